"""Counts beyond the largest of their type, and too few of them, are named."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from wanderers import SETTINGS, wander

import iscat_analysis as ia
from iscat_analysis.camera import refuse_overflow
from iscat_analysis.errors import DataError

LANDING = {"fit.mode": "mass", "background.method": "sliding"}


@pytest.fixture(scope="module")
def counts() -> NDArray[np.uint16]:
    return wander((60, 48, 48), seed=5, species=((400.0, 0.05, 1),)).counts


@pytest.mark.parametrize("settings", [{}, LANDING], ids=["track", "landing"])
def test_a_movie_that_overflowed_is_refused_by_name(
    settings: dict[str, Any], counts: NDArray[np.uint16]
) -> None:
    overflowed = (3 * counts.astype(np.int64)).astype(np.uint16)
    with pytest.raises(
        DataError, match="counts have overflowed 16 bits: pixels leap between 0 and"
    ):
        ia.fit_movie(overflowed, settings={**SETTINGS, **settings})


def test_what_else_is_bright_and_dark_is_not_taken_for_it(counts: NDArray[np.uint16]) -> None:
    stops = 2 * counts.astype(np.int64)
    stops[:, :, :10], stops[:, :, 10:12] = 0, 65535  # a field stop beside saturated light
    blinking = np.full((20, 192, 192), 20_000, dtype=np.uint16)
    blinking[::2, 5, 6], blinking[1::2, 5, 6] = 65535, 0  # one pixel
    flashes = counts.copy()
    flashes[::2] = 65535
    flashes[1::2] = 0
    shutter = 2 * counts
    assert shutter.max() < 65535
    shutter[:20] = 3
    for right in (
        shutter,
        counts,
        stops.astype(np.uint16),
        blinking,
        flashes,
        3.0 * counts,
        counts[:1],
        counts[:0],
    ):
        refuse_overflow(right, "movie")
    with pytest.raises(DataError, match="8 bits"):
        refuse_overflow((counts // 64).astype(np.uint8), "movie")


def test_a_movie_too_dark_to_show_its_particles_says_so() -> None:
    dim = wander((40, 48, 48), seed=5, species=((400.0, 0.05, 1),), level_e=100.0, gain_e_per_adu=1)
    found = ia.fit_movie(dim.counts, settings={**SETTINGS, "camera.gain_e_per_adu": 1.0})
    assert not len(found.table)
    (said,) = (text for text in found.warnings if "no particle was found" in text)
    numbers = r"with (\d+) e per .* ratio of ([\d.]+) in a frame, and the threshold is ([\d.]+)"
    light, height, needed = map(float, re.findall(numbers, said)[0])
    assert light == pytest.approx(100, rel=0.05)
    assert height < needed
    # a peak of 0.0124 over a dozen pixels, and rings: 0.0124·√(100·12)
    assert height == pytest.approx(0.0124 * (100 * 12) ** 0.5, rel=0.5)
