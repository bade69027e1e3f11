"""`iscat calibrate optics`: a landing movie goes in, the file that a fit reads comes out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scenes import OPTICS_TRUTH, write_bright_landings

import iscat_analysis as ia
from iscat_analysis.config import load_config
from iscat_analysis.errors import DataError
from iscat_cli import main

Captured = pytest.CaptureFixture[str]

FREE = ["--free", "focus,phase"]
SIGMAS = 4.0


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("optics")
    write_bright_landings(folder / "movie.tif", folder / "setup.toml")
    return folder / "movie.tif"


def test_a_landing_movie_tells_its_optics(movie: Path, tmp_path: Path, capsys: Captured) -> None:
    out, setup = tmp_path / "scope", movie.with_name("setup.toml")
    given = ["calibrate", "optics", str(movie), "--config", str(setup), *FREE, "--out", str(out)]
    assert main([*given, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["accepted"]
    assert printed["particles"] >= 12
    found = {row["parameter"]: row for row in printed["parameters"]}
    for name, true in OPTICS_TRUTH.items():
        assert found[name]["state"] == "measured"
        assert abs(found[name]["value"] - true) < SIGMAS * found[name]["sigma"]
        assert found[name]["sigma"] == pytest.approx(found[name]["crb"], rel=0.2)
    assert found["na"]["state"] == "given"
    page = (out / "optics.html").read_text(encoding="utf-8")
    assert page.count("<svg") >= 5
    # the file takes over in a configuration
    taken = load_config(setup, [f"optics.file={out / 'optics.toml'}"]).optics
    assert taken.focus_nm == pytest.approx(found["focus_nm"]["value"], abs=1e-6)
    assert taken.na == 1.42


def test_an_array_is_a_movie_too(movie: Path, tmp_path: Path) -> None:
    counts, setup = tifffile.imread(movie), movie.with_name("setup.toml")
    given = {"config": setup, "free": "focus,phase"}
    found = ia.calibrate_optics(counts, name="mine", **given, out=tmp_path / "scope")
    assert found.config == ia.calibrate_optics(movie, **given).config
    assert (tmp_path / "scope" / "optics.toml").exists()
    assert "mine" in (tmp_path / "scope" / "optics.html").read_text(encoding="utf-8")
    with pytest.raises(DataError, match=r"^dark: shows no bright particle"):
        ia.calibrate_optics(counts[:40], name="dark", **given)


def test_a_movie_with_background_frames(movie: Path, tmp_path: Path, capsys: Captured) -> None:
    """All particles at once, each among the rings of the others."""
    given = ["calibrate", "optics", str(movie), *FREE, "--out", str(tmp_path / "o"), "--json"]
    given += ["--config", str(movie.with_name("setup.toml"))]
    given += ["--set", "background.frames=[0,38]", "--set", "fit.frames=[120,160]"]
    assert main(given) == 0
    printed = json.loads(capsys.readouterr().out)
    found = {r["parameter"]: r for r in printed["parameters"]}
    for name, true in OPTICS_TRUTH.items():
        assert abs(found[name]["value"] - true) < SIGMAS * found[name]["sigma"]
    # the same errors were foreseen from the truth, without the movie
    wanted = ["bounds", "--for", "optics", "--events", str(printed["particles"]), *FREE, "--json"]
    wanted += ["--config", str(movie.with_name("setup.toml"))]
    truth = {f"optics.{name}": value for name, value in OPTICS_TRUTH.items()} | {
        "particle.mass_kda": 4500, "bounds.photons_per_pixel": 2e4,
        "bounds.n_before": 38, "bounds.n_after": 40,
    }  # fmt: skip
    wanted += [word for key, value in truth.items() for word in ("--set", f"{key}={value}")]
    assert main(wanted) == 0
    foreseen = {r["parameter"]: r for r in json.loads(capsys.readouterr().out)["parameters"]}
    for name in OPTICS_TRUTH:
        # speckle makes some particles brighter than others
        assert found[name]["crb"] == pytest.approx(foreseen[name]["sigma"], rel=0.1)
        assert found[name]["sigma"] == pytest.approx(foreseen[name]["sigma"], rel=0.3)


def test_options_of_the_forecast_belong_together(tmp_path: Path, capsys: Captured) -> None:
    given = ["--set", "camera.pixel_size_nm=84.4", "--set", "particle.mass_kda=4500"]
    assert main(["bounds", "--events", "20", *given]) == 2
    assert "--for optics" in capsys.readouterr().err
    assert main(["bounds", "--for", "optics", "--scan", "z=0:100:50", *given]) == 2
    assert "stands alone" in capsys.readouterr().err
    out = tmp_path / "plan"
    given += ["--free", "focus,na,phase", "--out", str(out)]
    assert main(["bounds", "--for", "optics", "--events", "20", *given]) == 0
    assert "particles needed for" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {
        "optics_bounds.json", "needed.csv", "needed.png", "needed.svg", ".iscat-files",
    }  # fmt: skip


def test_too_few_particles_are_one_clear_line(tmp_path: Path, capsys: Captured) -> None:
    random = np.random.default_rng(5)
    tifffile.imwrite(tmp_path / "m.tif", random.poisson(500, (60, 64, 64)).astype(np.uint16))
    given = ["calibrate", "optics", str(tmp_path / "m.tif"), "--set", "camera.pixel_size_nm=84.4"]
    assert main(given) == 1
    message = capsys.readouterr().err
    assert "shows no bright particle that stands alone" in message
    assert "record brighter ones" in message
    assert "Traceback" not in message


def test_free_names_are_checked(movie: Path, tmp_path: Path, capsys: Captured) -> None:
    given = [
        "calibrate",
        "optics",
        str(movie),
        "--free",
        "focus,fokus",
        "--out",
        str(tmp_path / "o"),
    ]
    assert main(given) == 2
    assert "'fokus' cannot be set free" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("step", "said"),
    [
        ("nan", "--focus-step nan"),
        ("1e9", "--focus-step 1e+09"),
        ("0", "--focus-step 0: over 60 frames the focus rises by 0 nm"),
        ("0.02", "--focus-step 0.02: over 60 frames the focus rises by 1.18 nm"),
    ],
)
def test_a_step_that_makes_no_scan_is_refused_by_its_name(
    step: str, said: str, tmp_path: Path, capsys: Captured
) -> None:
    tifffile.imwrite(tmp_path / "m.tif", np.full((60, 64, 64), 500, dtype=np.uint16))
    given = ["calibrate", "optics", str(tmp_path / "m.tif"), "--focus-step", step, "--quiet"]
    assert main([*given, "--set", "camera.pixel_size_nm=84.4"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_the_folder_one_is_in_is_no_movie_and_no_table(
    tmp_path: Path, capsys: Captured, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name, from which that of the results is made, is empty."""
    monkeypatch.chdir(tmp_path)
    optics = ["calibrate", "optics", ".", "--set", "camera.pixel_size_nm=84.4", "--quiet"]
    for given in (optics, ["calibrate", "mass", ".", "--standards", "66,146"]):
        assert main(given) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert "unexpected" not in line
        assert ": error: .: " in line
