"""Two samples beside each other: whether they are one, and by how much they differ.

Events of sample s come from species k with the density of `mixture`,

    A:  Σ_k w_k^A N(x; μ_k, τ_k² + σ²) / Z^A,    B:  Σ_k w_k^B N(x; μ_k + δ_k, τ_k² + σ²) / Z^B,

each with the errors and the detector of its own sample, so that samples of different noise can be
compared, and on a background whose share is its own.  Four hypotheses lie inside one another,

    same:  δ = 0, w^A = w^B      masses same:  δ = 0      fractions same:  w^A = w^B      all free,

and twice the difference of their largest log-likelihoods is χ² with as many degrees of freedom as
there are parameters less (Wilks, Ann. Math. Stat. 9, 60, 1938): "same" against all free says
whether the samples differ at all, "masses same" whether masses do, "fractions same" whether
fractions do.  Shifts and differences of fractions have the errors of the observed information of
the model in which all is free.  Which species there are is chosen on both samples together, so that
the choice does not favour a difference.

The mass of a species with fewer than `LEAST_COMPARED` events in either sample, or as broad as a
background, is not compared: it has no shift.  An error of the mass scale that the
two samples do not share is not in the test.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc

from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.species.choices import Choice, Searched
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.structure import (
    LOGIT_REACH,
    Limits,
    Optimum,
    Structure,
    information,
    maximise,
)

LEAST_COMPARED = 20
"""Events of a species in each sample, without which its masses are not compared."""

COMPARISON_COLUMNS = (
    "mass_kda", "mass_other_kda", "shift_kda", "shift_se", "shift_low", "shift_high",
    "shift_percent", "shift_percent_low", "shift_percent_high",
    "fraction", "fraction_other", "difference", "difference_se", "difference_low",
    "difference_high", "count", "count_other",
)  # fmt: skip
"""Columns of `Comparison.species`: the second sample is the other, shift and difference are the
other's less the first's, intervals are 95 %, fractions are of the particles that came."""

_TWO_SIDED_95 = 1.959964
_MOST_RELATIVE_WIDTH = 0.3  # width over mass
_TOLERANCE = 1e-9  # of the log-likelihood per event: 2·10⁻⁵ of χ² for 10 000 events


@dataclass(frozen=True)
class Test:
    """A likelihood-ratio test."""

    chi2: float
    dof: int
    p_value: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two samples beside each other; `compare` makes it.

    Attributes
    ----------
    species : pandas.DataFrame
        One row for each species by rising mass, columns `COMPARISON_COLUMNS`.
    same, same_masses, same_fractions : Test
        Of the three hypotheses, each against the model in which all is free.
    events, events_other : int
        Events of the samples.
    background, background_other : float
        Share of events of either sample that is background; 0 without one.
    """

    species: pd.DataFrame
    same: Test
    same_masses: Test
    same_fractions: Test
    events: int
    events_other: int
    background: float
    background_other: float

    def to_dict(self) -> dict[str, Any]:
        """Give everything as plain values.

        Returns
        -------
        dict
            Nested, species by row.
        """
        return {
            "events": self.events,
            "events_other": self.events_other,
            "same": asdict(self.same),
            "same_masses": asdict(self.same_masses),
            "same_fractions": asdict(self.same_fractions),
            "background": self.background,
            "background_other": self.background_other,
            "species": self.species.to_dict("records"),
        }


def compare(
    first: Events, other: Events, *, choice: Choice | None = None, start: Mixture | None = None,
    background: bool = False,
) -> Comparison:  # fmt: skip
    """Compare the species of two samples."""
    if start is None:
        pooled = Events(
            np.concatenate([first.x, other.x]),
            np.concatenate([first.sigma, other.sigma]),
            first.efficiency,
        )
        found = (Searched() if choice is None else choice).choose(pooled)
        start, background = found.best, found.background
    known = start.weight.size - int(background)
    samples = (first, other)
    seen = np.array([start.shares(events).sum(axis=0)[:known] for events in samples])
    narrow = np.sqrt(start.variance[:known]) < _MOST_RELATIVE_WIDTH * start.mean[:known]
    moves = (seen.min(axis=0) >= LEAST_COMPARED) & narrow
    free = _Hypothesis(samples, start, known, moves, own_fractions=True)
    full = free.fit(start)

    def against(*, shift: bool, own: bool) -> Test:
        narrow = _Hypothesis(samples, start, known, moves & shift, own_fractions=own)
        return free.against(full, narrow)

    a, b = (structure.mixture(full.theta) for structure in free.structures)
    shares = [
        float(mixture.shares(events).sum(axis=0)[known:].sum() / events.x.size)
        for mixture, events in zip((a, b), samples, strict=True)
    ]
    return Comparison(
        species=free.table(full, moves),
        same=against(shift=False, own=False),
        same_masses=against(shift=False, own=True),
        same_fractions=against(shift=True, own=False),
        events=first.x.size,
        events_other=other.x.size,
        background=shares[0],
        background_other=shares[1],
    )


