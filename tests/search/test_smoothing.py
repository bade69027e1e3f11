"""Smoothing by cosines, beside sums over the spot."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from iscat_analysis.search.bright import smoothed, spot_response


@pytest.mark.parametrize("shape", [(40, 40), (31, 57), (9, 16)])
@pytest.mark.parametrize("sigma_px", [0.5, 1.3, 4.6])
def test_smoothing_is_that_of_sums_over_the_spot(shape: tuple[int, int], sigma_px: float) -> None:
    """Up to the border, where the image is mirrored, and where the spot is wider than the image."""
    image = np.random.default_rng(3).standard_normal(shape)
    image[0, 0], image[-1, shape[1] // 2] = 50.0, -80.0
    expected = gaussian_filter(image, sigma_px)
    found = smoothed(image, spot_response(shape, sigma_px))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.abs(gaussian_filter(image, 1.1 * sigma_px) - expected).max() > 1e-3  # the control


def test_single_precision_stays_what_it_is() -> None:
    image = np.random.default_rng(4).standard_normal((64, 48)).astype(np.float32)
    response = spot_response(image.shape, 1.2) - spot_response(image.shape, 4.8)
    found = smoothed(image, response)
    assert found.dtype == np.float32
    expected = gaussian_filter(image, 1.2) - gaussian_filter(image, 4.8)
    np.testing.assert_allclose(found, expected, atol=2e-6)
