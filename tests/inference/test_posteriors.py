"""Posteriors are right: calibrated, as wide as the bound, skewed or bimodal where that is so."""

from __future__ import annotations

import math

import numpy as np
import pytest
from microscopes import setting
from scipy.stats import skew

from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.posterior import Prior, sample_posterior
from iscat_analysis.records import FloatArray, PosteriorResult
from iscat_analysis.study import PosteriorRanks, Setting, calibrate_posterior, trial_generator

pytestmark = pytest.mark.large

SEED = 12
DRAWS = 40
BINS = 5
PRIOR_TRIALS = 80
SURPRISE = 1e-4
SMALL = {"roi_nm": 1350.0}


def _calibrated(gain: float) -> PosteriorRanks:
    experiment = setting("iscat", "joint", fit=SMALL)
    width = np.array([100.0, 100.0, 12.0, 0.0])
    lower, upper = experiment.truth - width, experiment.truth + width
    lower[3], upper[3] = 500.0, 2000.0
    return calibrate_posterior(
        experiment, DRAWS, lower=lower, upper=upper, seed=SEED, workers=2, gain=gain
    )


def test_ranks_are_uniform_and_widths_are_the_bound() -> None:
    found = _calibrated(1.0)
    assert found.refused < DRAWS / 5
    assert min(found.p_values(BINS).values()) > SURPRISE
    widths = found.width_over_crb[found.kept]
    error = widths.std(axis=0) / math.sqrt(len(widths))
    # the flat prior on z ends within a few σ of some particles, which narrows those posteriors
    assert np.all(np.abs(np.median(widths, axis=0) - 1) < 4 * error + 0.02)


def test_ranks_reveal_a_wrong_likelihood() -> None:
    """With counts scaled to a tenth, noise is overstated and truths crowd the middle ranks."""
    found = _calibrated(0.1)
    assert min(found.p_values(BINS).values()) < SURPRISE


def _sampled(experiment: Setting, truth: FloatArray, trial: int) -> tuple[PosteriorResult, object]:
    random = trial_generator(SEED, 3, trial)
    likelihood = experiment.likelihood(experiment.draw(truth, random))
    start = experiment.start(truth, random)
    fit = fit_particle(
        likelihood, start, experiment.mode, experiment.config.fit.z_range_nm, level=False
    )
    return sample_posterior(likelihood, fit, walkers=32, steps=1000, seed=trial), fit


def test_a_mass_near_zero_is_skewed_against_its_bound() -> None:
    """Where z is free the amplitude keeps its sign, and a faint particle's mass piles up at 0."""
    experiment = setting("iscat", "joint", fit={**SMALL, "z_range_nm": [0.0, 150.0]}, z_nm=60.0)
    truth = experiment.truth * [1, 1, 1, 0] + [0, 0, 0, experiment.bounds.crb_joint[3]]
    posterior, fit = _sampled(experiment, truth, 1)
    mass = posterior.samples[..., posterior.names.index("mass_kda")].ravel()
    assert np.all(mass >= 0)
    assert skew(mass) > 0.3
    bright, _ = _sampled(experiment, experiment.truth, 1)
    assert bright.converged, bright.message
    assert abs(skew(bright.samples[..., 3].ravel())) < 0.2
    del fit


def _against_van_trees(experiment: Setting, width: float, believed: float) -> FloatArray:
    """Errors of the sampled posterior's mean over its bound, masses drawn from a normal prior."""
    found = []
    for trial in range(PRIOR_TRIALS):
        random = trial_generator(SEED, 5, trial)
        truth = np.array(experiment.truth)
        truth[3] += width * random.standard_normal()
        likelihood = experiment.likelihood(experiment.draw(truth, random))
        fit = fit_particle(
            likelihood, experiment.start(truth, random), experiment.mode,
            experiment.config.fit.z_range_nm, level=False,
        )  # fmt: skip
        prior = Prior({"mass_kda": (experiment.truth[3] + believed, width)})
        chain = sample_posterior(likelihood, fit, walkers=32, steps=250, seed=trial, prior=prior)
        assert chain.van_trees is not None
        mean = chain.samples[..., chain.names.index("mass_kda")].mean()
        found.append((mean - truth[3]) / chain.van_trees[chain.names.index("mass_kda")])
    return np.array(found)


def test_the_sampled_posterior_reaches_van_trees_and_a_wrong_prior_does_not() -> None:
    experiment = setting("iscat", "mass", fit=SMALL)
    crb = experiment.bounds.crb_joint[3]
    width = 0.5 * crb
    error = 1 / math.sqrt(2 * PRIOR_TRIALS)  # of the logarithm of a root mean square
    right = math.log(np.sqrt(np.mean(_against_van_trees(experiment, width, 0.0) ** 2)))
    assert abs(right) < 4 * error
    # without the prior the error would be the Cramér–Rao bound: √5 of this one
    assert math.log(math.sqrt(5)) > 4 * error
    wrong = math.log(np.sqrt(np.mean(_against_van_trees(experiment, width, 3 * width) ** 2)))
    assert wrong > 4 * error
