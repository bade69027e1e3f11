"""Medians without a look for what is no number."""

import numpy as np
import pytest
from scipy.ndimage import median_filter

from iscat_analysis.medians import median_3x3, middle


@pytest.mark.parametrize("n", [1, 2, 7, 500])
def test_they_are_those_of_numpy(n: int) -> None:
    values = np.random.default_rng(n).normal(size=(3, 5, n)).astype(np.float32)
    expected = np.median(values, axis=-1)
    found = middle(values)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, expected)


def test_the_median_of_nine_is_that_of_scipy() -> None:
    rng = np.random.default_rng(4)
    for shape in ((1, 1), (2, 5), (31, 64)):
        image = rng.normal(size=shape).round(1)  # some are equal
        assert np.array_equal(median_3x3(image), median_filter(image, size=3))
        if image.size > 1:  # the control: other edges are noticed
            assert not np.array_equal(median_3x3(image), median_filter(image, 3, mode="wrap"))
