"""Likelihoods of a particle's track, in time proportional to its length.

Positions are averages over an exposure and have an error of their own each.  The displacements of
free diffusion then have a covariance with three bands, linear in the diffusion coefficient; those
of a particle in a harmonic well follow a filter with one number as its state.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_LOG_2PI = math.log(2.0 * math.pi)
_SHORT = 1e-2  # below, a well hardly acts during one exposure and the moments are a series


@njit(cache=True, nogil=True, error_model="numpy")
def displacement_likelihood(
    steps: FloatArray,
    error: FloatArray,
    error_next: FloatArray,
    rate: FloatArray,
    rate_next: FloatArray,
    diffusion: float,
) -> tuple[float, float, float, float, float, float]:
    """Log-likelihood of displacements whose covariance is E + D·A, both with three bands.

    The pivots p_k and residuals z_k of its factorisation are differentiated with respect to D as
    they are made.  Because the covariance is linear in D, the second derivative of its
    log-determinant is −tr[(Σ⁻¹A)²], so that the Fisher information comes along exactly.

    Parameters
    ----------
    steps : ndarray, shape (c, n)
        Displacements along each axis.
    error, error_next : ndarray, shapes (c, n) and (c, n − 1)
        Diagonal of E and the band beside it.
    rate, rate_next : ndarray, shapes (n,) and (n − 1,)
        Diagonal of A and the band beside it.
    diffusion : float
        D.

    Returns
    -------
    value, slope, curvature : float
        Log-likelihood and its first two derivatives with respect to D.
    information : float
        Fisher information on D.
    log_determinant, its_slope : float
        Of the covariance, all axes together.
    """
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
    value = -0.5 * (total0 + quad0 + axes * n * _LOG_2PI)
    slope, curvature = -0.5 * (total1 + quad1), -0.5 * (total2 + quad2)
    return value, slope, curvature, -0.5 * total2, total0, total1


@njit(cache=True, nogil=True, error_model="numpy")
def harmonic_likelihood(
    positions: FloatArray,
    variance: FloatArray,
    gaps: FloatArray,
    exposure: float,
    diffusion: float,
    stiffness: float,
) -> float:
    """Log-likelihood of the displacements of a particle in a harmonic well of unknown centre.

    The state is the place at the start of an exposure, dx = −κ x dt + √(2D) dW, in equilibrium at
    first.  A flat prior of the centre is integrated out, which leaves the density of displacements.

    Parameters
    ----------
    positions : ndarray, shape (c, n)
        Averages over each exposure, along each axis.
    variance : ndarray, shape (c, n)
        Of the error of each position.
    gaps : ndarray, shape (n − 1,)
        Time from the start of one exposure to the start of the next [s].
    exposure : float
        Its length [s].
    diffusion : float
        D.
    stiffness : float
        κ, above 0 [1/s].

    Returns
    -------
    float
        Log-likelihood.
    """
    axes, n = positions.shape
    u = stiffness * exposure
    width = diffusion / stiffness
    decay, mean, var_end, var_mean, both = 1.0, 1.0, 0.0, 0.0, 0.0
    if exposure > 0.0:
        decay = math.exp(-u)
        left = -math.expm1(-u)
        mean = left / u
        var_end = -width * math.expm1(-2.0 * u)
        both = width * left * left / u
        if u < _SHORT:
            series = 1.0 / 3.0 - u * (0.25 - u * (7.0 / 60.0 - u / 24.0))
            var_mean = 2.0 * diffusion * exposure * series
        else:
            var_mean = 2.0 * width * (u - 2.0 * left - 0.5 * math.expm1(-2.0 * u)) / (u * u)
    value: float = -0.5 * axes * (n - 1) * _LOG_2PI
    for c in range(axes):
        place, unit, spread = 0.0, 0.0, width
        log_determinant, q11, q12, q22 = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            if k:
                kept = math.exp(-stiffness * (gaps[k - 1] - exposure))
                place *= kept
                unit *= kept
                spread = width + kept * kept * (spread - width)
            s = mean * mean * spread + var_mean + variance[c, k]
            e1, e2 = positions[c, k] - mean * place, 1.0 - mean * unit
            log_determinant += math.log(s)
            q11 += e1 * e1 / s
            q12 += e1 * e2 / s
            q22 += e2 * e2 / s
            gain = (decay * mean * spread + both) / s
            place = decay * place + gain * e1
            unit = decay * unit + gain * e2
            spread = decay * decay * spread + var_end - gain * gain * s
        value -= 0.5 * (log_determinant + q11 - q12 * q12 / q22 + math.log(q22))
    return value
