"""Which species to look for: as many as BIC likes, a number, given masses, or a ladder.

A ladder is oligomers: n_k copies of one monomer at

    μ_k = n_k m₁ + b,

m₁ free or held, b free or zero.  Which n there are is given, or found: from all that the masses
reach, the rung with the fewest events goes as long as BIC falls.  Where no monomer is named, masses
of free species over small numbers are tried.  The heaviest with a BIC within `_BIC_TIE` of the
least is taken, for half of a monomer's mass explains as much as the monomer.

Components have widths of their own under the prior of `structure`, or one for all, and stand on the
background of `mixture`, which takes what is none of them.

Whether the masses are those of a ladder is asked by a likelihood ratio against the same species
with every mean free: twice the gain is χ² with as many degrees of freedom as there are means more.

The number of components: fits with one after another, until BIC stops improving.

A component that is as broad as the background belongs to it, and components whose sum has one
maximum are one species: a shoulder, as of a protein of which some lost a part, is no second
protein, and neither is what a skewed peak has beside a normal one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, ndtr

from iscat_analysis._kernels.mixture import mixture_score, mixture_sums
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import BACKGROUND, Mixture, broad
from iscat_analysis.species.structure import (
    Means,
    Structure,
    fit_jointly,
    free_structure,
    polish,
    structure_of,
    width_prior,
)

Widths = Literal["common", "free"]

MOST_RUNGS = 12
"""Rungs that a ladder without given steps may have."""

_BIC_TIE = 6.0  # of BIC
_MOST_RELATIVE_WIDTH = 0.35  # of the mass, or of a ladder's monomer: wider is no rung


@dataclass(frozen=True)
class LadderFit:
    """The monomer of a ladder."""

    steps: tuple[int, ...]
    monomer_kda: float
    monomer_se: float
    monomer_low: float
    monomer_high: float
    offset_kda: float
    offset_se: float
    offset_low: float
    offset_high: float
    held: bool
    p_value: float


@dataclass(frozen=True, eq=False)
class Chosen:
    """The chosen species, and what is known of their choice."""

    tried: tuple[Mixture, ...]
    best: Mixture
    structure: Structure
    held: bool = False
    steps: tuple[int, ...] = ()
    searched: bool = False
    p_value: float = math.nan


@dataclass(frozen=True)
class Searched:
    """The number of species with the smallest BIC."""

    most: int = 6

    def choose(self, events: Events) -> Chosen:
        """Fit one number of components after another; those that make one peak are one species."""
        fits = fit_species(events, self.most, background=not events.plain)
        best = fits[int(np.argmin([fit.bic(events.x.size) for fit in fits]))].by_mass()
        if not events.plain:
            best = by_peaks(events, without_background(events, best).by_mass())
            fits.append(best)
        return Chosen(tuple(fits), best, free_structure(events, best), searched=True)


@dataclass(frozen=True)
class Number:
    """A given number of species with free masses."""

    k: int

    def choose(self, events: Events) -> Chosen:
        """Fit this number of species."""
        fits = fit_species(events, self.k, least=self.k)
        best = fits[-1].by_mass()
        return Chosen(tuple(fits), best, free_structure(events, best))


@dataclass(frozen=True)
class Begun:
    """Species with free masses, near those that are given."""

    masses_kda: tuple[float, ...]

    def choose(self, events: Events) -> Chosen:
        """Climb from the given masses to the nearest maximum of the likelihood."""
        masses = np.sort(np.array(self.masses_kda, dtype=np.float64))
        best = polish(events, ascend(events, _start(events, masses))).by_mass()
        return Chosen((best,), best, free_structure(events, best))


@dataclass(frozen=True)
class Given:
    """Species of known masses with free fractions and widths."""

    masses_kda: tuple[float, ...]
    widths: Widths = "free"
    background: bool = True

    def choose(self, events: Events) -> Chosen:
        """Fit fractions and widths."""
        masses = np.sort(np.array(self.masses_kda, dtype=np.float64))
        start = _start(events, masses, self.background)
        held = Means(np.zeros((masses.size, 0)), np.zeros((2, 0)), masses)
        structure = _rungs(events, start, held, self.widths, float(masses[0]))
        best = fit_jointly(events, start, structure)
        return Chosen((best,), best, structure, held=True)


@dataclass(frozen=True)
class Ladder:
    """Oligomers of one monomer."""

    monomer_kda: float | None = None
    steps: tuple[int, ...] = ()
    offset: bool = False
    held: bool = False
    widths: Widths = "free"
    background: bool = True

    def choose(self, events: Events) -> Chosen:
        """Fit the ladder, and find the steps that are not given."""
        if self.monomer_kda is not None:
            return self._from(events, self.monomer_kda)
        free = Searched().choose(events).best
        # a free species may be one to four monomers
        wanted = sorted({float(m / n) for m in peaks(events, free) for n in range(1, 5)})
        least = 0.5 * float(events.x.min())
        found = [self._from(events, m) for m in wanted if m >= least]
        n = events.x.size
        bic = np.array([one.best.bic(n) for one in found])
        near = [one for one, value in zip(found, bic, strict=True) if value < bic.min() + _BIC_TIE]
        return max(near, key=lambda one: one.best.mean[0] / one.steps[0])

    def _from(self, events: Events, monomer: float) -> Chosen:
        """Find the steps of a ladder whose monomer mass is approximately known."""
        if self.steps:
            steps = tuple(sorted(self.steps))
        else:
            # quantile of the masses that the ladder must reach
            top = round(float(np.quantile(events.x, 0.97)) / monomer)
            steps = tuple(range(1, max(1, min(top, MOST_RUNGS)) + 1))
        found = self._fit(events, monomer, steps)
        tried = [found.best]
        while not self.steps and len(found.steps) > 1:
            seen = found.best.shares(events).sum(axis=0)[: len(found.steps)]
            left = tuple(n for i, n in enumerate(found.steps) if i != int(np.argmin(seen)))
            fewer = self._fit(events, self.values(found)[0], left)
            tried.append(fewer.best)
            if fewer.best.bic(events.x.size) > found.best.bic(events.x.size):
                break
            found = fewer
        return replace(found, tried=tuple(tried), p_value=self._against_free(events, found))

    def values(self, found: Chosen, mixture: Mixture | None = None) -> tuple[float, float]:
        """Monomer mass m₁ and offset b of a ladder."""
        mean = (found.best if mixture is None else mixture).mean[: len(found.steps)]
        steps = np.array(found.steps, dtype=np.float64)
        if self.held and self.monomer_kda is not None:
            return self.monomer_kda, float(np.mean(mean - steps * self.monomer_kda))
        if self.offset and steps.size > 1:
            slope, offset = np.polyfit(steps, mean, 1)
            return float(slope), float(offset)
        return float(mean[0] / steps[0]), 0.0

    def _fit(self, events: Events, monomer: float, steps: Sequence[int]) -> Chosen:
        n = np.array(steps, dtype=np.float64)
        free = [not self.held, self.offset and (self.held or n.size > 1)]
        # around the monomer that was named
        begin = [1.0] if self.held else np.linspace(0.85, 1.15, 31)
        starts = [_start(events, n * monomer * s, self.background) for s in begin]
        start = max(starts, key=partial(height, events))
        slopes = np.stack([n, np.ones(n.size)], axis=1)[:, free]
        limits = monomer * np.array([[0.5, -0.5], [2.0, 0.5]])[:, free]
        means = Means(slopes, limits, monomer * n * self.held)
        structure = _rungs(events, start, means, self.widths, monomer)
        best = fit_jointly(events, start, structure)
        return Chosen((best,), best, structure, held=True, steps=tuple(steps))

    def _against_free(self, events: Events, found: Chosen) -> float:
        """Test whether free masses describe the events better than those of the ladder."""
        k = len(found.steps)
        monomer = self.monomer_kda or self.values(found)[0]
        centres = found.best.mean[:k]
        means = Means(np.eye(k), np.array([centres - 0.5 * monomer, centres + 0.5 * monomer]))
        structure = _rungs(events, found.best, means, self.widths, monomer)
        more = structure.low.size - found.best.parameters
        if more <= 0:
            return math.nan
        free = fit_jointly(events, found.best, structure)
        gain = max(2 * (free.log_likelihood - found.best.log_likelihood), 0.0)
        return float(chdtrc(more, gain))


Choice = Searched | Number | Begun | Given | Ladder


def _rungs(
    events: Events, start: Mixture, means: Means, widths: Widths, unit_kda: float
) -> Structure:
    """Make the structure of a ladder: means that are linear in m₁ and b."""
    mean, common = start.mean[: start.narrow], widths == "common"
    widest = _MOST_RELATIVE_WIDTH * unit_kda * np.sqrt(mean / mean.min())
    noise = events.usual_variance
    return structure_of(start, noise, means, widest, common=common, prior=not common)


def _start(events: Events, mean: FloatArray, background: bool = False) -> Mixture:
    """Start from the events near each mass, with the typical error as width.

    Shapes: `mean` (k,).
    """
    edges = (mean[:-1] + mean[1:]) / 2
    size = np.bincount(np.searchsorted(edges, events.x), minlength=mean.size) + 1.0
    near = Mixture(size / size.sum(), mean, np.full(mean.size, events.usual_variance))
    return near.on_background(*broad(events), FIRST_SHARE) if background else near


FIRST_SHARE = 0.05
"""Of the background, at a start."""


def fit_species(
    events: Events, max_species: int, *, least: int = 1, background: bool = False
) -> list[Mixture]:
    """Fit 1, 2, … components, on a background; stop after two numbers without a better BIC."""
    fits: list[Mixture] = []
    for k in range(1, min(max_species, max(1, events.x.size // 5)) + 1):
        parts = np.array_split(np.sort(events.x), k)  # equal shares of the sorted events
        variance = np.array([max(part.var(), 1e-12) for part in parts])
        start = Mixture(np.full(k, 1 / k), np.array([part.mean() for part in parts]), variance)
        if background:
            start = start.on_background(*broad(events), FIRST_SHARE)
        starts = [start, *(split_starts(events, fits[-1]) if fits else ())]
        climbed = sorted((ascend(events, one) for one in starts), key=partial(height, events))
        # starts, the best after climbing
        tried = [polish(events, one) for one in climbed[-2:]]
        fits.append(max(tried, key=lambda fit: fit.log_likelihood))
        bic = [fit.bic(events.x.size) for fit in fits]
        if k >= least and len(fits) - 1 - int(np.argmin(bic)) >= 2:
            break
    return fits


def without_background(events: Events, fit: Mixture) -> Mixture:
    """Leave the background out where BIC does not like it."""
    own = slice(0, fit.narrow)
    bare = Mixture(fit.weight[own] / fit.weight[own].sum(), fit.mean[own], fit.variance[own])
    found = polish(events, bare)
    return found if found.bic(events.x.size) <= fit.bic(events.x.size) else fit


def ascend(events: Events, start: Mixture, steps: int = 40) -> Mixture:
    """EM steps without selection by the detector: a start for `structure.polish`."""
    weight, mean, variance = start.weight.copy(), start.mean.copy(), start.variance.copy()
    own, rest, noise = slice(0, start.narrow), slice(start.narrow, None), events.usual_variance
    rows, middle = width_prior(mean[own])
    precision, pull = rows.T @ rows, rows.T @ middle
    for _ in range(steps):
        sums = mixture_sums(events.x, events.variance, (weight, mean, variance))[1]
        size, first, second, _, noisy = sums[own].T
        size = size + 1e-12
        before = variance[own]
        shift = before * first / size  # from the old mean, to avoid cancellation
        square = before * (before * second + noisy) / size - shift**2
        if not events.plain:  # of ln T, n events have the information 2 n
            pulled = pull + size * np.log(np.maximum(square, 0.0) + noise)
            square = np.exp(2 * np.linalg.solve(precision + np.diag(2 * size), pulled)) - noise
        mean[own] += shift
        variance[own] = np.maximum(square, 0.0)
        weight[own] = size / events.x.size
        if start.broad:
            weight[rest] = sums[rest, 0].sum() / (events.x.size * start.broad)
    return replace(start, weight=weight / weight.sum(), mean=mean, variance=variance)


def height(events: Events, start: Mixture) -> float:
    """Log-likelihood of a start, without selection by the detector."""
    species = start.weight, start.mean, start.variance
    return float(mixture_score(events.x, events.variance, species)[0])


def by_peaks(events: Events, fit: Mixture) -> Mixture:
    """Say which components are one species, and which are background."""
    own = slice(0, fit.narrow)
    weight, mean = fit.weight[own], fit.mean[own]
    whole = np.sqrt(fit.variance[own] + events.usual_variance)
    usual = [  # of widths that grow with the root of the mass, and of such that do not
        np.exp(np.average(np.log(whole / form), weights=weight)) * form
        for form in (np.sqrt(mean), np.ones(mean.shape))
    ]
    # whole widths that the others would have
    wide = whole > 4.0 * np.maximum(*usual)
    if wide.all():
        wide[:] = False
    kind = np.full(fit.narrow, BACKGROUND)
    kept = np.flatnonzero(~wide)
    valleys = _valleys(weight[kept], mean[kept], whole[kept])
    kind[kept] = np.unique(np.searchsorted(valleys, mean[kept]), return_inverse=True)[1]
    return replace(fit, kind=tuple(kind.tolist()))


def peaks(events: Events, fit: Mixture) -> FloatArray:
    """Mass at which the peak of each species is highest (s,)."""
    found, total = fit.means()[: fit.species].copy(), fit.variance + events.usual_variance
    for number in range(fit.species):
        own = np.flatnonzero(fit.kinds == number)
        if own.size > 1:
            found[number] = top_of(fit.weight[own], fit.mean[own], total[own])
    return found


def top_of(weight: FloatArray, mean: FloatArray, total: FloatArray) -> float:
    """Find where a sum of normal densities is highest.

    Shapes: `weight, mean, total` (k,).
    """
    low, high = float(mean.min()), float(mean.max())
    # towards the highest point of a peak
    for _ in range(4):
        if high <= low:
            break
        grid = np.linspace(low, high, 41)
        top = grid[int(np.argmax(_density(grid, weight, mean, total)))]
        step = grid[1] - grid[0]
        low, high = max(low, top - step), min(high, top + step)
    return (low + high) / 2


def _density(
    grid: FloatArray, weight: FloatArray, mean: FloatArray, total: FloatArray
) -> FloatArray:
    bells: FloatArray = np.exp(-0.5 * (grid[:, None] - mean) ** 2 / total) / np.sqrt(total)
    return bells @ weight


def _valleys(weight: FloatArray, mean: FloatArray, whole: FloatArray) -> FloatArray:
    """Give the minima between the maxima of a sum of components."""
    # widths to both sides of a component in which maxima are searched, and points
    grid = np.sort((mean + np.outer(np.linspace(-4.0, 4.0, 81), whole)).ravel())
    # of a width: points that are nearer would have maxima of rounding between them
    grid = grid[np.diff(grid, prepend=-np.inf) > 1e-3 * whole.min()]
    density = _density(grid, weight, mean, whole**2)
    high = np.flatnonzero((density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])) + 1
    return np.array([grid[i + int(np.argmin(density[i:j]))] for i, j in pairwise(high)])


def split_starts(events: Events, fit: Mixture) -> list[Mixture]:
    """Add a narrow species at the largest excess of events."""
    starts, places, sigma = [], np.sort(events.x), float(np.median(events.sigma))
    whole, every = np.sqrt(fit.variance + sigma**2), np.arange(fit.narrow)
    widths = [sigma]
    if not events.plain:  # the errors may be unknown, and those of the peaks are not
        widths.append(float(whole[every].min()) / 2)
    for h in widths:
        near = np.searchsorted(places, places + h) - np.searchsorted(places, places - h)
        away = places[:, None] - fit.mean
        share = (ndtr((away + h) / whole) - ndtr((away - h) / whole)) @ fit.weight
        expected = places.size * share
        place = float(places[int(np.argmax((near - expected) / np.sqrt(expected + 1)))])
        starts.append(_replaced(fit, every, 1 / (2 * fit.narrow + 1), place, (h / 2) ** 2))
    return starts


def joined_starts(fit: Mixture) -> list[Mixture]:
    """Merge two neighbouring species."""
    starts = []
    for i in range(fit.narrow - 1):
        pair = slice(i, i + 2)
        size = fit.weight[pair].sum()
        mean = float(fit.weight[pair] @ fit.mean[pair]) / size
        square = fit.variance[pair] + (fit.mean[pair] - mean) ** 2
        rest = np.delete(np.arange(fit.narrow), pair)
        starts.append(_replaced(fit, rest, size, mean, float(fit.weight[pair] @ square) / size))
    return starts


def _replaced(
    fit: Mixture, kept: NDArray[np.intp], weight: float, mean: float, variance: float
) -> Mixture:
    """Give some of the free components of a mixture, and others, on the same background.

    Shapes: `kept` (k,).
    """
    rest = slice(fit.narrow, None)
    own = Mixture(
        np.append(fit.weight[kept], weight),
        np.append(fit.mean[kept], mean),
        np.append(fit.variance[kept], variance),
    )
    share = float(fit.weight[rest].sum())
    return own.on_background(fit.mean[rest], fit.variance[rest], share)
