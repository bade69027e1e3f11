"""Rates over many draws: unbiased, intervals that hold the truth, a control that must fail."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from event_tables import draw_visits

import iscat_analysis as ia
from iscat_analysis import Kinetics
from iscat_analysis.answers.kinetics import UnbindingRate
from iscat_analysis.species import Efficiency

MISSING = Efficiency(5.0, 27.0)  # 71 % of 150 kDa are seen
DEPLETION, LEAVING = 0.03, 0.02


def draw(seed: int, **more: float) -> Kinetics:
    random = np.random.default_rng([57, seed])
    table = draw_visits(
        random, landings=400, depletion_per_s=DEPLETION, leaving_per_s=LEAVING, efficiency=MISSING
    )
    if more:
        table = table.drop(columns="snr")
    return ia.fit_kinetics(table, frame_rate_hz=100, frames=(0, 6000))


def test_rates_are_unbiased_and_their_intervals_hold_the_truth(
    repetitions: Callable[[int, int], int],
) -> None:
    trials = repetitions(60, 600)
    first = 400 * DEPLETION / -math.expm1(-DEPLETION * 60)
    seen = float(MISSING(150.0))
    landing, leaving, p_values, blind = [], [], [], []
    for seed in range(trials):
        found = draw(seed)
        landing.append(found.landing)
        assert isinstance(found.unbinding, UnbindingRate)
        leaving.append(found.unbinding)
        p_values.append(found.landing.p_value)
        unaware = draw(seed, blind=1.0).unbinding
        assert unaware is not None
        blind.append(unaware.per_second)
    rates = {
        # The threshold at 150 kDa is soft: Φ of the mass is what is seen to within a per cent.
        "first": (first * seen, [(r.per_second, r.per_second_low, r.per_second_high)
                                 for r in landing]),
        "depletion": (DEPLETION, [(r.depletion_per_s, r.depletion_low, r.depletion_high)
                                  for r in landing]),
        "leaving": (LEAVING, [(r.per_second, r.per_second_low, r.per_second_high)
                              for r in leaving]),
    }  # fmt: skip
    for name, (truth, found_rates) in rates.items():
        value, low, high = np.array(found_rates).T
        error = value.std(ddof=1) / math.sqrt(trials)
        assert abs(value.mean() - truth) < 4 * error + 0.01 * truth, name
        held = np.mean((low < truth) & (high > truth))
        assert held > 0.95 - 4 * math.sqrt(0.95 * 0.05 / trials), name
    assert np.mean(np.array(p_values) < 0.05) < 0.05 + 4 * math.sqrt(0.05 * 0.95 / trials)
    # The control: who thinks that every leaving is seen finds too slow a rate.
    assert np.mean(blind) < 0.85 * LEAVING
