"""What a track tells of its diffusion: displacements, their errors and their blur.

The camera shows a particle's place averaged over the exposure e, with an error ε_k of its own in
each frame.  Free diffusion gives the displacement d_k over a gap of g_k frames of length Δ

    Var d_k = 2D (g_k Δ − e/3) + σ_k² + σ_{k+1}²,      Cov(d_k, d_{k+1}) = D e/3 − σ_{k+1}²,

and nothing between others (Berglund, Phys. Rev. E 82, 011917, 2010, equations 6 and 12, for gaps
of one frame and equal errors).  So Σ(D) = E + D·A with three bands.

The diffusion coefficient of a track, by maximum likelihood, and the size that it tells.

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
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from iscat_analysis._kernels.diffusion import displacement_likelihood, most_likely_diffusion
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import array_of, number_in, real_array
from iscat_analysis.records import BoolArray, FloatArray, IntArray

LEAST_POSITIONS = 4
"""A shorter track says too little: of its displacements, at least one must have two neighbours."""

_ROUNDING = 1e-9  # an exposure that is the whole interval may exceed it by this share


class Likelihood(NamedTuple):
    """Log-likelihood of a diffusion coefficient D [nm²/s]."""

    value: float
    slope: float
    curvature: float
    information: float
    log_determinant: float
    log_determinant_slope: float


@dataclass(frozen=True, eq=False)
class Displacements:
    """A track, checked; build it with `gather`."""

    positions_nm: FloatArray
    variance_nm2: FloatArray
    frames: IntArray
    interval_s: float
    exposure_s: float
    counted: IntArray

    @cached_property
    def gaps_s(self) -> FloatArray:
        """Time that each displacement takes, shape (m,) [s]."""
        return np.asarray(np.diff(self.frames)[self.counted] * self.interval_s)

    @cached_property
    def steps_nm(self) -> FloatArray:
        """Displacements, shape (c, m)."""
        return np.ascontiguousarray(np.diff(self.positions_nm, axis=1)[:, self.counted])

    @cached_property
    def linked(self) -> BoolArray:
        """Whether a displacement begins where the one before ended, shape (m − 1,)."""
        return np.asarray(np.diff(self.counted) == 1)

    @cached_property
    def error(self) -> tuple[FloatArray, FloatArray]:
        """E: its diagonal, shape (c, m), and the band beside it, (c, m − 1) [nm²]."""
        variance, k = self.variance_nm2, self.counted
        band = np.where(self.linked, -variance[:, k[1:]], 0.0)
        return variance[:, k] + variance[:, k + 1], np.ascontiguousarray(band)

    @cached_property
    def rate(self) -> tuple[FloatArray, FloatArray]:
        """A: its diagonal, shape (m,), and the band beside it, (m − 1,) [s]."""
        blur = self.exposure_s / 3
        return 2 * (self.gaps_s - blur), np.where(self.linked, blur, 0.0)

    def likelihood(self, d_nm2_s: float) -> Likelihood:
        """Log-likelihood of free diffusion."""
        return Likelihood(
            *displacement_likelihood((self.steps_nm, *self.error, *self.rate), d_nm2_s)
        )

    @cached_property
    def best_nm2_s(self) -> float:
        """D of highest likelihood [nm²/s]."""
        scale = float(np.mean(self.steps_nm**2 / self.rate[0]))
        scale = scale or float(np.mean(self.error[0] / self.rate[0]))
        return float(most_likely_diffusion((self.steps_nm, *self.error, *self.rate), scale))

    @cached_property
    def best(self) -> Likelihood:
        """The likelihood at its maximum."""
        return self.likelihood(self.best_nm2_s)

    def estimate(self) -> tuple[float, float]:
        """D and its standard error, as `fit_diffusion` gives them [µm²/s]."""
        curved = self.best_nm2_s > 0 and self.best.curvature < 0
        information = -self.best.curvature if curved else self.best.information
        return self.best_nm2_s / NM2_PER_UM2, information**-0.5 / NM2_PER_UM2


def gather(
    frames: ArrayLike,
    positions_nm: ArrayLike,
    sigma_nm: ArrayLike,
    *,
    frame_rate_hz: float,
    exposure_ms: float | None,
    counted: ArrayLike | None = None,
) -> Displacements:
    """Check the arrays of a track, and make its displacements.

    Shapes: `frames` (n,), `positions_nm` (n,) or (n, c).
    """
    # frame rates; the smallest error and the largest place
    (slowest, fastest), (least, most) = (1e-6, 1e9), (1e-6, 1e9)
    rate = number_in(
        "frame_rate_hz", frame_rate_hz, least=slowest, most=fastest,
        what="number of frames per second",
    )  # fmt: skip
    interval = exposure = 1 / rate
    if exposure_ms is not None:
        exposure = number_in("exposure_ms", exposure_ms, least=0.0) / 1e3
    if exposure > interval * (1 + _ROUNDING):
        raise ConfigError(
            f"exposure_ms = {exposure_ms:g} is longer than the {1e3 * interval:g} ms from "
            f"frame to frame at frame_rate_hz = {frame_rate_hz:g}: correct one of them"
        )
    when = real_array("frames", frames)
    # beyond 2⁵³ not every frame has a number of its own
    listed = when.ndim == 1 and when.size >= LEAST_POSITIONS and np.abs(when).max() < 2**53
    if not listed or (when % 1).any() or not (np.diff(when) > 0).all():
        raise DataError(
            f"frames: give the frame number of each of at least {LEAST_POSITIONS} positions, whole "
            "numbers that increase; frames without a position are left out"
        )
    places = real_array("positions_nm", positions_nm)
    places = places[:, np.newaxis] if places.ndim == 1 else places
    if places.ndim != 2 or places.shape[0] != when.size or not places.shape[1]:
        raise DataError(
            f"positions_nm: has shape {np.shape(positions_nm)}; give ({when.size},) or "
            f"({when.size}, axes), one row for each of frames"
        )
    errors = real_array("sigma_nm", sigma_nm)
    columns = errors[:, np.newaxis] if errors.shape == when.shape else errors
    if columns.shape not in ((), (when.size, 1), places.shape):
        raise DataError(
            f"sigma_nm: has shape {errors.shape}; give one number, ({when.size},) or "
            f"{places.shape} as positions_nm has"
        )
    for name, array, low, what in (
        ("positions_nm", places, -most, "each position"),
        ("sigma_nm", columns, least, "the standard error of each position"),
    ):
        wrong = ~((array >= low) & (array <= most))
        if wrong.any():
            raise DataError(
                f"{name} = {array[wrong].flat[0]:g}: give {what} in nanometres, between {low:g} "
                f"and {most:g}; leave frames without one out"
            )
    # of the errors of a track, whose squares must not drown in one another
    if columns.max() > 1e5 * columns.min():
        raise DataError(
            f"sigma_nm: goes from {columns.min():g} to {columns.max():g} nm; leave out positions "
            "that say nothing beside the others"
        )
    going = np.ones(when.size - 1, bool) if counted is None else array_of("counted", counted)
    told = going.shape == (when.size - 1,) and going.dtype == bool
    if not told or going.sum() < LEAST_POSITIONS - 1:
        raise DataError(
            f"counted: give ({when.size - 1},) of bool, one for each displacement, at least "
            f"{LEAST_POSITIONS - 1} of them True"
        )
    return Displacements(
        positions_nm=np.ascontiguousarray(places.T),
        variance_nm2=np.ascontiguousarray(np.broadcast_to(columns**2, places.shape).T),
        frames=when.astype(np.int64),
        interval_s=interval,
        exposure_s=min(exposure, interval),
        counted=np.flatnonzero(going),
    )


NM2_PER_UM2 = 1e6  # nm²


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
    return diffusion_of(track, float(level))


def diffusion_of(track: Displacements, level: float) -> Diffusion:
    """Fit the diffusion coefficient of a track that is checked."""
    (best, sigma), crb = track.estimate(), track.best.information**-0.5 / NM2_PER_UM2
    other, other_sigma = (each / NM2_PER_UM2 for each in covariance_based(track, track.best_nm2_s))
    low, high = (end / NM2_PER_UM2 for end in _interval(track, level))
    spare = other_sigma**2 - crb**2
    return Diffusion(
        d_um2_s=best,
        sigma_d_um2_s=sigma,
        crb_d_um2_s=crb,
        interval_um2_s=(low, high),
        level=level,
        log_likelihood=track.best.value,
        n_positions=track.counted.size + 1,
        covariance_d_um2_s=other,
        covariance_sigma_d_um2_s=other_sigma,
        disagreement=(other - best) / math.sqrt(spare) if spare > 0 else math.nan,
    )


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


def _interval(track: Displacements, level: float) -> tuple[float, float]:
    """Find where the root of the likelihood ratio, nearly a line, has its critical value."""
    zero, best, step = track.likelihood(0.0), track.best_nm2_s, track.best.information**-0.5

    def beyond(d: float) -> float:
        there = track.likelihood(d)
        gained = d * zero.log_determinant_slope - (there.log_determinant - zero.log_determinant)
        deviation = math.sqrt(2 * max(track.best.value - there.value, 0.0))
        return deviation - critical_value(math.sqrt(max(gained, 0.0)), level)

    high = best + step
    while beyond(high) < 0:
        step *= 2
        high += step
    excludes_zero = best > 0 and beyond(0.0) > 0
    lower = float(scipy.optimize.brentq(beyond, 0.0, best)) if excludes_zero else 0.0
    return lower, float(scipy.optimize.brentq(beyond, best, high))


def critical_value(mu: float, level: float) -> float:
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


def covariance_based(track: Displacements, d_nm2_s: float) -> tuple[float, float]:
    """Estimate D from d_k² + d_k d_{k−1} + d_k d_{k+1}, whose mean is 2 D g_k Δ for any errors.

    Vestergaard, Blainey & Flyvbjerg (2014), equation 14, here for errors that differ and for gaps:
    σ_k² + σ_{k+1}² of a square is what its two products take off, and so is the blur.  The sum
    d·Q·d has the variance 2 tr (QΣ)².
    """
    diagonal = np.zeros(track.gaps_s.size)
    diagonal[1:-1] = track.linked[1:] & track.linked[:-1]
    if not diagonal.any():
        return math.nan, math.nan
    weights = bands(diagonal, np.where(track.linked, 0.5 * (diagonal[1:] + diagonal[:-1]), 0.0))
    time = 2 * float(track.gaps_s @ diagonal) * len(track.steps_nm)
    total = float(np.sum(track.steps_nm.T * (weights @ track.steps_nm.T)))
    variance = 0.0
    for error, band in zip(*track.error, strict=True):
        product = weights @ bands(error + d_nm2_s * track.rate[0], band + d_nm2_s * track.rate[1])
        variance += 2 * float(product.multiply(product.T).sum())
    return total / time, math.sqrt(variance) / time


def bands(main: FloatArray, beside: FloatArray) -> scipy.sparse.csr_array:
    """Make a symmetric matrix of its diagonal and the band beside it."""
    return scipy.sparse.diags_array([beside, main, beside], offsets=(-1, 0, 1), format="csr")
