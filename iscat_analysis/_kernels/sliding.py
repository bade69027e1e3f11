"""Sums over frames and peaks of a sliding statistic, in one pass over the counts without copies."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
MapArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@kernel()
def block_sums(
    counts: NDArray[Any],
    corner: tuple[int, int],
    good: BoolArray,
    total: NDArray[Any],
    sums: NDArray[Any],
    highest: NDArray[Any],
) -> None:
    """Add frames to the sums of a box of pixels, and find its highest counts where they are wanted.

    Shapes: `counts` (t, all y, all x), `good` (t,), `total` (x,), `sums` (y, x), `highest` (y, x)
    or (0, 0).
    """
    frames = counts.shape[0]
    rows, columns = sums.shape
    top, left = corner
    for i in range(rows):
        for j in range(columns):
            total[j] = 0
        for t in range(frames):
            if not good[t]:
                continue
            row = counts[t, top + i, left : left + columns]
            if highest.size:
                for j in range(columns):
                    total[j] += row[j]
                    highest[i, j] = max(highest[i, j], row[j])
            else:
                for j in range(columns):
                    total[j] += row[j]
        for j in range(columns):
            sums[i, j] += total[j]


@kernel()
def frame_totals(counts: NDArray[Any], zero: Any, out: NDArray[Any], same: BoolArray) -> None:
    """Sum every frame, and tell whether it repeats the one before it.

    Shapes: `counts` (t, y, x), `out` (t,), `same` (t,).
    """
    frames, rows, columns = counts.shape
    for t in range(frames):
        total = zero
        for i in range(rows):
            for j in range(columns):
                total += counts[t, i, j]
        out[t] = total
        same[t] = False
        if t > 0 and out[t - 1] == total:
            same[t] = True
            for i in range(rows):
                for j in range(columns):
                    if counts[t, i, j] != counts[t - 1, i, j]:
                        same[t] = False
                        break
                if not same[t]:
                    break


@kernel()
def region_sum(counts: NDArray[Any], good: BoolArray, out: FloatArray) -> None:
    """Add the good frames to `out`.

    Shapes: `counts` (t, n), `good` (t,), `out` (n,).
    """
    for t in range(counts.shape[0]):
        if good[t]:
            for i in range(out.size):
                out[i] += counts[t, i]


@kernel(fastmath={"reassoc", "nsz"})
def _add_rows(images: MapArray, i: int, out: MapArray) -> None:
    """Add row i of every image.

    Shapes: `images` (k, y, x), `out` (x,).
    """
    for k in range(images.shape[0]):
        for j in range(out.size):
            out[j] += images[k, i, j]


@kernel(fastmath={"reassoc", "nsz"})
def contrast_map(earlier: MapArray, later: MapArray, weight: MapArray, out: MapArray) -> float:
    """Weighted contrast of two sums over the field, minus its weighted mean.

    Shapes: `earlier, later` (k, y, x), `weight` (y, x), `out` (y, x).
    """
    rows, columns = weight.shape
    before = np.zeros((rows, columns), dtype=np.float32)
    after = np.zeros((rows, columns), dtype=np.float32)
    total_before = 0.0
    total_after = 0.0
    for i in range(rows):
        _add_rows(earlier, i, before[i])
        _add_rows(later, i, after[i])
        for j in range(columns):
            total_before += before[i, j] if weight[i, j] > 0 else 0.0
            total_after += after[i, j] if weight[i, j] > 0 else 0.0
    ratio = total_after / total_before
    for i in range(rows):
        for j in range(columns):
            if weight[i, j] > 0:
                out[i, j] = weight[i, j] * (after[i, j] / (ratio * before[i, j]) - 1.0)
            else:
                out[i, j] = 0.0
    return ratio


@kernel(fastmath={"reassoc", "nsz"})
def step_energy(
    earlier: MapArray,
    later: MapArray,
    moved: MapArray,
    used: BoolArray,
    read_e2: FloatArray,
    power_ratio: float,
    side: int,
    excess: MapArray,
    share: MapArray,
) -> None:
    """Squared change over its variance, less one, and share of used pixels, in squares of pixels.

    `moved` is the contrast that motion makes, of shape (0, 0) where there is none; `read_e2` is the
    read noise of the change.

    Shapes: `earlier, later` (k, y, x), `moved, used, read_e2` (y, x), `excess, share` (y/n, x/n).
    """
    rows, columns = used.shape
    before = np.zeros((rows, columns), dtype=np.float32)
    after = np.zeros((rows, columns), dtype=np.float32)
    total_before = 0.0
    total_after = 0.0
    for i in range(rows):
        _add_rows(earlier, i, before[i])
        _add_rows(later, i, after[i])
        for j in range(columns):
            lit = used[i, j] and before[i, j] > 0 and after[i, j] > 0
            before[i, j] = before[i, j] if lit else 0.0
            after[i, j] = after[i, j] if lit else 0.0
        if moved.size:
            for j in range(columns):
                before[i, j] *= 1 + moved[i, j]
        for j in range(columns):
            total_before += before[i, j]
            total_after += after[i, j]
    level = np.float32(total_after / total_before)
    squared = np.float32(power_ratio**2)
    sums = np.empty(columns, dtype=np.float32)
    seen = np.empty(columns, dtype=np.float32)
    for cell in range(excess.shape[0]):
        sums[:] = 0.0
        seen[:] = 0.0
        last = min((cell + 1) * side, rows)
        for i in range(cell * side, last):
            for j in range(columns):
                lit = np.float32(1.0 if before[i, j] > 0 else 0.0)
                change = after[i, j] - level * before[i, j]
                variance = after[i, j] + squared * before[i, j] + np.float32(read_e2[i, j])
                sums[j] += lit * (change * change / max(variance, np.float32(1e-30)) - lit)
                seen[j] += lit
        for m in range(excess.shape[1]):
            end = min((m + 1) * side, columns)
            pixels = np.float32((last - cell * side) * (end - m * side))
            excess[cell, m] = sums[m * side : end].sum() / pixels
            share[cell, m] = seen[m * side : end].sum() / pixels


@kernel()
def strongest_maps(maps: MapArray, index: NDArray[np.int64]) -> None:
    """Find the map of a stack that is farthest from 0, at each pixel.

    Shapes: `maps` (k, y, x), `index` (y, x).
    """
    depth, rows, columns = maps.shape
    highest = np.empty(columns, dtype=np.float32)
    for i in range(rows):
        for j in range(columns):
            highest[j] = abs(maps[0, i, j])
            index[i, j] = 0
        for k in range(1, depth):
            for j in range(columns):
                height = abs(maps[k, i, j])
                if height > highest[j]:
                    highest[j] = height
                    index[i, j] = k


@kernel()
def step_peaks(maps: MapArray, threshold: float) -> NDArray[np.int64]:
    """Local extremes of a stack of maps.

    Shapes: `maps` (k, y, x), result (n, 3).
    """
    found = []
    depth, rows, columns = maps.shape
    for k in range(depth):
        for i in range(rows):
            above = False  # most rows have no pixel above; vector registers find this fast
            for j in range(columns):
                above |= abs(maps[k, i, j]) > threshold
            if not above:
                continue
            for j in range(columns):
                value = maps[k, i, j]
                if abs(value) <= threshold:
                    continue
                sign = 1.0 if value > 0 else -1.0
                top = sign * value
                highest = True
                for kk in range(max(k - 1, 0), min(k + 2, depth)):
                    for ii in range(max(i - 1, 0), min(i + 2, rows)):
                        for jj in range(max(j - 1, 0), min(j + 2, columns)):
                            if sign * maps[kk, ii, jj] > top:
                                highest = False
                if highest:
                    found.append((k, i, j))
    out = np.empty((len(found), 3), dtype=np.int64)
    for n in range(len(found)):
        out[n, 0], out[n, 1], out[n, 2] = found[n]
    return out


@kernel()
def near_earlier_peaks(
    peaks: FloatArray,
    frames: tuple[int, int],
    distances: tuple[float, float, float],
    shares: tuple[float, float],
) -> BoolArray:
    """Tell which peaks may be lobes of an earlier one, or the same step.

    Shapes: `peaks` (n, 4), result (n,).
    """
    is_lobe = np.zeros(len(peaks), dtype=np.bool_)
    for own in range(len(peaks)):
        for higher in range(own):
            apart = abs(peaks[own, 0] - peaks[higher, 0])
            if apart > frames[1]:
                continue
            dx = abs(peaks[own, 1] - peaks[higher, 1])
            dy = abs(peaks[own, 2] - peaks[higher, 2])
            away = max(dx, dy)
            share = shares[0] if away < distances[1] else shares[1]
            if (away < distances[2] and peaks[own, 3] < share * peaks[higher, 3]) or (
                apart < frames[0] and math.hypot(dx, dy) < distances[0]
            ):
                is_lobe[own] = True
                break
    return is_lobe
