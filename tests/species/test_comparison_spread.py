"""Two samples over many draws: uniform p-values where they are one, and controls that must fail."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from event_tables import draw_table
from numpy.typing import NDArray
from scipy.stats import kstest

import iscat_analysis as ia
from iscat_analysis.species import Comparison, Efficiency

QUIET, NOISY = Efficiency(5.0, 10.0), Efficiency(5.0, 13.0)
MASSES, SHARES = (66.0, 132.0, 264.0), (0.5, 0.3, 0.2)


def draw(
    random: np.random.Generator,
    number: int,
    efficiency: Efficiency,
    *,
    shares: tuple[float, ...] = SHARES,
    scale: float = 1.0,
) -> pd.DataFrame:
    counts = dict(zip(MASSES, random.multinomial(number, shares).tolist(), strict=True))
    sigma = (0.45 * efficiency.sigma_kda, 0.9 * efficiency.sigma_kda)
    return draw_table(
        random, counts, sigma=sigma, background=number // 30, efficiency=efficiency, scale=scale
    )


def compared(first: pd.DataFrame, other: pd.DataFrame, **options: float) -> Comparison:
    return ia.compare_samples(first, other, ladder=66.0, steps=(1, 2, 4), **options)  # type: ignore[arg-type]


def p_of(found: Comparison) -> list[float]:
    return [test.p_value for test in (found.same, found.same_masses, found.same_fractions)]


@pytest.mark.large
def test_equal_samples_differ_as_often_as_they_should(
    repetitions: Callable[[int, int], int],
) -> None:
    """The samples are one; their sizes, errors and detectors are not."""
    trials = repetitions(40, 400)
    p_values, blind, pulls, inside = [], [], [], []
    for seed in range(trials):
        random = np.random.default_rng([83, seed])
        first, other = draw(random, 1200, NOISY), draw(random, 800, QUIET)
        found = compared(first, other)
        p_values.append(p_of(found))
        species = found.species
        shift, difference = species["shift_kda"], species["difference"]
        pulls.append([*(shift / species["shift_se"]), *(difference / species["difference_se"])])
        holds = [(species[f"{name}_low"] < 0) & (species[f"{name}_high"] > 0)
                 for name in ("shift", "difference")]  # fmt: skip
        inside.append(np.concatenate(holds))
        blind.append(p_of(compared(first, other, limit_kda=1.0)))
    p = np.array(p_values)
    assert [float(kstest(column, "uniform").pvalue) > 1e-3 for column in p.T] == [True] * 3
    pull = np.array(pulls)
    assert np.all(np.abs(pull.mean(axis=0)) < 4 * pull.std(axis=0) / math.sqrt(trials))
    assert np.all(np.abs(pull.std(axis=0) - 1) < 4 / math.sqrt(2 * trials))
    covered = float(np.mean(inside))
    assert covered > 0.95 - 4 * math.sqrt(0.95 * 0.05 / (trials * pull.shape[1] / 2))
    # The control: who forgets that the detectors differ finds a difference that is none.
    assert np.median(np.array(blind)[:, 0]) < 1e-3


def test_differences_are_found_and_measured(repetitions: Callable[[int, int], int]) -> None:
    """A shift of 1 % and eight monomers of a hundred that became dimers, beyond chance."""
    trials = repetitions(16, 200)
    shifts, differences, inside, p_values = [], [], [], []
    changed = (0.42, 0.38, 0.2)
    truth: NDArray[np.float64] = np.array([-0.08, 0.08, 0.0])
    for seed in range(trials):
        random = np.random.default_rng([84, seed])
        found = compared(
            draw(random, 2000, NOISY), draw(random, 2000, QUIET, shares=changed, scale=1.01)
        )
        species = found.species
        shifts.append(species["shift_percent"].tolist())
        differences.append(species["difference"].tolist())
        inside.append([*((species["shift_percent_low"] < 1) & (species["shift_percent_high"] > 1)),
                       *((species["difference_low"] < truth)
                         & (species["difference_high"] > truth))])  # fmt: skip
        p_values.append(p_of(found))
    for values, expected in ((shifts, np.ones(3)), (differences, truth)):
        table = np.array(values)
        error = table.std(axis=0, ddof=1) / math.sqrt(trials)
        assert np.all(np.abs(table.mean(axis=0) - expected) < 4 * error)
    assert np.mean(inside) > 0.95 - 4 * math.sqrt(0.95 * 0.05 / (6 * trials / 2))
    assert np.median(np.array(p_values), axis=0).max() < 1e-3
