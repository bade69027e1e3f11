"""Mode ``track`` in dark field, over a background that is learnt with the tracks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import iscat_analysis as ia
from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import configure
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.ranges import background_mode, measured_windows
from iscat_analysis.movie import open_stack
from iscat_analysis.study import write_stack

PHOTONS = 600.0
D_UM2_S = 0.8
SIGMAS = 4.0
SETTINGS: dict[str, Any] = {
    "optics.scheme": "darkfield", "optics.na": 1.2, "optics.focus_nm": 0.0,
    "camera.pixel_size_nm": 84.0, "camera.gain_e_per_adu": 1.0, "camera.offset_adu": 100.0,
    "camera.read_noise_e": 1.0, "camera.frame_rate_hz": 200.0, "camera.exposure_ms": 1.0,
    "particle.kind": "gold", "particle.diameter_nm": 20.0, "particle.height_nm": 20.0,
    "particle.photons_per_frame": PHOTONS, "fit.mode": "track", "fit.roi_nm": 1300.0,
    "track.free": "mass", "track.max_step_nm": 600.0,
    "simulation.shape": [44, 44], "simulation.frames": 60, "simulation.photons_per_pixel": PHOTONS,
    "simulation.movers": [{"d_um2_s": D_UM2_S, "x_px": 22.0, "y_px": 22.0}],
}  # fmt: skip


def _written(folder: Path, seed: int) -> tuple[Path, float]:
    """Write a movie of one particle, and give its mass."""
    level = {"background.method": "known", "background.level_e": 20.0}
    path = folder / f"movie_{seed}.tif"
    truth = write_stack(configure(settings=SETTINGS | level), path, seed=seed)
    return path, float(truth["mass_kda"].iloc[0])


def test_dark_field_tracks_need_no_frames_before(tmp_path: Path) -> None:
    """The median of all frames has much of a particle that goes no farther than it is wide."""
    path, mass = _written(tmp_path, 1)
    config = configure(settings=SETTINGS)
    assert config.background.method == "tracks"
    assert background_mode(config) == "tracks"
    result = ia.fit_movie(path, config=config)
    (track,) = result.tracks[result.tracks["n_frames"] > 30].to_dict("records")
    assert abs(track["mass_kda"] - mass) < SIGMAS * track["sigma_mass_kda"]
    assert abs(track["d_um2_s"] - D_UM2_S) < SIGMAS * track["sigma_d_um2_s"]
    assert track["sigma_mass_kda"] < 0.02 * mass
    folder = result.save(tmp_path / "out.iscat")
    with ia.open_result(folder, movie=path) as stored:
        assert isinstance(stored.view(int(track["track"])), Figure)
    with open_stack(path) as movie:
        camera = camera_from_config(config.camera, movie.shape[1:], movie.dtype)
        median = measured_windows(movie, config, camera, (0, 60), (0, 60))
    assert median.before_e.max() / 60 > 22.0  # of 20 e: not the background yet


def test_a_movie_too_short_to_learn_the_background_of_is_refused(tmp_path: Path) -> None:
    path, _ = _written(tmp_path, 1)
    short = configure(settings=SETTINGS | {"fit.frames": [0, 15], "track.min_frames": 10})
    with pytest.raises(DataError, match="too few to tell particles that move"):
        ia.fit_movie(path, config=short)


@pytest.mark.large
def test_masses_and_d_of_dark_field_tracks_are_right_to_their_errors(tmp_path: Path) -> None:
    """Twelve movies; with the median of the frames as the background masses are 5 % too small."""
    pulls = []
    for seed in range(12):
        path, mass = _written(tmp_path, 10 + seed)
        tracks = ia.fit_movie(path, config=configure(settings=SETTINGS)).tracks
        for track in tracks[tracks["n_frames"] > 30].to_dict("records"):
            pulls.append(
                (
                    (track["mass_kda"] - mass) / track["sigma_mass_kda"],
                    (track["d_um2_s"] - D_UM2_S) / track["sigma_d_um2_s"],
                )
            )
    found = np.array(pulls)
    assert len(found) >= 10
    assert (np.abs(found.mean(axis=0)) < SIGMAS / np.sqrt(len(found))).all()
    assert (np.abs(found.std(axis=0) - 1) < SIGMAS / np.sqrt(2 * len(found))).all()
