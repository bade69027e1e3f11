"""Log-likelihood, score and Fisher matrix in one pass over the pixels, and the fit that uses them.

Parameters and data are those of `iscat_analysis._kernels.noise`, which contains the differences of
the noise models; `kind` is the number of a noise model.

@@@Profile log-likelihood along z.

At one position and height the signal is a P + a² Q.  The two images are computed once for each
height, and the amplitude is fitted with them.

@@@The domain of a model: heights of its tables, and pixels within its reach.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from iscat_analysis._kernels import FAST, BoolArray, FloatArray, kernel
from iscat_analysis._kernels.image import signal_gradient, signal_image, signal_parts
from iscat_analysis._kernels.lattice import TAPS, lattice_span
from iscat_analysis._kernels.lens import LATTICE, ROUND, STAMP, Lens, Pixels, named_lens
from iscat_analysis._kernels.loops import factorise, solve
from iscat_analysis._kernels.noise import score_of_pixel, value_of_pixels
from iscat_analysis._kernels.radial import POWERS, AxialTable, profile_at
from iscat_analysis._kernels.radial_rows import intervals_needed, radial_strip, strip_scratch
from iscat_analysis._kernels.stamp import STRIP, begin_stamp, stamp_strip

CONVERGED, STALLED, EXHAUSTED, ABANDONED = 0, 1, 2, 3
"""Outcome of a fit: step below tolerance; no step improves; iterations used up; little to gain."""

LARGEST_GAIN_RATIO = 16.0
"""Largest gain in log-likelihood that a fit may still make, over the expected gain."""

_TOGETHER = 256
"""Pixels in one block: the slow logarithm is computed only for blocks with bright pixels."""


@kernel()
def signal_value(kind: int, data: FloatArray, level: float, s: FloatArray) -> float:
    """Log-likelihood of signals s (ny·nx,), relative to that without a particle."""
    flat, total = data.reshape(4, s.size), 0.0
    for first in range(0, s.size, _TOGETHER):
        last = min(first + _TOGETHER, s.size)
        total += value_of_pixels(kind, flat, first, last, level, s[first:last])
    return total


@kernel(fastmath=FAST, _nrt=False)
def _add_score(
    kind: int, data: FloatArray, first: int, last: int, level: float, g: FloatArray,
    sums: FloatArray,
) -> None:  # fmt: skip
    """Add some pixels of data (4, n) to the 5 scores and 15 Fisher entries in `sums`.

    g (5, last − first or more) holds their signals and the gradient.
    """
    c0, c1 = data[0, first:last], data[1, first:last]
    c2, c3 = data[2, first:last], data[3, first:last]
    b0 = b1 = b2 = b3 = b4 = 0.0
    f00 = f01 = f02 = f03 = f04 = 0.0
    f11 = f12 = f13 = f14 = 0.0
    f22 = f23 = f24 = 0.0
    f33 = f34 = f44 = 0.0
    for j in range(c0.size):
        pull, bend, g4 = score_of_pixel(kind, c0[j], c1[j], c2[j], c3[j], level, g[0, j])
        g0, g1, g2, g3 = g[1, j], g[2, j], g[3, j], g[4, j]
        b0 += pull * g0
        b1 += pull * g1
        b2 += pull * g2
        b3 += pull * g3
        b4 += pull * g4
        h0, h1, h2, h3, h4 = bend * g0, bend * g1, bend * g2, bend * g3, bend * g4
        f00 += h0 * g0
        f01 += h0 * g1
        f02 += h0 * g2
        f03 += h0 * g3
        f04 += h0 * g4
        f11 += h1 * g1
        f12 += h1 * g2
        f13 += h1 * g3
        f14 += h1 * g4
        f22 += h2 * g2
        f23 += h2 * g3
        f24 += h2 * g4
        f33 += h3 * g3
        f34 += h3 * g4
        f44 += h4 * g4
    sums[0] += b0
    sums[1] += b1
    sums[2] += b2
    sums[3] += b3
    sums[4] += b4
    sums[5] += f00
    sums[6] += f01
    sums[7] += f02
    sums[8] += f03
    sums[9] += f04
    sums[10] += f11
    sums[11] += f12
    sums[12] += f13
    sums[13] += f14
    sums[14] += f22
    sums[15] += f23
    sums[16] += f24
    sums[17] += f33
    sums[18] += f34
    sums[19] += f44


@kernel()
def image_value(kind: int, data: FloatArray, level: float, rows: FloatArray) -> float:
    """Log-likelihood of an image; `rows` (ny, 5 or more, nx) holds s and its gradient."""
    ny, nx = rows.shape[0], rows.shape[2]
    flat, total, together = data.reshape(4, ny * nx), 0.0, max(_TOGETHER // nx, 1)
    s = np.empty(together * nx)
    for first in range(0, ny, together):
        last = min(first + together, ny)
        for i in range(first, last):
            for j in range(nx):
                s[(i - first) * nx + j] = rows[i, 0, j]
        total += value_of_pixels(kind, flat, first * nx, last * nx, level, s)
    return total


@kernel()
def image_score(
    kind: int, data: FloatArray, level: float, rows: FloatArray, score: FloatArray,
    fisher: FloatArray,
) -> None:  # fmt: skip
    """Fill score (5) and Fisher matrix (5, 5) of an image; `rows` as in `image_value`."""
    ny, nx = rows.shape[0], rows.shape[2]
    flat, sums = data.reshape(4, ny * nx), np.zeros(20)
    for row in range(ny):
        _add_score(kind, flat, row * nx, (row + 1) * nx, level, rows[row], sums)
    _unpack(sums, score, fisher)


@kernel()
def _unpack(sums: FloatArray, score: FloatArray, fisher: FloatArray) -> None:
    """Fill score and Fisher matrix from the sums of `_add_score`."""
    k = 5
    for i in range(5):
        score[i] = sums[i]
        for j in range(i, 5):
            fisher[i, j] = fisher[j, i] = sums[k]
            k += 1


@kernel()
def score_pass(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    kind: int,
    data: FloatArray,
    theta: FloatArray,
    score: FloatArray,
    fisher: FloatArray,
) -> float:
    """Fill score (5) and Fisher matrix (5, 5) at θ and return the log-likelihood."""
    level = np.exp(theta[4])
    ny, nx = pixels.y.size, pixels.x.size
    if len(lens) == ROUND:  # strip by strip, while the strip is in the first cache
        flat, sums, total = data.reshape(4, ny * nx), np.zeros(20), 0.0
        together, f = strip_scratch(pixels)
        for row in range(0, ny, together):
            end = min(row + together, ny)
            here = radial_strip(profile, lens, pixels, row, end, theta[0], theta[1], theta[3], 5, f)
            _add_score(kind, flat, row * nx, end * nx, level, here, sums)
            total += value_of_pixels(kind, flat, row * nx, end * nx, level, here[0])
        _unpack(sums, score, fisher)
        return total
    if len(lens) == STAMP:
        flat, sums, total = data.reshape(4, ny * nx), np.zeros(20), 0.0
        scratch = begin_stamp(profile, lens, pixels, theta[0], theta[1], theta[3])
        at, lines = np.empty(TAPS, dtype=np.int64), np.zeros((5, STRIP * nx))
        for row in range(0, ny, STRIP):
            end = min(row + STRIP, ny)
            stamp_strip(profile, lens, theta[3], row, end - row, nx, at, scratch, lines)
            _add_score(kind, flat, row * nx, end * nx, level, lines, sums)
            total += value_of_pixels(kind, flat, row * nx, end * nx, level, lines[0])
        _unpack(sums, score, fisher)
        return total
    g = np.empty((ny, 5, nx))
    signal_gradient(profile, lens, pixels, theta[0], theta[1], theta[3], g)
    image_score(kind, data, level, g, score, fisher)
    value: float = image_value(kind, data, level, g)
    return value


@kernel()
def value_pass(
    profile: FloatArray, lens: Lens, pixels: Pixels, kind: int, data: FloatArray, theta: FloatArray
) -> float:
    """Log-likelihood at θ, without derivatives."""
    level = np.exp(theta[4])
    s = np.empty((pixels.y.size, pixels.x.size))
    signal_image(profile, lens, pixels, theta[0], theta[1], theta[3], s)
    value: float = signal_value(kind, data, level, s.reshape(s.size))
    return value


@kernel(_nrt=False)
def span(lens: Lens, pixels: Pixels, theta: FloatArray, width: int) -> tuple[int, int]:
    """Range of the flattened profile, `width` long, that an image needs."""
    zero = int(np.int64(0))  # a literal 0 has its own type, for which callers are compiled again
    if len(lens) == STAMP:
        return zero, width
    if len(lens) == LATTICE:
        first, last = lattice_span(lens, pixels.x, abs(pixels.offsets[-1]), theta[0])
        return first, last
    return zero, POWERS * intervals_needed(lens, pixels, theta[0], theta[1], width // POWERS)


@kernel()
def blank_profile(axial: AxialTable, lens: Lens, orders: int) -> FloatArray:
    """Profile for `picture_at` to fill."""
    channels, width = axial.heights.shape[2:]
    if len(lens) == STAMP:
        return np.empty((0, 0, 0))
    if len(lens) == LATTICE:
        nodes = 2 * lens.half + 1
        return np.empty((orders * channels, nodes, nodes))
    return np.empty((width // POWERS, POWERS, orders * channels))


@kernel()
def picture_at(
    axial: AxialTable, lens: Lens, z_nm: float, start: int, stop: int, profile: FloatArray
) -> FloatArray:
    """Profile at a height, filled over a range; a stamp has only one, in its table."""
    if len(lens) == STAMP:
        rows = 2 * lens.half + 1
        only: FloatArray = axial.heights[0, 0].reshape(2, rows, axial.heights.shape[3] // rows)
        return only
    profile_at(axial, z_nm, start, stop, profile)
    return profile


@kernel()
def value_batch(
    axial: AxialTable,
    lens: Lens,
    pixels: Pixels,
    kind: int,
    data: FloatArray,
    thetas: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (n) with the log-likelihood at θ (n, 5); equal z share a profile."""
    profile = blank_profile(axial, lens, 1)
    width = axial.heights.shape[3]
    z, first, last = np.nan, 0, 0
    for k in range(thetas.shape[0]):
        start, stop = span(lens, pixels, thetas[k], width)
        if thetas[k, 2] != z or start < first or stop > last:
            if thetas[k, 2] == z:
                start, stop = min(start, first), max(stop, last)
            z, first, last = thetas[k, 2], start, stop
            profile = picture_at(axial, lens, z, first, last, profile)
        out[k] = value_pass(profile, lens, pixels, kind, data, thetas[k])


