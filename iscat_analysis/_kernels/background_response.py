"""Response of the rows of `iscat_analysis._kernels.moving` to a change of their background.

If the logarithm of the background changes by δ, the estimates of rows change by -F⁻¹ G δ, with
G = w B ∂C the slopes that connect parameters of a row with the pixels of its background.  F is the
information on all rows of a *cluster*: rows of a frame whose centres lie in one another's squares.
They must be taken together, because two overlapping rows share the response, and each alone would
respond to the whole change.

`own_shares`, `send` and `follow` do the same for the rows of one track, row by row for several
images at once, so that the slopes are read from memory once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import FAST, AnyFloatArray, FloatArray, IntArray, SingleArray, kernel
from iscat_analysis._kernels.canvas import Light
from iscat_analysis._kernels.loops import copy_line, factorise, solve

AnyArray = NDArray[Any]

_LEAST_DAMPING, _LARGEST_DAMPING = 1e-3, 1.0
"""Damping added to F, relative to its diagonal, for rows that cannot be told apart: the least, and
the largest, which is used if rounding makes F not positive."""

_LEAST_DAMPING_LINKED = 0.1
"""The same if rows respond to each other: combinations that are hardly determined do not change."""


_LARGEST = 32767.0
"""Largest number in which slopes are stored; the norm of a slope is scaled to it."""


class Slopes(NamedTuple):
    """Derivatives of the light in the squares of rows; not filled if the arrays are empty."""

    squares: IntArray
    values: NDArray[np.int16]
    units: FloatArray
    moves: FloatArray


class Clusters(NamedTuple):
    """Rows of a frame that overlap one another, and the information on them."""

    rows: IntArray
    edges: IntArray
    frame: IntArray
    corners: IntArray
    factors: FloatArray
    steps: FloatArray


@kernel(fastmath=FAST, _nrt=False)
def keep_slopes(
    level: FloatArray, gradient: AnyFloatArray, index: IntArray, slopes: Slopes, row: int,
    square: tuple[int, int, int, int], room: SingleArray,
) -> None:  # fmt: skip
    """Store level × gradient of the free parameters of a row; `room` is work space for one."""
    for i in range(4):
        slopes.squares[row, i] = square[i]
    ny, nx = level.shape
    for k in range(index.size):
        for i in range(ny):  # line by line, so that the compiler uses vector registers
            line, light = room[i * nx : (i + 1) * nx], level[i]
            slope = gradient[i, 1 + index[k]]
            for j in range(nx):
                line[j] = light[j] * slope[j]
        length = np.sqrt(product(room, room, ny * nx))  # no pixel is larger
        slopes.units[row, k] = length / _LARGEST
        per, out = np.float32(_LARGEST / length), slopes.values[row, k]
        for j in range(ny * nx):
            out[j] = np.int16(np.rint(per * room[j]))


@kernel(fastmath=FAST, _nrt=False)
def gather(image: FloatArray, square: IntArray, out: AnyFloatArray) -> int:
    """Fill `out` with the pixels of a square, line after line, and tell how many they are."""
    r0, r1, c0, c1 = square
    nx = c1 - c0
    for i in range(r1 - r0):
        line, there = out[i * nx : (i + 1) * nx], image[r0 + i, c0:c1]
        for j in range(nx):
            line[j] = there[j]
    size: int = (r1 - r0) * nx
    return size


@kernel(fastmath=FAST, _nrt=False)
def put(values: AnyFloatArray, square: IntArray, image: FloatArray) -> None:
    """Add values, line after line, to the pixels of a square."""
    r0, r1, c0, c1 = square
    nx = c1 - c0
    for i in range(r1 - r0):
        line, there = values[i * nx : (i + 1) * nx], image[r0 + i, c0:c1]
        for j in range(nx):
            there[j] += line[j]


@kernel(fastmath=FAST, _nrt=False)
def product(slope: AnyArray, seen: AnyFloatArray, size: int) -> float:
    """Sum the products of the first pixels, in the precision of `seen`."""
    total = seen.dtype.type(0.0)
    for j in range(size):
        total += seen.dtype.type(slope[j]) * seen[j]
    return float(total)


@kernel(fastmath=FAST, _nrt=False)
def mix(
    slopes: NDArray[np.int16], units: FloatArray, by: FloatArray, size: int, out: AnyFloatArray
) -> None:
    """Fill the first pixels of `out` with slopes (k, side²), in their units, times numbers (k)."""
    first, slope = out.dtype.type(units[0] * by[0]), slopes[0]
    for j in range(size):
        out[j] = first * out.dtype.type(slope[j])
    for a in range(1, by.size):
        factor, slope = out.dtype.type(units[a] * by[a]), slopes[a]
        for j in range(size):
            out[j] += factor * out.dtype.type(slope[j])


@kernel(_nrt=False)
def find_clusters(squares: IntArray, starts: IntArray, owner: IntArray) -> None:
    """Find the rows that overlap by half their squares, directly or through others.

    Shapes: `squares` (rows, 4), `starts` (t + 1,), `owner` (rows,).
    """
    for t in range(starts.size - 1):
        for r in range(starts[t], starts[t + 1]):
            owner[r] = r
            r0, r1, c0, c1 = squares[r]
            for s in range(starts[t], r):
                s0, s1, d0, d1 = squares[s]
                far = abs(r0 + r1 - s0 - s1) >= max(r1 - r0, s1 - s0)
                if far or abs(c0 + c1 - d0 - d1) >= max(c1 - c0, d1 - d0):
                    continue
                mine, theirs = owner[r], owner[s]
                low, high = min(mine, theirs), max(mine, theirs)
                for q in range(starts[t], r + 1 if low < high else starts[t]):
                    if owner[q] == high:
                        owner[q] = low


@kernel()
def join_rows(
    slopes: Slopes, clusters: Clusters, light: Light, totals: SingleArray,
    information: FloatArray, first: int, last: int,
) -> None:  # fmt: skip
    """Factorise the information on the rows of some clusters, and let them respond to each other.

    Each row was fitted with the others at their positions then.  Rows that were fitted after it
    have changed by Δ since, so that its score is now -Σ F Δ; all rows of the cluster respond to it.

    Shapes: `totals` (t, y, x), `information` (rows, k, k).
    """
    _, k, area = slopes.values.shape
    block, work = np.empty((k, k)), np.empty((1 + 2 * k, area), np.float32)
    for c in range(first, last):
        rows = clusters.rows[clusters.edges[c] : clusters.edges[c + 1]]
        n, t = k * rows.size, clusters.frame[c]
        joint, other = np.zeros((n, n)), np.empty((n, n))
        order, scale, step = np.arange(n), np.empty(n), np.zeros(n)
        for a in range(rows.size):
            for i in range(k):
                for j in range(k):
                    joint[k * a + i, k * a + j] = information[rows[a], i, j]
            for b in range(a):
                if _overlap(slopes, light, t, totals[t], rows[a], rows[b], work, block):
                    for i in range(k):
                        for j in range(k):
                            joint[k * a + i, k * b + j] = block[i, j]
                            step[k * b + j] -= block[i, j] * slopes.moves[rows[a], i]
        for i in range(n):
            if not joint[i, i] > 0.0:  # the pixels do not depend on this parameter
                joint[i, i] = 1.0
            scale[i] = 1.0 / np.sqrt(joint[i, i])
        low = clusters.factors[clusters.corners[c] : clusters.corners[c + 1]].reshape(n, n)
        damped_steps, damping = rows.size > 1 and clusters.steps.size > 0, _LEAST_DAMPING
        for turn in range(2 if damped_steps else 1):
            out = low if turn == 0 else other
            damping = max(damping, _LEAST_DAMPING_LINKED if turn else _LEAST_DAMPING)
            while not factorise(joint, order, scale, damping, out) and damping < _LARGEST_DAMPING:
                damping *= 10.0
        if damped_steps:
            for i in range(n):
                step[i] *= scale[i]
            solve(other, step)
            for a in range(rows.size):
                for i in range(k):
                    clusters.steps[rows[a], i] = step[k * a + i] * scale[k * a + i]
        for i in range(n):
            for j in range(i + 1):
                low[i, j] /= scale[i]


@kernel(fastmath=FAST, _nrt=False)
def _overlap(
    slopes: Slopes, light: Light, t: int, total: SingleArray, r: int, s: int,
    work: SingleArray, out: FloatArray,
) -> bool:  # fmt: skip
    """Fill `out` (k, k) with the information that two rows share; tell whether they do.

    `work` (1 + 2 k, side²) is room.
    """
    r0, r1, c0, c1 = slopes.squares[r]
    s0, s1, d0, d1 = slopes.squares[s]
    top, bottom, left, right = max(r0, s0), min(r1, s1), max(c0, d0), min(c1, d1)
    if top >= bottom or left >= right:
        return False
    k, nx = out.shape[0], right - left
    size, power = (bottom - top) * nx, light.power[t]
    for i in range(top, bottom):
        weight = work[0, (i - top) * nx : (i - top + 1) * nx]
        background, read = light.background[i, left:right], light.read[i, left:right]
        others = total[i, left:right]
        for j in range(nx):
            variance = power * background[j] * (1.0 + others[j]) + read[j]
            weight[j] = 1.0 / variance if variance > 0.0 else 0.0
    for a in range(k):
        _copy_part(slopes, r, a, c1 - c0, top - r0, left - c0, nx, size, work[1 + a])
        _copy_part(slopes, s, a, d1 - d0, top - s0, left - d0, nx, size, work[1 + k + a])
        mine = work[1 + a]
        for j in range(size):
            mine[j] *= work[0, j]
    for a in range(k):
        for b in range(k):
            out[a, b] = product(work[1 + a], work[1 + k + b], size)
    return True


@kernel(fastmath=FAST, _nrt=False)
def _copy_part(
    slopes: Slopes, row: int, k: int, width: int, top: int, left: int, nx: int, size: int,
    out: SingleArray,
) -> None:  # fmt: skip
    """Fill `out` with a part of a slope: lines of nx pixels from a square of some width."""
    slope, unit = slopes.values[row, k], np.float32(slopes.units[row, k])
    for i in range(size // nx):
        line, there = out[i * nx : (i + 1) * nx], slope[(top + i) * width + left :]
        for j in range(nx):
            line[j] = unit * np.float32(there[j])


@kernel(fastmath=FAST)
def follow_rows(
    slopes: Slopes, clusters: Clusters, first: int, last: int, move: FloatArray,
    steps: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Give the response of the rows of some clusters to a change of ln(background).

    Shapes: `move` (y, x), `steps` (rows, k), `out` (y, x).
    """
    _, k, area = slopes.values.shape
    seen = np.empty(area, np.float32)
    for c in range(first, last):
        rows = clusters.rows[clusters.edges[c] : clusters.edges[c + 1]]
        n = k * rows.size
        step = np.empty(n)
        for q in range(rows.size):
            r = rows[q]
            size = gather(move, slopes.squares[r], seen)
            for a in range(k):
                step[k * q + a] = slopes.units[r, a] * product(slopes.values[r, a], seen, size)
        low = clusters.factors[clusters.corners[c] : clusters.corners[c + 1]].reshape(n, n)
        solve(low, step)
        for q in range(rows.size):
            r = rows[q]
            here, square = steps[r], slopes.squares[r]
            copy_line(step[k * q : k * (q + 1)], here)
            if out.size:
                size = (square[1] - square[0]) * (square[3] - square[2])
                mix(slopes.values[r], slopes.units[r], here, size, seen)
                put(seen, square, out)