class _Hypothesis:
    """What the two samples share.

    θ holds the logits of the species of A, of B where they are its own, the logits of both
    backgrounds, μ, the δ of species that may move, and τ².
    """

    def __init__(
        self,
        samples: tuple[Events, Events],
        start: Mixture,
        known: int,
        moves: BoolArray,
        *,
        own_fractions: bool,
    ) -> None:
        self.samples, self.known, self.moves = samples, known, np.flatnonzero(moves)
        every = start.weight.size
        logits = known - 1
        self.own = logits if own_fractions else 0
        back = every - known
        self.places = np.cumsum([0, logits, self.own, 2 * back, known, self.moves.size, known])
        p = int(self.places[-1])
        at_a, at_b, at_back, at_mean, at_shift, at_width = self.places[:-1]
        structures = []
        for sample in (0, 1):
            design, origin = np.zeros((3, every, p)), np.zeros((3, every))
            begin = at_b if sample and self.own else at_a
            design[0, 1:known, begin : begin + logits] = np.eye(logits)
            if back:
                design[0, known, at_back + sample] = 1.0
                origin[1, known], origin[2, known] = start.mean[known], start.variance[known]
            design[1, :known, at_mean : at_mean + known] = np.eye(known)
            if sample:
                design[1, self.moves, at_shift + np.arange(self.moves.size)] = 1.0
            design[2, :known, at_width:] = np.eye(known)
            structures.append(Structure(design, origin))
        self.structures = tuple(structures)
        self.limits = self._limits(start)

    def _limits(self, start: Mixture) -> Limits:
        """Limits of parameters: a mean may go halfway to its neighbours, a shift as far."""
        at_mean, at_shift, at_width = (int(place) for place in self.places[3:6])
        low = np.full(int(self.places[-1]), -LOGIT_REACH)
        high, scale = -low, np.ones(low.shape)
        unit = float(np.median(np.concatenate([events.sigma for events in self.samples])))
        mean = start.mean[: self.known]
        gap = np.diff(mean) / 2
        reach = np.concatenate([[mean[0] / 2], gap, [mean[-1] / 2]])
        reach = np.maximum(np.minimum(reach[:-1], reach[1:]), unit)
        low[at_mean:at_shift], high[at_mean:at_shift] = mean - reach, mean + reach
        low[at_shift:at_width], high[at_shift:at_width] = -reach[self.moves], reach[self.moves]
        low[at_width:] = 0.0
        spread = np.sqrt(start.variance[: self.known]) + unit
        high[at_width:] = (3 * spread) ** 2
        scale[at_mean:at_width], scale[at_width:] = unit, unit**2
        return Limits(low, high, scale)

    def theta(self, first: Mixture, other: Mixture) -> FloatArray:
        """Parameters of a similar hypothesis, converted to this one.

        Parameters of species that are nearly this hypothesis's.
        """
        k = self.known
        logits = [np.log(np.maximum(m.weight, 1e-6)) - math.log(max(m.weight[0], 1e-6))
                  for m in (first, other)]  # fmt: skip
        size = np.array([events.x.size for events in self.samples])
        shared = size @ np.array(logits) / size.sum()
        own = [logits[0][1:k], logits[1][1:k]] if self.own else [shared[1:k], np.empty(0)]
        shift = (other.mean - first.mean)[self.moves]
        back = np.array([one[k] for one in logits]) if first.weight.size > k else np.empty(0)
        middle = size @ np.array([first.mean, other.mean]) / size.sum()
        mean = np.where(np.isin(np.arange(k), self.moves), first.mean[:k], middle[:k])
        return np.concatenate([*own, back, mean, shift, first.variance[:k]])

    def fit(self, first: Mixture, other: Mixture | None = None) -> Optimum:
        """Maximise the likelihood of both samples."""
        return maximise(
            list(zip(self.samples, self.structures, strict=True)),
            self.theta(first, first if other is None else other),
            self.limits,
            tolerance=_TOLERANCE,
        )

    def against(self, full: Optimum, narrow: _Hypothesis) -> Test:
        """Test a hypothesis that this one contains, whose optimum is known."""
        dof = full.theta.size - int(narrow.places[-1])
        if not dof:
            return Test(0.0, 0, math.nan)
        nearly = narrow.fit(*(structure.mixture(full.theta) for structure in self.structures))
        chi2 = max(2 * (full.log_likelihood - nearly.log_likelihood), 0.0)
        return Test(chi2, dof, float(chdtrc(dof, chi2)))

    def table(self, full: Optimum, moves: BoolArray) -> pd.DataFrame:
        """Lay out shifts and differences with their errors."""
        k, theta = self.known, full.theta
        at_mean, at_shift = (int(place) for place in self.places[3:5])
        covariance = self._covariance(theta)
        mixtures = [structure.mixture(theta) for structure in self.structures]
        fractions, slopes = zip(*(self._fractions(i, theta) for i in (0, 1)), strict=True)
        slope = slopes[1] - slopes[0]
        error = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slope, covariance, slope), 0.0))
        shift, shift_se = np.full(k, math.nan), np.full(k, math.nan)
        relative_se = np.full(k, math.nan)
        mean = mixtures[0].mean[:k]
        for number, i in enumerate(self.moves):
            place, base = at_shift + number, at_mean + i
            shift[i] = theta[place]
            if not covariance[place, place] > 0:  # at an end of its range
                continue
            shift_se[i] = math.sqrt(covariance[place, place])
            ratio = np.zeros(theta.size)  # of δ/μ
            ratio[place], ratio[base] = 1 / mean[i], -theta[place] / mean[i] ** 2
            relative_se[i] = math.sqrt(max(float(ratio @ covariance @ ratio), 0.0))
        relative = shift / mean
        difference = fractions[1] - fractions[0]
        counts = [
            mixture.shares(events).sum(axis=0)[:k]
            for mixture, events in zip(mixtures, self.samples, strict=True)
        ]
        columns = {
            "mass_kda": mean,
            "mass_other_kda": np.where(moves, mixtures[1].mean[:k], math.nan),
            **_interval("shift", "shift_kda", shift, shift_se),
            "shift_percent": 100 * relative,
            "shift_percent_low": 100 * (relative - _TWO_SIDED_95 * relative_se),
            "shift_percent_high": 100 * (relative + _TWO_SIDED_95 * relative_se),
            "fraction": fractions[0],
            "fraction_other": fractions[1],
            **_interval("difference", "difference", difference, error),
            "count": counts[0],
            "count_other": counts[1],
        }
        return pd.DataFrame(columns, columns=list(COMPARISON_COLUMNS))

    def _fractions(self, sample: int, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fractions among the species of a sample, and their derivatives."""
        weight = self.structures[sample].mixture(theta).weight[: self.known]
        part = weight / weight.sum()
        logits = self.structures[sample].design[0, : self.known]
        return part, part[:, None] * (logits - part @ logits)

    def _covariance(self, theta: FloatArray) -> FloatArray:
        """Inverse of the observed information, without parameters at a limit."""
        samples = list(zip(self.samples, self.structures, strict=True))
        known = information(samples, theta, self.limits)
        margin = 1e-6 * (self.limits.high - self.limits.low)
        inside = (theta > self.limits.low + margin) & (theta < self.limits.high - margin)
        free = np.flatnonzero(inside & (np.diag(known) > 0))
        covariance = np.zeros(known.shape)
        covariance[np.ix_(free, free)] = np.linalg.pinv(known[np.ix_(free, free)])
        return covariance


def _interval(
    name: str, value_name: str, value: FloatArray, error: FloatArray
) -> dict[str, FloatArray]:
    return {
        value_name: value,
        f"{name}_se": error,
        f"{name}_low": value - _TWO_SIDED_95 * error,
        f"{name}_high": value + _TWO_SIDED_95 * error,
    }
