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
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr, ndtri

from iscat_analysis._kernels.diffusion import displacement_likelihood, most_likely_diffusion
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import array_of, number_in, real_array
from iscat_analysis.records import FloatArray

LEAST_POSITIONS = 4
"""A shorter track says too little: of its displacements, at least one must have two neighbours."""

_RATES_HZ = (1e-6, 1e9)
_LENGTHS_NM = (1e-6, 1e9)  # the smallest error and the largest place
_MOST_RATIO = 1e5  # of the errors of a track; their squares must not drown in one another
_MOST_FRAMES = 2**53  # beyond, not every frame has a number of its own
_OF_TIMES = ("gaps_s", "linked", "error", "rate")  # and of errors alone, of `Displacements`
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
    frames: NDArray[np.int64]
    interval_s: float
    exposure_s: float
    counted: NDArray[np.int64]

    @cached_property
    def gaps_s(self) -> FloatArray:
        """Time that each displacement takes, shape (m,) [s]."""
        return np.asarray(np.diff(self.frames)[self.counted] * self.interval_s)

    @cached_property
    def steps_nm(self) -> FloatArray:
        """Displacements, shape (c, m)."""
        return np.ascontiguousarray(np.diff(self.positions_nm, axis=1)[:, self.counted])

    @cached_property
    def linked(self) -> NDArray[np.bool_]:
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

    def moved(self, positions_nm: FloatArray) -> Displacements:
        """Replace the positions; frames and errors stay.

        Shapes: `positions_nm` (c, n).
        """
        track = replace(self, positions_nm=positions_nm)
        vars(track).update({name: getattr(self, name) for name in _OF_TIMES})
        return track

    def likelihood(self, d_nm2_s: float) -> Likelihood:
        """Log-likelihood of free diffusion."""
        return Likelihood(*displacement_likelihood(self.steps_nm, *self.error, *self.rate, d_nm2_s))


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
    rate = real_array("frame_rate_hz", frame_rate_hz)
    if rate.ndim or not _RATES_HZ[0] <= rate <= _RATES_HZ[1]:
        raise ConfigError(
            f"frame_rate_hz = {frame_rate_hz!r}: give one number of frames per second between "
            f"{_RATES_HZ[0]:g} and {_RATES_HZ[1]:g}"
        )
    interval = 1 / float(rate)
    exposure = interval
    if exposure_ms is not None:
        given = real_array("exposure_ms", exposure_ms)
        if given.ndim or not (np.isfinite(given) and given >= 0):
            raise ConfigError(f"exposure_ms = {exposure_ms!r}: give one number of at least 0")
        exposure = float(given) / 1e3
        if exposure > interval * (1 + _ROUNDING):
            raise ConfigError(
                f"exposure_ms = {exposure_ms:g} is longer than the {1e3 * interval:g} ms from "
                f"frame to frame at frame_rate_hz = {frame_rate_hz:g}: correct one of them"
            )
    when = real_array("frames", frames)
    if when.ndim != 1 or when.size < LEAST_POSITIONS:
        raise DataError(
            f"frames: has shape {when.shape}; give the frame number of each of at least "
            f"{LEAST_POSITIONS} positions"
        )
    whole = np.isfinite(when).all() and (np.abs(when) < _MOST_FRAMES).all()
    whole = whole and (when == np.round(when)).all()
    if not whole or not (np.diff(when) > 0).all():
        raise DataError(
            "frames: give whole numbers that increase, each frame once; frames without a position "
            "are left out"
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
    for name, array in (("positions_nm", places), ("sigma_nm", columns)):
        if not np.isfinite(array).all():
            raise DataError(f"{name}: is not finite everywhere; leave such frames out")
    least, most = _LENGTHS_NM
    if np.abs(places).max() > most:
        raise DataError(f"positions_nm = {places.flat[np.abs(places).argmax()]:g}: give nanometres")
    wrong = (columns < least) | (columns > most)
    if wrong.any():
        raise DataError(
            f"sigma_nm = {columns[wrong].flat[0]:g}: give the standard error of each position in "
            f"nanometres, at least {least:g}"
        )
    if columns.max() > _MOST_RATIO * columns.min():
        raise DataError(
            f"sigma_nm: goes from {columns.min():g} to {columns.max():g} nm; leave out positions "
            "that say nothing beside the others"
        )
    variance = np.broadcast_to(columns**2, places.shape).T
    every = np.ones(when.size - 1, dtype=bool)
    going = every if counted is None else array_of("counted", counted)
    if going.shape != (when.size - 1,) or going.dtype != bool:
        raise DataError(
            f"counted: has shape {going.shape} of {going.dtype}; give ({when.size - 1},) of bool, "
            "one for each displacement"
        )
    if going.sum() < LEAST_POSITIONS - 1:
        raise DataError(
            f"counted: leaves {going.sum()} displacements of {LEAST_POSITIONS - 1} that are needed"
        )
    return Displacements(
        positions_nm=np.ascontiguousarray(places.T),
        variance_nm2=np.ascontiguousarray(variance),
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
    best, sigma, crb, log_likelihood = _estimated(track)
    other, other_sigma = covariance_based(track, best)
    spare = other_sigma**2 - crb**2
    return Diffusion(
        d_um2_s=best / NM2_PER_UM2,
        sigma_d_um2_s=sigma / NM2_PER_UM2,
        crb_d_um2_s=crb / NM2_PER_UM2,
        interval_um2_s=tuple(end / NM2_PER_UM2 for end in _interval(track, best, level)),  # type: ignore[arg-type]
        level=float(level),
        log_likelihood=log_likelihood,
        n_positions=track.counted.size + 1,
        covariance_d_um2_s=other / NM2_PER_UM2,
        covariance_sigma_d_um2_s=other_sigma / NM2_PER_UM2,
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
    return best / NM2_PER_UM2, sigma / NM2_PER_UM2


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
        return deviation - critical_value(math.sqrt(max(gained, 0.0)), level)

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