@kernel()
def scoring_step(
    score: FloatArray, fisher: FloatArray, active: BoolArray, damping: float, step: FloatArray
) -> bool:
    """Solve (F + damping·diag F) step = score on the active parameters; False if singular."""
    n = 0
    index = np.empty(5, dtype=np.int64)
    for i in range(5):
        step[i] = 0.0
        if active[i]:
            if not fisher[i, i] > 0.0:
                return False
            index[n] = i
            n += 1
    scale = np.empty(n)
    for i in range(n):
        scale[i] = 1.0 / np.sqrt(fisher[index[i], index[i]])
    lower = np.empty((n, n))
    if not factorise(fisher, index[:n], scale, damping, lower):
        return False
    z = np.empty(n)
    for i in range(n):
        z[i] = score[index[i]] * scale[i]
    solve(lower, z)
    for i in range(n):
        step[index[i]] = z[i] * scale[i]
    return True


@kernel(_nrt=False)
def add_prior(
    prior: tuple[float, float], theta: FloatArray, score: FloatArray, fisher: FloatArray
) -> float:
    """Add a normal prior of z to score (5) and Fisher matrix (5, 5); return its logarithm."""
    mean, information = prior
    away = theta[2] - mean
    score[2] -= information * away
    fisher[2, 2] += information
    density: float = -0.5 * information * away * away
    return density