@kernel(fastmath=FAST)
def own_shares(slopes: Slopes, rows: IntArray, squares: IntArray, weight: FloatArray) -> FloatArray:
    """Give Gᵀ diag(weight) G of each row: the information that the background takes from it.

    Shapes: `rows` (n,), `squares` (n, 4), `weight` (y, x), result (n, k, k).
    """
    _, k, area = slopes.values.shape
    out, work, weighted = np.empty((rows.size, k, k)), np.empty(area), np.empty(area)
    for q in range(rows.size):
        values, units = slopes.values[rows[q]], slopes.units[rows[q]]
        size = gather(weight, squares[q], work)
        for a in range(k):
            slope, unit = values[a], units[a]
            for j in range(size):
                weighted[j] = unit * work[j] * slope[j]
            for b in range(a + 1):
                out[q, a, b] = out[q, b, a] = units[b] * product(values[b], weighted, size)
    return out


@kernel(fastmath=FAST)
def send(
    slopes: Slopes, rows: IntArray, squares: IntArray, by: FloatArray, out: FloatArray
) -> None:
    """Add G times numbers of the rows to images.

    Shapes: `by` (n, b, k), `out` (b, y, x).
    """
    work = np.empty(slopes.values.shape[2])
    for q in range(rows.size):
        values, units, square = slopes.values[rows[q]], slopes.units[rows[q]], squares[q]
        size = (square[1] - square[0]) * (square[3] - square[2])
        for v in range(by.shape[1]):
            mix(values, units, by[q, v], size, work)
            put(work, square, out[v])


@kernel(fastmath=FAST)
def follow(
    slopes: Slopes, rows: IntArray, squares: IntArray, covariance: FloatArray, images: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Give Gᵀ times images for each row, and the sum of G F⁻¹ Gᵀ times these images.

    Shapes: `covariance` (n, k, k), `images` (b, y, x), results (n, b, k), (b, y, x).
    """
    _, k, area = slopes.values.shape
    projections, out = np.empty((rows.size, images.shape[0], k)), np.zeros(images.shape)
    work, by = np.empty(area), np.empty(k)
    for q in range(rows.size):
        values, units, square = slopes.values[rows[q]], slopes.units[rows[q]], squares[q]
        for v in range(images.shape[0]):
            size = gather(images[v], square, work)
            for a in range(k):
                projections[q, v, a] = units[a] * product(values[a], work, size)
            for a in range(k):
                by[a] = 0.0
                for b in range(k):
                    by[a] += covariance[q, a, b] * projections[q, v, b]
            mix(values, units, by, size, work)
            put(work, square, out[v])
    return projections, out
