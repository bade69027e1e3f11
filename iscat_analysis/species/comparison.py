"""Two samples beside each other: whether they are one, and by how much they differ.

Events of sample s come from species k with the density of `mixture`,

    A:  Σ_k w_k^A N(x; μ_k, τ_k² + σ²) / Z^A,    B:  Σ_k w_k^B N(x; μ_k + δ_k, τ_k² + σ²) / Z^B,

each with the errors and the detector of its own sample, so that samples of different noise can be
compared, and on a background whose share is its own.  Components that make one peak are one
species: they move together, and their parts of it are the same in both samples.  Four hypotheses
lie inside one another,

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
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import chdtrc

from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.species.choices import peaks
from iscat_analysis.species.describe import plain_of
from iscat_analysis.species.events import Events
from iscat_analysis.species.maximum import TWO_SIDED_95, Maximum
from iscat_analysis.species.mixture import Mixture
from iscat_analysis.species.structure import Means, maximise_jointly, structure_of

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
        return plain_of(self)


def compare(first: Events, other: Events, start: Mixture) -> Comparison:
    """Compare two samples that hold the species of `start`."""
    known, samples = start.species, (first, other)
    seen = np.array([start.shares(events).sum(axis=0)[:known] for events in samples])
    # largest width over mass of a species that is compared
    narrow = start.widths()[:known] < 0.3 * start.means()[:known]
    moves = (seen.min(axis=0) >= LEAST_COMPARED) & narrow
    noise = float(np.median(np.concatenate([events.variance for events in samples])))
    free = _Hypothesis(samples, start, moves, noise, own_fractions=True)
    full = maximise_jointly(free.structures, [start, start])

    def against(*, shift: bool, own: bool) -> Test:
        narrow = _Hypothesis(samples, start, moves & shift, noise, own_fractions=own)
        return free.against(full, narrow)

    shares = [
        float(structure.mixture(full.theta).shares(events)[:, known:].sum() / events.x.size)
        for events, structure in free.structures
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
    backgrounds, those of components within their species, μ, the δ of species that may move, and
    ln T.  A mean may go halfway to its neighbours, a shift as far.
    """

    def __init__(
        self,
        samples: tuple[Events, Events],
        start: Mixture,
        moves: BoolArray,
        noise: float,
        *,
        own_fractions: bool,
    ) -> None:
        self.known, self.moves = start.species, np.flatnonzero(moves)
        k, of, belongs, unit = start.narrow, start.kinds, start.belongs, math.sqrt(noise)
        inner = [i for i in range(k) if of[i] in of[i + 1 :]]
        reach = self._reach(start.mean[:k], unit)
        shift = self._reach(start.means()[: self.known], unit)[self.moves]
        at = np.append(start.mean[:k], np.zeros(shift.size))
        reach = np.append(reach, shift)
        limits = np.array([at - reach, at + reach])
        self.structures = []
        for number, events in enumerate(samples):
            own = np.eye(2)[[number]]
            logits = np.hstack(
                [
                    np.kron(own if own_fractions else np.ones((1, 1)), belongs[:, 1 : self.known]),
                    np.kron(own, belongs[:, self.known :]),
                    np.eye(of.size)[:, inner],
                ]
            )
            slopes = np.hstack([np.eye(k), number * belongs[:k, self.moves]])
            means, widest = Means(slopes, limits), 3 * (np.sqrt(start.variance[:k]) + unit)
            structure = structure_of(start, noise, means, widest, logits=logits)
            self.structures.append((events, structure))
        self.at_mean = logits.shape[1]

    @staticmethod
    def _reach(mean: FloatArray, unit: float) -> FloatArray:
        """Half the distance of each mean to the nearer of its neighbours.

        Shapes: `mean` (k,), result (k,).
        """
        order = np.argsort(mean)
        gap = np.diff(mean[order]) / 2
        reach = np.concatenate([[mean[order[0]] / 2], gap, [mean[order[-1]] / 2]])
        found = np.empty(mean.shape)
        found[order] = np.maximum(np.minimum(reach[:-1], reach[1:]), unit)
        return found

    def mixtures(self, theta: FloatArray) -> list[Mixture]:
        """Make the components of both samples."""
        return [structure.mixture(theta) for _, structure in self.structures]

    def against(self, full: Maximum, narrow: _Hypothesis) -> Test:
        """Test a hypothesis that this one contains, whose optimum is known."""
        dof = full.theta.size - narrow.structures[0][1].low.size
        if not dof:
            return Test(0.0, 0, math.nan)
        nearly = maximise_jointly(narrow.structures, self.mixtures(full.theta))
        chi2 = max(2 * (full.value - nearly.value), 0.0)
        return Test(chi2, dof, float(chdtrc(dof, chi2)))

    def table(self, full: Maximum, moves: BoolArray) -> pd.DataFrame:
        """Lay out shifts and differences with their errors."""
        k, theta = self.known, full.theta
        covariance, mixtures = full.covariance(), self.mixtures(theta)
        fractions, slopes = zip(*(self._fractions(i, theta) for i in (0, 1)), strict=True)
        difference, slope = fractions[1] - fractions[0], slopes[1] - slopes[0]
        error = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", slope, covariance, slope), 0.0))
        first = mixtures[0]
        mean = peaks(self.structures[0][0], first)
        shift, shift_se, relative_se = (np.full(k, math.nan) for _ in range(3))
        places = self.at_mean + first.narrow + np.arange(self.moves.size)
        variance = np.diag(covariance)[places]
        shift[self.moves] = theta[places]
        shift_se[self.moves] = np.sqrt(np.where(variance > 0, variance, math.nan))  # at an end: NaN
        for i, place in zip(self.moves, places, strict=True):
            ratio = np.zeros(theta.size)  # of δ/μ
            ratio[place] = 1 / mean[i]
            own = np.flatnonzero(first.kinds == i)
            part = first.weight[own] / first.weight[own].sum()
            ratio[self.at_mean + own] = -theta[place] / mean[i] ** 2 * part
            relative_se[i] = math.sqrt(max(float(ratio @ covariance @ ratio), 0.0))
        relative_se[np.isnan(shift_se)] = math.nan
        counts = [
            mixture.shares(events).sum(axis=0)[:k]
            for mixture, (events, _) in zip(mixtures, self.structures, strict=True)
        ]
        columns = {
            "mass_kda": mean,
            "mass_other_kda": np.where(moves, mean + shift, math.nan),
            "shift_kda": shift,
            **_errors("shift", shift, shift_se),
            "shift_percent": 100 * shift / mean,
            **_errors("shift_percent", 100 * shift / mean, 100 * relative_se),
            "fraction": fractions[0],
            "fraction_other": fractions[1],
            "difference": difference,
            **_errors("difference", difference, error),
            "count": counts[0],
            "count_other": counts[1],
        }
        return pd.DataFrame(columns, columns=list(COMPARISON_COLUMNS))

    def _fractions(self, sample: int, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fractions among the species of a sample, and their derivatives."""
        structure = self.structures[sample][1]
        mixture = structure.mixture(theta)
        belongs = mixture.belongs[:, : self.known] * mixture.weight[:, None]
        part = belongs.sum(axis=0)
        logits = (belongs / part).T @ structure.design[0]
        part = part / part.sum()
        return part, part[:, None] * (logits - part @ logits)


def _errors(name: str, value: FloatArray, error: FloatArray) -> dict[str, FloatArray]:
    reach = TWO_SIDED_95 * error
    return {f"{name}_se": error, f"{name}_low": value - reach, f"{name}_high": value + reach}
