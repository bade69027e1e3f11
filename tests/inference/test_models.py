"""A particle model that is defined here alone goes through fit, bound and posterior."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from iscat_analysis.bounds import event_bounds
from iscat_analysis.inference.fit import ModelFit, fit_model
from iscat_analysis.inference.laws import POISSON
from iscat_analysis.inference.likelihood import ModelLikelihood
from iscat_analysis.inference.posterior import Prior, sample_posterior
from iscat_analysis.optics.model import Parameter, Values
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.records import Box, FloatArray

GRID = PixelGrid.centred(11, 100.0)
LIGHT_E, TRIALS, SIGMAS = 1e4, 150, 4.0
TRUTH = np.array([30.0, -20.0, 0.1, 180.0, 0.0])
NAMES = ("x_nm", "y_nm", "contrast", "width_nm")
WIDTH = np.array([150.0, 150.0, 0.1, 100.0, 0.0])


@dataclass(frozen=True)
class Spot:
    """A Gaussian spot; `stretch` makes its derivative along the width wrong."""

    stretch: float = 1.0
    parameters: tuple[Parameter, ...] = (
        Parameter("x_nm", "nm", step=100.0),
        Parameter("y_nm", "nm", step=100.0),
        Parameter("contrast", growth=0.5),
        Parameter("width_nm", "nm", (1.0, 1e4), growth=0.5),
    )

    def signal(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Give the picture and its derivatives."""
        x, y, contrast, width = map(float, values)
        dx, dy = grid.x_nm[None, :] - x, grid.y_nm[:, None] - y
        unit = np.exp(-(dx**2 + dy**2) / (2 * width**2))
        along = [contrast * dx / width**2, contrast * dy / width**2, np.ones(unit.shape),
                 self.stretch * contrast * (dx**2 + dy**2) / width**3]  # fmt: skip
        return contrast * unit, np.array([unit * each for each in along])


def likelihood_of(seed: int | None, spot: Spot | None = None) -> ModelLikelihood:
    """Draw counts of a spot; the expected ones without a seed."""
    light = LIGHT_E * (1 + Spot().signal(GRID, TRUTH[:4])[0])
    counts = light if seed is None else np.random.default_rng(seed).poisson(light).astype(float)
    flat = np.full(GRID.shape, LIGHT_E)
    data = np.stack([counts, flat, flat, np.zeros(GRID.shape)])
    return ModelLikelihood(spot or Spot(), GRID, POISSON, data)


def fitted(seed: int, *, spot: Spot | None = None, width_nm: float | None = None) -> ModelFit:
    """Fit a spot, at a width that is held where one is given."""
    start = TRUTH.copy()
    start[3] = width_nm or start[3]
    free = np.array([True, True, True, width_nm is None, False])
    return fit_model(likelihood_of(seed, spot), start, Box(free, start - WIDTH, start + WIDTH))


def pulls_of(**how: object) -> FloatArray:
    """Errors of many fits over the bound, (TRIALS, 4)."""
    bounds = event_bounds(likelihood_of(None), TRUTH, NAMES)
    found = [fitted(seed, **how) for seed in range(TRIALS)]  # type: ignore[arg-type]
    assert all(each.converged for each in found)
    return np.array([(each.theta - TRUTH)[:4] for each in found]) / bounds.crb_joint


def efficient(pulls: FloatArray) -> bool:
    """Tell whether means are 0 and spreads 1, within their standard errors."""
    near = np.abs(pulls.mean(axis=0)) < SIGMAS / math.sqrt(TRIALS)
    alike = np.abs(pulls.std(axis=0, ddof=1) - 1) < SIGMAS / math.sqrt(2 * TRIALS)
    return bool(np.all(near & alike))


def test_the_bound_is_that_of_the_picture() -> None:
    bounds = event_bounds(likelihood_of(None), TRUTH, NAMES)
    light = LIGHT_E * (1 + Spot().signal(GRID, TRUTH[:4])[0])
    slopes = []
    for k, step in enumerate((1e-2, 1e-2, 1e-6, 1e-2)):
        both = [TRUTH[:4] + sign * step * np.eye(4)[k] for sign in (1, -1)]
        above, below = (Spot().signal(GRID, at)[0] for at in both)
        slopes.append(LIGHT_E * (above - below).ravel() / (2 * step))
    information = (np.array(slopes) / light.ravel()) @ np.array(slopes).T
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    assert bounds.crb_joint == pytest.approx(expected, rel=1e-6)
    assert np.isnan(bounds.qcrb).all()  # nothing is known of its light


def test_fits_reach_the_bound() -> None:
    assert efficient(pulls_of())
    assert not efficient(pulls_of(width_nm=150.0))  # control: a width that is wrong, and held


def test_a_wrong_derivative_does_not_reach_it() -> None:
    """The reported errors are then not those of the estimates, and the control of the bound."""
    right, wrong = (fitted(3, spot=Spot(stretch)).sigma[3] for stretch in (1.0, 2.0))
    truth = event_bounds(likelihood_of(None), TRUTH, NAMES).crb_joint[3]
    assert right == pytest.approx(truth, rel=0.1)
    assert wrong < 0.7 * truth


def test_the_posterior_is_as_wide_as_the_bound() -> None:
    likelihood, fit = likelihood_of(5), fitted(5)
    free = sample_posterior(likelihood, fit, steps=600, seed=1)
    assert free.converged
    assert free.names == NAMES
    spread = free.samples.reshape(-1, 4).std(axis=0)
    assert spread == pytest.approx(fit.sigma[:4], rel=0.1)
    narrow = Prior({"width_nm": (180.0, 0.5 * float(fit.sigma[3]))})
    told = sample_posterior(likelihood, fit, steps=600, seed=1, prior=narrow)
    ratio = told.samples.reshape(-1, 4).std(axis=0) / spread
    assert ratio[3] == pytest.approx(1 / math.sqrt(5), rel=0.1)  # control: it is narrower
    assert told.van_trees is not None
    assert told.van_trees[3] == pytest.approx(fit.sigma[3] / math.sqrt(5), rel=0.1)


def test_a_prior_of_the_model_is_in_its_likelihood() -> None:
    mean, sd = 170.0, 3.0
    *others, width = Spot().parameters
    known = Spot(parameters=(*others, replace(width, prior=(mean, sd))))
    free, bound = (likelihood_of(7, spot).score_fisher(TRUTH) for spot in (None, known))
    away = TRUTH[3] - mean
    assert bound[0] - free[0] == pytest.approx(-0.5 * (away / sd) ** 2)
    assert (bound[1] - free[1])[3] == pytest.approx(-away / sd**2)
    assert (bound[2] - free[2])[3, 3] == pytest.approx(sd**-2)
    assert np.isinf(likelihood_of(7).score_fisher(TRUTH * [1, 1, 1, -1, 1])[0])  # no such width
