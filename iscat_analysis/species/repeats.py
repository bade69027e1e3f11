"""Where the limit of detection may lie, in a table that does not say what was missed.

The chance that an event is seen where it was measured is Φ((x − T)/r).  Tables mostly begin where
detection ends: T has some value between `_PLACES` of the lightest species, each as likely as any
other, and with a probability of `_FAR` lies far below, where it makes no difference; r is as the
noise of what was measured, or less.  At each of these the mixture is fitted again, and the
likelihood says how probable that limit is: shares and counts are repeated at limits drawn from
these.  A limit within the lightest peak makes it narrower than the others, and skewed, by which it
is told.

The measurement again and again, as the fitted species would give it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy.special import log_ndtr, ndtri_exp, softmax

from iscat_analysis.records import FloatArray
from iscat_analysis.species.choices import (
    Choice,
    Chosen,
    ascend,
    height,
    joined_starts,
    peaks,
    split_starts,
)
from iscat_analysis.species.events import Edge, Events
from iscat_analysis.species.maximum import ENDS_95
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.structure import (
    Structure,
    fit_jointly,
    free_structure,
    joint_problem,
    parameters,
    polish,
)

_STEP = 0.25  # of the places: as fine as the likelihood of hundreds of events tells
_PLACES = np.arange(-2.5, 1.51, _STEP)  # of T from the peak, in widths
_SOFT = (0.0, 0.3, 0.6, 1.0)  # r in widths; the first are as sharp as a cut
_FAR = 0.35  # prior: that T lies below all of these, where it makes no difference


@dataclass(frozen=True, eq=False)
class Possible:
    """A limit of detection, how probable it is, and the species that go with it."""

    probability: float
    events: Events
    mixture: Mixture
    structure: Structure

    @cached_property
    def curvature(self) -> FloatArray:
        """Give how the likelihood bends at the species (p, p)."""
        samples = [(self.events, self.structure)]
        return joint_problem(samples).curvature(parameters(samples, [self.mixture]))


def with_edges(
    events: Events, found: Chosen, choice: Choice, least: float
) -> tuple[Chosen, list[Possible]]:
    """Choose species again where a limit is probable: without it a cut peak looks like two."""
    possible = possible_edges(events, found, least)
    if possible[0].events.efficiency is None or not found.searched:
        return found, possible
    again = choice.choose(possible[0].events)
    n = events.x.size
    # of BIC: other species, and not the same found again
    if again.best.bic(n) > possible[0].mixture.bic(n) - 0.1:
        return found, possible
    return again, possible_edges(events, again, least)


def possible_edges(events: Events, found: Chosen, least: float) -> list[Possible]:
    """Give the limits that are possible, the most probable first; `least` events make a species.

    `events` say nothing of a limit.
    """
    best = fit_jointly(events, found.best, found.structure)
    seen = best.shares(events).sum(axis=0)[: best.species]
    light = np.flatnonzero(seen >= least)
    first = int(light[np.argmin(best.means()[light])]) if light.size else 0
    middle = float(best.means()[first])
    width = math.hypot(float(best.widths()[first]), math.sqrt(events.usual_variance))
    # events that tell how far below the lightest a cut may be
    lowest = np.sort(events.x)[:10]
    gap = float(np.ptp(lowest)) / max(lowest.size - 1, 1)
    tried = [Possible(math.log(_FAR) + best.log_likelihood, events, best, found.structure)]
    near = tried[0].curvature

    def at(limit: float, soft: float, part: float, start: Mixture) -> tuple[float, Mixture]:
        edge = replace(events, efficiency=Edge.at(limit, soft))
        structure = found.structure if found.held else free_structure(edge, best)
        fit = fit_jointly(edge, start, structure, near)
        prior = math.log((1 - _FAR) * max(part, 1e-9) / (_PLACES.size * len(_SOFT)))
        tried.append(Possible(prior + fit.log_likelihood, edge, fit, structure))
        return prior + fit.log_likelihood, fit

    if gap > 0:
        # just below the lightest event
        at(float(lowest[0]) * (1 - 1e-9), 0.0, min(gap / (_STEP * width), 1.0), best)
    highest = max(one.probability for one in tried)
    for soft in _SOFT:
        fit, last = best, -math.inf
        for limit in middle + _PLACES * width:
            if limit <= 0 or (soft == 0 and limit >= lowest[0]):
                continue
            value, fit = at(limit, soft * width, 1.0, fit)
            highest = max(highest, value)
            # log-likelihood below the highest, beyond which a limit is not moved on
            if value < min(highest - 12.0, last):
                break
            last = value
    chance: FloatArray = softmax([one.probability for one in tried])  # of their logarithms
    # probability of a limit that is kept
    kept = [i for i in np.argsort(-chance, kind="stable") if chance[i] > 1e-3]
    total = chance[kept].sum()
    return [replace(tried[i], probability=float(chance[i] / total)) for i in kept]


def ratio_of_doubt(possible: list[Possible]) -> FloatArray:
    """Give the highest over the lowest share of each species that limits make possible (s,).

    Within 95 % of their probability; a share that changes because another species is missed is not
    in doubt, and has the ratio of its own chances of detection.
    """
    weight = np.array([one.probability for one in possible])
    species = possible[0].mixture.species
    seen = np.array([one.mixture.detected(one.events)[:species] for one in possible])
    came = np.array([one.mixture.came[:species] for one in possible])
    ratios = np.full(species, np.inf)
    for values in (seen, came / came.sum(axis=1, keepdims=True)):
        for number, column in enumerate(values.T):
            order = np.argsort(column)
            ends = np.searchsorted(np.cumsum(weight[order]), ENDS_95)
            low, high = column[order][np.minimum(ends, column.size - 1)]
            ratios[number] = min(ratios[number], high / max(low, 1e-300))
    return ratios


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
        # repetitions in which other numbers are tried
        if found.searched and number < 20:
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
    more = [ascend(events, start, 10) for start in split_starts(events, fit)]
    return [
        polish(events, max(starts, key=partial(height, events)))
        for starts in (more, joined_starts(fit))
        if starts
    ]
