"""Likelihood of a pixel under each noise model: only these kernels depend on the noise model.

Parameters are θ = (x, y, z, a, g): position [nm], amplitude, and the logarithm of a common level
that multiplies the expected counts.  `data` (4, …) holds, by noise model:

CONDITIONAL  (d, n, ρ, κ): d of the n = b + d counts came after landing, p = q/(1+q) with
             q = ρ e^g (1+s); the unknown background has dropped out (physics.md, section 4).
             ℓ = κ [d ln q − n ln(1+q)], κ ≤ 1 the share of the variance that is not read noise.
POISSON      (d, α, β, v): λ = e^g (α + β s) + v, ℓ = d ln λ − λ; v is read-noise variance, added to
             the counts d as well (Huang et al., Nat. Methods 10, 653, 2013).

ℓ is relative to its value without a particle.  A masked pixel has all four entries zero, and the
third is above zero in every other pixel.

A new noise law needs a number, and a branch in each of these functions.  The other kernels pass
the number on; `iscat_analysis.inference.laws` defines it, and takes its formulas from here.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from iscat_analysis._kernels import FAST, FloatArray, kernel

CONDITIONAL, POISSON = 0, 1

Measured = tuple[int, FloatArray]
"""The number of a noise model, and its data."""

SERIES = 0.2
"""Largest |x| for which ln(1+x) is computed from its series."""

FLOOR = 1e-150
"""Smallest expected count or intensity: keeps quotients and their squares finite if a dark fringe
or a masked pixel is exactly zero."""
_WHOLE = 1e-9  # rounding of whole counts


@njit(inline="always")
def twice_artanh(w: float) -> float:
    """ln(1+x) for w = x/(2+x), by its series; 1e-16 for |x| < SERIES."""
    w2 = w * w
    tail = 1 / 3 + w2 * (1 / 5 + w2 * (1 / 7 + w2 * (1 / 9 + w2 * (1 / 11 + w2 / 13))))
    return 2.0 * w * (1.0 + w2 * tail)


@kernel(fastmath=FAST, _nrt=False)
def value_of_pixels(
    kind: int, data: FloatArray, first: int, last: int, level: float, s: FloatArray
) -> float:
    """Log-likelihood of some pixels of data (4, n); their signals are the first of s."""
    c0, c1 = data[0, first:last], data[1, first:last]
    c2, c3 = data[2, first:last], data[3, first:last]
    total, beyond = 0.0, 0  # a count, since a maximum would prevent vector registers
    if kind == CONDITIONAL:
        for j in range(c0.size):
            beyond += abs(level * (1.0 + s[j]) - 1.0) >= SERIES
        if not beyond:
            for j in range(c0.size):
                change = level * (1.0 + s[j]) - 1.0
                part = change * c2[j]
                one, other = 2.0 + change, 2.0 * (1.0 + c2[j]) + part
                per = 1.0 / (one * other)  # one division for both quotients, since it is slow
                now, later = twice_artanh(change * other * per), twice_artanh(part * one * per)
                total += c3[j] * (c0[j] * now - c1[j] * later)
        else:
            for j in range(c0.size):
                stretch = max(level * (1.0 + s[j]), FLOOR)
                share = c2[j] / (1.0 + c2[j])
                total += c3[j] * (
                    c0[j] * np.log(stretch) - c1[j] * np.log1p((stretch - 1.0) * share)
                )
        return total
    for j in range(c0.size):
        base = c1[j] + c3[j]
        rate = level * (c1[j] + c2[j] * s[j]) + c3[j]
        beyond += abs(rate - base) >= SERIES * max(base, FLOOR)
    if not beyond:
        for j in range(c0.size):
            base = max(c1[j] + c3[j], FLOOR)
            change = level * (c1[j] + c2[j] * s[j]) + c3[j] - base
            total += c0[j] * twice_artanh(change / (2.0 * base + change)) - change
    else:
        for j in range(c0.size):
            base = max(c1[j] + c3[j], FLOOR)
            rate = level * (c1[j] + c2[j] * s[j]) + c3[j]
            total += c0[j] * np.log(max(rate, FLOOR) / base) - (rate - base)
    return total


@njit(inline="always")
def score_of_pixel(
    kind: int, c0: float, c1: float, c2: float, c3: float, level: float, s: float
) -> tuple[float, float, float]:
    """Give ∂ℓ/∂s, the expected information about s, and the ratio of ∂/∂g and ∂/∂s."""
    if kind == CONDITIONAL:
        bright = max(1.0 + s, FLOOR)
        part = 1.0 / (1.0 + c2 * level * bright)
        p = 1.0 - part
        per = 1.0 / bright
        pull = c3 * (c0 - c1 * p) * per
        bend = c3 * c1 * p * part * per * per
    else:
        gain = level * c2
        expected = level * (c1 + c2 * s)
        per = 1.0 / max(expected + c3, FLOOR)
        pull = gain * (c0 * per - 1.0)
        bend = gain * gain * per
        bright = expected / max(gain, FLOOR)
    return pull, bend, bright


@kernel()
def score_of_pixels(
    kind: int, data: FloatArray, level: float, s: FloatArray, out: FloatArray
) -> None:
    """Fill out (3, n) with what `score_of_pixel` gives of the pixels of data (4, n)."""
    for j in range(s.size):
        c0, c1, c2, c3 = data[0, j], data[1, j], data[2, j], data[3, j]
        out[0, j], out[1, j], out[2, j] = score_of_pixel(kind, c0, c1, c2, c3, level, s[j])


@kernel(fastmath=FAST)
def curvature_of_row(
    kind: int, data: FloatArray, row: int, level: float, s: FloatArray, t: FloatArray
) -> float:
    """Fill t (3, nx) with ∂ℓ/∂s, ∂²ℓ/∂s² and ∂²ℓ/∂s∂g, and return the sum of ∂²ℓ/∂g².

    A masked pixel adds 0, as its quotients and their squares are finite, see `FLOOR`.
    """
    c0, c1, c2, c3 = data[0, row], data[1, row], data[2, row], data[3, row]
    total = 0.0
    if kind == CONDITIONAL:
        for j in range(s.size):
            bright = max(1.0 + s[j], FLOOR)
            part = 1.0 / (1.0 + c2[j] * level * bright)
            p = 1.0 - part
            per = 1.0 / bright
            spread = c3[j] * c1[j] * p * part
            t[0, j] = c3[j] * (c0[j] - c1[j] * p) * per
            t[1, j] = c3[j] * (c1[j] * p * p - c0[j]) * per * per
            t[2, j] = -spread * per
            total -= spread
        return total
    for j in range(s.size):
        gain = level * c2[j]
        light = level * (c1[j] + c2[j] * s[j])
        rate = max(light + c3[j], FLOOR)
        per = 1.0 / rate
        excess, weight = (c0[j] - rate) * per, c0[j] * per * per
        t[0, j] = gain * excess
        t[1, j] = -gain * gain * weight
        t[2, j] = gain * excess - light * gain * weight
        total += light * excess - light * light * weight
    return total


@njit(inline="always")
def bias_of_pixel(
    kind: int, c1: float, c2: float, c3: float, level: float, s: float,
    squared: float, bent: float, crossed: float, alone: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Give V′ tr(F⁻¹ ∂η ∂ηᵀ) + V tr(F⁻¹ ∂²η) of one pixel, and ∂η/∂s and ∂η/∂g.

    η is the natural coordinate of its law.  The traces of the signal are `squared`, of ∂s ∂sᵀ,
    `bent`, of ∂²s, `crossed`, twice the row of the level, and `alone`, the level itself.
    """
    if kind == CONDITIONAL:  # η = ln ρ + g + ln(1 + s)
        per = 1.0 / max(1.0 + s, FLOOR)
        part = 1.0 / (1.0 + c2 * level * max(1.0 + s, FLOOR))
        variance = c3 * c1 * (1.0 - part) * part
        square = squared * per * per
        skewed = square + crossed * per + alone
        both = variance * ((2.0 * part - 1.0) * skewed + bent * per - square)
        by_level = 1.0
    else:  # η = ln(light + read variance)
        light = level * (c1 + c2 * s)
        rate = max(light + c3, FLOOR)
        per, by_level = level * c2 / rate, light / rate
        both = rate * (per * (bent + crossed) + alone * by_level)
    return both, per, by_level


