"""The quintics of a radial profile at eight pixels at once, in vector registers.

Every pixel lies in another interval of the profile, so that a loop over pixels reads its six powers
one by one, and a compiler leaves it scalar.  Here a pixel evaluates all channels, which follow one
another in a profile, in one register, and eight pixels are then exchanged for their channels.
Numba makes no such code of loops: it is written as the instructions of LLVM, for registers of eight
numbers, which a processor has or puts together from smaller ones.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from iscat_analysis._kernels.radial import POWERS

FloatArray = NDArray[np.float64]

LANES = 8
"""Pixels at once; rows of scratch are longer than the pixels of a row by up to one less."""

DISTANCE = 12
"""Row of the distances, after eight channels and four slopes."""

_DOUBLE, _BYTE = ir.DoubleType(), ir.IntType(8)
_INDEX, _LANE = ir.IntType(64), ir.IntType(32)
_FLAGS = ("contract", "nsz")


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


def _lanes(*numbers: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(_LANE, len(numbers)), list(numbers))


def _exchanged(builder: ir.IRBuilder, rows: list[Any], widths: tuple[int, ...]) -> list[Any]:
    """Transpose a square of registers, or each square of one register's halves."""
    rows = list(rows)
    for width in widths:
        for i in range(len(rows)):
            if i & width:
                continue
            here, there = rows[i], rows[i + width]
            low = [LANES + (k ^ width) if k & width else k for k in range(LANES)]
            high = [LANES + k if k & width else k | width for k in range(LANES)]
            rows[i] = builder.shuffle_vector(here, there, _lanes(*low))
            rows[i + width] = builder.shuffle_vector(here, there, _lanes(*high))
    return rows


class _Emitter:
    """Writes the instructions that read a profile and fill rows of scratch."""

    def __init__(self, context: Any, builder: Any, signature: Any, arguments: Any) -> None:
        self.b = builder
        self.profile, rows = (
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args[:2], arguments[:2], strict=True)
        )
        self.channels = cgutils.unpack_tuple(builder, self.profile.shape)[2]
        self.stride = cgutils.unpack_tuple(builder, rows.strides)[0]
        self.rows = builder.bitcast(rows.data, _BYTE.as_pointer())
        self.first = arguments[2]

    def row(self, number: int) -> Any:
        """Point to the first pixel in a row of scratch."""
        at = self.b.gep(self.rows, [self.b.mul(self.stride, ir.Constant(_INDEX, number))])
        return self.b.gep(self.b.bitcast(at, _DOUBLE.as_pointer()), [self.first])

    def pixel(self, number: int, channels: int) -> tuple[list[Any], Any]:
        """Load the six powers of all channels, one register each, and spread a place over one."""
        distance = self.b.load(self.b.gep(self.row(DISTANCE), [ir.Constant(_INDEX, number)]))
        interval = self.b.fptosi(distance, _INDEX)
        place = self.b.fsub(distance, self.b.sitofp(interval, _DOUBLE), flags=_FLAGS)
        kind = ir.VectorType(_DOUBLE, channels)
        nothing = ir.Constant(kind, ir.Undefined)
        one = self.b.insert_element(nothing, place, ir.Constant(_LANE, 0))
        spread = self.b.shuffle_vector(one, nothing, _lanes(*[0] * channels))
        first = self.b.mul(interval, ir.Constant(_INDEX, POWERS))
        powers = []
        for k in range(POWERS):
            row = self.b.mul(self.b.add(first, ir.Constant(_INDEX, k)), self.channels)
            at = self.b.gep(self.profile.data, [row])
            powers.append(self.b.load(self.b.bitcast(at, kind.as_pointer()), align=8))
        return powers, spread

    def multiply_add(self, x: Any, y: Any, z: Any) -> Any:
        return self.b.fadd(self.b.fmul(x, y, flags=_FLAGS), z, flags=_FLAGS)

    def store(self, rows: list[Any]) -> None:
        """Fill the first rows of scratch from the first pixel on."""
        for k, row in enumerate(rows):
            self.b.store(row, self.b.bitcast(self.row(k), row.type.as_pointer()), align=8)


def _void(
    emit: Callable[[_Emitter], None],
) -> Callable[..., tuple[Any, Callable[..., Any]]]:
    """Make the typing of `emit`, whose instructions return nothing."""

    def typed(_: Any, profile: Any, rows: Any, first: Any) -> tuple[Any, Callable[..., Any]]:
        def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            emit(_Emitter(context, builder, signature, arguments))
            return context.get_dummy_value()

        return types.void(profile, rows, first), write

    return typed


def _write_with_slopes(e: _Emitter) -> None:
    """Horner's rule for eight channels and their slopes, of which four are kept."""
    values, slopes = [], []
    for pixel in range(LANES):
        c, t = e.pixel(pixel, LANES)
        value, slope = e.multiply_add(c[5], t, c[4]), c[5]
        for k in (3, 2, 1, 0):
            slope = e.multiply_add(slope, t, value)
            value = e.multiply_add(value, t, c[k])
        values.append(value)
        slopes.append(slope)
    both = [_exchanged(e.b, rows, (1, 2, 4)) for rows in (values, slopes)]
    e.store(both[0] + both[1][: LANES // 2])


def _write_values(e: _Emitter) -> None:
    """Horner's rule for four channels of two pixels in one register."""
    half, every = LANES // 2, _lanes(*range(LANES))
    values = []
    for pixel in range(half):
        (near, t_near), (far, t_far) = e.pixel(pixel, half), e.pixel(pixel + half, half)
        c = [e.b.shuffle_vector(a, b, every) for a, b in zip(near, far, strict=True)]
        t = e.b.shuffle_vector(t_near, t_far, every)
        value = c[5]
        for k in (4, 3, 2, 1, 0):
            value = e.multiply_add(value, t, c[k])
        values.append(value)
    e.store(_exchanged(e.b, values, (1, 2)))


_with_slopes = intrinsic(_void(_write_with_slopes))
_values = intrinsic(_void(_write_values))
