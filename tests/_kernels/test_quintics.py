"""Quintics in vector registers against their sums of powers."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis._kernels.radial_rows import (
    DISTANCE,
    evaluate,
    evaluate_bends,
    evaluate_last_slopes,
    evaluate_slopes,
    padded,
)

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


@pytest.mark.parametrize("channels", [4, 12])
def test_second_derivatives(channels: int) -> None:
    rng = np.random.default_rng(channels)
    profile = rng.normal(size=(30, 6, channels))
    f = np.full((20, padded(40)), np.nan)
    distances = rng.uniform(0, 30, padded(40))
    f[DISTANCE] = distances
    k, t = np.arange(6)[:, None], distances % 1
    powers, slopes = t**k, k * t ** np.maximum(k - 1, 0)
    bends = k * (k - 1) * t ** np.maximum(k - 2, 0)
    coefficients = profile[distances.astype(int)]
    value, slope, bend = (
        np.einsum("jpc,pj->cj", coefficients, factor) for factor in (powers, slopes, bends)
    )
    evaluate_bends(profile, f)
    want = np.concatenate([value[:4], slope[:4], bend[:4]])
    np.testing.assert_allclose(f[:12], want, rtol=10 * ROUNDING, atol=10 * ROUNDING)
    assert np.array_equal(f[DISTANCE], distances)
    if channels == 12:
        evaluate_last_slopes(profile, f)
        want = np.concatenate([value[4:], slope[4:8]])
        np.testing.assert_allclose(f[:12], want, rtol=ROUNDING, atol=ROUNDING)
    assert np.isnan(f[DISTANCE + 1 :]).all()
