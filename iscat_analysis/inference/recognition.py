"""Whether a particle that was fitted as a dipole is a sphere that stands on the coverslip.

A dipole does not describe a large particle: its centre is higher than that of a protein, and light
from its parts interferes.  A fit that is poor, or so bright that a compact protein of its mass
would be no dipole, is therefore repeated with spheres of several materials.  Beside the place they
have one parameter, as the dipole has, or two where the refractive index is fitted; a dipole at
another height has two as well.  In the Bayesian information criterion each costs half the logarithm
of the number of pixels (G. Schwarz, Ann. Statist. 6, 461, 1978).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from iscat_analysis.inference.fit import (
    AMPLITUDE,
    POOR_FIT_P,
    candidate_at,
    fit_particle,
    search_box,
)
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.maximiser import Optimum, covariance_of
from iscat_analysis.inference.models import SphereOfIndex, SphereOfLight
from iscat_analysis.inference.sizes import (
    AMBIGUITY_ODDS,
    OTHER_SIZE,
    OTHER_SIZE_SHARE,
    highest_maxima,
    scanned_masses,
)
from iscat_analysis.optics.sized import SeatedModel, largest_dipole_nm
from iscat_analysis.records import Alternative, Box, FitResult, FloatArray, Status, verdict
from iscat_analysis.units import sphere_diameter_nm


class _Sphere(NamedTuple):
    """A sphere at a maximum of its likelihood, with the information in its parameters."""

    likelihood: Likelihood
    optimum: Optimum
    information: FloatArray
    criterion: float = 0.0

    @property
    def mass_kda(self) -> float:
        """Its mass."""
        return float(self.optimum.theta[AMPLITUDE])

    def is_like(self, other: _Sphere) -> bool:
        """Whether both have the same size within their errors, or nearly so."""
        apart = abs(self.mass_kda - other.mass_kda)
        error = math.hypot(self._sigma_kda, other._sigma_kda)
        return apart < max(OTHER_SIZE_SHARE * self.mass_kda, OTHER_SIZE * error)

    @property
    def _sigma_kda(self) -> float:
        """Standard error of the mass."""
        free = np.arange(len(self.information)) != 2  # the gap is held
        return math.sqrt(max(float(covariance_of(self.information, free)[3, 3]), 0.0))


def may_be_large(likelihood: Likelihood, fit: FitResult) -> bool:
    """Tell whether a dipole misses as much as of a sphere, or is too heavy to be a dipole."""
    missed = (fit.chi2_reduced - 1) * likelihood.n_pixels
    # Share of the light of a sphere of 30 nm and more that a dipole does not describe
    if Status.POOR_FIT in fit.flags and missed > 0.05 * fit.snr**2:
        return True
    model = likelihood.model
    diameter = sphere_diameter_nm(abs(fit.mass_kda), model.material.density_kg_m3)
    return diameter > largest_dipole_nm(model.optics)


def recognised(
    likelihood: Likelihood,
    fit: FitResult,
    spheres: Sequence[SeatedModel],
    z_range_nm: tuple[float, float],
    *,
    level: bool,
) -> tuple[Likelihood, FitResult] | None:
    """Fit the sphere that describes a particle better than any dipole; None if there is none."""
    each = math.log(likelihood.n_pixels) / 2
    least = fit.log_likelihood + math.log(AMBIGUITY_ODDS)
    found: list[_Sphere] = []
    begin = _centred(likelihood, fit.theta)
    for model in spheres:
        seated = replace(likelihood, model=model, prior=None)
        cost = each if model.fits_index else 0.0
        for one in _maxima(seated, begin, least=least + cost, level=level):
            found.append(one._replace(criterion=one.optimum.log_likelihood - cost))
            least = max(least, found[-1].criterion - math.log(AMBIGUITY_ODDS))
    if not found:
        return None
    found.sort(key=lambda one: -one.criterion)
    best = found[0]
    seated, again = fit_seated(best.likelihood, best.optimum.theta, level=level)
    excess, left = (max(one.chi2_reduced - 1, 0.0) for one in (fit, again))
    # Share of the dipole's excess of χ² that a sphere may have if it does not describe all
    if again.p_value < POOR_FIT_P and left > 0.1 * excess:
        return None
    start = candidate_at(likelihood, begin, fit.snr)
    lifted = fit_particle(replace(likelihood, prior=None), start, "joint", z_range_nm, level=level)
    if lifted.log_likelihood - each > best.criterion:
        return None
    others = tuple(
        Alternative(0.0, best.criterion - other.criterion, other.mass_kda)
        for other in found[1:]
        if not best.is_like(other)
    )
    flags = list(again.flags)
    if others and others[0].log_likelihood_gap < math.log(AMBIGUITY_ODDS):
        flags.append(Status.AMBIGUOUS_SIZE)
    status, noticed = verdict(flags)
    shift = fit.x_nm - float(fit.estimate[0]), fit.y_nm - float(fit.estimate[1])
    whole = replace(again, alternatives=others, status=status, flags=noticed)
    return seated, whole.shifted(*shift)


def refitted(
    likelihood: Likelihood, sphere: SeatedModel, fit: FitResult, *, level: bool
) -> tuple[Likelihood, FitResult]:
    """Fit a sphere that was recognised to counts of which its neighbours have changed."""
    own = replace(likelihood, model=sphere, prior=None)
    seated, again = fit_seated(own, fit.theta, level=level)
    kept = [flag for flag in fit.flags if flag == Status.AMBIGUOUS_SIZE]
    status, noticed = verdict([*again.flags, *kept])
    return seated, replace(again, alternatives=fit.alternatives, status=status, flags=noticed)


def fit_seated(
    seated: Likelihood, theta: FloatArray, *, level: bool
) -> tuple[Likelihood, FitResult]:
    """Fit a sphere from a start near its maximum, and its index where that is free."""
    information: FloatArray | None = None
    if model_of(seated).fits_index:
        found = _with_index(seated, theta, -math.inf, level=level)
        seated, theta, information = found.likelihood, found.optimum.theta, found.information
    start, heights = candidate_at(seated, theta), seated.model.z_range_nm
    fit = fit_particle(seated, start, "mass", heights, level=level)
    flags = [*fit.flags, Status.LARGE]
    if information is not None:  # which depends on the error of the index as well
        free = np.insert(fit.box.free, LEVEL, True)
        *sigma, of_index, _ = np.sqrt(np.diag(covariance_of(information, free)))
        fit = replace(fit, sigma=np.array(sigma), sigma_index=float(of_index))
        low, high = model_of(seated).indices
        index = model_of(seated).sphere.index.real
        if min(index - low, high - index) < 1e-6:
            flags.append(Status.AT_BOUND)
    status, noticed = verdict(flags)
    return seated, replace(fit, status=status, flags=noticed)


def model_of(seated: Likelihood) -> SeatedModel:
    """Give the model of a sphere's likelihood."""
    if not isinstance(seated.model, SeatedModel):
        raise TypeError(f"{type(seated.model).__name__} is no SeatedModel")
    return seated.model


