"""What every pixel contributes to a likelihood, for parameters of any kind.

The kernels know a particle's own parameters; where the microscope's take part as well, the rows of
derivatives are put together here.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis._kernels.scoring import CONDITIONAL
from iscat_analysis.records import FloatArray


def pixel_terms(
    kind: int, data: FloatArray, signal: FloatArray, level: float
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Log-likelihood of a region and what its derivatives are made of.

    Each pixel's law has one natural coordinate η: the logarithm of the odds of a count to come
    after the step (CONDITIONAL), or the expected counts (POISSON).

    Shapes: `data` (4, ny, nx), `signal` (ny, nx), `score, information, by_signal, by_level` (ny,
    nx).
    """
    c0, c1, c2, c3 = data
    bright, nothing = 1 + signal, np.zeros(signal.shape)
    if kind == CONDITIONAL:
        used = c3 > 0
        if np.any(bright[used] <= 0):
            return -math.inf, nothing, nothing, nothing, nothing
        safe, odds = np.where(used, bright, 1.0), np.where(used, c2, 1.0)
        shift = np.log(safe) + level
        eta = np.log(odds) + shift
        p = 1 / (1 + np.exp(-eta))
        terms = c0 * shift - c1 * (np.logaddexp(0.0, eta) - np.log1p(odds))
        score = np.where(used, c3 * (c0 - c1 * p), 0.0)
        information = np.where(used, c3 * c1 * p * (1 - p), 0.0)
        return float(np.sum(c3 * terms)), score, information, 1 / safe, np.ones(signal.shape)
    used = c2 > 0
    gain = math.exp(level)
    expected = gain * (c1 + c2 * signal)
    rate = expected + c3
    if np.any(rate[used] <= 0):
        return -math.inf, nothing, nothing, nothing, nothing
    rate = np.where(used, rate, 1.0)
    empty = np.where(used, c1 + c3, 1.0)
    value = float(np.sum(np.where(used, c0 * np.log(rate / empty) - rate + empty, 0.0)))
    score = np.where(used, c0 / rate - 1, 0.0)
    return value, score, np.where(used, 1 / rate, 0.0), gain * c2, expected
