"""Kernels for the frames of a step: sums of parts, neighbours, its frame, its measured spread."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.whole import whole

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Ends = tuple[int, int, int, int]

_LEAST_KNOWN = 1e-9  # of a sum of squares that is left beside a mean, and is not rounding


@kernel()
def part_sums(counts: NDArray[Any], good: BoolArray, edges: IntArray, out: FloatArray) -> None:
    """Sum the good frames of contiguous parts.

    Shapes: `counts` (t, y, x), `good` (t,), `edges` (n + 1,), `out` (n, y, x).
    """
    out[:] = 0.0
    for n in range(edges.size - 1):
        for t in range(edges[n], edges[n + 1]):
            if good[t]:
                for i in range(out.shape[1]):
                    for j in range(out.shape[2]):
                        out[n, i, j] += counts[t, i, j]


@kernel()
def add_image(total: FloatArray, corner: tuple[int, int], image: FloatArray, scale: float) -> None:
    """Add a multiple of an image to a field.

    Shapes: `total` (y, x), `image` (ny, nx).
    """
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            total[corner[0] + i, corner[1] + j] += scale * image[i, j]


@kernel()
def times_change(
    ratio: FloatArray, here: Ends, image: FloatArray, inside: Ends, before: float, after: float
) -> None:
    """Multiply a ratio by (1 + after·image)/(1 + before·image).

    Shapes: `ratio` (y, x), `image` (ny, nx).
    """
    for i in range(here[0], here[1]):
        for j in range(here[2], here[3]):
            value = image[i - here[0] + inside[0], j - here[2] + inside[2]]
            ratio[i, j] *= (1.0 + after * value) / (1.0 + before * value)


@kernel()
def one_change(
    heights: FloatArray, weight: FloatArray, jump: FloatArray, gain: FloatArray
) -> tuple[float, int]:
    """Compare the mean before each possible change with the mean after it.

    Shapes: `heights` (t,), `weight` (t,), `jump` (t − 1,), `gain` (t − 1,).
    """
    light, total, lit = 0.0, 0.0, 0
    for t in range(heights.size):
        if weight[t] > 0:
            light += weight[t]
            total += weight[t] * heights[t]
            lit += 1
    before, first, largest = 0.0, 0.0, 0.0
    for t in range(heights.size - 1):
        if weight[t] > 0:
            before += weight[t]
            first += weight[t] * heights[t]
        after = light - before
        if before > 0 and after > 0:
            jump[t] = (total - first) / after - first / before
            gain[t] = 0.5 * before * after / light * jump[t] ** 2
            largest = max(largest, gain[t])
        else:
            jump[t], gain[t] = 0.0, math.nan
    return largest, lit


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
        if along > 0 and known > _LEAST_KNOWN * squares:
            gain = 0.5 * along * along / known
            if gain > least:
                least, found = gain, centre
    return least, found


@kernel()
def projector(
    mean: FloatArray, read: FloatArray, used: BoolArray, image: FloatArray, weights: FloatArray
) -> float:
    """Weights that measure the amplitude of an image and ignore a common level.

    Shapes: `mean` (y, x), `read` (y, x) or (1, 1), `used` (y, x), `image` (y, x), `weights` (y,
    x).
    """
    rows, columns = image.shape
    even = read.size == 1
    light, level = 0.0, 0.0
    for i in range(rows):
        for j in range(columns):
            weights[i, j] = 0.0
            if used[i, j]:
                noise = read[0, 0] if even else read[i, j]
                weights[i, j] = mean[i, j] / (mean[i, j] + noise * noise)
                light += mean[i, j] * weights[i, j]
                level += mean[i, j] * weights[i, j] * image[i, j]
    level /= max(light, 1e-300)
    scale = 0.0
    for i in range(rows):
        for j in range(columns):
            if used[i, j]:
                weights[i, j] *= image[i, j] - level
                scale += weights[i, j] * mean[i, j] * image[i, j]
    return max(scale, 1e-300)


@kernel(fastmath=True)
def frame_scores(
    counts: NDArray[Any], lit: BoolArray, weights: FloatArray, out: FloatArray
) -> None:
    """Sum frames with several sets of weights at once.

    Shapes: `counts` (t, p), `lit` (t,), `weights` (n, p), `out` (n, m).
    """
    m = 0
    for t in range(counts.shape[0]):
        if not lit[t]:
            continue
        for n in range(weights.shape[0]):
            total = 0.0
            for i in range(weights.shape[1]):
                total += weights[n, i] * counts[t, i]
            out[n, m] = total
        m += 1


@kernel()
def mean_of(
    values: FloatArray, power: FloatArray, shot: float, read: float, start: int, stop: int
) -> tuple[float, float]:
    """Average contiguous frames per unit of power.

    Shapes: `values, power` (t,).
    """
    total, light = 0.0, 0.0
    for t in range(start, stop):
        total += values[t]
        light += power[t]
    return total / light, (shot * light + read * (stop - start)) / light**2


@kernel()
def spreads(
    values: FloatArray, power: FloatArray, shot: FloatArray, read: FloatArray, edges: IntArray,
    lengths: IntArray, out: FloatArray,
) -> None:  # fmt: skip
    """Sum the squared differences between parts of a window's frames, over their expectation.

    Shapes: `values` (n, t), `power` (t,), `shot, read` (n,), `edges` (k + 1,), `lengths` (m,),
    `out` (1 + m, n + 1).
    """
    frames, parts = power.size, edges.size - 1
    last = values.shape[0]
    if parts > 1:
        means, weights = np.empty(parts), np.empty(parts)
        for n in range(last):
            total, weight = 0.0, 0.0
            for k in range(parts):
                mean, variance = mean_of(values[n], power, shot[n], read[n], edges[k], edges[k + 1])
                means[k], weights[k] = mean, 1 / variance
                total += mean * weights[k]
                weight += weights[k]
            for k in range(parts):
                out[0, n] += weights[k] * (means[k] - total / weight) ** 2
        out[0, last] += parts - 1
    for m in range(lengths.size):
        length = lengths[m]
        pairs = frames // (2 * length)
        for n in range(last):
            for k in range(pairs):
                start = 2 * k * length
                one, of_one = mean_of(values[n], power, shot[n], read[n], start, start + length)
                two, of_two = mean_of(
                    values[n], power, shot[n], read[n], start + length, start + 2 * length
                )
                out[1 + m, n] += (two - one) ** 2 / (of_one + of_two)
        out[1 + m, last] += pairs


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
