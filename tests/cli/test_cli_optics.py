"""`iscat calibrate optics`: a landing movie goes in, the file that a fit reads comes out."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import tifffile
from scenes import OPTICS_TRUTH, write_bright_landings

import iscat_analysis as ia
from iscat_analysis.config import load_config
from iscat_analysis.errors import DataError
from iscat_analysis.report.vega import figures_in
from iscat_analysis.schemas import schema
from iscat_cli import main

Captured = pytest.CaptureFixture[str]

FREE = ["--free", "focus,phase"]
SIGMAS = 4.0


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("optics")
    write_bright_landings(folder / "movie.tif", folder / "setup.toml")
    return folder / "movie.tif"


@pytest.fixture(scope="module")
def scope(movie: Path) -> Path:
    """Learn the optics of the movie; what is printed lies in the folder as well."""
    out, setup = movie.with_name("scope"), movie.with_name("setup.toml")
    given = ["calibrate", "optics", str(movie), "--config", str(setup), *FREE, "--out", str(out)]
    with redirect_stdout(io.StringIO()) as printed:
        assert main([*given, "--json"]) == 0
    (out / "printed.json").write_text(printed.getvalue(), encoding="utf-8")
    return out


def test_a_landing_movie_tells_its_optics(movie: Path, scope: Path) -> None:
    printed = json.loads((scope / "printed.json").read_text(encoding="utf-8"))
    assert printed["accepted"]
    assert printed["particles"] >= 12
    found = {row["parameter"]: row for row in printed["parameters"]}
    for name, true in OPTICS_TRUTH.items():
        assert found[name]["state"] == "measured"
        assert abs(found[name]["value"] - true) < SIGMAS * found[name]["sigma"]
        assert found[name]["sigma"] == pytest.approx(found[name]["crb"], rel=0.2)
    assert found["na"]["state"] == "given"
    drawn = figures_in(scope / "optics.html")
    assert set(drawn) == {"average", "radial", "p-values", "pupil", "correlation"}
    # the file takes over in a configuration
    setup = movie.with_name("setup.toml")
    taken = load_config(setup, [f"optics.file={scope / 'optics.toml'}"]).optics
    assert taken.focus_nm == pytest.approx(found["focus_nm"]["value"], abs=1e-6)
    assert taken.na == 1.42


def test_an_array_is_a_movie_too(movie: Path, scope: Path, tmp_path: Path) -> None:
    counts, setup = tifffile.imread(movie), movie.with_name("setup.toml")
    given = {"config": setup, "free": "focus,phase"}
    ia.calibrate_optics(counts, name="mine", **given, out=tmp_path / "scope")
    written = [
        [
            line
            for line in (out / "optics.toml").read_text(encoding="utf-8").splitlines()
            if not line.startswith(("#", "movie", "sha256"))
        ]
        for out in (scope, tmp_path / "scope")
    ]
    assert written[0] == written[1]
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
    given = ["bounds", "--for", "optics", "--events", "20", *given, "--free", "focus,na,phase"]
    assert main(given) == 0
    assert "particles needed for" in capsys.readouterr().out
    out = tmp_path / "plan"
    assert main([*given, "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    jsonschema.validate(printed, schema("optics_bounds"))
    assert json.loads((out / "optics_bounds.json").read_text(encoding="utf-8")) == printed
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(printed | {"events": 0}, schema("optics_bounds"))
    names = {"optics_bounds.json", "needed.csv", "bounds.html", ".iscat-files"}
    assert {path.name for path in out.iterdir()} == names


def test_too_few_particles_are_one_clear_line(tmp_path: Path, only_line) -> None:
    random = np.random.default_rng(5)
    tifffile.imwrite(tmp_path / "m.tif", random.poisson(500, (60, 64, 64)).astype(np.uint16))
    given = ["calibrate", "optics", str(tmp_path / "m.tif"), "--set", "camera.pixel_size_nm=84.4"]
    message = only_line(*given, "--quiet", status=1)
    assert "shows no bright particle that stands alone" in message
    assert "record brighter ones" in message


def test_free_names_are_checked(movie: Path, tmp_path: Path, only_line) -> None:
    given = ["calibrate", "optics", str(movie), "--free", "focus,fokus"]
    assert "'fokus' cannot be set free" in only_line(*given, "--out", str(tmp_path / "o"))


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
    step: str, said: str, tmp_path: Path, only_line
) -> None:
    tifffile.imwrite(tmp_path / "m.tif", np.full((60, 64, 64), 500, dtype=np.uint16))
    given = ["calibrate", "optics", str(tmp_path / "m.tif"), "--focus-step", step, "--quiet"]
    assert said in only_line(*given, "--set", "camera.pixel_size_nm=84.4")


def test_the_folder_one_is_in_is_no_movie_and_no_table(
    tmp_path: Path, only_line, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name, from which that of the results is made, is empty."""
    monkeypatch.chdir(tmp_path)
    optics = ["calibrate", "optics", ".", "--set", "camera.pixel_size_nm=84.4", "--quiet"]
    for given in (optics, ["calibrate", "mass", ".", "--standards", "66,146"]):
        assert ": error: .: " in only_line(*given, status=1)
