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
from iscat_analysis._kernels.image import begin_strips, fill_strip, signal_image, signal_parts
from iscat_analysis._kernels.lattice import nodes_needed
from iscat_analysis._kernels.lens import LATTICE, STAMP, Lens, Pixels, named_lens
from iscat_analysis._kernels.loops import copy_line, factorise, marked, solve
from iscat_analysis._kernels.noise import Measured, score_of_pixel, value_of_pixels
from iscat_analysis._kernels.radial import POWERS, AxialTable, profile_at
from iscat_analysis._kernels.radial_rows import intervals_needed

CONVERGED, STALLED, EXHAUSTED, ABANDONED = 0, 1, 2, 3
"""Outcome of a fit: step below tolerance; no step improves; iterations used up; little to gain."""

LARGEST_GAIN_RATIO = 16.0
"""Largest gain in log-likelihood that a fit may still make, over the expected gain."""

_TOGETHER = 256
"""Pixels in one block: the slow logarithm is computed only for blocks with bright pixels."""


Score = tuple[FloatArray, FloatArray]
"""Score (5) and Fisher matrix (5, 5), to be filled."""


@kernel()
def signal_value(measured: Measured, level: float, s: FloatArray) -> float:
    """Log-likelihood of signals s (ny·nx,), relative to that without a particle."""
    kind, data = measured
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
    for k, value in enumerate((b0, b1, b2, b3, b4, f00, f01, f02, f03, f04)):
        sums[k] += value
    for k, value in enumerate((f11, f12, f13, f14, f22, f23, f24, f33, f34, f44)):
        sums[10 + k] += value


@kernel()
def image_score(measured: Measured, level: float, rows: FloatArray, into: Score) -> float:
    """Fill score and Fisher matrix of an image, and give its log-likelihood.

    `rows` (ny, 5 or more, nx) holds s and its gradient.
    """
    kind, data = measured
    ny, nx = rows.shape[0], rows.shape[2]
    flat, sums, total = data.reshape(4, ny * nx), np.zeros(20), 0.0
    for row in range(ny):
        _add_score(kind, flat, row * nx, (row + 1) * nx, level, rows[row], sums)
        total += value_of_pixels(kind, flat, row * nx, (row + 1) * nx, level, rows[row, 0])
    _unpack(sums, into)
    return total


@kernel()
def _unpack(sums: FloatArray, into: Score) -> None:
    """Fill score and Fisher matrix from the sums of `_add_score`."""
    score, fisher = into
    k = 5
    for i in range(5):
        score[i] = sums[i]
        for j in range(i, 5):
            fisher[i, j] = fisher[j, i] = sums[k]
            k += 1


@kernel()
def score_pass(
    profile: FloatArray, lens: Lens, pixels: Pixels, measured: Measured, theta: FloatArray,
    into: Score,
) -> float:  # fmt: skip
    """Fill score and Fisher matrix at θ and return the log-likelihood.

    This goes strip by strip, while the strip is in the first cache.
    """
    kind, data = measured
    level, ny, nx = np.exp(theta[4]), pixels.y.size, pixels.x.size
    flat, sums, total = data.reshape(4, ny * nx), np.zeros(20), 0.0
    begun = begin_strips(profile, lens, pixels, theta)
    together, _, lines = begun
    for row in range(0, ny, together):
        end = min(row + together, ny)
        fill_strip(profile, lens, pixels, theta, row, end, begun)
        _add_score(kind, flat, row * nx, end * nx, level, lines, sums)
        total += value_of_pixels(kind, flat, row * nx, end * nx, level, lines[0])
    _unpack(sums, into)
    return total


@kernel()
def value_pass(
    profile: FloatArray, lens: Lens, pixels: Pixels, measured: Measured, theta: FloatArray
) -> float:
    """Log-likelihood at θ, without derivatives."""
    s = np.empty((pixels.y.size, pixels.x.size))
    signal_image(profile, lens, pixels, theta, s)
    value: float = signal_value(measured, np.exp(theta[4]), s.reshape(s.size))
    return value


