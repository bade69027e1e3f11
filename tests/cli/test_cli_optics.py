"""`iscat calibrate optics`: a landing movie goes in, the file that a fit reads comes out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from iscat_analysis.config import config_to_toml, load_config, parse_config
from iscat_analysis.study.simulate import write_stack
from iscat_cli import main

Captured = pytest.CaptureFixture[str]

FREE = ["--free", "focus,phase"]
TRUTH = {"focus_nm": -420.0, "reference_phase_deg": 10.0}
SIDE, FRAMES = 176, 160
SIGMAS = 4.0


def _values(**sections: dict[str, Any]) -> dict[str, Any]:
    return {
        "optics": {"wavelength_nm": 525.0, "na": 1.42, "attenuation": 0.1, "focus_nm": -300.0}
        | sections.pop("optics", {}),
        "camera": {"pixel_size_nm": 84.4},
        "particle": {"kind": "protein", "height_nm": 5.0},
        **sections,
    }


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen particles land 3.7 µm apart, each at a frame of its own."""
    folder = tmp_path_factory.mktemp("optics")
    events = [
        {"frame": 40 + 5 * i, "x_px": 22.3 + 44 * (i % 4), "y_px": 21.6 + 44 * (i // 4),
         "mass_kda": 4500.0}
        for i in range(16)
    ]  # fmt: skip
    simulation = {
        "shape": [SIDE, SIDE], "frames": FRAMES, "photons_per_pixel": 2e4, "seed": 3,
        "background": "speckle", "events": events,
    }  # fmt: skip
    write_stack(parse_config(_values(optics=TRUTH, simulation=simulation)), folder / "movie.tif")
    (folder / "setup.toml").write_text(config_to_toml(parse_config(_values())), encoding="utf-8")
    return folder / "movie.tif"


def test_a_landing_movie_tells_its_optics(movie: Path, tmp_path: Path, capsys: Captured) -> None:
    out, setup = tmp_path / "scope", movie.with_name("setup.toml")
    given = ["calibrate", "optics", str(movie), "--config", str(setup), *FREE, "--out", str(out)]
    assert main([*given, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["accepted"]
    assert printed["particles"] >= 12
    found = {row["parameter"]: row for row in printed["parameters"]}
    for name, true in TRUTH.items():
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


def test_a_movie_with_background_frames(movie: Path, tmp_path: Path, capsys: Captured) -> None:
    """All particles at once, each among the rings of the others."""
    given = ["calibrate", "optics", str(movie), *FREE, "--out", str(tmp_path / "o"), "--json"]
    given += ["--config", str(movie.with_name("setup.toml"))]
    given += ["--set", "background.frames=[0,38]", "--set", "fit.frames=[120,160]"]
    assert main(given) == 0
    found = {r["parameter"]: r for r in json.loads(capsys.readouterr().out)["parameters"]}
    for name, true in TRUTH.items():
        assert abs(found[name]["value"] - true) < SIGMAS * found[name]["sigma"]


def test_too_few_particles_are_one_clear_line(tmp_path: Path, capsys: Captured) -> None:
    random = np.random.default_rng(5)
    tifffile.imwrite(tmp_path / "m.tif", random.poisson(500, (60, 64, 64)).astype(np.uint16))
    given = ["calibrate", "optics", str(tmp_path / "m.tif"), "--set", "camera.pixel_size_nm=84.4"]
    assert main(given) == 1
    message = capsys.readouterr().err
    assert "0 bright particles that stand alone" in message
    assert "record more" in message
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
