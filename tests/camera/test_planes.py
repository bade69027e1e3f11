"""Tracks that stay at one height while their height is fitted in every frame."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scenes import Stack, make_config

import iscat_analysis as ia
from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import fixed_height_warning
from iscat_analysis.fitting.ranges import checked
from iscat_analysis.records import silent
from iscat_analysis.study import Movie
from iscat_analysis.tracking.find import held_height_warning
from iscat_analysis.tracking.frames import Recording

STEP_NM, SIGMA_NM = 30.0, 5.0


def _table(along: float, frames: int = 60, seed: int = 1) -> pd.DataFrame:
    """Two tracks whose steps along z have a share of the variance of those along x."""
    rng = np.random.default_rng(seed)
    rows = []
    for track in range(2):
        steps = STEP_NM * rng.standard_normal((frames, 3)) * [1, 1, np.sqrt(along)]
        places = np.cumsum(steps, axis=0) + np.array([3000, 3000, 400])
        places += rng.standard_normal((frames, 3)) * [SIGMA_NM, SIGMA_NM, 1.0]
        rows.append(pd.DataFrame(places, columns=["x_nm", "y_nm", "z_nm"]))
        rows[-1] = rows[-1].assign(track=track, frame=np.arange(frames))
    return pd.concat(rows).assign(sigma_x_nm=SIGMA_NM, sigma_y_nm=SIGMA_NM, status="ok")


JOINT = make_config(fit={"mode": "track"}, track={"free": "joint"})


def test_a_membrane_is_recognised() -> None:
    found = fixed_height_warning(JOINT, _table(0.0).sample(frac=1, random_state=3))
    assert found is not None
    assert 'set track.free = "mass" and particle.height_nm = 400' in found.text
    assert found.values["across_nm"] == pytest.approx(STEP_NM, rel=0.2)
    assert found.values["along_nm"] == pytest.approx(np.sqrt(2), rel=0.3)  # noise of two heights


@pytest.mark.parametrize("along", [1.0, 0.15])
def test_particles_that_move_along_z_are_none(along: float) -> None:
    """Near the coverslip they move less along z than along it."""
    assert fixed_height_warning(JOINT, _table(along)) is None


def test_nothing_is_said_where_little_is_known() -> None:
    assert fixed_height_warning(JOINT, _table(0.0, frames=12)) is None
    assert fixed_height_warning(JOINT, _table(0.0).assign(status="poor_fit")) is None
    assert fixed_height_warning(JOINT, _table(0.0).assign(frame=np.arange(120) * 2)) is None
    held = make_config(fit={"mode": "track"}, track={"free": "mass"})
    assert fixed_height_warning(held, _table(0.0)) is None


MOVIE = {
    "background": {"frames": None},
    "fit": {"mode": "track", "frames": None},
    "track": {"free": "joint"},
    "particle": {"mass_kda": 480.0},
}
SIMULATED = {"shape": [48, 48], "frames": 60, "photons_per_pixel": 4e5, "background": "speckle"}


def _moving(seed: int = 1, *, exposure_ms: float = 0.2, **mover: Any) -> tuple[Config, Stack]:
    """Simulate two particles that move."""
    simulated = {**SIMULATED, "movers": [{"count": 2, "mass_kda": 400.0, **mover}]}
    camera = {"frame_rate_hz": 331.0, "exposure_ms": exposure_ms, "gain_e_per_adu": 20.0}
    config = make_config(**MOVIE, camera=camera, simulation=simulated)
    return config, Stack(np.array(list(Movie(config, seed).frames())))


def _said_of(config: Config, movie: Stack, flags: Sequence[str]) -> str | None:
    """Ask what is said of free heights with such rows."""
    fits = pd.DataFrame({"frame": np.arange(len(flags)) % len(movie.counts), "flags": flags})
    camera = camera_from_config(config.camera, movie.shape[1:], movie.dtype)
    with ThreadPoolExecutor(1) as pool:
        recording = Recording(movie, camera, checked(movie, camera), pool, silent)
        found = held_height_warning(config, recording, (0, len(movie.counts)), fits)
    return None if found is None else found.text


def test_a_membrane_whose_heights_were_lost_is_recognised() -> None:
    """Where free heights describe nothing, and one height does, it is no fault of the optics."""
    config, movie = _moving(d_um2_s=0.3)
    lost = _said_of(config, movie, ["poor_fit"] * 70 + [""] * 50)
    assert 'set track.free = "mass"' in lost
    assert "with heights that are free 70 of 120 fits are rejected" in lost
    assert _said_of(config, movie, ["poor_fit"] * 50 + [""] * 70) is None
    assert _said_of(config, movie, []) is None
    track = config.track.model_copy(update={"free": "mass"})
    assert _said_of(config.model_copy(update={"track": track}), movie, ["poor_fit"] * 120) is None


@pytest.mark.parametrize(
    "mover",
    [
        pytest.param(
            {"d_um2_s": 4.0, "space": "volume", "ceiling_nm": 1000.0}, marks=pytest.mark.large
        ),
        {"d_um2_s": 0.1, "space": "volume", "ceiling_nm": 100.0},
    ],
)
def test_particles_at_many_heights_are_not_taken_for_a_membrane(mover: dict[str, Any]) -> None:
    """Even where all their rows were rejected, as through wrong optics."""
    config, movie = _moving(**mover)
    assert _said_of(config, movie, ["poor_fit"] * 120) is None


@pytest.mark.large
def test_a_movie_of_a_membrane_says_so() -> None:
    """Its heights were free: of all fits nearly none was described, and the optics were blamed."""
    config, movie = _moving(seed=2, exposure_ms=2.5, d_um2_s=0.8)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        result = ia.fit_movie(movie.counts, config=config)
    assert (result.table["status"] == "ok").mean() < 0.5
    assert sum('set track.free = "mass"' in line for line in result.warnings) == 1


MEMBRANE = """
import sys
sys.path[:0] = ["tests", "tests/camera"]
import iscat_analysis as ia
from test_planes import _moving
config, movie = _moving(seed=2, exposure_ms=2.5, d_um2_s=0.8)
print(len(ia.fit_movie(movie.counts, config=config).table))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="memory is filled by its C library")
@pytest.mark.large
@pytest.mark.parametrize("filled", ["0", "255"])
def test_pixels_far_from_a_particle_outside_the_field_are_not_drawn_from_beyond_its_tables(
    filled: str,
) -> None:
    """What memory held there was at times no number, and then no particle was found."""
    done = subprocess.run(
        [sys.executable, "-c", MEMBRANE],
        env=os.environ | {"MALLOC_PERTURB_": filled},
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert int(done.stdout) == 119
