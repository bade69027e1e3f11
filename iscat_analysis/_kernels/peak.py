"""Signal of largest magnitude around a particle, from a radial profile."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.quintics import DISTANCE, evaluate, padded
from iscat_analysis._kernels.vectors import LANES

FloatArray = NDArray[np.float64]

_NEAR = 0.9  # of the largest signal at nodes, above which an interval may contain the maximum


@njit(inline="always")
def _parts(
    extreme: int, f0r: float, f0i: float, f2r: float, f2i: float, a: float, rho: float,
    circular: bool, analyzer: bool,
) -> tuple[float, float]:  # fmt: skip
    """Linear and quadratic part of the signal in one of the directions that matter.

    At fixed r the signal is a function of cos 2φ, with its extremes at ±1 or where its slope
    vanishes.  F2 comes multiplied by r².
    """
    if circular:
        other = 0.0 if analyzer else f2r * f2r + f2i * f2i
        return 2 * rho * a * f0r, a * a * (f0r * f0r + f0i * f0i + other)
    turn = 1.0 - 2.0 * extreme
    if extreme == 2:
        slope = rho * f2r + a * (f0r * f2r + f0i * f2i)
        sign = -1.0 if a < 0 else 1.0
        curvature = max(abs(a) * (f2r * f2r + f2i * f2i), 1e-300)
        turn = min(max(-slope / curvature * sign, -1.0), 1.0)
    re, im = f0r + turn * f2r, f0i + turn * f2i
    return 2 * rho * a * re, a * a * (re * re + im * im)


@kernel(fastmath=FAST)
def _add_up(
    f: FloatArray, inv_step: float, a: float, rho: float, circular: bool, analyzer: bool,
    extreme: int, sums: FloatArray,
) -> None:  # fmt: skip
    """Fill `sums` with the signal at the distances of `f` in one direction."""
    for j in range(sums.size):
        square = (f[DISTANCE, j] / inv_step) ** 2
        linear, quadratic = _parts(
            extreme, f[0, j], f[1, j], square * f[2, j], square * f[3, j], a, rho,
            circular, analyzer,
        )  # fmt: skip
        sums[j] = linear + quadratic


@kernel()
def largest_signal(
    profile: FloatArray,
    inv_step: float,
    per_step: int,
    amplitude: float,
    rho: float,
    circular: bool,
    analyzer: bool,
) -> tuple[float, float]:
    """Parts of the signal of largest magnitude that are linear and quadratic in the amplitude.

    The largest signal on a radial grid of `per_step` points in each interval of the profile is
    refined by a parabola through its neighbours.  Only intervals that begin or end near the largest
    signal at a node are searched: within an interval the signal rises by a twentieth at most.
    """
    intervals, extremes = profile.shape[0], 1 if circular else 3 if analyzer else 2
    rough, f = np.empty((extremes, padded(intervals))), np.empty((DISTANCE + 1, padded(intervals)))
    for j in range(f.shape[1]):
        f[DISTANCE, j] = min(j, intervals - 1)
    evaluate(profile, f)
    top = 0.0
    for extreme in range(extremes):
        _add_up(f, inv_step, amplitude, rho, circular, analyzer, extreme, rough[extreme])
        for k in range(intervals):
            top = max(top, abs(rough[extreme, k]))
    fine, f = np.empty(padded(per_step)), np.empty((DISTANCE + 1, padded(per_step)))
    at = best = int(np.int64(0))  # a literal 0 has its own type, for which more is compiled
    least, top = _NEAR * top, -1.0
    for k in range(intervals):
        near = False
        for extreme in range(extremes):
            after = abs(rough[extreme, min(k + 1, intervals - 1)])
            near |= max(abs(rough[extreme, k]), after) >= least
        if not near:
            continue
        for i in range(f.shape[1]):
            f[DISTANCE, i] = k + min(i, per_step - 1) / per_step
        evaluate(profile, f)
        for extreme in range(extremes):
            _add_up(f, inv_step, amplitude, rho, circular, analyzer, extreme, fine)
            for i in range(per_step):
                if abs(fine[i]) > top:
                    top, at, best = abs(fine[i]), extreme, k * per_step + i
    count, node = per_step * intervals, best / per_step
    f, neighbours = np.empty((DISTANCE + 1, LANES)), np.empty(LANES)
    if 0 < best < count - 1:
        for i in range(LANES):
            f[DISTANCE, i] = (best + min(i, 2) - 1) / per_step
        evaluate(profile, f)
        _add_up(f, inv_step, amplitude, rho, circular, analyzer, at, neighbours)
        low, mid, high = neighbours[0], neighbours[1], neighbours[2]
        curvature = low - 2 * mid + high
        if curvature != 0.0:
            node += 0.5 * (low - high) / curvature / per_step
    f[DISTANCE] = node
    evaluate(profile, f)
    square = (node / inv_step) ** 2
    linear, quadratic = _parts(
        at, f[0, 0], f[1, 0], square * f[2, 0], square * f[3, 0], amplitude, rho, circular, analyzer
    )
    return linear, quadratic
