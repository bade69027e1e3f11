"""Particles that move over an unknown, constant background: every particle in every frame.

The counts of pixel p in frame t are Poisson with w_t B_p (1 + C_tp), C the sum of the particles'
signals, and read noise as in `iscat_analysis._kernels.scoring`, whose fit this is.  A *row* is one
particle in one frame, θ = (x, y, z, a, 0); rows are in the order of their frames, and those of
frame t are starts[t] to starts[t + 1].  Within a frame they are fitted in turn, each with the
others in its background, so that the result does not depend on how frames are shared out among
threads.

The picture of a row is one of several, sharp or blurred, by its number in `group`: a table for the
fit, which reaches over the fitted square, and one for drawing, which reaches farther.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.image import Lens, Pixels, signal_gradient, signal_image
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.scoring import POISSON, STALLED, maximize, scratch, span

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

PART = 0.5
"""Steps, in standard deviations, over which second derivatives are taken as differences."""


class Pictures(NamedTuple):
    """Pictures of one microscope, one for each blur.

    Attributes
    ----------
    heights : ndarray, shape (groups, n, 3, channels, width)
        As in `AxialTable`.
    first_nm, step_nm, kappa : float
        As in `AxialTable`.
    lens : Lens
        What turns a profile into a signal.
    """

    heights: FloatArray
    first_nm: float
    step_nm: float
    kappa: float
    lens: Lens


class Light(NamedTuple):
    """A movie and what is known of its light.

    Attributes
    ----------
    counts : ndarray of float32, shape (t, y, x)
        Photoelectrons [e].
    power : ndarray, shape (t,)
        Power of each frame, 1 on average.
    background : ndarray, shape (y, x)
        Photoelectrons at power 1 [e].
    read : ndarray, shape (y, x)
        Variance of the read noise [e²].
    used : ndarray of bool, shape (y, x)
        Pixels that may be used.
    """

    counts: NDArray[np.float32]
    power: FloatArray
    background: FloatArray
    read: FloatArray
    used: BoolArray


class Field(NamedTuple):
    """The pixels, and how far each particle is drawn and fitted.

    Attributes
    ----------
    pixels : Pixels
        Of the whole field.
    pixel_nm : float
        Side of a pixel [nm].
    side, drawn : int
        Sides of the square that is fitted and of that which is drawn [pixels].
    """

    pixels: Pixels
    pixel_nm: float
    side: int
    drawn: int


class Search(NamedTuple):
    """What is fitted, and how.

    Attributes
    ----------
    free : ndarray of bool, shape (5,)
        Free parameters.
    reach : ndarray, shape (5,)
        How far each may move from its start.
    lower, upper : ndarray, shape (5,)
        Bounds besides.
    max_step : ndarray, shape (5,)
        Largest change in one step.
    tolerance : float
        Expected gain in log-likelihood at which a fit ends.
    passes : int
        Passes over the data at most.
    """

    free: BoolArray
    reach: FloatArray
    lower: FloatArray
    upper: FloatArray
    max_step: FloatArray
    tolerance: float
    passes: int


@njit(cache=True, nogil=True, error_model="numpy")
def _table(pictures: Pictures, group: int) -> AxialTable:
    """Table of one blur."""
    return AxialTable(pictures.heights[group], pictures.first_nm, pictures.step_nm, pictures.kappa)


@njit(cache=True, nogil=True, error_model="numpy")
def box_of(centre_nm: float, pixel_nm: float, side: int, size: int) -> tuple[int, int]:
    """Half-open range of pixels around a place, cut off at the edge of the field."""
    first = int(np.rint(centre_nm / pixel_nm - (side - 1) / 2))
    return max(first, 0), min(first + side, size)


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(pixels: Pixels, r0: int, r1: int, c0: int, c1: int) -> Pixels:
    """Pixels of a part of the field."""
    return Pixels(pixels.x[c0:c1], pixels.y[r0:r1], pixels.offsets, pixels.weights)


@njit(cache=True, nogil=True, error_model="numpy")
def _draw(
    pictures: Pictures, group: int, theta: FloatArray, pixels: Pixels,
    work: FloatArray, profile: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` with the signal of one row."""
    table = _table(pictures, group)
    start, stop = span(pictures.lens, pixels, theta, table.heights.shape[3])
    profile_at(table, theta[2], start, stop, work, profile)
    signal_image(profile, pictures.lens, pixels, theta[0], theta[1], theta[3], out)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _stage(
    light: Light, t: int, total: FloatArray, own: FloatArray,
    r0: int, c0: int, data: FloatArray,
) -> None:  # fmt: skip
    """Fill the constants of a square's likelihood, with the other particles in its background."""
    w = light.power[t]
    for i in range(data.shape[1]):
        for j in range(data.shape[2]):
            row, column = r0 + i, c0 + j
            if light.used[row, column]:
                level, v = w * light.background[row, column], light.read[row, column]
                data[0, i, j] = light.counts[t, row, column] + v
                data[1, i, j] = level * (1.0 + total[row, column] - own[i, j])
                data[2, i, j] = level
                data[3, i, j] = v
            else:
                data[:, i, j] = 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def fit_frames(
    light: Light,
    field: Field,
    near: Pictures,
    far: Pictures,
    search: Search,
    starts: IntArray,
    first: int,
    last: int,
    sweeps: int,
    theta: FloatArray,
    group: IntArray,
    outcome: IntArray,
    passes: IntArray,
    expected: FloatArray,
    stretch: FloatArray,
) -> None:
    """Fit the rows of frames first…last − 1, each `sweeps` times, and draw them.

    Parameters
    ----------
    light, field, near, far, search
        Movie, pixels, pictures to fit and to draw, and what is fitted.
    starts : ndarray of int, shape (t + 1,)
        First row of each frame.
    first, last : int
        Frames.
    sweeps : int
        How often; 0 draws only.
    theta : ndarray, shape (rows, 5)
        Starts; overwritten with the estimates.
    group : ndarray of int, shape (rows,)
        Number of each row's picture.
    outcome, passes : ndarray of int, shape (rows,)
        Filled with how the last fit ended, and its passes over the data.
    expected : ndarray, shape (t,)
        Filled with the photoelectrons expected in the used pixels at power 1.
    stretch : ndarray, shape (y, x)
        Added to: Σ w (1 + C) over the frames.
    """
    rows, columns = light.background.shape
    work, profile = scratch(_table(far, 0), far.lens, 1)
    most = 0
    for t in range(first, last):
        most = max(most, starts[t + 1] - starts[t])
    drawn = np.zeros((most, field.drawn, field.drawn))
    boxes = np.zeros((most, 4), dtype=np.int64)
    total = np.zeros((rows, columns))
    square = np.empty(4 * field.side * field.side)
    mine = np.empty(field.side * field.side)
    score, fisher = np.empty(5), np.empty((5, 5))
    lower, upper = np.empty(5), np.empty(5)
    for t in range(first, last):
        total[:] = 0.0
        for turn in range(sweeps + 1):
            for r in range(starts[t], starts[t + 1]):
                k = r - starts[t]
                p, own = theta[r], drawn[k]
                if turn > 0:
                    b0, b1, b2, b3 = boxes[k]
                    r0, r1 = box_of(p[1], field.pixel_nm, field.side, rows)
                    c0, c1 = box_of(p[0], field.pixel_nm, field.side, columns)
                    if r1 <= r0 or c1 <= c0:
                        outcome[r] = STALLED
                        continue
                    shape = (r1 - r0) * (c1 - c0)
                    data = square[: 4 * shape].reshape(4, r1 - r0, c1 - c0)
                    here = mine[:shape].reshape(r1 - r0, c1 - c0)
                    for i in range(r1 - r0):
                        for j in range(c1 - c0):
                            y, x = r0 + i - b0, c0 + j - b2
                            inside = 0 <= y < b1 - b0 and 0 <= x < b3 - b2
                            here[i, j] = own[y, x] if inside else 0.0
                    _stage(light, t, total, here, r0, c0, data)
                    for i in range(5):
                        lower[i] = max(search.lower[i], p[i] - search.reach[i])
                        upper[i] = min(search.upper[i], p[i] + search.reach[i])
                        if search.free[i]:
                            p[i] = min(max(p[i], lower[i]), upper[i])
                    pixels = _cut(field.pixels, r0, r1, c0, c1)
                    _, used, ended = maximize(
                        _table(near, group[r]), near.lens, pixels, POISSON, data,
                        search.free, lower, upper, search.max_step, search.tolerance,
                        search.passes, p, score, fisher,
                    )  # fmt: skip
                    passes[r] = used
                    outcome[r] = ended
                    for i in range(b1 - b0):
                        for j in range(b3 - b2):
                            total[b0 + i, b2 + j] -= own[i, j]
                b0, b1 = box_of(p[1], field.pixel_nm, field.drawn, rows)
                b2, b3 = box_of(p[0], field.pixel_nm, field.drawn, columns)
                boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3] = b0, b1, b2, b3
                if b1 <= b0 or b3 <= b2:
                    boxes[k] = 0
                    continue
                _draw(
                    far, group[r], p, _cut(field.pixels, b0, b1, b2, b3), work, profile,
                    own[: b1 - b0, : b3 - b2],
                )  # fmt: skip
                for i in range(b1 - b0):
                    for j in range(b3 - b2):
                        total[b0 + i, b2 + j] += own[i, j]
        amount = 0.0
        w = light.power[t]
        for i in range(rows):
            for j in range(columns):
                if light.used[i, j]:
                    amount += light.background[i, j] * (1.0 + total[i, j])
                stretch[i, j] += w * (1.0 + total[i, j])
        expected[t] = amount


