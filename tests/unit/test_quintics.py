"""Quintics in vector registers against their sums of powers."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis._kernels.quintics import DISTANCE, evaluate, evaluate_slopes, padded

ROUNDING = 1e-13


@pytest.mark.parametrize("pixels", [1, 8, 13, 256])
@pytest.mark.parametrize("channels", [4, 8, 12])
def test_channels_and_slopes(pixels: int, channels: int) -> None:
    rng = np.random.default_rng(pixels)
    profile = rng.normal(size=(30, 6, channels))
    f = np.full((20, padded(pixels)), np.nan)
    distances = rng.uniform(0, 30, padded(pixels))
    distances[0] = 0.0
    f[DISTANCE] = distances
    powers = (distances % 1) ** np.arange(6)[:, None]
    slopes = np.arange(6)[:, None] * (distances % 1) ** np.maximum(np.arange(6) - 1, 0)[:, None]
    coefficients = profile[distances.astype(int)]
    want = np.einsum("jpc,pj->cj", coefficients, powers)
    evaluate(profile, f)
    np.testing.assert_allclose(f[:4], want[:4], rtol=ROUNDING, atol=ROUNDING)
    assert np.isnan(f[4:8]).all()
    assert np.array_equal(f[DISTANCE], distances)
    if channels == 4:
        return
    evaluate_slopes(profile, f)
    np.testing.assert_allclose(f[:8], want[:8], rtol=ROUNDING, atol=ROUNDING)
    want = np.einsum("jpc,pj->cj", coefficients, slopes)
    np.testing.assert_allclose(f[8:12], want[:4], rtol=ROUNDING, atol=ROUNDING)
    assert np.isnan(f[DISTANCE + 1 :]).all()
