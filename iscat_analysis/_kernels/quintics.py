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


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_last_slopes(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate the last eight of twelve channels as `evaluate_slopes` eight."""
    for j in range(0, f.shape[1], LANES):
        _with_last_slopes(profile, f, j)


@njit(cache=True, nogil=True, error_model="numpy")
def evaluate_bends(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate as `evaluate`, and in rows 4 to 7 slopes, in rows 8 to 11 second derivatives."""
    for j in range(0, f.shape[1], LANES):
        _with_bends(profile, f, j)


def _pixel(code: Code, number: int, channels: int, skipped: int = 0) -> tuple[list[Any], Any]:
    """Load the powers of some channels at a pixel, and its place in the interval."""
    profile, f = code.one, code.other
    place = code.plus(code.first, code.index(number))
    interval, t = code.parted(code.in_row(f, DISTANCE, place), channels)
    every = code.length(profile, 2)
    first, begin = code.times(interval, code.index(POWERS)), code.index(skipped)
    rows = (code.times(code.plus(first, code.index(k)), every) for k in range(POWERS))
    places = (code.plus(row, begin) for row in rows)
    return [code.load(code.at(profile, place), channels) for place in places], t


def _pair(code: Code, number: int) -> tuple[list[Any], Any]:
    """Load the powers of four channels at a pixel and at the fourth after it, in one register."""
    half = LANES // 2
    (near, t_near), (far, t_far) = (_pixel(code, k, half) for k in (number, number + half))
    return [code.joined(*both) for both in zip(near, far, strict=True)], code.joined(t_near, t_far)


def _store(code: Code, rows: list[Any]) -> None:
    """Fill the first rows of scratch."""
    for k, row in enumerate(rows):
        code.store(row, code.in_row(code.other, k, code.first))


def _write_with_slopes(code: Code, skipped: int = 0) -> None:
    """Horner's rule for eight channels and their slopes, of which four are kept."""
    values, slopes = [], []
    for pixel in range(LANES):
        c, t = _pixel(code, pixel, LANES, skipped)
        value, slope = code.multiply_add(c[5], t, c[4]), c[5]
        for k in (3, 2, 1, 0):
            slope = code.multiply_add(slope, t, value)
            value = code.multiply_add(value, t, c[k])
        values.append(value)
        slopes.append(slope)
    _store(code, code.exchanged(values) + code.exchanged(slopes)[: LANES // 2])


def _write_values(code: Code) -> None:
    """Horner's rule for four channels."""
    values = []
    for pixel in range(LANES // 2):
        c, t = _pair(code, pixel)
        value = c[5]
        for k in (4, 3, 2, 1, 0):
            value = code.multiply_add(value, t, c[k])
        values.append(value)
    _store(code, code.exchanged(values))


def _write_with_bends(code: Code) -> None:
    """Horner's rule for four channels, their slopes and second derivatives."""
    values, slopes, bends = [], [], []
    for pixel in range(LANES // 2):
        c, t = _pair(code, pixel)
        value, slope, bend = code.multiply_add(c[5], t, c[4]), c[5], c[5]
        slope, value = code.multiply_add(slope, t, value), code.multiply_add(value, t, c[3])
        for k in (2, 1, 0):
            bend = code.multiply_add(bend, t, slope)
            slope = code.multiply_add(slope, t, value)
            value = code.multiply_add(value, t, c[k])
        values.append(value)
        slopes.append(slope)
        bends.append(code.plus_itself(bend))
    _store(code, [row for rows in (values, slopes, bends) for row in code.exchanged(rows)])


_with_slopes = instructions(_write_with_slopes)
_with_last_slopes = instructions(lambda code: _write_with_slopes(code, LANES // 2))
_values = instructions(_write_values)
_with_bends = instructions(_write_with_bends)
