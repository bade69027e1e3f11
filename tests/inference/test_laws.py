"""Each noise model of the registry: value, score, information and residual agree with its law."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest

from iscat_analysis._kernels.scoring import signal_value
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import choose_noise
from iscat_analysis.inference.laws import NOISE_LAWS, Poisson
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.records import FloatArray

SHAPE = (100, 100)
SIGNAL = 0.05
ERRORS = 5.0
"""Standard errors that a mean over pixels may be off."""


def _drawn(name: str, seed: int, stretch: float = 1.0) -> FloatArray:
    """Draw counts; `stretch` is the size of their noise over that of the law."""
    random = np.random.default_rng(seed)

    def counts(mean: float) -> FloatArray:
        return mean + stretch * (random.poisson(mean, SHAPE) - mean)

    if name == "conditional":
        before, after = counts(1000.0), counts(900.0 * (1 + SIGNAL))
        return np.stack([after, before + after, np.full(SHAPE, 0.9), np.ones(SHAPE)])
    if name == "poisson":
        read = 4.0
        after = counts(900.0 * (1 + SIGNAL)) + stretch * random.normal(0, np.sqrt(read), SHAPE)
        return np.stack([after + read, *(np.full(SHAPE, c) for c in (900.0, 900.0, read))])
    raise AssertionError(f"{name}: say how its counts are drawn")


def _off(values: FloatArray, expected: float) -> float:
    """Give how far a mean over pixels is from what is expected, in standard errors."""
    return float((values.mean() - expected) / (values.std(ddof=1) / np.sqrt(values.size)))


@pytest.mark.parametrize("name", NOISE_LAWS)
def test_score_has_mean_zero_and_the_variance_of_the_information(name: str) -> None:
    signal = np.full(SHAPE, SIGNAL)
    terms = NOISE_LAWS[name].terms(_drawn(name, 1), signal, 0.0)
    unit = terms.score / np.sqrt(terms.information)
    assert abs(_off(unit, 0.0)) < ERRORS
    assert abs(_off(unit**2, 1.0)) < ERRORS
    noisy = NOISE_LAWS[name].terms(_drawn(name, 1, stretch=1.2), signal, 0.0)
    assert _off(noisy.score**2 / noisy.information, 1.0) > ERRORS  # control: another noise


@pytest.mark.parametrize("name", NOISE_LAWS)
def test_residual_is_the_score_in_standard_deviations(name: str) -> None:
    model, data, signal = NOISE_LAWS[name], _drawn(name, 2), np.full(SHAPE, SIGNAL)
    terms = model.terms(data, signal, 0.01)
    residual = model.residuals(data, signal, np.exp(0.01))
    np.testing.assert_allclose(residual, terms.score / np.sqrt(terms.information), rtol=1e-9)


@pytest.mark.parametrize("name", NOISE_LAWS)
def test_the_signal_of_the_counts_is_as_exact_as_its_information(name: str) -> None:
    model, data, signal = NOISE_LAWS[name], _drawn(name, 3), np.full(SHAPE, SIGNAL)
    variance = 1 / model.signal_information(data, signal)
    spread = (model.measured_signal(data) - SIGNAL) ** 2
    assert spread.mean() == pytest.approx(variance.mean(), rel=ERRORS * np.sqrt(2 / data[0].size))


@pytest.mark.parametrize("name", NOISE_LAWS)
def test_the_level_looks_like_its_direction(name: str) -> None:
    """∂ℓ/∂g, by differences of the value, is the score of the signal that the level looks like."""
    law, data, signal = NOISE_LAWS[name], _drawn(name, 4), np.full(SHAPE, SIGNAL)
    terms, step = law.terms(data, signal, 0.0), 1e-5
    below, above = (law.terms(data, signal, g).value for g in (-step, step))
    slope = (above - below) / (2 * step)
    error = 1e-6 * np.abs(terms.score * terms.by_level).sum()
    assert slope == pytest.approx(np.sum(terms.score * terms.by_level), abs=error)


@pytest.mark.parametrize("name", NOISE_LAWS)
def test_kernels_and_arrays_have_one_likelihood(name: str) -> None:
    model, data = NOISE_LAWS[name], _drawn(name, 5)
    signal = np.random.default_rng(6).normal(0, 0.05, SHAPE)
    kernels = signal_value((model.code, data), np.exp(0.02), signal.ravel())
    assert model.terms(data, signal, 0.02).value == pytest.approx(kernels, rel=1e-9)
    brighter = model.multiplied(data, np.full(SHAPE, 1.03))
    change = model.reference_change(brighter, data)
    value = model.terms(data, np.full(SHAPE, 0.03), 0.0).value
    assert change == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize("name", NOISE_LAWS)
def test_one_more_count_does_what_the_response_says(name: str) -> None:
    """The score about the signal changes with a count before, and with one after."""
    model, data, signal = NOISE_LAWS[name], _drawn(name, 7), np.full(SHAPE, SIGNAL)
    before = np.full(SHAPE, 1000.0)
    _, after = model.count_response(data, signal, 1.0, before)
    terms = model.terms(data, signal, 0.0)
    more = data.copy()
    more[: 2 if name == "conditional" else 1] += 1
    changed = model.terms(more, signal, 0.0)
    np.testing.assert_allclose(changed.score - terms.score, after, rtol=1e-6)


def test_an_unknown_law_is_refused() -> None:
    """Neither a name nor a law that no kernel knows becomes Poisson."""
    with pytest.raises(ConfigError, match="noise = 'gamma': give one of conditional, poisson"):
        choose_noise("gamma", interferes=True, counted=True)

    class Gamma(Poisson):
        """A law with a number of its own."""

        name, code = "gamma", 7

    grid = PixelGrid.centred(5, 100.0)
    model = forward_model(Config.model_validate({"camera": {"pixel_size_nm": 100.0}}), 1000.0)
    for law, refused in ((Gamma(), True), (Poisson(), False)):  # the control: a known one
        with pytest.raises(ConfigError, match="noise = ") if refused else nullcontext():
            Likelihood(model, grid, law, np.ones((4, *grid.shape)))
