"""An equilibrium constant from the events of a series of concentrations.

Table s holds events of the species at equilibrium, with weights among the particles that came

    w_sk ∝ c_k(totals_s; K_D, β) · m_k^p

(`mass_action`), with common masses and one width, on a background whose share is each table's own,
each event with its own error and each table with its own detector: the likelihood is that of
`mixture`, and the product over all tables is maximised in ln K_D, the masses, the width, the shares
of the backgrounds and, where asked for, β.  Only ratios of species count: how many events a table
has depends on the surface as well and says nothing here.

The interval of K_D is where the likelihood, maximised over everything else, lies within 1.92 of its
maximum (James & Roos, Comput. Phys. Commun. 10, 343, 1975).  The model is tested against one whose
weights are free in every table, with the same masses and width: twice the gain is χ² with as many
degrees of freedom as there are weights more.  Proteins that do not bind, concentrations that are
not as labelled and replicates that disagree show there.  An inactive part, which shifts all tables
a little, is asked for by itself: twice the gain of β is half of the time 0, else χ² with one degree
of freedom, where there is none (Self & Liang, J. Am. Stat. Assoc. 82, 605, 1987).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from iminuit import Minuit
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.intervals import interval
from iscat_analysis.species.mass_action import COMPOSITION, LANDING_POWER, Model, landing_logits
from iscat_analysis.species.structure import (
    LOGIT_REACH,
    Limits,
    Structure,
    information,
    maximise,
    score,
)

_REACH = math.log(1e4)  # of ln K_D beyond the concentrations
_GRID = 25
_SIGMAS = 1.959964
_FAST = 0  # strategy of Minuit without second derivatives, which take n²/2 values
_FIRST_STEP = 0.1  # of ln K_D towards an end of its interval
_PROFILE = 9  # points of the profile between the ends of the interval
_MASS_RANGE = 0.2  # of the masses that were given
_WIDEST = 0.3  # of the lightest
_STEP = 1e-4  # of ln K_D and of β, for their slopes
_TOLERANCE = 0.01  # of Minuit: 1e-5 of the log-likelihood
_TOLERANCE_FREE = 1e-10  # of the log-likelihood per event
_MOST_INACTIVE = 0.9
_INSIDE = 1e-3  # of its range that a start lies away from a limit, where Minuit sees no slope
_FIRST_BACKGROUND = -3.0  # its logit


@dataclass(frozen=True, eq=False)
class EquilibriumFit:
    """An equilibrium constant and what it rests on; `fit_equilibrium` makes it."""

    kd_nm: float
    kd_low: float
    kd_high: float
    inactive: float
    inactive_se: float
    inactive_p: float
    masses_kda: FloatArray
    width_kda: float
    chi2: float
    dof: int
    p_value: float
    complexes: FloatArray
    complexes_low: FloatArray
    complexes_high: FloatArray
    predicted: FloatArray
    pull: FloatArray
    background: FloatArray
    profile_ln_kd: FloatArray
    profile_deviance: FloatArray


def fit_equilibrium(
    tables: Sequence[Events],
    totals_nm: FloatArray,
    *,
    model: Model,
    masses_kda: Sequence[float],
    power: float = LANDING_POWER,
    inactive: bool = False,
) -> EquilibriumFit:
    """Fit K_D to the events of all tables together.

    Shapes: `totals_nm` (n, 1) or (n, 2).
    """
    series = _Series(tables, totals_nm, model, np.array(masses_kda, float), power, inactive)
    free, free_value = series.fit_free()
    found = series.fit(free)
    best, best_value = np.array(found.values), -float(found.fval)
    low, high, points = _interval(found)
    chi2 = max(2 * (free_value - best_value), 0.0)
    dof = len(tables) * (series.kinds - 1) - series.constants
    logits, errors, complexes = series.observed(free)
    inactive_se = math.nan
    other = _Series(tables, totals_nm, model, np.array(masses_kda, float), power, not inactive)
    other_value = -float(other.fit(other.fit_free()[0]).fval)
    gain = max(2 * (best_value - other_value) * (1 if inactive else -1), 0.0)
    if inactive:
        found.hesse()
        inactive_se = float(found.errors["inactive"])
    mixtures = [one.mixture(best[: series.linear]) for one in series.structures(best)]
    predicted = np.array([_complexes(m.weight[: series.kinds]) for m in mixtures])
    reach = _SIGMAS * errors
    return EquilibriumFit(
        kd_nm=math.exp(best[series.linear]),
        kd_low=low,
        kd_high=high,
        inactive=float(best[-1]) if inactive else 0.0,
        inactive_se=inactive_se,
        inactive_p=float(chdtrc(1, gain)) / 2,
        masses_kda=mixtures[0].mean[: series.kinds],
        width_kda=math.sqrt(mixtures[0].variance[0]),
        chi2=chi2,
        dof=dof,
        p_value=float(chdtrc(dof, chi2)) if dof > 0 else math.nan,
        complexes=complexes,
        complexes_low=_share(logits - reach),
        complexes_high=_share(logits + reach),
        predicted=predicted,
        pull=(logits - np.log(predicted / (1 - predicted))) / errors,
        background=np.array([float(m.weight[-1]) for m in mixtures]),
        profile_ln_kd=points[:, 0],
        profile_deviance=points[:, 1],
    )


class _Series:
    """The likelihood of all tables.

    The parameters are the masses, τ², a logit of the background for each table, ln K_D and, where
    it is fitted, β; all but the last one or two enter linearly.
    """

    def __init__(
        self,
        tables: Sequence[Events],
        totals_nm: FloatArray,
        model: Model,
        masses: FloatArray,
        power: float,
        inactive: bool,
    ) -> None:
        self.tables, self.totals, self.model, self.power = tables, totals_nm, model, power
        self.composition = COMPOSITION[model]
        self.kinds, self.parts = self.composition.shape
        self.masses = self.composition @ masses
        self.constants = 1 + int(inactive)
        self.number = len(tables)
        self.linear = self.parts + 1 + self.number
        self.events = sum(table.x.size for table in tables)
        sigma = float(np.median(np.concatenate([table.sigma for table in tables])))
        widest = (_WIDEST * float(self.masses.min())) ** 2
        middle = np.log(totals_nm[totals_nm > 0])
        ends = [(middle.min() - _REACH, middle.max() + _REACH), (0.0, _MOST_INACTIVE)]
        ends = ends[: self.constants]
        back = np.full(self.number, LOGIT_REACH)
        self.limits = Limits(
            np.concatenate([(1 - _MASS_RANGE) * masses, [0.0], -back, [e[0] for e in ends]]),
            np.concatenate([(1 + _MASS_RANGE) * masses, [widest], back, [e[1] for e in ends]]),
            np.concatenate(
                [np.full(self.parts, sigma), [sigma**2], np.ones(self.number), [1.0, 0.1]]
            )[: self.linear + self.constants],
        )
        self.first = np.concatenate(
            [masses, [min(sigma**2, widest) / 4], np.full(self.number, _FIRST_BACKGROUND)]
        )

    def _structure(self, number: int, columns: int) -> Structure:
        """Masses, width and background of one table; logits of its species are 0."""
        design, origin = np.zeros((3, self.kinds + 1, columns)), np.zeros((3, self.kinds + 1))
        design[1, : self.kinds, : self.parts] = self.composition
        design[2, : self.kinds, self.parts] = 1.0
        design[0, self.kinds, self.parts + 1 + number] = 1.0
        x = self.tables[number].x
        low, high = float(x.min()), float(x.max())
        origin[1, self.kinds] = (low + high) / 2
        origin[2, self.kinds] = max((high - low) / 2, float(self.masses.min())) ** 2
        return Structure(design, origin)

    def structures(self, theta: FloatArray) -> list[Structure]:
        """Give the structures whose species are as the constants want them."""
        return self._with(self._logits(theta))

    def _logits(self, theta: FloatArray) -> FloatArray:
        inactive = float(theta[self.linear + 1]) if self.constants > 1 else 0.0
        return landing_logits(
            self.model, self.totals, math.exp(theta[self.linear]), inactive, self.masses, self.power
        )

    def _with(self, logits: FloatArray) -> list[Structure]:
        found = []
        for number in range(self.number):
            one = self._structure(number, self.linear)
            one.origin[0, : self.kinds] = logits[number]
            # The background's logit counts from all species together.
            one.origin[0, self.kinds] = np.logaddexp.reduce(logits[number])
            found.append(one)
        return found

    def value(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood and its slope."""
        logits = self._logits(theta)
        total, slope = 0.0, np.zeros(theta.shape)
        by_logits = np.zeros(logits.shape)
        for number, one in enumerate(self._with(logits)):
            found, slopes = score(self.tables[number], one.mixture(theta[: self.linear]))
            total += found
            slope[: self.linear] += np.tensordot(slopes, one.design, 2)
            part = np.exp(logits[number] - logits[number].max())
            by_logits[number] = slopes[0, : self.kinds]
            by_logits[number] += slopes[0, self.kinds] * part / part.sum()
        for place in range(self.linear, theta.size):
            step = np.zeros(theta.shape)
            step[place] = _STEP
            rise = self._logits(theta + step) - self._logits(theta - step)
            slope[place] = float(np.sum(by_logits * rise)) / (2 * _STEP)
        return total, slope

    def fit_free(self) -> tuple[FloatArray, float]:
        """Let the weights be free in every table: their logits stand behind the others."""
        columns = self.linear + self.number * (self.kinds - 1)
        self._free = []
        for number in range(self.number):
            one = self._structure(number, columns)
            begin = self.linear + number * (self.kinds - 1)
            one.design[0, 1 : self.kinds, begin : begin + self.kinds - 1] = np.eye(self.kinds - 1)
            self._free.append(one)
        own = np.full(columns - self.linear, LOGIT_REACH)
        self._free_limits = Limits(
            np.concatenate([self.limits.low[: self.linear], -own]),
            np.concatenate([self.limits.high[: self.linear], own]),
            np.concatenate([self.limits.scale[: self.linear], np.ones(own.size)]),
        )
        found = maximise(
            list(zip(self.tables, self._free, strict=True)),
            np.concatenate([self.first, np.zeros(own.size)]),
            self._free_limits,
            evaluations=1000,
            tolerance=_TOLERANCE_FREE,
        )
        return found.theta, found.log_likelihood

    def fit(self, free: FloatArray) -> Minuit:
        """Maximise over everything, from the best of a grid of K_D."""
        grid = np.linspace(self.limits.low[self.linear], self.limits.high[self.linear], _GRID)
        begun = np.concatenate([free[: self.linear], [0.0], [0.05]])[: self.limits.low.size]
        # The background counted from the first species, and counts from all.
        for number, one in enumerate(self._free):
            weight = one.mixture(free).weight
            odds = weight[-1] / weight[: self.kinds].sum()
            begun[self.parts + 1 + number] = max(math.log(max(odds, 1e-6)), -LOGIT_REACH / 2)
        starts = []
        for ln_kd in grid[1:-1]:
            theta = begun.copy()
            theta[self.linear] = ln_kd
            starts.append((self.value(theta)[0], theta))
        return self._maximum(max(starts, key=lambda one: one[0])[1])

    def _maximum(self, start: FloatArray) -> Minuit:
        """Maximise from a start."""
        last = lru_cache(maxsize=1)(lambda theta: self.value(np.frombuffer(theta)))
        inner = _INSIDE * (self.limits.high - self.limits.low)
        names = [f"linear {place}" for place in range(self.linear)] + ["ln_kd", "inactive"]
        search = Minuit(
            lambda theta: -last(theta.tobytes())[0],
            np.clip(start, self.limits.low + inner, self.limits.high - inner),
            grad=lambda theta: -last(theta.tobytes())[1],
            name=names[: start.size],
        )
        search.errordef, search.strategy, search.tol = Minuit.LIKELIHOOD, _FAST, _TOLERANCE
        search.limits = list(zip(self.limits.low, self.limits.high, strict=True))
        search.errors = self.limits.scale / math.sqrt(self.events)
        return search.migrad()

    def observed(self, free: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Logit of the complexes of each table, its standard error, and their fraction."""
        samples = list(zip(self.tables, self._free, strict=True))
        known = information(samples, free, self._free_limits)
        covariance = np.linalg.pinv(known)
        logits, errors = np.empty(self.number), np.empty(self.number)
        for number, one in enumerate(self._free):
            weight = one.mixture(free).weight[: self.kinds]
            part = weight / weight.sum()
            logits[number] = math.log(part[-1] / (1 - part[-1]))
            slope = np.zeros(free.size)
            begin = self.linear + number * (self.kinds - 1)
            # d logit(f_k)/dl_k = 1; of another: −f_j/(1 − f_k)
            slope[begin : begin + self.kinds - 1] = -part[1:] / (1 - part[-1])
            slope[begin + self.kinds - 2] = 1.0
            errors[number] = math.sqrt(max(float(slope @ covariance @ slope), 1e-12))
        return logits, errors, _share(logits)


def _interval(found: Minuit) -> tuple[float, float, FloatArray]:
    """Give the interval of K_D, and points of the profile of ln K_D between its ends."""
    best, (least, most) = float(found.values["ln_kd"]), found.limits["ln_kd"]

    def deviance(grid: ArrayLike) -> FloatArray:
        heights = found.mnprofile("ln_kd", grid=np.atleast_1d(grid))[1]
        return np.asarray(2 * np.maximum(heights - float(found.fval), 0.0))

    low, high = interval(
        lambda ln_kd: float(deviance(ln_kd)[0]), best, least, most, step=_FIRST_STEP
    )
    grid = np.unique(np.append(np.linspace(low, high, _PROFILE), best))
    return (
        math.exp(low) if low > least else 0.0,
        math.exp(high) if high < most else math.inf,
        np.column_stack([grid, deviance(grid)]),
    )


def _complexes(weight: FloatArray) -> float:
    return float(weight[-1] / weight.sum())


def _share(logits: FloatArray) -> FloatArray:
    return np.asarray(1 / (1 + np.exp(-logits)))
