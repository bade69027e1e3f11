"""The domain of a model: heights of its tables, and pixels within its reach."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SLACK_NM = 1e-6
"""Tolerance for the rounding of coordinates at the edge of the support."""


@kernel()
def supported(
    thetas: FloatArray,
    x: FloatArray,
    y: FloatArray,
    half_pixel: float,
    reach: float,
    low: float,
    high: float,
    largest_level: float,
) -> BoolArray:
    """Tell for which θ (n, 5) all pixels are within reach, z is in the table and all is finite."""
    inside = np.empty(thetas.shape[0], dtype=np.bool_)
    for k in range(thetas.shape[0]):
        dx = max(abs(thetas[k, 0] - x[0]), abs(thetas[k, 0] - x[-1])) + half_pixel
        dy = max(abs(thetas[k, 1] - y[0]), abs(thetas[k, 1] - y[-1])) + half_pixel
        inside[k] = (
            np.hypot(dx, dy) <= reach
            and low - SLACK_NM <= thetas[k, 2] <= high + SLACK_NM
            and np.isfinite(thetas[k, 3])
            and abs(thetas[k, 4]) <= largest_level
        )
    return inside


@kernel()
def box_supported(
    start: FloatArray,
    free: BoolArray,
    lower: FloatArray,
    upper: FloatArray,
    x: FloatArray,
    y: FloatArray,
    half_pixel: float,
    reach: float,
    low: float,
    high: float,
    largest_level: float,
) -> tuple[bool, bool]:
    """Tell whether a box contains the start of the free parameters, and is in the support."""
    inside = True
    corners = np.empty((4, 5))
    for i in range(5):
        if free[i] and not lower[i] <= start[i] <= upper[i]:
            inside = False
        for k in range(4):
            corners[k, i] = start[i]
        if free[i] and i < 3:
            corners[0, i], corners[1, i] = lower[i], upper[i]
            corners[2, i] = lower[i] if i == 0 else upper[i]
            corners[3, i] = upper[i] if i == 0 else lower[i]
    known = supported(corners, x, y, half_pixel, reach, low, high, largest_level)
    return inside, known[0] and known[1] and known[2] and known[3]
