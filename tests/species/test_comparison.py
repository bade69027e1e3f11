"""Two samples beside each other: what shifts, differs, and is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from event_tables import draw_table

import iscat_analysis as ia
from iscat_analysis.report.vega import figures_in
from iscat_analysis.species import Efficiency
from iscat_analysis.species.comparison import COMPARISON_COLUMNS

EFFICIENCY = Efficiency(5.0, 13.0)


def sample(seed: int, monomers: int = 400, dimers: int = 300, **more: float) -> pd.DataFrame:
    random = np.random.default_rng(seed)
    counts = {66.0: monomers, 132.0: dimers}
    return draw_table(random, counts, background=15, efficiency=EFFICIENCY, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def first() -> pd.DataFrame:
    return sample(1)


def test_a_sample_is_itself(first: pd.DataFrame) -> None:
    found = ia.compare_samples(first, first, ladder=66.0, steps=(1, 2))
    assert list(found.species.columns) == list(COMPARISON_COLUMNS)
    assert found.same.p_value > 0.99
    assert found.same.chi2 == pytest.approx(0, abs=0.05)
    assert (found.same.dof, found.same_masses.dof, found.same_fractions.dof) == (3, 2, 1)
    assert np.allclose(found.species["shift_kda"], 0, atol=0.05)
    assert np.allclose(found.species["difference"], 0, atol=1e-3)


def test_a_shift_and_a_difference_are_told_apart(first: pd.DataFrame) -> None:
    shifted = ia.compare_samples(first, sample(2, scale=1.05), ladder=66.0, steps=(1, 2))
    assert shifted.same_masses.p_value < 1e-6
    assert shifted.same_fractions.p_value > 1e-3
    assert shifted.species["shift_percent"][1] == pytest.approx(5, abs=1.5)
    low, high = shifted.species["shift_percent_low"][1], shifted.species["shift_percent_high"][1]
    assert low < 5 < high
    mixed = ia.compare_samples(first, sample(3, 200, 500), ladder=66.0, steps=(1, 2))
    assert mixed.same_fractions.p_value < 1e-6
    assert mixed.same_masses.p_value > 1e-3
    assert mixed.species["difference"][0] == pytest.approx(2 / 7 - 4 / 7, abs=0.1)
    assert mixed.species["difference"].sum() == pytest.approx(0, abs=1e-9)


def test_turned_round_everything_changes_its_sign(first: pd.DataFrame) -> None:
    there = ia.compare_samples(first, sample(3, 200, 500, scale=1.02), ladder=66.0, steps=(1, 2))
    back = ia.compare_samples(sample(3, 200, 500, scale=1.02), first, ladder=66.0, steps=(1, 2))
    assert there.same.chi2 == pytest.approx(back.same.chi2, rel=1e-2)
    for column, error in (("shift_kda", "shift_se"), ("difference", "difference_se")):
        forth = there.species[column].to_numpy()
        assert np.allclose(forth, -back.species[column], atol=0.1 * there.species[error].min())


def test_rare_species_have_no_shift(first: pd.DataFrame) -> None:
    found = ia.compare_samples(first, sample(4, 400, 3), ladder=66.0, steps=(1, 2))
    assert np.isfinite(found.species["shift_kda"][0])
    assert np.isnan(found.species["shift_kda"][1])
    assert found.same_masses.dof == 1
    assert found.same_fractions.p_value < 1e-6


def test_many_are_compared_as_each_would_be(first: pd.DataFrame, tmp_path: Path) -> None:
    others = [sample(5), sample(6, 300, 400), sample(7, scale=1.03)]
    notes: list[str] = []
    many = ia.compare_tables([first, *others], ladder=66.0, steps=(1, 2), out=tmp_path / "out",
                             notify=notes.append)  # fmt: skip
    one = ia.compare_tables([first, *others], ladder=66.0, steps=(1, 2), workers=1)
    assert [c.to_dict() for c in many] == [c.to_dict() for c in one]
    alone = ia.compare_samples(first, others[1], ladder=66.0, steps=(1, 2))
    assert many[1].same.chi2 == pytest.approx(alone.same.chi2, rel=0.05)
    written = json.loads((tmp_path / "out" / "comparison.json").read_text())
    assert [row["source"] for row in written["comparisons"]] == ["table 2", "table 3", "table 4"]
    rows = pd.read_csv(tmp_path / "out" / "comparison.csv")
    assert len(rows) == 6
    drawn = figures_in(tmp_path / "out" / "comparison.html")
    assert drawn["shifts"].data["rows"]["name"] == [f"table {n}" for n in (2, 2, 3, 3, 4, 4)]
    moved = drawn["shifts"].data["rows"]["x"]
    np.testing.assert_allclose(moved, rows["shift_kda"], rtol=1e-5)


def test_notes_tell_of_chance_and_of_the_scale(first: pd.DataFrame) -> None:
    notes: list[str] = []
    table = first.assign(systematic_mass_kda=1.0)
    ia.compare_tables([table] * 7, k=2, notify=notes.append)
    assert any("by chance alone" in note for note in notes)
    assert any("that of the mass scale" in note for note in notes)


def test_too_few_are_refused(first: pd.DataFrame) -> None:
    with pytest.raises(ia.DataError, match="two tables"):
        ia.compare_tables([first])
    with pytest.raises(ia.DataError, match="table 2: holds 4 events, too few to compare"):
        ia.compare_samples(first, first.head(4))
    with pytest.raises(ia.ConfigError, match="give one of them"):
        ia.compare_samples(first, first, k=2, ladder=66.0)
