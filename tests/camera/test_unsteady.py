"""Pixels that switch, are noisy or repeat themselves: found, and nothing else is."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import tifffile
from noisy import GAIN, SIDE, speckled_counts
from numpy.typing import NDArray
from scenes import make_config
from small_movies import SETUP, simulate

import iscat_analysis as ia
from iscat_analysis.camera import Camera, find_unsteady, unsteady_finding
from iscat_analysis.diagnosis import least_beside
from iscat_analysis.study import Movie

Counts = NDArray[np.float64]

SHAPE = (48, 64)
LEVEL_E, FRAMES, BLOCKS = 1e5, 8, 24
CAMERA = Camera()
LEAST = least_beside(0.92)  # of pixels of 84 nm


def _steady(seed: int) -> Counts:
    """Draw blocks of frames next to each other, each with a power of its own."""
    rng = np.random.default_rng(seed)
    light = LEVEL_E * (1 + 0.1 * rng.standard_normal(SHAPE))
    power = 1 + 0.01 * rng.standard_normal((BLOCKS, FRAMES, 1, 1))
    expected = power * light
    return expected + np.sqrt(expected) * rng.standard_normal(expected.shape)


def _switching(counts: Counts, share: float) -> Counts:
    """Let one pixel rise by a share in half of the blocks."""
    counts[::2, :, 20, 30] *= 1 + share
    return counts


@pytest.mark.parametrize("share", [0.005, 0.1])
def test_a_pixel_that_switches_slowly(share: float) -> None:
    odd = find_unsteady(_switching(_steady(1), share), CAMERA, LEAST)
    assert odd is not None
    assert np.argwhere(odd).tolist() == [[20, 30]]


@pytest.mark.parametrize("excess", [0.4, 3.0])
def test_a_noisy_column_is_named(excess: float) -> None:
    counts = _steady(2)
    rng = np.random.default_rng(3)
    counts[..., 40] += np.sqrt(excess * LEVEL_E) * rng.standard_normal(counts.shape[:3])
    odd = find_unsteady(counts, CAMERA, LEAST)
    assert odd is not None
    assert odd[:, 40].all()
    assert odd.sum() == SHAPE[0]
    text = unsteady_finding(odd, "m.tif").text
    assert text.startswith("m.tif: 48 pixels (column 40) have noise that is not the light's")


def test_a_border_that_is_always_the_same() -> None:
    counts = _steady(4)
    counts[..., :2, :] = 2.4e5
    odd = find_unsteady(counts, CAMERA, LEAST)
    assert odd is not None
    assert odd[:2].all()
    assert odd.sum() == 2 * SHAPE[1]


def test_steady_pixels_are_left_alone() -> None:
    assert all(find_unsteady(_steady(seed), CAMERA, LEAST) is None for seed in range(5, 15))


def test_light_that_changes_particles_and_a_pattern_that_moves_are_no_pixels() -> None:
    y, x = np.indices(SHAPE)
    tilt = 1 + 0.03 * np.sin(np.arange(BLOCKS))[:, None, None, None] * (x / 32 - 1)
    assert find_unsteady(_steady(20) * tilt, CAMERA, LEAST) is None
    rng = np.random.default_rng(21)
    spots = _steady(22)
    for block in range(BLOCKS):  # of 2 and 20 %, that land and stay
        for k in range(2):
            at = rng.uniform(0, 48), rng.uniform(0, 64)
            spot = np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * 0.92**2))
            spots[block:] *= 1 - (0.02, 0.2)[k] * spot
    assert find_unsteady(spots, CAMERA, LEAST) is None
    moving = speckled_counts(
        [np.ones((SIDE, SIDE))] * 64, 64, "drift", np.random.default_rng(23), drift_px=0.05
    )
    assert find_unsteady(moving.reshape(8, 8, SIDE, SIDE), Camera(GAIN), LEAST) is None


def test_a_fine_pattern_that_drifts_far_is_no_pixels() -> None:
    """Over 24 blocks of a movie it goes 1.4 pixels; no pixel changes then as one that switches."""
    moving = speckled_counts(
        [np.ones((SIDE, SIDE))] * 192, 192, "drift", np.random.default_rng(28), drift_px=0.0075
    )
    assert find_unsteady(moving.reshape(24, 8, SIDE, SIDE), Camera(GAIN), LEAST) is None


def test_particles_that_move_are_no_pixels() -> None:
    """Six of 5 % go 0.7 pixels from one frame to the next, everywhere in the field."""
    rng = np.random.default_rng(24)
    counts = _steady(24)
    y, x = np.indices(SHAPE)
    walk = rng.uniform(0, SHAPE, (6, 2))
    for frame in counts.reshape(-1, *SHAPE):
        walk = (walk + 0.5 * rng.standard_normal(walk.shape)) % SHAPE
        for a, b in walk:
            frame *= 1 - 0.05 * np.exp(-((y - a) ** 2 + (x - b) ** 2) / (2 * 0.92**2))
    assert find_unsteady(counts, CAMERA, LEAST) is None


def test_where_most_are_odd_it_is_not_the_pixels() -> None:
    counts = _steady(25)
    rng = np.random.default_rng(26)
    noisy = rng.random(SHAPE) < 0.2
    counts[..., noisy] += 1e3 * rng.standard_normal((BLOCKS, FRAMES, int(noisy.sum())))
    assert find_unsteady(counts, CAMERA, LEAST) is None


def test_another_process_leaves_them_out_too(tmp_path: Path) -> None:
    counts = np.arange(1, 61, dtype=np.uint16).reshape(5, 3, 4)
    np.save(tmp_path / "movie.npy", counts)
    odd = np.zeros((3, 4), dtype=bool)
    odd[1, 2] = True
    with ia.open_stack(tmp_path / "movie.npy") as movie:
        left = movie.without(odd, np.zeros(1, dtype=np.uint16))
        again = pickle.loads(pickle.dumps(left))
        for one in (left, again):
            np.testing.assert_array_equal(one.read(0, 5), np.where(odd, 0, counts))
        again.close()
        np.testing.assert_array_equal(movie.read(0, 5), counts)
        assert left.sha256() == movie.sha256()


def test_a_movie_is_hashed_once_whoever_asks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "movie.npy", np.arange(60, dtype=np.uint16).reshape(5, 3, 4))
    hashed: list[ia.Stack] = []
    real = ia.Stack.sha256

    def counted(movie: ia.Stack) -> str:
        hashed.append(movie)
        return real(movie)

    monkeypatch.setattr(ia.Stack, "sha256", counted)
    with ia.open_stack(tmp_path / "movie.npy") as movie:
        begun = movie.hashed()
        left = movie.without(np.zeros((3, 4), dtype=bool), np.zeros(0, dtype=np.uint16))
        seen = movie.seen_as(movie)
        digests = {each.hashed().result() for each in (movie, left, seen)}
        assert digests == {begun.result()} == {real(movie)}
        assert len(hashed) == 1


def test_a_landing_movie_with_pixels_that_blink(monkeypatch: pytest.MonkeyPatch) -> None:
    """One particle, found among ten such pixels; control: without this."""
    event = {"frame": 80, "x_px": 22.0, "y_px": 25.0, "mass_kda": 800.0}
    config = make_config(
        background={"method": "sliding", "frames": None, "window_frames": 40},
        fit={"frames": None, "spheres": []}, camera={"gain_e_per_adu": 4.0},
        optics={"calibrate": "never"}, detection={"false_alarms_per_movie": 1e-3},
        simulation={"frames": 160, "photons_per_pixel": 1e5, "events": [event]},
    )  # fmt: skip
    rng = np.random.default_rng(27)
    light = np.array(list(Movie(config, 27).expected_frames()))
    for y, x in rng.integers(0, 48, (10, 2)):
        light[:, y, x] *= 1 + 0.1 * (np.cumsum(rng.random(160) < 0.03) % 2)
    counts = np.round(rng.poisson(light) / 4).astype(np.uint16)
    found = ia.fit_movie(counts, config=config)
    (row,) = found.table.to_dict("records")
    assert row["status"] == "ok"
    assert abs(row["mass_kda"] - 800.0) < 4 * row["sigma_mass_kda"]
    assert any("noise that is not the light's" in text for text in found.warnings)
    monkeypatch.setattr("iscat_analysis.diagnosis.light.find_unsteady", lambda *_: None)
    assert len(ia.fit_movie(counts, config=config).table) > 3


@pytest.mark.parametrize("light", [np.full(5, 3e-4), np.linspace(0.02, 0.8, 6)])
def test_a_shutter_that_is_closed_or_opens_is_no_pixels_and_no_gain(
    light: NDArray[np.float64], tmp_path: Path
) -> None:
    """Of the first of 30 background frames; the noise of the others is that of their light."""
    simulate(tmp_path / "movie.tif", seed=3)
    counts = tifffile.imread(tmp_path / "movie.tif")
    first = counts[: len(light)].astype(np.int64)
    counts[: len(light)] = np.random.default_rng(1).binomial(first, light[:, None, None])
    settings = {key: value for key, value in SETUP.items() if not key.startswith("simulation")}
    (said,) = ia.fit_movie(counts, settings=settings).warnings
    assert f"of {len(counts)} {'is' if light[-1] > 0.1 else 'are'} dark or cut off" in said
