"""Populations of spheres: a mixture of log-normal distributions of diameters.

The logarithm of a log-normal diameter is normal, so that diameters d_i with errors s_i of their
logarithm are the mixture of `mixture`,

    ln d_i ~ N(ln D_k, (ln g_k)² + s_i²),

with the median D_k and the geometric standard deviation g_k of each population, which is what the
diameters scatter beyond their errors.  It is searched and repeated as that of masses is.

The error σ_d/d falls with the diameter, as d^−p: with p = 3 for small spheres, whose light goes
with d³.  A diameter that noise made too large then seems to be well measured, and is weighted too
much: errors of 6 % moved the median by 2.4 % and a width of 12 % by a sixth.  d^p is what has the
same error everywhere, and is normal, so that the likelihood of D is

    exp(−(e^(p u) − 1)²/(2 p² σ_d²/d²)),    u = ln D − ln d.

The mixture takes the normal distribution in its place that gives the same mean and variance of ln D
together with the population that the sphere belongs to; population and distributions are found in
turn (expectation propagation: Minka, Proc. UAI 17, 362, 2001).

What is not seen is not corrected for: the light of spheres is in no simple relation to their size.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.findings import Finding, Noted
from iscat_analysis.findings.tables import LARGE_DIAMETER_ERRORS, SPHERES_LEFT_OUT
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.species.choices import Searched
from iscat_analysis.species.describe import (
    LEAST_EVENTS,
    LEAST_SPECIES,
    POINTS,
    histogram_of,
    interval_of,
    mean_density,
    plain_of,
    selection_of,
    widened,
)
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.repeats import Possible, bootstrap
from iscat_analysis.units import count

UNIT_NM = 1e-3
"""Diameters are taken over this length, so that every logarithm is positive, as `Events` asks."""

LARGEST_ERROR = 0.5
"""Relative error from which a diameter says nothing."""


@dataclass(frozen=True, eq=False)
class Sizes(Noted):
    """Populations of diameters; `describe_sizes` makes it.

    `populations` has a row for each, by rising median: diameter_nm (median), geometric_sd, fraction
    with 95 % intervals (*_low, *_high), diameter_systematic, which the interval of the median
    includes, count and outlier.  `curve` has diameter_nm and model [spheres per nm], errors
    included.
    """

    populations: pd.DataFrame
    selection: pd.DataFrame
    support: float
    histogram: pd.DataFrame
    curve: pd.DataFrame
    spheres: int
    draws: int
    seed: int
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Give what ``summary.json`` holds under ``sizes``."""
        return plain_of(self, by_column=("histogram", "curve"))


def describe_sizes(
    diameters_nm: FloatArray,
    sigmas_nm: FloatArray,
    *,
    seed: int,
    common: float = 0.0,
    draws: int = 100,
    findings: Sequence[Finding] = (),
) -> Sizes | None:
    """Describe diameters as populations; `common` is the relative error that all share.

    None where fewer than `LEAST_EVENTS` are known.

    Shapes: `diameters_nm, sigmas_nm` (n,).
    """
    known = (diameters_nm > UNIT_NM) & (sigmas_nm > 0) & (sigmas_nm < LARGEST_ERROR * diameters_nm)
    diameter, sigma = diameters_nm[known], sigmas_nm[known]
    if diameter.size < LEAST_EVENTS:
        return None
    power = _power(diameter, sigma)
    events = Events(np.log(diameter / UNIT_NM), sigma / diameter, None, plain=True)
    measured, choice = events, Searched()
    best = choice.choose(events).best
    # turns of population and distributions
    for _ in range(4):
        events = _beside(measured, power, best)
        found = choice.choose(events)
        best = found.best
    limits, k = [Possible(1.0, events, best, found.structure)], best.mean.size
    repeats, support = bootstrap(limits, found, draws=draws, least=LEAST_EVENTS, seed=seed)
    middle = interval_of([r.mixture.mean for r in repeats], k)
    low, high = widened(middle, best.mean, np.full(k, common))
    width_low, width_high = interval_of([np.sqrt(r.mixture.variance) for r in repeats], k)
    part_low, part_high = interval_of([r.mixture.weight for r in repeats], k)
    seen = best.shares(events).sum(axis=0)
    populations = pd.DataFrame(
        {
            "diameter_nm": UNIT_NM * np.exp(best.mean),
            "diameter_low": UNIT_NM * np.exp(low),
            "diameter_high": UNIT_NM * np.exp(high),
            "diameter_systematic": UNIT_NM * common * np.exp(best.mean),
            "geometric_sd": np.exp(np.sqrt(best.variance)),
            "geometric_sd_low": np.exp(width_low),
            "geometric_sd_high": np.exp(width_high),
            "fraction": best.weight,
            "fraction_low": part_low,
            "fraction_high": part_high,
            "count": seen,
            "outlier": seen < LEAST_SPECIES - 0.5,
        }
    )
    histogram = histogram_of(Events(diameter, sigma, None)).rename(
        columns={"low_kda": "low_nm", "high_kda": "high_nm"}
    )
    return Sizes(
        populations=populations,
        selection=selection_of(found, diameter.size),
        support=support,
        histogram=histogram[histogram["high_nm"] > diameter.min()],
        curve=_curve(events, best),
        spheres=int(diameter.size),
        draws=draws,
        seed=seed,
        findings=(*findings, *_doubts(known, power * sigma / diameter)),
    )


