"""Frames that were interpolated, smoothed or sharpened are told from raw ones by their noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, median_filter, shift

from iscat_analysis.camera import Camera, find_processing

FRAMES, SIDE, GAIN = 150, 96, 4.0

Movie = NDArray[np.float64]


@dataclass(frozen=True)
class Source:
    """Frames in memory."""

    counts: Movie
    name: str = "movie"

    @property
    def shape(self) -> tuple[int, int, int]:
        frames, rows, columns = self.counts.shape
        return frames, rows, columns

    def read(self, start: int, stop: int) -> Movie:
        return self.counts[start:stop]


def raw(
    seed: int, light_e: float = 1000.0, laser: float = 0.02, vibration_px: float = 0.0
) -> Movie:
    """Draw counts of a rough pattern in unsteady light."""
    rng = np.random.default_rng(seed)
    pattern = gaussian_filter(rng.standard_normal((SIDE + 20, SIDE + 20)), 1.5)
    pattern = 1 + 0.1 * pattern / pattern.std()
    frames = np.empty((FRAMES, SIDE, SIDE))
    for frame in frames:
        seen = shift(pattern, vibration_px * rng.standard_normal(2)) if vibration_px else pattern
        power = light_e * (1 + laser * rng.standard_normal())
        frame[:] = rng.poisson(power * seen[10:-10, 10:-10]) / GAIN
    return np.round(frames)


def cut_off(counts: Movie) -> Movie:
    """Lose half of every thirtieth frame."""
    counts[::30, SIDE // 2 :] = 0
    return counts


def aligned(counts: Movie, px_per_frame: float) -> Movie:
    """Take a drift out by bilinear interpolation."""
    out = np.empty_like(counts[:, 1:, 1:])
    for number, frame in enumerate(counts):
        x, y = px_per_frame * number % 1, px_per_frame * number / 2 % 1
        rows = (1 - y) * frame[:-1] + y * frame[1:]
        out[number] = (1 - x) * rows[:, :-1] + x * rows[:, 1:]
    return np.round(out)


def registered(counts: Movie) -> Movie:
    """Move each frame by a random fraction of a pixel, with cubic splines."""
    rng = np.random.default_rng(1)
    return np.round([shift(frame, rng.normal(0, 0.2, 2), mode="nearest") for frame in counts])


def kind(counts: Movie) -> str | None:
    camera = Camera(offset_adu=0.0, gain_e_per_adu=GAIN)
    found = find_processing(Source(counts), camera, (0, len(counts)))
    return None if found is None else found.kind


@pytest.mark.parametrize(
    "seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.large) for seed in (3, 4, 5))]
)
@pytest.mark.parametrize("vibration_px", [0.0, 0.1, 0.3])
def test_raw_counts_are_raw(seed: int, vibration_px: float) -> None:
    assert kind(raw(seed, vibration_px=vibration_px)) is None


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda counts: np.round(counts / 16), id="few bits"),
        pytest.param(lambda counts: counts / counts.mean((1, 2), keepdims=True) * 250, id="power"),
        pytest.param(lambda counts: np.repeat(counts[::2], 2, axis=0), id="each frame twice"),
        pytest.param(lambda counts: np.roll(counts, 3, axis=2), id="whole pixels"),
        pytest.param(cut_off, id="frames cut off"),
    ],
)
def test_what_leaves_the_noise_of_pixels_alone_is_no_processing(
    change: Callable[[Movie], Movie],
) -> None:
    assert kind(change(raw(7, laser=0.1))) is None


@pytest.mark.parametrize("px_per_frame", [0.002, 0.004, 0.02, 0.3])
def test_a_movie_that_was_aligned_is_interpolated(px_per_frame: float) -> None:
    assert kind(aligned(raw(2), px_per_frame)) == "interpolated"


def test_splines_interpolate_too() -> None:
    assert kind(registered(raw(3))) == "interpolated"


def test_filters_are_recognised() -> None:
    counts = raw(4)
    assert kind(np.array([median_filter(frame, 3) for frame in counts])) == "smoothed"
    smooth = np.array([gaussian_filter(frame, 0.6) for frame in counts])
    assert kind(smooth) == "smoothed"
    assert kind(counts + 1.5 * (counts - smooth)) == "sharpened"


def test_too_few_or_too_dark_frames_tell_nothing() -> None:
    assert kind(aligned(raw(5), 0.3)[:5]) is None
    assert kind(aligned(raw(5, light_e=10.0), 0.3)) is None
