"""A model that does not describe the data is noticed, and good data are left in peace."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from microscopes import PHOTONS, configuration, setting
from scipy.stats import binom, kstest, poisson

from iscat_analysis.inference.fit import POOR_FIT_P, fit_particle, three_tests
from iscat_analysis.inference.laws import attainable_tails
from iscat_analysis.records import FitResult, FloatArray, Status
from iscat_analysis.study import Setting, make_setting, run_trials, trial_generator

SEED = 61
FEW, TRIALS = 160, 400
MISFITS = 20
SURPRISE = 1e-4
"""Probability below which a count of flags disagrees with the nominal rate."""


def _fit(experiment: Setting, frame: FloatArray, trial: int, gain: float = 1.0) -> FitResult:
    random = trial_generator(SEED, 1, trial)
    likelihood = experiment.likelihood(experiment.windows(frame, random, gain=gain))
    start = experiment.start(experiment.truth, random)
    return fit_particle(
        likelihood, start, experiment.mode, experiment.config.fit.z_range_nm, level=False
    )


def _good_frame(experiment: Setting) -> FloatArray:
    return experiment.level_e() + experiment.signal_e(experiment.truth)


def _seen_through(experiment: Setting, **optics: float) -> FloatArray:
    """Return the frame of the same particle in the same light through other optics."""
    at = experiment.config.bounds
    other = make_setting(
        configuration(
            optics={"focus_nm": -500.0, **optics},
            bounds={"photons_per_pixel": at.photons_per_pixel},
        ),
        experiment.mode,
        z_nm=float(experiment.truth[2]),
    )
    return experiment.level_e() + other.signal_e(experiment.truth)


@pytest.mark.parametrize("mode", ["mass", "joint"])
@pytest.mark.parametrize("scheme", ["iscat", "cobri", "darkfield"])
def test_good_data_are_flagged_as_often_as_stated(
    scheme: str, mode: str, repetitions: Callable[[int, int], int]
) -> None:
    count = repetitions(FEW, TRIALS)
    trials = run_trials(setting(scheme, mode), count, seed=SEED)
    for rate in (POOR_FIT_P, 0.01, 0.1):
        flags = int(np.sum(trials.p_value < rate))
        assert binom.sf(flags - 1, count, rate) > SURPRISE, (rate, flags)
        assert binom.cdf(flags, count, rate) > SURPRISE, (rate, flags)
    assert np.array_equal(trials.flagged(Status.POOR_FIT), trials.p_value < POOR_FIT_P)


def test_each_test_is_uniform_on_good_data() -> None:
    experiment = setting("iscat", "joint")
    found = []
    for trial in range(TRIALS):
        random = trial_generator(SEED, 2, trial)
        likelihood = experiment.likelihood(experiment.draw(experiment.truth, random))
        start = experiment.start(experiment.truth, random)
        fit = fit_particle(likelihood, start, "joint", (0.0, 1000.0), level=False)
        at = likelihood, fit.theta
        found.append(three_tests(*at, fit.box.free)[1])
    for column in np.transpose(found):
        assert kstest(column, "uniform").pvalue > SURPRISE


def test_the_least_likely_of_few_counts_is_judged_exactly() -> None:
    """What a pixel can attain below a tail, against the sum over every count."""
    means = np.array([1e-4, 0.02, 0.1, 0.2, 0.7, 3.0, 12.0, 40.0, 300.0])
    counts = np.arange(900.0)[:, None]
    above, below = poisson.sf(counts - 1, means), poisson.cdf(counts, means)
    tails = np.minimum(1.0, 2 * np.minimum(above, below))
    for tail in (0.5, 1e-2, 1.1e-5, 1e-7, 3e-11):
        exact = np.sum(poisson.pmf(counts, means) * (tails <= tail), axis=0)
        np.testing.assert_allclose(attainable_tails(means, tail), exact, rtol=1e-6, atol=1e-16)


@pytest.mark.parametrize("mode", ["mass", "joint"])
@pytest.mark.parametrize(
    "optics",
    [{"focus_nm": -420.0}, {"focus_nm": -580.0}, {"na": 1.25}, {"na": 1.5}],
    ids=lambda optics: "-".join(f"{k}={v:g}" for k, v in optics.items()),
)
def test_wrong_optics(optics: dict[str, float], mode: str) -> None:
    """With half more light than elsewhere: what is fine in an image is fainter in its pixels."""
    experiment = setting("iscat", mode, photons=1.5 * PHOTONS)
    _noticed(experiment, lambda e: _seen_through(e, **optics))


@pytest.mark.parametrize("mode", ["mass", "joint"])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_second_particle_300_nm_away(share: float, mode: str) -> None:
    def frame(experiment: Setting) -> FloatArray:
        other = experiment.truth + np.array([300.0, 0.0, 0.0, 0.0])
        other[3] *= share
        return _good_frame(experiment) + experiment.signal_e(other)

    _noticed(setting("iscat", mode), frame)


def test_dead_pixel() -> None:
    def frame(experiment: Setting) -> FloatArray:
        out = _good_frame(experiment)
        out[12, 20] *= 0.96  # far from dead, in one pixel of a thousand
        return out

    _noticed(setting("iscat", "joint"), frame)


def test_saturation() -> None:
    def frame(experiment: Setting) -> FloatArray:
        out = _good_frame(experiment)
        return np.minimum(out, experiment.level_e() + 0.3 * (out - experiment.level_e()).max())

    _noticed(setting("iscat", "joint"), frame)


@pytest.mark.parametrize("gain", [0.7, 1.4])
def test_wrong_gain(gain: float) -> None:
    experiment = setting("iscat", "joint")
    for trial in range(MISFITS):
        fit = _fit(experiment, _good_frame(experiment), trial, gain)
        assert Status.POOR_FIT in fit.flags


def test_modes_are_tested_only_outside_the_fitted_directions() -> None:
    """A shift of the particle is no misfit where x is free, and is one where it is not."""
    experiment = setting("iscat", "joint")
    likelihood = experiment.likelihood(experiment.draw(experiment.truth, None))
    theta = np.array([*experiment.truth[:3], 0.0, 0.0])
    theta[3] = likelihood.model.scale.amplitude(experiment.truth[3])
    crb = experiment.bounds.crb_joint
    moved = theta + np.array([15 * crb[0], 0, 0, 0, 0])
    free = np.array([True, True, True, True, False])
    assert three_tests(likelihood, moved, free)[1][1] > 0.9
    assert three_tests(likelihood, moved, free & [False, True, True, True, True])[1][1] < 1e-6
    assert three_tests(likelihood, theta, free)[1][1] == pytest.approx(1.0)


def _noticed(experiment: Setting, frame) -> None:  # type: ignore[no-untyped-def]
    """Every fit is flagged, and its p-value is below that of the same noise on the true model."""
    good, bad = _good_frame(experiment), frame(experiment)
    for trial in range(MISFITS):
        fit = _fit(experiment, bad, trial)
        assert fit.p_value < _fit(experiment, good, trial).p_value
        assert Status.POOR_FIT in fit.flags, (trial, fit.p_value)
