"""Sums over frames, peaks of a sliding statistic, and the frames around a step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import BoolArray, FloatArray, IntArray, SingleArray, kernel
from iscat_analysis._kernels.loops import whole


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


def contrast_map(earlier: SingleArray, later: SingleArray, weight: SingleArray) -> SingleArray:
    """Weighted contrast of two sums over the field, minus its weighted mean.

    Shapes: `earlier, later` (k, y, x), `weight` (y, x), result (y, x).
    """
    before, after, used = earlier.sum(axis=0), later.sum(axis=0), weight > 0
    ratio = after[used].sum(dtype=np.float64) / before[used].sum(dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = np.divide(after, ratio * before, out=np.ones(weight.shape), where=used)
    return np.asarray(weight * (stretch - 1.0), dtype=np.float32)


@kernel()
def best_line(
    frames: IntArray,
    weight: FloatArray,
    heights: FloatArray,
    rise: int,
    centres: tuple[int, int, int],
    least: float,
) -> tuple[float, int]:
    """Find the linear rise that describes heights best, of those with some centres.

    Gives its log-likelihood over that of a constant and its centre; `least` and 0 where none has
    more.

    Shapes: `frames, weight, heights` (t,), `centres` first, one past the last, and step.
    """
    light, level = 0.0, 0.0
    for k in range(frames.size):
        light += weight[k]
        level += weight[k] * heights[k]
    found = 0
    for centre in range(*centres):
        new, squares, along = 0.0, 0.0, 0.0
        for k in range(frames.size):
            share = min(max((frames[k] + 0.5 - centre) / rise + 0.5, 0.0), 1.0)
            new += weight[k] * share
            squares += weight[k] * share * share
            along += weight[k] * share * heights[k]
        along -= new / light * level
        known = squares - new * new / light
        # of the sum of squares, that is left beside the mean and is not rounding
        if along > 0 and known > 1e-9 * squares:
            gain = 0.5 * along * along / known
            if gain > least:
                least, found = gain, centre
    return least, found


@kernel()
def ring_heights(
    snr: NDArray[Any], centre: tuple[float, float], place: tuple[float, float], ring: float,
    patch: float, others: FloatArray, highest: FloatArray,
) -> None:  # fmt: skip
    """Find the largest value of a map in each sector of a ring around a particle.

    Shapes: `snr` (y, x), `others` (n, 2), `highest` (sectors,).
    """
    x0, y0 = centre
    xc, yc = place
    rows, columns = snr.shape
    distance = max(math.hypot(xc - x0, yc - y0), ring)
    near2, far = (distance - ring) ** 2, distance + ring
    top, bottom = whole(y0 - far, 0, rows), whole(np.ceil(y0 + far) + 1, 0, rows)
    left, right = whole(x0 - far, 0, columns), whole(np.ceil(x0 + far) + 1, 0, columns)
    sectors = highest.size
    highest[:] = -1.0
    # nearer to the particle, a patch would cover a whole lobe of a residual
    twice = distance > 2 * patch
    peak, peak_y, peak_x = -1.0, 0, 0
    for passed in range(2 if twice else 1):
        judging = passed == 1 or not twice
        if judging and twice and peak < 0:
            return
        for i in range(top, bottom):
            for j in range(left, right):
                away2 = (i - y0) ** 2 + (j - x0) ** 2
                if not (near2 < away2 < far**2):
                    continue
                if (i - yc) ** 2 + (j - xc) ** 2 <= patch**2:
                    continue
                own = True
                for k in range(others.shape[0]):
                    if (i - others[k, 1]) ** 2 + (j - others[k, 0]) ** 2 <= away2:
                        own = False
                        break
                if not own:
                    continue
                value = abs(snr[i, j])
                if not judging:
                    if value > peak:
                        peak, peak_y, peak_x = value, i, j
                elif not twice or (i - peak_y) ** 2 + (j - peak_x) ** 2 > patch**2:
                    angle = math.atan2(i - y0, j - x0) / (2 * math.pi) + 0.5
                    sector = whole(angle * sectors, 0, sectors) % sectors
                    highest[sector] = max(highest[sector], value)
