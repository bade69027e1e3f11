"""Errors of places that the curvature of the likelihood does not tell."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from microscopes import setting
from scenes import observed_information

from iscat_analysis.inference.fit import AWAY, fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.records import FitResult
from iscat_analysis.study import Setting, run_trials, trial_generator

STANDARD_ERRORS = 4.0
FAR = 5.0


def _trial(experiment: Setting, number: int) -> tuple[Likelihood, FitResult]:
    random = trial_generator(2021, 11, number)
    likelihood = experiment.likelihood(experiment.draw(experiment.truth, random))
    fit = fit_particle(
        likelihood, experiment.start(experiment.truth, random), experiment.mode,
        experiment.config.fit.z_range_nm, level=experiment.level,
    )  # fmt: skip
    return likelihood, fit


@pytest.mark.parametrize(("mode", "photons"), [("mass", 100.0), ("mass", 300.0), ("joint", 300.0)])
def test_places_of_few_photons_are_as_uncertain_as_stated(
    mode: str, photons: float, repetitions: Callable[[int, int], int]
) -> None:
    """By the curvature the spread along y is 1.25 to 1.5 errors, and one fit 6 of them off."""
    experiment = setting("darkfield", mode, photons=photons, z_nm=200.0)
    found = run_trials(experiment, repetitions(160, 400), seed=2021, stream=11)
    pulls = ((found.estimate - found.truth) / found.sigma)[found.unflagged]
    for k in range(2):
        spread = float(np.sqrt(np.mean(pulls[:, k] ** 2)))
        assert abs(spread - 1) < STANDARD_ERRORS / math.sqrt(2 * len(pulls))
        assert np.max(np.abs(pulls[:, k])) < FAR


def test_many_photons_leave_errors_to_the_curvature() -> None:
    points = {"samples_per_pixel": 1}  # their table along z is right to 1e-9
    experiment = setting("iscat", "joint", photons=3000.0, z_nm=200.0, camera=points)
    likelihood, fit = _trial(experiment, 0)
    free = np.flatnonzero(fit.box.free)
    observed = observed_information(likelihood, fit.theta)[np.ix_(free, free)]
    np.testing.assert_allclose(
        fit.sigma[:3], np.sqrt(np.diag(np.linalg.inv(observed)))[:3], rtol=1e-9
    )


def test_no_place_three_errors_away_is_more_likely_than_the_estimate() -> None:
    """In these trials the search alone ended on the lower of two maxima of the likelihood."""
    experiment = setting("darkfield", "mass", photons=100.0, z_nm=200.0)
    for number in range(60):
        likelihood, fit = _trial(experiment, number)
        if fit.flags:
            continue
        around = np.tile(fit.theta, (4, 1))
        for row, (k, side) in enumerate([(0, -1), (0, 1), (1, -1), (1, 1)]):
            around[row, k] += side * AWAY * fit.sigma[k]
        inside = np.clip(around, fit.box.lower, fit.box.upper)
        assert np.all(likelihood.values(inside) <= fit.log_likelihood + 1e-6)


def test_covariance_and_errors_agree() -> None:
    experiment = setting("darkfield", "joint", photons=100.0, z_nm=200.0)
    wide = [fit for _, fit in (_trial(experiment, n) for n in range(20)) if not fit.flags]
    for fit in wide:
        np.testing.assert_allclose(
            np.sqrt(np.diag(fit.covariance)), fit.sigma[np.isfinite(fit.sigma)], rtol=1e-9
        )
        assert np.all(np.linalg.eigvalsh(fit.covariance) > 0)
