"""`iscat fit --mode track`: what is printed, and what is said of movies that are odd."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import pandas as pd
import pytest
import tifffile

from iscat_analysis import schema, simulate_movie
from iscat_cli import main

RATE_HZ = 331.0
SETUP = """
[optics]
calibrate = "never"
[camera]
pixel_size_nm = 84.0
gain_e_per_adu = 20.0
[calibration]
gradient_per_kda = -3.1e-5
[particle]
mass_kda = 400.0
[fit]
mode = "track"
roi_nm = 2000.0
[track]
free = "mass"
[posterior]
enabled = false
"""
SIMULATED = """
[simulation]
shape = [48, 48]
frames = 60
photons_per_pixel = 4e5
seed = 4
[[simulation.movers]]         # two that meet
d_um2_s = 0.05
x_px = 12.0
y_px = 30.0
drift_um_s = [6.0, 0.0]
[[simulation.movers]]
d_um2_s = 0.05
x_px = 27.0
y_px = 31.0
drift_um_s = [-6.0, 0.0]
[[simulation.movers]]         # one that leaves
d_um2_s = 0.05
x_px = 36.0
y_px = 8.0
drift_um_s = [9.0, 0.0]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a movie whose file says nothing of times, and its configuration."""
    out = tmp_path_factory.mktemp("moving")
    times = f"frame_rate_hz = {RATE_HZ}\nexposure_ms = 2.5\n"
    whole = SETUP.replace("[camera]\n", f"[camera]\n{times}")
    (out / "whole.toml").write_text(whole + SIMULATED)
    (out / "setup.toml").write_text(SETUP)
    simulate_movie(out / "whole.toml", out / "simulated.tif")
    counts = tifffile.imread(out / "simulated.tif")
    tifffile.imwrite(out / "movie.tif", counts, photometric="minisblack")
    return out


def _fit(folder: Path, out: Path, *options: str) -> int:
    base = ["fit", str(folder / "movie.tif"), "--config", str(folder / "setup.toml")]
    return main([*base, "--out", str(out), *options])


def test_tracks_that_meet_and_leave_are_printed_and_said(
    folder: Path, tmp_path: Path, capsys
) -> None:
    rate = [f"--set=camera.frame_rate_hz={RATE_HZ}", "--set=camera.exposure_ms=2.5"]
    assert _fit(folder, tmp_path / "out", *rate, "--json") == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    jsonschema.validate(found, schema("fit"))
    tracks = pd.DataFrame(found["tracks"])
    met = tracks[tracks["flags"].str.contains("crosses")]
    assert found["motion"]["crossed"] == len(met) >= 2
    assert (met["nearest_nm"] < 500).all()
    assert "come nearer than 500 nm" in printed.err
    assert "numbers may be exchanged" in printed.err
    gone = tracks[tracks["ends"] == "border"]
    assert len(gone) == 1
    assert gone["last_frame"].iloc[0] < 45
    assert abs(tracks["mass_kda"].median() / 400 - 1) < 0.1
    assert len(pd.read_csv(tmp_path / "out" / "tracks.csv")) == len(tracks)


def test_without_a_frame_rate_there_are_tracks_and_one_line(
    folder: Path, tmp_path: Path, capsys
) -> None:
    assert _fit(folder, tmp_path / "out") == 0
    printed = capsys.readouterr()
    assert printed.err.count("camera.frame_rate_hz is not known") == 1
    assert "as in --set camera.frame_rate_hz=331.0" in printed.err
    tracks = pd.read_csv(tmp_path / "out" / "tracks.csv")
    assert tracks["d_um2_s"].isna().all()
    assert tracks["mass_kda"].notna().all()
    assert "mass ± σ [kDa]" not in printed.out
    assert _fit(folder, tmp_path / "rows", "--events", "2") == 0
    assert "mass ± σ [kDa]" in capsys.readouterr().out


def test_an_exposure_longer_than_the_interval_ends_with_2(
    folder: Path, tmp_path: Path, capsys
) -> None:
    times = ["--set=camera.frame_rate_hz=331", "--set=camera.exposure_ms=5"]
    assert _fit(folder, tmp_path / "out", *times) == 2
    printed = capsys.readouterr()
    assert "camera.exposure_ms = 5 is longer than the 3.021 ms from frame to frame" in printed.err
    assert not (tmp_path / "out").exists()


def test_a_movie_of_few_frames_is_refused_in_one_line(folder: Path, tmp_path: Path, capsys) -> None:
    assert _fit(folder, tmp_path / "out", "--frames", "0:12", "--quiet") == 1
    printed = capsys.readouterr()
    assert "12 frames, too few" in printed.err
    assert printed.err.count("\n") == 1
