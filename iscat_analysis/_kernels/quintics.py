"""The quintics of a radial profile at eight pixels at once, in vector registers.

Every pixel lies in another interval of the profile, so that a loop over pixels reads its six powers
one by one, and the compiler uses no vector registers.  Here all channels of one pixel, which are
next to each other in a profile, are evaluated in one register.  The registers of eight pixels are
then transposed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.vectors import LANES, Code, instructions

FloatArray = NDArray[np.float64]

DISTANCE = 12
"""Row of the distances, after eight channels and four slopes."""


@kernel()
def padded(pixels: int) -> int:
    """Give the length of a row of scratch."""
    return (pixels + LANES - 1) // LANES * LANES


@kernel()
def evaluate(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate the first four channels of a profile.

    Shapes: `profile` (intervals, 6, 4 or more), `f` (rows, padded).
    """
    for j in range(0, f.shape[1], LANES):
        _values(profile, f, j)


@kernel()
def evaluate_slopes(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate eight channels like `evaluate`, and in rows 8 to 11 slopes of the first four."""
    for j in range(0, f.shape[1], LANES):
        _with_slopes(profile, f, j)


@kernel()
def evaluate_last_slopes(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate the last eight of twelve channels like `evaluate_slopes`."""
    for j in range(0, f.shape[1], LANES):
        _with_last_slopes(profile, f, j)


@kernel()
def evaluate_bends(profile: FloatArray, f: FloatArray) -> None:
    """Evaluate as `evaluate`, and in rows 4 to 7 slopes, in rows 8 to 11 second derivatives."""
    for j in range(0, f.shape[1], LANES):
        _with_bends(profile, f, j)


def _places(code: Code) -> tuple[list[Any], Any]:
    """Give where the powers of eight pixels begin, and their positions in their intervals."""
    intervals, t = code.parted(code.in_row(code.other, DISTANCE, code.first))
    size = code.times(code.index(POWERS), code.length(code.one, 2))
    return [code.times(interval, size) for interval in intervals], t


def _powers(code: Code, begin: Any, channels: int) -> list[Any]:
    """Load the powers of some channels."""
    every = code.length(code.one, 2)
    places = (code.plus(begin, code.times(code.index(k), every)) for k in range(POWERS))
    return [code.load(code.at(code.one, place), channels) for place in places]


def _pairs(code: Code) -> Iterator[tuple[list[Any], Any]]:
    """Load powers of four channels, of a pixel and of the fourth after it in one register."""
    begin, t = _places(code)
    half = LANES // 2
    for k in range(half):
        near, far = _powers(code, begin[k], half), _powers(code, begin[k + half], half)
        both = zip(near, far, strict=True)
        yield [code.joined(*pair) for pair in both], code.chosen(t, [k] * half + [k + half] * half)


def _store(code: Code, rows: list[Any]) -> None:
    """Fill the first rows of scratch."""
    for k, row in enumerate(rows):
        code.store(row, code.in_row(code.other, k, code.first))


def _write_with_slopes(code: Code, skipped: int = 0) -> None:
    """Horner's rule for eight channels and their slopes, of which four are kept."""
    values, slopes = [], []
    begin, places = _places(code)
    for k in range(LANES):
        c = _powers(code, code.plus(begin[k], code.index(skipped)), LANES)
        t = code.chosen(places, [k] * LANES)
        value, slope = code.multiply_add(c[5], t, c[4]), c[5]
        for power in (3, 2, 1, 0):
            slope = code.multiply_add(slope, t, value)
            value = code.multiply_add(value, t, c[power])
        values.append(value)
        slopes.append(slope)
    _store(code, code.exchanged(values) + code.exchanged(slopes)[: LANES // 2])


def _write_values(code: Code) -> None:
    """Horner's rule for four channels."""
    values = []
    for c, t in _pairs(code):
        value = c[5]
        for k in (4, 3, 2, 1, 0):
            value = code.multiply_add(value, t, c[k])
        values.append(value)
    _store(code, code.exchanged(values))


def _write_with_bends(code: Code) -> None:
    """Horner's rule for four channels, their slopes and second derivatives."""
    values, slopes, bends = [], [], []
    for c, t in _pairs(code):
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
