"""Sums over frames, peaks of a sliding statistic, and the frames around a step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import BoolArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.loops import whole

MapArray = NDArray[np.float32]


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
