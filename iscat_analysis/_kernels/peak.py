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

_STRIP = 256  # distances looked at together, as many as the first cache holds


@njit(inline="always")
def _parts(
    way: int, f0r: float, f0i: float, f2r: float, f2i: float, a: float, rho: float,
    circular: bool, analyzer: bool,
) -> tuple[float, float]:  # fmt: skip
    """Linear and quadratic part of the signal in one of the directions that matter.

    At fixed r the signal is a function of cos 2φ, with its extremes at ±1 or where its slope
    vanishes.  F2 comes multiplied by r².
    """
    if circular:
        other = 0.0 if analyzer else f2r * f2r + f2i * f2i
        return 2 * rho * a * f0r, a * a * (f0r * f0r + f0i * f0i + other)
    turn = 1.0 - 2.0 * way
    if way == 2:
        slope = rho * f2r + a * (f0r * f2r + f0i * f2i)
        sign = -1.0 if a < 0 else 1.0
        bend = max(abs(a) * (f2r * f2r + f2i * f2i), 1e-300)
        turn = min(max(-slope / bend * sign, -1.0), 1.0)
    re, im = f0r + turn * f2r, f0i + turn * f2i
    return 2 * rho * a * re, a * a * (re * re + im * im)


@kernel(fastmath=FAST)
def _add_up(
    f: FloatArray, inv_step: float, a: float, rho: float, circular: bool, analyzer: bool, way: int,
    sums: FloatArray,
) -> None:  # fmt: skip
    """Fill `sums` with the signal at the distances of `f` in one direction."""
    for j in range(sums.size):
        square = (f[DISTANCE, j] / inv_step) ** 2
        linear, quadratic = _parts(
            way, f[0, j], f[1, j], square * f[2, j], square * f[3, j], a, rho, circular, analyzer
        )
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

    The largest on a radial grid of `per_step` points in each interval of the profile, then that of
    a parabola through its neighbours.
    """
    count, ways = per_step * profile.shape[0], 1 if circular else 3 if analyzer else 2
    sums, f = np.empty((ways, padded(count))), np.empty((DISTANCE + 1, _STRIP))
    for first in range(0, sums.shape[1], _STRIP):
        last = min(first + _STRIP, sums.shape[1])
        for j in range(_STRIP):
            f[DISTANCE, j] = min(first + j, count - 1) / per_step
        evaluate(profile, f)
        for way in range(ways):
            _add_up(f, inv_step, amplitude, rho, circular, analyzer, way, sums[way, first:last])
    at = best = 0
    top = -1.0
    for way in range(ways):
        for j in range(count):
            if abs(sums[way, j]) > top:
                top, at, best = abs(sums[way, j]), way, j
    place = best / per_step
    if 0 < best < count - 1:
        low, mid, high = sums[at, best - 1], sums[at, best], sums[at, best + 1]
        bend = low - 2 * mid + high
        if bend != 0.0:
            place += 0.5 * (low - high) / bend / per_step
    f = np.empty((DISTANCE + 1, LANES))
    f[DISTANCE] = place
    evaluate(profile, f)
    square = (place / inv_step) ** 2
    linear, quadratic = _parts(
        at, f[0, 0], f[1, 0], square * f[2, 0], square * f[3, 0], amplitude, rho, circular,
        analyzer,
    )  # fmt: skip
    return linear, quadratic
