"""Rows and columns that flicker, in standard errors: what fits say where they are divided out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import poisson

import iscat_analysis as ia
from iscat_analysis.camera import LightModel
from iscat_analysis.config import Config, load_config
from iscat_analysis.diagnosis.light import judge_lines
from iscat_analysis.errors import DataError
from iscat_analysis.movie import Stack
from iscat_analysis.study import Movie

pytestmark = pytest.mark.large

PIXEL_NM, SIDE, LEVEL_E, GAIN = 84.0, 88, 1e5, 4.0
FLICKER = 2e-3
"""Of each line of each frame: 0.4 of the variance of shot noise, and 1.1 of what a mass sees."""

DRIFT_PX = (0.005, -0.002)
"""Per frame: the noise of a window sixfold, where it is not followed."""

MASSES, GRID = (300.0, 400.0, 480.0), (16, 43, 70)

SIGMAS, TAIL = 4.0, 1e-4
UNBIASED = 0.01


def _config(kind: str, *settings: str) -> Config:
    landing = ["simulation.frames=140", "background.window_frames=40"]
    ranges = {
        "landing": landing,
        "drifting": [
            *landing, f"simulation.drift_px_per_frame={list(DRIFT_PX)}",
            "background.drift_correction=true",
        ],
        "fixed": [
            "simulation.frames=120", "background.method=fixed", "background.frames=[0, 60]",
            "fit.frames=[60, 120]",
        ],
    }  # fmt: skip
    return load_config(
        None,
        [
            f"camera.pixel_size_nm={PIXEL_NM}", f"camera.gain_e_per_adu={GAIN}",
            "particle.mass_kda=146.0", "calibration.gradient_per_kda=-3.1e-5",
            f"simulation.shape=[{SIDE}, {SIDE}]", f"simulation.photons_per_pixel={LEVEL_E}",
            "simulation.background=speckle", "simulation.power_noise=0.01",
            "posterior.enabled=false", "optics.calibrate=never", "compute.workers=1",
            *ranges[kind], *settings,
        ],
    )  # fmt: skip


def _recorded(config: Config, seed: int, lines: str, flicker: float) -> np.ndarray:
    """Draw counts whose rows, columns or both have factors of their own in every frame."""
    rng = np.random.default_rng(seed)
    light = np.array(list(Movie(config, seed).expected_frames()))
    frames = len(light)
    if lines in ("rows", "both"):
        light *= 1 + flicker * rng.standard_normal((frames, SIDE, 1))
    if lines in ("columns", "both"):
        light *= 1 + flicker * rng.standard_normal((frames, 1, SIDE))
    return np.round(rng.poisson(light) / GAIN).astype(np.uint16)


def _fitted(kind: str, lines: str, movies: int, *settings: str) -> pd.DataFrame:
    """Errors over σ, and relative ones of the masses, of nine particles in each movie."""
    rows = []
    for seed in range(movies):
        rng = np.random.default_rng(seed)
        placed = [
            {
                "frame": int(rng.integers(60, 80)) if kind != "fixed" else 60,
                "x_px": x + rng.uniform(-2, 2),
                "y_px": y + rng.uniform(-2, 2),
                "mass_kda": MASSES[(i + j) % 3],
            }
            for i, y in enumerate(GRID)
            for j, x in enumerate(GRID)
        ]
        config = _config(kind, "detection.false_alarms_per_movie=1e-3", *settings)
        simulation = type(config.simulation).model_validate(
            {**config.simulation.model_dump(), "events": placed}
        )
        config = config.model_copy(update={"simulation": simulation})
        table = ia.fit_movie(_recorded(config, seed, lines, FLICKER), config=config).table
        for truth in placed:
            apart = np.hypot(table.x_px - truth["x_px"], table.y_px - truth["y_px"])
            (found,) = table[apart < 2].to_dict("records")
            mass = truth["mass_kda"]
            rows.append(
                {
                    "x": (found["x_px"] - truth["x_px"]) * PIXEL_NM / found["sigma_x_nm"],
                    "y": (found["y_px"] - truth["y_px"]) * PIXEL_NM / found["sigma_y_nm"],
                    "mass": (found["mass_kda"] - mass) / found["sigma_mass_kda"],
                    "relative": found["mass_kda"] / mass - 1,
                    "false": len(table) - len(placed),
                    "weight": (mass / found["sigma_mass_kda"]) ** 2,
                }
            )
    return pd.DataFrame(rows)


def _assert_standard(pulls: pd.Series[float]) -> None:
    assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * len(pulls))


@pytest.mark.parametrize("kind", ["landing", "fixed"])
@pytest.mark.parametrize("lines", ["rows", "columns", "both"])
def test_pulls_are_standard_and_masses_unbiased(kind: str, lines: str) -> None:
    table = _fitted(kind, lines, 20)
    for name in ("x", "y", "mass"):
        _assert_standard(table[name])
    bias = float(np.average(table["relative"], weights=table["weight"]))
    error = 1 / math.sqrt(table["weight"].sum())
    assert abs(bias) < UNBIASED
    assert abs(bias) < SIGMAS * error


@pytest.mark.parametrize("kind", ["landing", "fixed"])
def test_without_the_correction_they_are_not(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Control: the movies above; across the rows and in the mass, and not along them."""
    monkeypatch.setattr("iscat_analysis.diagnosis.light.judge_lines", lambda *_: None)
    table = _fitted(kind, "rows", 8)
    _assert_standard(table["x"])
    for name in ("y", "mass"):
        with pytest.raises(AssertionError):
            _assert_standard(table[name])


