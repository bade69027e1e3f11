"""Which species to look for: as many as BIC likes, a number, given masses, or a ladder.

A ladder is oligomers: n_k copies of one monomer at

    μ_k = n_k m₁ + b,

m₁ free or held, b free or zero.  Which n there are is given, or found: from all that the masses
reach, the rung with the fewest events goes as long as BIC falls.  Where no monomer is named, masses
of free species over small numbers are tried.  The heaviest with a BIC within `_BIC_TIE` of the
least is taken, for half of a monomer's mass explains as much as the monomer.

Components have widths of their own under the prior of `widths`, or one for all, and stand on the
background of `background`, which takes what is none of them.

Whether the masses are those of a ladder is asked by a likelihood ratio against the same species
with every mean free: twice the gain is χ² with as many degrees of freedom as there are means more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import chdtrc

from iscat_analysis.records import FloatArray
from iscat_analysis.species.background import broad
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.search import (
    FIRST_SHARE,
    ascend,
    by_peaks,
    fit_species,
    height,
    peaks,
    without_background,
)
from iscat_analysis.species.structure import (
    Structure,
    fit_jointly,
    free_structure,
    polish,
    structure_of,
)

Widths = Literal["common", "free"]

MOST_RUNGS = 12
"""Rungs that a ladder without given steps may have."""

_BIC_TIE = 6.0  # of BIC
_MOST_FREE_MULTIPLES = 4  # multiples that a free species may be
_REACH = 0.97  # quantile of the masses that the ladder must reach
_MOST_RELATIVE_WIDTH = 0.35  # of the mass, or of a ladder's monomer: wider is no rung
_SEARCH = np.linspace(0.85, 1.15, 31)  # of the monomer that was named


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
        best = polish(events, ascend(events, _near(events, masses))).by_mass()
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
        structure = _rungs(
            events, start, masses, np.zeros((masses.size, 0)), np.zeros((2, 0)),
            widths=self.widths, unit_kda=float(masses[0]),
        )  # fmt: skip
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
        wanted = sorted(
            {float(m / n) for m in peaks(events, free) for n in range(1, _MOST_FREE_MULTIPLES + 1)}
        )
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
            top = round(float(np.quantile(events.x, _REACH)) / monomer)
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
        begin = [1.0] if self.held else _SEARCH
        starts = [_start(events, n * monomer * s, self.background) for s in begin]
        start = max(starts, key=lambda one: height(events, one))
        structure = _rungs(
            events, start, monomer * n * self.held, np.stack([n, np.ones(n.size)], axis=1)[:, free],
            monomer * np.array([[0.5, -0.5], [2.0, 0.5]])[:, free],
            widths=self.widths, unit_kda=monomer,
        )  # fmt: skip
        best = fit_jointly(events, start, structure)
        return Chosen((best,), best, structure, held=True, steps=tuple(steps))

    def _against_free(self, events: Events, found: Chosen) -> float:
        """Test whether free masses describe the events better than those of the ladder."""
        k = len(found.steps)
        monomer = self.monomer_kda or self.values(found)[0]
        centres = found.best.mean[:k]
        structure = _rungs(
            events, found.best, np.zeros(k), np.eye(k),
            np.array([centres - 0.5 * monomer, centres + 0.5 * monomer]),
            widths=self.widths, unit_kda=monomer,
        )  # fmt: skip
        more = structure.limits.low.size - found.best.parameters
        if more <= 0:
            return math.nan
        free = fit_jointly(events, found.best, structure)
        gain = max(2 * (free.log_likelihood - found.best.log_likelihood), 0.0)
        return float(chdtrc(more, gain))


Choice = Searched | Number | Begun | Given | Ladder


def _rungs(
    events: Events,
    start: Mixture,
    origin: FloatArray,
    slopes: FloatArray,
    ranges: FloatArray,
    *,
    widths: Widths,
    unit_kda: float,
) -> Structure:
    """Make the structure of a ladder: means that are linear in m₁ and b.

    Shapes: `origin` (k,), `slopes` (k, p), `ranges` (2, p).
    """
    k, common = start.narrow, widths == "common"
    of_widths = np.ones((k, 1)) if common else np.eye(k)
    units = np.full(slopes.shape[1], float(np.median(events.sigma)))
    mean = start.mean[:k]
    widest = _MOST_RELATIVE_WIDTH * unit_kda * np.sqrt(mean / mean.min())
    return structure_of(
        start, events.usual_variance, origin, slopes, ranges, units, of_widths,
        np.full(k, widest[0]) if common else widest, prior=not common,
    )  # fmt: skip


def _start(events: Events, mean: FloatArray, background: bool) -> Mixture:
    """Start from the species near each mass, and a faint background."""
    near = _near(events, mean)
    return near.on_background(*broad(events), FIRST_SHARE) if background else near


def _near(events: Events, mean: FloatArray) -> Mixture:
    """Take the fractions of events near each mass, and the typical error as width.

    Shapes: `mean` (k,).
    """
    edges = (mean[:-1] + mean[1:]) / 2
    size = np.bincount(np.searchsorted(edges, events.x), minlength=mean.size) + 1.0
    variance = np.full(mean.size, float(np.median(events.sigma)) ** 2)
    return Mixture(size / size.sum(), mean, variance)
