"""How fast particles land, and how long they stay.

Landings at times t_i in [0, T] come at the rate λ(t) = λ₀ exp(−kt): the drop, or the layer above
the surface, runs out of particles at the rate k.  With λ₀ at its best, the log-likelihood is

    ℓ(k) = n ln(k/(1 − exp(−kT))) − k Σ t_i + const,

concave in k.  A ratio of likelihoods tests k = 0, and the distance of Kolmogorov and Smirnov
between the times and the fitted law whether that law describes them; diffusion out of a drop at
rest, λ ∝ t^(−1/2), does not look exponential.

A landing is paired with a leaving at the same place, of the same mass, later; each is in one pair.
Of landing i that stays at least d₀, the window of the search, a leaving is seen with the chance q_i
if it leaves before the end, c_i after d₀:

    paired, after d_i + d₀:  q_i κ exp(−κ d_i);      not:  1 − q_i (1 − exp(−κ c_i)),

so that those that still stay at the end (censored) and those whose leaving was missed are accounted
for.  How many pairs are chance is told by leavings whose places are moved by half of the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.special import chdtrc, kolmogorov

from iscat_analysis.records import FloatArray
from iscat_analysis.species.intervals import TWO_SIDED_95, interval

IndexArray: TypeAlias = NDArray[np.int64]
"""Rows of a table."""

LEAST_LANDINGS = 10
"""Fewer landings have no rate that depends on time."""

_LARGEST_RATE_TIME = 200.0  # of kT
_GRID = 400  # rates among which the maximum is looked for
_RATE_TOLERANCE = 1e-7  # of its logarithm
_SMALL = 1e-6  # of kT, below which series take over
_MASS_SIGMAS = 4.0  # standard errors between the masses of a pair


@dataclass(frozen=True)
class LandingRate:
    """How fast particles land."""

    landings: int
    seconds: float
    per_second: float
    per_second_low: float
    per_second_high: float
    depletion_per_s: float
    depletion_low: float
    depletion_high: float
    depletion_p: float
    p_value: float


@dataclass(frozen=True)
class UnbindingRate:
    """How fast particles leave."""

    landings: int
    pairs: int
    chance_pairs: int
    per_second: float
    per_second_low: float
    per_second_high: float


def landing_rate(times_s: FloatArray, seconds: float) -> LandingRate:
    """Fit the rate of landings and its depletion.

    Shapes: `times_s` (n,).
    """
    n = times_s.size
    if n < LEAST_LANDINGS:
        return LandingRate(n, seconds, *([math.nan] * 8))
    share = np.sort(times_s) / seconds
    mean = float(share.mean())

    def height(x: float) -> float:
        return n * (_log_slope(x) - x * mean)

    def rise(x: float) -> float:
        return _middle(x) - mean

    best = float(scipy.optimize.brentq(rise, -_LARGEST_RATE_TIME, _LARGEST_RATE_TIME, xtol=1e-10))
    top = height(best)
    ends = interval(
        lambda x: 2 * (top - height(x)), best, -_LARGEST_RATE_TIME, _LARGEST_RATE_TIME, step=1.0
    )
    flat = 2 * (top - height(0.0))
    # Information on ln λ₀ and x = kT: n, −n g', and that of ∫λ.
    slope = -_middle(best)
    curvature = (_middle(best + 1e-4) - _middle(best - 1e-4)) / -2e-4
    error = math.sqrt((1 + slope**2 / curvature) / n)
    rate = n / seconds * math.exp(_log_slope(best))
    law = -np.expm1(-best * share) / -math.expm1(-best) if abs(best) > _SMALL else share
    steps = np.arange(n + 1) / n
    distance = float(max(np.max(steps[1:] - law), np.max(law - steps[:-1])))
    return LandingRate(
        landings=n,
        seconds=seconds,
        per_second=rate,
        per_second_low=rate * math.exp(-TWO_SIDED_95 * error),
        per_second_high=rate * math.exp(TWO_SIDED_95 * error),
        depletion_per_s=best / seconds,
        depletion_low=ends[0] / seconds,
        depletion_high=ends[1] / seconds,
        depletion_p=float(chdtrc(1, max(flat, 0.0))),
        p_value=float(kolmogorov(math.sqrt(n) * distance)),
    )


def pair_events(
    frame: FloatArray,
    place_px: FloatArray,
    mass_kda: FloatArray,
    sigma_kda: FloatArray,
    *,
    radius_px: float,
) -> tuple[IndexArray, IndexArray]:
    """Pair landings with the leavings of the same particles.

    Shapes: `frame` (n,), `place_px` (n, 2), `mass_kda, sigma_kda` (n,), `landing, leaving`
    (pairs,).
    """
    lands, leaves = np.flatnonzero(mass_kda > 0), np.flatnonzero(mass_kda < 0)
    if not lands.size or not leaves.size:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    tree = scipy.spatial.cKDTree(place_px[lands])
    taken: dict[int, int] = {}
    for leaving in leaves[np.argsort(frame[leaves], kind="stable")]:
        near = lands[tree.query_ball_point(place_px[leaving], radius_px)]
        error = np.hypot(sigma_kda[near], sigma_kda[leaving])
        alike = np.abs(mass_kda[near] + mass_kda[leaving]) < _MASS_SIGMAS * error
        fit = [int(i) for i in near[alike & (frame[near] < frame[leaving])] if int(i) not in taken]
        if fit:
            taken[max(fit, key=lambda i: frame[i])] = int(leaving)
    order = sorted(taken)
    return np.array(order, np.int64), np.array([taken[i] for i in order], np.int64)


def unbinding_rate(
    stay_s: FloatArray, censor_s: FloatArray, detected: FloatArray, *, chance_pairs: int = 0
) -> UnbindingRate:
    """Fit the rate at which particles leave.

    Shapes: `stay_s` (n,), `censor_s` (n,), `detected` (n,).
    """
    paired = np.isfinite(stay_s)
    number, stayed = int(paired.sum()), float(stay_s[paired].sum())
    left, chance = censor_s[~paired], detected[~paired]
    longest = float(censor_s.max(initial=0.0))
    if not longest > 0:
        return UnbindingRate(stay_s.size, number, chance_pairs, math.nan, math.nan, math.nan)

    with np.errstate(divide="ignore"):  # none is missed, or none seen
        missed, seen = np.log1p(-chance), np.log(chance)

    def height(ln_rate: float) -> float:
        rate = math.exp(ln_rate)
        still = float(np.sum(np.logaddexp(missed, seen - rate * left)))
        return number * ln_rate - rate * stayed + still

    low, high = math.log(1e-6 / longest), math.log(1e6 / longest)
    best = low
    if number:
        grid = np.linspace(low, high, _GRID)
        near = int(np.argmax([height(x) for x in grid]))
        around = float(grid[max(near - 1, 0)]), float(grid[min(near + 1, grid.size - 1)])
        best = float(
            scipy.optimize.minimize_scalar(
                lambda x: -height(x),
                bounds=around,
                method="bounded",
                options={"xatol": _RATE_TOLERANCE},
            ).x
        )
    top = height(best)
    ends = interval(lambda x: 2 * (top - height(x)), best, low, high, step=1.0)
    rate, least, most = (math.exp(x) for x in (best, *ends))
    if not number:
        rate = least = 0.0
    return UnbindingRate(stay_s.size, number, chance_pairs, rate, least, most)


def _log_slope(x: float) -> float:
    """ln(x/(1 − e^(−x)))."""
    return x / 2 if abs(x) < _SMALL else math.log(x / -math.expm1(-x))


def _middle(x: float) -> float:
    """Mean of a time in [0, 1] whose density is as e^(−xt)."""
    return 0.5 - x / 12 if abs(x) < 1e-3 else 1 / x - 1 / math.expm1(x)
