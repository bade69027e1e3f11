"""Mixture of peaks with an exponential tail, on a background, truncated to a window.

An event of a species is μ + e + n: e is exponential with mean |t| and the sign of t, n is normal
with variance v = τ² + σ_i².  With N the density of n at d = x − μ, t > 0 and z = d − v/t,

    f = e^(v/2t² − d/t) Φ(z/√v) / t,      t ∂f/∂x = N − f,
    g = (z f + v N/t) / t,                t ∂f/∂t = g − f,

where g contains the exponential twice (Grushka, Anal. Chem. 44, 1733, 1972).  All slopes follow.
For t far below √v these differences cancel; f is then computed from its series
Σ (t/√v)ⁿ Heₙ(d/√v) N.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]

_SHORT = 0.05  # of √v: for a shorter tail the series is used
_ORDERS = 7
_ERFC_LIMIT = 24.0  # beyond it the complementary error function vanishes
_ROOT_2PI = math.sqrt(2.0 * math.pi)
_TINY = 1e-290


@njit
def _over_normal(a: float) -> float:
    """Give Φ(a)/φ(a) for a ≤ 0."""
    y = -a * math.sqrt(0.5)
    if y < _ERFC_LIMIT:
        return math.sqrt(0.5 * math.pi) * math.exp(y * y) * math.erfc(y)
    b = 1.0 / (a * a)
    return -(1.0 - b * (1.0 - 3.0 * b * (1.0 - 5.0 * b))) / a


@njit
def _peak(d: float, v: float, t: float) -> tuple[float, float, float, float]:
    """Density at x = μ + d, and its slopes in μ, v and t."""
    sign = 1.0 if t >= 0 else -1.0
    d *= sign
    s, w = abs(t), math.sqrt(v)
    u = d / w
    normal = math.exp(-0.5 * u * u) / (_ROOT_2PI * w)
    if s < _SHORT * w:
        e = s / w
        before, here, after = 1.0, u, u * u - 1.0  # Hermite polynomials of orders n, n + 1, n + 2
        f = f_mu = f_v = f_s = 0.0
        power, lower = 1.0, 0.0  # eⁿ and n eⁿ⁻¹
        for n in range(_ORDERS):
            f += power * before
            f_mu += power * here
            f_v += power * after
            f_s += lower * before
            lower = (n + 1) * power
            power *= e
            before, here, after = here, after, u * after - (n + 2) * here
        scaled = normal / w
        by_mean, by_tail = sign * scaled * f_mu, sign * scaled * f_s
        return max(f, 0.0) * normal, by_mean, 0.5 * scaled / w * f_v, by_tail
    z = d - v / s
    a = z / w
    if a > 0:
        f = math.exp(0.5 * v / (s * s) - d / s) * 0.5 * math.erfc(-a * math.sqrt(0.5)) / s
    else:
        f = w * normal / s * _over_normal(a)
    f_x = (normal - f) / s
    f_v = 0.5 * (-d / v * normal - f_x) / s
    f_s = ((z * f + v * normal / s) / s - f) / s
    return f, -sign * f_x, f_v, sign * f_s


@kernel()
def tailed_score(
    x: FloatArray,
    noise: FloatArray,
    background: FloatArray,
    size: FloatArray,
    kind_noise: FloatArray,
    nodes: FloatArray,
    node_background: FloatArray,
    seen: FloatArray,
    weight: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
    tail: float,
    shape: FloatArray,
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Log-likelihood of the events of a window, and its slopes.

    The probability to detect the event itself is left out.  The probability to detect a particle
    with the noise of each kind of event is the sum over nodes of the density times `seen`, which
    includes the distances of the nodes.

    Shapes: `x, noise` (n,), `background` (n, b), `size, kind_noise` (c,), `nodes` (g,),
    `node_background` (g, b), `seen` (c, g), `weight` (k + 1,), `mean, variance` (k,), `shape` (b,);
    slopes in the logarithms of `weight` (k + 1,), in mean, variance and tail (3, k), in the
    logarithms of `shape` (b,) and in `seen` (c, g).
    """
    k, b = mean.size, shape.size
    by_weight, by_peak, by_shape = np.zeros(k + 1), np.zeros((3, k)), np.zeros(b)
    by_seen = np.zeros(seen.shape)
    part, slopes, flat = np.empty(k + 1), np.empty((3, k)), np.empty(b)
    value = 0.0
    for i in range(x.size):
        total = _TINY
        for j in range(k):
            f, by_mean, by_variance, by_tail = _peak(x[i] - mean[j], variance[j] + noise[i], tail)
            part[j] = weight[j] * f
            slopes[0, j] = weight[j] * by_mean
            slopes[1, j] = weight[j] * by_variance
            slopes[2, j] = weight[j] * by_tail
            total += part[j]
        part[k] = 0.0
        for m in range(b):
            flat[m] = weight[k] * shape[m] * background[i, m]
            part[k] += flat[m]
        total += part[k]
        value += math.log(total)
        over = 1.0 / total
        for j in range(k):
            by_weight[j] += part[j] * over
            for q in range(3):
                by_peak[q, j] += slopes[q, j] * over
        by_weight[k] += part[k] * over
        for m in range(b):
            by_shape[m] += flat[m] * over
    own, own_slopes, own_shape = np.empty(k + 1), np.empty((3, k)), np.empty(b)
    for c in range(size.size):
        own[:], own_slopes[:], own_shape[:] = 0.0, 0.0, 0.0
        total = _TINY
        for g in range(nodes.size):
            here = seen[c, g]
            density = 0.0
            for j in range(k):
                f, by_mean, by_variance, by_tail = _peak(
                    nodes[g] - mean[j], variance[j] + kind_noise[c], tail
                )
                f *= weight[j]
                density += f
                own[j] += f * here
                own_slopes[0, j] += weight[j] * by_mean * here
                own_slopes[1, j] += weight[j] * by_variance * here
                own_slopes[2, j] += weight[j] * by_tail * here
            for m in range(b):
                f = weight[k] * shape[m] * node_background[g, m]
                density += f
                own[k] += f * here
                own_shape[m] += f * here
            total += density * here
            by_seen[c, g] = density
        value -= size[c] * math.log(total)
        over = size[c] / total
        for j in range(k):
            for q in range(3):
                by_peak[q, j] -= own_slopes[q, j] * over
        for j in range(k + 1):
            by_weight[j] -= own[j] * over
        for m in range(b):
            by_shape[m] -= own_shape[m] * over
        for g in range(nodes.size):
            by_seen[c, g] *= -over
    return value, by_weight, by_peak, by_shape, by_seen