@kernel(_nrt=False)
def span(lens: Lens, pixels: Pixels, theta: FloatArray, width: int) -> tuple[int, int]:
    """Range of the flattened profile, `width` long, that an image needs."""
    zero = int(np.int64(0))  # a literal 0 has its own type, for which callers are compiled again
    if len(lens) == STAMP:
        return zero, width
    if len(lens) == LATTICE:
        first, count = nodes_needed(lens, pixels, pixels.x, theta[0])
        side = 2 * lens.half + 1
        return first * side, (first + count) * side
    return zero, POWERS * intervals_needed(lens, pixels, theta, width // POWERS)


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
    axial: AxialTable, lens: Lens, pixels: Pixels, measured: Measured, thetas: FloatArray
) -> FloatArray:
    """Give the log-likelihoods at θ (n, 5); equal z share a profile."""
    profile, out = blank_profile(axial, lens, 1), np.empty(thetas.shape[0])
    width = axial.heights.shape[3]
    z, first, last = np.nan, 0, 0
    for k in range(thetas.shape[0]):
        start, stop = span(lens, pixels, thetas[k], width)
        if thetas[k, 2] != z or start < first or stop > last:
            if thetas[k, 2] == z:
                start, stop = min(start, first), max(stop, last)
            z, first, last = thetas[k, 2], start, stop
            profile = picture_at(axial, lens, z, first, last, profile)
        out[k] = value_pass(profile, lens, pixels, measured, thetas[k])
    return out


@kernel()
def scoring_step(
    score: FloatArray, fisher: FloatArray, active: BoolArray, damping: float, step: FloatArray
) -> bool:
    """Solve (F + damping·diag F) step = score on the active parameters; False if singular."""
    index = marked(active)
    n = index.size
    scale, lower, z = np.empty(n), np.empty((n, n)), np.empty(n)
    for i in range(5):
        step[i] = 0.0
    for i in range(n):
        known = fisher[index[i], index[i]]
        if not known > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(known)
        z[i] = score[index[i]] * scale[i]
    if not factorise(fisher, index, scale, damping, lower):
        return False
    solve(lower, z)
    for i in range(n):
        step[index[i]] = z[i] * scale[i]
    return True


Picture = tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...]]
"""Fields of a table along z, of its lens and of the pixels."""

Search = tuple[BoolArray, FloatArray, FloatArray, FloatArray, float, int, float]
"""Which parameters are free, lower and upper ends of their box, their largest steps, shape (5,)
each; tolerance of the likelihood, the most passes, and below which likelihood a maximum is of no
use."""

Normal = tuple[float, float]
"""Mean and information of a normal prior of z."""


@kernel(_nrt=False)
def add_prior(prior: Normal, theta: FloatArray, into: Score) -> float:
    """Add a prior of z to score and Fisher matrix; return its logarithm."""
    mean, information = prior
    score, fisher = into
    away = theta[2] - mean
    score[2] -= information * away
    fisher[2, 2] += information
    density: float = -0.5 * information * away * away
    return density


@kernel()
def maximize(
    picture: Picture, measured: Measured, search: Search, prior: Normal, theta: FloatArray
) -> tuple[float, int, int, FloatArray]:
    """Damped Fisher scoring inside a box, from θ, which is overwritten with the estimate.

    Gives its log-likelihood, the passes, how it ended, and its Fisher matrix.  Zero information
    of the prior means none.
    """
    table, optics, grid = picture
    free, lower, upper, max_step, tolerance, iterations, least = search
    axial, lens, pixels = AxialTable(*table), named_lens(optics), Pixels(*grid)
    profile = blank_profile(axial, lens, 2)
    width = axial.heights.shape[3]
    step, trial, score = np.empty(5), np.empty(5), np.empty(5)
    fisher, trial_score, trial_fisher = np.empty((5, 5)), np.empty(5), np.empty((5, 5))
    active = np.empty(5, dtype=np.bool_)
    damping = 0.0
    start, stop = (0, width) if not free[2] else span(lens, pixels, theta, width)
    profile = picture_at(axial, lens, theta[2], start, stop, profile)
    value = score_pass(profile, lens, pixels, measured, theta, (score, fisher))
    value += add_prior(prior, theta, (score, fisher))
    passes = 1
    while passes < iterations:
        for i in range(5):
            outwards = theta[i] <= lower[i] and score[i] < 0
            outwards |= theta[i] >= upper[i] and score[i] > 0
            active[i] = free[i] and not outwards
        if scoring_step(score, fisher, active, damping, step):
            shrink = 1.0
            for i in range(5):
                if active[i] and abs(step[i]) * shrink > max_step[i]:
                    shrink = max_step[i] / abs(step[i])
            gain = largest_gain = 0.0
            for i in range(5):
                trial[i] = min(max(theta[i] + shrink * step[i], lower[i]), upper[i])
                gain += 0.5 * score[i] * (trial[i] - theta[i])
                largest_gain += 0.5 * LARGEST_GAIN_RATIO * score[i] * step[i]
            if not np.isfinite(gain):  # an overflow: a NaN position must not become an index
                return value, passes, STALLED, fisher
            if damping == 0.0 and (gain < tolerance or value + largest_gain < least):
                copy_line(trial, theta)
                outcome = CONVERGED if gain < tolerance else ABANDONED
                return value + gain, passes, outcome, fisher
            if free[2]:
                start, stop = span(lens, pixels, trial, width)
                profile_at(axial, trial[2], start, stop, profile)
            into = trial_score, trial_fisher
            there = score_pass(profile, lens, pixels, measured, trial, into)
            there += add_prior(prior, trial, into)
            passes += 1
            if there >= value - 1e-3 * tolerance - 1e-13 * abs(value):
                value = there
                copy_line(trial, theta)
                copy_line(trial_score, score)
                copy_line(trial_fisher.reshape(25), fisher.reshape(25))
                damping = 0.0 if damping < 1e-2 else 0.1 * damping
                continue
        if damping > 1e6:
            return value, passes, STALLED, fisher
        damping = max(10 * damping, 1e-3)
    return value, passes, EXHAUSTED, fisher