@njit(cache=True, nogil=True, error_model="numpy")
def residual_frames(
    light: Light,
    field: Field,
    far: Pictures,
    starts: IntArray,
    first: int,
    last: int,
    theta: FloatArray,
    group: IntArray,
    out: NDArray[np.float32],
) -> None:
    """Fill `out` (last − first, y, x) with counts minus expectation; 0 where not used."""
    rows, columns = light.background.shape
    work, profile = scratch(_table(far, 0), far.lens, 1)
    own = np.zeros((field.drawn, field.drawn))
    total = np.zeros((rows, columns))
    for t in range(first, last):
        total[:] = 0.0
        for r in range(starts[t], starts[t + 1]):
            p = theta[r]
            b0, b1 = box_of(p[1], field.pixel_nm, field.drawn, rows)
            b2, b3 = box_of(p[0], field.pixel_nm, field.drawn, columns)
            if b1 <= b0 or b3 <= b2:
                continue
            mine = own[: b1 - b0, : b3 - b2]
            _draw(far, group[r], p, _cut(field.pixels, b0, b1, b2, b3), work, profile, mine)
            for i in range(b1 - b0):
                for j in range(b3 - b2):
                    total[b0 + i, b2 + j] += mine[i, j]
        w = light.power[t]
        for i in range(rows):
            for j in range(columns):
                left = 0.0
                if light.used[i, j]:
                    left = light.counts[t, i, j] - w * light.background[i, j] * (1.0 + total[i, j])
                out[t - first, i, j] = left


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _score_of(data: FloatArray, g: FloatArray, score: FloatArray) -> None:
    """Fill the four scores of a square whose signal and gradient are g (ny, 5, nx)."""
    s0 = s1 = s2 = s3 = 0.0
    for i in range(data.shape[1]):
        for j in range(data.shape[2]):
            beta = data[2, i, j]
            if beta > 0:
                rate = data[1, i, j] + beta * g[i, 0, j] + data[3, i, j]
                pull = beta * (data[0, i, j] / rate - 1.0)
                s0 += pull * g[i, 1, j]
                s1 += pull * g[i, 2, j]
                s2 += pull * g[i, 3, j]
                s3 += pull * g[i, 4, j]
    score[0], score[1], score[2], score[3] = s0, s1, s2, s3


