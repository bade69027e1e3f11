"""The noise at every spatial frequency: what is measured, and what the search makes of it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import make_config
from scipy.ndimage import convolve1d

import iscat_analysis as ia
from iscat_analysis.camera import Camera, NoiseSpectrum, measure_spectrum
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.events import search_likelihood
from iscat_analysis.records import Windows
from iscat_analysis.search.templates import find_particles, signal_to_noise

Array = NDArray[np.float64]

SIDE, FRAMES, LEVEL_E, GAIN = 64, 128, 1e4, 4.0
CAMERA = Camera(gain_e_per_adu=GAIN)
LAGGED, LEAKY = (0.0, 0.75, 0.25), (0.1, 0.8, 0.1)


def _light() -> Array:
    """Draw a field that is brighter in the middle, with speckle."""
    rng = np.random.default_rng(9)
    y, x = np.mgrid[:SIDE, :SIDE] / SIDE - 0.5
    return LEVEL_E * np.exp(-(x**2 + y**2)) * (1 + 0.1 * rng.standard_normal((SIDE, SIDE)))


def _movie(
    seed: int, *, x: tuple[float, ...] = (1.0,), y: tuple[float, ...] = (1.0,), rows: float = 0.0,
    read_noise_e: float = 0.0, frames: int = FRAMES,
) -> Array:  # fmt: skip
    """Draw counts whose noise leaks into neighbours along x and y, and whose rows flicker."""
    rng = np.random.default_rng(seed)
    light = np.broadcast_to(_light(), (frames, SIDE, SIDE))
    noise = rng.poisson(light) - light
    noise = convolve1d(convolve1d(noise, x, axis=2), y, axis=1)
    noise = noise + read_noise_e * rng.standard_normal(light.shape)
    flicker = 1 + rows * rng.standard_normal((frames, SIDE, 1))
    return np.round((light + noise) * flicker / GAIN)


def _measured(**noise: Any) -> NoiseSpectrum:
    found = measure_spectrum(_movie(1, **noise), CAMERA)
    assert found is not None
    return found


def test_shot_noise_is_as_expected() -> None:
    assert all(measure_spectrum(_movie(seed), CAMERA) is None for seed in range(12))


def test_the_correlation_of_neighbours_is_measured() -> None:
    """Of noise a + b of the neighbour: variance a² + b², covariance ab, and all of it 1."""
    found = _measured(x=LAGGED)
    error = 5 / math.sqrt(SIDE**2 * FRAMES / 2)
    a, b = LAGGED[1:]
    assert found.variance == pytest.approx(a**2 + b**2, abs=error)
    assert found.neighbours[0] == pytest.approx(a * b / (a**2 + b**2), abs=error)
    assert abs(found.neighbours[1]) < error
    assert found.summed[0] == pytest.approx(1.0, abs=5 * found.summed[1])
    assert found.finding is not None
    assert "in x" in found.finding.text
    assert found.shared == (0, 0)


def test_rows_that_flicker_are_measured() -> None:
    """Their share is N σ²/(1 + N σ²), N the mean photoelectrons of a pixel."""
    sigma = 2e-3
    found = _measured(rows=sigma)
    added = sigma**2 * _light().mean()
    assert found.shared[0] == pytest.approx(added / (1 + added), rel=0.05)
    assert found.shared[1] == 0
    assert found.variance == pytest.approx(1 + added, rel=0.01)
    assert found.finding is not None
    assert "whole rows flicker" in found.finding.text
    assert "correlated" not in found.finding.text


def test_noise_of_another_size_needs_no_line() -> None:
    found = _measured(read_noise_e=50.0)
    assert found.variance == pytest.approx(1 + 50.0**2 / _light().mean(), rel=0.02)
    assert found.finding is None
    np.testing.assert_allclose(found.power, found.variance, rtol=1e-12)


@pytest.mark.parametrize("why", ["few frames", "small", "dark", "saturated"])
def test_where_nothing_can_be_told_nothing_is(why: str) -> None:
    counts = _movie(1, x=LAGGED)
    if why == "few frames":
        counts = counts[:7]
    elif why == "small":
        counts = counts[:, :20]
    elif why == "dark":
        counts = np.round(counts / 1e4)
    else:
        counts = np.minimum(counts, 0.8 * counts.max()).astype(np.uint16)
        counts[:, : 2 * SIDE // 3] = 65535
    assert measure_spectrum(counts, CAMERA) is None


def test_particles_that_do_not_move_are_no_noise() -> None:
    counts = _movie(3)
    counts[:, 30:34, 30:34] *= 1.2
    assert measure_spectrum(counts, CAMERA) is None


# ---- what the search makes of it -------------------------------------------------------------


def _of_unit_variance(kernel: tuple[float, ...]) -> tuple[float, ...]:
    """Give the kernel of a camera whose gain was measured without regard to correlations."""
    return tuple(np.array(kernel) / np.linalg.norm(kernel))


COLOURED: dict[str, dict[str, Any]] = {
    "lagged": {"x": _of_unit_variance(LAGGED)},
    "leaky": {"x": _of_unit_variance(LEAKY), "y": _of_unit_variance(LEAKY)},
    "rows": {"rows": 4e-3},
    "read": {"read_noise_e": 60.0},
}
FIELDS, SIGMAS = 40, 4.0
ONE = {"false_alarms_per_movie": 1.0}


def _windows(counts: Array) -> Windows:
    """Sum the first half of a movie, and the other."""
    electrons, half = GAIN * counts, len(counts) // 2
    nothing = np.zeros((SIDE, SIDE), dtype=bool)
    return Windows(
        before_e=electrons[:half].sum(0), after_e=electrons[half:].sum(0), n_before=half,
        n_after=half, power_ratio=electrons[half:].sum() / electrons[:half].sum(),
        read_variance_before_e2=np.zeros((SIDE, SIDE)),
        read_variance_after_e2=np.zeros((SIDE, SIDE)), masked=nothing, saturated=nothing,
        frames_before=(0, half), frames_after=(half, 2 * half), power=np.ones(2 * half),
    )  # fmt: skip


@pytest.fixture(scope="module", params=sorted(COLOURED))
def searched(request: pytest.FixtureRequest) -> tuple[Array, int, int]:
    """SNR maps of 40 blank fields, false alarms in them, and those of a filter that knows less."""
    config = make_config(detection=ONE)
    noise = _measured(**COLOURED[request.param])
    white = make_context(config, (SIDE, SIDE))
    context = make_context(config, (SIDE, SIDE), noise=noise)
    maps, alarms = [], [0, 0]
    for seed in range(FIELDS):
        windows = _windows(_movie(100 + seed, frames=8, **COLOURED[request.param]))
        likelihood = search_likelihood(context, windows, np.zeros((SIDE, SIDE)))
        maps.append(signal_to_noise(likelihood, context.templates)[0][0])
        for kind, one in enumerate((context, white)):
            found = find_particles(
                likelihood, one.templates, config.detection, roi_px=context.roi_px
            )
            alarms[kind] += len(found)
    return np.array(maps), alarms[0], alarms[1]


def _assert_as_asked(alarms: int) -> None:
    """No more than asked for, and no fewer than half, as in white noise."""
    assert 0.5 * FIELDS - SIGMAS * math.sqrt(0.5 * FIELDS) < alarms
    assert alarms < FIELDS + SIGMAS * math.sqrt(FIELDS)


def test_whitened_noise_has_unit_variance(searched: tuple[Array, int, int]) -> None:
    maps = searched[0]
    assert maps.std() == pytest.approx(1.0, abs=0.03)
    assert maps[:, :4].std() == pytest.approx(1.0, abs=0.06)
    assert maps[:, :, :4].std() == pytest.approx(1.0, abs=0.06)


def test_false_alarms_are_as_many_as_asked(searched: tuple[Array, int, int]) -> None:
    _assert_as_asked(searched[1])


def test_a_filter_for_white_noise_is_wrong_there(searched: tuple[Array, int, int]) -> None:
    """Control: the same fields, searched as if their noise were shot noise."""
    with pytest.raises(AssertionError):
        _assert_as_asked(searched[2])


def test_a_template_larger_than_the_field_is_cut() -> None:
    noise = _measured(x=LAGGED)
    small = replace(noise, shape=(SIDE, SIDE), information=np.ones((SIDE, SIDE // 2 + 1)))
    template = np.random.default_rng(1).standard_normal((SIDE + 1, SIDE + 1))
    dual = small.dual(template)
    inside = np.s_[:SIDE, :SIDE]
    np.testing.assert_allclose(dual[inside], template[inside], atol=1e-12)
    assert not dual[SIDE].any()


# ---- what the user is told -------------------------------------------------------------------


_KNOWN = {
    "camera.gain_e_per_adu": GAIN, "camera.read_noise_e": 0.0, "optics.calibrate": "never",
}  # fmt: skip


@pytest.mark.parametrize("method", ["fixed", "sliding"])
def test_the_user_is_told(method: str) -> None:
    counts = _movie(5, x=LEAKY, y=LEAKY, frames=160).astype(np.uint16)
    config = make_config(background={"frames": None, "method": method}, fit={"frames": None})
    if method == "fixed":
        config = make_config(background={"frames": [0, 80]}, fit={"frames": [80, 160]})
    result = ia.fit_movie(counts, config=config, settings=_KNOWN)
    about = result.summary["background" if method == "fixed" else "landing"]["noise_spectrum"]
    assert about["neighbour_correlation"] == pytest.approx([0.24, 0.24], abs=0.02)
    assert any("neighbouring pixels is correlated" in text for text in result.warnings)
    # a pixel that leaks has 0.44 of the variance of its light, and the gain is right all the same
    assert about["variance_over_shot"] == pytest.approx(0.436, rel=0.03)
    assert not any("set camera.gain" in text for text in result.warnings)
