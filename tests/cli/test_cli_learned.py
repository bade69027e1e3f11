"""`iscat-fit` on a microscope that is not the configured one; `--measured` where none would do."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scenes import OPTICS_TRUTH, write_bright_landings

from iscat_cli import main, main_fit

Captured = pytest.CaptureFixture[str]

SYSTEMATIC = [f"systematic_{name}" for name in ("x_nm", "y_nm", "mass_kda")]


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("learned")
    write_bright_landings(folder / "movie.tif", folder / "setup.toml")
    return folder / "movie.tif"


@pytest.mark.large
def test_what_was_learned_is_not_learned_again(movie: Path, tmp_path: Path) -> None:
    first, again = tmp_path / "first", tmp_path / "again"
    setup = str(movie.with_name("setup.toml"))
    assert main_fit([str(movie), "--config", setup, "--out", str(first)]) == 0
    learned = json.loads((first / "summary.json").read_text(encoding="utf-8"))["optics"]
    assert learned["calibrated"]
    assert main_fit([str(movie), "--config", str(first / "config.toml"), "--out", str(again)]) == 0
    assert "optics" not in json.loads((again / "summary.json").read_text(encoding="utf-8"))
    one, two = (pd.read_csv(folder / "fits.csv") for folder in (first, again))
    pd.testing.assert_frame_equal(one, two)
    assert len(one) == 16
    assert np.all(one[SYSTEMATIC[2]] > 0)
    assert set(SYSTEMATIC) <= set(one.columns)
    values = {row["parameter"]: row for row in learned["parameters"]}
    for name, true in OPTICS_TRUTH.items():
        assert abs(values[name]["value"] - true) < 4 * values[name]["sigma"]


def test_a_measured_template_serves_a_fit(movie: Path, tmp_path: Path, capsys: Captured) -> None:
    out, setup = tmp_path / "picture", str(movie.with_name("setup.toml"))
    given = ["calibrate", "optics", str(movie), "--config", setup, "--measured"]
    assert main([*given, "--free", "focus", "--out", str(out)]) == 2
    assert "leave out --free" in capsys.readouterr().err
    assert main([*given, "--out", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["accepted"]
    assert {path.name for path in out.iterdir()} == {
        "optics.toml", "template.npz", "template.json", "template.html", ".iscat-files",
    }  # fmt: skip
    with_it = ["--config", setup, "--set", f"optics.file={out / 'optics.toml'}"]
    assert main_fit([str(movie), *with_it, "--out", str(tmp_path / "fits")]) == 0
    table = pd.read_csv(tmp_path / "fits" / "fits.csv")
    assert len(table) == 16
    assert table["crb_mass_kda"].notna().all()
    assert table["qcrb_mass_kda"].isna().all()
    # there is no quantum bound of a picture, and the command that shows both says so
    assert main(["bounds", *with_it]) == 2
    assert "has no quantum bound" in capsys.readouterr().err
