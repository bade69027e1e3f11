"""The maximiser of every likelihood that the compiled kernels do not know: damped scoring in a box.

Score and expected information make a step (Fisher scoring), which is damped after Levenberg and
Marquardt where it does not raise the likelihood.  Steps, damping and outcomes are those of
`iscat_analysis._kernels.scoring.maximize`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from iscat_analysis._kernels.scoring import LARGEST_GAIN_RATIO
from iscat_analysis.records import BoolArray, Box, FloatArray

TOLERANCE = 2e-4
"""Gain of log-likelihood, as a scoring step expects it, at which a fit ends."""

PASSES = 60
"""Evaluations that a fit may take."""


@dataclass(frozen=True)
class Optimum:
    """Where a maximisation ended."""

    theta: FloatArray
    log_likelihood: float
    passes: int
    converged: bool
    fisher: FloatArray


def covariance_of(information: FloatArray, free: BoolArray) -> FloatArray:
    """Inverse of the information about the free parameters; NaN of those it does not determine.

    Shapes: `information`, result (n, n), `free` (n,).
    """
    known = free & (np.diag(information) > 0)
    inside, scale = np.ix_(known, known), 1 / np.sqrt(np.diag(information)[known])
    unit = np.outer(scale, scale)
    out = np.full(information.shape, math.nan)
    out[inside] = np.linalg.pinv(information[inside] * unit, hermitian=True) * unit
    return out


def eliminated(information: FloatArray, shared: int) -> FloatArray:
    """Information about the first parameters after all others are fitted: the Schur complement.

    Shapes: `information` (n, n), result (shared, shared).
    """
    cross = information[:shared, shared:]
    return np.asarray(information[:shared, :shared] + cross @ imitation(information, shared))


def imitation(information: FloatArray, shared: int) -> FloatArray:
    """Change of the last parameters per unit error of the first ones.

    Shapes: `information` (n, n), result (n − shared, shared).
    """
    block = information[shared:, shared:]
    scale = 1 / np.sqrt(np.diag(block))
    solved = np.linalg.solve(
        block * np.outer(scale, scale), information[shared:, :shared] * scale[:, None]
    )
    return np.asarray(-solved * scale[:, None])


def scoring_step(
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


def maximise(
    score_fisher: Callable[[FloatArray], tuple[float, FloatArray, Any]],
    start: FloatArray,
    box: Box,
    farthest: Callable[[FloatArray], FloatArray],
    *,
    tolerance: float = TOLERANCE,
    least: float = -math.inf,
    step_of: Callable[[FloatArray, Any, BoolArray, float], FloatArray | None] = scoring_step,
) -> Optimum:
    """Maximise a log-likelihood inside a box.

    `farthest` gives the largest change of each parameter in a step from a point.  A fit is given up
    where it cannot reach `least`.  `step_of` solves for the step where the information is no
    matrix, but blocks of one.

    Shapes: `start` (n,).
    """
    theta, damping = start.copy(), 0.0
    value, score, fisher = score_fisher(theta)
    used = 1
    while used < PASSES and math.isfinite(value) and damping <= 1e6:
        blocked = ((theta <= box.lower) & (score < 0)) | ((theta >= box.upper) & (score > 0))
        step = step_of(score, fisher, box.free & ~blocked, damping)
        if step is None:
            damping = max(10 * damping, 1e-3)
            continue
        most_gained = 0.5 * LARGEST_GAIN_RATIO * float(score @ step)
        step = step / max(1.0, float(np.max(np.abs(step) / farthest(theta))))
        trial = np.clip(theta + step, box.lower, box.upper)
        gain = 0.5 * float(score[box.free] @ (trial - theta)[box.free])
        if damping == 0.0 and (gain < tolerance or value + most_gained < least):
            return Optimum(trial, value + gain, used, gain < tolerance, fisher)
        there = score_fisher(trial)
        used += 1
        if there[0] >= value - 1e-3 * tolerance - 1e-13 * abs(value):
            theta, (value, score, fisher) = trial, there
            damping = 0.0 if damping < 1e-2 else 0.1 * damping
        else:
            damping = max(10 * damping, 1e-3)
    return Optimum(theta, value, used, False, fisher)
