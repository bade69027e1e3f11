"""Is the motion of a track free?  Tests against an exponent, confinement, and a D that changes.

All compare the highest likelihood of a wider model with that of free diffusion.  An anomalous
exponent lies inside its range when the motion is free, so that twice the difference is χ² with one
degree of freedom.  A well of vanishing stiffness is a unit root, for which no such law holds; what
the difference comes to without a well is therefore found from tracks drawn with the same frames,
errors and D (Davison & Hinkley, Bootstrap Methods, 1997, section 4.2).

Fractional Brownian motion: the likelihood of D and of an exponent α together, and its maximum.

Displacements have the covariance Σ = E + M, E that of the errors, with three bands, and
M = D·C(α), full.  With W = Σ⁻¹, z = W d and Σ_a, Σ_ab the derivatives with respect to ln D and α

    ∂_a ℓ = ½ [z·Σ_a z − tr WΣ_a],      I_ab = ½ tr WΣ_aWΣ_b  (Fisher's information),
    −∂_ab ℓ = Σ_a z·WΣ_b z − I_ab − ½ [z·Σ_ab z − tr WΣ_ab],

so that W and one product, C'W, tell everything: M W is 1 − E W, and E has three bands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc

from iscat_analysis._kernels.harmonic_trap import most_likely_well
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import number_in, shown
from iscat_analysis.records import FloatArray, IntArray
from iscat_analysis.species.diffusion import NM2_PER_UM2, Displacements, bands, gather

STRETCH = 40
"""Displacements at least of a stretch of a track whose D is compared with that of the others."""

MOST_POSITIONS = 4000
"""Of a track whose exponent is tested."""


@dataclass(frozen=True)
class AnomalousTest:
    """Whether the mean-squared displacement grows as time to the power 1.

    Attributes
    ----------
    p_value : float
        Chance of a likelihood ratio at least this large if the motion is free.
    ratio : float
        Twice the difference of the log-likelihoods.
    exponent : float
        α of highest likelihood; NaN for a track that does not move.
    sigma_exponent : float
        Its standard error, from the Fisher information of α and D together.
    d_um2_s : float
        D with that exponent: the mean-squared displacement of a frame is 2 D Δ along each axis
        [µm²/s].
    """

    p_value: float
    ratio: float
    exponent: float
    sigma_exponent: float
    d_um2_s: float


@dataclass(frozen=True)
class ConfinementTest:
    """Whether a track stays in a harmonic well.

    Attributes
    ----------
    p_value : float
        Share of tracks without a well, this one included, whose likelihood ratio is at least as
        large.
    ratio : float
        Twice the difference of the log-likelihoods.
    confinement_nm : float
        Standard deviation of the place in the well, along each axis; infinite where no well is
        better than free diffusion.
    d_um2_s : float
        D inside the well [µm²/s].
    """

    p_value: float
    ratio: float
    confinement_nm: float
    d_um2_s: float


def anomalous_test(
    frames: ArrayLike,
    positions_nm: ArrayLike,
    sigma_nm: ArrayLike,
    *,
    frame_rate_hz: float,
    exposure_ms: float | None = None,
) -> AnomalousTest:
    """Test free diffusion against fractional Brownian motion, MSD = 2 D Δ (t/Δ)^α along each axis.

    An exponent below 1 is subdiffusion; above 1 it is motion with a direction, as a drift of the
    stage makes it.  Errors of the positions and blur are in both likelihoods.  The time taken
    grows with the cube of the track's length: seconds for 1000 positions.

    Parameters
    ----------
    frames : array_like of int, shape (n,)
        As in `fit_diffusion`.
    positions_nm : array_like, shape (n,) or (n, c)
        As in `fit_diffusion` [nm].
    sigma_nm : array_like
        As in `fit_diffusion` [nm].
    frame_rate_hz : float
        As in `fit_diffusion`.
    exposure_ms : float, optional
        As in `fit_diffusion` [ms].

    Returns
    -------
    AnomalousTest
        The exponent and how surprising it is.

    Raises
    ------
    ConfigError
        The frame rate or exposure is impossible.
    DataError
        The arrays are not those of a track, or it has more than `MOST_POSITIONS`.

    References
    ----------
    Mandelbrot & Van Ness, SIAM Rev. 10, 422 (1968).
    """
    track = gather(
        frames, positions_nm, sigma_nm, frame_rate_hz=frame_rate_hz, exposure_ms=exposure_ms
    )
    if track.frames.size > MOST_POSITIONS:
        raise DataError(
            f"frames: {track.frames.size} positions are more than the {MOST_POSITIONS} whose "
            "covariance fits into memory; give a part of the track"
        )
    return exponent_of(track)


def exponent_of(track: Displacements) -> AnomalousTest:
    """Test whether the exponent of a track that is checked is 1."""
    if not track.best_nm2_s > 0:
        return AnomalousTest(1.0, 0.0, math.nan, math.nan, 0.0)
    at, there = most_likely_power(track, track.best_nm2_s)
    ratio = max(2 * (there.value - track.best.value), 0.0)
    sigma = math.nan
    if math.isfinite(there.value):
        sigma = math.sqrt(float(np.linalg.inv(there.information)[1, 1]))
    d_um2_s = math.exp(at[0]) / NM2_PER_UM2
    return AnomalousTest(float(chdtrc(1, ratio)), ratio, float(at[1]), sigma, d_um2_s)


def confinement_test(
    frames: ArrayLike,
    positions_nm: ArrayLike,
    sigma_nm: ArrayLike,
    *,
    frame_rate_hz: float,
    exposure_ms: float | None = None,
    resamples: int = 199,
    enough: int | None = None,
    rng: np.random.Generator | None = None,
) -> ConfinementTest:
    """Test free diffusion against diffusion in a harmonic well of unknown place.

    Errors of the positions and blur are in both likelihoods.

    Parameters
    ----------
    frames : array_like of int, shape (n,)
        As in `fit_diffusion`.
    positions_nm : array_like, shape (n,) or (n, c)
        As in `fit_diffusion` [nm].
    sigma_nm : array_like
        As in `fit_diffusion` [nm].
    frame_rate_hz : float
        As in `fit_diffusion`.
    exposure_ms : float, optional
        As in `fit_diffusion` [ms].
    resamples : int
        Free tracks that are drawn; the smallest p-value is 1/(resamples + 1).
    enough : int, optional
        Draw no more once so many of them have a likelihood ratio at least as large: the p-value is
        then their share (Besag & Clifford), and a track that moves freely soon says so.
    rng : numpy.random.Generator, optional
        Draws them; absent, one with seed 1.

    Returns
    -------
    ConfinementTest
        The size of the well and how surprising it is.

    Raises
    ------
    ConfigError
        The frame rate or exposure is impossible, or `resamples` or `enough` is no positive number.
    DataError
        The arrays are not those of a track.

    References
    ----------
    Uhlenbeck & Ornstein, Phys. Rev. 36, 823 (1930).
    Besag & Clifford, Biometrika 78, 301 (1991).
    """
    track = gather(
        frames, positions_nm, sigma_nm, frame_rate_hz=frame_rate_hz, exposure_ms=exposure_ms
    )
    turns = int(number_in("resamples", resamples, least=1, whole=True))
    if enough is not None:
        number_in("enough", enough, least=1, whole=True)
    if rng is not None and not isinstance(rng, np.random.Generator):
        raise ConfigError(f"rng = {shown(rng)}: give what numpy.random.default_rng(1) returns")
    return well_of(track, turns, enough, np.random.default_rng(1) if rng is None else rng)


def well_of(
    track: Displacements, resamples: int, enough: int | None, rng: np.random.Generator
) -> ConfinementTest:
    """Test whether a track that is checked stays in a well."""
    free = track.best_nm2_s
    if not free > 0:
        return ConfinementTest(1.0, 0.0, math.inf, 0.0)
    ratio, d, stiffness = _harmonic_trap(track)
    larger, p_value = 0, math.nan
    for number in range(1, resamples + 1):
        larger += _harmonic_trap(free_track(track, free, rng))[0] >= ratio
        p_value = (larger + 1) / (number + 1)
        if larger == enough:
            p_value = larger / number
            break
    size = math.sqrt(d / stiffness) if ratio > 0 else math.inf
    return ConfinementTest(p_value, ratio, size, d / NM2_PER_UM2)


def steadiness_of(track: Displacements) -> float:
    """Test whether a track has one D from its beginning to its end.

    A track that was continued by another particle after they met has not.

    Notes
    -----
    Twice the difference of the logarithms is χ² with one degree of freedom fewer than there are
    stretches (S. S. Wilks, Ann. Math. Stat. 9, 60, 1938).
    """
    last = track.frames.size - 1
    # stretches at most
    count = min(last // STRETCH, 25)
    if count < 2:
        return 1.0
    ratio = 0.0
    for a, b in pairwise(np.linspace(0, last, count + 1).astype(int)):
        part = stretch_of(track, slice(a, b + 1))
        ratio += 2 * (part.best.value - part.likelihood(track.best_nm2_s).value)
    return float(chdtrc(count - 1, max(ratio, 0.0)))


def stretch_of(track: Displacements, kept: slice) -> Displacements:
    """Take some positions that follow each other; all displacements between them count."""
    frames = track.frames[kept]
    return replace(
        track,
        positions_nm=track.positions_nm[:, kept],
        variance_nm2=track.variance_nm2[:, kept],
        frames=frames,
        counted=np.arange(frames.size - 1),
    )


def _harmonic_trap(track: Displacements) -> tuple[float, float, float]:
    """Find the well of highest likelihood: the ratio, D [nm²/s] and κ [1/s]."""
    timed = track.positions_nm, track.variance_nm2, track.gaps_s, track.exposure_s
    scale = track.best_nm2_s or float(np.mean(track.steps_nm**2 / track.rate[0]))
    # per length of the track: there a well is not felt
    softest = 0.3 / float(track.gaps_s.sum())
    # times the frame rate: there a well is flat noise within one frame
    stiffest = 3.0 / track.interval_s
    value, d, stiffness = most_likely_well(timed, scale, softest, stiffest)
    return max(2 * (value - track.best.value), 0.0), d, stiffness


def free_track(track: Displacements, d: float, rng: np.random.Generator) -> Displacements:
    """Draw a free track with the same frames and errors.

    The mean over an exposure is halfway between its ends, with the variance D e/6 of a bridge.
    """
    shape, e = track.positions_nm.shape, track.exposure_s
    during = math.sqrt(2 * d * e) * rng.standard_normal(shape)
    dark = np.maximum(np.append(0.0, track.gaps_s - e), 0.0)
    between = np.sqrt(2 * d * dark) * rng.standard_normal(shape)
    between[:, 1:] += during[:, :-1]
    mean = np.cumsum(between, axis=1) + during / 2
    mean += math.sqrt(d * e / 6) * rng.standard_normal(shape)
    mean += np.sqrt(track.variance_nm2) * rng.standard_normal(shape)
    return replace(track, positions_nm=mean)


_EXPONENTS = (0.02, 1.98)
_LN_D = 20.0  # from ln D of free diffusion at most
_EXPONENT_STEP = 1e-3  # of an exponent, for the derivatives of the mean-squared displacement
_SETTLED = 1e-3  # twice the gain of log-likelihood that a last step expects
_MOST_STEPS = 50


class _There(NamedTuple):
    """Log-likelihood at (ln D, α), its slope, minus its curvature, and the Fisher information."""

    value: float
    slope: FloatArray
    curvature: FloatArray
    information: FloatArray


class Lags(NamedTuple):
    """All time differences between frames, in frames, and the index of the one of each pair."""

    distinct: FloatArray
    which: IntArray

    @classmethod
    def of(cls, track: Displacements) -> Lags:
        """Collect those of a track."""
        pairs = np.abs(np.subtract.outer(track.frames, track.frames))
        longest = int(pairs[0, -1])
        if longest < pairs.size:  # few gaps or none: all lags up to the longest
            return cls(np.arange(longest + 1.0), pairs)
        distinct, which = np.unique(pairs, return_inverse=True)
        return cls(distinct.astype(float), which.reshape(pairs.shape))


def most_likely_power(track: Displacements, free: float) -> tuple[FloatArray, _There]:
    """Maximise the likelihood of D and α by Newton's method, within limits; (ln D, α) and it.

    Shapes: result (2,).
    """
    lags = Lags.of(track)
    at = np.array([math.log(free), 1.0])
    low, high = np.array([at[0] - _LN_D, _EXPONENTS[0]]), np.array([at[0] + _LN_D, _EXPONENTS[1]])
    here = likelihood_at(track, lags, at)
    if not math.isfinite(here.value):
        return at, here
    for _ in range(_MOST_STEPS):
        known = here.curvature
        if not (known[1, 1] > 0 and np.linalg.det(known) > 0):
            known = here.information
        alpha = np.clip(np.linalg.solve(known, here.slope)[1], low[1] - at[1], high[1] - at[1])
        ln_d = (here.slope[0] - known[0, 1] * alpha) / known[0, 0]
        step = np.array([np.clip(ln_d, low[0] - at[0], high[0] - at[0]), alpha])
        if here.slope @ step < _SETTLED:
            at = at + step
            break
        there = likelihood_at(track, lags, at + step)
        # of ln D and α: no step at all
        while not there.value > here.value and np.abs(step).max() > 1e-6:
            step /= 2
            there = likelihood_at(track, lags, at + step)
        if not there.value > here.value:  # rounding is all that is left
            break
        at, here = at + step, there
    return at, here


def likelihood_at(track: Displacements, lags: Lags, at: FloatArray) -> _There:
    """Log-likelihood of fractional Brownian motion at (ln D, α), all axes; −∞ where it rounds."""
    before, there, after = (
        math.exp(at[0]) * mean_squared_displacement(track, lags.distinct, power)
        for power in at[1] + _EXPONENT_STEP * np.arange(-1, 2)
    )
    motion = covariance(lags, there)
    turn = covariance(lags, (after - before) / (2 * _EXPONENT_STEP))
    bend = covariance(lags, (after - 2 * there + before) / _EXPONENT_STEP**2)
    value, slope = -0.5 * track.steps_nm.size * math.log(2 * math.pi), np.zeros(2)
    curvature, information = np.zeros((2, 2)), np.zeros((2, 2))
    for main, off_diagonal, steps in zip(*track.error, track.steps_nm, strict=True):
        noise = bands(main, off_diagonal)
        try:
            inverse, log_determinant = _inverse(motion + noise.toarray())
        except np.linalg.LinAlgError:
            return _There(-math.inf, slope, curvature, information)
        z = inverse @ steps
        value -= (log_determinant + float(steps @ z)) / 2
        rises = np.eye(steps.size) - noise @ inverse, turn @ inverse  # Σ_a W, for ln D and for α
        force = np.array([rise @ steps for rise in rises])
        pull = force @ z - [np.trace(rise) for rise in rises]
        slope += pull / 2
        fisher = np.array([[np.einsum("ij,ji", a, b) / 2 for b in rises] for a in rises])
        second = np.array([pull, pull])  # z·Σ_ab z − tr WΣ_ab
        second[1] = pull[1], z @ bend @ z - np.einsum("ij,ij", inverse, bend)
        curvature += force @ inverse @ force.T - fisher - second / 2
        information += fisher
    return _There(value, slope, curvature, information)


def _inverse(sigma: FloatArray) -> tuple[FloatArray, float]:
    """Invert a covariance by halves, twice as fast as LAPACK, with its log-determinant."""
    half = len(sigma) // 2
    # rows of a matrix that is not halved to be inverted
    if 2 * half <= 80:
        factor = np.linalg.cholesky(sigma)
        return np.asarray(np.linalg.inv(sigma)), 2 * float(np.log(np.diag(factor)).sum())
    first, one = _inverse(sigma[:half, :half])
    slopes = first @ sigma[:half, half:]
    last, other = _inverse(sigma[half:, half:] - sigma[half:, :half] @ slopes)
    side = -slopes @ last
    return np.block([[first - side @ slopes.T, side], [side.T, last]]), one + other


def mean_squared_displacement(
    track: Displacements, lags: FloatArray, exponent: float
) -> FloatArray:
    """Mean-squared displacement of averages over exposures for D = 1, without what is constant.

    |t|^α averaged over two exposures is [(t+e)^(α+2) + |t−e|^(α+2) − 2 t^(α+2)]/[e² (α+1)(α+2)].
    """
    e = track.exposure_s / track.interval_s
    smooth = lags**exponent
    if e > 0:
        high = exponent + 2
        closed = (lags + e) ** high + np.abs(lags - e) ** high - 2 * lags**high
        closed /= e**2 * (exponent + 1) * high
        # An exposure this small a part of a lag blurs by a series; the closed form cancels
        far = lags * 1e-2 > e
        series = 1 + exponent * (exponent - 1) / 12 * (e / np.where(far, lags, 1.0)) ** 2
        smooth = np.where(far, smooth * series, closed)
    return np.asarray(2 * track.interval_s * (smooth - smooth[0]))


def covariance(lags: Lags, msd: FloatArray) -> FloatArray:
    """Covariance of displacements along an axis: −½ of the second difference of an MSD.

    Shapes: `msd` (m,), result (n − 1, n − 1).
    """
    pairs = msd[lags.which]
    twice = pairs[1:, :-1] + pairs[:-1, 1:]
    twice -= pairs[1:, 1:]
    twice -= pairs[:-1, :-1]
    return np.asarray(twice / 2)
