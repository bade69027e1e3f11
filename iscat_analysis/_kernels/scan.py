"""Profile log-likelihood along z.

At one position and height the signal is a P + a² Q.  The two images are computed once for each
height, and the amplitude is fitted with them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.image import Pixels, signal_parts
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lens import named_lens
from iscat_analysis._kernels.noise import score_of_pixel
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.scoring import blank_profile, signal_value, span

FloatArray = NDArray[np.float64]


@kernel()
def scan_heights(
    table: tuple[Any, ...],
    optics: tuple[Any, ...],
    grid: tuple[Any, ...],
    kind: int,
    data: FloatArray,
    heights: FloatArray,
    amplitude_range: tuple[float, float],
    theta: FloatArray,
    values: FloatArray,
    amplitudes: FloatArray,
) -> None:
    """Profile log-likelihood along z at fixed (x, y): the amplitude takes two scoring steps.

    Fills `values` and `amplitudes`, shape (n,), for `heights`; θ gives the other parameters and the
    start.  An empty amplitude range holds the amplitude fixed.  The first three arguments are those
    of `maximize`.
    """
    axial, lens, pixels = AxialTable(*table), named_lens(optics), Pixels(*grid)
    profile = blank_profile(axial, lens, 1)
    here, size = theta.copy(), pixels.y.size * pixels.x.size
    flat, parts, s = data.reshape(4, size), np.empty((2, size)), np.empty(size)
    p, q = parts[0], parts[1]
    low, high = amplitude_range
    unit, level = theta[3] if theta[3] != 0.0 else 1.0, np.exp(theta[4])
    for k in range(heights.size):
        here[2] = heights[k]
        start, stop = span(lens, pixels, here, axial.heights.shape[3])
        profile_at(axial, here[2], start, stop, profile)
        signal_parts(profile, lens, pixels, theta[0], theta[1], unit, parts)
        a = theta[3]
        for _ in range(2 if low < high else 0):
            pull, known = _amplitude(kind, flat, level, a, p, q)
            if known > 0:
                a = min(max(a + pull / known, low), high)
        for j in range(s.size):
            s[j] = a * (p[j] + a * q[j])
        values[k] = signal_value(kind, data, level, s)
        amplitudes[k] = a


@kernel(fastmath=FAST)
def _amplitude(
    kind: int, data: FloatArray, level: float, a: float, p: FloatArray, q: FloatArray
) -> tuple[float, float]:
    """Score about the amplitude, and its information; data has shape (4, n)."""
    pull = known = 0.0
    for j in range(p.size):
        s, slope = a * (p[j] + a * q[j]), p[j] + 2 * a * q[j]
        score, bend, _ = score_of_pixel(
            kind, data[0, j], data[1, j], data[2, j], data[3, j], level, s
        )
        pull += score * slope
        known += bend * slope * slope
    return pull, known
