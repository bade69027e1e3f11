"""Numbers that become indices of kernels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iscat_analysis._kernels.lattice import radial_waves, sum_waves
from iscat_analysis._kernels.loops import whole, within
from iscat_analysis._kernels.mixture import mixture_score


@pytest.mark.parametrize("x", [math.nan, math.inf, -math.inf, 1e300, -1e300, 2.0**63, -(2.0**63)])
def test_no_number_leaves_its_range(x: float) -> None:
    expected = 40 if x > 40 else -3
    assert whole(x, -3, 40) == expected
    assert within(x, -3.0, 40.0) == expected


def test_numbers_inside_are_cut_as_ever() -> None:
    for x in (-2.9, -0.5, 0.0, 0.99, 7.5, 39.999):
        assert whole(x, -3, 40) == int(x)
        assert within(x, -3.0, 40.0) == x


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1e300, 1e18])
def test_waves_are_nothing_where_no_place_is(wrong: float) -> None:
    harmonics, transverse = np.ones((1, 1, 8), complex), np.linspace(1e-3, 1e-2, 8)
    waves = radial_waves(harmonics, transverse, 10.0, 20)
    out = np.full((2, 2, waves.shape[-1]), np.nan)
    sum_waves(waves, 0.1, np.array([wrong, 5.0]), np.zeros(2), out)
    assert (out[0] == 0).all()
    assert (np.abs(out[1]) > 0).any()  # control


@pytest.mark.parametrize("wrong", [math.nan, 1e300, np.finfo(float).max, 1e-320])
@pytest.mark.parametrize("place", ["mass", "variance"])
def test_mixtures_read_no_memory_but_their_own(wrong: float, place: str) -> None:
    """The table of powers of 2 was read far beyond its end; the process then died."""
    x, noise = np.linspace(50.0, 150.0, 300), np.full(300, 64.0)
    (x if place == "mass" else noise)[::7] = wrong
    weight, mean, variance = np.array([0.5, 0.5]), np.array([80.0, 120.0]), np.array([9.0, 9.0])
    assert mixture_score(x, noise, (weight, mean, variance))[1].shape == (3, 2)
