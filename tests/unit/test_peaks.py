"""Maxima of a stack of fields."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import maximum_filter

from iscat_analysis.search.peaks import maxima


@pytest.mark.parametrize("reach", [(1, 2, 2), (0, 1, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_maxima_are_what_a_filter_of_the_neighbourhood_leaves(reach, dtype):
    fields = np.random.default_rng(5).standard_normal((7, 30, 41)).astype(dtype)
    fields[2, 3:5, 7] = 9.0  # two neighbours of the same height
    fields[0, 0, 0] = fields[-1, -1, -1] = 8.0
    size = tuple(2 * n + 1 for n in reach)
    expected = np.argwhere((fields == maximum_filter(fields, size)) & (fields > 1.0))
    found = maxima(fields, 1.0, reach)
    assert np.array_equal(found, expected)
    assert len(found) > 20
    assert {(2, 3, 7), (2, 4, 7), (0, 0, 0), (6, 29, 40)} <= set(map(tuple, found.tolist()))


def test_nothing_stands_out_of_what_is_level():
    assert maxima(np.ones((3, 4, 5)), 1.0, (1, 1, 1)).shape == (0, 3)
    assert len(maxima(np.ones((3, 4, 5)), 0.5, (1, 1, 1))) == 60
