"""Twelve bits in the high bits of sixteen: their steps, their ceiling, a gain per their count."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import iscat_analysis as ia
from iscat_analysis.camera import Camera
from iscat_analysis.camera.counts import converter_ceiling, padded_bits
from iscat_analysis.camera.learned import learn_camera
from iscat_analysis.config import CameraConfig
from iscat_analysis.records import StackMetadata

GAIN, LEVEL_E = 8.0, 16000.0  # of the twelve bits


def _counts(frames: int = 40, level_e: float = LEVEL_E) -> NDArray[np.uint16]:
    light = np.random.default_rng(1).poisson(level_e, (frames, 48, 48))
    return np.minimum(np.round(light / GAIN), 4095).astype(np.uint16)


def test_bits_that_are_empty_are_counted() -> None:
    counts = _counts()
    assert padded_bits(counts) == 0
    assert padded_bits(counts << 4) == 4
    assert padded_bits((counts << 4).astype(np.int32)) == 4
    assert padded_bits(counts * np.uint16(10)) == 0  # as of averages; 10 is no power of two
    assert padded_bits(counts.astype(float)) == 0


def test_the_ceiling_of_twelve_bits_is_found_where_they_are_padded() -> None:
    full = _counts(4, 33000.0)  # half of the pixels above 4095
    assert converter_ceiling(full) == 4095
    assert converter_ceiling(full << 4) == 65520
    mixed = full << 4
    mixed[0, 0, 0] += 3
    assert converter_ceiling(mixed) == math.inf
    assert converter_ceiling(_counts() << 4) == math.inf


@pytest.mark.parametrize("shift", [0, 4])
def test_a_drivers_gain_is_per_count_of_the_camera(shift: int) -> None:
    """Where it stands: averages of two frames tell no gain by themselves."""
    counts = _counts() << shift
    said = StackMetadata(gain_e_per_adu=GAIN, offset_adu=0.5, source="m.json")
    movie = ia.open_stack(counts)
    learned = learn_camera(movie, CameraConfig(), (0, 1), metadata=said)  # one frame: no noise
    number = learned.numbers["gain_e_per_adu"]
    assert (number.value, number.source) == (GAIN / 2**shift, "metadata")
    assert learned.numbers["offset_adu"].value == 0.5 * 2**shift
    measured = learn_camera(movie, CameraConfig(), (0, 40), metadata=replace(said, offset_adu=None))
    gain = measured.numbers["gain_e_per_adu"]
    assert abs(gain.value - GAIN / 2**shift) < 5 * gain.se
    padding = measured.padding("m.tif")
    assert (padding is not None) == bool(shift)
    assert padding is None or padding.values == {"step": 16, "bits": 12}
    assert isinstance(measured.camera, Camera)