def _centred(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Move θ to the centre of the image's energy, if the dipole lies on a part of a ring."""
    signal = np.nan_to_num(likelihood.measured_signal())
    energy = np.maximum(signal**2 * likelihood.signal_information() - 1, 0.0)
    grid = likelihood.grid
    x, y = float(theta[0]), float(theta[1])
    # around an image's centre, which each improves
    for reach in (900.0, 700.0, 600.0, 500.0):
        near = (grid.y_nm[:, None] - y) ** 2 + (grid.x_nm - x) ** 2 < reach**2
        weight = np.where(near, energy, 0.0)
        if not weight.any():
            return theta
        x, y = (
            float(np.average(axis, weights=weight.sum(over)))
            for axis, over in ((grid.x_nm, 0), (grid.y_nm, 1))
        )
    moved = theta.copy()
    moved[:2] = x, y
    # nearer to the centre a dipole is in the middle
    beside = math.hypot(x - theta[0], y - theta[1]) > 100.0
    return moved if beside and _is_in_reach(likelihood, moved) else theta


def _is_in_reach(likelihood: Likelihood, theta: FloatArray) -> bool:
    """Tell whether the model is known for all places that a fit from a start may reach."""
    box = search_box(likelihood, theta, "mass", likelihood.model.z_range_nm)
    corners = product(*zip(box.lower[:2], box.upper[:2], strict=True))
    return bool(likelihood.supports(np.array([[*at, *theta[2:]] for at in corners])).all())


def _maxima(seated: Likelihood, theta: FloatArray, *, least: float, level: bool) -> list[_Sphere]:
    """Maximise the likelihood of a sphere from the best diameters of a scan.

    Where the index is fitted, the light of a sphere is scanned too.  A sphere of the scan that
    describes the image worse than no particle does is no start.  Maxima below `least` are left out.
    """
    model = model_of(seated)
    x, y, g = float(theta[0]), float(theta[1]), float(theta[LEVEL])
    masses = scanned_masses(model, *model.mass_range_kda)
    # light per volume of a sphere whose index is fitted
    strengths = np.geomspace(0.007, 0.25, 10) if model.fits_index else np.ones(1)
    own = model.strength_of(model.sphere.index.real) if model.fits_index else 1.0
    values = np.empty((masses.size, strengths.size))
    for i, mass in enumerate(masses.tolist()):
        linear = model.scanned(mass)
        for j, strength in enumerate(strengths.tolist()):
            signal = linear.amplitude_image(seated.grid, x, y, 0.0, strength / own * mass)
            values[i, j] = seated.noise.terms(seated.data, signal, g).value
    optima: list[_Sphere] = []
    # maxima of the likelihood over the diameter, of each material
    for i, j in highest_maxima(values, 3):
        if values[i, j] <= 0:
            break
        begin = np.array([x, y, 0.0, masses[i], g])
        if model.fits_index:
            there = replace(seated, model=model.of_strength(float(strengths[j])))
            found = _with_index(there, begin, least, level=level)
        else:
            box = search_box(seated, begin, "mass", model.z_range_nm, level=level)
            end = seated.maximize(np.clip(begin, box.lower, box.upper), box, least=least)
            found = _Sphere(seated, end, end.fisher)
        if found.optimum.converged and found.optimum.log_likelihood > least:
            optima.append(found)
    return optima


def _with_index(seated: Likelihood, theta: FloatArray, least: float, *, level: bool) -> _Sphere:
    """Maximise over the index too."""
    model = model_of(seated)
    box = search_box(seated, theta, "mass", model.z_range_nm, level=level)
    spheres = SphereOfLight(model)
    light = float(theta[AMPLITUDE]) * model.strength_of(model.sphere.index.real)
    wider = zip((box.free, box.lower, box.upper), (True, 0.0, np.inf), strict=True)
    box = Box(*(np.insert(each, LEVEL, of_light) for each, of_light in wider))
    begin = np.clip(np.insert(theta, LEVEL, light), box.lower, box.upper)
    end = seated.under(spheres).maximize(begin, box, least=least)
    found = spheres.with_index(end.theta)
    of_index = seated.under(SphereOfIndex(model))
    information = of_index.score_fisher(np.append(found, end.theta[-1]))[2]
    own = np.delete(np.arange(6), LEVEL)
    return _Sphere(
        replace(seated, model=model.of_index(float(found[LEVEL]))),
        replace(end, theta=np.delete(end.theta, LEVEL), fisher=information[np.ix_(own, own)]),
        information,
    )
