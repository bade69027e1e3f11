"""Rates of landing and leaving: likelihoods, pairs, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from event_tables import draw_visits

import iscat_analysis as ia
from iscat_analysis.answers.kinetics import landing_rate, pair_events, unbinding_rate

WHOLE = (0, 6000)


@pytest.mark.parametrize("depletion", [-0.03, 0.0, 0.08])
def test_the_rate_of_landings_is_where_its_likelihood_is_largest(depletion: float) -> None:
    random = np.random.default_rng(1)
    x, share = depletion * 60, random.random(400)
    times = 60 * (-np.log1p(share * np.expm1(-x)) / x if x else share)
    found = landing_rate(times, 60.0)

    def height(rate: float, k: float) -> float:
        mean = rate * (60 if abs(k) < 1e-9 else -math.expm1(-k * 60) / k)
        return 400 * math.log(rate) - k * float(times.sum()) - mean

    best = height(found.per_second, found.depletion_per_s)
    for rate in (0.99, 1.01):
        for step in (-1e-3, 1e-3):
            assert height(found.per_second * rate, found.depletion_per_s + step) < best
    # The interval of k ends where the likelihood, with the rate at its best, fell by 1.92.
    for end in (found.depletion_low, found.depletion_high):
        rate = 400 * end / -math.expm1(-end * 60)
        assert best - height(rate, end) == pytest.approx(1.92, abs=0.01)
    assert found.depletion_low < depletion < found.depletion_high
    assert (found.depletion_p < 1e-4) == (depletion != 0)
    assert found.p_value > 0.01


def test_diffusion_out_of_a_drop_is_not_exponential() -> None:
    times = 60 * np.random.default_rng(2).random(1000) ** 2  # a rate as t^(-1/2)
    assert landing_rate(times, 60.0).p_value < 1e-4


def test_few_landings_have_no_rate() -> None:
    found = landing_rate(np.arange(5.0), 60.0)
    assert found.landings == 5
    assert math.isnan(found.per_second)


def test_pairs_are_of_one_place_one_mass_and_in_order() -> None:
    frame = np.array([10.0, 20, 30, 40, 50, 5, 60])
    place = np.array([[0.0, 0], [9, 9], [0.1, 0], [9, 9.2], [5, 5], [5, 5], [20, 20]])
    mass = np.array([100.0, 200, -105, -400, 150, -150, -100])
    landing, leaving = pair_events(frame, place, mass, np.full(7, 8.0), radius_px=1.5)
    assert (landing.tolist(), leaving.tolist()) == ([0], [2])


def test_the_latest_of_two_visitors_leaves_first_and_each_once() -> None:
    frame = np.array([10.0, 20, 30, 40])
    mass = np.array([100.0, 100, -100, -100])
    landing, leaving = pair_events(frame, np.zeros((4, 2)), mass, np.full(4, 8.0), radius_px=1.0)
    assert (landing.tolist(), leaving.tolist()) == ([0, 1], [3, 2])


def test_without_censoring_the_rate_is_one_over_the_mean() -> None:
    stay = np.random.default_rng(3).exponential(4.0, 300)
    found = unbinding_rate(stay, np.full(300, 1e4), np.ones(300))
    assert found.per_second == pytest.approx(1 / stay.mean(), rel=1e-4)
    reach = 1.96 / math.sqrt(300)
    assert math.log(found.per_second / found.per_second_low) == pytest.approx(reach, rel=0.05)
    assert math.log(found.per_second_high / found.per_second) == pytest.approx(reach, rel=0.05)


def test_censored_stays_count_as_time() -> None:
    """As many leavings per time that was watched: the textbook's estimate."""
    random = np.random.default_rng(4)
    stay, censor = random.exponential(30.0, 500), random.uniform(0, 40, 500)
    seen = np.where(stay < censor, stay, np.nan)
    found = unbinding_rate(seen, censor, np.ones(500))
    watched = float(np.minimum(stay, censor).sum())
    assert found.per_second == pytest.approx(np.isfinite(seen).sum() / watched, rel=1e-4)


def test_nothing_that_leaves_gives_an_upper_end() -> None:
    found = unbinding_rate(np.full(100, np.nan), np.full(100, 10.0), np.ones(100))
    assert found.per_second == found.per_second_low == 0
    assert found.per_second_high == pytest.approx(1.92 / 1000, rel=0.01)


def test_rates_of_a_table() -> None:
    table = draw_visits(
        np.random.default_rng(5), landings=600, depletion_per_s=0.03, leaving_per_s=0.02
    )
    found = ia.fit_kinetics(table, frame_rate_hz=100, frames=WHOLE)
    assert found.landing.depletion_low < 0.03 < found.landing.depletion_high
    assert found.unbinding is not None
    assert found.unbinding.per_second_low < 0.02 < found.unbinding.per_second_high
    assert found.unbinding.chance_pairs < 0.1 * found.unbinding.pairs
    assert found.notes == ()
    assert ia.fit_kinetics(table, frame_rate_hz=100).frames[1] <= 6000
    assert ia.fit_kinetics(table[table["mass_kda"] > 0], frame_rate_hz=100).unbinding is None


def test_pairs_by_chance_are_told() -> None:
    random = np.random.default_rng(6)
    table = draw_visits(random, landings=800, depletion_per_s=0.0, leaving_per_s=0.02, field_px=15)
    found = ia.fit_kinetics(table, frame_rate_hz=100, frames=WHOLE)
    assert any("chance" in note for note in found.notes)


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({}, ia.ConfigError, "need the frames per second"),
        ({"frame_rate_hz": 0.0}, ia.ConfigError, "above 0"),
        ({"frame_rate_hz": 100.0, "frames": (50, 20)}, ia.ConfigError, "a later one"),
        ({"frame_rate_hz": 100.0, "radius_px": -1.0}, ia.ConfigError, "radius_px"),
        ({"frame_rate_hz": 100.0, "frames": (9000, 9100)}, ia.DataError, "no event lies"),
    ],
)
def test_what_is_impossible_is_refused(options: dict, error: type[Exception], said: str) -> None:
    table = draw_visits(
        np.random.default_rng(7), landings=50, depletion_per_s=0.0, leaving_per_s=0.02
    )
    with pytest.raises(error, match=said):
        ia.fit_kinetics(table, **options)


def test_a_table_without_frames_is_refused() -> None:
    with pytest.raises(ia.DataError, match="without a frame"):
        ia.fit_kinetics(pd.DataFrame({"mass_kda": [60.0] * 20}), frame_rate_hz=10)


def test_the_frame_rate_is_read_beside_the_table(tmp_path: Path) -> None:
    table = draw_visits(
        np.random.default_rng(8), landings=100, depletion_per_s=0.0, leaving_per_s=0.02
    )
    table.assign(status="ok").to_csv(tmp_path / "fits.csv", index=False)
    (tmp_path / "config.toml").write_text("[camera]\nframe_rate_hz = 100.0\n")
    with pytest.raises(ia.ConfigError):  # a configuration of whoever
        ia.fit_kinetics(tmp_path)
    (tmp_path / "summary.json").write_text("{}")
    assert ia.fit_kinetics(tmp_path).frame_rate_hz == 100