@kernel()
def maximize(
    table: tuple[Any, ...],
    optics: tuple[Any, ...],
    grid: tuple[Any, ...],
    kind: int,
    data: FloatArray,
    free: BoolArray,
    lower: FloatArray,
    upper: FloatArray,
    max_step: FloatArray,
    tolerance: float,
    iterations: int,
    theta: FloatArray,
    fisher: FloatArray,
    least: float,
    prior: tuple[float, float],
) -> tuple[float, int, int]:
    """Damped Fisher scoring inside a box, from θ, which is overwritten with the estimate.

    `prior` has mean and information of a normal prior of z; zero information means no prior.

    Shapes: `data` (4, ny, nx), `free` (5,), `lower, upper, max_step` (5,), `theta` (5,), `fisher`
    (5, 5).
    """
    axial, lens, pixels = AxialTable(*table), named_lens(optics), Pixels(*grid)
    profile = blank_profile(axial, lens, 2)
    width = axial.heights.shape[3]
    step, trial, score = np.empty(5), np.empty(5), np.empty(5)
    trial_score, trial_fisher = np.empty(5), np.empty((5, 5))
    active = np.empty(5, dtype=np.bool_)
    damping = 0.0
    start, stop = (0, width) if not free[2] else span(lens, pixels, theta, width)
    profile = picture_at(axial, lens, theta[2], start, stop, profile)
    value = score_pass(profile, lens, pixels, kind, data, theta, score, fisher)
    value += add_prior(prior, theta, score, fisher)
    passes = 1
    while passes < iterations:
        for i in range(5):
            blocked = (theta[i] <= lower[i] and score[i] < 0) or (
                theta[i] >= upper[i] and score[i] > 0
            )
            active[i] = free[i] and not blocked
        if not scoring_step(score, fisher, active, damping, step):
            if damping > 1e6:
                return value, passes, STALLED
            damping = max(10 * damping, 1e-3)
            continue
        largest_gain = 0.0
        for i in range(5):
            largest_gain += 0.5 * LARGEST_GAIN_RATIO * score[i] * step[i]
        shrink = 1.0
        for i in range(5):
            if active[i] and abs(step[i]) * shrink > max_step[i]:
                shrink = max_step[i] / abs(step[i])
        gain = 0.0
        for i in range(5):
            trial[i] = min(max(theta[i] + shrink * step[i], lower[i]), upper[i])
            gain += 0.5 * score[i] * (trial[i] - theta[i])
        if not np.isfinite(gain):  # an overflow: a NaN position must not become an index
            return value, passes, STALLED
        if damping == 0.0 and gain < tolerance:
            for i in range(5):
                theta[i] = trial[i]
            return value + gain, passes, CONVERGED
        if damping == 0.0 and value + largest_gain < least:
            for i in range(5):
                theta[i] = trial[i]
            return value + gain, passes, ABANDONED
        if free[2]:
            start, stop = span(lens, pixels, trial, width)
            profile_at(axial, trial[2], start, stop, profile)
        trial_value = score_pass(
            profile, lens, pixels, kind, data, trial, trial_score, trial_fisher
        )
        trial_value += add_prior(prior, trial, trial_score, trial_fisher)
        passes += 1
        if trial_value >= value - 1e-3 * tolerance - 1e-13 * abs(value):
            value = trial_value
            for i in range(5):  # a slice assignment would also compile its error message
                theta[i], score[i] = trial[i], trial_score[i]
                for j in range(5):
                    fisher[i, j] = trial_fisher[i, j]
            damping = 0.0 if damping < 1e-2 else 0.1 * damping
        else:
            if damping > 1e6:
                return value, passes, STALLED
            damping = max(10 * damping, 1e-3)
    return value, passes, EXHAUSTED


