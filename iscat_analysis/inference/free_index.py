"""Diameter and refractive index of a sphere from one picture.

A small sphere scatters with d³ (n − n_s), and its picture tells that product and neither factor.  A
larger one changes its picture in another way with d than with n.  What a picture tells is in the
information about ln d and ln (n − n_s), with the place eliminated: the eigenvector (q, 1) of its
larger eigenvalue is the combination d^q (n − n_s).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from iscat_analysis.inference.common_size import UNDETERMINED, CommonSize, fit_common_size, slopes
from iscat_analysis.inference.fit import AMPLITUDE, fit_particle
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.sizes import OTHER_SIZE, SURE_ODDS
from iscat_analysis.optics.sized import SizedModel
from iscat_analysis.records import Candidate, FitResult, FloatArray, Status, verdict

INDEX = 5
"""Place of the index behind θ."""

_SAME_LIKELIHOOD = 0.5  # by which a fit may end below the one that it began from


class IndexFit(NamedTuple):
    """A sphere whose index was fitted as well, and what its picture tells."""

    likelihood: Likelihood
    fit: FitResult
    power: float
    """q of d^q (n − n_s)."""

    sigma: float
    """Relative standard error of that."""

    @property
    def is_told(self) -> bool:
        """Whether the picture tells diameter and index apart."""
        return math.isfinite(self.fit.sigma_index)


def fit_index(likelihood: Likelihood, fit: FitResult, z_range_nm: tuple[float, float]) -> IndexFit:
    """Fit the index as well, from every likely diameter; the fit stays where that tells nothing."""
    model = _model_of(likelihood)
    found = _maxima(likelihood, model, fit, z_range_nm)
    before = _covariance(likelihood, fit)
    if found:
        best, *others = found
        own, again, covariance = _refitted(likelihood, model, fit, best, z_range_nm)
        if _is_told(likelihood, own, fit, again, (before, covariance)):
            again = _with_errors(again, covariance, others)
            return IndexFit(own, again, *_combination(own, again, covariance))
    return IndexFit(likelihood, fit, *_combination(likelihood, fit, before))


def _model_of(likelihood: Likelihood) -> SizedModel:
    """Give the model of a sphere's likelihood."""
    if not isinstance(likelihood.model, SizedModel):
        raise TypeError(f"{type(likelihood.model).__name__} has no index")
    return likelihood.model


def _refitted(
    likelihood: Likelihood,
    model: SizedModel,
    fit: FitResult,
    best: CommonSize,
    z_range_nm: tuple[float, float],
) -> tuple[Likelihood, FitResult, FloatArray]:
    """Fit the sphere again with the index that was found, and give the covariance with the index.

    Shapes: covariance (6, 6), of θ and the index.
    """
    own = replace(likelihood, model=model.of_index(best.index - float(best.bias[1])))
    pixel = likelihood.grid.pixel_nm
    x, y, z, *_ = best.places[0].tolist()
    start = Candidate(x / pixel, y / pixel, z, best.mass_kda, fit.snr)
    again = fit_particle(own, start, "size", z_range_nm, level=bool(fit.box.free[LEVEL]))
    again = again.shifted(fit.x_nm - float(fit.estimate[0]), fit.y_nm - float(fit.estimate[1]))
    return own, again, _covariance(own, again)


def _is_told(
    likelihood: Likelihood,
    own: Likelihood,
    fit: FitResult,
    again: FitResult,
    covariances: Sequence[FloatArray],
) -> bool:
    """Tell whether the index is known to better than half of its contrast.

    A picture that tells little lets the index go anywhere, to where its error, by the curvature, is
    small.  So its error where the fit began counts as well; and on the way from there the logarithm
    of the likelihood rose by g, so that the error is no less than that way over √(2 g).
    """
    model = _model_of(own)
    index, known = model.sphere.index.real, _model_of(likelihood).sphere.index.real
    gain = again.log_likelihood - fit.log_likelihood
    if Status.AT_BOUND in again.flags or gain < -_SAME_LIKELIHOOD:
        return False
    errors = [math.sqrt(covariance[INDEX, INDEX]) for covariance in covariances]
    errors.append(abs(index - known) / math.sqrt(max(2 * gain, 1.0)))
    return max(errors) < UNDETERMINED * abs(index - model.optics.n_sample)


def _with_errors(fit: FitResult, covariance: FloatArray, others: Sequence[CommonSize]) -> FitResult:
    """Give a fit the errors with the index free, and a flag for another likely diameter."""
    errors = np.sqrt(np.diag(covariance))
    apart = OTHER_SIZE * errors[AMPLITUDE]
    flags = list(fit.flags)
    if any(abs(other.mass_kda - fit.mass_kda) > apart for other in others):
        flags.append(Status.AMBIGUOUS_SIZE)
    status, noticed = verdict(flags)
    return replace(
        fit, sigma=errors[:4], sigma_index=float(errors[INDEX]), status=status, flags=noticed
    )


def _maxima(
    likelihood: Likelihood, model: SizedModel, fit: FitResult, z_range_nm: tuple[float, float]
) -> list[CommonSize]:
    """Find the maxima of the likelihood in place, diameter and index that are likely, best first.

    They begin at the diameters and heights that are likely at the configured index.
    """
    x, y, z, mass, level = fit.theta.tolist()
    levels = [level] if fit.box.free[LEVEL] else []
    starts = [(z, mass), *((other.z_nm, other.mass_kda) for other in fit.alternatives)]
    tried = [
        fit_common_size(
            [likelihood], model, np.array([[x, y, height, *levels]]), z_range_nm,
            mass_kda=size, index=model.sphere.index.real,
        )
        for height, size in starts
    ]  # fmt: skip
    found = sorted(
        (one for one in tried if one is not None and one.converged),
        key=lambda one: -one.log_likelihood,
    )
    least = found[0].log_likelihood - math.log(SURE_ODDS) if found else math.inf
    return [one for one in found if one.log_likelihood > least]


def _combination(
    likelihood: Likelihood, fit: FitResult, covariance: FloatArray
) -> tuple[float, float]:
    """Give q of the combination d^q (n − n_s) that is told best, and its relative error.

    Shapes: `covariance` (6, 6).
    """
    model = _model_of(likelihood)
    both = np.ix_([AMPLITUDE, INDEX], [AMPLITUDE, INDEX])
    scale = np.array([3 * fit.mass_kda, model.sphere.index.real - model.optics.n_sample])
    relative = covariance[both] / np.outer(scale, scale)
    along = np.linalg.eigh(relative)[1][:, 0]
    told = along / along[1]
    return float(told[0]), math.sqrt(max(float(told @ relative @ told), 0.0))


def _covariance(likelihood: Likelihood, fit: FitResult) -> FloatArray:
    """Give the inverse of the expected information; 0 for a height that is at an end of its range.

    Shapes: result (6, 6), of θ and the index.
    """
    model = _model_of(likelihood)
    common = np.array([fit.theta[AMPLITUDE], model.sphere.index.real])
    signal, rows = slopes(likelihood, model, fit.theta[:3], common)
    fisher = likelihood.score_of_signal(signal, rows, float(fit.theta[LEVEL]))[2]
    free = np.append(fit.box.free, True)
    free[2] &= fit.box.lower[2] < fit.theta[2] < fit.box.upper[2]
    inside, scale = np.ix_(free, free), np.sqrt(np.diag(fisher))
    unit = np.outer(scale, scale)
    inverse = np.linalg.pinv(fisher[inside] / unit[inside], hermitian=True)
    covariance = np.zeros(fisher.shape)
    covariance[inside] = inverse / unit[inside]
    return covariance
