"""What ``benchmarks/scale.py`` concludes from jobs: on invented ones, whose prices are known."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

SOURCE = Path(__file__).resolve().parents[2] / "benchmarks" / "scale.py"
TRUTH = np.array([5.0, 0.4, 0.014, 0.012])
"""Processor seconds once, per part, per megabyte and per event."""


@pytest.fixture(scope="module")
def scale() -> Any:
    """Load the benchmark."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SOURCE.parent)
        spec = importlib.util.spec_from_file_location("scale", SOURCE)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, "scale", module)  # where its dataclasses look
        spec.loader.exec_module(module)
        return module


def _jobs(scale: Any, error: float, seed: int) -> list[Any]:
    """Invent the jobs of the usual series, and the longest one in more parts."""
    rng = np.random.default_rng(seed)
    sizes = [
        (128, 400, 1, 1), (128, 800, 10, 1), (256, 800, 40, 1), (512, 800, 160, 2),
        (128, 3200, 40, 1), (128, 12800, 320, 2), (512, 400, 10, 1), (512, 400, 100, 1),
        (512, 400, 400, 1), (128, 12800, 320, 8),
    ]  # fmt: skip
    costs = []
    for side, frames, events, chunks in sizes:
        job = scale.Job(side, side, frames, events)
        cost = scale.Cost(job, 0.0, 0.0, 0.0, {}, events, chunks, 1)
        taken = float(TRUTH @ scale.amounts(cost)) * (1 + error * rng.standard_normal())
        costs.append(scale.Cost(job, taken, 0.0, 0.0, {}, events, chunks, 1))
    return costs


def test_prices_are_those_that_jobs_were_made_of(scale: Any) -> None:
    found, _ = scale.prices(_jobs(scale, 0.0, 0))
    np.testing.assert_allclose(found, TRUTH, rtol=1e-9)
    pulls = []
    for seed in range(60):
        found, errors = scale.prices(_jobs(scale, 0.03, seed))
        pulls.append((found - TRUTH) / errors)
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4 * 1.2 / np.sqrt(60))
    assert np.all(np.std(pulls, axis=0) < 1.6)  # Student's t of 6 degrees of freedom: 1.22


def test_parts_are_whole_and_the_movie_is_hashed_by_one(scale: Any) -> None:
    """Four parts keep eight workers no busier than four; with many parts hashing limits."""
    amount = (1.0, 4.0, 400.0, 100.0)
    once, shared = 5.0, 4 * 0.4 + 400 * 0.014 + 100 * 0.012
    found = scale.efficiency(TRUTH, amount, hash_mb_per_s=1e9)
    assert found[1] == 1.0
    assert found[2] == pytest.approx((once + shared) / (2 * (once + shared / 2)))
    assert found[8] == pytest.approx(found[4] / 2, rel=1e-6)
    long = (1.0, 4000.0, 4e5, 1e5)
    quick, slow = (scale.efficiency(TRUTH, long, hash_mb_per_s=h)[64] for h in (1e9, 1000.0))
    whole = once + 1000 * shared
    assert quick == pytest.approx(whole / (64 * (once + 1000 * shared * 63 / 4000)), rel=1e-6)
    assert slow == pytest.approx(whole / (64 * (once + 400.0)), rel=1e-6)
