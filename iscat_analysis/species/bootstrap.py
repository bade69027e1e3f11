"""The measurement again and again, as the fitted species would give it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, ndtri_exp

from iscat_analysis.records import FloatArray
from iscat_analysis.species.choices import Chosen
from iscat_analysis.species.edges import Possible
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.search import ascend, height, joined_starts, peaks, split_starts
from iscat_analysis.species.structure import fit_jointly, polish

_SUPPORT_DRAWS = 20
_RIVAL_STEPS = 10


@dataclass(frozen=True, eq=False)
class Repeat:
    """One repetition."""

    mixture: Mixture
    count: FloatArray
    corrected: FloatArray
    mass: FloatArray


def bootstrap(
    possible: Sequence[Possible], found: Chosen, *, draws: int, least: int, seed: int
) -> tuple[list[Repeat], float]:
    """Fit simulated repetitions; in some of them let BIC choose between neighbouring numbers.

    Where the limit of detection is not known, each repetition has one of those that are possible.
    """
    rng = np.random.default_rng(seed)
    repeats, agreed = [], []
    chance = np.cumsum([one.probability for one in possible])
    places = (rng.permutation(draws) + 0.5) / draws if len(possible) > 1 else np.zeros(draws)
    for number, place in enumerate(places):
        one = possible[int(np.searchsorted(chance[:-1], place, side="right"))]
        events, best = one.events, one.mixture
        drawn = draw_events(events, best, max(least, int(rng.poisson(events.x.size))), rng)
        # from the estimate, so that species keep their places
        fit = fit_jointly(drawn, best, one.structure, one.curvature)
        repeats.append(
            Repeat(
                fit, fit.shares(drawn).sum(axis=0), fit.came * fit.arrived(drawn), peaks(drawn, fit)
            )
        )
        if found.searched and number < _SUPPORT_DRAWS:
            n = drawn.x.size
            agreed.append(
                all(fit.bic(n) <= rival.bic(n) for rival in _rivals(drawn, fit.by_mass()))
            )
    return repeats, float(np.mean(agreed)) if agreed else math.nan


def draw_events(events: Events, mixture: Mixture, n: int, rng: np.random.Generator) -> Events:
    """Draw events as the mixture would give them, each detected and with a real event's noise.

    Notes
    -----
    Species and the filter's estimate y are drawn given detection, y > u·σ_d, and x given y: however
    unlikely a species is to be seen, no draw is thrown away.
    """
    which = rng.integers(events.x.size, size=n)
    sigma, efficiency = events.sigma[which], events.efficiency
    blank = replace(events, x=np.zeros(n), sigma=sigma)
    seen = mixture.weight * mixture.chance(blank)
    steps = np.cumsum(seen, axis=1) / seen.sum(axis=1, keepdims=True)
    species = (rng.random((n, 1)) > steps[:, :-1]).sum(axis=1)
    mean, spread = mixture.mean[species], mixture.variance[species] + blank.variance
    if efficiency is None:
        return replace(events, x=np.abs(rng.normal(mean, np.sqrt(spread))), sigma=sigma)
    total = spread + efficiency.extra_sigma(sigma) ** 2
    reach = np.sqrt(total)
    tail = np.log1p(-rng.random(n)) + log_ndtr((mean - efficiency.threshold_kda) / reach)
    estimate = -reach * ndtri_exp(tail)  # less the mean
    left = np.sqrt(spread * (total - spread) / total)
    x = rng.normal(mean + spread / total * estimate, left)
    return replace(events, x=np.abs(x), sigma=sigma)


def _rivals(events: Events, fit: Mixture) -> list[Mixture]:
    """Fit one species more and, where there are two or more, one less."""
    more = [ascend(events, start, _RIVAL_STEPS) for start in split_starts(events, fit)]
    return [
        polish(events, max(starts, key=lambda start: height(events, start)))
        for starts in (more, joined_starts(fit))
        if starts
    ]