def _power(diameter: FloatArray, sigma: FloatArray) -> float:
    """Find p of σ_d/d ~ d^−p by least squares, with its prior."""
    x, y = np.log(diameter), np.log(sigma / diameter)
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y / (x @ x))
    left = float(np.mean((y - slope * x) ** 2))
    information = float(x @ x) / max(left, 1e-12)
    # the prior of p is that of small spheres, 3 ± 1
    found = (3.0 - information * slope) / (1.0 + information)
    # below it the sign of p makes no difference
    return math.copysign(max(abs(found), 1e-3), found)


def _beside(measured: Events, power: float, population: Mixture) -> Events:
    """Give the normal distributions that stand for the likelihoods beside a population."""
    own = np.argmax(population.shares(measured), axis=1)
    centre, error = population.mean[own], measured.sigma
    # of the variance of an error: a population that is narrower tells nothing else
    variance = np.maximum(population.variance[own], 0.25 * measured.variance)
    total = 1 / variance + 1 / measured.variance
    middle = (centre / variance + measured.x / measured.variance) / total
    # standard deviations
    x = middle + np.outer(np.linspace(-6.0, 6.0, 61), 1 / np.sqrt(total))
    misfit = np.expm1(power * (x - measured.x)) / (power * error)
    height = -0.5 * (misfit**2 + (x - centre) ** 2 / variance)
    weight = np.exp(height - height.max(axis=0))
    weight /= weight.sum(axis=0)
    mean = (weight * x).sum(axis=0)
    spread = (weight * (x - mean) ** 2).sum(axis=0)
    # of the information of an error, at least
    information = np.maximum(1 / spread - 1 / variance, 0.05 / measured.variance)
    mean = (mean / spread - centre / variance) / information
    return Events(mean, information**-0.5, None, plain=True)


def _curve(events: Events, best: Mixture) -> pd.DataFrame:
    """Give the density per nm that the populations and the errors make."""
    # standard deviations of the curve beyond the outermost diameters
    reach = 3.0 * float(np.median(events.sigma))
    ends = np.exp([events.x.min() - reach, events.x.max() + reach])
    diameter = np.linspace(ends[0], ends[1], POINTS)
    density = events.x.size * mean_density(events, best, np.log(diameter)) / diameter
    return pd.DataFrame({"diameter_nm": UNIT_NM * diameter, "model": density / UNIT_NM})


def _doubts(known: BoolArray, skew: FloatArray) -> Iterator[Finding]:
    """Say which diameters are left out, and where errors are too large.

    Shapes: `known` (n,), `skew` (k,), of those that are known.
    """
    if left_out := int(np.count_nonzero(~known)):
        amount = count(left_out, "sphere")
        yield SPHERES_LEFT_OUT({"amount": amount, "percent": 100 * LARGEST_ERROR})
    # p σ_d/d from which the likelihood of a diameter is not known well enough
    if np.median(np.abs(skew)) > 0.3:
        yield LARGE_DIAMETER_ERRORS()
