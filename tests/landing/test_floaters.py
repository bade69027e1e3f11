"""Free 30 nm gold at a thousand frames a second: heights, errors, diffusion, against the truth.

What is expected of one frame (2·10⁴ photoelectrons per pixel, exposure 0.05 ms, 16.4 µm²/s): 0.3 nm
along z and 1 to 3 nm across by counting, 0.6 nm and 0.8 nm by the path of the exposure, and at a
height of 1.9 µm a fringe told from its neighbours by 15 standard deviations.  Of D a movie of 100
frames tells 10 %, the bound of its steps: two times 99, each with the error √2 of its square.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from floaters import Sphere, Volume
from scipy.constants import Boltzmann, zero_Celsius

import iscat_analysis as ia

pytestmark = [pytest.mark.large, pytest.mark.filterwarnings("ignore::UserWarning")]

FRAMES, MOVIES, SIDE_PX = 100, 24, 80
FRINGES, FRINGE_NM = 10, 197.4  # up to 1974 nm
GOLD_NM, GOLD_KDA, EXPOSURE_MS = 30.0, 164312.5, 0.05
WATER = Boltzmann * (25 + zero_Celsius) / (3 * np.pi * 0.89e-3 * GOLD_NM * 1e-9) * 1e12
SETTINGS = {
    "camera.pixel_size_nm": 84.0,
    "camera.gain_e_per_adu": 2.0,
    "camera.frame_rate_hz": 1000.0,
    "camera.exposure_ms": EXPOSURE_MS,
    "particle.kind": "gold",
    "particle.diameter_nm": GOLD_NM,
    "fit.mode": "track",
    "fit.z_range_nm": [0.0, 2100.0],
    "track.free": "joint",
    "track.max_step_nm": 1000.0,
    "optics.calibrate": "never",
}
SIGMAS = 4.0
NEAR_NM, WRONG_NM = 300.0, 80.0


@dataclass(frozen=True)
class Followed:
    """Rows near a particle that is in the field, with their errors; the tracks of the particles."""

    rows: pd.DataFrame
    tracks: pd.DataFrame
    inside: int


def _follow(volume: Volume, seeds: range, settings: dict[str, object]) -> Followed:
    rows, tracks, inside = [], [], 0
    for seed in seeds:
        movie = volume.record(FRAMES, (Sphere(GOLD_NM, WATER),), seed=seed, exposure_ms=EXPOSURE_MS)
        result = ia.fit_movie(movie.counts, settings=settings)
        truth = movie.truth.set_index("frame")
        inside += int(truth["inside"].sum())
        table = result.table.join(truth.add_suffix("_true"), on="frame")
        away = np.hypot(table["x_nm"] - table["x_nm_true"], table["y_nm"] - table["y_nm_true"])
        table = table[table["inside_true"].astype(bool) & (away < NEAR_NM)]
        rows.append(table)
        longest = result.tracks["n_frames"].idxmax()
        tracks.append(result.tracks.loc[[longest]])
    return Followed(pd.concat(rows), pd.concat(tracks), inside)


@pytest.fixture(scope="module")
def volume() -> Volume:
    return Volume((SIDE_PX, SIDE_PX))


@pytest.fixture(scope="module")
def gold(volume: Volume) -> Followed:
    return _follow(volume, range(101, 101 + MOVIES), SETTINGS)


def _errors(rows: pd.DataFrame, name: str) -> pd.Series:
    return rows[name] - rows[f"{name}_true"]


def test_heights_are_those_of_the_particle_through_ten_fringes(gold: Followed) -> None:
    good = gold.rows[gold.rows["status"] == "ok"]
    assert len(good) > 0.85 * gold.inside
    off = _errors(good, "z_nm")
    assert np.mean(off.abs() > WRONG_NM) < 0.005
    good, off = good[off.abs() < WRONG_NM], off[off.abs() < WRONG_NM]
    fringe = (good["z_nm_true"] // FRINGE_NM).astype(int)
    assert set(range(FRINGES)) <= set(fringe)
    for number in range(FRINGES):
        mine = off[fringe == number]
        assert abs(mine.mean()) < SIGMAS * mine.std() / np.sqrt(len(mine)), number
    assert abs(off.mean()) < SIGMAS * off.std() / np.sqrt(len(off))
    assert off.std() / np.sqrt(len(off)) < 0.1


@pytest.mark.parametrize("name", ["x_nm", "y_nm", "z_nm"])
def test_errors_hold_the_path_of_the_exposure(gold: Followed, name: str) -> None:
    good = gold.rows[gold.rows["status"] == "ok"]
    good = good[_errors(good, "z_nm").abs() < WRONG_NM]
    pulls = _errors(good, name) / good[f"sigma_{name}"]
    assert abs(pulls.mean()) < SIGMAS * pulls.std() / np.sqrt(len(pulls))
    assert pulls.std() == pytest.approx(1.0, abs=0.1)


def test_diffusion_and_size_are_right(gold: Followed) -> None:
    tracks = gold.tracks
    weight = 1 / tracks["crb_d_um2_s"] ** 2 * tracks["d_um2_s"] ** 2  # of the relative error
    relative = float(np.average(tracks["d_um2_s"] / WATER - 1, weights=weight))
    error = float(1 / np.sqrt(weight.sum()))
    assert error < 0.025
    assert abs(relative) < 0.03 + 2 * error
    pulls = (tracks["d_um2_s"] - WATER) / tracks["sigma_d_um2_s"]
    assert abs(pulls.mean()) < SIGMAS / np.sqrt(len(pulls))
    assert pulls.std() == pytest.approx(1.0, abs=SIGMAS / np.sqrt(2 * len(pulls)))
    assert tracks["diameter_nm"].median() == pytest.approx(GOLD_NM, rel=0.06)


def test_masses_count_the_frames_in_which_the_path_was_wide(gold: Followed) -> None:
    """Some frames lack a third of the mass; without these the mean would be 1.4 % too high."""
    relative = gold.tracks["mass_kda"] / GOLD_KDA - 1
    assert abs(relative.mean()) < 0.005 + 2 * relative.std() / np.sqrt(len(relative))
    pulls = relative * GOLD_KDA / gold.tracks["sigma_mass_kda"]
    assert pulls.std() == pytest.approx(1.0, abs=SIGMAS / np.sqrt(2 * len(pulls)))


def test_pictures_that_know_of_no_motion_do_not_fit(volume: Volume) -> None:
    """The control: told that the exposure is a flash, masses are too low and pulls too wide."""
    few = _follow(volume, range(102, 105), SETTINGS | {"camera.exposure_ms": 1e-3})
    pulls = _errors(few.rows, "z_nm") / few.rows["sigma_z_nm"]
    assert pulls[pulls.abs() < WRONG_NM].std() > 1.4
    assert few.tracks["mass_kda"].median() < 0.93 * GOLD_KDA
