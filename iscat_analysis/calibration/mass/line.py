"""A straight line through points with errors in both coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.records import FloatArray


@dataclass(frozen=True)
class Line:
    """A straight line y = slope·x + intercept."""

    slope: float
    intercept: float
    covariance: FloatArray
    chi2: float
    dof: int


def york_line(x: ArrayLike, x_se: ArrayLike, y: ArrayLike, y_se: ArrayLike) -> Line:
    """Fit a line to points with independent errors in both coordinates.

    Shapes: `x, x_se` (n,), `y, y_se` (n,).
    """
    xs, sx, ys, sy = (np.asarray(v, dtype=np.float64) for v in (x, x_se, y, y_se))
    if np.unique(xs).size < 2 or (sy <= 0).any():
        raise ValueError("a line needs two different x, and positive errors of y")
    vx, vy = sx**2, sy**2
    slope = float(np.polyfit(xs, ys, 1, w=1 / sy)[0])
    for _ in range(200):
        weight = 1 / (vy + slope**2 * vx)
        x_mean = float(np.sum(weight * xs) / weight.sum())
        y_mean = float(np.sum(weight * ys) / weight.sum())
        u, v = xs - x_mean, ys - y_mean
        beta = weight * (u * vy + slope * v * vx)
        new = float(np.sum(weight * beta * v) / np.sum(weight * beta * u))
        done = abs(new - slope) <= 1e-14 * abs(new)
        slope = new
        if done:
            break
    adjusted = x_mean + beta
    centre = float(np.sum(weight * adjusted) / weight.sum())
    var_slope = float(1 / np.sum(weight * (adjusted - centre) ** 2))
    var_intercept = float(1 / weight.sum()) + centre**2 * var_slope
    covariance = np.array([[var_slope, -centre * var_slope], [-centre * var_slope, var_intercept]])
    intercept = y_mean - slope * x_mean
    chi2 = float(np.sum(weight * (ys - slope * xs - intercept) ** 2))
    return Line(slope, intercept, covariance, chi2, xs.size - 2)
