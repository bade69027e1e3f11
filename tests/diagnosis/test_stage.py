"""A stage that moves is seen before anything is searched, and then the pattern is followed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import fourier_shift, gaussian_filter

import iscat_analysis as ia
from iscat_analysis.camera import Camera
from iscat_analysis.search.noise import measure_motion, measure_noise
from iscat_analysis.study import Movie

LEVEL_E = 1e5
SHAPE = (240, 64, 72)
FRAMES = np.arange(SHAPE[0])


def _counts(shift_px: np.ndarray, *, added: np.ndarray | float = 0.0) -> np.ndarray:
    """Make a speckle pattern that moves along x, with the noise of its light."""
    rng = np.random.default_rng(11)
    pattern = gaussian_filter(rng.standard_normal(SHAPE[1:]), 1.2, mode="wrap")
    waves = np.fft.fft2(1 + 0.1 * pattern / pattern.std())
    moved = [np.fft.ifft2(fourier_shift(waves, (0.0, d))).real for d in shift_px]
    return rng.poisson(LEVEL_E * (np.array(moved) + added)).astype(np.uint32)


def _landing() -> np.ndarray:
    """Make something as bright as a particle of some MDa, from the middle of the movie on."""
    picture = np.zeros(SHAPE[1:])
    picture[30, 40] = 1.0
    picture = 0.05 * gaussian_filter(picture, 1.5) / gaussian_filter(picture, 1.5).max()
    return np.asarray((SHAPE[0] // 2 <= FRAMES)[:, None, None] * picture)


@pytest.mark.parametrize(
    ("shift_px", "added", "moves"),
    [
        (0 * FRAMES, 0.0, False),
        (0 * FRAMES, _landing(), False),
        (2e-4 * FRAMES, 0.0, True),
        (2e-3 * FRAMES, _landing(), True),
        (0.01 * np.sin(FRAMES / 20), 0.0, True),
        (0.05 * (FRAMES > 100), 0.0, True),
    ],
    ids=["at rest", "a particle lands", "drift", "drift and a particle", "to and fro", "a step"],
)
def test_motion_is_seen_in_the_noise_of_averages(
    shift_px: np.ndarray, added: Any, moves: bool
) -> None:
    share = measure_motion(_counts(shift_px, added=added), Camera(), 40)
    assert share > 0.1 if moves else abs(share) < 0.01


def test_noise_without_motion_is_that_of_the_light() -> None:
    """The pattern goes by 1 px in the movie; control: its motion left in."""
    counts = _counts(4e-3 * FRAMES)
    whole, rest = (measure_noise(counts, Camera(), 30, follows=f) for f in (False, True))
    assert whole.at(30) > 10
    assert abs(rest.at(30) - 1) < 0.15
    assert rest.best > 2 * whole.best


def _fitted(drift: float, setting: bool | str) -> tuple[bool, ia.Result]:
    """Fit a movie; whether the pattern was followed, as the configuration that repeats it says."""
    settings = {
        "camera.pixel_size_nm": 84.0, "camera.gain_e_per_adu": 4.0, "optics.calibrate": "never",
        "particle.mass_kda": 146.0, "calibration.gradient_per_kda": -3.1e-5,
        "simulation.shape": [72, 72], "simulation.frames": 400, "simulation.count": 6,
        "simulation.photons_per_pixel": 1e5, "simulation.leavings": 0,
        "simulation.species": [480.0], "simulation.background": "speckle",
        "simulation.speckle_contrast": 0.1,
        "simulation.drift_px_per_frame": [drift, 0.0], "background.drift_correction": setting,
        "compute.workers": 1, "fit.spheres": (),
    }  # fmt: skip
    config = ia.configure(settings=settings)
    counts = np.array(list(Movie(config, 3).frames(3)))
    result = ia.fit_movie(counts, config=config)
    return "drift_correction = true" in result.config_toml, result


def test_the_pattern_is_followed_where_it_moves() -> None:
    """Control: nothing is well described where it is not."""
    followed, result = _fitted(1e-3, "auto")
    assert followed
    assert (result.table["status"] == "ok").sum() >= 5
    assert result.summary["landing"]["drift_corrected"]
    followed, result = _fitted(1e-3, False)
    assert not followed
    assert (result.table["status"] == "ok").sum() <= 1


def test_nothing_is_followed_where_it_rests() -> None:
    followed, result = _fitted(0.0, "auto")
    assert not followed
    assert (result.table["status"] == "ok").sum() >= 5
    assert not result.summary["landing"]["drift_corrected"]
