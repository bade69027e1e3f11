"""A calibrant that rejects the configured optics learns them once, for all movies of the day."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import iscat_analysis as ia
from iscat_analysis.config import read_toml
from iscat_analysis.instrument.learning import REJECTED_P

pytestmark = pytest.mark.large

TRUE_NM = -450.0
APART_PX = 44
SIGMAS = 4.0
"""A focus farther from the truth than this many standard errors is wrong: 6e-5 by chance."""

SETUP: dict[str, Any] = {
    "optics.focus_nm": -300.0,
    "camera.pixel_size_nm": 84.4,
    "particle.mass_kda": 9000.0,
    "background.frames": (0, 20),
    "fit.frames": (20, 40),
    "posterior.enabled": False,
    "simulation.frames": 40,
    "simulation.photons_per_pixel": 5e4,
    "simulation.background": "flat",
}


def _simulate(path: Path, side: int, seed: int, focus_nm: float = TRUE_NM) -> None:
    """Write a movie of a square of bright particles that stand alone."""
    events = [
        {"frame": 20, "x_px": 22.3 + APART_PX * (k % side), "y_px": 21.6 + APART_PX * (k // side),
         "mass_kda": 9000.0}
        for k in range(side**2)
    ]  # fmt: skip
    changes = {
        "optics.focus_nm": focus_nm,
        "simulation.shape": [APART_PX * side] * 2,
        "simulation.events": events,
    }
    ia.simulate_movie({**SETUP, **changes}, str(path), seed=seed)


def _summary(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return found["optics"]


def test_the_optics_are_learned_once_and_serve_the_day(tmp_path: Path) -> None:
    _simulate(tmp_path / "first.tif", 4, seed=1)
    _simulate(tmp_path / "second.tif", 2, seed=2)
    _simulate(tmp_path / "sample.tif", 3, seed=3)
    _simulate(tmp_path / "moved.tif", 2, seed=4, focus_nm=SETUP["optics.focus_nm"])
    table = tmp_path / "samples.csv"
    table.write_text(
        "path,role\nsample.tif,sample\nmoved.tif,sample\n"
        "second.tif,calibrant\nfirst.tif,calibrant\n"
    )
    out = tmp_path / "out"
    day = ia.batch(table, out=out, config=SETUP)
    assert day.failed == ()

    learned = _summary(out / "calibration" / "first.iscat")
    assert learned["calibrated"]
    assert learned["median_p"] < REJECTED_P
    focus = {row["parameter"]: row for row in learned["parameters"]}["focus_nm"]
    assert abs(focus["value"] - TRUE_NM) < SIGMAS * focus["sigma"]
    assert abs(focus["value"] - SETUP["optics.focus_nm"]) > SIGMAS * focus["sigma"]

    results = [out / "movies" / f"{name}.iscat" for name in ("first", "second", "sample")]
    results.append(out / "calibration" / "second.iscat")
    first = read_toml(out / "calibration" / "first.iscat" / "config.toml")["optics"]
    for folder in results:
        tested = _summary(folder)
        assert not tested["calibrated"]
        assert tested["median_p"] >= REJECTED_P
        used = read_toml(folder / "config.toml")["optics"]
        for key in ("focus_nm", "na", "reference_phase_deg", "aberrations_nm", "covariance"):
            assert used[key] == first[key]
    rows = day.movies.set_index("movie")["optics"]
    assert rows[["first", "second", "sample"]].tolist() == 3 * ["of the day, confirmed"]
    # control: a movie of another focus rejects what serves the others, and its four particles tell
    assert rows["moved"] == "learned from this movie"
    moved = _summary(out / "movies" / "moved.iscat")
    focus = {row["parameter"]: row for row in moved["parameters"]}["focus_nm"]
    assert abs(focus["value"] - SETUP["optics.focus_nm"]) < SIGMAS * focus["sigma"]
    page = day.page.read_text(encoding="utf-8")
    assert "learned by first" in page
    assert ia.batch(table, out=out, config=SETUP).analysed == ()
