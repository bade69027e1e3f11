"""What all particles do at once, and frames that show nothing new."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from wanderers import FRAME_RATE_HZ, SETTINGS, wander

import iscat_analysis as ia
from iscat_analysis.camera import Camera
from iscat_analysis.movie import open_stack
from iscat_analysis.tracking.frames import keep_frames
from iscat_analysis.tracking.tracks import common_motion

FRAMES, TRACKS = 300, 8
STEP_NM = np.where(np.arange(TRACKS) % 2, 30.0, 70.0)

Walk = NDArray[np.float64]


def _walk(seed: int, frames: int = FRAMES) -> Walk:
    """Places of free particles, shape (frames, tracks, 2)."""
    steps = np.random.default_rng(seed).standard_normal((frames, TRACKS, 2)) * STEP_NM[:, None]
    return np.cumsum(steps, axis=0)


def _table(walk: Walk) -> pd.DataFrame:
    frame, track = (k.ravel() for k in np.indices(walk.shape[:2]))
    return pd.DataFrame({
        "track": track, "frame": frame, "status": "ok",
        "x_nm": walk[..., 0].ravel(), "y_nm": walk[..., 1].ravel(),
    })  # fmt: skip


def _said(walk: Walk) -> list[str]:
    return [found.text for found in common_motion(_table(walk), FRAME_RATE_HZ)]


def _vibrating(walk: Walk) -> Walk:
    return walk + 15.0 * np.random.default_rng(9).standard_normal((len(walk), 1, 2))


def _lost_at_once(walk: Walk) -> Walk:
    return np.delete(walk, np.arange(140, 180), axis=0)


def _dropped(walk: Walk) -> Walk:
    return np.delete(walk, np.random.default_rng(3).choice(len(walk), 35, replace=False), axis=0)


@pytest.mark.parametrize("seed", range(20))
def test_free_particles_do_nothing_at_once(seed: int) -> None:
    walk = _walk(seed)
    assert not _said(walk)
    walk[::60, 0] += 800.0  # and one of them is lost now and then
    assert not _said(walk)


@pytest.mark.parametrize(
    ("spoiled", "words"),
    [
        (_vibrating, "all particles move together, by 2"),
        (_lost_at_once, "particles jump from frame 139 to 140"),
        (_dropped, "the camera seems to have dropped frames"),
    ],
)
def test_what_makes_d_too_large_for_all_is_said(
    spoiled: Callable[[Walk], Walk], words: str
) -> None:
    for seed in range(5):
        (said,) = _said(spoiled(_walk(seed, FRAMES + 40)))
        assert words in said
        assert "D" in said


@pytest.mark.parametrize("status", ["poor_fit", "ok"])
def test_parts_of_something_else_are_no_particles(status: str) -> None:
    """As where rings of a bright particle outside the field are taken for some that run."""
    walk = _walk(1)
    walk[150:, :3] += 600.0
    table = _table(walk)
    table.loc[table["track"] < 3, "status"] = status
    assert bool(common_motion(table, FRAME_RATE_HZ)) == (status == "ok")


def test_two_particles_are_too_few_to_tell() -> None:
    table = _table(_vibrating(_walk(1)))
    assert not common_motion(table[table["track"] < 2], FRAME_RATE_HZ)


def test_repeated_and_empty_frames_are_left_out_of_tracks() -> None:
    movie = wander((120, 64, 64), seed=2, species=((400.0, 0.3, 2),))
    counts = movie.counts.copy()
    stuck = np.arange(10, 100, 5)
    counts[stuck] = counts[stuck - 1]
    counts[[57, 58]] = 0
    result = ia.fit_movie(counts, settings=SETTINGS)
    (said,) = [line for line in result.warnings if "left out" in line]
    assert "frames 10, 15, 20, 25 and 16 more are dark, cut off or repeat" in said
    odd = [*stuck.tolist(), 57, 58]
    assert not result.table["frame"].isin(odd).any()
    own = result.table.merge(movie.truth, on="frame", suffixes=("", "_true"))
    away = np.hypot(own["x_nm"] - own["x_nm_true"], own["y_nm"] - own["y_nm_true"])
    nearest = away.groupby([own["track"], own["frame"]]).min()
    assert np.median(nearest) < 30.0  # frames have the numbers that they have in the movie
    tracks = result.tracks[result.tracks["n_frames"] > 60]
    assert len(tracks)
    assert (np.abs(tracks["d_um2_s"] - 0.3) < 4 * tracks["sigma_d_um2_s"]).all()
    power = result.analysis.power
    assert np.isnan(power).sum() == len(odd)


def test_frames_behind_a_closed_shutter_are_left_out_of_tracks() -> None:
    counts = np.random.default_rng(1).integers(900, 1100, (120, 8, 8)).astype(np.uint16)
    with open_stack(counts) as movie:
        kept = keep_frames(movie, Camera(), (0, 120))
        assert kept.movie is movie
        assert kept.finding is None
    counts[70:80] //= 300
    with open_stack(counts) as movie:
        kept = keep_frames(movie, Camera(), (0, 120))
    assert kept.numbers is not None
    assert kept.numbers.tolist() == [*range(70), *range(80, 120)]
    assert kept.finding is not None
    assert "frames 70, 71, 72, 73 and 6 more are dark" in kept.finding.text
    assert "D is too small" not in kept.finding.text  # what is dark is no frame that repeats


def test_particles_keep_what_is_divided_out_with_rows_that_flicker(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = 1 + 0.01 * np.random.default_rng(7).standard_normal((120, 64, 1))
    steady, flickering = (
        wander((120, 64, 64), seed=3, species=((400.0, 0.3, 1),), shade=shade).counts
        for shade in (None, lambda t: rows[t])
    )

    def mass(counts: NDArray[np.uint16]) -> tuple[float, float]:
        result = ia.fit_movie(counts, settings=SETTINGS)
        assert list(result.tracks["status"]) == ["ok"]
        track = result.tracks.iloc[0]
        return float(track["mass_kda"]), float(track["sigma_mass_kda"])

    wanted, error = mass(steady)
    assert abs(mass(flickering)[0] - wanted) < 0.5 * error  # of the same noise
    monkeypatch.setattr("iscat_analysis.tracking.stages.restore_particle_light", lambda *_: None)
    assert wanted - mass(flickering)[0] > 4 * error  # control


def test_steps_over_frames_that_are_known_to_be_missing_are_no_surprise() -> None:
    kept = np.delete(np.arange(FRAMES), np.random.default_rng(3).choice(FRAMES, 35, replace=False))
    table = _table(_walk(1)[kept])
    assert common_motion(table, FRAME_RATE_HZ)
    assert not common_motion(table, FRAME_RATE_HZ, kept)
