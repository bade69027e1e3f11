"""The first-order bias of maximum likelihood, which faint particles show."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.records import FitResult


def unbiased(likelihood: Likelihood, fit: FitResult) -> FitResult:
    """Take the first-order bias of maximum likelihood off the mass.

    A position that is fitted follows the noise to where it adds to the particle, so that the
    amplitude comes out too large by 1/SNR²: 1 % at 10.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    fit : FitResult
        Its estimate.

    Returns
    -------
    FitResult
        With mass and contrast corrected; `theta` stays where the likelihood has its maximum.

    Notes
    -----
    M. J. Box, J. R. Stat. Soc. B 33, 171 (1971): −½ F⁻¹ Σ w g tr(F⁻¹ H), g and H the gradient and
    the second derivatives of the expectation, here of ln(1 + C) plus the level.
    """
    if "mass_kda" not in fit.free or not np.all(np.isfinite(fit.covariance)):
        return fit
    theta, model = fit.theta, likelihood.model
    signal, first, second = model.amplitude_hessian(likelihood.grid, *(float(t) for t in theta[:4]))
    index = [i for i in range(5) if fit.box.free[i]]
    bright = 1 + signal
    gradient = np.ones((5, *signal.shape))
    gradient[:4] = first / bright
    hessian = np.zeros((5, 5, *signal.shape))
    hessian[:4, :4] = second / bright - gradient[:4, None] * gradient[None, :4]
    weight = likelihood.signal_information(signal) * bright**2
    gradient = gradient[index].reshape(len(index), -1)
    bend = hessian[np.ix_(index, index)].reshape(len(index), len(index), -1)
    fisher = (gradient * weight.ravel()) @ gradient.T
    unit = 1 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    inverse = np.linalg.pinv(fisher * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit)
    traces = np.einsum("ij,ijp->p", inverse, bend)
    bias = -0.5 * inverse @ (gradient @ (weight.ravel() * traces))
    shift = float(bias[index.index(3)]) * model.scale.slope(float(theta[3]))
    sigma = float(fit.sigma[3])
    if not math.isfinite(shift) or abs(shift) > sigma:
        return fit
    mass = fit.mass_kda - shift
    return replace(fit, mass_kda=mass, contrast=model.peak_contrast(fit.z_nm, mass))