@kernel()
def scan_heights(
    picture: Picture,
    measured: Measured,
    heights: FloatArray,
    limits: tuple[float, float],
    theta: FloatArray,
) -> FloatArray:
    """Profile log-likelihood along z at fixed (x, y): the amplitude takes two scoring steps.

    Gives values and amplitudes, shape (2, n), for `heights` (n,); θ has the other parameters and
    the start.  Empty limits of the amplitude hold it fixed.
    """
    table, optics, grid = picture
    kind, data = measured
    axial, lens, pixels = AxialTable(*table), named_lens(optics), Pixels(*grid)
    profile = blank_profile(axial, lens, 1)
    here, size = theta.copy(), pixels.y.size * pixels.x.size
    flat, parts, s = data.reshape(4, size), np.empty((2, size)), np.empty(size)
    p, q, out = parts[0], parts[1], np.empty((2, heights.size))
    low, high = limits
    here[3], level = theta[3] if theta[3] != 0.0 else 1.0, np.exp(theta[4])
    for k in range(heights.size):
        here[2] = heights[k]
        start, stop = span(lens, pixels, here, axial.heights.shape[3])
        profile_at(axial, here[2], start, stop, profile)
        signal_parts(profile, lens, pixels, here, parts)
        a = theta[3]
        for _ in range(2 if low < high else 0):
            pull, known = _amplitude(kind, flat, level, a, p, q)
            if known > 0:
                a = min(max(a + pull / known, low), high)
        for j in range(s.size):
            s[j] = a * (p[j] + a * q[j])
        out[0, k], out[1, k] = signal_value(measured, level, s), a
    return out


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
def supported(thetas: FloatArray, grid: tuple[Any, ...], limits: tuple[float, ...]) -> BoolArray:
    """Tell for which θ (n, 5) all pixels are within reach, z is in the table and all is finite.

    `grid` has the centres of the pixels and half their side, `limits` the reach, the lowest and the
    highest z, and the largest logarithm of the level.
    """
    x, y, half_pixel = grid
    reach, low, high, largest_level = limits
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
    box: tuple[BoolArray, FloatArray, FloatArray], start: FloatArray, grid: tuple[Any, ...],
    limits: tuple[float, ...],
) -> bool:  # fmt: skip
    """Tell whether a box of free parameters around a start is in the support."""
    free, lower, upper = box
    corners = np.empty((4, 5))
    for i in range(5):
        for k in range(4):
            corners[k, i] = start[i]
        if free[i] and i < 3:
            corners[0, i], corners[1, i] = lower[i], upper[i]
            corners[2, i] = lower[i] if i == 0 else upper[i]
            corners[3, i] = upper[i] if i == 0 else lower[i]
    known = supported(corners, grid, limits)
    inside: bool = known[0] and known[1] and known[2] and known[3]
    return inside
