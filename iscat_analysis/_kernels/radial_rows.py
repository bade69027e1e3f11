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
from functools import partial
from typing import Any

import numpy as np

from iscat_analysis._kernels import FAST, FloatArray, kernel
from iscat_analysis._kernels.lens import Pixels, RoundLens
from iscat_analysis._kernels.loops import copy_line, whole
from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.vectors import LANES, Code, instructions

DISTANCE = 12
"""Row of the distances, after eight channels and four slopes."""


@kernel()
def padded(pixels: int) -> int:
    """Give the length of a row of scratch."""
    return (pixels + LANES - 1) // LANES * LANES


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


def _horner(code: Code, c: list[Any], t: Any, derivatives: int) -> list[Any]:
    """Value of a quintic at t, its slope, and half its second derivative."""
    out = [c[POWERS - 1]]
    for power in reversed(range(POWERS - 1)):
        more = out[-1:] if len(out) <= derivatives else []
        out = [
            code.multiply_add(each, t, before)
            for each, before in zip(out, [c[power], *out], strict=False)
        ] + more
    return out


def _write_wide(code: Code, skipped: int = 0) -> None:
    """Eight channels and their slopes, of which four are kept."""
    begin, places = _places(code)
    quintics = []
    for k in range(LANES):
        c = _powers(code, code.plus(begin[k], code.index(skipped)), LANES)
        quintics.append(_horner(code, c, code.chosen(places, [k] * LANES), 1))
    values, slopes = zip(*quintics, strict=True)
    _store(code, code.exchanged([*values]) + code.exchanged([*slopes])[: LANES // 2])


def _write_four(code: Code, derivatives: int = 0) -> None:
    """Four channels and their derivatives."""
    quintics = [_horner(code, c, t, derivatives) for c, t in _pairs(code)]
    rows = []
    for order, parts in enumerate(zip(*quintics, strict=True)):
        whole = [code.plus_itself(part) if order == 2 else part for part in parts]
        rows += code.exchanged(whole)
    _store(code, rows)


_values, _with_bends = instructions(_write_four), instructions(partial(_write_four, derivatives=2))
_with_slopes = instructions(_write_wide)
_with_last_slopes = instructions(partial(_write_wide, skipped=LANES // 2))


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


_DX, _DY, SUMS = DISTANCE + 1, DISTANCE + 2, DISTANCE + 3
"""Rows of scratch after those of the quintics: dx, dy, and the sums over the samples."""

_STRIP = 256  # pixels, or one row if it has more


@kernel()
def intervals_needed(lens: RoundLens, pixels: Pixels, theta: FloatArray, most: int) -> int:
    """Count the intervals of a radial profile that an image needs, of `most`, and one to round."""
    x, y, margin = pixels.x, pixels.y, abs(pixels.offsets[-1])
    dx = max(abs(x[0] - theta[0]), abs(x[-1] - theta[0])) + margin
    dy = max(abs(y[0] - theta[1]), abs(y[-1] - theta[1])) + margin
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
        f[SUMS, j] += weight * (2 * rho * a * eu_r + a * a * power)
        f[SUMS + 1, j] -= weight * (cos_psi * s_u - sin_psi * s_v)
        f[SUMS + 2, j] -= weight * (sin_psi * s_u + cos_psi * s_v)
        f[SUMS + 3, j] += weight * (
            g_r * (f[4, j] + f[6, j] * c2)
            + g_i * (f[5, j] + f[7, j] * c2)
            + (h_r * f[6, j] + h_i * f[7, j]) * s2
        )
        f[SUMS + 4, j] += weight * (2 * rho * eu_r + 2 * a * power)


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
        f[SUMS, j] += weight * 2 * rho * eu_r
        f[SUMS + 1, j] += weight * (eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i)


@kernel()
def strip_scratch(pixels: Pixels) -> tuple[int, FloatArray]:
    """Rows of pixels in a strip, and its scratch."""
    together = min(max(_STRIP // pixels.x.size, 1), pixels.y.size)
    return together, np.empty((SUMS + 5, padded(together * pixels.x.size)))


@kernel()
def radial_strip(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, theta: FloatArray, first: int, last: int,
    count: int, f: FloatArray,
) -> None:  # fmt: skip
    """Compute rows `first` to `last` of signal and gradient (`count` 5) or of the parts (2).

    They are in the lines of `f` from `SUMS` on, all pixels one after the other; the parts do not
    depend on the amplitude.
    """
    x, y, offsets, weights = pixels.x, pixels.y[first:last], pixels.offsets, pixels.weights
    for k in range(SUMS, SUMS + count):
        for j in range(f.shape[1]):
            f[k, j] = 0.0
    for i in range(offsets.size):
        for j in range(offsets.size):
            _place(lens.inv_step, x, y, theta[0] - offsets[j], theta[1] - offsets[i], f)
            weight = weights[i] * weights[j]
            if count == 5:
                evaluate_slopes(profile, f)
                _add_gradient(lens, theta[3], weight, f)
            else:
                evaluate(profile, f)
                _add_parts(lens, weight, f)


@kernel()
def radial_parts(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, theta: FloatArray, out: FloatArray
) -> None:
    """As `iscat_analysis._kernels.image.signal_parts`."""
    rows, columns = pixels.y.size, pixels.x.size
    together, f = strip_scratch(pixels)
    for first in range(0, rows, together):
        last = min(first + together, rows)
        radial_strip(profile, lens, pixels, theta, first, last, 2, f)
        for k in range(2):
            strip = f[SUMS + k, : (last - first) * columns]
            copy_line(strip, out[k, first * columns : last * columns])


@kernel(fastmath=FAST)
def radial_signal(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, theta: FloatArray, out: FloatArray
) -> None:
    """As `iscat_analysis._kernels.image.signal_image`."""
    parts, amplitude = np.empty((2, out.size)), theta[3]
    radial_parts(profile, lens, pixels, theta, parts)
    for i in range(out.shape[0]):
        p, q, there = parts[0, i * out.shape[1] :], parts[1, i * out.shape[1] :], out[i]
        for j in range(there.size):
            there[j] = amplitude * (p[j] + amplitude * q[j])


@kernel(fastmath=FAST)
def _parts_along(
    f: FloatArray, lens: RoundLens, a: float, direction: int, parts: FloatArray
) -> None:
    """Fill `parts` (2, n) with the signal at the distances of `f` in a direction that matters.

    At fixed r the signal is a function of cos 2φ, with its extremes at ±1 or where its slope
    vanishes.
    """
    for j in range(parts.shape[1]):
        square = (f[DISTANCE, j] / lens.inv_step) ** 2
        f0r, f0i, f2r, f2i = f[0, j], f[1, j], square * f[2, j], square * f[3, j]
        turn, across = 1.0 - 2.0 * direction, 0.0
        if lens.co == 0.0:
            turn, across = 0.0, lens.ring * (f2r * f2r + f2i * f2i)
        elif direction == 2:
            slope = lens.rho * f2r + a * (f0r * f2r + f0i * f2i)
            sign = -1.0 if a < 0 else 1.0
            curvature = max(abs(a) * (f2r * f2r + f2i * f2i), 1e-300)
            turn = min(max(-slope / curvature * sign, -1.0), 1.0)
        re, im = f0r + turn * f2r, f0i + turn * f2i
        parts[0, j], parts[1, j] = 2 * lens.rho * a * re, a * a * (re * re + im * im + across)


@kernel()
def largest_signal(
    profile: FloatArray, lens: RoundLens, per_step: int, amplitude: float
) -> tuple[float, float]:
    """Parts of the signal of largest magnitude that are linear and quadratic in the amplitude.

    The largest signal on a radial grid of `per_step` points in each interval of the profile is
    refined by a parabola through its neighbours.
    """
    count = per_step * profile.shape[0]
    f, parts = np.empty((DISTANCE + 1, padded(count))), np.empty((2, padded(count)))
    for j in range(f.shape[1]):
        f[DISTANCE, j] = min(j, count - 1) / per_step
    evaluate(profile, f)
    at = int(np.int64(0))  # a literal 0 has its own type, for which more is compiled
    top, node, sums = -1.0, 0.0, parts[0]
    for direction in range(1 if lens.co == 0.0 else 3 if lens.cross == 0.0 else 2):
        _parts_along(f, lens, amplitude, direction, parts)
        for j in range(count):
            sums[j] += parts[1, j]
        for j in range(count):
            if abs(sums[j]) > top:
                top, at = abs(sums[j]), direction
                low, high = sums[max(j - 1, 0)], sums[min(j + 1, count - 1)]
                curvature = low - 2 * sums[j] + high
                inside = 0 < j < count - 1 and curvature != 0.0
                node = (j + (0.5 * (low - high) / curvature if inside else 0.0)) / per_step
    f = np.empty((DISTANCE + 1, LANES))
    f[DISTANCE] = node
    evaluate(profile, f)
    _parts_along(f, lens, amplitude, at, parts[:, :LANES])
    return parts[0, 0], parts[1, 0]