@kernel()
def scan_heights(
    table: tuple[Any, ...],
    optics: tuple[Any, ...],
    grid: tuple[Any, ...],
    kind: int,
    data: FloatArray,
    heights: FloatArray,
    amplitude_range: tuple[float, float],
    theta: FloatArray,
    values: FloatArray,
    amplitudes: FloatArray,
) -> None:
    """Profile log-likelihood along z at fixed (x, y): the amplitude takes two scoring steps.

    Fills `values` and `amplitudes`, shape (n,), for `heights`; θ gives the other parameters and the
    start.  An empty amplitude range holds the amplitude fixed.  The first three arguments are those
    of `maximize`.
    """
    axial, lens, pixels = AxialTable(*table), named_lens(optics), Pixels(*grid)
    profile = blank_profile(axial, lens, 1)
    here, size = theta.copy(), pixels.y.size * pixels.x.size
    flat, parts, s = data.reshape(4, size), np.empty((2, size)), np.empty(size)
    p, q = parts[0], parts[1]
    low, high = amplitude_range
    unit, level = theta[3] if theta[3] != 0.0 else 1.0, np.exp(theta[4])
    for k in range(heights.size):
        here[2] = heights[k]
        start, stop = span(lens, pixels, here, axial.heights.shape[3])
        profile_at(axial, here[2], start, stop, profile)
        signal_parts(profile, lens, pixels, theta[0], theta[1], unit, parts)
        a = theta[3]
        for _ in range(2 if low < high else 0):
            pull, known = _amplitude(kind, flat, level, a, p, q)
            if known > 0:
                a = min(max(a + pull / known, low), high)
        for j in range(s.size):
            s[j] = a * (p[j] + a * q[j])
        values[k] = signal_value(kind, data, level, s)
        amplitudes[k] = a


