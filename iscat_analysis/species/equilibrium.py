"""Concentrations at equilibrium, and what of them lands.

Monomers and dimers of c monomers in all, 2 M ⇌ D, K_D = [M]²/[D] (Fineberg, Surrey & Kukura, J.
Mol. Biol. 432, 6168, 2020):

    [M] = 2c / (1 + √(1 + 8c/K_D)),      [D] = [M]²/K_D.

Two partners of a and b in all, A + B ⇌ AB, K_D = [A][B]/[AB]:

    [AB] = 2ab / (s + √(s² − 4ab)),  s = a + b + K_D,      [A] = a − [AB],  [B] = b − [AB].

Of monomers, or of A, a part β may be inactive: it stays as it is.

The number of particles of mass m that land on an absorbing surface below a drop at rest is
2 c √(Dt/π) per area, and D ∝ m^(−1/3): landings are as c·m^p with p = −1/6.  Through a layer of
fixed thickness, as where liquid flows, they are as c·D, p = −1/3; where the surface and not
diffusion decides, and is as sticky for all, p = 0.

An equilibrium constant from the events of a series of concentrations.

Table s holds events of the species at equilibrium, with weights among the particles that came

    w_sk ∝ c_k(totals_s; K_D, β) · m_k^p

as above.  What the tables' peaks, backgrounds and detectors look like is learned with them
(`series`), and the product of the likelihoods of all tables is maximised in ln K_D, all of that,
the exponent p unless it is given, and, where asked for, β.  Only ratios of species count: how many
events a table has depends on the surface as well and says nothing here.

What is known of p is that it lies about −1/6 and between −1/3 and 0, according to whether liquid
flows and whether the surface keeps all that reach it: a normal distribution about −1/6 with a
standard deviation of 1/6 enters the likelihood.  A ratio of two masses shifts ln K_D of dimers by
0.1 to 0.2 between these.

A tail of either sign, the background and a limit of detection can stand for each other, and the
likelihood has two maxima in every fifth series with a limit, of heights that differ by tenths.  The
fit therefore starts from tails of either sign, and takes the highest.

The interval of K_D is where the likelihood, maximised over everything else, lies within 1.92 of its
maximum (James & Roos, Comput. Phys. Commun. 10, 343, 1975); it is followed from every maximum.
The model is tested against one whose weights are free in every table, with the same masses and
width: twice the gain is χ² with as many degrees of freedom as there are weights more.  Proteins
that do not bind, concentrations that are not as labelled and replicates that disagree show there.
An inactive part, which shifts all tables a little, is asked for by itself: twice the gain of β is
half of the time 0, else χ² with one degree of freedom, where there is none (Self & Liang, J. Am.
Stat. Assoc. 82, 605, 1987).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Literal

import numpy as np
from scipy.special import chdtrc, expit, logit

from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.maximum import TWO_SIDED_95, Maximum, Problem, interval, maximise
from iscat_analysis.species.series import Series

Model = Literal["dimer", "ab"]

LANDING_POWER = -1 / 6
"""p of landings ∝ concentration · mass^p: diffusion from a drop at rest to an absorbing surface."""

LANDING_POWER_SIGMA = 1 / 6
"""What it may be off by: liquid that flows makes it −1/3, a surface that takes all alike 0."""

COMPOSITION: dict[Model, FloatArray] = {
    "dimer": np.array([[1.0], [2.0]]),
    "ab": np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]),
}
"""How many of each part a species holds, (species, parts); the last species is the complex."""


def at_equilibrium(
    model: Model, totals_nm: FloatArray, kd_nm: float, inactive: float = 0.0
) -> FloatArray:
    """Give the concentrations of all species.

    Shapes: `totals_nm` (n, 1) or (n, 2), result (n, 2) or (n, 3).
    """
    active = (1 - inactive) * totals_nm[:, 0]
    idle = inactive * totals_nm[:, 0]
    if model == "dimer":
        monomer = 2 * active / (1 + np.sqrt(1 + 8 * active / kd_nm))
        found = [monomer + idle, monomer**2 / kd_nm]
    else:
        other = totals_nm[:, 1]
        s = active + other + kd_nm
        product = 2 * active * other / (s + np.sqrt(s**2 - 4 * active * other))
        found = [active - product + idle, other - product, product]
    # of the total: what is absent has some logarithm
    least = 1e-12 * totals_nm.sum(axis=1)[:, None]
    return np.asarray(np.maximum(np.array(found).T, least))


def landing_logits(
    model: Model,
    totals_nm: FloatArray,
    kd_nm: float,
    inactive: float,
    masses_kda: FloatArray,
    power: float,
) -> FloatArray:
    """Give the logarithm of how many of each species land, less that of the first.

    Shapes: `totals_nm` (n, 1) or (n, 2), `masses_kda` (k,), result (n, k).
    """
    logits = np.log(at_equilibrium(model, totals_nm, kd_nm, inactive))
    logits = logits + power * np.log(masses_kda)
    return np.asarray(logits - logits[:, :1])


_REACH = math.log(1e4)  # of ln K_D beyond the concentrations
_TURNED = 0.6  # of a peak's width: tails from which other maxima are sought
_SAME = 1e-4  # of log-likelihood: two ways to one maximum
_STEP = 1e-4  # of ln K_D and of β, for their slopes


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
    detected: FloatArray
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
    series = Series(tables, COMPOSITION[model], np.array(masses_kda, float))
    free = maximise(series.problem(), series.first)
    equilibrium = _Equilibrium(series, totals_nm, model, power, inactive)
    found, (low, high, points) = _profiled(equilibrium, equilibrium.maxima(free))
    full = equilibrium.full(found.theta)
    free = maximise(series.problem(), full)
    other = _Equilibrium(series, totals_nm, model, power, not inactive).near(found.theta)
    gain = max(2 * (found.value - other.value) * (1 if inactive else -1), 0.0)
    chi2 = max(2 * (free.value - found.value), 0.0)
    dof = len(tables) * (series.kinds - 1) - 1 - int(inactive)
    logits, errors, complexes = _observed(series, free)
    shared, landed = series.shared(full), series.logits(full)
    predicted = expit(landed[:, -1] - np.logaddexp.reduce(landed[:, :-1], axis=1))
    reach = TWO_SIDED_95 * errors
    constants = equilibrium.constants(found.theta)
    constant_errors = equilibrium.constants(found.errors())
    return EquilibriumFit(
        kd_nm=math.exp(constants["ln_kd"]),
        kd_low=low,
        kd_high=high,
        inactive=constants.get("inactive", 0.0),
        inactive_se=constant_errors.get("inactive", math.nan),
        inactive_p=float(chdtrc(1, gain)) / 2,
        landing_power=constants["power"] if power is None else power,
        landing_power_se=constant_errors.get("power", 0.0),
        masses_kda=series.modes(full),
        detected=series.detected(full),
        width_kda=math.sqrt(max(float(shared.variance[0]), 0.0)),
        tail_kda=shared.tail * math.sqrt(float(shared.variance[0]) + series.noise),
        limit_kda=shared.limit[0],
        chi2=chi2,
        dof=dof,
        p_value=float(chdtrc(dof, chi2)) if dof > 0 else math.nan,
        complexes=complexes,
        complexes_low=expit(logits - reach),
        complexes_high=expit(logits + reach),
        predicted=predicted,
        pull=(logits - np.log(predicted / (1 - predicted))) / errors,
        background=series.background(full),
        profile_ln_kd=points[:, 0],
        profile_deviance=points[:, 1],
    )


class _Equilibrium:
    """A series whose weights are those of an equilibrium.

    In place of the logits stand ln K_D, the landing exponent where it is not known, and β where it
    is fitted.
    """

    def __init__(
        self, series: Series, totals: FloatArray, model: Model, power: float | None, inactive: bool
    ) -> None:
        self.series, self.totals, self.model, self.power = series, totals, model, power
        middle = np.log(totals[totals > 0])
        added = [("ln_kd", middle.min() - _REACH, middle.max() + _REACH, middle.mean(), 1.0)]
        if power is None:
            added.append(("power", -1.0, 1.0, LANDING_POWER, LANDING_POWER_SIGMA))
        if inactive:
            added.append(("inactive", 0.0, 0.9, 0.05, 0.1))
        self.names, *numbers = zip(*added, strict=True)
        self.at = series.own
        of_series = np.array([series.low, series.high, series.first, series.scale])
        self.low, self.high, self.first, self.scale = np.hstack([of_series[:, : self.at], numbers])

    def constants(self, theta: FloatArray) -> dict[str, float]:
        """Name what stands in place of the logits."""
        return dict(zip(self.names, theta[self.at :].tolist(), strict=True))

    def full(self, theta: FloatArray) -> FloatArray:
        """Give the parameters of the series, with the logits that the constants want."""
        return np.concatenate([theta[: self.at], self._logits(theta[self.at :])])

    def _logits(self, constants: FloatArray) -> FloatArray:
        values = {"power": self.power or 0.0, "inactive": 0.0}
        values |= dict(zip(self.names, constants.tolist(), strict=True))
        found = landing_logits(
            self.model, self.totals, math.exp(values["ln_kd"]), values["inactive"],
            self.series.masses, values["power"],
        )  # fmt: skip
        return found[:, 1:].ravel()

    def _rise(self, constants: FloatArray) -> FloatArray:
        """Slopes of the logits in the constants.

        Shapes: `constants` (c,), result (c, tables (k - 1)).
        """
        steps = _STEP * np.eye(constants.size)
        rises = [self._logits(constants + step) - self._logits(constants - step) for step in steps]
        return np.array(rises) / (2 * _STEP)

    def height(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Log-likelihood and its slope."""
        total, slope = self.series.likelihood(self.full(theta))
        slope = np.append(slope[: self.at], self._rise(theta[self.at :]) @ slope[self.at :])
        if self.power is None:
            away = (theta[self.at + 1] - LANDING_POWER) / LANDING_POWER_SIGMA
            total -= 0.5 * away**2
            slope[self.at + 1] -= away / LANDING_POWER_SIGMA
        return total, slope

    def problem(self) -> Problem:
        """Give what is maximised."""
        return Problem(self.height, self.low, self.high, self.scale, self.series.events)

    def near(self, theta: FloatArray) -> Maximum:
        """Climb from shared parameters and a K_D that are about right.

        Shapes: `theta` (at least own + 1,).
        """
        added = self.first[self.at + 1 :]
        return maximise(self.problem(), np.concatenate([theta[: self.at + 1], added]))

    def maxima(self, free: Maximum) -> list[Maximum]:
        """Give maxima, the highest first, from what was found with free weights.

        A tail, the background's bends and a limit of detection can stand for each other: there may
        be one maximum for tails of either sign.  Of the constants the start is the best of a grid:
        where the equilibrium is another, a large K_D with an exponent far from the usual one is.
        """
        logits, first = free.theta[self.at :], self.first[self.at :]
        # points of ln K_D and of the exponent where a start is sought
        axes = [np.linspace(self.low[self.at], self.high[self.at], 25)[1:-1]]
        if self.power is None:
            axes.append(np.linspace(self.low[self.at + 1], self.high[self.at + 1], 9)[1:-1])
        starts = [np.append(one, first[len(axes) :]) for one in product(*axes)]
        far = [np.sum(np.abs(self._logits(one) - logits)) for one in starts]
        begin = np.append(free.theta[: self.at], starts[int(np.argmin(far))])
        found = [maximise(self.problem(), begin)]
        for tail in (-_TURNED, _TURNED):
            turned = self.series.turned(found[0].theta, tail)
            found.append(maximise(self.problem(), turned))
        return sorted(found, key=lambda one: -one.value)


