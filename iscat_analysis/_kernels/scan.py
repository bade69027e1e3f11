"""Profile log-likelihood along z.

At one place and height the signal is a P + a² Q: the two pictures are made once for each height,
and the amplitude is fitted with them.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.image import Lens, Pixels, signal_parts
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.scoring import CONDITIONAL, FLOOR, scratch, signal_value, span

FloatArray = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy")
def scan_heights(
    axial: AxialTable,
    lens: Lens,
    pixels: Pixels,
    kind: int,
    data: FloatArray,
    heights: FloatArray,
    amplitude_range: tuple[float, float],
    theta: FloatArray,
    values: FloatArray,
    amplitudes: FloatArray,
) -> None:
    """Profile log-likelihood along z at fixed (x, y): the amplitude takes two scoring steps.

    Fills `values` and `amplitudes`, shape (n,), for `heights`; θ gives the rest and the start.  An
    empty amplitude range holds the amplitude fixed.
    """
    work, profile = scratch(axial, lens, 1)
    here = theta.copy()
    parts = np.empty((pixels.y.size, 2, pixels.x.size))
    s = np.empty((pixels.y.size, pixels.x.size))
    low, high = amplitude_range
    unit, level = theta[3] if theta[3] != 0.0 else 1.0, np.exp(theta[4])
    for k in range(heights.size):
        here[2] = heights[k]
        start, stop = span(lens, pixels, here, axial.heights.shape[3])
        profile_at(axial, here[2], start, stop, work, profile)
        signal_parts(profile, lens, pixels, theta[0], theta[1], unit, parts)
        a = theta[3]
        for _ in range(2 if low < high else 0):
            pull = known = 0.0
            for row in range(parts.shape[0]):
                one, two = _row_amplitude(kind, data, row, level, a, parts[row])
                pull += one
                known += two
            if known > 0:
                a = min(max(a + pull / known, low), high)
        for row in range(parts.shape[0]):
            for j in range(s.shape[1]):
                s[row, j] = a * (parts[row, 0, j] + a * parts[row, 1, j])
        values[k] = signal_value(kind, data, level, s.reshape(s.size))
        amplitudes[k] = a


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _row_amplitude(
    kind: int, data: FloatArray, row: int, level: float, a: float, parts: FloatArray
) -> tuple[float, float]:
    """Score of one row about the amplitude, and its information."""
    c0, c1, c2, c3 = data[0, row], data[1, row], data[2, row], data[3, row]
    pull = known = 0.0
    for j in range(c0.size):
        s, slope = a * (parts[0, j] + a * parts[1, j]), parts[0, j] + 2 * a * parts[1, j]
        if kind == CONDITIONAL:
            bright = max(1.0 + s, FLOOR)
            odds = c2[j] * level * bright
            per = 1.0 / (bright * (1.0 + odds))
            pull += c3[j] * (c0[j] + odds * (c0[j] - c1[j])) * per * slope
            known += c3[j] * c1[j] * odds * (per * slope) ** 2
        else:
            gain = level * c2[j]
            per = 1.0 / max(level * (c1[j] + c2[j] * s) + c3[j], FLOOR)
            pull += gain * (c0[j] * per - 1.0) * slope
            known += gain * gain * per * slope * slope
    return pull, known
