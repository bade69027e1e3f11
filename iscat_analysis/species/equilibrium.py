"""An equilibrium constant from the events of a series of concentrations.

Table s holds events of the species at equilibrium, with weights among the particles that came

    w_sk ∝ c_k(totals_s; K_D, β) · m_k^p

(`mass_action`).  What the tables' peaks, backgrounds and detectors look like is learned with them
(`series`), and the product of the likelihoods of all tables is maximised in ln K_D, all of that,
the exponent p unless it is given, and, where asked for, β.  Only ratios of species count: how many
events a table has depends on the surface as well and says nothing here.

What is known of p is that it lies about −1/6 and between −1/3 and 0, according to whether liquid
flows and whether the surface keeps all that reach it: a normal distribution about −1/6 with a
standard deviation of 1/6 enters the likelihood.  A ratio of two masses shifts ln K_D of dimers by
0.1 to 0.2 between these.

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
from functools import cache

import numpy as np
from iminuit import Minuit
from scipy.special import chdtrc

from iscat_analysis.errors import DataError
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.intervals import interval
from iscat_analysis.species.mass_action import (
    COMPOSITION,
    LANDING_POWER,
    LANDING_POWER_SIGMA,
    Model,
    landing_logits,
)
from iscat_analysis.species.series import Free, Series

_REACH = math.log(1e4)  # of ln K_D beyond the concentrations
_GRID = 25
_SIGMAS = 1.959964
# Of log-likelihood, by which no point of the profile may exceed the maximum
_LOG_LIKELIHOOD_TOLERANCE = 0.1
_FIRST_STEP = 0.1  # of ln K_D towards an end of its interval
_PROFILE = 9  # points of the profile between the ends of the interval
_STEP = 1e-4  # of ln K_D and of β, for their slopes
_MOST_INACTIVE = 0.9


@dataclass(frozen=True, eq=False)
class EquilibriumFit:
    """An equilibrium constant and what it rests on; `fit_equilibrium` makes it."""

    kd_nm: float
    kd_low: float
    kd_high: float
    inactive: float
    inactive_se: float
    inactive_p: float
    landing_power: float
    landing_power_se: float
    masses_kda: FloatArray
    width_kda: float
    tail_kda: float
    limit_kda: float
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
    power: float | None = None,
    inactive: bool = False,
) -> EquilibriumFit:
    """Fit K_D to the events of all tables together.

    Shapes: `totals_nm` (n, 1) or (n, 2).
    """
    masses = np.array(masses_kda, float)
    free_series = Free(tables, COMPOSITION[model], masses)
    free_fit = free_series.maximum(free_series.first)
    free, free_value = np.array(free_fit.values), -float(free_fit.fval)
    series = _Equilibrium(tables, totals_nm, model, masses, power, inactive)
    found = series.fit(free)
    best, best_value = np.array(found.values), -float(found.fval)
    chi2 = max(2 * (free_value - best_value), 0.0)
    dof = len(tables) * (series.kinds - 1) - 1 - int(inactive)
    logits, errors, complexes = _observed(free_series, free)
    other = _Equilibrium(tables, totals_nm, model, masses, power, not inactive)
    other_value = -float(other.fit(best).fval)
    gain = max(2 * (best_value - other_value) * (1 if inactive else -1), 0.0)
    found.hesse()
    constants = found.values.to_dict(), found.errors.to_dict()
    low, high, points = _interval(found)
    shared, landed = series.shared(best), series.logits(best)
    predicted = _share(landed[:, -1] - np.logaddexp.reduce(landed[:, :-1], axis=1))
    reach = _SIGMAS * errors
    return EquilibriumFit(
        kd_nm=math.exp(constants[0]["ln_kd"]),
        kd_low=low,
        kd_high=high,
        inactive=constants[0].get("inactive", 0.0),
        inactive_se=constants[1].get("inactive", math.nan),
        inactive_p=float(chdtrc(1, gain)) / 2,
        landing_power=constants[0].get("power", power),
        landing_power_se=constants[1].get("power", 0.0),
        masses_kda=shared.mean,
        width_kda=math.sqrt(float(shared.variance[0])),
        tail_kda=shared.tail,
        limit_kda=shared.limit[0],
        chi2=chi2,
        dof=dof,
        p_value=float(chdtrc(dof, chi2)) if dof > 0 else math.nan,
        complexes=complexes,
        complexes_low=_share(logits - reach),
        complexes_high=_share(logits + reach),
        predicted=predicted,
        pull=(logits - np.log(predicted / (1 - predicted))) / errors,
        background=series.weights(best, landed)[:, -1],
        profile_ln_kd=points[:, 0],
        profile_deviance=points[:, 1],
    )


class _Equilibrium(Series):
    """A series whose weights are those of an equilibrium.

    ln K_D, the landing exponent where it is not known, and β where it is fitted follow the other
    parameters.
    """

    def __init__(
        self,
        tables: Sequence[Events],
        totals_nm: FloatArray,
        model: Model,
        masses: FloatArray,
        power: float | None,
        inactive: bool,
    ) -> None:
        super().__init__(tables, COMPOSITION[model], masses)
        self.totals, self.model, self.power = totals_nm, model, power
        middle = np.log(totals_nm[totals_nm > 0])
        added = [("ln_kd", middle.min() - _REACH, middle.max() + _REACH, middle.mean(), 1.0)]
        if power is None:
            added.append(("power", -1.0, 1.0, LANDING_POWER, LANDING_POWER_SIGMA))
        if inactive:
            added.append(("inactive", 0.0, _MOST_INACTIVE, 0.05, 0.1))
        names, *numbers = zip(*added, strict=True)
        self.names += names
        self.low, self.high, self.first, self.scale = (
            np.append(old, new)
            for old, new in zip((self.low, self.high, self.first, self.scale), numbers, strict=True)
        )

    def logits(self, theta: FloatArray) -> FloatArray:
        """Logits of the species that follow from the constants."""
        values = dict(zip(self.names[self.own :], theta[self.own :], strict=True))
        return landing_logits(
            self.model, self.totals, math.exp(values["ln_kd"]), values.get("inactive", 0.0),
            self.masses, values["power"] if self.power is None else self.power,
        )  # fmt: skip

    def height(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood and its slope."""
        total, slope, by_logits = self.value(theta, self.logits(theta))
        slope = np.append(slope, np.zeros(theta.size - self.own))
        for place in range(self.own, theta.size):
            step = np.zeros(theta.shape)
            step[place] = _STEP
            rise = self.logits(theta + step) - self.logits(theta - step)
            slope[place] = float(np.sum(by_logits * rise)) / (2 * _STEP)
        if self.power is None:
            away = (theta[self.own + 1] - LANDING_POWER) / LANDING_POWER_SIGMA
            total -= 0.5 * away**2
            slope[self.own + 1] -= away / LANDING_POWER_SIGMA
        return total, slope

    def fit(self, free: FloatArray) -> Minuit:
        """Maximise over everything, from the best of a grid of K_D."""
        begun = np.concatenate([free[: self.own], self.first[self.own :]])
        starts = []
        for ln_kd in np.linspace(self.low[self.own], self.high[self.own], _GRID)[1:-1]:
            theta = begun.copy()
            theta[self.own] = ln_kd
            starts.append((self.height(theta)[0], theta))
        return self.maximum(max(starts, key=lambda one: one[0])[1])


