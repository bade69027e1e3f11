"""Movies given to the wrong mode are recognised, and the right ones are not accused."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scenes import make_config
from scipy.ndimage import shift
from wanderers import wander

from iscat_analysis import fit_movie
from iscat_analysis.errors import DataError, FloodError
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pipeline.recognise import BLOCK, DOUBT, as_landing, as_moving
from iscat_analysis.search.changes import Changes, find_changes, spot_of

SIDE, BLOCKS, RATE_HZ, PIXEL_NM = 72, 30, 331.0, 84.4
LIGHT_E = 4e5
SPOT = spot_of(525.0, 1.42, PIXEL_NM)
SEEDS = range(12)
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


def moving(seed: int, d_um2_s: float, particles: int = 6) -> np.ndarray:
    """Blocks of particles that diffuse, and turn back at the border."""
    rng = np.random.default_rng(seed)
    step = np.sqrt(2 * d_um2_s * 1e6 / RATE_HZ) / PIXEL_NM
    blocks = np.zeros((BLOCKS, SIDE, SIDE))
    for number in range(particles):
        path = rng.uniform(8, SIDE - 8, 2) + np.cumsum(rng.normal(0, step, (600, 2)), axis=0)
        path = SIDE - 1 - np.abs(np.mod(path, 2 * (SIDE - 1)) - (SIDE - 1))
        for frame, place in enumerate(path):
            blocks[frame // BLOCK] += _seen(place, 400.0 if number % 2 else 200.0) / BLOCK
    return _noisy(blocks, rng)


def landing(seed: int, events: int = 16, drift_px: float = 0.0, leave: bool = False) -> np.ndarray:
    """Blocks of particles that land in the middle of any frame, over a pattern that may drift."""
    rng = np.random.default_rng(seed)
    frames = np.arange(BLOCKS * BLOCK).reshape(BLOCKS, BLOCK)
    pattern = 0.15 * rng.standard_normal((SIDE, SIDE)) if drift_px else 0.0
    blocks = np.zeros((BLOCKS, SIDE, SIDE))
    for _ in range(events):
        first = rng.integers(0, frames.size)
        last = first + 200 if leave else frames.size
        share = ((frames >= first) & (frames < last)).mean(axis=1)
        place = rng.uniform(4, SIDE - 4, 2)
        blocks += share[:, None, None] * _seen(place, 480.0)
    if drift_px:
        smooth = shift(pattern, 0.5, order=1)
        blocks += [shift(smooth, drift_px * k, order=3, mode="wrap") for k in range(BLOCKS)]
    return _noisy(blocks, rng)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("leave", [False, True])
def test_landings_are_told_from_motion(seed: int, leave: bool) -> None:
    found = find_changes(landing(seed, leave=leave), SPOT)
    assert found.number >= 8
    assert found.undone < 0.1
    assert as_moving(found, "movie.tif") == ""
    said = as_landing(found, "movie.tif")
    assert 'fit.mode = "mass"' in said
    assert f"of {found.number} clear changes" in said


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("d_um2_s", [0.1, 0.3, 0.8])
def test_motion_is_told_from_landings(seed: int, d_um2_s: float) -> None:
    found = find_changes(moving(seed, d_um2_s), SPOT)
    assert as_landing(found, "movie.tif") == ""
    assert 'fit.mode = "track"' in as_moving(found, "movie.tif")


@pytest.mark.parametrize("seed", SEEDS)
def test_slow_motion_is_not_taken_for_landings(seed: int) -> None:
    assert as_landing(find_changes(moving(seed, 0.01), SPOT), "movie.tif") == ""


@pytest.mark.parametrize("seed", SEEDS)
def test_a_pattern_that_drifts_is_not_taken_for_motion(seed: int) -> None:
    found = find_changes(landing(seed, drift_px=0.02), SPOT)
    assert found.number > 0
    assert as_moving(found, "movie.tif") == ""


@pytest.mark.parametrize("seed", SEEDS)
def test_an_empty_movie_shows_neither(seed: int) -> None:
    found = find_changes(landing(seed, events=0), SPOT)
    assert found.number == 0
    assert as_landing(found, "m") == as_moving(found, "m") == ""


def test_few_changes_say_nothing() -> None:
    few = Changes(5, 1.0, 0.0)
    assert 0.5**6 < DOUBT < 0.5**5
    assert as_landing(few, "movie.tif") == ""
    assert as_landing(Changes(6, 1.0, 0.0), "movie.tif") != ""
    assert as_moving(Changes(1, 0.0, 1.0), "movie.tif") == ""
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
    changes = find_changes(list(_noisy(blocks, rng)), SPOT)
    assert not as_moving(changes, "movie")
    assert changes.number <= 5  # at the border neighbours are missing
