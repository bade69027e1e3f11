"""The likelihood of a particle's track in a harmonic well, by a Kalman filter with a scalar state.

Each position is an average over an exposure and has its own error.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis._kernels import FAST, FloatArray, kernel
from iscat_analysis._kernels.diffusion import LOG_2PI, TOGETHER
from iscat_analysis._kernels.loops import copy_line, largest

Track = tuple[FloatArray, FloatArray, FloatArray, float]
"""Positions (c, n), the variances of their errors (c, n), times between them (n − 1,), exposure."""

_STIFFNESSES = 10  # number of stiffnesses among which the search begins
_FINER = 0.3  # factor of the distance of the compared points in each step
_LARGEST_LOG_RATIO = 10.0  # largest logarithm of D over that of free diffusion
_TOLERANCE = 1e-4  # tolerance of the log-likelihood at its maximum


@kernel(fastmath=FAST)
def harmonic_likelihoods(track: Track, diffusion: FloatArray, stiffness: FloatArray) -> FloatArray:
    """Log-likelihoods of the displacements of a particle in harmonic wells of unknown centre.

    The state is the position at the start of an exposure, dx = −κ x dt + √(2D) dW, which begins in
    equilibrium.  The centre has a flat prior and is integrated out, which gives the density of
    displacements.

    Shapes: `diffusion, stiffness` (m,), result (m,).
    """
    positions, variance, gaps, exposure = track
    axes, n = positions.shape
    m = diffusion.size
    wells, state = np.empty((7, m)), np.empty((8, m))
    width, decay, mean, var_end, var_mean = wells[0], wells[1], wells[2], wells[3], wells[4]
    both, dark_decay, place, unit, spread = wells[5], wells[6], state[0], state[1], state[2]
    product, q11, q12, q22, log_determinant = state[3], state[4], state[5], state[6], state[7]
    for i in range(m):
        width[i] = diffusion[i] / stiffness[i]
        u = stiffness[i] * exposure
        decay[i], mean[i], var_end[i], var_mean[i], both[i] = 1.0, 1.0, 0.0, 0.0, 0.0
        if exposure > 0.0:
            left = -math.expm1(-u)
            decay[i], mean[i] = math.exp(-u), left / u
            var_end[i] = -width[i] * math.expm1(-2.0 * u)
            both[i] = width[i] * left * left / u
            # with little stiffness times exposure the moments are computed from a series
            if u < 1e-2:
                series = 1.0 / 3.0 - u * (0.25 - u * (7.0 / 60.0 - u / 24.0))
                var_mean[i] = 2.0 * diffusion[i] * exposure * series
            else:
                curved = u - 2.0 * left - 0.5 * math.expm1(-2.0 * u)
                var_mean[i] = 2.0 * width[i] * curved / (u * u)
    out = np.empty(m)
    for i in range(m):
        out[i] = -0.5 * axes * (n - 1) * LOG_2PI
    for c in range(axes):
        for i in range(m):
            place[i], unit[i], spread[i], product[i] = 0.0, 0.0, width[i], 1.0
            q11[i], q12[i], q22[i], log_determinant[i] = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            if k < 2 or gaps[k - 1] != gaps[k - 2]:
                dark = gaps[k - 1] - exposure if k else 0.0
                for i in range(m):
                    dark_decay[i] = math.exp(-stiffness[i] * dark)
            here, error = positions[c, k], variance[c, k]
            for i in range(m):
                before, one = dark_decay[i] * place[i], dark_decay[i] * unit[i]
                wide = width[i] + dark_decay[i] * dark_decay[i] * (spread[i] - width[i])
                s = mean[i] * mean[i] * wide + var_mean[i] + error
                inverse = 1.0 / s
                e1, e2 = here - mean[i] * before, 1.0 - mean[i] * one
                product[i] *= s
                q11[i] += e1 * e1 * inverse
                q12[i] += e1 * e2 * inverse
                q22[i] += e2 * e2 * inverse
                gain = (decay[i] * mean[i] * wide + both[i]) * inverse
                place[i] = decay[i] * before + gain * e1
                unit[i] = decay[i] * one + gain * e2
                spread[i] = decay[i] * decay[i] * wide + var_end[i] - gain * gain * s
            if k % TOGETHER == 0 or k == n - 1:
                for i in range(m):
                    log_determinant[i] += math.log(product[i])
                    product[i] = 1.0
        for i in range(m):
            inside = q11[i] - q12[i] * q12[i] / q22[i]
            out[i] -= 0.5 * (log_determinant[i] + inside + math.log(q22[i]))
    return out


@kernel()
def most_likely_well(
    track: Track, scale: float, softest: float, stiffest: float
) -> tuple[float, float, float]:
    """Maximise the likelihood of a harmonic well over D and stiffness.

    The search compares a square of nine points in the logarithms.  The highest point becomes the
    centre of the next square; if it is the centre, the square shrinks around the vertex of a
    parabola.
    """
    low, high, best = np.empty(2), np.empty(2), np.empty(2)
    low[0], high[0] = -_LARGEST_LOG_RATIO, _LARGEST_LOG_RATIO
    low[1], high[1] = math.log(softest), math.log(stiffest)
    points, square, vertex = np.empty((2 * _STIFFNESSES, 2)), np.empty((9, 2)), np.empty((1, 2))
    for k in range(2 * _STIFFNESSES):
        points[k, 0] = 0.5 * (k % 2)
        points[k, 1] = low[1] + (high[1] - low[1]) * (k // 2) / (_STIFFNESSES - 1.0)
    values = _logarithmic(track, scale, points)
    at = largest(values)
    copy_line(points[at], best)
    # first distance of the compared points
    value, apart = values[at], 0.3
    for _ in range(100):
        for k in range(9):
            square[k, 0], square[k, 1] = best[0] + (k // 3 - 1) * apart, best[1]
            square[k, 1] += (k % 3 - 1) * apart
            for a in range(2):
                square[k, a] = min(max(square[k, a], low[a]), high[a])
        values = _logarithmic(track, scale, square)
        at = largest(values)
        if values[at] > value:
            copy_line(square[at], best)
            value = values[at]
            continue
        g0, g1 = 0.5 * (values[7] - values[1]), 0.5 * (values[5] - values[3])
        h0, h1 = values[7] + values[1] - 2.0 * value, values[5] + values[3] - 2.0 * value
        h01 = 0.25 * (values[8] + values[0] - values[2] - values[6])
        det = h0 * h1 - h01 * h01
        apart *= _FINER
        if not (h0 < 0.0 and det > 0.0):
            if apart < _TOLERANCE:
                break
            continue
        step0, step1 = (h01 * g1 - h1 * g0) / det, (h01 * g0 - h0 * g1) / det
        if 0.5 * (g0 * step0 + g1 * step1) < _TOLERANCE:
            break
        for a in range(2):
            move = (step0 if a == 0 else step1) * apart / _FINER
            vertex[0, a] = min(max(best[a] + move, low[a]), high[a])
        there = _logarithmic(track, scale, vertex)[0]
        if there > value:
            copy_line(vertex[0], best)
            value = there
    return value, scale * math.exp(best[0]), math.exp(best[1])


@kernel()
def _logarithmic(track: Track, scale: float, points: FloatArray) -> FloatArray:
    """Log-likelihoods at (log D/scale, log κ)."""
    diffusion, stiffness = np.empty(points.shape[0]), np.empty(points.shape[0])
    for i in range(points.shape[0]):
        diffusion[i], stiffness[i] = scale * math.exp(points[i, 0]), math.exp(points[i, 1])
    values: FloatArray = harmonic_likelihoods(track, diffusion, stiffness)
    return values
