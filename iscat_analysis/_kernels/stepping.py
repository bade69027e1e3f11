"""What is done with the frames of each step: sums of parts, neighbours, its frame, its repeats."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Ends = tuple[int, int, int, int]


@kernel()
def part_sums(counts: NDArray[Any], good: BoolArray, edges: IntArray, out: FloatArray) -> None:
    """Sum the good frames of contiguous parts.

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        Stored counts.
    good : ndarray of bool, shape (t,)
        Frames to take.
    edges : ndarray of int, shape (n + 1,)
        Where the parts begin and end.
    out : ndarray, shape (n, y, x)
        Filled.
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

    Parameters
    ----------
    total : ndarray, shape (y, x)
        Added to.
    corner : (int, int)
        Row and column of the image's first pixel, all of which lie in the field.
    image : ndarray, shape (ny, nx)
        Its values.
    scale : float
        The multiple.
    """
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            total[corner[0] + i, corner[1] + j] += scale * image[i, j]


@kernel()
def times_change(
    ratio: FloatArray, here: Ends, image: FloatArray, inside: Ends, before: float, after: float
) -> None:  # fmt: skip
    """Multiply a ratio with (1 + after·image)/(1 + before·image).

    Parameters
    ----------
    ratio : ndarray, shape (y, x)
        Changed where it shows the image.
    here, inside : (int, int, int, int)
        The same pixels of `ratio` and of `image`: first and last row, first and last column,
        half-open.
    image : ndarray, shape (ny, nx)
        A particle's contrast.
    before, after : float
        Share of the light before and after in which the particle is there.
    """
    for i in range(here[0], here[1]):
        for j in range(here[2], here[3]):
            value = image[i - here[0] + inside[0], j - here[2] + inside[2]]
            ratio[i, j] *= (1.0 + after * value) / (1.0 + before * value)


@kernel()
def one_change(
    heights: FloatArray, weight: FloatArray, jump: FloatArray, gain: FloatArray
) -> tuple[float, int]:
    """Compare what precedes each change of mean with what follows it.

    Parameters
    ----------
    heights : ndarray, shape (t,)
        A value for every frame.
    weight : ndarray, shape (t,)
        One over its variance; 0 leaves it out.
    jump : ndarray, shape (t − 1,)
        Filled with the mean after frame k less that up to it; 0 where one side has no weight.
    gain : ndarray, shape (t − 1,)
        Filled with the gain in log-likelihood of that change; NaN where one side has no weight.

    Returns
    -------
    float
        The largest gain.
    int
        Frames with weight.
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
def projector(
    mean: FloatArray, read: FloatArray, used: BoolArray, image: FloatArray, weights: FloatArray
) -> float:
    """Weights that measure the amplitude of an image and ignore a common level.

    Parameters
    ----------
    mean : ndarray, shape (y, x)
        Photoelectrons of a frame of unit power.
    read : ndarray, shape (y, x) or (1, 1)
        Read noise of one frame [e].
    used : ndarray of bool, shape (y, x)
        Pixels in use.
    image : ndarray, shape (y, x)
        Contrast.
    weights : ndarray, shape (y, x)
        Filled.

    Returns
    -------
    float
        Their answer to a frame of unit power that holds the image once.
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
    """Weigh some frames in several ways at once.

    Parameters
    ----------
    counts : ndarray, shape (t, p)
        Stored counts of p pixels.
    lit : ndarray of bool, shape (t,)
        Frames to take.
    weights : ndarray, shape (n, p)
        Of the pixels.
    out : ndarray, shape (n, m)
        Filled, one column for each frame that is taken.
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

    Parameters
    ----------
    values, power : ndarray, shape (t,)
        A value and the light of every frame.
    shot, read : float
        Variance of a value that is expected, per unit of power and per frame.
    start, stop : int
        Half-open range of frames.

    Returns
    -------
    float
        Their mean.
    float
        Its expected variance.
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
    """Add up how parts of the frames of one window differ, over what is expected.

    Parameters
    ----------
    values : ndarray, shape (n, t)
        Several values for every frame.
    power : ndarray, shape (t,)
        Its light.
    shot, read : ndarray, shape (n,)
        Variance of each value that is expected, per unit of power and per frame.
    edges : ndarray of int, shape (k + 1,)
        Contiguous parts, which are compared with their mean.
    lengths : ndarray of int, shape (m,)
        Frames in averages that are compared with their neighbours.
    out : ndarray, shape (1 + m, n + 1)
        Added to: squares over what is expected, and in the last column how many; the parts come
        first.
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
    """Find how high a map rises in each sector of a ring around a particle.

    Parameters
    ----------
    snr : ndarray, shape (y, x)
        The map.
    centre, place : (float, float)
        The particle, and what lies in the middle of the ring, (x, y) [pixels].
    ring : float
        From the middle of the ring to its edges [pixels].
    patch : float
        Nearer than this to `place`, and to the highest of what is left, pixels do not count.
    others : ndarray, shape (n, 2)
        (x, y) of places that take the pixels that are nearer to them than to the particle.
    highest : ndarray, shape (sectors,)
        Filled, for sectors of the same angle; −1 where one has no pixel.
    """
    x0, y0 = centre
    xc, yc = place
    rows, columns = snr.shape
    distance = max(math.hypot(xc - x0, yc - y0), ring)
    near2, far = (distance - ring) ** 2, distance + ring
    top, bottom = max(math.floor(y0 - far), 0), max(min(math.ceil(y0 + far) + 1, rows), 0)
    left, right = max(math.floor(x0 - far), 0), max(min(math.ceil(x0 + far) + 1, columns), 0)
    sectors = highest.size
    highest[:] = -1.0
    # closer in, a patch would cover a whole lobe of a misfit
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
                    sector = int(angle * sectors) % sectors
                    highest[sector] = max(highest[sector], value)
