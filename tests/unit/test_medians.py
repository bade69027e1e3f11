"""Medians without a look for what is no number."""

import numpy as np
import pytest

from iscat_analysis.medians import middle


@pytest.mark.parametrize("n", [1, 2, 7, 500])
def test_they_are_those_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).normal(size=(3, 5, n)).astype(np.float32)
    expected = np.median(values, axis=-1)
    found = middle(values)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)
