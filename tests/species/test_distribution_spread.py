"""The mixture over many draws: unbiased, the right number, and controls that must fail."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from iscat_analysis.species import Distribution, Efficiency, Searched, describe

Array = NDArray[np.float64]

MASSES, WIDTHS, SHARES = (66.0, 146.0, 480.0), (4.0, 5.0, 10.0), (0.4, 0.35, 0.25)
DRAWS = 16


def draw(
    seed: int,
    *,
    n: int = 360,
    sigma: tuple[float, float] = (6.0, 14.0),
    efficiency: Efficiency | None = None,
    masses: tuple[float, ...] = MASSES,
    widths: tuple[float, ...] = WIDTHS,
    shares: tuple[float, ...] = SHARES,
) -> tuple[Array, Array]:
    """Masses of n particles that came, as far as the detector saw them."""
    rng = np.random.default_rng(seed)
    species = rng.choice(len(masses), n, p=shares)
    errors = rng.uniform(*sigma, n)
    x = rng.normal(rng.normal(np.array(masses)[species], np.array(widths)[species]), errors)
    if efficiency is not None:
        extra = np.sqrt(efficiency.sigma_kda**2 - errors**2)
        seen = rng.normal(x, extra) > efficiency.threshold_kda
        x, errors = x[seen], errors[seen]
    return x, errors


def in_standard_errors(values: list[list[float]], truth: tuple[float, ...]) -> Array:
    table = np.array(values)
    error = table.std(axis=0, ddof=1) / math.sqrt(len(table))
    return np.asarray((table.mean(axis=0) - truth) / error)


@pytest.fixture(scope="module")
def described() -> list[Distribution]:
    return [describe(*draw(seed), seed=seed, draws=0) for seed in range(DRAWS)]


def test_bic_picks_the_right_number(described: list[Distribution]) -> None:
    assert [len(found.species) for found in described].count(3) >= DRAWS - 1


def test_species_are_unbiased(described: list[Distribution]) -> None:
    right = [found.species for found in described if len(found.species) == 3]
    off = in_standard_errors([s["mass_kda"].tolist() for s in right], MASSES)
    assert np.all(np.abs(off) < 4), off
    off = in_standard_errors([s["fraction"].tolist() for s in right], SHARES)
    assert np.all(np.abs(off) < 4), off


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_species_are_not_split(count: int) -> None:
    share = (1 / count,) * count
    found = [
        describe(
            *draw(seed, n=150, masses=MASSES[:count], widths=WIDTHS[:count], shares=share),
            seed=1, draws=0,
        )
        for seed in range(12)
    ]  # fmt: skip
    assert [len(f.species) for f in found].count(count) >= 11


def test_each_events_own_error_matters_and_a_pooled_one_is_biased() -> None:
    """Half the events are five times as noisy; all are one species without a width."""
    own, wrong, numbers = [], [], []
    for seed in range(DRAWS):
        rng = np.random.default_rng(1000 + seed)
        sigma = np.where(np.arange(300) % 2 == 0, 4.0, 20.0)
        x = rng.normal(200.0, sigma)
        mine = describe(x, sigma, seed=1, draws=0, choice=Searched(3))
        same = describe(
            x, np.full(300, float(np.median(sigma))), seed=1, draws=0, choice=Searched(3)
        )
        own.append(mine.species["width_kda"].max())
        species = same.species
        wrong.append(species["width_kda"].max() > 5 or species["outlier"].any())
        numbers.append(len(mine.species))
    assert numbers.count(1) >= DRAWS - 1
    assert np.median(own) < 2
    # The control: pooled, one peak grows a width that it does not have, or stands on a background;
    # it falls apart no longer, for two components of one peak are one species.
    assert sum(wrong) > DRAWS / 2


def test_missed_particles_are_accounted_for_and_ignoring_them_is_biased() -> None:
    efficiency = Efficiency(4.5, 15.0)  # half of 67.5 kDa are seen
    fair, naive = [], []
    for seed in range(DRAWS):
        x, sigma = draw(2000 + seed, n=500, efficiency=efficiency, widths=(0.0, 5.0, 10.0))
        found = describe(x, sigma, efficiency=efficiency, seed=1, draws=0)
        blind = describe(x, sigma, seed=1, draws=0)
        if len(found.species) == 3 == len(blind.species):
            fair.append([*found.species["mass_kda"], *found.species["fraction"],
                         found.species["count_corrected"].sum()])  # fmt: skip
            naive.append([*blind.species["mass_kda"], *blind.species["fraction"],
                          blind.species["count_corrected"].sum()])  # fmt: skip
    assert len(fair) >= DRAWS - 3
    truth = (*MASSES, *SHARES, 500.0)
    off = in_standard_errors(fair, truth)
    assert np.all(np.abs(off) < 4), off
    control = in_standard_errors(naive, truth)
    assert control[0] > 6
    assert control[3] < -6
    assert control[6] < -6


def test_intervals_hold_the_truth() -> None:
    inside, pulls = [], []
    for seed in range(12):
        found = describe(*draw(3000 + seed, n=200), seed=seed, draws=30, choice=Searched(3))
        if len(found.species) != 3:
            continue
        species = {name: column.to_numpy() for name, column in found.species.items()}
        inside.append(
            [
                *((species["mass_low"] < MASSES) & (species["mass_high"] > MASSES)),
                *((species["fraction_low"] < SHARES) & (species["fraction_high"] > SHARES)),
            ]
        )
        pulls.append(((species["mass_kda"] - MASSES) / species["mass_se"]).tolist())
    table = np.array(inside, dtype=float)
    # 95 % of 6 × 12 intervals; four binomial standard errors, and 30 draws cut quantiles short.
    assert table.mean() > 0.95 - 4 * math.sqrt(0.95 * 0.05 / table.size) - 0.02
    spread = np.array(pulls).std(axis=0, ddof=1)
    assert np.all(spread < 1 + 4 / math.sqrt(2 * 12)), spread
