"""Rows that leap aside for a frame or two."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.tracking.rows import Localizations
from iscat_analysis.tracking.stages import without_outliers

FRAMES = 200


def _rows(step_nm: float, error_nm: float) -> Localizations:
    """Two tracks of normal steps, seen with errors."""
    rng = np.random.default_rng(7)
    frame, track = np.divmod(np.arange(2 * FRAMES), 2)
    paths = np.cumsum(rng.normal(0, step_nm, (FRAMES, 2, 2)), axis=0)
    theta = np.zeros((2 * FRAMES, 5))
    theta[:, :2] = (paths + rng.normal(0, error_nm, paths.shape)).reshape(-1, 2)
    theta[:, 3] = rng.normal(100.0, 3.0, 2 * FRAMES)
    return Localizations.of(frame, track, theta)


@pytest.mark.parametrize(("step_nm", "error_nm"), [(3.0, 10.0), (70.0, 10.0), (0.0, 10.0)])
def test_normal_steps_stay(step_nm: float, error_nm: float) -> None:
    rows = _rows(step_nm, error_nm)
    assert (without_outliers(rows).theta == rows.theta).all()


@pytest.mark.parametrize("length", [1, 2])
def test_leaps_are_brought_back(length: int) -> None:
    rows = _rows(3.0, 10.0)
    truth = rows.theta.copy()
    away = np.flatnonzero(rows.track == 1)[[50, 120]]
    for first in away:
        there = first + 2 * np.arange(length)
        rows.theta[there, :2] += (250.0, -400.0)
        rows.theta[there, 3] *= 0.2
    back = without_outliers(rows).theta
    changed = np.flatnonzero((back != rows.theta).any(axis=1))
    expected = [first + 2 * k for first in away for k in range(length)]
    assert changed.tolist() == expected
    assert np.abs(back[changed, :2] - truth[changed, :2]).max() < 50
    assert np.abs(back[changed, 3] / 100 - 1).max() < 0.05


def test_few_rows_are_left_alone() -> None:
    rows = _rows(3.0, 10.0)
    few = rows.only(rows.frame < 3)
    few.theta[2, :2] += 500
    assert (without_outliers(few).theta == few.theta).all()
