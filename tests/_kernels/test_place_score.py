"""Score, information and likelihood of a frame's square in one pass, against those of an image."""

from __future__ import annotations

import numpy as np
import pytest

from iscat_analysis._kernels.lattice import DEGREE, TAPS
from iscat_analysis._kernels.lens import RoundLens, StampLens
from iscat_analysis._kernels.moving import place_score
from iscat_analysis._kernels.noise import POISSON
from iscat_analysis._kernels.scoring import image_score

ROUNDING = 1e-11  # of sums over pixels in another order
ALONG_Z = RoundLens(0.1, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0)
ONE_HEIGHT = StampLens(0.1, 40, np.zeros((DEGREE + 1, TAPS)), 2)


@pytest.mark.parametrize("with_z", [False, True])
@pytest.mark.parametrize("contrast", [0.01, 0.6], ids=["faint", "beyond the series"])
@pytest.mark.parametrize("read_e2", [0.0, 900.0])
def test_one_pass_says_what_three_say(with_z, contrast, read_e2):
    rng = np.random.default_rng(3)
    side = 13
    here = rng.uniform(-contrast, contrast, (side, 5, side))
    here[:, 3] *= with_z
    light = rng.uniform(3e3, 5e3, (side, side))
    read = np.full_like(light, read_e2)
    seen = rng.poisson(light * (1 + here[:, 0])) + read
    data = np.stack([seen, light * (1 + rng.uniform(0, 0.02, light.shape)), light, read])
    data[:, 4, 2:5] = 0.0  # pixels that are not used

    score, fisher = np.full(5, np.nan), np.full((5, 5), np.nan)
    lens = ALONG_Z if with_z else ONE_HEIGHT
    value = place_score(data, here, lens, score, fisher)

    wanted_score, wanted = np.empty(5), np.empty((5, 5))
    wanted_value = image_score((POISSON, data), 1.0, here, (wanted_score, wanted))
    wanted_score[4] = wanted[4] = wanted[:, 4] = 0.0
    scale = np.sqrt(np.diag(wanted))
    assert value == pytest.approx(wanted_value, rel=ROUNDING)
    np.testing.assert_allclose(score, wanted_score, rtol=0, atol=ROUNDING * scale.max() * side)
    np.testing.assert_allclose(fisher, wanted, rtol=0, atol=ROUNDING * np.abs(wanted).max())
    assert np.isfinite(value)
    assert fisher[2, 2] > 0 if with_z else not fisher[2].any()


def test_gradients_in_single_precision_lose_only_their_own_rounding():
    rng = np.random.default_rng(4)
    here = rng.uniform(-0.01, 0.01, (11, 5, 9)).astype(np.float32)
    light = rng.uniform(3e3, 5e3, (11, 9))
    data = np.stack([rng.poisson(light).astype(float), light, light, np.zeros_like(light)])
    found = [(np.empty(5), np.empty((5, 5))) for _ in range(2)]
    values = [
        place_score(data, signal, ONE_HEIGHT, *into)
        for signal, into in zip((here, here.astype(float)), found, strict=True)
    ]
    assert values[0] == pytest.approx(values[1], rel=ROUNDING)
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-9)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("level_e", [4e3, 4e5, 4e7])
def test_single_precision_is_enough_for_a_fit(level_e):
    rng = np.random.default_rng(5)
    side = 32
    here = rng.uniform(-1.0, 1.0, (side, 5, side)) * 3 / np.sqrt(level_e)
    light = rng.uniform(0.7, 1.3, (side, side)) * level_e
    seen = rng.poisson(light * (1 + here[:, 0]))
    data = np.stack([seen, light, light, np.full_like(light, 30.0)]).astype(np.float32)
    data[0] += data[3]
    here = here.astype(np.float32)

    score, fisher = np.empty(5), np.empty((5, 5))
    value = place_score(data, here, ONE_HEIGHT, score, fisher)

    exact_score, exact = np.empty(5), np.empty((5, 5))
    wide = data.astype(float), here.astype(float), ONE_HEIGHT, exact_score, exact
    exact_value = place_score(*wide)
    free = [0, 1, 3]
    sigma = np.sqrt(np.diag(exact)[free])
    off = np.abs(score - exact_score)[free] / sigma  # standard deviations of the estimates
    rounding = side**2 * float(np.finfo(np.float32).eps)  # at worst, of sums of so many terms
    assert off.max() < rounding * np.sqrt(np.abs(exact_value))
    assert value == pytest.approx(exact_value, abs=rounding * side**2)
    np.testing.assert_allclose(fisher, exact, rtol=0, atol=rounding * np.abs(exact).max())
