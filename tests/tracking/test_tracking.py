"""Particles that move: every frame fitted on its own, positions linked into tracks."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from instruments import Instrument
from scenes import PIXEL_NM, make_config
from wanderers import SETTINGS, wander

import iscat_analysis as ia
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.run import Run
from iscat_analysis.movie import open_stack
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pipeline import analyse, fit_stack
from iscat_analysis.records import TRACK_COLUMNS, Analysis
from iscat_analysis.tracking.tracks import mass_correlation

BEFORE, FRAMES, LEVEL_E, SIGMAS = 60, 30, 1e5, 4.0
SHAPE = (60, 76)
RATE_HZ = 331.0
STARTS = ((1800.0, 1900.0, 150.0), (4400.0, 3000.0, 150.0))  # x, y, z [nm]
MASSES = (3000.0, 5000.0)


def _config() -> Config:
    return make_config(
        camera={"frame_rate_hz": RATE_HZ, "exposure_ms": 2.0},
        optics={"focus_nm": -500.0},
        particle={"height_nm": 150.0, "mass_kda": 4000.0},
        background={"frames": [0, BEFORE]},
        fit={"mode": "track", "frames": None, "roi_nm": 2200.0, "z_range_nm": [0.0, 320.0]},
        simulation={"shape": list(SHAPE)},
    )


def _movie(path: Path, hidden: tuple[int, ...] = ()) -> np.ndarray:
    """Write a movie of two particles that diffuse; their paths, shape (2, frames, 3)."""
    rng = np.random.default_rng(7)
    steps = rng.normal(0, (40.0, 40.0, 4.0), (len(STARTS), FRAMES, 3))
    paths = np.array(STARTS)[:, None] + np.cumsum(steps, axis=1)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    model = forward_model(_config(), grid.diagonal_nm)
    counts = []
    for frame in range(-BEFORE, FRAMES):
        signal = np.zeros(SHAPE)
        for number, (track, mass) in enumerate(zip(paths, MASSES, strict=True)):
            if frame >= 0 and not (number == 0 and frame in hidden):
                signal += model.image(grid, *track[frame], mass)
        counts.append(rng.poisson(LEVEL_E * (1 + signal)))
    tifffile.imwrite(path, np.array(counts, dtype=np.uint32), photometric="minisblack")
    return paths


@pytest.fixture(scope="module")
def movie(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """Write the movie of both particles; their paths."""
    path = tmp_path_factory.mktemp("moving") / "movie.tif"
    return path, _movie(path)


@pytest.fixture(scope="module")
def found(movie: tuple[Path, np.ndarray]) -> Analysis:
    """Follow them."""
    return fit_stack(movie[0], _config())


def _errors(found: Analysis, paths: np.ndarray, name: str, axis: int) -> tuple[np.ndarray, Any]:
    table = found.table
    nearest = [
        int(np.argmin(np.hypot(p.x_nm - paths[:, p.frame - BEFORE, 0],
                               p.y_nm - paths[:, p.frame - BEFORE, 1])))
        for p in table.itertuples()
    ]  # fmt: skip
    truth = paths[nearest, table["frame"] - BEFORE, axis]
    return ((table[name] - truth) / table[f"sigma_{name}"]).to_numpy(), nearest


def test_each_particle_is_one_track_with_standard_pulls(
    movie: tuple[Path, np.ndarray], found: Analysis
) -> None:
    out, paths = movie[0].with_suffix(".iscat"), movie[1]
    assert len(found.table) == 2 * FRAMES
    assert (found.table.groupby("event")["frame"].nunique() == FRAMES).all()
    assert (found.table["frame"].diff().dropna().isin([1, 1 - FRAMES])).all()
    assert (found.table["status"] == "ok").mean() > 0.9
    for axis, name in enumerate(("x_nm", "y_nm", "z_nm")):
        pulls, nearest = _errors(found, paths, name, axis)
        assert len(set(zip(found.table["event"], nearest, strict=True))) == len(STARTS)
        assert abs(pulls.mean()) < SIGMAS / math.sqrt(pulls.size)
        assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * pulls.size)
    assert len(found.views) == len(STARTS)
    assert found.tracks is not None
    for row in found.tracks.itertuples():
        mass = MASSES[int(np.argmin(np.abs(np.array(MASSES) - row.mass_kda)))]
        assert abs(row.mass_kda - mass) < SIGMAS * row.sigma_mass_kda
        assert (row.first_frame, row.last_frame) == (BEFORE, BEFORE + FRAMES - 1)
    written = pd.read_csv(out / "tracks.csv")
    kept = pd.read_parquet(out / "tracks.parquet")
    assert tuple(written.columns[: len(TRACK_COLUMNS)]) == TRACK_COLUMNS
    pd.testing.assert_frame_equal(kept, found.tracks, check_dtype=False)
    assert np.allclose(written["mass_kda"], kept["mass_kda"], rtol=1e-8)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["tracks"] == len(STARTS)
    assert summary["motion"]["frame_rate_hz"] == RATE_HZ


def test_frames_share_the_noise_of_their_background(found: Analysis) -> None:
    """At one place the masses of two frames have 1/(n + 1) of their variance in common."""
    context = make_context(_config(), SHAPE)
    correlation = mass_correlation(context, found.table)
    assert correlation is not None
    reach = np.array([0.0, 1.0, 150.0, 900.0])
    told = correlation(np.stack([reach, np.zeros(4)], axis=1))
    assert np.allclose(np.diag(told), 1)
    assert np.all(np.linalg.eigvalsh(told) > 0)
    share = 1 / (BEFORE + 1)
    assert abs(told[0, 1] / share - 1) < 0.05
    assert abs(told[0, 2]) < share
    assert abs(told[0, 3]) < 0.2 * share
    known = make_config(background={"method": "known", "frames": None, "level_e": 1e5})
    assert mass_correlation(replace(context, config=known), found.table) is None


def test_films_show_what_the_fits_explain(found: Analysis) -> None:
    assert {film.track for film in found.films} == {0, 1}
    for film in found.films:
        assert len(film.frames) == len(film.contrast) == FRAMES
        assert abs(np.nanstd(film.residual) - 1) < 0.05
        assert np.abs(film.model).max() > 5 * np.nanstd(film.contrast - film.model)


def test_a_track_outlives_frames_in_which_the_particle_is_not_seen(tmp_path: Path) -> None:
    hidden = (11, 12)
    _movie(tmp_path / "movie.tif", hidden)
    table = fit_stack(tmp_path / "movie.tif", _config()).table
    seen = sorted(table.groupby("event")["frame"].nunique())
    assert seen == [FRAMES - len(hidden), FRAMES]


def test_an_interrupt_keeps_the_frames_that_are_done(movie: tuple[Path, np.ndarray]) -> None:
    def stop(stage: str, done: int, _: int) -> None:
        if stage == "track" and done == 5:
            raise KeyboardInterrupt

    with open_stack(movie[0]) as stack:
        cut = analyse(stack, _config(), Run(progress=stop))
    assert cut.summary["interrupted"]
    assert sorted(cut.table["frame"].unique()) == list(range(BEFORE, BEFORE + 5))


def test_nothing_to_track_is_an_empty_table(tmp_path: Path) -> None:
    flat = np.random.default_rng(1).poisson(LEVEL_E, (BEFORE + 5, *SHAPE)).astype(np.uint32)
    tifffile.imwrite(tmp_path / "movie.tif", flat, photometric="minisblack")
    found = fit_stack(tmp_path / "movie.tif", _config())
    assert found.table.empty
    assert not found.views


@pytest.mark.large  # a recorded movie of test_uneven is refused in the same words
def test_a_pattern_under_a_known_level_is_not_followed() -> None:
    """It took 24 s to follow 390 rows of 30 frames, none of which was a particle."""
    movie = wander((30, 64, 64), seed=1, speckle=0.02, species=((400.0, 0.4, 2),))
    known = {"background.method": "known", "background.level_e": 4e5}
    with pytest.raises(DataError, match=r"followed through all frames: .*the light differs"):
        ia.fit_movie(movie.counts, settings={**SETTINGS, **known})


@pytest.mark.parametrize("spherical_nm", [0.0, 20.0])
def test_what_is_wrong_is_named_over_a_recorded_background(spherical_nm: float) -> None:
    aberrations = {11: spherical_nm} if spherical_nm else {}
    instrument = Instrument(emission="reciprocal", aberrations_nm=aberrations)
    dark, lit = (
        wander((20, 64, 64), seed=5, instrument=instrument, species=((mass, 0.3, 3),), speckle=0.0)
        for mass in (1e-6, 600.0)
    )
    counts = np.concatenate([dark.counts, lit.counts])
    fixed = {"background.frames": [0, 20], "fit.z_range_nm": [0.0, 300.0]}
    result = ia.fit_movie(counts, settings={**SETTINGS, **fixed})
    said = [line for line in result.warnings if "the model does not describe" in line]
    assert len(said) == bool(spherical_nm)
    assert not said or "spherical aberration, off by about +2" in said[0]
