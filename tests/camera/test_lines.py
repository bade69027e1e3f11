"""Rows and columns that flicker: found, divided out, and what that does to a particle."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import PIXEL_NM, Stack, make_config

import iscat_analysis as ia
from iscat_analysis.camera import Camera, LightModel, SteadyFrames, with_lines
from iscat_analysis.fitting.context import make_context
from iscat_analysis.optics.pixels import PixelGrid

Array = NDArray[np.float64]

GAIN, OFFSET, LEVEL_E = 4.0, 100.0, 4e4
CAMERA = Camera(gain_e_per_adu=GAIN, offset_adu=OFFSET, full_scale_adu=65535.0)
SHAPE = (48, 64)


def _light() -> Array:
    rng = np.random.default_rng(2)
    return LEVEL_E * (1 + 0.1 * rng.standard_normal(SHAPE))


def _movie(
    seed: int, frames: int = 64, *, rows: float = 0.0, columns: float = 0.0, power: float = 0.0
) -> NDArray[np.uint16]:
    rng = np.random.default_rng(seed)
    light = _light() * (1 + power * rng.standard_normal((frames, 1, 1)))
    light = light * (1 + rows * rng.standard_normal((frames, SHAPE[0], 1)))
    light = light * (1 + columns * rng.standard_normal((frames, 1, SHAPE[1])))
    return np.round(rng.poisson(light) / GAIN + OFFSET).astype(np.uint16)


@pytest.mark.parametrize("kind", ["rows", "columns"])
def test_a_line_keeps_its_share_of_the_light(kind: str) -> None:
    """After the correction no line flickers, not even by its shot noise; the frames still do."""
    counts = _movie(1, **{kind: 2e-3}, power=0.02)
    lines = with_lines(counts, CAMERA)
    assert lines is not None
    share = 4e-6 * LEVEL_E / (1 + 4e-6 * LEVEL_E)
    assert lines.shares[kind == "columns"] == pytest.approx(share, rel=0.1)
    assert lines.shares[kind == "rows"] == 0
    steady = CAMERA.to_electrons(SteadyFrames(Stack(counts), lines, CAMERA).read(0, 64))
    before = CAMERA.to_electrons(counts)
    along = 2 if kind == "rows" else 1
    power = before.mean(axis=(1, 2))
    np.testing.assert_allclose(steady.mean(axis=(1, 2)), power, rtol=1e-6)
    relative = [e.mean(axis=along) / power[:, None] for e in (before, steady)]
    spread = [float(np.mean(np.std(r, axis=0) / np.mean(r, axis=0))) for r in relative]
    pixels = SHAPE[along - 1]
    assert spread[0] == pytest.approx(math.hypot(2e-3, 1 / math.sqrt(pixels * LEVEL_E)), rel=0.05)
    assert spread[1] < 1e-5


def test_lines_that_do_not_flicker_are_left_alone() -> None:
    assert all(with_lines(_movie(seed, power=0.02), CAMERA) is None for seed in range(12))


def test_saturated_and_empty_pixels_stay_what_they_are() -> None:
    counts = _movie(3, rows=3e-3)
    counts[:, 5, 6] = 65535
    counts[10] = 0
    lines = with_lines(counts[11:], CAMERA)
    assert lines is not None
    assert lines.light_e[5, 6] == 0
    steady = SteadyFrames(Stack(counts), lines, CAMERA).read(0, 64)
    assert (steady[np.arange(64) != 10, 5, 6] == 65535).all()
    assert not steady[10].any()


def test_what_is_left_of_a_particle_is_foreseen() -> None:
    """Its line is lowered by the line's mean contrast: 2λ/(π NA C a) of the height of a spot.

    That of an ideal spot; this one is cut by the height, and a third larger or smaller.
    """
    context = make_context(make_config(), SHAPE)
    grid = PixelGrid.region((0, SHAPE[0]), (0, SHAPE[1]), PIXEL_NM)
    signal = context.wide.image(grid, 30 * PIXEL_NM, 24 * PIXEL_NM, 5.0, 1000.0)
    lines = LightModel(_light(), shares=(0.3, 0.0))
    left = (1 + signal) / lines.taken(signal) - 1
    rng = np.random.default_rng(4)
    flicker = 1 + 1e-3 * rng.standard_normal((2, SHAPE[0], 1))
    frames = flicker * _light() * np.stack([np.ones(SHAPE), 1 + signal])
    before, after = (f / f.sum() for f in frames / lines.factors(frames))
    gained = np.average(1 + signal, weights=_light())
    np.testing.assert_allclose(after / before * gained - 1, left, atol=1e-6)
    peak = np.unravel_index(int(np.abs(signal).argmax()), SHAPE)
    optics = context.model.optics
    spot = 2 * optics.wavelength_nm / (math.pi * optics.na * SHAPE[1] * PIXEL_NM)
    taken = 1 - left[peak] / signal[peak]
    weight = _light()[peak[0]]
    mean = float(np.sum(weight * signal[peak[0]]) / weight.sum())
    whole = float(np.sum(_light() * signal) / _light().sum())
    expected = (mean - whole) * (1 + signal[peak]) / signal[peak]
    assert taken == pytest.approx(expected, rel=0.01)
    assert mean / signal[peak] == pytest.approx(spot, rel=0.35)


def test_lines_are_found_as_often_by_chance_as_the_normal_law_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At 2 standard errors, where it can be counted; 4.5 of them are used."""
    monkeypatch.setattr("iscat_analysis.camera.noise.LEAST_SIGMAS", 2.0)
    trials, found = 400, 0
    rng = np.random.default_rng(6)
    for _ in range(trials):
        counts = rng.normal(LEVEL_E, math.sqrt(LEVEL_E), (16, 24, 24))
        lines = with_lines(counts, Camera())
        found += 0 if lines is None else np.count_nonzero(lines.shares)
    expected = 2 * trials * 0.02275
    assert abs(found - expected) < 4 * math.sqrt(expected)


def test_the_user_is_told_and_a_clean_movie_is_not_touched() -> None:
    config = make_config(background={"frames": [0, 32]}, fit={"frames": [32, 64]})
    settings = {
        "camera.gain_e_per_adu": GAIN, "camera.offset_adu": OFFSET, "optics.calibrate": "never",
    }  # fmt: skip
    flickering = ia.fit_movie(_movie(7, rows=3e-3), config=config, settings=settings)
    assert flickering.summary["lines"]["row_share"] > 0.1
    assert flickering.summary["lines"]["column_share"] == 0
    assert any("whole rows flicker" in text for text in flickering.warnings)
    assert not any("assume independent pixels" in text for text in flickering.warnings)
    clean = ia.fit_movie(_movie(8), config=config, settings=settings)
    assert "lines" not in clean.summary
    off = settings | {"background.power_normalization": False}
    without = ia.fit_movie(_movie(7, rows=3e-3), config=config, settings=off)
    assert "lines" not in without.summary
    assert any("assume independent pixels" in text for text in without.warnings)
