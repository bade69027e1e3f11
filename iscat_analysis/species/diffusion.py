"""The diffusion coefficient of a track, by maximum likelihood, and the size that it tells.

The likelihood is that of all displacements together, each frame with its own error and its blur
(Berglund, Phys. Rev. E 82, 011917, 2010; Michalet & Berglund, Phys. Rev. E 85, 061916, 2012).  A
mean-squared displacement fitted with a line uses the same numbers many times over and needs to be
told how many lags are best; this does not, and reaches the Cramér–Rao bound.

The covariance is linear in D, Σ = E + D·A.  With M = Σ⁻¹A the third cumulants are
E[∂³ℓ] = 2 tr M³ and Cov(∂²ℓ, ∂ℓ) = −tr M³, whose combination E[∂³ℓ]/2 + Cov(∂²ℓ, ∂ℓ), which is the
bias of order 1/n (Cox & Snell, J. R. Stat. Soc. B 30, 248, 1968), is zero: nothing is taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from iscat_analysis._kernels.diffusion import most_likely_diffusion
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import number_in, real_array
from iscat_analysis.records import FloatArray
from iscat_analysis.species.displacements import Displacements, gather

_NM2_PER_UM2 = 1e6  # nm²


@dataclass(frozen=True)
class Diffusion:
    """A diffusion coefficient, what is known of it, and a second opinion.

    Attributes
    ----------
    d_um2_s : float
        D of highest likelihood, at least 0 [µm²/s].
    sigma_d_um2_s : float
        Its standard error, from the curvature of the likelihood; at D = 0 from the bound.
    crb_d_um2_s : float
        The Cramér–Rao bound at D.
    interval_um2_s : tuple of float
        Likelihood-ratio interval; it starts at 0 where 0 cannot be excluded.
    level : float
        The interval's coverage.
    log_likelihood : float
        At D, of the displacements in nm.
    n_positions : int
        Displacements that count, and one.
    covariance_d_um2_s : float
        The covariance-based estimate, which uses neither errors nor exposure, and may be negative.
    covariance_sigma_d_um2_s : float
        Its standard error, were the errors and the exposure right.
    disagreement : float
        The two estimates' difference over its standard error.  Far from 0, more than 3 or so, the
        errors or the exposure are not what was said, or the particle does not diffuse freely.
    """

    d_um2_s: float
    sigma_d_um2_s: float
    crb_d_um2_s: float
    interval_um2_s: tuple[float, float]
    level: float
    log_likelihood: float
    n_positions: int
    covariance_d_um2_s: float
    covariance_sigma_d_um2_s: float
    disagreement: float


def fit_diffusion(
    frames: ArrayLike,
    positions_nm: ArrayLike,
    sigma_nm: ArrayLike,
    *,
    frame_rate_hz: float,
    exposure_ms: float | None = None,
    counted: ArrayLike | None = None,
    level: float = 0.95,
) -> Diffusion:
    """Diffusion coefficient of one track: maximum likelihood with errors and motion blur.

    Free diffusion, the same along all axes; the errors of different frames and axes are
    independent.  `anomalous_test` and `confinement_test` ask whether the motion is free.

    Parameters
    ----------
    frames : array_like of int, shape (n,)
        Frame of each position, increasing; gaps are frames without a position.  At least 4.
    positions_nm : array_like, shape (n,) or (n, c)
        Positions along one or c axes [nm].
    sigma_nm : array_like
        Standard error of each position: one number, (n,), or (n, c) [nm].
    frame_rate_hz : float
        Frames per second.
    exposure_ms : float, optional
        Time over which a frame collects light [ms]; absent, all of the time from frame to frame.
        0 is a flash.
    counted : array_like of bool, shape (n − 1,), optional
        Displacements that count, each by the position from which it goes; absent, all.  Where a
        particle is seen only if it stays, as at the border of the field, the large displacements
        are missing: those that begin there must be left out, or D comes out too small.  At least 3.
    level : float
        Coverage of the interval.

    Returns
    -------
    Diffusion
        Estimate, standard error, Cramér–Rao bound, interval, and the covariance-based estimate.

    Raises
    ------
    ConfigError
        The frame rate, exposure or level is impossible.
    DataError
        The arrays are not those of a track.

    Notes
    -----
    The interval holds every D that a likelihood-ratio test admits.  Near 0 the estimate cannot
    fall below 0, and the critical value follows: with μ² the mean of twice the log-likelihood over
    that of D = 0 (Cowan et al., Eur. Phys. J. C 71, 1554, 2011) it is that of Feldman & Cousins
    (Phys. Rev. D 57, 3873, 1998), one-sided at 0 and two-sided far from it.

    References
    ----------
    Berglund, Phys. Rev. E 82, 011917 (2010); Michalet & Berglund, Phys. Rev. E 85, 061916 (2012);
    Vestergaard, Blainey & Flyvbjerg, Phys. Rev. E 89, 022726 (2014), for the covariance-based
    estimate.
    """
    track = gather(
        frames, positions_nm, sigma_nm,
        frame_rate_hz=frame_rate_hz, exposure_ms=exposure_ms, counted=counted,
    )  # fmt: skip
    if not 0 < number_in("level", level) < 1:
        raise ConfigError(f"level = {level!r}: give a coverage between 0 and 1")
    best, sigma, crb, log_likelihood = _estimated(track)
    other, other_sigma = _covariance_based(track, best)
    spare = other_sigma**2 - crb**2
    return Diffusion(
        d_um2_s=best / _NM2_PER_UM2,
        sigma_d_um2_s=sigma / _NM2_PER_UM2,
        crb_d_um2_s=crb / _NM2_PER_UM2,
        interval_um2_s=tuple(end / _NM2_PER_UM2 for end in _interval(track, best, level)),  # type: ignore[arg-type]
        level=float(level),
        log_likelihood=log_likelihood,
        n_positions=track.counted.size + 1,
        covariance_d_um2_s=other / _NM2_PER_UM2,
        covariance_sigma_d_um2_s=other_sigma / _NM2_PER_UM2,
        disagreement=(other - best) / math.sqrt(spare) if spare > 0 else math.nan,
    )


def estimate_diffusion(
    frames: ArrayLike,
    positions_nm: ArrayLike,
    sigma_nm: ArrayLike,
    *,
    frame_rate_hz: float,
    exposure_ms: float | None = None,
    counted: ArrayLike | None = None,
) -> tuple[float, float]:
    """D of one track and its standard error, as in `fit_diffusion`, and nothing else."""
    track = gather(
        frames, positions_nm, sigma_nm,
        frame_rate_hz=frame_rate_hz, exposure_ms=exposure_ms, counted=counted,
    )  # fmt: skip
    best, sigma, *_ = _estimated(track)
    return best / _NM2_PER_UM2, sigma / _NM2_PER_UM2


def _estimated(track: Displacements) -> tuple[float, float, float, float]:
    """D of highest likelihood, its standard error, the bound there [nm²/s], and the likelihood."""
    best = most_likely(track)
    there = track.likelihood(best)
    crb = 1 / math.sqrt(there.information)
    sigma = 1 / math.sqrt(-there.curvature) if best > 0 and there.curvature < 0 else crb
    return best, sigma, crb, there.value


def hydrodynamic_diameter(
    d_um2_s: ArrayLike,
    sigma_d_um2_s: ArrayLike = 0.0,
    *,
    viscosity_mpa_s: float = 0.89,
    temperature_c: float = 25.0,
) -> tuple[FloatArray, FloatArray]:
    """Diameter of the sphere that diffuses as fast, far from walls: k T/(3π η D).

    Parameters
    ----------
    d_um2_s : array_like
        Diffusion coefficients, at least 0 [µm²/s].
    sigma_d_um2_s : array_like
        Their standard errors [µm²/s].
    viscosity_mpa_s : float
        η of the liquid [mPa s]; water has 0.89 at 25 °C.
    temperature_c : float
        T [°C].

    Returns
    -------
    diameter_nm : ndarray
        Infinite where D is 0.
    sigma_nm : ndarray
        To first order, d σ_D/D.

    Raises
    ------
    ConfigError
        Viscosity or temperature is impossible.
    DataError
        A D or an error is negative or not finite, or their shapes do not go together.

    References
    ----------
    Einstein, Ann. Phys. 322, 549 (1905).
    """
    number_in("viscosity_mpa_s", viscosity_mpa_s, above=0.0)
    number_in("temperature_c", temperature_c, above=-scipy.constants.zero_Celsius)
    d, sigma = real_array("d_um2_s", d_um2_s), real_array("sigma_d_um2_s", sigma_d_um2_s)
    for name, array in (("d_um2_s", d), ("sigma_d_um2_s", sigma)):
        bad = ~(np.isfinite(array) & (array >= 0))
        if bad.any():
            raise DataError(f"{name} = {array[bad].flat[0]:g}: give finite numbers of at least 0")
    try:
        d, sigma = np.broadcast_arrays(d, sigma)
    except ValueError:
        raise DataError(
            f"sigma_d_um2_s: has shape {sigma.shape}, which does not go with {d.shape} of d_um2_s"
        ) from None
    energy = scipy.constants.Boltzmann * (temperature_c + scipy.constants.zero_Celsius)
    drag = 3 * math.pi * viscosity_mpa_s * 1e-3
    with np.errstate(divide="ignore", invalid="ignore"):
        diameter = energy / (drag * d * 1e-12) * 1e9
        error = np.where(d > 0, diameter * sigma / d, np.inf)
    return np.asarray(diameter), np.asarray(error)


def most_likely(track: Displacements) -> float:
    """Maximise the likelihood of free diffusion."""
    scale = float(np.mean(track.steps_nm**2 / track.rate[0])) or float(
        np.mean(track.error[0] / track.rate[0])
    )
    return float(most_likely_diffusion(track.steps_nm, *track.error, *track.rate, scale))


def _interval(track: Displacements, best: float, level: float) -> tuple[float, float]:
    """Find where the root of the likelihood ratio, nearly a line, has its critical value."""
    zero, there = track.likelihood(0.0), track.likelihood(best)
    peak = there.value

    def beyond(d: float) -> float:
        there = track.likelihood(d)
        gained = d * zero.log_determinant_slope - (there.log_determinant - zero.log_determinant)
        deviation = math.sqrt(2 * max(peak - there.value, 0.0))
        return deviation - _critical(math.sqrt(max(gained, 0.0)), level)

    step = 1 / math.sqrt(there.information)
    high = best + step
    while beyond(high) < 0:
        step *= 2
        high += step
    upper = float(scipy.optimize.brentq(beyond, best, high))
    lower = (
        0.0 if best == 0 or beyond(0.0) <= 0 else float(scipy.optimize.brentq(beyond, 0.0, best))
    )
    return lower, upper


def _critical(mu: float, level: float) -> float:
    """Critical deviation where the estimate is N(μ, 1) but cannot fall below 0.

    The interval holds μ if the deviation is less than this; the chance of it is Φ(c) − Φ(−l) with
    l = c for c ≤ μ, and else (μ² + c²)/2μ, because twice the ratio is μ² − 2μx for x < 0.
    """
    one, two = float(ndtri(level)), float(ndtri(0.5 + level / 2))
    if mu >= two:
        return two

    def short(c: float) -> float:
        low = c if c <= mu else (mu * mu + c * c) / (2 * mu)
        return float(ndtr(c) - ndtr(-low)) - level

    return float(scipy.optimize.brentq(short, one, two)) if mu > 0 and short(one) < 0 else one


def _covariance_based(track: Displacements, d_nm2_s: float) -> tuple[float, float]:
    """Estimate D from d_k² + d_k d_{k−1} + d_k d_{k+1}, whose mean is 2 D g_k Δ for any errors.

    Vestergaard, Blainey & Flyvbjerg (2014), equation 14, here for errors that differ and for gaps:
    σ_k² + σ_{k+1}² of a square is what its two products take off, and so is the blur.  The sum
    d·Q·d has the variance 2 tr (QΣ)².
    """
    steps = track.steps_nm
    diagonal = np.zeros(track.gaps_s.size)
    diagonal[1:-1] = track.linked[1:] & track.linked[:-1]
    if not diagonal.any():
        return math.nan, math.nan
    off_diagonal = np.where(track.linked, 0.5 * (diagonal[1:] + diagonal[:-1]), 0.0)
    time = 2 * float(track.gaps_s @ diagonal) * len(steps)
    total = float(
        np.sum(diagonal * steps**2) + 2 * np.sum(off_diagonal * steps[:, 1:] * steps[:, :-1])
    )
    variance = 0.0
    for error, band in zip(*track.error, strict=True):
        main, next_ = error + d_nm2_s * track.rate[0], band + d_nm2_s * track.rate[1]
        variance += 2 * _square_trace((diagonal, off_diagonal), (main, next_))
    return total / time, math.sqrt(variance) / time


def _square_trace(one: tuple[FloatArray, FloatArray], two: tuple[FloatArray, FloatArray]) -> float:
    """Trace of (AB)² of symmetric tridiagonal matrices, each its diagonal and what is beside."""
    (a, b), (c, d) = one, two
    main = a * c
    main[:-1] += b * d
    main[1:] += b * d
    above, below = a[:-1] * d + b * c[1:], b * c[:-1] + a[1:] * d
    farther = b[:-1] * d[1:] * b[1:] * d[:-1]
    return float(np.sum(main**2) + 2 * np.sum(above * below) + 2 * np.sum(farther))
