"""Movies given to the wrong mode are recognised, and the right ones are not accused."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scenes import Stack, make_config
from scipy.ndimage import shift
from wanderers import wander

from iscat_analysis import fit_movie
from iscat_analysis.camera import Camera, camera_from_config
from iscat_analysis.diagnosis import BLOCK, Changes, as_landing, as_moving, look_at_changes
from iscat_analysis.diagnosis.recognise import (
    LARGEST_CHANCE,
    LEAST_MOVING,
    MOST_MOVING,
    MOST_STAYING,
    find_changes,
    spot_of,
)
from iscat_analysis.errors import DataError, FloodError
from iscat_analysis.optics.forward import PixelGrid, forward_model

SIDE, BLOCKS, RATE_HZ, PIXEL_NM = 72, 30, 331.0, 84.4
LIGHT_E = 4e5
SPOT = spot_of(525.0, 1.42, PIXEL_NM)
SEEDS = range(12)
MOVIES = [pytest.param(n, marks=pytest.mark.large) if n > 2 else n for n in SEEDS]
FINE = 4  # places of the picture to a pixel


@functools.cache
def _picture(mass_kda: float) -> np.ndarray:
    """Draw a particle with FINE places to a pixel."""
    pixel = PIXEL_NM / FINE
    grid = PixelGrid.centred(2 * SIDE * FINE + 1, pixel)
    config = make_config(particle={"mass_kda": 300.0})
    model = forward_model(config, grid.diagonal_nm)
    return np.asarray(model.image(grid, 0.0, 0.0, 5.0, mass_kda))


def _seen(place_px: np.ndarray, mass_kda: float) -> np.ndarray:
    """Draw the field with a particle at (y, x) pixels, to a quarter of one."""
    row, column = (SIDE * FINE - np.rint(place_px * FINE)).astype(int)
    picture = _picture(mass_kda)
    return picture[row : row + SIDE * FINE : FINE, column : column + SIDE * FINE : FINE]


def _noisy(blocks: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    noise = rng.standard_normal(blocks.shape) / np.sqrt(LIGHT_E * BLOCK)
    blocks = 1 + blocks + noise
    return np.asarray(blocks / blocks.mean(axis=0))


def moving(seed: int, d_um2_s: float, particles: int = 6, number: int = BLOCKS) -> np.ndarray:
    """Blocks of particles that diffuse, and turn back at the border."""
    rng = np.random.default_rng(seed)
    step = np.sqrt(2 * d_um2_s * 1e6 / RATE_HZ) / PIXEL_NM
    size = number * BLOCK, 2
    blocks = np.zeros((number, SIDE, SIDE))
    for which in range(particles):
        path = rng.uniform(8, SIDE - 8, 2) + np.cumsum(rng.normal(0, step, size), axis=0)
        path = SIDE - 1 - np.abs(np.mod(path, 2 * (SIDE - 1)) - (SIDE - 1))
        for frame, place in enumerate(path):
            blocks[frame // BLOCK] += _seen(place, 400.0 if which % 2 else 200.0) / BLOCK
    return _noisy(blocks, rng)


def landing(
    seed: int, events: int = 16, drift_px: float = 0.0, leave: bool = False, stay: int = 200
) -> np.ndarray:
    """Blocks of particles that land in any frame, over a pattern that may drift.

    Some `leave` after as many frames as they `stay`.
    """
    rng = np.random.default_rng(seed)
    frames = np.arange(BLOCKS * BLOCK).reshape(BLOCKS, BLOCK)
    pattern = 0.15 * rng.standard_normal((SIDE, SIDE)) if drift_px else 0.0
    blocks = np.zeros((BLOCKS, SIDE, SIDE))
    for _ in range(events):
        first = rng.integers(0, frames.size)
        last = first + stay if leave else frames.size
        share = ((frames >= first) & (frames < last)).mean(axis=1)
        place = rng.uniform(4, SIDE - 4, 2)
        blocks += share[:, None, None] * _seen(place, 480.0)
    if drift_px:
        smooth = shift(pattern, 0.5, order=1)
        blocks += [shift(smooth, drift_px * k, order=3, mode="wrap") for k in range(BLOCKS)]
    return _noisy(blocks, rng)


@pytest.mark.parametrize("seed", MOVIES)
@pytest.mark.parametrize("leave", [False, True])
def test_landings_are_told_from_motion(seed: int, leave: bool) -> None:
    found = find_changes(landing(seed, leave=leave), SPOT)
    assert found.number >= 5
    assert found.moving < 0.2
    assert as_moving(found, "movie.tif") is None
    said = as_landing(found, "movie.tif").text
    assert 'fit.mode = "mass"' in said
    assert f"of {found.number} clear changes" in said


@pytest.mark.parametrize("seed", MOVIES)
@pytest.mark.parametrize("d_um2_s", [0.1, 0.3, 0.8])
def test_motion_is_told_from_landings(seed: int, d_um2_s: float) -> None:
    found = find_changes(moving(seed, d_um2_s), SPOT)
    assert as_landing(found, "movie.tif") is None
    assert 'fit.mode = "track"' in as_moving(found, "movie.tif").text


@pytest.mark.parametrize("d_um2_s", [0.05, 0.15, 0.5])
def test_motion_of_two_particles_is_told_in_300_frames(d_um2_s: float) -> None:
    said = 0
    for seed in SEEDS:
        found = find_changes(moving(seed, d_um2_s, particles=2, number=15), SPOT)
        assert as_landing(found, "movie.tif") is None
        said += as_moving(found, "movie.tif") is not None
    assert said >= 11


@pytest.mark.parametrize(
    ("frames", "species"), [(200, ((400.0, 0.15, 2), (200.0, 0.8, 1))), (300, ((400.0, 0.05, 3),))]
)
@pytest.mark.parametrize(
    "seed", [300, *(pytest.param(seed, marks=pytest.mark.large) for seed in (301, 302))]
)
def test_a_movie_of_three_particles_that_move_is_told(
    seed: int, frames: int, species: tuple[tuple[float, float, int], ...]
) -> None:
    movie = Stack(wander((frames, 64, 64), seed=seed, species=species).counts)
    config = make_config(camera={"pixel_size_nm": 84.0, "gain_e_per_adu": 20.0})
    camera = camera_from_config(config.camera, (64, 64), np.uint16)
    found = look_at_changes(movie, config, camera, (0, frames))
    assert 'fit.mode = "track"' in as_moving(found, "movie.tif").text


@pytest.mark.parametrize("stay", [10, 30, 60])
@pytest.mark.parametrize("seed", MOVIES)
def test_particles_that_land_for_a_moment_do_not_move(seed: int, stay: int) -> None:
    found = find_changes(landing(seed, events=8, leave=True, stay=stay), SPOT)
    assert found.number > 0
    assert as_moving(found, "movie.tif") is None


@pytest.mark.parametrize("seed", MOVIES)
def test_a_place_where_one_lands_and_leaves_again_and_again_does_not_move(seed: int) -> None:
    rng = np.random.default_rng(seed)
    there = np.cumsum(rng.random(BLOCKS * BLOCK) < 0.03) % 2
    share = there.reshape(BLOCKS, BLOCK).mean(axis=1)
    blocks = share[:, None, None] * _seen(rng.uniform(4, SIDE - 4, 2), 400.0)
    found = find_changes(_noisy(blocks, rng), SPOT)
    assert found.number > 0
    assert as_moving(found, "movie.tif") is None


@pytest.mark.parametrize("seed", MOVIES)
def test_neighbours_that_land_one_after_the_other_do_not_move(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = np.arange(BLOCKS * BLOCK).reshape(BLOCKS, BLOCK)
    blocks = np.zeros((BLOCKS, SIDE, SIDE))
    for first, place in zip(range(60, 541, 120), rng.uniform(8, SIDE - 8, (5, 2)), strict=True):
        for when, where in ((first, place), (first + 25, place + np.array([0.0, 3.5]))):
            blocks += (frames >= when).mean(axis=1)[:, None, None] * _seen(where, 400.0)
    found = find_changes(_noisy(blocks, rng), SPOT)
    assert found.number > 0
    assert as_moving(found, "movie.tif") is None


def test_few_landings_are_told_in_mode_track() -> None:
    said = [as_landing(find_changes(landing(s, events=3), SPOT), "movie.tif") for s in SEEDS]
    assert sum(map(bool, said)) >= 11


@pytest.mark.parametrize("seed", MOVIES)
def test_slow_motion_is_not_taken_for_landings(seed: int) -> None:
    assert as_landing(find_changes(moving(seed, 0.01), SPOT), "movie.tif") is None


@pytest.mark.parametrize("seed", MOVIES)
def test_a_pattern_that_drifts_is_not_taken_for_motion(seed: int) -> None:
    found = find_changes(landing(seed, drift_px=0.02), SPOT)
    assert found.number > 0
    assert as_moving(found, "movie.tif") is None


@pytest.mark.parametrize("seed", MOVIES)
def test_an_empty_movie_shows_neither(seed: int) -> None:
    found = find_changes(landing(seed, events=0), SPOT)
    assert found.number == 0
    assert as_landing(found, "m") is as_moving(found, "m") is None


def test_few_changes_say_nothing() -> None:
    assert max(MOST_STAYING, MOST_MOVING) ** 2 < LARGEST_CHANCE < min(MOST_STAYING, MOST_MOVING)
    assert as_landing(Changes(1, 1.0, 0.0), "movie.tif") is None
    assert as_landing(Changes(2, 1.0, 0.0), "movie.tif") is not None
    assert as_moving(Changes(1, 0.0, 1.0), "movie.tif") is None
    assert as_moving(Changes(2, 0.0, 1.0), "movie.tif") is not None


def test_movies_of_both_kinds_are_of_neither() -> None:
    """Many changes make a small share significant, as where landings crowd."""
    assert as_moving(Changes(100, 0.7, LEAST_MOVING - 0.05), "movie.tif") is None
    assert as_moving(Changes(100, 0.5, LEAST_MOVING + 0.05), "movie.tif") is not None


def test_too_few_blocks_show_no_changes() -> None:
    assert find_changes(np.ones((4, 8, 8)), SPOT).number == 0


def test_what_is_wrong_with_a_moving_movie_is_said_all_the_same() -> None:
    """That its particles move explains a flood of candidates, and no other error."""
    movie = wander((200, 64, 64), seed=3, species=((400.0, 0.15, 3), (400.0, 0.8, 2)))
    with pytest.raises(DataError, match=r"background\.window_frames = 150") as raised:
        fit_movie(
            movie.counts,
            settings={
                "background.window_frames": 150, "camera.pixel_size_nm": 84.0,
                "camera.gain_e_per_adu": 20.0, "fit.mode": "mass", "optics.calibrate": "never",
            },
        )  # fmt: skip
    assert not isinstance(raised.value, FloodError)


def test_pixels_that_blink_are_no_particles_that_move() -> None:
    rng = np.random.default_rng(4)
    blocks = np.zeros((BLOCKS, SIDE, SIDE))
    for y, x in rng.integers(0, SIDE, (20, 2)):
        lit = np.cumsum(rng.random(BLOCKS * BLOCK) < 0.01) % 2
        blocks[:, y, x] += 0.03 * lit.reshape(BLOCKS, BLOCK).mean(axis=1)
    changes = find_changes(_noisy(blocks, rng), SPOT)
    assert not as_moving(changes, "movie")
    assert changes.number <= 5  # at the border neighbours are missing


def test_a_round_beam_on_a_larger_field_shows_no_motion() -> None:
    """Where it is dim a contrast has more noise, which comes and goes from block to block."""
    rng = np.random.default_rng(4)
    y, x = np.indices((SIDE, SIDE))
    beam = 1e5 * np.exp(-2 * ((x - 36) ** 2 + (y - 33) ** 2) / 25**2)
    contrast = np.zeros((SIDE, SIDE))
    counts = np.empty((600, SIDE, SIDE), dtype=np.uint16)
    for frame in range(600):
        if frame % 50 == 25:
            contrast = contrast + _seen(rng.uniform(24, 48, 2), 480.0)
        counts[frame] = np.round(rng.poisson(beam * (1 + contrast)) / 4 + 100)
    config = make_config(background={"method": "sliding", "frames": None}, fit={"frames": None})
    camera = Camera(4.0, 100.0, 2.0)
    found = look_at_changes(Stack(counts), config, camera, (0, 600))
    assert found.number >= 5
    assert as_moving(found, "movie.tif") is None
    assert as_landing(found, "movie.tif") is not None
