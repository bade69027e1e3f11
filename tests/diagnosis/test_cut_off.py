"""Frames whose transfer broke off: left out in every mode, and named."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import make_config
from wanderers import SETTINGS, wander

import iscat_analysis as ia
from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.search.frames import cut_off
from iscat_analysis.study import Movie

Counts = NDArray[np.uint16]
OFFSET = 100


def _counts(config: Config, seed: int = 2) -> Counts:
    light = np.array(list(Movie(config, seed).expected_frames()))
    return np.round(np.random.default_rng(seed).poisson(light) / 4 + OFFSET).astype(np.uint16)


def _config(way: str) -> Config:
    spans = {
        "fixed": ({"method": "fixed", "frames": [0, 40]}, [40, 80]),
        "sliding": ({"method": "sliding", "frames": None, "window_frames": 30}, None),
    }
    background, frames = spans[way]
    return make_config(
        background=background, fit={"frames": frames}, optics={"calibrate": "never"},
        camera={"gain_e_per_adu": 4.0, "offset_adu": OFFSET},
        simulation={
            "shape": [48, 48], "frames": 80, "photons_per_pixel": 1e5,
            "events": [{"frame": 40, "x_px": 24.0, "y_px": 26.0, "mass_kda": 500.0}],
        },
    )  # fmt: skip


def test_frames_without_their_first_or_last_rows_are_told() -> None:
    counts = np.random.default_rng(1).poisson(1e3, (20, 32, 24)).astype(np.uint16)
    counts[:, :, :4] //= 50  # a border that is dark in every frame
    counts[3, 20:], counts[7, :1], counts[9] = 0, 0, 0
    counts[12] //= 3  # dim, but whole
    assert np.flatnonzero(cut_off(counts, Camera())).tolist() == [3, 7, 9]
    dim = np.random.default_rng(1).poisson(0.1, (20, 32, 24)).astype(np.uint16)
    assert not cut_off(dim, Camera()).any()  # as in dark field


@pytest.fixture(scope="module")
def wholes() -> dict[str, ia.Result]:
    """Fit the movies of which no frame is cut off."""
    return {
        way: ia.fit_movie(_counts(_config(way)), config=_config(way))
        for way in ("fixed", "sliding")
    }


@pytest.mark.parametrize(
    ("way", "filled", "number"),
    [("fixed", 0, 20), ("fixed", OFFSET, 60), ("sliding", OFFSET, 20), ("sliding", 0, 60)],
)
def test_half_a_frame_is_left_out_of_sums(
    way: str, filled: int, number: int, wholes: dict[str, ia.Result]
) -> None:
    """In the background as well as after it; what the others say of the particle stays."""
    config = _config(way)
    counts, whole = _counts(config), wholes[way]
    assert not [text for text in whole.warnings if "cut off" in text]
    counts[number, 24:] = filled
    result = ia.fit_movie(counts, config=config)
    (said,) = [text for text in result.warnings if "cut off" in text]
    assert f"frame {number} " in said
    assert list(result.table["status"]) == ["ok"]
    one, other = (float(r.table["mass_kda"].iloc[0]) for r in (whole, result))
    assert abs(one - other) < 0.5 * float(result.table["sigma_mass_kda"].iloc[0])


def test_frames_behind_a_shutter_are_named_in_a_recorded_background() -> None:
    config = _config("fixed")
    counts = _counts(config)
    counts[10:14] = np.random.default_rng(3).poisson(OFFSET, (4, 48, 48))
    counts[50] = 0  # dropped
    result = ia.fit_movie(counts, config=config)
    (said,) = [text for text in result.warnings if "cut off" in text]
    assert "frames 10, 11, 12, 13 and 1 more of 80 are dark" in said
    assert not [text for text in result.warnings if "repeat" in text]
    assert list(result.table["status"]) == ["ok"]


def test_particles_that_move_lose_a_frame_that_is_cut_off() -> None:
    counts = wander((120, 64, 64), seed=3, species=((400.0, 0.3, 1),)).counts
    counts[30, 32:] = 0
    result = ia.fit_movie(counts, settings=SETTINGS)
    (said,) = [text for text in result.warnings if "cut off" in text]
    assert "frame 30 is dark, cut off" in said
    assert list(result.tracks["status"]) == ["ok"]
    assert 30 not in set(result.table["frame"])


def test_mode_track_over_a_recorded_background_goes_on_after_such_frames() -> None:
    config = _config("fixed")
    counts = _counts(config)
    counts[60, 24:], counts[65] = 0, OFFSET
    settings = {"fit.mode": "track", "track.free": "mass", "camera.frame_rate_hz": 100.0}
    result = ia.fit_movie(counts, config=config, settings=settings)
    assert any("frames 60, 65 of 80 are dark or cut off" in text for text in result.warnings)
    assert sorted(set(result.table["frame"])) == sorted(set(range(40, 80)) - {60, 65})
