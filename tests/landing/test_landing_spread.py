"""Landing movies in standard errors: false alarms, bias, spread against the bound, frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from landings import PIXEL_NM, analysed, landing_config
from scipy.ndimage import convolve1d
from scipy.stats import poisson

from iscat_analysis.config import Config
from iscat_analysis.fitting.context import make_context
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import FRAME_COLUMN, Candidate
from iscat_analysis.study import Movie

pytestmark = pytest.mark.large

LEVEL_E = 1e5
WINDOW = 40
SIGMAS = 4.0
TAIL = 1e-4  # of the Poisson law on either side


STILL, DRIFTING = (0.0, 0.0), (0.005, -0.002)
"""Pixels per frame along x and y; 0.2 pixels between two windows are ten times the shot noise."""


def _moving(drift: tuple[float, float]) -> list[str]:
    """Give the settings of a movie that drifts, and of what corrects it."""
    return [
        f"simulation.drift_px_per_frame={list(drift)}",
        f"background.drift_correction={str(any(drift)).lower()}",
    ]


def _analyse(config: Config, seed: int) -> pd.DataFrame:
    return analysed(np.array(list(Movie(config, seed).frames())), config)[0].fits


# ---- blank movies ----------------------------------------------------------------------------


BLANK = ["detection.false_alarms_per_movie=1.0", "fit.roi_nm=1800.0"]


@pytest.fixture(scope="module", params=[STILL, DRIFTING], ids=["still", "drifting"])
def alarms(request: pytest.FixtureRequest) -> tuple[int, int]:
    """Events found in blank movies at 1 expected in each, and the number of movies."""
    config = landing_config(64, 240, *BLANK, *_moving(request.param))
    movies = 64
    return sum(len(_analyse(config, seed)) for seed in range(movies)), movies


def _assert_expected(found: int, expected: float) -> None:
    assert poisson.ppf(TAIL, expected) <= found <= poisson.isf(TAIL, expected)


def test_false_alarms_are_as_many_as_configured(alarms: tuple[int, int]) -> None:
    found, movies = alarms
    _assert_expected(found, movies)


def test_drift_that_is_not_corrected_is_taken_for_particles() -> None:
    """Control: of the false alarms above, and of the speed of the drift."""
    short = ["background.window_frames=10", "background.drift_correction=false"]
    config = landing_config(32, 50, *BLANK, *_moving(DRIFTING), *short)
    with pytest.raises(AssertionError):
        _assert_expected(len(_analyse(config, 1)), 1)


@pytest.mark.parametrize("wrong", [0.35, 2.5])
def test_another_number_of_false_alarms_is_refused(alarms: tuple[int, int], wrong: float) -> None:
    """Control: the test above can fail."""
    found, movies = alarms
    with pytest.raises(AssertionError):
        _assert_expected(found, wrong * movies)


def _with_noise(counts: np.ndarray, light: np.ndarray, kind: str, seed: int) -> np.ndarray:
    """Give the electrons of frames a noise that no configuration tells of."""
    rng, noise = np.random.default_rng(1000 + seed), counts - light
    lagged, leaky = (np.array(k) / np.linalg.norm(k) for k in ((0, 3, 1), (0.1, 0.8, 0.1)))
    if kind == "lagged":
        return light + convolve1d(noise, lagged, axis=2)
    if kind == "leaky":
        return light + convolve1d(convolve1d(noise, leaky, axis=1), leaky, axis=2)
    if kind == "read":
        return counts + 200 * rng.standard_normal(counts.shape)
    if kind == "gain":
        return light + math.sqrt(1.3) * noise
    frames, rows, columns = counts.shape
    lines = (frames, rows, 1) if kind == "rows" else (frames, 1, columns)
    return counts * (1 + 2e-3 * rng.standard_normal(lines))


KINDS = ("lagged", "leaky", "read", "gain", "rows", "columns")


def _alarms_in(kind: str, movies: int) -> int:
    """Count events in blank movies, 1 expected in each, with a kind of noise."""
    config, found = landing_config(64, 240, *BLANK), 0
    for seed in range(movies):
        light = np.array(list(Movie(config, seed).expected_frames()))
        drawn = np.random.default_rng(seed).poisson(light)
        counts = np.round(_with_noise(drawn, light, kind, seed) / 4.0)
        result, _ = analysed(np.clip(counts, 0, 65535).astype(np.uint16), config)
        found += len(result.fits)
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_unknown_noise_has_as_many_false_alarms_as_configured(kind: str) -> None:
    _assert_expected(_alarms_in(kind, 40), 40)


@pytest.mark.parametrize("kind", KINDS)
def test_a_search_that_does_not_measure_the_noise_has_more(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control: of the noise, and of the test above."""
    monkeypatch.setattr("iscat_analysis.diagnosis.noise.measure_spectrum", lambda *_, **__: None)
    with pytest.raises(AssertionError):
        _assert_expected(_alarms_in(kind, 6), 6)


# ---- isolated events -------------------------------------------------------------------------

GRID = (18, 44, 70, 96)
MASSES = (120.0, 250.0, 480.0)


