"""The optics are learned from particles at heights of their own, where z is fitted."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from instruments import PEAK_PER_KDA, Instrument, Pictures
from scenes import Stack

from iscat_analysis.camera import camera_from_config, measure_windows
from iscat_analysis.config import load_config
from iscat_analysis.instrument import loop
from iscat_analysis.instrument.loop import learn
from iscat_analysis.instrument.result import OpticsCalibration

pytestmark = pytest.mark.large

SIGMAS = 4.0
PIXEL_NM, LEVEL_E, FRAMES, SIDE = 84.0, 2e7, 2, 140
TRUTH = Instrument(emission="reciprocal", focus_nm=-560.0, na=1.40)


@pytest.fixture(scope="module")
def movie() -> tuple[np.ndarray, np.ndarray]:
    """Frames before and after 16 particles bound, at up to 300 nm; x, y and z of each [nm]."""
    rng = np.random.default_rng(5)
    places = PIXEL_NM * (25 + 30 * np.indices((4, 4)).reshape(2, -1) + rng.uniform(-3, 3, (2, 16)))
    particles = np.vstack([places, rng.uniform(5, 300, 16)]).T
    axis = PIXEL_NM * np.arange(SIDE)
    pictures = Pictures(TRUTH, 1.05 * PIXEL_NM * math.hypot(SIDE, SIDE))
    bound = np.ones((SIDE, SIDE))
    for (x, y, z), mass in zip(particles.tolist(), rng.uniform(300, 900, 16), strict=True):
        at = (axis - x)[None, :], (axis - y)[:, None]
        bound *= 1 + pictures.at_height(z).contrast(*at, mass)
    light = LEVEL_E * np.repeat([np.ones_like(bound), bound], FRAMES, axis=0)
    return (rng.poisson(light) / 1000).astype(np.uint16), particles


def _learned(counts: np.ndarray, mode: str, focus_nm: float = -500.0) -> OpticsCalibration:
    config = load_config(
        None,
        [
            f"fit.mode={mode}",
            "fit.z_range_nm=[0,400]",
            f"optics.focus_nm={focus_nm}",
            f"camera.pixel_size_nm={PIXEL_NM}",
            "camera.gain_e_per_adu=1000",
            f"calibration.gradient_per_kda={Pictures(TRUTH).sign * PEAK_PER_KDA}",
            "background.method=fixed",
            f"background.frames=[0,{FRAMES}]",
        ],
    )
    camera = camera_from_config(config.camera, counts.shape[1:], counts.dtype)
    windows = measure_windows(Stack(counts), camera, (0, FRAMES), (FRAMES, 2 * FRAMES))
    with ThreadPoolExecutor(2) as pool:
        field = loop.WholeField(windows, config, pool)
        return learn(field, config, ("focus", "na"), {"movie": "movie"}, pool.map).outcome


@pytest.mark.parametrize("focus_nm", [-500.0, -400.0])
def test_optics_are_learned_with_the_height_of_every_particle(
    focus_nm: float, movie: tuple[np.ndarray, np.ndarray]
) -> None:
    """From a focus so far off that heights are of other fringes, too."""
    found = _learned(movie[0], "joint", focus_nm)
    assert found.accepted
    estimate = found.measured.estimate
    sigma = dict(zip(estimate.names, np.sqrt(np.diag(estimate.covariance)), strict=True))
    assert abs(estimate.values["focus_nm"] + 560.0) < SIGMAS * sigma["focus_nm"]
    assert abs(estimate.values["na"] - 1.40) < SIGMAS * sigma["na"]
    places = np.array([(s.x_nm, s.y_nm, s.z_nm) for s in estimate.images])
    nearest = np.hypot(*(places[:, None, :2] - movie[1][:, :2]).T).argmin(axis=0)
    assert np.abs(places - movie[1][nearest]).max() < 8.0


def test_particles_taken_for_ones_on_the_glass_teach_nothing(
    movie: tuple[np.ndarray, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control."""
    monkeypatch.setattr(loop, "ROUNDS", 1)
    assert not _learned(movie[0], "mass").accepted
