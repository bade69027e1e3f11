"""Contrasts need a zero of the light: counts that have lost it are refused, raw ones are not."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from iscat_analysis.camera import LearnedCamera, with_camera
from iscat_analysis.camera.learned import learn_camera
from iscat_analysis.config import CameraConfig, parse_config
from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack

Counts = NDArray[np.float64]

FRAMES, SIDE = 300, 64
GAIN = 4.0  # photoelectrons per count
LEVEL_E = 1e5


@cache
def _raw(
    *, speckle: float = 0.1, flicker: float = 0.01, seed: int = 1, dip: float = 0.01
) -> Counts:
    """Make counts of a landing movie: light, flicker, shot noise, and a few particles that land."""
    random = np.random.default_rng(seed)
    rough = random.standard_normal((SIDE, SIDE))
    light = LEVEL_E * (1 + speckle * rough)
    power = 1 + flicker * random.standard_normal(FRAMES)
    light = np.maximum(light, 0.2 * LEVEL_E) * power[:, None, None]
    y, x = np.indices((SIDE, SIDE))
    for k in range(6):
        spot = np.exp(-((y - 10 * k - 5) ** 2 + (x - 9 * k - 8) ** 2) / 4)
        light[40 * (k + 1) :] *= 1 - dip * spot
    return np.rint(random.poisson(light) / GAIN)


def _learned(counts: Counts, **camera: float) -> LearnedCamera:
    movie = open_stack(counts)
    return learn_camera(movie, CameraConfig(**camera), (0, len(counts)))


def _scaled(ratio: Counts, low: float, high: float, top: int = 65535) -> Counts:
    return np.clip(np.rint((ratio - low) / (high - low) * top), 0, top)


def _drifting(counts: Counts) -> Counts:
    walk = np.cumsum(np.random.default_rng(5).standard_normal(len(counts))) * 2e-4
    return counts / counts.mean(axis=0) * (1 + walk - walk.mean())[:, None, None]


LOST: dict[str, Callable[[Counts], Counts]] = {
    "0.9 to 1.1 in 16 bits": lambda a: _scaled(a / a.mean(0), 0.9, 1.1),
    "0.95 to 1.05 in 16 bits": lambda a: _scaled(a / a.mean(0), 0.95, 1.05),
    "0.9 to 1.1 in 8 bits": lambda a: _scaled(a / a.mean(0), 0.9, 1.1, 255),
    "over the first frames": lambda a: _scaled(a / a[:50].mean(0), 0.9, 1.1),
    "with wandering light": lambda a: _scaled(_drifting(a), 0.9, 1.1),
    "background taken off": lambda a: np.rint(a - a.mean(0) + 32768),
    "per cent": lambda a: np.rint((a / a.mean(0) - 1) * 1e4),
}


@pytest.mark.parametrize("flicker", [0.01, 0.0])
@pytest.mark.parametrize("done", LOST)
def test_counts_without_a_zero_are_refused(done: str, flicker: float) -> None:
    """Of the first, all particles were ok at 9.8 times their mass, with 2.5 % stated."""
    counts = LOST[done](_raw(flicker=flicker))
    found = _learned(counts)
    assert "do not tell where the light is zero" in found.refusal
    assert "raw counts" in found.refusal
    assert "camera.offset_adu" in found.refusal
    assert not _learned(counts, offset_adu=-1000.0, gain_e_per_adu=0.03).refusal


@pytest.mark.parametrize("flicker", [0.01, 0.0])
def test_the_ratio_of_an_even_field_is_refused_too(flicker: float) -> None:
    raw = _raw(speckle=0.0, flicker=flicker)
    assert _learned(_scaled(raw / raw.mean(0), 0.9, 1.1)).refusal
    assert not _learned(raw).refusal


@pytest.mark.parametrize(("flicker", "dip"), [(0.02, 0.01), (0.001, 0.11), (0.0, 0.01)])
@pytest.mark.parametrize(("speckle", "seed"), [(0.0, 0), (0.001, 1), (0.02, 2), (0.3, 3)])
def test_raw_counts_are_not(speckle: float, seed: int, flicker: float, dip: float) -> None:
    raw = _raw(speckle=speckle, flicker=flicker, seed=seed, dip=dip)
    for offset in (0.0, 100.0):
        assert not _learned(raw + offset).refusal


def test_light_that_flickers_tells_the_zero_of_an_even_field() -> None:
    """Its error is in the budget: pixels alone told it to 40 % of the light or not at all."""
    shares, errors = [], []
    for seed in range(4):
        raw = _raw(speckle=0.0, flicker=0.02, seed=seed)
        found = _learned(raw)
        number = found.numbers["offset_adu"]
        assert number.source == "assumed"
        shares.append(number.se * GAIN / LEVEL_E)
        assert found.summary["light_adu"] == pytest.approx(LEVEL_E / GAIN, rel=0.02)
        # a ratio that begins at zero has its zero, and the same error of it
        ratio = _learned(_scaled(raw / raw.mean(0), 0.0, 2.0))
        assert not ratio.refusal
        errors.append(ratio.numbers["offset_adu"].se / (65535 / 2))
    assert 0.03 < np.median(shares) < 0.3
    assert 0.03 < np.median(errors) < 0.3


def test_counts_that_were_subtracted_are_refused_with_their_number() -> None:
    raw = _raw()
    least = 0.5 * float(raw.min())
    found = _learned(raw - np.rint(least))
    assert "counts were subtracted" in found.refusal
    told = float(found.refusal.rpartition("camera.offset_adu = ")[2])
    assert found.camera.law is not None
    error = found.camera.law.contrast_se * (LEVEL_E / GAIN - least)
    assert abs(told + np.rint(least)) < 4 * error < 0.1 * LEVEL_E / GAIN
    again = _learned(raw - np.rint(least), offset_adu=told)
    assert not again.refusal
    assert again.numbers["gain_e_per_adu"].value == pytest.approx(GAIN, rel=0.1)


def test_the_movie_is_named() -> None:
    raw = _raw()
    movie = open_stack(_scaled(raw / raw.mean(0), 0.9, 1.1))
    config = parse_config({"camera": {"pixel_size_nm": 84.0}})
    with pytest.raises(DataError, match=f"{movie.name}: its counts do not tell"):
        with_camera(movie, config, (0, FRAMES))
