"""Frames that were averaged or filtered in time: named, and not taken for a wrong gain."""

from __future__ import annotations

import numpy as np
import pytest
from noisy import GAIN, SIDE, speckled_counts

from iscat_analysis.camera import Camera, shared_light
from iscat_analysis.diagnosis import judge_counts

CAMERA = Camera(gain_e_per_adu=GAIN)


def _frames(kind: str, seed: int, **options: float) -> np.ndarray:
    still = [np.ones((SIDE, SIDE))] * 80
    return speckled_counts(still, 80, kind, np.random.default_rng(seed), **options).astype(float)


def test_independent_frames_have_nothing_in_common() -> None:
    for seed in range(4):
        assert shared_light(_frames("clean", seed), CAMERA) is None
    assert shared_light(_frames("excess", 4), CAMERA) is None


@pytest.mark.parametrize("pixels", [1e-3, 1e-2, 0.05])
def test_a_pattern_that_drifts_goes_on_changing(pixels: float) -> None:
    assert shared_light(_frames("drift", 5, drift_px=pixels), CAMERA) is None


@pytest.mark.parametrize("size", [1e-4, 1e-3])
def test_flicker_goes_on_growing(size: float) -> None:
    assert shared_light(_frames("flicker", 6, pink=size), CAMERA) is None


@pytest.mark.parametrize(("kept", "expected"), [(0.5, 0.5), (0.3, None)])
def test_averaged_and_recursively_filtered_frames(kept: float, expected: float | None) -> None:
    """Of a mean of two, neighbours have half; of a recursive filter about 1 − what it keeps."""
    counts = _frames("clean", 7)
    if expected is None:
        for k in range(1, len(counts)):
            counts[k] = (1 - kept) * counts[k] + kept * counts[k - 1]
    else:
        counts = (counts[1:] + counts[:-1]) / 2
    shared = shared_light(counts, CAMERA)
    assert shared == pytest.approx(expected or 1 - kept, rel=0.05)
    noise = judge_counts(counts, CAMERA)
    assert noise.spectrum is None  # of neighbours too: its threshold would let noise pass
    (found,) = noise.findings
    assert found.code == "frames-filtered"
