"""Mixture of normal distributions with an error of its own for each event: EM and likelihood.

x_i ~ Σ_k w_k N(μ_k, τ_k² + σ_i²).  Loops, because the arrays are a few hundred by a few.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_LOG_2PI = math.log(2.0 * math.pi)


@njit(cache=True, nogil=True, error_model="numpy")
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


@njit(cache=True, nogil=True, error_model="numpy")
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
    share = np.empty(k)
    value = 0.0
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
        value += top + math.log(norm) - 0.5 * _LOG_2PI
        for j in range(k):
            r = share[j] / norm
            total = variance[j] + noise[i]
            z = (x[i] - mean[j]) / total
            gradient[0, j] += r
            gradient[1, j] += r * z
            gradient[2, j] += 0.5 * r * (z * z - 1.0 / total)
    return value, gradient
