"""What the first frames say: a pattern that shakes, coarse counts, no noise, axes in disorder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile
from scenes import make_config
from scipy.ndimage import gaussian_filter, shift

from iscat_analysis.camera import Camera, diagnose_gain
from iscat_analysis.camera.noise import measure_pattern_jitter
from iscat_analysis.diagnosis.causes import axes_warning
from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.pipeline import analyse

SHAPE = (48, 56)
LEVEL_E = 1e5
FRAMES = 40


def _pattern(rng: np.random.Generator) -> np.ndarray:
    rough = gaussian_filter(rng.standard_normal(SHAPE), 3.0, mode="wrap")
    return np.asarray(LEVEL_E * (1 + 0.1 * rough / rough.std()))


def _movie(shaking_px: float, *, noise: float = 0.0, seed: int = 1) -> np.ndarray:
    """Frames of one pattern, moved at random, with extra noise of each pixel [√e]."""
    rng = np.random.default_rng(seed)
    pattern = _pattern(rng)
    frames = []
    for dy, dx in shaking_px * rng.standard_normal((FRAMES, 2)):
        light = shift(pattern, (dy, dx), order=3, mode="nearest")
        light *= 1 + 0.01 * rng.standard_normal()
        light += noise * np.sqrt(light) * rng.standard_normal(SHAPE)
        frames.append(rng.poisson(light))
    return np.array(frames).astype(np.uint32)


@pytest.mark.parametrize("rms_px", [0.05, 0.1])
def test_a_pattern_that_shakes_is_no_wrong_gain(rms_px: float) -> None:
    counts, camera = _movie(rms_px), Camera(well_depth_e=1e9)
    found = measure_pattern_jitter(counts, camera)
    assert found is not None
    assert found.share > 0.9
    assert found.rms_px == pytest.approx(rms_px, rel=0.25)  # 78 numbers: 8 %
    finding = diagnose_gain(counts, camera).finding
    assert finding is not None
    assert finding.code == "pattern-shakes"


def test_noise_of_single_pixels_is_no_shaking() -> None:
    """The control: twice the variance, in every pixel on its own."""
    counts, camera = _movie(0.0, noise=1.0), Camera(well_depth_e=1e9)
    found = measure_pattern_jitter(counts, camera)
    assert found is not None
    assert abs(found.share) < 0.05
    finding = diagnose_gain(counts, camera).finding
    assert finding is not None
    assert finding.code == "gain-off"
    assert 0.4 <= float(finding.values["measured"]) < 0.5005


def test_without_noise_beyond_the_light_nothing_shakes() -> None:
    rng = np.random.default_rng(3)
    camera = Camera(gain_e_per_adu=0.5, well_depth_e=1e9)
    assert measure_pattern_jitter(rng.poisson(1e4, (20, *SHAPE)), camera) is None
    assert measure_pattern_jitter(np.full((20, *SHAPE), 1000), camera) is None
    assert measure_pattern_jitter(np.zeros((20, *SHAPE)), camera) is None


@pytest.mark.parametrize("gain", [1024.0, 4.0])
def test_counts_that_are_too_coarse_are_no_wrong_gain(gain: float) -> None:
    """Of 8 bits: noise of 0.3 counts, which rounding hides, whatever gain was configured."""
    counts = (_movie(0.0) // 1024).astype(np.uint8)
    finding = diagnose_gain(counts, Camera(gain_e_per_adu=gain, well_depth_e=1e9)).finding
    if gain == 1024.0:  # which predicts the noise, with what rounding adds
        assert finding is None
        return
    assert finding is not None
    assert finding.code == "noise-rounded"


@pytest.mark.parametrize(("order", "lines"), [((1, 2, 0), "columns"), ((1, 0, 2), "rows")])
def test_axes_in_another_order_are_told(order: tuple[int, int, int], lines: str) -> None:
    counts = _movie(0.05)
    found = axes_warning("m.npy", np.transpose(counts, order))
    assert found is not None
    assert (found.code, found.where, found.values["lines"]) == ("axes-swapped", "m.npy", lines)


def test_axes_in_order_are_not_told() -> None:
    """Nor are movies without a pattern, whose columns flicker, or that are dark in part."""
    rng = np.random.default_rng(2)
    even = rng.poisson(1e4, (30, *SHAPE))
    flicker = even * (1 + 0.02 * rng.standard_normal((30, 1, SHAPE[1])))
    border = _movie(0.05)
    border[:, :10] = 0
    broken = flicker.copy()
    broken[3, 4, 5], broken[7, 8, 9] = np.inf, np.nan
    lost = np.full((30, *SHAPE), np.nan)
    dark = np.zeros((30, *SHAPE))
    for counts in (_movie(0.05), _movie(0.5), even, flicker, border, dark, broken, lost):
        assert axes_warning("m.npy", counts) is None


@pytest.mark.parametrize("mode", ["mass", "track"])
def test_frames_that_are_all_the_same_are_refused(tmp_path: Path, mode: str) -> None:
    config = make_config(
        fit={"mode": mode, "frames": None}, background={"frames": [0, 20]},
        camera={"frame_rate_hz": 100.0},
    )  # fmt: skip
    path, counts = tmp_path / "still.tif", np.full((40, 32, 32), 900, dtype=np.uint16)
    tifffile.imwrite(path, counts, photometric="minisblack")
    said = "still.tif: frames 0 to 19 are all the same; export the movie again"
    with open_stack(path) as movie, pytest.raises(DataError, match=said):
        analyse(movie, config)