@kernel(fastmath=FAST)
def _amplitude(
    kind: int, data: FloatArray, level: float, a: float, p: FloatArray, q: FloatArray
) -> tuple[float, float]:
    """Score about the amplitude, and its information; data has shape (4, n)."""
    pull = known = 0.0
    for j in range(p.size):
        s, slope = a * (p[j] + a * q[j]), p[j] + 2 * a * q[j]
        score, bend, _ = score_of_pixel(
            kind, data[0, j], data[1, j], data[2, j], data[3, j], level, s
        )
        pull += score * slope
        known += bend * slope * slope
    return pull, known


SLACK_NM = 1e-6
"""Tolerance for the rounding of coordinates at the edge of the support."""


@kernel()
def supported(
    thetas: FloatArray,
    x: FloatArray,
    y: FloatArray,
    half_pixel: float,
    reach: float,
    low: float,
    high: float,
    largest_level: float,
) -> BoolArray:
    """Tell for which θ (n, 5) all pixels are within reach, z is in the table and all is finite."""
    inside = np.empty(thetas.shape[0], dtype=np.bool_)
    for k in range(thetas.shape[0]):
        dx = max(abs(thetas[k, 0] - x[0]), abs(thetas[k, 0] - x[-1])) + half_pixel
        dy = max(abs(thetas[k, 1] - y[0]), abs(thetas[k, 1] - y[-1])) + half_pixel
        inside[k] = (
            np.hypot(dx, dy) <= reach
            and low - SLACK_NM <= thetas[k, 2] <= high + SLACK_NM
            and np.isfinite(thetas[k, 3])
            and abs(thetas[k, 4]) <= largest_level
        )
    return inside


@kernel()
def box_supported(
    start: FloatArray,
    free: BoolArray,
    lower: FloatArray,
    upper: FloatArray,
    x: FloatArray,
    y: FloatArray,
    half_pixel: float,
    reach: float,
    low: float,
    high: float,
    largest_level: float,
) -> tuple[bool, bool]:
    """Tell whether a box contains the start of the free parameters, and is in the support."""
    inside = True
    corners = np.empty((4, 5))
    for i in range(5):
        if free[i] and not lower[i] <= start[i] <= upper[i]:
            inside = False
        for k in range(4):
            corners[k, i] = start[i]
        if free[i] and i < 3:
            corners[0, i], corners[1, i] = lower[i], upper[i]
            corners[2, i] = lower[i] if i == 0 else upper[i]
            corners[3, i] = upper[i] if i == 0 else lower[i]
    known = supported(corners, x, y, half_pixel, reach, low, high, largest_level)
    return inside, known[0] and known[1] and known[2] and known[3]
