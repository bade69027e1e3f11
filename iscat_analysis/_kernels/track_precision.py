"""Information, bias and goodness of the fit of a particle in a frame; see `fit_frames`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iscat_analysis._kernels import FAST, AnyFloatArray, BoolArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.background_response import keep_slopes
from iscat_analysis._kernels.canvas import Pictures, Rows, cut, draw, lens_of, square_of, stage
from iscat_analysis._kernels.lens import STAMP, Lens, Pixels
from iscat_analysis._kernels.loops import copy_line, factorise, largest
from iscat_analysis._kernels.moving import LEAST, Room, Scene, place_score
from iscat_analysis._kernels.noise import FLOOR
from iscat_analysis._kernels.stamp import BENDS

PART = 0.5
"""Steps, in standard deviations, of the differences that give second derivatives."""


@kernel(fastmath=FAST, _nrt=False)
def _add_curvature(
    data: FloatArray, here: FloatArray, plus: FloatArray, minus: FloatArray, bias: FloatArray
) -> None:
    """Add −½ Σ β²/λ ∂²s ∂s to the bias, ∂² from the signals one `PART` to each side."""
    for i in range(data.shape[1]):
        d1, d2, d3 = data[1, i], data[2, i], data[3, i]
        s, up, down = here[i, 0], plus[i, 0], minus[i, 0]
        gx, gy, gz, ga = here[i, 1], here[i, 2], here[i, 3], here[i, 4]
        b0 = b1 = b2 = b3 = 0.0
        for j in range(s.size):
            rate = max(d1[j] + d2[j] * s[j] + d3[j], FLOOR)
            curved = d2[j] * d2[j] / rate * (up[j] + down[j] - 2 * s[j])
            b0 += curved * gx[j]
            b1 += curved * gy[j]
            b2 += curved * gz[j]
            b3 += curved * ga[j]
        bias[0] -= 0.5 * b0 / PART**2
        bias[1] -= 0.5 * b1 / PART**2
        bias[2] -= 0.5 * b2 / PART**2
        bias[3] -= 0.5 * b3 / PART**2


@kernel(fastmath=FAST)
def _left_over(
    data: AnyFloatArray, here: AnyFloatArray, amplitude: float, numbers: FloatArray
) -> None:
    """Fill the last five numbers of a row.

    Where s = a P + a² Q, a ∂²s/∂a² is 2 (∂s/∂a − s/a).
    """
    zero, one, four = data.dtype.type(0.0), data.dtype.type(1.0), data.dtype.type(4.0)
    least, a = data.dtype.type(LEAST), data.dtype.type(amplitude)
    chi2 = used = light = known = more = zero
    # one sum for each column: a single sum would prevent vector registers
    worst = np.zeros(data.shape[2], data.dtype)
    inverse = one / a if a != zero else zero
    for i in range(data.shape[1]):
        d0, d1, d2, d3 = data[0, i], data[1, i], data[2, i], data[3, i]
        s, ga = here[i, 0], here[i, 4]
        for j in range(s.size):
            rate = d1[j] + d2[j] * s[j] + d3[j]
            per = one / max(rate, least)
            left = (d0[j] - rate) * (d0[j] - rate) * per
            chi2 += left
            worst[j] = max(worst[j], left)
            used += one if d2[j] > zero else zero
            light += d2[j]
            slope = d2[j] * ga[j]
            change = slope * per
            known += change * slope
            bend = four * d2[j] * (ga[j] - inverse * s[j])
            more += change * (bend - a * change * slope)
    numbers[0], numbers[1], numbers[2] = chi2, used, np.sqrt(worst[largest(worst)])
    numbers[3] = light / max(used, one)
    numbers[4] = more / known if known > zero else zero


class Judgements(NamedTuple):
    """Of every row: information, O V, V (n, 4, 4), bias (n, 4), and the numbers of tests (n, 6)."""

    fisher: FloatArray
    turned: FloatArray
    ways: FloatArray
    bias: FloatArray
    numbers: FloatArray


@kernel(_nrt=False)
def judge_frames(
    scene: Scene, free: BoolArray, particles: Rows, first: int, last: int, out: Judgements
) -> None:
    """Fill information, bias and tests of the rows of frames first…last − 1, at θ."""
    light, field, near, canvas, slopes, room = scene
    fisher, turned, ways, bias, numbers = out
    starts, theta, group = particles
    rows, columns = light.background.shape
    area, index, ways_here = field.side**2, room.free, room.ways
    known, pull, g = room.small[:5], room.small[5], room.pixels[4 * area :]
    for t in range(first, last):
        for r in range(starts[t], starts[t + 1]):
            p, f = theta[r], fisher[r]
            r0, r1, c0, c1 = square_of(field, canvas.rings[r], field.side, rows, columns)
            if r1 <= r0:
                continue
            ny, nx = r1 - r0, c1 - c0
            pixels = cut(field.pixels, r0, r1, c0, c1)
            m = _rows_drawn(near.lens)
            here = g[: m * ny * nx].reshape(ny, m, nx)
            draw(near, group[r], p, pixels, room.profile, here)
            data = room.pixels[: 4 * ny * nx].reshape(4, ny, nx)
            stage(light, t, canvas.total[t], here, r0, c0, data)
            keep_slopes(data[2], here, index, slopes, r, (r0, r1, c0, c1), room.line)
            value = place_score(data, here, near.lens, pull, known)
            for i in range(4):
                for j in range(4):
                    f[i, j] = known[i, j]
            numbers[r, 0] = value
            _left_over(data, here, p[3], numbers[r, 1:])
            if not _directions(f, index, ways_here):
                continue
            farthest = 0.0
            for k in range(index.size):
                for a in range(2):
                    farthest = max(farthest, abs(ways_here[a, k]))
            if PART * farthest > field.pixel_nm:  # practically singular
                continue
            for k in range(index.size):
                for a in range(4):
                    ways[r, a, k] = ways_here[a, k]
            _curve(
                near, lens_of(near, group[r]), group[r], free, pixels, data, here, p, ways_here,
                room, turned[r], bias[r],
            )  # fmt: skip


@kernel(_nrt=False)
def _rows_drawn(lens: Lens) -> int:
    """Give how many numbers `draw` is asked for of each pixel."""
    return int(np.int64(BENDS if len(lens) == STAMP else 5))  # a literal has its own type


@kernel()
def _curve(
    near: Pictures, lens: Lens, group: int, free: BoolArray, pixels: Pixels, data: AnyFloatArray,
    here: AnyFloatArray, p: FloatArray, ways: FloatArray, room: Room, turned: FloatArray,
    bias: FloatArray,
) -> None:  # fmt: skip
    """Fill O V of a row and add to its bias; the type of the lens chooses the compiled branches.

    An image at one height has second derivatives; for others they are differences.
    """
    ny, nx = pixels.y.size, pixels.x.size
    if len(lens) == STAMP:
        _curve_at_one_height(data, here, ways, turned, bias)
        return
    low = near.first_nm
    high = low + near.step_nm * (near.heights.shape[1] - 1)
    trial, pulls, known = np.empty(5), np.empty((2, 5)), np.empty((5, 5))
    both = room.work[: 10 * ny * nx].reshape(2, ny, 5, nx)
    for k in range(ways.shape[1]):
        for sign in range(2):
            step = PART if sign == 0 else -PART
            copy_line(p, trial)
            for a in range(4):
                trial[a] += step * ways[a, k]
            if free[2]:
                trial[2] = min(max(trial[2], low), high)
            draw(near, group, trial, pixels, room.profile, both[sign])
            place_score(data, both[sign], near.lens, pulls[sign], known)
        _add_curvature(data, here, both[0], both[1], bias)
        for a in range(4):
            turned[a, k] = -(pulls[0, a] - pulls[1, a]) / (2 * PART)


@kernel()
def _curve_at_one_height(
    data: AnyFloatArray, bends: AnyFloatArray, ways: FloatArray, turned: FloatArray,
    bias: FloatArray,
) -> None:  # fmt: skip
    """Do it with the second derivatives of an image at one height (ny, BENDS, nx)."""
    sums, spread, n = np.zeros(9), np.zeros((4, 4), bends.dtype), ways.shape[0]
    for a in range(n):  # not 4: the compiler would unroll the loop
        for b in range(n):
            for k in range(ways.shape[1]):
                spread[a, b] += ways[a, k] * ways[b, k]
    _observe(data, bends, spread, sums)
    order = (0, 1, 3)
    observed = np.zeros((4, 4))
    for m in range(3):
        for q in range(3):
            observed[order[m], order[q]] = sums[m + q + (m > 0 and q > 0)]
        bias[order[m]] -= 0.5 * sums[6 + m]
    for a in range(n):
        for k in range(ways.shape[1]):
            turned[a, k] = 0.0
            for b in range(n):
                turned[a, k] += observed[a, b] * ways[b, k]


@kernel(fastmath=FAST, _nrt=False)
def _observe(
    data: AnyFloatArray, bends: AnyFloatArray, spread: AnyFloatArray, sums: FloatArray
) -> None:
    """Sum the observed information in xx, xy, xa, yy, ya, aa, and Σ β²/λ tr(F⁻¹ ∂²s) ∂s."""
    one, two, least = data.dtype.type(1.0), data.dtype.type(2.0), data.dtype.type(LEAST)
    o0 = o1 = o2 = o3 = o4 = o5 = b0 = b1 = b2 = data.dtype.type(0.0)
    vxx, vyy, vaa = spread[0, 0], spread[1, 1], spread[3, 3]
    vxy, vxa, vya = two * spread[0, 1], two * spread[0, 3], two * spread[1, 3]
    for i in range(data.shape[1]):
        d0, d1, d2, d3 = data[0, i], data[1, i], data[2, i], data[3, i]
        s, gx, gy, ga = bends[i, 0], bends[i, 1], bends[i, 2], bends[i, 4]
        gxx, gxy, gyy = bends[i, 3], bends[i, 5], bends[i, 6]
        gxa, gya, gaa = bends[i, 7], bends[i, 8], bends[i, 9]
        for j in range(s.size):
            rate = d1[j] + d2[j] * s[j] + d3[j]
            per = one / max(rate, least)
            pull = d2[j] * per * (d0[j] - rate)
            weight = d2[j] * per * d2[j]
            bend = weight * per * d0[j]
            o0 += bend * gx[j] * gx[j] - pull * gxx[j]
            o1 += bend * gx[j] * gy[j] - pull * gxy[j]
            o2 += bend * gx[j] * ga[j] - pull * gxa[j]
            o3 += bend * gy[j] * gy[j] - pull * gyy[j]
            o4 += bend * gy[j] * ga[j] - pull * gya[j]
            o5 += bend * ga[j] * ga[j] - pull * gaa[j]
            curved = weight * (
                vxx * gxx[j] + vyy * gyy[j] + vaa * gaa[j]
                + vxy * gxy[j] + vxa * gxa[j] + vya * gya[j]
            )  # fmt: skip
            b0 += curved * gx[j]
            b1 += curved * gy[j]
            b2 += curved * ga[j]
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = o0, o1, o2, o3, o4, o5
    sums[6], sums[7], sums[8] = b0, b1, b2


@kernel()
def _directions(fisher: FloatArray, index: IntArray, out: FloatArray) -> bool:
    """Fill the columns of `out` (4, n) with V, V Vᵀ the inverse of F on the free parameters."""
    n = index.size
    scale = np.empty(n)
    for i in range(n):
        if not fisher[index[i], index[i]] > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(fisher[index[i], index[i]])
    low = np.empty((n, n))
    if not factorise(fisher, index, scale, 0.0, low):
        return False
    for i in range(n):
        # pivot of a matrix with ones on its diagonal below which a parameter is undetermined
        if not low[i, i] ** 2 > 1e-9:
            return False
    out[:] = 0.0
    for k in range(n):  # column k of L⁻ᵀ
        for i in range(k, -1, -1):
            total = 1.0 if i == k else 0.0
            for j in range(i + 1, k + 1):
                total -= low[j, i] * out[index[j], k] / scale[j]
            out[index[i], k] = total / low[i, i] * scale[i]
    return True
