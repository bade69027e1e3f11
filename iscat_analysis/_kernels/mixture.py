"""Mixture of normal distributions with an error of its own for each event: EM and likelihood.

x_i ~ Σ_k w_k N(μ_k, τ_k² + σ_i²), seen where an estimate of it exceeds a threshold.
Loops, because the arrays are a few hundred by a few.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]

_LOG_2PI = math.log(2.0 * math.pi)
_SURE = 9.0  # standard deviations above the threshold: a chance of 1 to the last digit
_TINY = 1e-250  # a density below it is added up by logarithms


@kernel()
def mixture_em(
    x: FloatArray,
    noise: FloatArray,
    weight: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
    steps: int,
) -> None:
    """Take steps of expectation and maximisation, in place.

    Parameters
    ----------
    x, noise : ndarray, shape (n,)
        Measured values and σ_i².
    weight, mean, variance : ndarray, shape (k,)
        w, μ and τ²; overwritten.
    steps : int
        How many.
    """
    n, k = x.size, weight.size
    share = np.empty(k)
    size, first, second = np.empty(k), np.empty(k), np.empty(k)
    for _ in range(steps):
        size[:] = 1e-12
        first[:] = 0.0
        second[:] = 0.0
        for i in range(n):
            top = -1e300
            for j in range(k):
                total = variance[j] + noise[i]
                d = x[i] - mean[j]
                share[j] = math.log(weight[j] + 1e-300) - 0.5 * (d * d / total + math.log(total))
                top = max(top, share[j])
            norm = 0.0
            for j in range(k):
                share[j] = math.exp(share[j] - top)
                norm += share[j]
            for j in range(k):
                r = share[j] / norm
                gain = variance[j] / (variance[j] + noise[i])
                true = gain * (x[i] - mean[j])  # from the old mean, against cancellation
                size[j] += r
                first[j] += r * true
                second[j] += r * (true * true + gain * noise[i])
        for j in range(k):
            shift = first[j] / size[j]
            mean[j] += shift
            variance[j] = max(second[j] / size[j] - shift * shift, 0.0)
            weight[j] = size[j] / n


@kernel()
def mixture_score(
    x: FloatArray, noise: FloatArray, weight: FloatArray, mean: FloatArray, variance: FloatArray
) -> tuple[float, FloatArray]:
    """Log-likelihood and its gradient.

    Parameters
    ----------
    x, noise : ndarray, shape (n,)
        Measured values and σ_i².
    weight, mean, variance : ndarray, shape (k,)
        w, μ and τ².

    Returns
    -------
    value : float
        Σ_i log Σ_k w_k N(x_i; μ_k, τ_k² + σ_i²).
    gradient : ndarray, shape (3, k)
        With respect to log w (each by itself), μ and τ².
    """
    n, k = x.size, weight.size
    gradient = np.zeros((3, k))
    share, slope, inverse = np.empty(k), np.empty(k), np.empty(k)
    value = 0.0
    for i in range(n):
        norm = 0.0
        for j in range(k):
            inverse[j] = 1.0 / (variance[j] + noise[i])
            d = x[i] - mean[j]
            slope[j] = d * inverse[j]
            share[j] = weight[j] * math.sqrt(inverse[j]) * math.exp(-0.5 * d * slope[j])
            norm += share[j]
        if norm > _TINY:
            value += math.log(norm) - 0.5 * _LOG_2PI
        else:  # far from every species: by logarithms
            top = -1e300
            for j in range(k):
                share[j] = math.log(weight[j] + 1e-300) + 0.5 * math.log(inverse[j])
                share[j] -= 0.5 * slope[j] * slope[j] / inverse[j]
                top = max(top, share[j])
            norm = 0.0
            for j in range(k):
                share[j] = math.exp(share[j] - top)
                norm += share[j]
            value += top + math.log(norm) - 0.5 * _LOG_2PI
        for j in range(k):
            r = share[j] / norm
            gradient[0, j] += r
            gradient[1, j] += r * slope[j]
            gradient[2, j] += 0.5 * r * (slope[j] * slope[j] - inverse[j])
    return value, gradient


@kernel()
def _log_normal_cdf(a: float) -> float:
    """Logarithm of Φ(a); the asymptotic series where erfc would vanish."""
    if a > -20.0:
        return math.log(0.5 * math.erfc(-a * math.sqrt(0.5)))
    b = 1.0 / (a * a)
    series = -b * (1.0 - 3.0 * b * (1.0 - 5.0 * b * (1.0 - 7.0 * b)))
    return -0.5 * a * a - math.log(-a) - 0.5 * _LOG_2PI + math.log1p(series)


@kernel()
def detection_score(
    noise: FloatArray,
    threshold: float,
    times: int,
    weight: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
) -> tuple[float, FloatArray]:
    """Logarithm of the chance to see the events, and its gradient.

    Parameters
    ----------
    noise : ndarray, shape (n,)
        s_i² of the estimate that decides.
    threshold : float
        What it must exceed.
    times : int
        How often each counts.
    weight, mean, variance : ndarray, shape (k,)
        w, μ and τ².

    Returns
    -------
    value : float
        Σ_i log Z_i, Z_i = Σ_k w_k Φ((μ_k − threshold)/√(τ_k² + s_i²)).
    gradient : ndarray, shape (3, k)
        With respect to log w (each by itself), μ and τ².
    """
    n, k = noise.size, weight.size
    gradient = np.zeros((3, k))
    at, reach, part, edge = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    value = 0.0
    for i in range(n):
        total = 0.0
        for j in range(k):
            reach[j] = 1.0 / math.sqrt(variance[j] + noise[i])
            at[j] = (mean[j] - threshold) * reach[j]
            if at[j] > _SURE:
                part[j], edge[j] = weight[j], 0.0
            else:
                part[j] = weight[j] * 0.5 * math.erfc(-at[j] * math.sqrt(0.5))
                edge[j] = weight[j] * math.exp(-0.5 * at[j] * at[j] - 0.5 * _LOG_2PI)
            total += part[j]
        if total > _TINY:
            value += math.log(total)
        else:  # hardly ever seen: by logarithms
            top = -1e300
            for j in range(k):
                part[j] = math.log(weight[j] + 1e-300) + _log_normal_cdf(at[j])
                top = max(top, part[j])
            total = 0.0
            for j in range(k):
                density = math.log(weight[j] + 1e-300) - 0.5 * at[j] * at[j] - 0.5 * _LOG_2PI
                edge[j] = math.exp(density - top)
                part[j] = math.exp(part[j] - top)
                total += part[j]
            value += top + math.log(total)
        for j in range(k):
            slope = edge[j] / total * reach[j]
            gradient[0, j] += part[j] / total
            gradient[1, j] += slope
            gradient[2, j] -= 0.5 * slope * at[j] * reach[j]
    return times * value, times * gradient