def _observed(series: Series, free: Maximum) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Logit of the complexes of each table, its standard error, and their fraction."""
    part = np.exp(series.logits(free.theta))
    part /= part.sum(axis=1, keepdims=True)
    number, own = part.shape[0], part.shape[1] - 1
    slopes = np.hstack([-part[:, 1:-1] / (1 - part[:, -1:]), np.ones((number, 1))])  # d logit/dl_j
    blocks = free.covariance()[series.own :, series.own :].reshape(number, own, number, own)
    variance = np.einsum("ti,titj,tj->t", slopes, blocks, slopes)
    return logit(part[:, -1]), np.sqrt(np.maximum(variance, 1e-12)), part[:, -1]


def _profiled(
    equilibrium: _Equilibrium, maxima: list[Maximum]
) -> tuple[Maximum, tuple[float, float, FloatArray]]:
    """Give the highest maximum, and the interval of K_D about it.

    A profile may lead to yet another maximum that is higher; then it is done again from there.
    """
    while True:
        interval_of_kd, reached = _interval(equilibrium, maxima)
        # of log-likelihood: another maximum than the one that was found
        if reached.value < maxima[0].value + 1e-3:
            return maxima[0], interval_of_kd
        maxima = [maximise(equilibrium.problem(), reached.theta), *maxima]


def _interval(
    equilibrium: _Equilibrium, maxima: list[Maximum]
) -> tuple[tuple[float, float, FloatArray], Maximum]:
    """Give the interval of K_D with points of the profile of ln K_D, and its highest point.

    The profile is followed from every maximum, and the highest counts.  Where two ways have met,
    they go on as one.
    """
    at, found, problem = equilibrium.at, maxima[0], equilibrium.problem()
    best, least, most = float(found.theta[at]), float(problem.low[at]), float(problem.high[at])
    branches: list[dict[float, Maximum]] = []
    for one in maxima:
        if all(abs(one.value - other.value) > _SAME for b in branches for other in b.values()):
            branches.append({float(one.theta[at]): one})

    @cache
    def deviance(ln_kd: float) -> float:
        climbed: dict[int, Maximum] = {}
        for branch in branches:
            nearest = branch[min(branch, key=lambda place: abs(place - ln_kd))]
            if id(nearest) not in climbed:
                low, high, start = problem.low.copy(), problem.high.copy(), nearest.theta.copy()
                low[at] = high[at] = start[at] = ln_kd
                top = maximise(replace(problem, low=low, high=high), start, nearest.curvature)
                met = (one for one in climbed.values() if abs(one.value - top.value) < _SAME)
                climbed[id(nearest)] = next(met, top)
            branch[ln_kd] = climbed[id(nearest)]
        return 2 * max(found.value - max(one.value for one in climbed.values()), 0.0)

    first = TWO_SIDED_95 * float(found.errors()[at])
    # of ln K_D towards an end of its interval, at first
    low, high = interval(deviance, best, least, most, step=max(first, 0.1))
    # points of the profile between the ends of the interval
    grid = np.unique(np.append(np.linspace(low, high, 9), best))
    points = np.column_stack([grid, [deviance(float(value)) for value in grid]])
    reached = max((one for branch in branches for one in branch.values()), key=lambda m: m.value)
    ends = math.exp(low) if low > least else 0.0, math.exp(high) if high < most else math.inf
    return (*ends, points), reached
