"""Movies of ``benchmarks/hazards.py``, in which something is wrong: right, or flagged in words."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from _hazard_rows import ROWS
from hazards import judge

pytestmark = pytest.mark.large

SEEDS = range(31, 81, 10)


@pytest.mark.parametrize(
    ("name", "strength"),
    [
        ("clean", 1.0),
        ("tether", 17.0),  # seen in time, where only a part of it is
        ("tether", 35.0),
        ("jitter", 15.0),  # which leaves steps beside the particles
        ("breathing", 0.05),
        ("light that rises", 40.0),
        ("aggregates among proteins", 10000.0),  # whose rings are no flood of noise
    ],
)
def test_a_row_keeps_its_promise(name: str, strength: float) -> None:
    found = judge(name, ROWS[name], strength, SEEDS)
    assert found["kept"], found


def test_a_lie_is_found() -> None:
    """The control: masses are compared with 0.9 of the truth."""
    name = "clean, truth changed afterwards"
    assert not judge(name, ROWS[name], 0.9, SEEDS)["kept"]


def test_contrasts_that_breathe_are_told_and_their_errors_are_larger() -> None:
    found = judge("breathing", ROWS["breathing"], 0.05, SEEDS)
    assert any("contrasts fluctuate" in text for text in found["said"])
    assert found["pull_std"] < 1 + 3 / (2 * found["ok"]) ** 0.5
