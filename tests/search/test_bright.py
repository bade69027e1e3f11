"""Bright steps of any shape are found where and when they are, and noise is left in peace."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis.camera import Camera
from iscat_analysis.config import load_config
from iscat_analysis.records import FloatArray
from iscat_analysis.search.bright import BrightStep, excess_of, find_bright_steps
from iscat_analysis.search.frames import Chunk, make_chunk, measure_frames
from iscat_analysis.search.sliding import STRIDES

LEVEL = 4000.0
WINDOW = 24
PIXEL_NM = 100.0
FRAMES, ROWS, COLUMNS = 200, 60, 64


def _ring(y_px: float, x_px: float, contrast: float) -> FloatArray:
    """No particle looks like this: a dark ring around a bright one, and nothing at the centre."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    r = np.hypot(y - y_px, x - x_px) * PIXEL_NM / 200
    return np.asarray(contrast * (r**2 - 0.3 * r**4) * np.exp(-(r**2)))


def _steps(events: list[tuple[int, float, float, float]], seed: int) -> list[BrightStep]:
    random = np.random.default_rng(seed)
    speckle = LEVEL * random.uniform(0.7, 1.3, (ROWS, COLUMNS))
    expected = np.broadcast_to(speckle, (FRAMES, ROWS, COLUMNS)).copy()
    for frame, y, x, contrast in events:
        expected[frame:] *= 1 + _ring(y, x, contrast)
    counts = random.poisson(expected).astype(np.uint16)
    settings = [
        f"camera.pixel_size_nm={PIXEL_NM}", f"fit.roi_nm={20 * PIXEL_NM}",
        "optics.wavelength_nm=444", "optics.na=1.2",
    ]  # fmt: skip
    steps = find_bright_steps(_chunk(counts), WINDOW, load_config(None, settings))
    return steps.alone(20)


def _chunk(counts: np.ndarray) -> Chunk:  # type: ignore[type-arg]
    camera = Camera(full_scale_adu=65535.0)
    light, repeats = measure_frames(counts, camera)
    return make_chunk(0, counts, ~repeats, light, camera, stride=WINDOW // STRIDES)


def test_steps_are_found_at_their_place_and_frame() -> None:
    events = [(70, 20.3, 18.8, 0.16), (131, 38.6, 43.2, -0.13)]
    steps = _steps(events, seed=5)
    assert len(steps) == 2
    for frame, y, x, _ in events:
        step = min(steps, key=lambda s: abs(s.frame - frame))
        assert abs(step.frame - frame) <= 1
        assert step.y_px == pytest.approx(y, abs=0.5)
        assert step.x_px == pytest.approx(x, abs=0.5)
        contrast = step.windows.after_e / (step.windows.power_ratio * step.windows.before_e) - 1
        truth = _ring(y, x, {e[0]: e[3] for e in events}[frame])
        cut = truth[slice(*step.rows), slice(*step.columns)]
        assert np.corrcoef(contrast.ravel(), cut.ravel())[0, 1] > 0.8


def test_noise_shows_no_step() -> None:
    assert not _steps([], seed=6)


def test_frames_of_a_neighbour_are_left_out() -> None:
    """Fifteen pixels away something happens 14 frames later; its frames are not summed."""
    (step,) = [
        s for s in _steps([(80, 25.0, 22.0, 0.15), (94, 25.0, 37.0, 0.15)], 7) if s.frame < 85
    ]
    assert step.windows.n_after < 14
    assert step.windows.n_before >= WINDOW - 2


def test_one_place_that_changes_twice_is_dated_apart_or_left_out() -> None:
    steps = _steps([(90, 30.0, 30.0, 0.15), (97, 30.0, 30.0, 0.15)], seed=8)
    assert all(step.windows.n_before < WINDOW or step.windows.n_after < WINDOW for step in steps)


@pytest.mark.parametrize("side", [1, 2, 3])
def test_energy_of_squares_is_the_mean_of_their_pixels(side: int) -> None:
    """Also at the border, where squares are cut, and beside pixels that are left out."""
    random = np.random.default_rng(9)
    change = random.standard_normal((11, 17))
    used = random.random(change.shape) > 0.1
    variance = np.where(used, random.uniform(0.5, 2.0, change.shape), 0.0)
    excess, share = excess_of(change, variance, used, side)
    assert share.shape == (-(-11 // side), -(-17 // side))
    each = np.where(used, change**2 / np.where(used, variance, 1.0) - 1, 0.0)
    for values, found in ((each, excess), (used, share)):
        for i, j in np.ndindex(share.shape):
            square = values[i * side : (i + 1) * side, j * side : (j + 1) * side]
            assert found[i, j] == pytest.approx(square.mean(), rel=1e-3, abs=1e-3)
