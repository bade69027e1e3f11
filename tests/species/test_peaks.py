"""Species are peaks, what is none of them is background, and limits are integrated over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

import iscat_analysis as ia
from iscat_analysis.species.choices import Searched, by_peaks, top_of
from iscat_analysis.species.events import Edge, Events
from iscat_analysis.species.mixture import Mixture, broad
from iscat_analysis.species.repeats import possible_edges
from iscat_analysis.species.structure import width_prior

Array = NDArray[np.float64]
SHARES = (0.5, 0.3, 0.2)


def clean(seed: int) -> pd.DataFrame:
    """Draw three standards as an instrument without errors exports them."""
    random = np.random.default_rng([61, seed])
    mass = random.normal(
        np.repeat([66.0, 146, 480], [500, 300, 200]), np.repeat([9, 11, 20], [500, 300, 200])
    )
    return pd.DataFrame({"mass_kda": mass})  # fmt: skip


def species_of(found: ia.Distribution) -> pd.DataFrame:
    return found.species[~found.species["outlier"]]


def test_a_clean_table_without_errors_has_its_shares() -> None:
    """The lightest was not determined, as the flank of something that was missed."""
    for seed in range(4):
        found = ia.find_species(clean(seed), draws=30)
        assert len(found.species) == 3
        assert found.species["mass_kda"].to_numpy() == pytest.approx([66, 146, 480], rel=0.02)
        for share, one in zip(SHARES, found.species.itertuples(), strict=True):
            assert one.fraction_low < share < one.fraction_high < share + 0.15
        assert not any("determined" in note for note in found.notes)


def test_a_shoulder_is_no_second_species_and_is_told() -> None:
    """A protein of which a part is heavier, as albumin, and one that is not."""
    random = np.random.default_rng(3)
    counts = [700, 500, 400]
    mass = random.normal(np.repeat([60.0, 76, 200], counts), np.repeat([8.0, 14, 14], counts))
    found = ia.find_species(pd.DataFrame({"mass_kda": mass}), draws=4)
    skewed, other = species_of(found).to_dict("records")
    assert skewed["mass_kda"] == pytest.approx(62, abs=3)
    assert skewed["mean_kda"] == pytest.approx(mass[:1200].mean(), abs=2.5)
    assert skewed["mean_kda"] > skewed["mass_kda"] + 1.5
    assert skewed["count"] == pytest.approx(1200, abs=30)
    assert other["mass_kda"] == pytest.approx(200, abs=3)
    (note,) = [note for note in found.notes if "skewed" in note]
    assert "describes it better" in note
    apart = ia.find_species(pd.DataFrame({"mass_kda": mass}), start_kda=[60.0, 76, 200], draws=0)
    assert len(apart.species) == 3  # where somebody asks for them


def test_a_valley_makes_two_species() -> None:
    events = Events(np.linspace(40, 120, 50), np.ones(50), None)
    for apart, kinds in ((15.0, (0, 0)), (26.0, (0, 1))):
        pair = Mixture(np.array([0.5, 0.5]), np.array([60.0, 60 + apart]), np.array([99.0, 99.0]))
        assert by_peaks(events, pair).kind == kinds  # two normal ones have one top within 2 widths
    assert top_of(np.ones(2), np.array([60.0, 61.0]), np.full(2, 9.0)) == pytest.approx(
        60.5, abs=0.02
    )


def test_a_background_is_no_species_and_takes_no_tails() -> None:
    random = np.random.default_rng(8)
    for dirt in (0, 200):
        true = np.repeat([66.0, 132.0], [500, 500])
        mass = np.append(random.normal(true, 10.0), np.exp(random.uniform(3.5, 7.0, dirt)))
        found = ia.find_species(pd.DataFrame({"mass_kda": mass}), draws=4)
        known = species_of(found)
        assert known["mass_kda"].to_numpy() == pytest.approx([66, 132], abs=3)
        assert known["count"].to_numpy() == pytest.approx([500, 500], abs=60)
        assert known["width_kda"].to_numpy() == pytest.approx([10, 10], abs=1.5)
        if dirt:
            nothing = found.species.iloc[-1]
            assert nothing["background"]
            assert nothing["count"] == pytest.approx(dirt, abs=60)
            assert nothing[["mass_kda", "mass_low", "fraction", "count_corrected"]].isna().all()
        else:
            assert "background" not in found.species


def test_the_background_is_even_over_octaves() -> None:
    events = Events(np.geomspace(20, 2000, 100), np.ones(100), None)
    mean, variance = broad(events)
    x = np.geomspace(40, 1000, 60)
    density = norm.pdf(x[:, None], mean, np.sqrt(variance)).sum(axis=1) * x
    assert density.std() / density.mean() < 0.1
    assert np.all(np.sqrt(variance) > 0.3 * mean)  # and slow over any peak


def test_the_prior_of_widths_knows_no_unit_and_doubts_what_is_off_the_trend() -> None:
    mass = np.array([66.0, 146.0, 480.0])

    def doubt(width: Array, mass: Array = mass) -> float:
        rows, middle = width_prior(mass)
        return float(np.sum((rows @ np.log(width) - middle) ** 2))

    trend = np.sqrt(mass)
    assert doubt(trend) < 0.1
    assert doubt(10 * trend, 1000 * mass) == pytest.approx(doubt(trend), abs=0.1)
    assert doubt(np.ones(3)) < 2  # as where all have the noise of one background
    assert doubt(mass) < 2
    assert doubt(trend * [1, 4, 1]) > 9


def test_a_limit_within_the_lightest_peak_is_told_or_doubted() -> None:
    """Of what a limit leaves of a peak, the truth lies within what is possible."""
    random = np.random.default_rng(5)
    true = np.repeat([66.0, 146.0], [2000, 1000])
    mass = random.normal(true, 11.0)
    for limit, softness in ((0.0, 0.0), (60.0, 7.0)):
        seen = mass[random.normal(mass, softness) > limit] if limit else mass
        events = Events(seen, np.ones(seen.size), None)
        found = Searched().choose(events)
        possible = possible_edges(events, found, 2.5)
        assert sum(one.probability for one in possible) == pytest.approx(1)
        share = [one.mixture.detected(one.events)[0] for one in possible]
        truth = np.count_nonzero(seen < 106) / 2000
        assert min(share) <= truth + 0.02
        assert max(share) >= truth - 0.02
        if not limit:
            likely = sum(
                one.probability for one in possible if one.mixture.detected(one.events)[0] > 0.9
            )
            assert likely > 0.95
    chance = Edge.at(60.0, 7.0).extra_sigma(np.ones(3))
    assert chance.tolist() == [7.0] * 3


def test_shares_hold_the_doubt_about_a_limit() -> None:
    random = np.random.default_rng(6)
    mass = random.normal(np.repeat([66.0, 146.0], [900, 900]), 11.0)
    table = pd.DataFrame({"mass_kda": mass[random.normal(mass, 7.0) > 58]})
    blind = ia.find_species(table, draws=60).species
    known = ia.find_species(table, draws=60, limit_kda=58, limit_sigma_kda=7).species
    assert blind["fraction_low"][0] < 0.5 < blind["fraction_high"][0]
    assert known["fraction_low"][0] < 0.5 < known["fraction_high"][0]
    width = [one["fraction_high"][0] - one["fraction_low"][0] for one in (blind, known)]
    assert width[0] > 1.2 * width[1]


def test_the_measured_standards_are_one_species_each(data_dir: Path) -> None:
    path = data_dir / "refeyn_events_2.4.2.h5"
    if not path.exists():
        pytest.skip(f"no measured table: {path} is absent")
    found = ia.find_species(path, draws=20)
    known = species_of(found)
    assert known["mass_kda"].to_numpy() == pytest.approx([60, 147, 481, 1000], rel=0.04)
    assert known["mean_kda"][0] == pytest.approx(66, rel=0.06)
    assert known["fraction"].notna().all()
    assert found.species["background"].tolist() == [False] * 4 + [True]


@pytest.mark.parametrize("cut", [60.0, 70.0])
def test_a_peak_that_a_program_cut_is_completed(cut: float) -> None:
    """Nobody says so: as many as lie below are missing, and the rest looked like two peaks."""
    table = clean(5)
    found = ia.find_species(table[table["mass_kda"] > cut], draws=40).species
    assert len(found) == 3
    assert found["mass_kda"][0] == pytest.approx(66, abs=4)
    for share, one in zip(SHARES, found.itertuples(), strict=True):
        assert one.fraction_low < share < one.fraction_high
    assert found["count_corrected"][0] == pytest.approx(500, rel=0.35)
    assert found["count"][0] < 400


def test_what_is_left_of_a_peak_that_a_program_cut_is_one_species() -> None:
    """It was two, one of them all that the cut left of the flank."""
    random = np.random.default_rng([5, 9])
    mass = random.normal(np.repeat([66.0, 146.0], [2000, 500]), 9.0)
    found = ia.find_species(pd.DataFrame({"mass_kda": mass[mass > 58]}), draws=0).species
    assert found["mass_kda"].to_numpy() == pytest.approx([66, 146], abs=1.5)
