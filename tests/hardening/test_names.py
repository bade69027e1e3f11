"""One movie, one name, one file costs only itself."""

from __future__ import annotations

import csv
import json
import os
import shutil
import threading
from pathlib import Path

import pandas as pd
import pytest
from small_movies import SETUP, analysed, put_in_place_of_fits

import iscat_analysis as ia
from iscat_analysis.report.vega import figures_in
from iscat_cli import main

NAMES = [
    "a$\\frac$", "=1+1", "+1+1", "@a", "-1+1", "'=a", "\x1b[31mred", "\u202egpj", "<b>&amp;\"",
    "NA", "_hidden", "a\nb", os.fsdecode(b"not \xff\xfe text"), "plain",
]  # fmt: skip
WRITTEN = [name.encode("utf-8", "backslashreplace").decode() for name in NAMES]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Make a movie and its result."""
    return analysed(tmp_path_factory.mktemp("made"))


@pytest.fixture
def lab(made: Path, tmp_path: Path, monkeypatch) -> Path:
    """Return a folder of movies whose fits are all done."""
    put_in_place_of_fits(made, monkeypatch)
    folder = tmp_path / "lab"
    folder.mkdir()
    for name in NAMES:
        shutil.copy(made / "movie.tif", folder / f"{name}.tif")
    return folder


@pytest.mark.filterwarnings("ignore:Glyph:UserWarning")
def test_a_day_of_all_names(lab: Path, capsys) -> None:
    out = lab.parent / "out"
    found = ia.batch(lab, out=out, config=SETUP)
    assert found.failed == ()
    assert sorted(found.analysed) == sorted(WRITTEN)
    assert sorted(found.movies["sample"]) == sorted(WRITTEN)
    assert sorted(pd.read_parquet(out / "events.parquet")["sample"].unique()) == sorted(WRITTEN)
    for table in out.glob("*.csv"):
        with table.open(encoding="utf-8", newline="") as file:
            cells = [cell for row in csv.reader(file) for cell in row]
        assert not [c for c in cells if c.startswith(tuple("=+@")) or c.startswith("-1+")]
    shown = set(figures_in(found.page)["stacked"].data["rows"]["panel"])
    assert {"a$\\frac$  (2)", "\\x1b[31mred  (2)", "=1+1  (2)", "a\nb  (2)"} <= shown
    page = found.page.read_text(encoding="utf-8")
    assert not {"\x1b", "\u202e"} & set(page)
    capsys.readouterr()
    assert main(["batch", str(lab), "--out", str(out), *_settings()]) == 0
    said = capsys.readouterr()
    assert "\\x1b[31mred" in said.out
    assert not {"\x1b", "\u202e"} & set(said.out + said.err)


def _settings() -> list[str]:
    words = (f"{key}={json.dumps(value)}" for key, value in SETUP.items())
    return [word for setting in words for word in ("--set", setting)]


def test_messages_reach_a_terminal_as_text(tmp_path: Path, capsys) -> None:
    assert main(["fit", str(tmp_path / "\x1b]0;mine\x07\u202e.tif")]) == 1
    said = capsys.readouterr().err
    assert "\\x1b]0;mine\\x07\\u202e.tif" in said
    assert not {"\x1b", "\x07", "\u202e"} & set(said)


@pytest.mark.parametrize("share", [0.0, 0.7])
def test_damaged_results_cost_only_themselves(lab: Path, share: float) -> None:
    damaged = {"NA": "fits.parquet", "=1+1": "summary.json", "@a": "config.toml"}
    for path in lab.iterdir():
        if path.stem not in ("plain", *damaged):
            path.unlink()
    out = lab.parent / "out"
    ia.batch(lab, out=out, config=SETUP)
    files = [out / "movies" / f"{movie}.iscat" / name for movie, name in damaged.items()]
    kept = [file.read_bytes() for file in files]
    for file, content in zip(files, kept, strict=True):
        file.write_bytes(content[: round(share * len(content))])
    shutil.copy(lab / "plain.tif", lab / "another.tif")
    told: list[str] = []
    found = ia.batch(lab, out=out, config=SETUP, notify=told.append)
    assert found.failed == ()
    assert sorted(found.analysed) == sorted([*damaged, "another"])
    assert sum("is damaged, and is made anew" in line for line in told) == len(damaged)
    assert [file.read_bytes() for file in files] == kept
    assert ia.batch(lab, out=out, config=SETUP).analysed == ()


def test_watching_goes_on_beside_a_name_that_is_no_text(lab: Path) -> None:
    for path in lab.iterdir():
        if path.stem not in ("plain", NAMES[-2]):
            path.unlink()
    stop, told = threading.Event(), []

    def notify(line: str) -> None:
        told.append(line)
        if "the page is" in line:
            stop.set()

    found = ia.watch(lab, config=SETUP, interval_s=0.05, stop=stop, notify=notify)
    assert found is not None
    assert found.failed == ()
    assert sorted(found.movies["state"]) == ["done", "done"]
