"""The measurement again and again, as the fitted species would give it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from iscat_analysis.distribution.events import Events
from iscat_analysis.distribution.mixture import Mixture, climb, height, polish
from iscat_analysis.distribution.search import joined_starts, split_starts
from iscat_analysis.records import FloatArray

_TRIES = 50
_SUPPORT_DRAWS = 20
_RIVAL_EVALUATIONS = 150


@dataclass(frozen=True, eq=False)
class Repeat:
    """One repetition.

    Attributes
    ----------
    mixture : Mixture
        Fitted to it.
    count, corrected : ndarray, shape (k,)
        Events of each species that were seen, and that came.
    """

    mixture: Mixture
    count: FloatArray
    corrected: FloatArray


def bootstrap(
    events: Events, best: Mixture, *, draws: int, least: int, seed: int
) -> tuple[list[Repeat], float]:
    """Fit simulated repetitions; in some of them let BIC choose between neighbouring numbers.

    Parameters
    ----------
    events : Events
        What was seen.
    best : Mixture
        By rising mass.
    draws : int
        Repetitions.
    least : int
        Events in a repetition, at least.
    seed : int
        Chooses the random numbers.

    Returns
    -------
    repeats : list of Repeat
        Their species in the order of `best`.
    support : float
        Share of those asked in which BIC chose the same number; NaN where none was.
    """
    rng = np.random.default_rng(seed)
    repeats, agreed = [], []
    for number in range(draws):
        drawn = _draw(events, best, max(least, int(rng.poisson(events.x.size))), rng)
        fit = polish(drawn, best)  # from the estimate, so that species keep their places
        repeats.append(Repeat(fit, fit.shares(drawn).sum(axis=0), fit.weight * fit.arrived(drawn)))
        if number < _SUPPORT_DRAWS:
            n = drawn.x.size
            agreed.append(
                all(fit.bic(n) <= rival.bic(n) for rival in _rivals(drawn, fit.by_mass()))
            )
    return repeats, float(np.mean(agreed)) if agreed else math.nan


def _draw(events: Events, mixture: Mixture, wanted: int, rng: np.random.Generator) -> Events:
    """Events as the mixture would give them, detected as the real ones were."""
    xs: list[FloatArray] = []
    sigmas: list[FloatArray] = []
    have = 0
    for _ in range(_TRIES):
        size = 2 * wanted
        species = rng.choice(mixture.weight.size, size, p=mixture.weight)
        sigma = rng.choice(events.sigma, size)
        true = rng.normal(mixture.mean[species], np.sqrt(mixture.variance[species]))
        x = rng.normal(true, sigma)
        if events.efficiency is not None:
            estimate = rng.normal(x, events.efficiency.extra_sigma(sigma))
            kept = estimate > events.efficiency.threshold_kda
            x, sigma = x[kept], sigma[kept]
        xs.append(np.abs(x))
        sigmas.append(sigma)
        have += x.size
        if have >= wanted:
            break
    return Events(np.concatenate(xs)[:wanted], np.concatenate(sigmas)[:wanted], events.efficiency)


def _rivals(events: Events, fit: Mixture) -> list[Mixture]:
    """Fit one species more and, where there are two or more, one less."""
    more = [climb(events, start) for start in split_starts(events, fit)]
    return [
        polish(events, max(starts, key=lambda start: height(events, start)), _RIVAL_EVALUATIONS)
        for starts in (more, joined_starts(fit))
        if starts
    ]
