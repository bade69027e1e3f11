"""Mixture of normal distributions, in which each event has its own error: EM and likelihood.

x_i ~ Σ_k w_k N(μ_k, τ_k² + σ_i²); an event is detected if an estimate of it exceeds a threshold.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from iscat_analysis._kernels import FAST, FloatArray, kernel

Species = tuple[FloatArray, FloatArray, FloatArray]
"""Weights, means μ and variances τ² of species (k,)."""

_LOG_2PI = math.log(2.0 * math.pi)
_TINY = 1e-250  # smaller densities are added by their logarithms
_BLOCK = 128  # events whose numbers fit into the cache
# Ln 2; the first has few digits
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.90821492927058770002e-10
_POWERS_OF_HALF = np.exp2(-np.arange(1024.0))
_LAST_INDEX = np.uint32(_POWERS_OF_HALF.size - 1)


@njit(inline="always")
def _exp_falling(x: float) -> float:
    """Give exp x for −700 ≤ x ≤ 0 to 2e-16, in a form for vector registers."""
    halvings = np.int32(0.5 - x / _LN2_HIGH)
    r = (x + halvings * _LN2_HIGH) + halvings * _LN2_LOW
    value: float = 1.0 / 6227020800.0
    value = value * r + 1.0 / 479001600.0
    value = value * r + 1.0 / 39916800.0
    value = value * r + 1.0 / 3628800.0
    value = value * r + 1.0 / 362880.0
    value = value * r + 1.0 / 40320.0
    value = value * r + 1.0 / 5040.0
    value = value * r + 1.0 / 720.0
    value = value * r + 1.0 / 120.0
    value = value * r + 1.0 / 24.0
    value = value * r + 1.0 / 6.0
    value = value * r + 0.5
    value = value * r + 1.0
    value = value * r + 1.0
    value *= _POWERS_OF_HALF[np.uint32(halvings) & _LAST_INDEX]  # inside the table whatever x is
    return value


@kernel(fastmath=FAST, _nrt=False)
def _densities(
    x: FloatArray, noise: FloatArray, one: tuple[float, float, float], terms: FloatArray,
    norm: FloatArray,
) -> None:  # fmt: skip
    """Add √(2π) times the density of a species, (weight, μ, τ²), at some events to `norm`.

    Fills terms (3, n): that density, (x − μ)/(τ² + σ²) and 1/(τ² + σ²).
    """
    weight, mean, variance = one
    share, slope, inverse = terms[0], terms[1], terms[2]
    for i in range(x.size):
        over = 1.0 / (variance + noise[i])
        d = x[i] - mean
        slope[i], inverse[i] = d * over, over
        share[i] = weight * math.sqrt(over) * _exp_falling(max(-0.5 * d * d * over, -700.0))
        norm[i] += share[i]


@kernel()
def _by_logarithms(weight: FloatArray, terms: FloatArray, norm: FloatArray) -> float:
    """Compute events far from every species again; return the change of their logarithms."""
    added = 0.0
    for i in range(norm.size):
        if norm[i] > _TINY:
            continue
        top = -1e300
        for j in range(weight.size):
            share, slope, inverse = terms[j, :, i]
            share = math.log(weight[j] + 1e-300) + 0.5 * (math.log(inverse) - slope**2 / inverse)
            terms[j, 0, i] = share
            top = max(top, share)
        norm[i] = 0.0
        for j in range(weight.size):
            terms[j, 0, i] = math.exp(terms[j, 0, i] - top)
            norm[i] += terms[j, 0, i]
        added += top
    return added


@kernel()
def _expect(
    x: FloatArray, noise: FloatArray, species: Species, terms: FloatArray, norm: FloatArray
) -> float:
    """Fill the shares of each event and the reciprocal norms; return Σ log(√(2π) density)."""
    weight, mean, variance = species
    norm[:] = 0.0
    for j in range(weight.size):
        _densities(x, noise, (weight[j], mean[j], variance[j]), terms[j], norm)
    value: float = _by_logarithms(weight, terms, norm)
    for i in range(norm.size):
        value += math.log(norm[i])
        norm[i] = 1.0 / norm[i]
    return value


@kernel(fastmath=FAST, _nrt=False)
def _moments(
    terms: FloatArray, over: FloatArray, noise: FloatArray
) -> tuple[float, float, float, float, float]:
    """Sum the shares r of a species, r·slope, r·slope², r·inverse and r·inverse·σ²."""
    size = first = second = spread = noisy = 0.0
    share, slope, inverse = terms[0], terms[1], terms[2]
    for i in range(over.size):
        r = share[i] * over[i]
        size += r
        first += r * slope[i]
        second += r * slope[i] * slope[i]
        spread += r * inverse[i]
        noisy += r * inverse[i] * noise[i]
    return size, first, second, spread, noisy


@kernel()
def mixture_sums(x: FloatArray, noise: FloatArray, species: Species) -> tuple[float, FloatArray]:
    """Sum over events the terms from which EM steps and slopes are computed.

    Shapes: `x, noise` (n,), `sums` (k, 5).
    """
    n, k = x.size, species[0].size
    sums, terms, norm = np.zeros((k, 5)), np.empty((k, 3, _BLOCK)), np.empty(_BLOCK)
    value = -0.5 * n * _LOG_2PI
    for start in range(0, n, _BLOCK):
        stop = min(start + _BLOCK, n)
        here = norm[: stop - start]
        value += _expect(x[start:stop], noise[start:stop], species, terms, here)
        for j in range(k):
            found = _moments(terms[j], here, noise[start:stop])
            for m in range(5):
                sums[j, m] += found[m]
    return value, sums


@kernel()
def mixture_score(x: FloatArray, noise: FloatArray, species: Species) -> tuple[float, FloatArray]:
    """Log-likelihood and its gradient.

    Shapes: `x, noise` (n,), `gradient` (3, k).
    """
    value, sums = mixture_sums(x, noise, species)
    gradient = np.empty((3, sums.shape[0]))
    for j in range(sums.shape[0]):
        gradient[0, j] = sums[j, 0]
        gradient[1, j] = sums[j, 1]
        gradient[2, j] = 0.5 * (sums[j, 2] - sums[j, 3])
    return value, gradient


@kernel()
def _log_normal_cdf(a: float) -> float:
    """Logarithm of Φ(a); the asymptotic series if erfc would vanish."""
    if a > -20.0:
        return math.log(0.5 * math.erfc(-a * math.sqrt(0.5)))
    b = 1.0 / (a * a)
    series = -b * (1.0 - 3.0 * b * (1.0 - 5.0 * b * (1.0 - 7.0 * b)))
    return -0.5 * a * a - math.log(-a) - 0.5 * _LOG_2PI + math.log1p(series)


@kernel()
def detection_score(
    noise: FloatArray, threshold: float, times: int, species: Species
) -> tuple[float, FloatArray]:
    """Logarithm of the probability to detect the events, and its gradient.

    Shapes: `noise` (n,), `gradient` (3, k).
    """
    weight, mean, variance = species
    n, k = noise.size, weight.size
    gradient = np.zeros((3, k))
    at, reach, part, edge = np.empty(k), np.empty(k), np.empty(k), np.empty(k)
    value = 0.0
    for i in range(n):
        total = 0.0
        for j in range(k):
            reach[j] = 1.0 / math.sqrt(variance[j] + noise[i])
            at[j] = (mean[j] - threshold) * reach[j]
            # standard deviations above the threshold: the probability is 1
            if at[j] > 9.0:
                part[j], edge[j] = weight[j], 0.0
            else:
                part[j] = weight[j] * 0.5 * math.erfc(-at[j] * math.sqrt(0.5))
                edge[j] = weight[j] * math.exp(-0.5 * at[j] * at[j] - 0.5 * _LOG_2PI)
            total += part[j]
        if total > _TINY:
            value += math.log(total)
        else:  # hardly ever detected: by logarithms
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
