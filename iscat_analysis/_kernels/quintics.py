"""The quintics of a radial profile at eight pixels at once, in vector registers.

Every pixel lies in another interval of the profile, so that a loop over pixels reads its six powers
one by one, and a compiler leaves it scalar.  Here a pixel evaluates all channels, which follow one
another in a profile, in one register, and eight pixels are then exchanged for their channels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.vectors import LANES, Code, instructions

FloatArray = NDArray[np.float64]

DISTANCE = 12
"""Row of the distances, after eight channels and four slopes."""


@njit(cache=True, nogil=True, error_model="numpy")
def padded(pixels: int) -> int:
    """Give the length of a row of scratch."""
    return (pixels + LANES - 1) // LANES * LANES


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate the first four channels of a profile.

    Parameters
    ----------
    profile : ndarray, shape (intervals, 6, 4 or more)
        See `iscat_analysis._kernels.radial`.
    f : ndarray, shape (rows, padded)
        Row `DISTANCE` has the distances of the pixels, in intervals and below their number; the
        first four rows are filled with the channels.
    """
    for j in range(0, f.shape[1], LANES):
        _values(profile, f, j)


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_slopes(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate eight channels as `evaluate` four, and in rows 8 to 11 slopes of the first four."""
    for j in range(0, f.shape[1], LANES):
        _with_slopes(profile, f, j)


def _pixel(code: Code, number: int, channels: int) -> tuple[list[Any], Any]:
    """Load the powers of all channels at a pixel, and its place in the interval."""
    profile, f = code.one, code.other
    place = code.plus(code.first, code.index(number))
    interval, t = code.parted(code.in_row(f, DISTANCE, place), channels)
    every = code.length(profile, 2)
    first = code.times(interval, code.index(POWERS))
    rows = (code.times(code.plus(first, code.index(k)), every) for k in range(POWERS))
    return [code.load(code.at(profile, row), channels) for row in rows], t


def _store(code: Code, rows: list[Any]) -> None:
    """Fill the first rows of scratch."""
    for k, row in enumerate(rows):
        code.store(row, code.in_row(code.other, k, code.first))


def _write_with_slopes(code: Code) -> None:
    """Horner's rule for eight channels and their slopes, of which four are kept."""
    values, slopes = [], []
    for pixel in range(LANES):
        c, t = _pixel(code, pixel, LANES)
        value, slope = code.multiply_add(c[5], t, c[4]), c[5]
        for k in (3, 2, 1, 0):
            slope = code.multiply_add(slope, t, value)
            value = code.multiply_add(value, t, c[k])
        values.append(value)
        slopes.append(slope)
    _store(code, code.exchanged(values) + code.exchanged(slopes)[: LANES // 2])


def _write_values(code: Code) -> None:
    """Horner's rule for four channels of two pixels in one register."""
    half, values = LANES // 2, []
    for pixel in range(half):
        (near, t_near), (far, t_far) = (
            _pixel(code, number, half) for number in (pixel, pixel + half)
        )
        c = [code.joined(*pair) for pair in zip(near, far, strict=True)]
        t = code.joined(t_near, t_far)
        value = c[5]
        for k in (4, 3, 2, 1, 0):
            value = code.multiply_add(value, t, c[k])
        values.append(value)
    _store(code, code.exchanged(values))


_with_slopes = instructions(_write_with_slopes)
_values = instructions(_write_values)
