"""Tables of events whose numbers no particle has: a sentence or a result, never a crash."""

from __future__ import annotations

import contextlib
import itertools
import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.species.events import POSSIBLE_KDA
from iscat_cli import main

NONE = np.finfo(float).max
"""What a commercial program writes where there is nothing."""

MASSES = (1e300, -1e300, NONE, 1e200, 1e150, 1e16, 1e-320, math.inf, math.nan, 0.0)
ERRORS = (1e150, NONE, 1e-320, 1e-300, math.inf, math.nan, 0.0, -1.0)
WRONG = [
    *({"mass_kda": value} for value in MASSES),
    *({"sigma_mass_kda": value} for value in ERRORS),
]
ASKED = [
    *itertools.product(("mass_kda", "sigma_mass_kda"), (1e300, NONE, 1e150, 1e-320)),
    *itertools.product(("snr", "frame", "x_px"), (NONE, 1e-320)),
]


def events(**wrong: float) -> pd.DataFrame:
    """Sixty events of two species; the first has something wrong."""
    rng = np.random.default_rng(47)
    mass = rng.normal(np.repeat([66.0, 132.0], 30), 8.0)
    table = pd.DataFrame(
        {"mass_kda": mass, "sigma_mass_kda": 8.0, "frame": np.arange(60) * 10.0, "x_px": 5.0,
         "y_px": 6.0, "snr": mass / 8.0}
    )  # fmt: skip
    for column, value in wrong.items():
        table.loc[0, column] = value
    return table


@pytest.fixture(scope="module")
def expected() -> ia.Distribution:
    """Find the species of the others."""
    rest = events()[1:].reset_index(drop=True)
    return ia.find_species(rest, k=2, draws=0, above_kda=20.0)


@pytest.mark.parametrize("wrong", WRONG, ids=str)
def test_species_leave_out_what_no_particle_has(
    wrong: dict[str, float], expected: ia.Distribution
) -> None:
    said: list[str] = []
    found = ia.find_species(events(**wrong), k=2, draws=0, above_kda=20.0, notify=said.append)
    pd.testing.assert_frame_equal(found.species, expected.species)
    assert any("1 event without a mass and an error between" in note for note in said)


def test_possible_masses_are_kept() -> None:
    """Control: what a particle can have is no reason to leave it out."""
    for value in (*POSSIBLE_KDA, -66.0):
        said: list[str] = []
        table = events(mass_kda=value)
        ia.find_species(table, k=2, draws=0, limit_kda=20.0, notify=said.append)
        assert not any("without a mass" in note for note in said)


def answers(table: pd.DataFrame) -> None:
    """Ask everything about a table, which has an answer, or none in a sentence."""
    samples = pd.DataFrame({"concentration_nm": [3.0, 30.0]})
    for question, options in (
        (ia.find_species, {"events": table, "draws": 3}),
        (ia.compare_tables, {"tables": [table, events()]}),
        (ia.fit_kinetics, {"events": table, "frame_rate_hz": 100.0}),
        (ia.fit_kd, {"samples": samples, "tables": [table, events()], "model": "dimer"}),
    ):
        with contextlib.suppress(ia.IscatError):
            question(**options)


@pytest.mark.parametrize(("column", "value"), ASKED)
def test_any_question_about_them_has_an_answer(column: str, value: float) -> None:
    answers(events().assign(**{column: value}))


def test_any_question_about_a_table_with_all_of_them_has_an_answer() -> None:
    """One wrong number in each of its first events."""
    table = events()
    for row, (column, value) in enumerate(ASKED):
        table.loc[row, column] = value
    answers(table)


@pytest.mark.parametrize("value", [1e-320, 1e300, NONE])
def test_masses_that_are_asked_for_are_bounded(value: float) -> None:
    for option in ("sigma_kda", "limit_kda", "above_kda", "ladder"):
        with pytest.raises(ia.ConfigError, match=f"`{option}` = .*: give one mass"):
            ia.find_species(events(), draws=0, **{option: value})
    with pytest.raises(ia.ConfigError, match=r"`masses_kda` = .*: give one mass"):
        ia.find_species(events(), draws=0, masses_kda=[66.0, value])
    samples = pd.DataFrame({"concentration_nm": [3.0, value]})
    with pytest.raises(ia.DataError, match="row 2 has no concentration"):
        ia.fit_kd(samples, tables=[events(), events()], model="dimer")


def test_the_command_answers_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number, (mass, sigma) in enumerate(itertools.product((1e300, NONE, 66.0), (1e150, 8.0))):
        path = tmp_path / f"{number}.csv"
        events(mass_kda=mass, sigma_mass_kda=sigma).to_csv(path, index=False)
        assert main(["species", str(path), "--k", "2", "--draws", "3"]) == 0
        left_out = "1 event without a mass and an error" in capsys.readouterr().err
        assert left_out == ((mass, sigma) != (66.0, 8.0))


@pytest.mark.parametrize("name", ["mass_kda", "sigma_mass_kda", "snr", "status"])
def test_two_columns_of_one_name(tmp_path: Path, name: str) -> None:
    table = events().assign(status="ok")
    double = pd.concat([table, table[[name]]], axis=1)
    with pytest.raises(ia.DataError, match=f"table: has two columns of the name {name}"):
        ia.find_species(double, draws=0)
    double.to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(ia.DataError, match=f"a.csv: has two columns of the name {name}"):
        ia.find_species(tmp_path / "a.csv", draws=0)
    unused = [table.assign(buffer="PBS"), table[["x_px"]].set_axis(["buffer"], axis=1)]
    other = pd.concat(unused, axis=1)
    assert ia.find_species(other, k=2, draws=0).events == 60  # not one that is used