@njit(cache=True, nogil=True, error_model="numpy")
def _directions(fisher: FloatArray, index: IntArray, out: FloatArray) -> bool:
    """Fill the columns of `out` (4, n) with V, V Vᵀ the inverse of F on the free parameters."""
    n = index.size
    scale = np.empty(n)
    for i in range(n):
        if not fisher[index[i], index[i]] > 0.0:
            return False
        scale[i] = 1.0 / np.sqrt(fisher[index[i], index[i]])
    low = np.zeros((n, n))
    for i in range(n):
        for j in range(i + 1):
            total = fisher[index[i], index[j]] * scale[i] * scale[j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            if i == j:
                if not total > 1e-12:
                    return False
                low[i, i] = np.sqrt(total)
            else:
                low[i, j] = total / low[j, j]
    out[:] = 0.0
    for k in range(n):  # column k of L⁻ᵀ
        for i in range(k, -1, -1):
            total = 1.0 if i == k else 0.0
            for j in range(i + 1, k + 1):
                total -= low[j, i] * out[index[j], k] / scale[j]
            out[index[i], k] = total / low[i, i] * scale[i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def judge_frames(
    light: Light,
    field: Field,
    near: Pictures,
    far: Pictures,
    free: BoolArray,
    starts: IntArray,
    first: int,
    last: int,
    theta: FloatArray,
    group: IntArray,
    fisher: FloatArray,
    turned: FloatArray,
    ways: FloatArray,
    bias: FloatArray,
    score: FloatArray,
    numbers: FloatArray,
    brief: bool,
) -> None:
    """Say of the rows of frames first…last − 1 what their likelihoods know, at θ.

    Parameters
    ----------
    light, field, near, far, free, starts, first, last, theta, group
        As in `fit_frames`.
    fisher : ndarray, shape (rows, 4, 4)
        Filled with the expected information in (x, y, z, a).
    turned, ways : ndarray, shape (rows, 4, 4)
        Filled with O V and V, the columns of V directions of one standard deviation in the free
        parameters, and O the observed information; NaN where the information is singular.
    bias : ndarray, shape (rows, 4)
        Filled with what `score` is expected to be off by through curvature, −½ Σ V tr(F⁻¹∂²η) ∂η:
        F⁻¹ times it is the bias of order 1/N (see `iscat_analysis.inference.bias`).
    score : ndarray, shape (rows, 4)
        Filled with the gradient of the log-likelihood.
    numbers : ndarray, shape (rows, 5)
        Filled with the log-likelihood over that without the particle, χ², pixels, the largest
        residual in standard deviations, and mean background of the square [e].
    brief : bool
        Leave out what takes second derivatives: `turned`, `ways` and `bias`.
    """
    rows, columns = light.background.shape
    work, profile = scratch(_table(far, 0), far.lens, 1)
    work2, profile2 = scratch(_table(near, 0), near.lens, 2)
    index = np.flatnonzero(free[:4])
    n = index.size
    total = np.zeros((rows, columns))
    drawn = np.zeros((field.drawn, field.drawn))
    square = np.empty(4 * field.side**2)
    blank = np.zeros((field.side, field.side))
    g = np.empty(5 * field.side**2)
    up, down = np.empty(5 * field.side**2), np.empty(5 * field.side**2)
    ways_here, trial, ahead, behind = np.empty((4, n)), np.empty(5), np.empty(4), np.empty(4)
    for t in range(first, last):
        total[:] = 0.0
        for r in range(starts[t], starts[t + 1]):
            b0, b1 = box_of(theta[r, 1], field.pixel_nm, field.drawn, rows)
            b2, b3 = box_of(theta[r, 0], field.pixel_nm, field.drawn, columns)
            if b1 <= b0 or b3 <= b2:
                continue
            own = drawn[: b1 - b0, : b3 - b2]
            _draw(far, group[r], theta[r], _cut(field.pixels, b0, b1, b2, b3), work, profile, own)
            for i in range(b1 - b0):
                for j in range(b3 - b2):
                    total[b0 + i, b2 + j] += own[i, j]
        for r in range(starts[t], starts[t + 1]):
            p = theta[r]
            fisher[r], turned[r], ways[r] = 0.0, np.nan, np.nan
            bias[r], score[r], numbers[r] = 0.0, 0.0, 0.0
            r0, r1 = box_of(p[1], field.pixel_nm, field.side, rows)
            c0, c1 = box_of(p[0], field.pixel_nm, field.side, columns)
            if r1 <= r0 or c1 <= c0:
                continue
            ny, nx = r1 - r0, c1 - c0
            pixels = _cut(field.pixels, r0, r1, c0, c1)
            table = _table(near, group[r])
            profile_at(table, p[2], 0, table.heights.shape[3], work2, profile2)
            here = g[: 5 * ny * nx].reshape(ny, 5, nx)
            signal_gradient(profile2, near.lens, pixels, p[0], p[1], p[3], here)
            data = square[: 4 * ny * nx].reshape(4, ny, nx)
            _stage(light, t, total, blank, r0, c0, data)
            value = chi2 = used = worst = level = 0.0
            f = fisher[r]
            for i in range(ny):
                for j in range(nx):
                    beta = data[2, i, j]
                    if beta > 0:
                        data[1, i, j] -= beta * here[i, 0, j]
                        base = data[1, i, j] + data[3, i, j]
                        rate = base + beta * here[i, 0, j]
                        value += data[0, i, j] * np.log(rate / base) - (rate - base)
                        left = (data[0, i, j] - rate) / np.sqrt(rate)
                        chi2 += left * left
                        worst = max(worst, abs(left))
                        used += 1.0
                        level += beta
                        bend = beta * beta / rate
                        for a in range(4):
                            for b in range(a + 1):
                                f[a, b] += bend * here[i, 1 + a, j] * here[i, 1 + b, j]
            for a in range(4):
                for b in range(a):
                    f[b, a] = f[a, b]
            numbers[r, 0], numbers[r, 1], numbers[r, 2] = value, chi2, used
            numbers[r, 3], numbers[r, 4] = worst, level / max(used, 1.0)
            _score_of(data, here, score[r])
            if brief or not _directions(f, index, ways_here):
                continue
            for k in range(n):
                for sign in range(2):
                    step = PART if sign == 0 else -PART
                    trial[:] = p
                    for a in range(4):
                        trial[a] += step * ways_here[a, k]
                    if free[2]:
                        low = table.first_nm
                        high = low + table.step_nm * (table.heights.shape[0] - 1)
                        trial[2] = min(max(trial[2], low), high)
                        profile_at(table, trial[2], 0, table.heights.shape[3], work2, profile2)
                    there = (up if sign == 0 else down)[: 5 * ny * nx].reshape(ny, 5, nx)
                    signal_gradient(
                        profile2, near.lens, pixels, trial[0], trial[1], trial[3], there
                    )
                    _score_of(data, there, ahead if sign == 0 else behind)
                plus = up[: 5 * ny * nx].reshape(ny, 5, nx)
                minus = down[: 5 * ny * nx].reshape(ny, 5, nx)
                for i in range(ny):
                    for j in range(nx):
                        beta = data[2, i, j]
                        if beta > 0:
                            rate = data[1, i, j] + beta * here[i, 0, j] + data[3, i, j]
                            curved = (plus[i, 0, j] + minus[i, 0, j] - 2 * here[i, 0, j]) / PART**2
                            for a in range(4):
                                bias[r, a] -= 0.5 * beta * beta / rate * curved * here[i, 1 + a, j]
                for a in range(4):
                    turned[r, a, k] = -(ahead[a] - behind[a]) / (2 * PART)
                    ways[r, a, k] = ways_here[a, k]


@njit(cache=True, nogil=True, error_model="numpy")
def common_modes(
    light: Light,
    field: Field,
    near: Pictures,
    frame: IntArray,
    theta: FloatArray,
    group: IntArray,
    top: int,
    left: int,
    out: FloatArray,
) -> None:
    """Add up what the frames of one track change of each pixel's light, per parameter in common.

    Parameters
    ----------
    light, field, near
        As in `fit_frames`.
    frame, group : ndarray of int, shape (n,)
        Frames and pictures of the track's rows.
    theta : ndarray, shape (n, 5)
        Their estimates.
    top, left : int
        First row and column of `out` in the field.
    out : ndarray, shape (4, y, x)
        Filled with Σ w B ∂C over the frames, for (x, y, z, a) [e per unit].
    """
    rows, columns = light.background.shape
    work, profile = scratch(_table(near, 0), near.lens, 2)
    g = np.empty(5 * field.side**2)
    out[:] = 0.0
    for k in range(frame.size):
        p, w = theta[k], light.power[frame[k]]
        r0, r1 = box_of(p[1], field.pixel_nm, field.side, rows)
        c0, c1 = box_of(p[0], field.pixel_nm, field.side, columns)
        if r1 <= r0 or c1 <= c0:
            continue
        ny, nx = r1 - r0, c1 - c0
        table = _table(near, group[k])
        profile_at(table, p[2], 0, table.heights.shape[3], work, profile)
        here = g[: 5 * ny * nx].reshape(ny, 5, nx)
        pixels = _cut(field.pixels, r0, r1, c0, c1)
        signal_gradient(profile, near.lens, pixels, p[0], p[1], p[3], here)
        for i in range(ny):
            for j in range(nx):
                if light.used[r0 + i, c0 + j]:
                    level = w * light.background[r0 + i, c0 + j]
                    for a in range(4):
                        out[a, r0 - top + i, c0 - left + j] += level * here[i, 1 + a, j]
