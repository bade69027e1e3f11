"""The fit of MSPT that benchmarks compare with does what it is said to do."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

SOURCE = Path(__file__).resolve().parents[2] / "benchmarks" / "_mspt.py"
SPEC = importlib.util.spec_from_file_location("_mspt", SOURCE)
assert SPEC is not None
assert SPEC.loader is not None
mspt = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(mspt)

TRUTH = np.array([-30.0, 0.3, -0.4, 0.15, 2.1, 0.2, 1.3])


def picture(p: np.ndarray, side: int = 13) -> np.ndarray:
    """Draw the difference of two Gaussians, as its formula says."""
    height, x, y, t, s, offset, sigma = p
    row, column = np.indices((side, side)) - side // 2
    r2 = (column - x) ** 2 + (row - y) ** 2
    narrow, wide = np.exp(-r2 / (2 * sigma**2)), np.exp(-r2 / (2 * (s * sigma) ** 2))
    return height * (narrow - (1 - t) / s * wide) + offset


def test_derivatives_are_those_of_the_cost() -> None:
    image = picture(TRUTH) + np.random.default_rng(1).standard_normal((13, 13))
    at, step = TRUTH * 1.05, 1e-5
    assert mspt.cost(at, image) == pytest.approx(0.5 * ((picture(at) - image) ** 2).sum())

    def slope(of: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        return np.array([(of(at + d) - of(at - d)) / (2 * step) for d in step * np.eye(7)])

    gradient, hessian = mspt.gradient(at, image), mspt.hessian(at, image)
    np.testing.assert_allclose(slope(lambda p: mspt.cost(p, image)), gradient, rtol=1e-6)
    error = np.abs(slope(lambda p: mspt.gradient(p, image)) - hessian)
    assert (error <= 1e-8 * np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))).all()


def test_its_own_picture_is_found_again() -> None:
    frame = picture(TRUTH, 41)
    noisy = frame + np.random.default_rng(2).standard_normal(frame.shape)
    ((row, column),) = mspt.candidates(noisy[4:, 2:])
    assert (row, column) == (20 - 4, 20 - 2)
    image = mspt.cut(frame[4:, 2:], row, column)
    begin = mspt.start(image, 0.002)
    assert begin[1:3] == pytest.approx(TRUTH[1:3], abs=0.1)
    found = mspt.fit(image, begin)
    assert found.success
    assert found.x == pytest.approx(TRUTH, rel=1e-4)