@kernel(fastmath=FAST)
def residuals_of_row(
    kind: int,
    data: FloatArray,
    row: int,
    level: float,
    s: FloatArray,
    rate: FloatArray,
    residual: FloatArray,
    t: FloatArray,
) -> None:
    """Fill the expected counts, the residuals in standard deviations, and t (4, nx).

    t holds the information about a relative change of the light, its score, ∂/∂s of the logarithm
    of the light, and the excess kurtosis of the counts.
    """
    c0, c1, c2, c3 = data[0, row], data[1, row], data[2, row], data[3, row]
    for j in range(s.size):
        if kind == CONDITIONAL:
            bright = max(1.0 + s[j], FLOOR)
            part = 1.0 / (1.0 + c2[j] * level * bright)
            rate[j] = c1[j] * (1.0 - part)
            t[0, j] = c3[j] * rate[j] * part
            t[1, j] = (c0[j] - rate[j]) * c3[j]
            t[2, j] = 1.0 / bright
            total = c1[j] if c1[j] > 0 else 1.0
            t[3, j] = c3[j] * (1.0 / max(rate[j] * part, 1.0) - 6.0 / total)
        else:
            # With read noise, a measured background may be below zero.
            raw = level * (c1[j] + c2[j] * s[j])
            used = c2[j] > 0
            light = max(raw, FLOOR) if used else 0.0
            rate[j] = max(raw + c3[j], FLOOR)
            t[0, j] = light * light / rate[j]
            t[1, j] = light * (c0[j] - rate[j]) / rate[j]
            # expected light below which a pixel has no information on relative changes
            t[2, j] = c2[j] * level / light if light > 1e-100 else 0.0
            t[3, j] = 1.0 / rate[j] if used else 0.0
    if kind == CONDITIONAL:
        for j in range(s.size):
            residual[j] = t[1, j] / max(np.sqrt(t[0, j]), FLOOR)
    else:
        for j in range(s.size):
            residual[j] = (c0[j] - rate[j]) / np.sqrt(rate[j]) if c2[j] > 0 else 0.0


@njit(inline="always")
def variance_of_pixel(kind: int, total: float, share: float, mean: float) -> float:
    """Variance of a count that expects `mean`; `total` and `share` are c1 and c3 of the data."""
    return share * mean * (1.0 - mean / total) if kind == CONDITIONAL else mean


@njit(inline="always")
def tail_of_pixel(
    kind: int, observed: float, total: float, share: float, mean: float, above: bool
) -> tuple[bool, float, float, float]:
    """Give the arguments of the exact tail probability beyond a count, and whether there is one.

    `NoiseLaw.tails` computes the probability.
    """
    if kind == CONDITIONAL:
        # read noise reduces the counts by its share of the variance, as if they were lost
        n, k, p = share * total, share * (observed if above else total - observed), mean / total
        a = min(max(k, 1e-9), n)
        known, b, x = k > 0.0, n - a + 1.0, p if above else 1.0 - p
    else:
        k = max(np.floor(observed + _WHOLE), 0.0)
        known, a, b, x = k > 0.0 or not above, k if above else k + 1.0, mean, 1.0 if above else 0.0
    return known, a, b, x
