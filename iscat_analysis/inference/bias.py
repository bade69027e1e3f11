"""The bias of maximum likelihood of order 1/N, which faint particles show.

A position that is fitted follows the noise to where it adds to the particle, so that the amplitude
comes out too large, by about 1/SNR²: 1 % at 10, 11 % at 3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.scoring import CONDITIONAL, FLOOR
from iscat_analysis.inference.likelihood import LEVEL, Derivatives, Likelihood

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def first_order_bias(
    likelihood: Likelihood, theta: FloatArray, free: BoolArray, derivatives: Derivatives
) -> FloatArray:
    """Bias of the maximum-likelihood estimate, to order 1/N.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    theta : ndarray, shape (5,)
        Where it has its maximum.
    free : ndarray of bool, shape (5,)
        What was fitted and does not lie on a wall.
    derivatives : Derivatives
        Of the signal at θ.

    Returns
    -------
    ndarray, shape (5,)
        Expected estimate minus truth; 0 where not free.

    Notes
    -----
    For counts of an exponential family with natural parameter η(θ) and variance V(η),
    −½ F⁻¹ Σ ∂η [V′ tr(F⁻¹ ∂η ∂ηᵀ) + V tr(F⁻¹ ∂²η)], the sum over pixels: D. R. Cox and E. J. Snell,
    J. R. Stat. Soc. B 30, 248 (1968), in the form of M. J. Box, ibid. 33, 171 (1971).
    """
    index = np.flatnonzero(free)
    signal, first, second = derivatives
    _, c1, c2, c3 = likelihood.data
    used = likelihood.used
    level = np.exp(theta[LEVEL])
    gradient = np.zeros((5, *signal.shape))
    bend = np.zeros((5, 5, *signal.shape))
    if likelihood.kind == CONDITIONAL:
        bright = np.maximum(1 + signal, FLOOR)  # η = ln ρ + level + ln(1 + s)
        odds = c2 * level * bright
        variance = c3 * c1 * odds / (1 + odds) ** 2
        skewness = variance * (1 - odds) / (1 + odds)
        gradient[:4], gradient[LEVEL] = first / bright, 1.0
        bend[:4, :4] = second / bright - gradient[:4, None] * gradient[None, :4]
    else:
        light = level * (c1 + c2 * signal)  # η = ln(light + read variance)
        rate = np.maximum(light + c3, FLOOR)
        variance = skewness = rate
        gain = level * c2 / rate
        gradient[:4], gradient[LEVEL] = gain * first, light / rate
        bend[:4, :4] = gain * second
        bend[LEVEL, :4] = bend[:4, LEVEL] = gain * first
        bend[LEVEL, LEVEL] = light / rate
        bend -= gradient[:, None] * gradient[None]
    slope = gradient[index][:, used]
    variance, skewness = variance[used], skewness[used]
    fisher = (slope * variance) @ slope.T
    unit = 1 / np.sqrt(np.maximum(np.diag(fisher), FLOOR))
    inverse = np.linalg.pinv(fisher * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit)
    curved = np.einsum("ij,ijp->p", inverse, bend[np.ix_(index, index)][:, :, used])
    skewed = np.einsum("ij,ip,jp->p", inverse, slope, slope)
    out = np.zeros(5)
    out[index] = -0.5 * inverse @ (slope @ (skewness * skewed + variance * curved))
    return out