def _observed(series: Free, free: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Logit of the complexes of each table, its standard error, and their fraction."""
    covariance = np.linalg.pinv(series.information(free))
    part = np.exp(series.logits(free))
    part /= part.sum(axis=1, keepdims=True)
    logits, errors = np.empty(series.number), np.empty(series.number)
    for number, one in enumerate(part):
        logits[number] = math.log(one[-1] / (1 - one[-1]))
        slope = np.zeros(free.size)
        begin = series.own + number * (series.kinds - 1)
        # d logit(f_k)/dl_k = 1; of another: −f_j/(1 − f_k)
        slope[begin : begin + series.kinds - 1] = -one[1:] / (1 - one[-1])
        slope[begin + series.kinds - 2] = 1.0
        errors[number] = math.sqrt(max(float(slope @ covariance @ slope), 1e-12))
    return logits, errors, _share(logits)


def _interval(found: Minuit) -> tuple[float, float, FloatArray]:
    """Give the interval of K_D, and points of the profile of ln K_D between its ends."""
    best, (least, most) = float(found.values["ln_kd"]), found.limits["ln_kd"]

    top = float(found.fval)

    @cache
    def deviance(ln_kd: float) -> float:
        found.values["ln_kd"] = ln_kd
        found.migrad()  # from where the last one ended
        if found.fval < top - _LOG_LIKELIHOOD_TOLERANCE:
            raise DataError(
                "K_D: the fit did not end at the largest likelihood, which lies near "
                f"{math.exp(ln_kd):.3g} nM: give the masses, or hold the landing exponent"
            )
        return 2 * max(float(found.fval) - top, 0.0)

    found.fixed["ln_kd"] = True
    low, high = interval(deviance, best, least, most, step=_FIRST_STEP)
    grid = np.unique(np.append(np.linspace(low, high, _PROFILE), best))
    points = np.column_stack([grid, [deviance(float(value)) for value in grid]])
    return (
        math.exp(low) if low > least else 0.0,
        math.exp(high) if high < most else math.inf,
        points,
    )


def _share(logits: FloatArray) -> FloatArray:
    return np.asarray(1 / (1 + np.exp(-logits)))
