"""Candidates, fits and posteriors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from iscat_analysis.records.arrays import BoolArray, FloatArray
from iscat_analysis.records.verdicts import Status


@dataclass(frozen=True)
class Candidate:
    """A place where the search finds a possible particle.

    Attributes
    ----------
    x_px, y_px : float
        Sub-pixel position; integer = pixel centre, y down the rows.
    z_nm : float
        Height of the template that matched best [nm].
    mass_kda : float
        Linear estimate of the mass [kDa]; negative where the contrast has the other sign.
    snr : float
        Matched-filter signal over its noise.
    beside : float
        Largest ratio at other places with the same distance from a known particle.
    """

    x_px: float
    y_px: float
    z_nm: float
    mass_kda: float
    snr: float
    beside: float = 0.0


@dataclass(frozen=True)
class Alternative:
    """Another height that a fit converged to.

    Attributes
    ----------
    z_nm : float
        The height [nm].
    log_likelihood_gap : float
        Log-likelihood of the best height minus that of this one, ≥ 0.
    mass_kda : float
        The mass [kDa]: in mode size, another diameter may have another mass.
    """

    z_nm: float
    log_likelihood_gap: float
    mass_kda: float = math.nan


@dataclass(frozen=True)
class Box:
    """Bounds of θ = (x, y, z, amplitude, level) and which of them are free.

    Attributes
    ----------
    free : ndarray of bool, shape (5,)
        Free parameters.
    lower, upper : ndarray, shape (5,)
        Bounds [nm, amplitude, 1].
    """

    free: BoolArray
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True)
class FitResult:
    """One maximum-likelihood fit.

    Attributes
    ----------
    x_nm, y_nm, z_nm, mass_kda : float
        Estimate in the full frame [nm, kDa]; a parameter that was not free holds its fixed value.
    theta : ndarray, shape (5,)
        Maximum of the likelihood, in the parameters of the likelihood.
    estimate : ndarray, shape (5,)
        The maximum minus the bias of order 1/N; the estimates above are computed from it.
    box : Box
        Bounds of the search.
    free : tuple of str
        Names of the free parameters, a subset of `PARAMETERS` in that order.
    sigma : ndarray, shape (4,)
        Standard deviations from the observed information, in the order of `PARAMETERS`;
        NaN where not free.  With few photons, those of positions follow from the likelihood three
        errors away, if this is larger; see `iscat_analysis.inference.fit.reach`.
    covariance : ndarray, shape (n_free, n_free)
        Inverse observed information, with these standard deviations.
    contrast : float
        Signed peak contrast of the model over the plane, at the estimate.
    log_likelihood : float
        At its maximum, without terms that do not depend on the parameters.
    snr : float
        √(2 Δℓ) against no particle; a free level is fitted in both.
    iterations : int
        Scoring steps taken by the best start.
    chi2_reduced, p_value : float
        Goodness of fit of the fitted pixels.
    status : Status
        The verdict.
    flags : tuple of Status
        All flags, worst first, including the status unless it is ok.
    alternatives : tuple of Alternative
        Other heights, best first.
    sigma_index : float
        Standard deviation of the refractive index of a sphere, where it was fitted.
    size_probability : float
        Posterior probability of the diameter among all that were found; NaN where it is not free.
    """

    x_nm: float
    y_nm: float
    z_nm: float
    mass_kda: float
    theta: FloatArray
    estimate: FloatArray
    box: Box
    free: tuple[str, ...]
    sigma: FloatArray
    covariance: FloatArray
    contrast: float
    log_likelihood: float
    snr: float
    iterations: int
    chi2_reduced: float
    p_value: float
    status: Status
    flags: tuple[Status, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    sigma_index: float = math.nan
    size_probability: float = math.nan

    def shifted(self, x_nm: float, y_nm: float) -> FitResult:
        """Give the same fit in coordinates with another origin."""
        return replace(self, x_nm=self.x_nm + x_nm, y_nm=self.y_nm + y_nm)


@dataclass(frozen=True)
class PosteriorResult:
    """An ensemble of posterior samples and the verdict on it.

    Attributes
    ----------
    names : tuple of str
        Parameter names with units, as in `PARAMETERS`.
    samples : ndarray, shape (chain, draw, parameter)
        Draws after burn-in, one chain per walker.
    log_likelihood : ndarray, shape (chain, draw)
        At each draw.
    tau : ndarray, shape (parameter,)
        Integrated autocorrelation time [steps].
    r_hat : ndarray, shape (parameter,)
        Split R̂.
    ess_bulk, ess_tail : ndarray, shape (parameter,)
        Effective sample sizes.
    acceptance : float
        Mean acceptance fraction.
    converged : bool
        Whether every criterion holds; if not, the samples must not be reported as a posterior.
    message : str
        Which criterion failed, or that all hold.
    van_trees : ndarray, shape (parameter,), or None
        With an informative prior, the least root-mean-square error of any estimate over particles
        of that prior [nm, kDa].
    """

    names: tuple[str, ...]
    samples: FloatArray
    log_likelihood: FloatArray
    tau: FloatArray
    r_hat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    acceptance: float
    converged: bool
    message: str
    van_trees: FloatArray | None = None
