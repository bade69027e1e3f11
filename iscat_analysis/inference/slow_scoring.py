"""Damped Fisher scoring of any likelihood, for models that the compiled kernels do not know.

The steps are those of `iscat_analysis._kernels.scoring.maximize`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.scoring import LARGEST_GAIN_RATIO

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Score = Callable[[FloatArray], tuple[float, FloatArray, FloatArray]]

LARGEST_GROWTH = 0.5
"""Largest relative change of the amplitude in one step: the image of a sphere changes with it."""

_AMPLITUDE = 3
_LARGEST_DAMPING = 1e6


def maximize_slowly(
    score_fisher: Score,
    start: FloatArray,
    free: BoolArray,
    lower: FloatArray,
    upper: FloatArray,
    farthest: FloatArray,
    *,
    tolerance: float,
    passes: int,
    least: float,
) -> tuple[FloatArray, float, int, bool, FloatArray]:
    """Maximise inside a box; gives θ, the value, the passes, whether it converged, and the Fisher.

    Shapes: `start, free, lower, upper, farthest` (n,).
    """
    theta, damping = start.copy(), 0.0
    value, score, fisher = score_fisher(theta)
    used = 1
    while used < passes and math.isfinite(value):
        blocked = ((theta <= lower) & (score < 0)) | ((theta >= upper) & (score > 0))
        step = _step(score, fisher, free & ~blocked, damping)
        if step is None:
            if damping > _LARGEST_DAMPING:
                break
            damping = max(10 * damping, 1e-3)
            continue
        most_gained = 0.5 * LARGEST_GAIN_RATIO * float(score @ step)
        most = farthest.copy()
        most[_AMPLITUDE] = min(most[_AMPLITUDE], LARGEST_GROWTH * abs(theta[_AMPLITUDE]) or np.inf)
        step *= 1 / max(1.0, float(np.max(np.abs(step) / most)))
        trial = np.clip(theta + step, lower, upper)
        gain = 0.5 * float(score[free] @ (trial - theta)[free])
        if damping == 0.0 and gain < tolerance:
            return trial, value + gain, used, True, fisher
        if damping == 0.0 and value + most_gained < least:
            return trial, value + gain, used, False, fisher
        there = score_fisher(trial)
        used += 1
        if there[0] >= value - 1e-3 * tolerance - 1e-13 * abs(value):
            theta, (value, score, fisher) = trial, there
            damping = 0.0 if damping < 1e-2 else 0.1 * damping
        elif damping > _LARGEST_DAMPING:
            break
        else:
            damping = max(10 * damping, 1e-3)
    return theta, value, used, False, fisher


def _step(
    score: FloatArray, fisher: FloatArray, active: BoolArray, damping: float
) -> FloatArray | None:
    """Solve (F + damping·diag F) step = score on the active parameters; None if singular."""
    index = np.flatnonzero(active)
    out = np.zeros(score.size)
    diagonal = np.diag(fisher)[index]
    if not np.all(diagonal > 0):
        return None
    scale = 1 / np.sqrt(diagonal)
    scaled = fisher[np.ix_(index, index)] * np.outer(scale, scale) + damping * np.eye(index.size)
    try:
        out[index] = scale * np.linalg.solve(scaled, score[index] * scale)
    except np.linalg.LinAlgError:
        return None
    return out if np.all(np.isfinite(out)) else None
