"""K_D over many draws: intervals hold the truth, a wrong model is told, and controls must fail."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from event_tables import draw_series
from numpy.typing import NDArray
from scipy.stats import kstest

import iscat_analysis as ia
from iscat_analysis.answers.binding import Binding
from iscat_analysis.species import Efficiency
from iscat_analysis.species.equilibrium import LANDING_POWER, EquilibriumFit, at_equilibrium

pytestmark = pytest.mark.large

EFFICIENCY = Efficiency(5.0, 13.0)  # 54 % of 66 kDa are seen
KD_NM = 10.0
TOTALS: NDArray[np.float64] = np.repeat([1.0, 3.0, 10.0, 30.0, 60.0, 100.0], 3)[:, None]
SAMPLES = pd.DataFrame({"concentration_nm": TOTALS[:, 0]})
DIRTY = (0, 30, 0)  # events of something else in every third table


def fitted(
    seed: int,
    *,
    inert: float = 0.0,
    inactive: bool = False,
    landing_power: float | None = LANDING_POWER,
) -> Binding:
    tables = draw_series(
        np.random.default_rng([91, seed]), "dimer", TOTALS, KD_NM, [66.0], number=600,
        inactive=inert, efficiency=EFFICIENCY, background=DIRTY,
    )  # fmt: skip
    return ia.fit_kd(
        SAMPLES, tables=tables, model="dimer", masses_kda=[64.0], inactive=inactive,
        landing_power=landing_power,
    )  # fmt: skip


def covered(found: list[Binding]) -> float:
    return float(np.mean([one.fit.kd_low < KD_NM < one.fit.kd_high for one in found]))


def test_the_interval_of_kd_holds_the_truth(repetitions: Callable[[int, int], int]) -> None:
    trials = repetitions(8, 120)
    found = [fitted(seed) for seed in range(trials)]
    error = np.log([one.fit.kd_nm / KD_NM for one in found])
    assert abs(error.mean()) < 4 * error.std(ddof=1) / math.sqrt(trials)
    claimed = np.mean([math.log(one.fit.kd_high / one.fit.kd_low) for one in found]) / 3.92
    assert abs(error.std(ddof=1) / claimed - 1) < 4 / math.sqrt(2 * trials)
    if trials >= 100:
        assert covered(found) >= 0.92
    assert covered(found) > 0.95 - 4 * math.sqrt(0.95 * 0.05 / trials)
    assert kstest([one.fit.p_value for one in found], "uniform").pvalue > 1e-3
    alarms = np.mean([one.fit.inactive_p < 0.01 for one in found])
    assert alarms < 0.01 + 4 * math.sqrt(0.01 / trials)
    # The control: who takes all for landing alike misses the truth.
    alike = [fitted(seed, landing_power=0.0) for seed in range(min(trials, 30))]
    assert covered(alike) < 0.2


def test_what_the_model_does_not_know_is_told_and_can_be_fitted(
    repetitions: Callable[[int, int], int],
) -> None:
    """5 % of the protein do not bind."""
    trials = repetitions(4, 60)
    plain = [fitted(seed, inert=0.05) for seed in range(trials)]
    assert covered(plain) < 0.5
    told = np.mean([one.fit.inactive_p < 0.05 for one in plain])
    assert told > 0.5
    right = [fitted(seed, inert=0.05, inactive=True) for seed in range(trials)]
    assert covered(right) > 0.95 - 4 * math.sqrt(0.95 * 0.05 / trials)
    part = np.array([one.fit.inactive for one in right])
    assert abs(part.mean() - 0.05) < 4 * part.std(ddof=1) / math.sqrt(trials) + 0.005


SIX = np.array([1.0, 3.0, 10.0, 30.0, 100.0, 300.0])


def bare(
    seed: int, *, tail: float = 0.0, dirt: float = 0.0, limit: float = 0.0, power: float = -1 / 6,
    growth: float = 0.0,
) -> list[pd.DataFrame]:  # fmt: skip
    """Tables of 600 masses without errors, as other programs give them; dirt is uniform.

    Widths grow with a power of the mass.
    """
    random = np.random.default_rng([92, seed])
    tables = []
    for total in SIX:
        monomer, dimer = at_equilibrium("dimer", np.array([[total]]), KD_NM)[0] * [1, 2**power]
        true = np.where(random.random(3000) < dimer / (monomer + dimer), 132.0, 66.0)
        width = 12.0 * (true / 66.0) ** growth
        true += random.exponential(tail, true.size) if tail else 0.0
        mass = random.normal(true, width)
        mass = np.where(random.random(mass.size) < dirt, random.uniform(20, 600, mass.size), mass)
        seen = mass[random.normal(mass, 8.0) > limit] if limit else mass
        tables.append(pd.DataFrame({"mass_kda": seen[seen > 0][:600]}))
    return tables


def bare_fit(seed: int, landing_power: float | None = None, **world: float) -> EquilibriumFit:
    return ia.fit_kd(
        pd.DataFrame({"concentration_nm": SIX}), tables=bare(seed, **world), model="dimer",
        masses_kda=[64.0], landing_power=landing_power,
    ).fit  # fmt: skip


@pytest.mark.parametrize(
    "world",
    [
        pytest.param({"tail": 12.0}, id="tail"),
        pytest.param({"dirt": 0.25}, id="dirt", marks=pytest.mark.large),
        pytest.param({"limit": 65.0}, id="limit"),
        pytest.param({"growth": 1.0}, id="wide"),
        pytest.param({"power": 0.0}, id="landing", marks=pytest.mark.large),
    ],
)
def test_masses_without_errors_give_kd(
    world: dict[str, float], repetitions: Callable[[int, int], int]
) -> None:
    """What peaks, dirt, detector and surface look like is learned."""
    trials = repetitions(3, 100)
    found = [bare_fit(seed, **world) for seed in range(trials)]
    inside = np.mean([fit.kd_low < KD_NM < fit.kd_high for fit in found])
    assert inside > 0.95 - 4 * math.sqrt(0.95 * 0.05 / trials)
    error = np.array([math.log(fit.kd_nm / KD_NM) for fit in found])
    claimed = np.array([math.log(fit.kd_high / fit.kd_low) / 3.92 for fit in found])
    # Priors of what cannot be told shift the estimate by less than the error that is claimed.
    assert abs(error.mean()) < claimed.mean() + 3 * error.std(ddof=1) / math.sqrt(trials)


def test_an_exponent_that_is_held_where_it_is_not_known_is_wrong(
    repetitions: Callable[[int, int], int],
) -> None:
    """The control of the landing exponent: 0 is true, and −1/3 is held."""
    trials = repetitions(3, 40)
    found = [bare_fit(seed, landing_power=-1 / 3, power=0.0) for seed in range(trials)]
    assert np.mean([fit.kd_low < KD_NM < fit.kd_high for fit in found]) < 0.5
