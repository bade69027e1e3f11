"""`iscat kd` as a user meets it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest
from event_tables import draw_series

from iscat_analysis.movie import path_beside
from iscat_analysis.schemas import schema
from iscat_cli import main


@pytest.fixture
def samples(tmp_path: Path) -> Path:
    totals = np.array([[3.0], [30.0], [100.0]])
    random = np.random.default_rng(4)
    for number, table in enumerate(draw_series(random, "dimer", totals, 10.0, [66.0], number=400)):
        table.to_csv(tmp_path / f"{number}.csv", index=False)
    rows = pd.DataFrame({"path": [f"{n}.csv" for n in range(3)], "concentration_nm": totals[:, 0]})
    rows.to_csv(tmp_path / "samples.csv", index=False)
    return tmp_path / "samples.csv"


def test_the_table_and_kd(samples: Path, capsys) -> None:
    assert main(["kd", str(samples), "--model", "dimer", "--masses", "66"]) == 0
    heading, *rows, last = capsys.readouterr().out.splitlines()
    assert heading.split()[:3] == ["table", "concentration", "[nM]"]
    assert [row.split()[0] for row in rows] == ["0.csv", "1.csv", "2.csv"]
    assert last.startswith("K_D = ")
    assert "of the equilibrium" in last


def test_a_table_with_semicolons_and_decimal_commas_is_the_same(samples: Path, capsys) -> None:
    """As a spreadsheet saves it where numbers are written so."""
    command = ["kd", str(samples), "--model", "dimer", "--masses", "66", "--quiet"]
    assert main(command) == 0
    expected = capsys.readouterr().out
    pd.read_csv(samples).to_csv(samples, index=False, sep=";", decimal=",")
    assert main(command) == 0
    assert capsys.readouterr().out == expected


def test_json_follows_the_schema(samples: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    command = ["kd", str(samples), "--model", "dimer", "--masses", "66", "--inactive"]
    assert main([*command, "--out", str(out), "--json", "--quiet"]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    jsonschema.validate(printed, schema("kd"))
    assert printed.pop("out") == str(out)
    assert json.loads((out / "kd.json").read_text()) == printed
    assert printed["inactive_se"] is not None


@pytest.mark.parametrize(
    ("options", "status", "said"),
    [
        ("--model ab", 2, "--masses: model ab needs the masses of A and B"),
        ("--model ab --masses 40,80", 1, "no column a_nm"),
        ("--model dimer --masses 66,80", 2, "--masses: model dimer takes the mass of the monomer"),
        ("--model dimer --masses x", 2, "--masses x: write masses in kDa"),
        ("--model dimer --landing 3", 2, "--landing 3: must lie between -1 and 1"),
        ("--model trimer", 2, "'trimer' is not one of 'dimer', 'ab'"),
        ("", 2, "Missing option '--model'"),
    ],
)
def test_what_is_wrong_is_said_with_the_option(
    options: str, status: int, said: str, samples: Path, only_line
) -> None:
    assert said in only_line("kd", str(samples), *options.split(), status=status)


FORMATS = [
    ("{}.TIF", "{}.ome.tiff", "{}.nd2"), ("{}.npy", "{}.mp", "{}"),
    ("{}.zarr", "{}.h5::/run/movie", "{}.bin::64x64,uint16"),
]  # fmt: skip


@pytest.mark.parametrize("formats", FORMATS)
def test_a_movie_of_any_format_stands_for_its_result(
    formats: tuple[str, ...], samples: Path, tmp_path: Path, capsys
) -> None:
    """The movies themselves may be elsewhere; a table beside a result is not its movie."""
    addresses = [Path(name.format(number)) for number, name in enumerate(formats)]
    for number, address in enumerate(addresses):
        folder = path_beside(tmp_path / "day" / address, ".iscat")
        folder.mkdir(parents=True)
        shutil.copy(tmp_path / f"{number}.csv", folder / "fits.csv")
        summary = {"input": {"path": f"elsewhere/{address}"}}
        (folder / "summary.json").write_text(json.dumps(summary))
    expected = [len(pd.read_csv(tmp_path / f"{number}.csv")) for number in range(3)]
    rows = pd.read_csv(samples)
    rows["path"] = [f"day/{address}" for address in addresses]
    shutil.copy(tmp_path / "2.csv", tmp_path / "day" / "0.csv")
    rows.loc[3] = ["day/0.csv", 90.0]
    rows.to_csv(samples, index=False)
    assert main(["kd", str(samples), "--model", "dimer", "--masses", "66", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["samples"]
    assert [row["events"] for row in found] == [*expected, expected[2]]
