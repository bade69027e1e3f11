"""The likelihood of the track of a freely diffusing particle, in time proportional to its length.

Each position is an average over an exposure and has its own error.  The displacements therefore
have a tridiagonal covariance, which is linear in the diffusion coefficient.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis._kernels import FAST, FloatArray, kernel
from iscat_analysis._kernels.loops import largest

Moves = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
"""Displacements (c, n) of a track, and of their covariance the diagonals beside one another: of the
errors (c, n) and (c, n − 1), and of what diffusion adds per D, (n,) and (n − 1,)."""

LOG_2PI = math.log(2.0 * math.pi)

TOGETHER = 8
"""Number of variances whose product cannot overflow, so that one logarithm is enough for them."""

_GRID_POINTS = 25


@kernel()
def displacement_likelihood(
    moves: Moves, diffusion: float
) -> tuple[float, float, float, float, float, float]:
    """Log-likelihood of displacements whose covariance is E + D·A, both tridiagonal.

    The pivots p_k and residuals z_k of its factorisation are differentiated with respect to D as
    they are made.  Because the covariance is linear in D, the second derivative of its
    log-determinant is −tr[(Σ⁻¹A)²], so that the Fisher information comes along exactly.
    """
    steps, error, error_next, rate, rate_next = moves
    axes, n = steps.shape
    total0, total1, total2 = 0.0, 0.0, 0.0
    quad0, quad1, quad2 = 0.0, 0.0, 0.0
    for c in range(axes):
        p0 = error[c, 0] + diffusion * rate[0]
        p1, p2 = rate[0], 0.0
        z0, z1, z2 = steps[c, 0], 0.0, 0.0
        for k in range(n):
            if k:
                b0 = error_next[c, k - 1] + diffusion * rate_next[k - 1]
                b1 = rate_next[k - 1]
                r0 = b0 / p0
                r1 = (b1 - r0 * p1) / p0
                r2 = -(2.0 * r1 * p1 + r0 * p2) / p0
                z2 = -(r2 * z0 + 2.0 * r1 * z1 + r0 * z2)
                z1 = -(r1 * z0 + r0 * z1)
                z0 = steps[c, k] - r0 * z0
                p2 = -(2.0 * b1 * r1 + b0 * r2)
                p1 = rate[k] - b1 * r0 - b0 * r1
                p0 = error[c, k] + diffusion * rate[k] - b0 * r0
            total0 += math.log(p0)
            total1 += p1 / p0
            total2 += p2 / p0 - (p1 / p0) ** 2
            q0 = z0 * z0 / p0
            q1 = (2.0 * z0 * z1 - q0 * p1) / p0
            q2 = (2.0 * z1 * z1 + 2.0 * z0 * z2 - 2.0 * q1 * p1 - q0 * p2) / p0
            quad0 += q0
            quad1 += q1
            quad2 += q2
    value = -0.5 * (total0 + quad0 + axes * n * LOG_2PI)
    slope, curvature = -0.5 * (total1 + quad1), -0.5 * (total2 + quad2)
    return value, slope, curvature, -0.5 * total2, total0, total1


@kernel(fastmath=FAST)
def displacement_likelihoods(moves: Moves, diffusion: FloatArray) -> FloatArray:
    """Log-likelihoods of many D at once, without derivatives.

    Each pivot needs the division by the one before it.  The pivots of several D are independent, so
    that ten D take only twice as long as one.

    Shapes: `diffusion` (m,), result (m,).
    """
    steps, error, error_next, rate, rate_next = moves
    axes, n = steps.shape
    state = np.empty((4, diffusion.size))
    p, z, product, quad = state[0], state[1], state[2], state[3]
    out = np.empty(diffusion.size)
    for i in range(diffusion.size):
        out[i] = -0.5 * axes * n * LOG_2PI
    for c in range(axes):
        for i in range(diffusion.size):
            p[i], z[i], product[i], quad[i] = 1.0, 0.0, 1.0, 0.0
        for k in range(n):
            main, turn, step = error[c, k], rate[k], steps[c, k]
            off_diagonal, off_diagonal_slope = 0.0, 0.0
            if k:
                off_diagonal, off_diagonal_slope = error_next[c, k - 1], rate_next[k - 1]
            for i in range(diffusion.size):
                band = off_diagonal + diffusion[i] * off_diagonal_slope
                ratio = band / p[i]
                z[i] = step - ratio * z[i]
                p[i] = main + diffusion[i] * turn - band * ratio
                quad[i] += z[i] * z[i] / p[i]
                product[i] *= p[i]
            if k % TOGETHER == 0 or k == n - 1:
                for i in range(diffusion.size):
                    out[i] -= 0.5 * math.log(product[i])
                    product[i] = 1.0
        for i in range(diffusion.size):
            out[i] -= 0.5 * quad[i]
    return out


@kernel()
def most_likely_diffusion(moves: Moves, scale: float) -> float:
    """Maximise the likelihood of free diffusion by Newton's method, from one or two values of D."""
    top = 2.0 * scale
    while displacement_likelihood(moves, top)[1] > 0.0:
        top *= 2.0
    grid = np.empty(_GRID_POINTS + 1)
    grid[0] = 0.0
    for k in range(_GRID_POINTS):
        # lowest value of D on the first grid over the highest
        grid[k + 1] = top * 1e-5 ** (1.0 - k / (_GRID_POINTS - 1.0))
    # a second grid is finer, between the neighbours of the best point
    for _ in range(2):
        values = displacement_likelihoods(moves, grid)
        highest = largest(values)
        best = grid[highest]
        low, high = grid[max(highest - 1, 0)], grid[min(highest + 1, grid.size - 1)]
        # steps at most, until the last one's length is small beside the scale of D
        for _ in range(20):
            there = displacement_likelihood(moves, best)
            if not there[2] < 0.0:
                break
            step = -there[1] / there[2]
            if not low <= best + step <= high:
                break
            best += step
            if abs(step) < 1e-12 * scale:
                return float(best)
        grid = np.empty(_GRID_POINTS)
        for k in range(_GRID_POINTS):
            grid[k] = low + (high - low) / (_GRID_POINTS - 1) * k
        grid[_GRID_POINTS - 1] = high
    return float(best)