@pytest.fixture(scope="module", params=[STILL, DRIFTING], ids=["still", "drifting"])
def events(request: pytest.FixtureRequest) -> pd.DataFrame:
    """Sixteen particles a movie, apart from each other, at random frames; a third leave."""
    tables = []
    rate = np.array(request.param)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        placed: list[dict[str, Any]] = []
        for row in GRID:
            for column in GRID:
                frame = int(rng.integers(60, 110))
                leaves = len(placed) % 3 == 0
                placed.append(
                    {
                        "frame": frame,
                        "leave": frame + 90 if leaves else None,
                        "x_px": column + rng.uniform(-2, 2),
                        "y_px": row + rng.uniform(-2, 2),
                        "mass_kda": MASSES[len(placed) % 3],
                    }
                )
        # those of noise are counted above
        alarms = "detection.false_alarms_per_movie=1e-3"
        config = landing_config(115, 260, *_moving(request.param), alarms, events=placed)
        table = _analyse(config, seed)
        for truth in placed:
            for sign, when in ((1, truth["frame"]), (-1, truth["leave"])):
                if when is None:
                    continue
                x_px, y_px = (truth["x_px"], truth["y_px"]) + rate * (when - truth["frame"])
                near = table[
                    (np.hypot(table.x_px - x_px, table.y_px - y_px) < 2)
                    & (table.mass_kda * sign > 0)
                ]
                found = near.iloc[0].to_dict() if len(near) else {}
                tables.append(
                    {
                        **found, "true_frame": when, "true_mass": truth["mass_kda"],
                        "true_x_nm": x_px * PIXEL_NM,
                        "true_y_nm": y_px * PIXEL_NM,
                        "found": len(near), "extra": len(table) - len(placed) - 6,
                    }
                )  # fmt: skip
    return pd.DataFrame(tables)


def test_every_event_is_found_once(events: pd.DataFrame) -> None:
    assert (events["found"] == 1).all()
    assert (events["extra"] == 0).all()


def _pulls(events: pd.DataFrame, name: str, over: str) -> np.ndarray:
    truth = events["true_mass" if name == "mass_kda" else f"true_{name}"]
    value = events[name].abs() if name == "mass_kda" else events[name]
    return ((value - truth) / events[f"{over}_{name}"]).to_numpy()


def _assert_standard(pulls: np.ndarray) -> None:
    n = pulls.size
    assert abs(pulls.mean()) < SIGMAS / math.sqrt(n)
    assert abs(pulls.std() - 1) < SIGMAS / math.sqrt(2 * n)


@pytest.mark.parametrize("name", ["x_nm", "y_nm", "mass_kda"])
def test_pulls_are_standard(events: pd.DataFrame, name: str) -> None:
    _assert_standard(_pulls(events, name, "sigma"))


@pytest.mark.parametrize("name", ["x_nm", "y_nm", "mass_kda"])
def test_the_spread_meets_the_bound(events: pd.DataFrame, name: str) -> None:
    pulls = _pulls(events, name, "crb")
    assert pulls.std() < 1.05 + SIGMAS / math.sqrt(2 * pulls.size)


def test_a_bound_of_twice_the_frames_is_missed(events: pd.DataFrame) -> None:
    """Control: a window used twice would claim √2 less."""
    with pytest.raises(AssertionError):
        _assert_standard(math.sqrt(2) * _pulls(events, "mass_kda", "sigma"))


def test_frames_lie_in_their_intervals(events: pd.DataFrame) -> None:
    late = (events["frame"] - events["true_frame"]).abs()
    inside = (late <= events[FRAME_COLUMN]).mean()
    assert inside > 0.95 - SIGMAS * math.sqrt(0.05 * 0.95 / len(events))
    heavy = events["true_mass"] > 200
    assert (late[heavy] <= 1).mean() >= 0.95


# ---- bias ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def biases() -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of a faint particle's mass, with and without the correction."""
    config = landing_config(64, 200)
    context = make_context(config, (64, 64), sliding=True)
    grid = PixelGrid.region((0, context.roi_px), (0, context.roi_px), PIXEL_NM)
    x, y, mass = 15.3, 15.8, 66.0
    signal = context.model.image(grid, x * PIXEL_NM, y * PIXEL_NM, 5.0, mass)
    rng = np.random.default_rng(4)
    start = Candidate(x, y, 5.0, mass, 8.0)
    plain, corrected = [], []
    for _ in range(1500):
        before = rng.poisson(WINDOW * LEVEL_E, grid.shape).astype(float)
        after = rng.poisson(WINDOW * LEVEL_E * (1 + signal)).astype(float)
        likelihood = conditional(context.model, grid, before, after, 1.0)
        fit = fit_particle(likelihood, start, "mass", (0.0, 1000.0), level=True)
        plain.append(fit.theta[3] / context.model.scale.amplitude(mass) - 1)
        corrected.append(fit.mass_kda / mass - 1)
    return np.array(plain), np.array(corrected)


def _assert_unbiased(errors: np.ndarray) -> None:
    assert abs(errors.mean()) < 3 * errors.std() / math.sqrt(errors.size)


def test_the_mass_of_a_faint_particle_is_unbiased(biases: tuple[np.ndarray, np.ndarray]) -> None:
    _assert_unbiased(biases[1])


def test_maximum_likelihood_alone_is_biased(biases: tuple[np.ndarray, np.ndarray]) -> None:
    """Control: by the inverse square of the signal-to-noise ratio."""
    with pytest.raises(AssertionError):
        _assert_unbiased(biases[0])
