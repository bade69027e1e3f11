"""All that the tests of a fit ask of its pixels, in one call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.residuals import residuals, suspects
from iscat_analysis._kernels.score_test import mode_statistic

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@kernel()
def count_and_test(
    kind: int,
    data: FloatArray,
    level: float,
    rows: FloatArray,
    x: FloatArray,
    y: FloatArray,
    theta: FloatArray,
    waist: float,
    order: int,
    free: BoolArray,
    dependent: float,
    negligible: float,
    many: float,
    rate: FloatArray,
    tails: FloatArray,
) -> tuple[float, int, float, float, float, int, float, float, int]:
    """Look at the residuals of one fit; all arguments are those of the three kernels it calls."""
    residual, terms = np.empty(rate.shape), np.empty((rate.shape[0], 4, rate.shape[1]))
    chi2, pixels, excess, largest, least = residuals(kind, data, level, rows, rate, residual, terms)
    mode_chi2, freedom, mode_excess = mode_statistic(
        x, y, theta, waist, order, rows, terms, free, dependent, largest, negligible
    )
    least_tail, count = suspects(kind, data, rate, residual, many, tails)
    return chi2, pixels, excess, least, mode_chi2, freedom, mode_excess, least_tail, count
