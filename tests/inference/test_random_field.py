"""Maxima of smooth noise, counted where they are known between the pixels."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import gaussian_filter, label, maximum_filter

from iscat_analysis.inference.random_field import Excursions, expected_maxima, extent
from iscat_analysis.search.peaks import summits

SIDE, FINE, LEVEL = 256, 4, 3.3
SIGMAS = 4.0
WIDTH_PX = 1.3
"""Of the filter: as rough a field, for its pixels, as those of a microscope."""

ROUGHNESS = np.eye(2) / (2 * WIDTH_PX**2)


def _filtered(noise: NDArray[np.float64], zoom: int = 1) -> NDArray[np.float64]:
    """Filter white noise to a periodic field of unit variance, and know it between its pixels."""
    k = 2 * math.pi * fft.fftfreq(SIDE)
    kernel = np.exp(-0.5 * WIDTH_PX**2 * (k[:, None] ** 2 + k[None, :] ** 2))
    spectrum = fft.fft2(noise) * kernel / math.sqrt(np.mean(kernel**2))
    wide = np.zeros((zoom * SIDE, zoom * SIDE), dtype=complex)
    first = (zoom * SIDE - SIDE) // 2
    inside = slice(first, first + SIDE)
    wide[inside, inside] = fft.fftshift(spectrum)
    return zoom**2 * np.real(fft.ifft2(fft.ifftshift(wide)))


def test_maxima_are_as_many_as_the_theory_says() -> None:
    """In 24 fields, of either sign; the level is between the pixels, 4 times as fine."""
    found = 0
    for seed in range(12):
        field = _filtered(np.random.default_rng(seed).standard_normal((SIDE, SIDE)), FINE)
        for signed in (field, -field):
            top = signed == maximum_filter(signed, 3, mode="wrap")
            # what a grid of 1/4 pixel misses on average
            height = signed * (1 + np.trace(ROUGHNESS) / (2 * 12 * FINE**2))
            found += int(np.count_nonzero(top & (height > LEVEL)))
    expected = 24 * expected_maxima(LEVEL, extent(ROUGHNESS, SIDE**2))
    assert abs(found - expected) < SIGMAS * math.sqrt(expected)


def test_what_two_searches_both_see_counts_once() -> None:
    """Stretches of the field of two searches correlated by 0.9; a control without correlation."""
    correlation, found = 0.9, 0
    rng = np.random.default_rng(5)
    for _ in range(12):
        one, other = rng.standard_normal((2, SIDE, SIDE))
        first = _filtered(one, FINE)
        second = _filtered(correlation * one + math.sqrt(1 - correlation**2) * other, FINE)
        found += label((first > LEVEL) | (second > LEVEL))[1]
    area = extent(ROUGHNESS, SIDE**2)
    each = [expected_maxima(LEVEL, area, correlation=c) for c in (0.0, correlation)]
    expected = 12 * (each[0] + each[1])  # the first by itself, and what the second adds
    assert abs(found - expected) < SIGMAS * math.sqrt(expected)
    assert abs(found - 24 * each[0]) > SIGMAS * math.sqrt(24 * each[0])


def test_a_peak_is_known_between_its_pixels() -> None:
    """To 0.3 % of its height; a parabola through three pixels misses 1 %."""
    field = gaussian_filter(np.random.default_rng(3).standard_normal((96, 96)), WIDTH_PX)
    errors, parabolas = [], []
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:21, :21]
    for _ in range(200):
        dy, dx = rng.uniform(-0.5, 0.5, 2)
        peak = np.exp(-((y - 10 - dy) ** 2 + (x - 10 - dx) ** 2) / (4 * WIDTH_PX**2))
        found_dy, found_dx, above = (
            float(v[0]) for v in summits(peak[None], np.array([[0, 10, 10]]))
        )
        errors.append(peak[10, 10] + above - 1)
        assert math.hypot(found_dy - dy, found_dx - dx) < 0.02
        rise = 0.0
        for low, mid, high in (peak[9:12, 10], peak[10, 9:12]):
            rise += (high - low) ** 2 / (8 * (2 * mid - low - high))
        parabolas.append(peak[10, 10] + rise - 1)
    assert np.abs(errors).max() < 3e-3
    assert np.abs(parabolas).max() > 1e-2
    assert summits(field[None], np.array([[0, 0, 0]]))[2][0] >= 0


@pytest.mark.parametrize("alarms", [1e-3, 0.1, 10.0])
def test_the_level_is_the_one_asked_for(alarms: float) -> None:
    area, volume = 4e3, 2e3
    for space, correlation in ((0.0, 0.0), (volume, 0.0), (0.0, 0.625)):
        u = Excursions(area, space, correlation).level(alarms)
        assert expected_maxima(u, area, space, correlation=correlation) == pytest.approx(alarms)


def test_few_places_have_the_lowest_level() -> None:
    assert Excursions(1.0).level(1.0, lowest=2.5) == 2.5
    assert Excursions(0.0).level(1.0, lowest=2.5) == 2.5
