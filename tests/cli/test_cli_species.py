"""`iscat species` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest
from event_tables import draw_table, draw_visits

from iscat_analysis.schemas import schema
from iscat_analysis.species import Efficiency
from iscat_cli import main

EFFICIENCY = Efficiency(5.0, 13.0)


@pytest.fixture
def events(tmp_path: Path) -> Path:
    random = np.random.default_rng(2)
    table = draw_table(random, {66.0: 300, 132.0: 200}, background=10, efficiency=EFFICIENCY)
    path = tmp_path / "fits.csv"
    table.assign(status="ok", frame=1).to_csv(path, index=False)
    return path


def test_the_table_of_oligomers(events: Path, capsys) -> None:
    assert main(["species", str(events), "--ladder", "60", "--draws", "5"]) == 0
    printed = capsys.readouterr()
    heading, first, second, background, monomer = printed.out.splitlines()
    assert heading.split()[:3] == ["oligomer", "mass", "[kDa]"]
    assert [line.split()[0] for line in (first, second, background)] == ["1", "2", "background"]
    assert monomer.startswith("monomer 6")
    assert "p = " in monomer


def test_json_follows_the_schema(events: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    command = ["species", str(events), "--ladder", "66", "--draws", "3", "--out", str(out)]
    assert main([*command, "--json", "--quiet"]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    jsonschema.validate(printed, schema("species"))
    assert printed.pop("out") == str(out)
    written = json.loads((out / "species.json").read_text())
    assert written == printed
    assert len(pd.read_csv(out / "species.csv")) == 3


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        ("--k 3 --ladder 66", 2, "--k and --ladder are two descriptions"),
        ("--steps 1,2", 2, "--steps is of a ladder; give --ladder"),
        ("--ladder x", 2, "--ladder x: give the mass of the monomer"),
        ("--steps 1,a --ladder 66", 2, "--steps 1,a: write whole numbers"),
        ("--masses 66;132", 2, "--masses 66;132: write masses in kDa as in --masses 66,132"),
        ("--limit a:b", 2, "--limit a:b: write it as --limit 40"),
        ("--limit 40 --above 50", 2, "--limit and --above"),
        ("--sigma 0", 2, "--sigma 0: give one mass in kDa above 0"),
        ("--above 9000", 1, "no event lies above --above 9000"),
        ("--k 200", 1, "give a smaller --k"),
        ("--start 66,1x", 2, "--start 66,1x: write masses in kDa"),
        ("--start 66 --k 2", 2, "--k and --start"),
        ("--branch leaving", 1, "holds 0 leaving events"),
    ],
)
def test_what_is_wrong_is_said_with_the_option(
    options: str, status: int, said: str, events: Path, only_line
) -> None:
    assert said in only_line("species", str(events), *options.split(), status=status)


def test_notes_name_options(events: Path, tmp_path: Path, capsys) -> None:
    path = tmp_path / "bare.csv"
    pd.read_csv(events)[["mass_kda"]].to_csv(path, index=False)
    assert main(["species", str(path), "--k", "2", "--draws", "0"]) == 0
    error = capsys.readouterr().err
    assert "--sigma gives them one" in error
    assert "--above cuts where all are still detected" in error


def test_a_flank_of_what_is_missed_is_not_determined(tmp_path: Path, capsys) -> None:
    """Of 40 kDa a twentieth is seen, as a peak near 60 that is narrower than those of others."""
    path = tmp_path / "bare.csv"
    for light, said in ((40.0, 1), (66.0, 0)):
        random = np.random.default_rng(7)
        mass = random.normal(np.repeat([light, 150.0], [8000, 1000]), 12.0)
        limit = 65.0 if said else 20.0
        pd.DataFrame({"mass_kda": mass[random.normal(mass, 8.0) > limit]}).to_csv(path, index=False)
        assert main(["species", str(path), "--k", "2", "--draws", "4"]) == 0
        shown = capsys.readouterr()
        assert shown.out.count("not determined") == said
        assert shown.err.count("all that is seen of a lighter species") == said
    known = ["--limit", "20:8", "--draws", "4"]
    assert main(["species", str(path), "--k", "2", *known]) == 0
    assert "not determined" not in capsys.readouterr().out


def test_samples_are_compared_with_the_first(events: Path, tmp_path: Path, capsys) -> None:
    other = tmp_path / "other.csv"
    table = draw_table(np.random.default_rng(3), {66.0: 150, 132.0: 350}, efficiency=EFFICIENCY)
    table.to_csv(other, index=False)
    command = ["species", str(events), str(other), "--ladder", "66", "--steps", "1,2"]
    assert main(command) == 0
    first, heading, *rows = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{other} beside {events}: p = ")
    assert heading.startswith("species [kDa]")
    assert len(rows) == 2
    out = tmp_path / "out"
    assert main([*command, "--json", "--quiet", "--out", str(out)]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    jsonschema.validate(printed, schema("species_comparison"))
    assert printed.pop("out") == str(out)
    assert json.loads((out / "comparison.json").read_text()) == printed
    assert printed["comparisons"][0]["same_fractions"]["p_value"] < 1e-3


@pytest.mark.parametrize(
    "option", ["--offset", "--hold", "--branch=landing", "--widths=common", "--start=66"]
)
def test_what_is_for_one_table_is_refused_for_two(option: str, events: Path, only_line) -> None:
    line = only_line("species", str(events), str(events), "--ladder", "66", option)
    assert f"{option.partition('=')[0]} is for a single table" in line


@pytest.fixture
def visits(tmp_path: Path) -> Path:
    table = draw_visits(
        np.random.default_rng(3), landings=300, depletion_per_s=0.03, leaving_per_s=0.02
    )
    table.to_csv(tmp_path / "visits.csv", index=False)
    return tmp_path / "visits.csv"


def test_rates_stand_below_the_species(visits: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "rates"
    command = ["species", str(visits), "--k", "1", "--draws", "2", "--frame-rate", "100"]
    assert main([*command, "--frames", "0:6000", "--quiet"]) == 0
    landing, leaving = capsys.readouterr().out.splitlines()[-2:]
    assert landing.startswith("landing ")
    assert leaving.startswith("leaving 0.0")
    assert main([*command, "--json", "--quiet", "--out", str(out)]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    jsonschema.validate(printed, schema("species"))
    assert printed["kinetics"]["frame_rate_hz"] == 100
    assert json.loads((out / "species.json").read_text())["kinetics"] == printed["kinetics"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--frame-rate 0", "--frame-rate 0: give one number above 0"),
        ("--frames 0:100", "--frames 0:100 is for rates, which need --frame-rate"),
        ("--frames x --frame-rate 3", "write it as A:B"),
    ],
)
def test_rates_that_cannot_be_are_refused(options: str, said: str, visits: Path, only_line) -> None:
    assert said in only_line("species", str(visits), *options.split())
