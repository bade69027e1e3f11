"""What the likelihood of a particle in a frame knows of it; see `fit_frames`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.canvas import (
    Canvas,
    Field,
    Light,
    Pictures,
    cut,
    draw_gradient,
    ready_frame,
    square_of,
    stage,
    table_of,
)
from iscat_analysis._kernels.dense import factorise
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lens import STAMP
from iscat_analysis._kernels.place_score import place_score
from iscat_analysis._kernels.scoring import FLOOR, blank_profile

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

PART = 0.5
"""Steps, in standard deviations, over which second derivatives are taken as differences."""

_SINGULAR = 1e-9
"""Pivot of a matrix with ones on its diagonal below which a parameter is not known."""


@kernel(fastmath=FAST, _nrt=False)
def _score_of(data: FloatArray, g: FloatArray, score: FloatArray) -> None:
    """Fill the four scores of a square whose signal and gradient are g (ny, 5, nx)."""
    score[:] = 0.0
    for i in range(data.shape[1]):
        d0, d1, d2, d3 = data[0, i], data[1, i], data[2, i], data[3, i]
        s, gx, gy, gz, ga = g[i, 0], g[i, 1], g[i, 2], g[i, 3], g[i, 4]
        s0 = s1 = s2 = s3 = 0.0
        for j in range(s.size):
            rate = max(d1[j] + d2[j] * s[j] + d3[j], FLOOR)
            pull = d2[j] * (d0[j] / rate - 1.0)
            s0 += pull * gx[j]
            s1 += pull * gy[j]
            s2 += pull * gz[j]
            s3 += pull * ga[j]
        score[0] += s0
        score[1] += s1
        score[2] += s2
        score[3] += s3


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


@kernel(fastmath=FAST, _nrt=False)
def _left_over(data: FloatArray, here: FloatArray) -> tuple[float, float, float, float]:
    """χ², pixels, largest residual and light of a square."""
    chi2 = used = worst = light = 0.0
    for i in range(data.shape[1]):
        d0, d1, d2, d3, s = data[0, i], data[1, i], data[2, i], data[3, i], here[i, 0]
        for j in range(s.size):
            rate = d1[j] + d2[j] * s[j] + d3[j]
            left = (d0[j] - rate) * (d0[j] - rate) / max(rate, FLOOR)
            chi2 += left
            worst = max(worst, left)
            used += 1.0 if d2[j] > 0 else 0.0
            light += d2[j]
    return chi2, used, np.sqrt(worst), light


@kernel()
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
    canvas: Canvas,
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
    light, field, near, far, free, starts, first, last, theta, group, canvas
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
    near_profile = blank_profile(table_of(near, 0), near.lens, 1)
    far_profile = blank_profile(table_of(far, 0), far.lens, 1)
    profile = blank_profile(table_of(near, 0), near.lens, 2)
    low = near.first_nm
    high = low + near.step_nm * (near.heights.shape[1] - 1)
    index = np.flatnonzero(free[:4])
    n = index.size
    image = np.empty(max(field.drawn, field.side) ** 2)
    square = np.empty(4 * field.side**2)
    g, up = np.empty(5 * field.side**2), np.empty(5 * field.side**2)
    down = np.empty(5 * field.side**2)
    pull, known = np.empty(5), np.empty((5, 5))
    ways_here, trial, ahead, behind = np.empty((4, n)), np.empty(5), np.empty(4), np.empty(4)
    for t in range(first, last):
        ready_frame(
            field, near, far, starts, t, theta, group, canvas, near_profile, far_profile, image
        )
        for r in range(starts[t], starts[t + 1]):
            p, f = theta[r], fisher[r]
            f[:], turned[r], ways[r] = 0.0, np.nan, np.nan
            bias[r], score[r], numbers[r] = 0.0, 0.0, 0.0
            r0, r1, c0, c1 = square_of(field, canvas.rings[r], field.side, rows, columns)
            if r1 <= r0:
                continue
            ny, nx = r1 - r0, c1 - c0
            pixels = cut(field.pixels, r0, r1, c0, c1)
            here = g[: 5 * ny * nx].reshape(ny, 5, nx)
            draw_gradient(near, group[r], p, pixels, profile, here)
            data = square[: 4 * ny * nx].reshape(4, ny, nx)
            stage(light, t, canvas.total[t], here, r0, c0, data)
            value = place_score(data, here, len(near.lens) != STAMP, pull, known)
            for i in range(4):
                score[r, i] = pull[i]
                for j in range(4):
                    f[i, j] = known[i, j]
            chi2, used, worst, amount = _left_over(data, here)
            numbers[r, 0], numbers[r, 1], numbers[r, 2] = value, chi2, used
            numbers[r, 3], numbers[r, 4] = worst, amount / max(used, 1.0)
            if brief or not _directions(f, index, ways_here):
                continue
            if PART * np.abs(ways_here[:2]).max() > field.pixel_nm:  # as good as singular
                continue
            for k in range(n):
                for sign in range(2):
                    step = PART if sign == 0 else -PART
                    trial[:] = p
                    for a in range(4):
                        trial[a] += step * ways_here[a, k]
                    if free[2]:
                        trial[2] = min(max(trial[2], low), high)
                    there = (up if sign == 0 else down)[: 5 * ny * nx].reshape(ny, 5, nx)
                    draw_gradient(near, group[r], trial, pixels, profile, there)
                    _score_of(data, there, ahead if sign == 0 else behind)
                plus = up[: 5 * ny * nx].reshape(ny, 5, nx)
                minus = down[: 5 * ny * nx].reshape(ny, 5, nx)
                _add_curvature(data, here, plus, minus, bias[r])
                for a in range(4):
                    turned[r, a, k] = -(ahead[a] - behind[a]) / (2 * PART)
                    ways[r, a, k] = ways_here[a, k]


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
        if not low[i, i] ** 2 > _SINGULAR:
            return False
    out[:] = 0.0
    for k in range(n):  # column k of L⁻ᵀ
        for i in range(k, -1, -1):
            total = 1.0 if i == k else 0.0
            for j in range(i + 1, k + 1):
                total -= low[j, i] * out[index[j], k] / scale[j]
            out[index[i], k] = total / low[i, i] * scale[i]
    return True
