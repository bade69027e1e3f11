"""Bad starts, odd particles, threads: the answer stays, and no NaN ever counts as a result."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from microscopes import setting

from iscat_analysis.fitting.events import Region
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.records import PARAMETERS, Candidate, FitResult, FloatArray, Status
from iscat_analysis.study import Setting, run_trials, trial_generator

SEED = 77
SAME = 1e-2
"""Agreement of fits from different starts, in standard deviations; the fit stops at 1e-3."""


def _data(experiment: Setting, truth: FloatArray, trial: int) -> tuple[Likelihood, Candidate]:
    random = trial_generator(SEED, 0, trial)
    likelihood = experiment.likelihood(experiment.draw(truth, random))
    pixel = experiment.context.pixel_nm
    near = Candidate(truth[0] / pixel, truth[1] / pixel, truth[2], truth[3], 0.0)
    return likelihood, near


def _fit(experiment: Setting, likelihood: Likelihood, start: Candidate) -> FitResult:
    return fit_particle(
        likelihood, start, experiment.mode, experiment.config.fit.z_range_nm, level=False
    )


@pytest.mark.parametrize("scheme", ["iscat", "cobri", "darkfield"])
@pytest.mark.parametrize("mode", ["mass", "localize", "joint"])
def test_far_starts_lead_to_the_same_estimate(scheme: str, mode: str) -> None:
    """Up to 127 nm away, a third of λ/NA; farther off a ring of the image has optima of its own."""
    experiment = setting(scheme, mode)
    free = experiment.free
    for trial in range(4):
        likelihood, near = _data(experiment, experiment.truth, trial)
        best = _fit(experiment, likelihood, near)
        for dx, dy, dz, factor in (
            (1.5, 0.0, 0.0, 1.0),
            (-1.05, 1.05, 300.0, 1.0),
            (0.0, -1.5, 300.0, 4.0),
            (1.05, 1.05, 0.0, 0.25),
        ):
            start = replace(
                near,
                x_px=near.x_px + dx,
                y_px=near.y_px + dy,
                z_nm=near.z_nm + (dz if "z_nm" in free else 0.0),
                mass_kda=near.mass_kda * (factor if "mass_kda" in free else 1.0),
            )
            found = _fit(experiment, likelihood, start)
            shift = [abs(getattr(found, n) - getattr(best, n)) for n in PARAMETERS]
            assert np.nanmax(shift / best.sigma) < SAME, (trial, dx, dy, dz, factor)
            assert found.status == best.status


@pytest.mark.parametrize("focus_nm", [-500.0, -300.0, 100.0, 400.0])
def test_contrast_of_either_sign(focus_nm: float) -> None:
    """Landing and leaving: the image of a negative mass is of the opposite sign."""
    experiment = setting("iscat", "mass", optics={"focus_nm": focus_nm}, calibration={
        "gradient_per_kda": _sign(focus_nm) * 3.1e-5})  # fmt: skip
    for sign in (1.0, -1.0):
        truth = experiment.truth * [1, 1, 1, sign]
        likelihood, near = _data(experiment, truth, 0)
        for start in (near, replace(near, mass_kda=-near.mass_kda)):
            fit = _fit(experiment, likelihood, start)
            assert fit.status == Status.OK
            assert abs(fit.mass_kda - truth[3]) < 5 * fit.sigma[3]


def _sign(focus_nm: float) -> float:
    """Sign of the peak contrast of this microscope."""
    plain = setting("iscat", "mass", optics={"focus_nm": focus_nm}, calibration=None)
    return float(np.sign(plain.context.model.peak_contrast(*(float(v) for v in plain.truth[2:]))))


@pytest.mark.parametrize("scheme", ["iscat", "cobri", "darkfield"])
@pytest.mark.parametrize("mode", ["mass", "localize", "joint"])
@pytest.mark.parametrize("mass", [0.0, 1e-3, 10.0])
def test_no_nan_is_ever_ok_for_a_particle_that_is_hardly_there(
    scheme: str, mode: str, mass: float
) -> None:
    experiment = setting(scheme, mode, photons=1000.0)
    for trial in range(8):
        truth = experiment.truth * [1, 1, 1, 0] + [0, 0, 0, mass]
        likelihood, near = _data(experiment, truth, trial)
        for start in (near, replace(near, mass_kda=1000.0)):
            _finite_if_ok(_fit(experiment, likelihood, start))


@pytest.mark.parametrize("scheme", ["iscat", "darkfield"])
@pytest.mark.parametrize("mode", ["mass", "joint"])
@pytest.mark.parametrize("corner", [(0.0, 0.0), (0.3, 8.0), (-0.4, 3.0), (-1.0, 8.0)])
def test_particles_at_the_edge_of_the_field(
    scheme: str, mode: str, corner: tuple[float, float]
) -> None:
    """The main job clips the region to the field; the particle then lies at its side."""
    whole = setting(scheme, mode)
    experiment = replace(whole, region=Region((0, 17), (0, 17)))
    pixel = experiment.context.pixel_nm
    for trial in range(4):
        truth = np.array([corner[0] * pixel, corner[1] * pixel, *experiment.truth[2:]])
        likelihood, near = _data(experiment, truth, trial)
        fit = _fit(experiment, likelihood, replace(near, x_px=near.x_px + 0.5))
        _finite_if_ok(fit)
        if corner[0] >= 0:
            assert fit.status == Status.OK
        if fit.status == Status.OK:
            error = [fit.x_nm - truth[0], fit.y_nm - truth[1]] / fit.sigma[:2]
            assert np.max(np.abs(error)) < 6


def _finite_if_ok(fit: FitResult) -> None:
    if fit.status != Status.OK:
        return
    free = [PARAMETERS.index(name) for name in fit.free]
    numbers = [fit.x_nm, fit.y_nm, fit.z_nm, fit.mass_kda, fit.contrast, fit.log_likelihood,
               fit.chi2_reduced, fit.p_value]  # fmt: skip
    assert np.all(np.isfinite(numbers))
    assert np.all(np.isfinite(fit.sigma[free]))
    assert np.all(fit.sigma[free] > 0)
    assert np.all(np.isfinite(fit.covariance))


@pytest.mark.parametrize("scheme", ["iscat", "darkfield"])
def test_threads_change_nothing(scheme: str) -> None:
    experiment = setting(scheme, "joint")
    reference = run_trials(experiment, 40, seed=SEED, workers=1)
    for workers in (2, 3, 5):
        again = run_trials(experiment, 40, seed=SEED, workers=workers)
        for item in fields(reference):
            if item.name == "seconds":
                continue
            one, two = getattr(reference, item.name), getattr(again, item.name)
            if isinstance(one, np.ndarray) and one.dtype.kind == "f":
                assert np.array_equal(one, two, equal_nan=True), item.name
            else:
                assert np.all(np.asarray(one) == np.asarray(two)), item.name
