"""Particles through a microscope that no model here describes: a ghost of the light, and coma."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from instruments import Instrument, InstrumentMovie, Landings, draw_landings

from iscat_analysis.answers.calibrations import template_calibration
from iscat_analysis.config import configure
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import analyse
from iscat_analysis.records import Analysis

pytestmark = pytest.mark.large

SHAPE, PIXEL = (1200, 160, 160), 84.0
INSTRUMENT = Instrument(
    focus_nm=-300.0,
    emission="reciprocal",
    ghost=(0.35, 70.0, 420.0, -150.0),
    aberrations_nm={8: 15.0, 9: 12.0},
)
SETTINGS = {
    "camera.pixel_size_nm": PIXEL,
    "camera.gain_e_per_adu": 4.0,
    "optics.focus_nm": -300.0,
    "optics.calibrate": "never",
    "particle.mass_kda": 205.0,
    "calibration.gradient_per_kda": -3.1e-5,
}


def _movie(path: Path, seed: int) -> Landings:
    landings = draw_landings(SHAPE, 110, seed=seed)
    movie = InstrumentMovie(INSTRUMENT, SHAPE, landings, seed=seed + 1)
    tifffile.imwrite(path, movie.counts, photometric="minisblack")
    return landings


def _fit(path: Path, **settings: Any) -> Analysis:
    with open_stack(path) as movie:
        return analyse(movie, configure(settings=SETTINGS | settings))


def _matched(table: pd.DataFrame, truth: Landings) -> tuple[pd.DataFrame, Any]:
    rows, which = [], []
    for index in range(truth.frame.size):
        near = np.hypot(table["x_px"] - truth.x_px[index], table["y_px"] - truth.y_px[index]) < 4
        near &= np.abs(table["frame"] - truth.frame[index]) < 25
        if near.sum() == 1:
            rows.append(int(np.flatnonzero(near)[0]))
            which.append(index)
    return table.iloc[rows].reset_index(drop=True), np.array(which)


@pytest.mark.parametrize("seed", [1, 41])
def test_a_template_serves_where_the_model_fails(seed: int, tmp_path: Path) -> None:
    """The template is made on one movie and used on it and on another."""
    truth = _movie(tmp_path / "one.tif", seed)
    fresh = _movie(tmp_path / "two.tif", seed + 100)
    plain = {k: v for k, v in SETTINGS.items() if not k.startswith("calibration")}
    found = template_calibration(
        tmp_path / "one.tif", configure(settings=plain), tmp_path / "picture"
    )
    assert found.accepted, found.refusals
    with_it = {"optics.file": str(tmp_path / "picture" / "optics.toml")}

    wrong, _ = _matched(_fit(tmp_path / "one.tif").table, truth)
    assert np.mean(wrong["status"] == "ok") < 0.3

    for path, landings in ((tmp_path / "one.tif", truth), (tmp_path / "two.tif", fresh)):
        table = _fit(path, **with_it).table
        assert table["qcrb_mass_kda"].isna().all()
        events, which = _matched(table, landings)
        assert len(events) >= 0.95 * landings.frame.size
        good = (events["status"] == "ok").to_numpy()
        assert good.mean() > 0.6
        events, mass = events[good], landings.mass_kda[which[good]]
        places = {
            "x_nm": events["x_nm"] - PIXEL * landings.x_px[which[good]],
            "y_nm": events["y_nm"] - PIXEL * landings.y_px[which[good]],
        }
        error = 1 / np.sqrt(2 * good.sum())
        for name, off in places.items():
            sigma = events[f"sigma_{name}"]
            common = np.average(off, weights=1 / sigma**2)  # the origin is the template's own
            assert abs(np.std((off - common) / sigma) - 1) < 0.1 + 3 * error, name
        sigma = events["sigma_mass_kda"].to_numpy()
        ratio = events["mass_kda"].to_numpy() / mass
        scale = np.average(ratio, weights=(mass / sigma) ** 2)
        assert abs(scale - 1) < 4 * found.template.peak_se
        assert abs(np.std((ratio - scale) * mass / sigma) - 1) < 0.1 + 3 * error
        for size in np.unique(mass):  # linear
            same = mass == size
            se = np.mean(sigma[same] / size) / np.sqrt(same.sum())
            assert abs(ratio[same].mean() - scale) < 4 * se + 0.005
        spread = (events["sigma_mass_kda"] / events["crb_mass_kda"]).median()
        assert abs(spread - 1) < 0.01