@pytest.mark.parametrize("kind", ["landing", "fixed"])
def test_masses_are_too_low_where_what_is_left_is_not_foreseen(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control: rows and columns take 2 × 2.8 pixels of 88 off a particle, 6 % of its mass."""
    for method in ("left", "taken"):
        monkeypatch.setattr(
            f"iscat_analysis.camera.light.LightModel.{method}",
            lambda _, signal, method=method: signal if method == "left" else np.ones_like(signal),
        )
    table = _fitted(kind, "both", 6)
    bias = float(np.average(table["relative"], weights=table["weight"]))
    assert -0.09 < bias < -0.03


def test_lines_are_left_in_where_the_pattern_moves_and_the_spread_holds_them() -> None:
    """A pattern that moves changes their light by more than they flicker."""
    table = _fitted("drifting", "both", 12, 'fit.sigma="measured"')
    assert not table["false"].any()
    for name in ("x", "y", "mass"):
        _assert_standard(table[name])
    bias = float(np.average(table["relative"], weights=table["weight"]))
    assert abs(bias) < SIGMAS / math.sqrt(table["weight"].sum())


def test_lines_that_are_divided_out_of_a_moving_pattern_make_particles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Control: of the test above, and of its own movie without flicker."""

    def divided(movie: Stack, config: Config, *others: Any) -> LightModel | None:
        background = config.background.model_copy(update={"drift_correction": False})
        return judge_lines(movie, config.model_copy(update={"background": background}), *others)

    monkeypatch.setattr("iscat_analysis.diagnosis.light.judge_lines", divided)
    config = _config("drifting", "simulation.count=0", "detection.false_alarms_per_movie=1e-3")
    with pytest.raises(DataError, match="places in frames 0:140 pass the detection threshold"):
        ia.fit_movie(_recorded(config, 0, "both", FLICKER), config=config)
    assert not len(ia.fit_movie(_recorded(config, 0, "both", 0.0), config=config).table)


@pytest.mark.parametrize("kind", ["landing", "fixed"])
def test_blanks_have_as_many_false_alarms_as_configured(kind: str) -> None:
    movies = 40
    config = _config(kind, "detection.false_alarms_per_movie=1.0", "simulation.count=0")
    found = 0
    for seed in range(movies):
        result = ia.fit_movie(_recorded(config, seed, "both", FLICKER), config=config)
        assert "lines" in result.summary
        found += len(result.table)
    assert poisson.ppf(TAIL, movies) <= found <= poisson.isf(TAIL, movies)


def test_clean_movies_are_not_touched(monkeypatch: pytest.MonkeyPatch) -> None:
    config = _config("landing", "simulation.count=0", "detection.false_alarms_per_movie=3.0")
    counts = [_recorded(config, seed, "rows", 0.0) for seed in range(6)]
    found = [ia.fit_movie(c, config=config) for c in counts]
    assert not any("lines" in result.summary for result in found)
    monkeypatch.setattr("iscat_analysis.diagnosis.light.judge_lines", lambda *_: None)
    for c, result in zip(counts, found, strict=True):
        pd.testing.assert_frame_equal(ia.fit_movie(c, config=config).table, result.table)
