"""The ratiometric film: what it shows, in whatever order frames are asked for."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.pipeline import preview as ratio_film
from iscat_analysis.pipeline.preview import RatioFilm

FLICKER = 0.1


@pytest.fixture
def counts() -> np.ndarray:
    """Make frames of a flickering laser, in which a dark spot lands at frame 20."""
    random = np.random.default_rng(3)
    pattern = 1 + 0.2 * random.random((16, 16))
    power = 1 + FLICKER * random.standard_normal((40, 1, 1))
    frames = 1e5 * pattern * power
    frames[20:, 5, 7] *= 0.98
    return 100 + random.poisson(frames)


def _direct(counts: np.ndarray, frame: int, window: int, offset: float) -> np.ndarray:
    light = counts - offset
    light = light / light.mean(axis=(1, 2), keepdims=True)
    return light[frame : frame + window].mean(0) / light[frame - window : frame].mean(0) - 1


def test_frames_are_the_same_in_any_order(counts: np.ndarray) -> None:
    film = RatioFilm(ia.open_stack(counts), window=8, offset_adu=100.0)
    assert film.frames == (8, 33)
    for frame in (8, 9, 12, 30, 29, 20, 21, 8, 32):
        assert np.allclose(film.contrast(frame), _direct(counts, frame, 8, 100.0), atol=1e-12)
    film.window = 3
    assert np.allclose(film.contrast(20), _direct(counts, 20, 3, 100.0), atol=1e-12)


def test_a_landing_shows_and_flicker_does_not(counts: np.ndarray) -> None:
    film = RatioFilm(ia.open_stack(counts), window=8, offset_adu=100.0)
    image = film.contrast(20)
    assert image[5, 7] == pytest.approx(-0.02, abs=4 * np.sqrt(2 / 8 / 1e5))
    others = np.delete(image.ravel(), 5 * 16 + 7)
    assert np.std(others) < 1.5 * np.sqrt(2 / 8 / 1.1e5)
    raw = counts[20:28].mean(0) / counts[12:20].mean(0) - 1  # the control: without division
    assert abs(np.mean(raw)) > 10 * abs(np.mean(others))


def test_a_wrong_offset_is_what_the_film_warns_of(counts: np.ndarray) -> None:
    right = RatioFilm(ia.open_stack(counts), window=8, offset_adu=100.0).contrast(20)[5, 7]
    wrong = RatioFilm(ia.open_stack(counts), window=8, offset_adu=-1e5).contrast(20)[5, 7]
    assert abs(wrong) < 0.7 * abs(right)


def test_light_and_noise_are_measured(counts: np.ndarray) -> None:
    found = RatioFilm(ia.open_stack(counts), offset_adu=100.0).light(10)
    light = counts.mean(axis=(1, 2)) - 100.0
    assert np.allclose(found["light"], light[found["frame"]])
    assert found["noise"].median() == pytest.approx(1 / np.sqrt(light.mean()), rel=0.15)


def test_of_a_large_field_few_frames_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of 8 × 8 pixels count as those of 1200 × 1920 do with 2**29 bytes."""
    counts = 1000 + np.random.default_rng(2).poisson(100, (3000, 8, 8)).astype(np.uint16)
    read: list[int] = []
    real = ia.Stack.read

    def counting(self: ia.Stack, start: int, stop: int) -> np.ndarray:
        read.append(stop - start)
        return real(self, start, stop)

    monkeypatch.setattr(ia.Stack, "read", counting)
    film, usual = RatioFilm(ia.open_stack(counts), window=25), []
    for most in (ratio_film._READ_BYTES, round(2**29 * 64 / (1200 * 1920))):
        monkeypatch.setattr(ratio_film, "_READ_BYTES", most)
        read.clear()
        light = film.light()
        assert len(light) == sum(read) / 2
        assert light["frame"].iloc[[0, -1]].tolist() == [0, 2998]
        usual.append(sum(read))
        film.limits(ratio=True)
        usual.append(sum(read) - usual[-1])
    assert usual == [800, 250, 116, 100]


def test_dark_frames_and_impossible_windows_are_refused(counts: np.ndarray) -> None:
    with pytest.raises(ia.ConfigError, match=r"camera\.offset_adu"):
        RatioFilm(ia.open_stack(counts), offset_adu=1e9).contrast(20)
    with pytest.raises(ia.ConfigError, match="window"):
        RatioFilm(ia.open_stack(counts), window=21)


def test_a_movie_of_10_gb_needs_the_memory_of_some_images(tmp_path: Path) -> None:
    path = tmp_path / "long.npy"
    shape = (20_000, 512, 512)  # a sparse file, which takes no room on the disk
    np.lib.format.open_memmap(path, mode="w+", dtype=np.uint16, shape=shape)[-1] = 1
    with ia.open_stack(path) as movie:
        film = RatioFilm(movie, window=25, offset_adu=-100.0)
        tracemalloc.start()
        for frame in (15_000, 15_001, 15_002, 14_990):
            film.contrast(frame)
        film.light(20)
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert most < 30e6
