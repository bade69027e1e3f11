"""Ladders over many draws: unbiased, intervals that hold the truth, and controls that must fail."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from event_tables import draw_table

import iscat_analysis as ia
from iscat_analysis.species import Efficiency

EFFICIENCY = Efficiency(5.0, 13.0)  # 54 % of 66 kDa are seen
TRUTH = np.array([66.0, 0.5, 0.3, 0.2])


def test_ladders_are_unbiased_and_their_intervals_hold_the_truth(
    repetitions: Callable[[int, int], int],
) -> None:
    trials = repetitions(16, 200)
    values, inside, blind, p_values = [], [], [], []
    for seed in range(trials):
        random = np.random.default_rng([71, seed])
        counts = random.multinomial(1000, TRUTH[1:])
        oligomers = dict(zip((66.0, 132.0, 264.0), counts.tolist(), strict=True))
        table = draw_table(random, oligomers, background=30, efficiency=EFFICIENCY)
        found = ia.find_species(table, ladder=62.0, steps=(1, 2, 4), draws=40, seed=seed)
        missed = ia.find_species(table, ladder=62.0, steps=(1, 2, 4), draws=0, limit_kda=1.0)
        ladder, species = found.ladder, found.species
        assert ladder is not None
        values.append([ladder.monomer_kda, *species["fraction"][:3]])
        blind.append(missed.species["fraction"][0])
        p_values.append(ladder.p_value)
        low = np.array([ladder.monomer_low, *species["fraction_low"][:3]])
        high = np.array([ladder.monomer_high, *species["fraction_high"][:3]])
        inside.append((low < TRUTH) & (high > TRUTH))
    table_of = np.array(values)
    error = table_of.std(axis=0, ddof=1) / math.sqrt(trials)
    assert np.all(np.abs(table_of.mean(axis=0) - TRUTH) < 4 * error)
    held = np.array(inside, dtype=float)
    # The fractions of a trial add up to 1: four intervals are worth two.
    allowed = 0.95 - 4 * math.sqrt(0.95 * 0.05 / (held.size / 2))
    assert held.mean() > allowed, held.mean(axis=0)
    assert np.mean(np.array(p_values) < 0.05) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / trials)
    # The control: who takes nothing for missed finds too few monomers.
    assert (TRUTH[1] - np.mean(blind)) / error[1] > 10
