"""A microscope that is not the same over its field is learned, and every particle comes back.

Each particle of these movies is drawn with the optics of its own place, by a microscope that knows
nothing of the model that is fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from instruments import Instrument, Landings, draw_landings
from shared_errors import systematic
from uneven_movies import (
    GAIN,
    PIXEL_NM,
    Optics,
    UnevenMovie,
    astigmatic,
    comatic,
    other_reference,
    tilted,
)

from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import FIELD_TERMS, Config, load_config
from iscat_analysis.fitting.run import Run
from iscat_analysis.instrument.learning import learn_optics
from iscat_analysis.landing.find import analyse_landings
from iscat_analysis.trust.uneven_reference import reference_map

pytestmark = pytest.mark.large

SHAPE = (1000, 176, 160)
MASSES = (480.0, 480.0, 146.0)
SIGMAS = 4.0
LEARNED_TERMS = [
    pytest.param(tilted(70.0, 28.0), {"focus_tilt_x_nm": 70.0, "focus_tilt_y_nm": 28.0}, 9,
                 id="tilt of 70 nm"),
    pytest.param(tilted(-130.0, 52.0), {"focus_tilt_x_nm": -130.0, "focus_tilt_y_nm": 52.0}, 2,
                 id="tilt of 130 nm"),
    pytest.param(tilted(0.0, 0.0, 45.0), {"focus_curvature_nm": 45.0}, 7, id="curved by 45 nm"),
    pytest.param(comatic(12.0), {"coma_field_nm": 12.0}, 10, id="coma of 12 nm"),
    pytest.param(comatic(35.0), {"coma_field_nm": 35.0}, 4, id="coma of 35 nm"),
    pytest.param(astigmatic(15.0, -7.5), {"astigmatism_field_x_nm": 15.0,
                                          "astigmatism_field_y_nm": -7.5}, 6, id="astigmatism"),
    pytest.param(other_reference(0.2), {"phase_curvature_deg": math.degrees(0.2)}, 5,
                 id="phase of 0.2 rad"),
    pytest.param(other_reference(0.5), {"phase_curvature_deg": math.degrees(0.5)}, 8,
                 id="phase of 0.5 rad"),
]  # fmt: skip


@dataclass(frozen=True)
class _Outcome:
    """How the masses of an analysis agree with the truth."""

    found: int
    pulls: np.ndarray
    ratio: float
    ratio_se: float


def _config(*settings: str) -> Config:
    return load_config(
        None,
        [
            f"camera.pixel_size_nm={PIXEL_NM}", f"camera.gain_e_per_adu={GAIN}",
            "optics.focus_nm=-300", "particle.mass_kda=146", "calibration.gradient_per_kda=-3.1e-5",
            "background.method=sliding", "compute.workers=1", *settings,
        ],
    )  # fmt: skip


def _landings(seed: int) -> Landings:
    return draw_landings(SHAPE, 48, seed=seed, masses=MASSES, apart_px=18.0)


def _movie(optics: Optics, seed: int, **light: float) -> UnevenMovie:
    microscope = Instrument(emission="reciprocal", focus_nm=-300.0)
    return UnevenMovie(microscope, optics, SHAPE, _landings(seed), seed=seed + 100, **light)


def _learned(movie: UnevenMovie) -> tuple[Config, dict[str, tuple[float, float]]]:
    config = _config()
    camera = camera_from_config(config.camera, SHAPE[1:], movie.dtype)
    learned, told, _ = learn_optics(movie, config, camera)
    rows = {each["parameter"]: each for each in told.get("parameters", ())}
    errors = {
        name: (learned.optics.field_term(name), rows[name]["sigma"])
        for name in FIELD_TERMS
        if learned.optics.field_term(name)
    }
    return learned, errors


def _outcome(movie: UnevenMovie, config: Config, landings: Landings) -> _Outcome:
    camera = camera_from_config(config.camera, SHAPE[1:], movie.dtype)
    found = analyse_landings(movie, config, camera, Run())
    good = found.fits[found.fits["status"] == "ok"].reset_index(drop=True)
    learned = config.optics.covariance is not None
    shared = systematic(config, good)["mass_kda"] if learned else np.zeros(len(good))
    pulls, ratios = [], []
    for x, y, frame, mass in zip(
        landings.x_px, landings.y_px, landings.frame, landings.mass_kda, strict=True
    ):
        here = np.hypot(good["x_px"] - x, good["y_px"] - y) < 1
        row = good[here & (np.abs(good["frame"] - frame) < 20)]
        if len(row) == 1:
            fitted, sigma = row["mass_kda"].item(), row["sigma_mass_kda"].item()
            pulls.append((fitted - mass) / np.hypot(sigma, shared[row.index[0]]))
            ratios.append(fitted / mass)
    error = float(np.std(ratios)) / math.sqrt(max(len(ratios), 1))
    return _Outcome(len(pulls), np.array(pulls), float(np.mean(ratios)), error)


@pytest.mark.parametrize(("optics", "truth", "seed"), LEARNED_TERMS)
def test_what_differs_over_the_field_is_learned(
    optics: Optics, truth: dict[str, float], seed: int
) -> None:
    movie, landings = _movie(optics, seed), _landings(seed)
    learned, terms = _learned(movie)
    assert set(terms) == set(truth)  # nothing else, and no drift
    assert learned.optics.focus_drift_nm == 0
    for name, size in truth.items():
        value, sigma = terms[name]
        assert abs(value - size) < SIGMAS * sigma
        assert sigma < 0.1 * np.hypot.reduce(list(truth.values()))
    count = len(landings.frame)
    with_it, without = (_outcome(movie, each, landings) for each in (learned, _config()))
    assert with_it.found >= count - 2
    assert without.found < count - 5  # as configured, rows are lost
    assert np.sqrt(np.mean(with_it.pulls**2)) < 1 + SIGMAS / np.sqrt(2 * with_it.found)
    assert np.abs(with_it.pulls).max() < 5
    assert abs(with_it.ratio - 1) < 0.01 + SIGMAS * with_it.ratio_se


@pytest.mark.parametrize("seed", [3, 11, 12])
def test_of_an_even_microscope_nothing_is_learned(seed: int) -> None:
    learned, terms = _learned(_movie(tilted(0.0, 0.0), seed))
    assert not terms
    assert learned.optics.focus_drift_nm == 0


@pytest.mark.parametrize("cone", [0.1, 0.2])
def test_a_cone_of_light_is_fitted_with_where_it_is_configured(cone: float) -> None:
    """The movie's plane waves also pass the oil at their angles, which the model leaves out."""
    movie, landings = _movie(tilted(0.0, 0.0), 13, illumination_na=cone), _landings(13)
    with_it, without = (
        _outcome(movie, _config(f"optics.illumination_na={na}"), landings) for na in (cone, 0.0)
    )
    assert with_it.found >= len(landings.frame) - 2
    assert np.sqrt(np.mean(with_it.pulls**2)) < 1 + SIGMAS / np.sqrt(2 * with_it.found)
    assert abs(with_it.ratio - 1) < 0.003 + SIGMAS * with_it.ratio_se
    assert abs(without.ratio - 1) > abs(with_it.ratio - 1) + 0.005


@pytest.mark.parametrize("tilt", [0.03, 0.05])
def test_what_is_said_of_the_reference_makes_masses_right(tilt: float) -> None:
    movie, landings, config = _movie(other_reference(0.0, tilt), 21), _landings(21), _config()
    camera = camera_from_config(config.camera, SHAPE[1:], movie.dtype)
    found = analyse_landings(movie, config, camera, Run())
    said = reference_map(config, found.fits)
    assert said is not None
    assert abs(said.terms[0] * SHAPE[1] / 2 / said.field_px[2] - tilt) < SIGMAS * said.errors[0]
    followed = _config(
        f"optics.reference_tilt={said.terms[:2].tolist()}",
        f"optics.reference_curvature={said.terms[2]}", f"optics.field_px={list(said.field_px)}",
    )  # fmt: skip
    before, after = (_outcome(movie, each, landings) for each in (config, followed))
    assert np.sqrt(np.mean(before.pulls**2)) > 1.5
    assert np.sqrt(np.mean(after.pulls**2)) < 1 + SIGMAS / np.sqrt(2 * after.found)
    assert abs(after.ratio - 1) < 0.005 + SIGMAS * after.ratio_se
