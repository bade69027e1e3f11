"""From a radial profile to the image of a particle and its gradient, a strip of rows at a time.

A strip needs two loops over all of its pixels: the first evaluates the quintics, eight pixels at a
time; the second combines them.  Both use vector registers, and their rows of scratch fit into the
first cache.

Every pixel lies in another interval of the profile, so that a loop over pixels would read its six
powers one by one, and the compiler would use no vector registers.  So all channels of one pixel,
which are next to each other in a profile, are evaluated in one register.  The registers of eight
pixels are then transposed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import njit

from iscat_analysis._kernels import FAST, FloatArray, kernel
from iscat_analysis._kernels.lens import Pixels, RoundLens
from iscat_analysis._kernels.loops import whole
from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.vectors import LANES, Code, instructions

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


_DX, _DY, _SUMS = DISTANCE + 1, DISTANCE + 2, DISTANCE + 3
"""Rows of scratch after those of the quintics: dx, dy, and the sums over the samples."""

_SCRATCH = _SUMS + 5
_STRIP = 256  # pixels, or one row if it has more


@kernel()
def intervals_needed(lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, most: int) -> int:
    """Count the intervals of a radial profile that an image needs, of `most`, and one to round."""
    x, y, margin = pixels.x, pixels.y, abs(pixels.offsets[-1])
    dx = max(abs(x[0] - x_p), abs(x[-1] - x_p)) + margin
    dy = max(abs(y[0] - y_p), abs(y[-1] - y_p)) + margin
    distance = np.sqrt(dx * dx + dy * dy) * lens.inv_step
    needed: int = min(whole(distance, 0, most) + 2, most)
    return needed


@kernel(fastmath=FAST)
def _place(
    inv_step: float, x: FloatArray, y: FloatArray, x_p: float, y_p: float, f: FloatArray
) -> None:
    """Fill rows `_DX`, `_DY` and `DISTANCE` of f; with zeros if there are no pixels."""
    for i in range(y.size):
        for j in range(x.size):
            f[_DX, i * x.size + j] = x[j] - x_p
            f[_DY, i * x.size + j] = y[i] - y_p
    for j in range(x.size * y.size, f.shape[1]):
        f[_DX, j] = f[_DY, j] = 0.0
    for j in range(f.shape[1]):
        f[DISTANCE, j] = np.sqrt(f[_DX, j] * f[_DX, j] + f[_DY, j] * f[_DY, j]) * inv_step


@kernel(fastmath=FAST)
def _add_gradient(lens: RoundLens, amplitude: float, weight: float, f: FloatArray) -> None:
    """Add weight × (s, ∂s/∂x_p, ∂s/∂y_p, ∂s/∂z, ∂s/∂a) of a strip to its sums."""
    inv_step, rho, cos_psi, sin_psi, co, cross, ring = lens
    a = amplitude
    for j in range(f.shape[1]):
        dx, dy = f[_DX, j], f[_DY, j]
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        per_r = inv_step * inv_step / (f[DISTANCE, j] + 1e-30)
        c2, s2 = co * (u * u - v * v), cross * (2 * u * v) + ring * (u * u + v * v)
        eu_r, eu_i = f[0, j] + f[2, j] * c2, f[1, j] + f[3, j] * c2
        ev_r, ev_i = f[2, j] * s2, f[3, j] * s2
        # (1/r) d/dr of the fields at fixed u² − v² and 2uv
        p_r, p_i = (f[8, j] + f[10, j] * c2) * per_r, (f[9, j] + f[11, j] * c2) * per_r
        q_r, q_i = f[10, j] * s2 * per_r, f[11, j] * s2 * per_r
        # ∂s = Re(g* ∂e_u + h* ∂e_v), with ∂u e_u = p u + 2u F2 co, ∂v e_u = p v − 2v F2 co,
        # ∂u e_v = q u + 2 F2 (v cross + u ring), ∂v e_v = q v + 2 F2 (u cross + v ring)
        g_r, g_i = 2 * a * rho + 2 * a * a * eu_r, 2 * a * a * eu_i
        h_r, h_i = 2 * a * a * ev_r, 2 * a * a * ev_i
        along_r = g_r * p_r + g_i * p_i + h_r * q_r + h_i * q_i
        along_u = 2 * co * (g_r * f[2, j] + g_i * f[3, j])
        both = 2 * (h_r * f[2, j] + h_i * f[3, j])
        along_r += ring * both
        along_v = cross * both
        s_u = along_r * u + along_u * u + along_v * v
        s_v = along_r * v - along_u * v + along_v * u
        power = eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i
        f[_SUMS, j] += weight * (2 * rho * a * eu_r + a * a * power)
        f[_SUMS + 1, j] -= weight * (cos_psi * s_u - sin_psi * s_v)
        f[_SUMS + 2, j] -= weight * (sin_psi * s_u + cos_psi * s_v)
        f[_SUMS + 3, j] += weight * (
            g_r * (f[4, j] + f[6, j] * c2)
            + g_i * (f[5, j] + f[7, j] * c2)
            + (h_r * f[6, j] + h_i * f[7, j]) * s2
        )
        f[_SUMS + 4, j] += weight * (2 * rho * eu_r + 2 * a * power)


@kernel(fastmath=FAST)
def _add_parts(lens: RoundLens, weight: float, f: FloatArray) -> None:
    """Add weight × the factors of a and a² in a strip of signals to its sums."""
    _, rho, cos_psi, sin_psi, co, cross, ring = lens
    for j in range(f.shape[1]):
        dx, dy = f[_DX, j], f[_DY, j]
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        c2, s2 = co * (u * u - v * v), cross * (2 * u * v) + ring * (u * u + v * v)
        eu_r, eu_i = f[0, j] + f[2, j] * c2, f[1, j] + f[3, j] * c2
        ev_r, ev_i = f[2, j] * s2, f[3, j] * s2
        f[_SUMS, j] += weight * 2 * rho * eu_r
        f[_SUMS + 1, j] += weight * (eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i)


@kernel()
def strip_scratch(pixels: Pixels) -> tuple[int, FloatArray]:
    """Rows of pixels in a strip, and its scratch."""
    together = min(max(_STRIP // pixels.x.size, 1), pixels.y.size)
    return together, np.empty((_SCRATCH, padded(together * pixels.x.size)))


@kernel()
def radial_strip(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, first: int, last: int, x_p: float,
    y_p: float, amplitude: float, count: int, f: FloatArray,
) -> FloatArray:  # fmt: skip
    """Compute rows `first` to `last` of signal and gradient (`count` 5) or of the parts (2).

    Returns the lines of `f` that hold them, with all pixels one after the other; the parts do not
    depend on the amplitude.
    """
    x, y, offsets, weights = pixels.x, pixels.y[first:last], pixels.offsets, pixels.weights
    sums = f[_SUMS : _SUMS + count]
    for k in range(count):
        for j in range(sums.shape[1]):
            sums[k, j] = 0.0
    for i in range(offsets.size):
        for j in range(offsets.size):
            _place(lens.inv_step, x, y, x_p - offsets[j], y_p - offsets[i], f)
            weight = weights[i] * weights[j]
            if count == 5:
                evaluate_slopes(profile, f)
                _add_gradient(lens, amplitude, weight, f)
            else:
                evaluate(profile, f)
                _add_parts(lens, weight, f)
    return sums


@kernel()
def radial_gradient(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, amplitude: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """As `iscat_analysis._kernels.image.signal_gradient`."""
    rows, columns = pixels.y.size, pixels.x.size
    together, f = strip_scratch(pixels)
    for first in range(0, rows, together):
        last = min(first + together, rows)
        sums = radial_strip(profile, lens, pixels, first, last, x_p, y_p, amplitude, 5, f)
        for row in range(first, last):
            begin = (row - first) * columns
            for k in range(5):
                here, there = sums[k, begin : begin + columns], out[row, k]
                for j in range(columns):
                    there[j] = here[j]


@kernel()
def radial_parts(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, out: FloatArray
) -> None:
    """As `iscat_analysis._kernels.image.signal_parts`."""
    rows, columns = pixels.y.size, pixels.x.size
    together, f = strip_scratch(pixels)
    for first in range(0, rows, together):
        last = min(first + together, rows)
        sums = radial_strip(profile, lens, pixels, first, last, x_p, y_p, 1.0, 2, f)
        for k in range(2):
            here, there = sums[k], out[k, first * columns : last * columns]
            for j in range(there.size):
                there[j] = here[j]


@kernel(fastmath=FAST)
def radial_signal(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, amplitude: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """As `iscat_analysis._kernels.image.signal_image`."""
    parts = np.empty((2, out.size))
    radial_parts(profile, lens, pixels, x_p, y_p, parts)
    for i in range(out.shape[0]):
        p, q, there = parts[0, i * out.shape[1] :], parts[1, i * out.shape[1] :], out[i]
        for j in range(there.size):
            there[j] = amplitude * (p[j] + amplitude * q[j])


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
    profile: FloatArray, inv_step: float, per_step: int, amplitude: float, rho: float,
    circular: bool, analyzer: bool,
) -> tuple[float, float]:  # fmt: skip
    """Parts of the signal of largest magnitude that are linear and quadratic in the amplitude.

    The largest signal on a radial grid of `per_step` points in each interval of the profile is
    refined by a parabola through its neighbours.
    """
    count = per_step * profile.shape[0]
    f, sums = np.empty((DISTANCE + 1, padded(count))), np.empty(padded(count))
    for j in range(f.shape[1]):
        f[DISTANCE, j] = min(j, count - 1) / per_step
    evaluate(profile, f)
    at = int(np.int64(0))  # a literal 0 has its own type, for which more is compiled
    top, node = -1.0, 0.0
    for extreme in range(1 if circular else 3 if analyzer else 2):
        _add_up(f, inv_step, amplitude, rho, circular, analyzer, extreme, sums)
        for j in range(count):
            if abs(sums[j]) > top:
                top, at = abs(sums[j]), extreme
                low, high = sums[max(j - 1, 0)], sums[min(j + 1, count - 1)]
                curvature = low - 2 * sums[j] + high
                inside = 0 < j < count - 1 and curvature != 0.0
                node = (j + (0.5 * (low - high) / curvature if inside else 0.0)) / per_step
    f = np.empty((DISTANCE + 1, LANES))
    f[DISTANCE] = node
    evaluate(profile, f)
    square = (node / inv_step) ** 2
    linear, quadratic = _parts(
        at, f[0, 0], f[1, 0], square * f[2, 0], square * f[3, 0], amplitude, rho, circular, analyzer
    )
    return linear, quadratic
