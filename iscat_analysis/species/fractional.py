"""Fractional Brownian motion: the likelihood of D and of an exponent α together, and its maximum.

Displacements have the covariance Σ = E + M, E that of the errors, with three bands, and
M = D·C(α), full.  With W = Σ⁻¹, z = W d and Σ_a, Σ_ab the derivatives with respect to ln D and α

    ∂_a ℓ = ½ [z·Σ_a z − tr WΣ_a],      I_ab = ½ tr WΣ_aWΣ_b  (Fisher's information),
    −∂_ab ℓ = Σ_a z·WΣ_b z − I_ab − ½ [z·Σ_ab z − tr WΣ_ab],

so that W and one product, C'W, tell everything: M W is 1 − E W, and E has three bands.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.records import FloatArray
from iscat_analysis.species.displacements import Displacements

_EXPONENTS = (0.02, 1.98)
_LN_D = 20.0  # from ln D of free diffusion at most
# An exposure this small a part of a lag blurs by a series; the closed form cancels
_SHORT_EXPOSURE = 1e-2
_EXPONENT_STEP = 1e-3  # of an exponent, for the derivatives of the mean-squared displacement
_LAST_STEP_SIGMAS = 0.1  # standard errors: of a step of Newton's method that is the last one
_NO_STEP = 1e-6  # of ln D and α
_MOST_STEPS = 50  # steps
_MOST_ROWS_DIRECT = 80  # rows of a matrix that is not halved to be inverted


class Fractional(NamedTuple):
    """Fractional Brownian motion of highest likelihood."""

    value: float
    d_nm2_s: float
    exponent: float
    sigma_exponent: float


class _There(NamedTuple):
    """Log-likelihood at (ln D, α), its slope, minus its curvature, and the Fisher information."""

    value: float
    slope: FloatArray
    curvature: FloatArray
    information: FloatArray


class Lags(NamedTuple):
    """All time differences between frames, in frames, and the index of the one of each pair."""

    distinct: FloatArray
    which: NDArray[np.int64]

    @classmethod
    def of(cls, track: Displacements) -> Lags:
        """Collect those of a track."""
        pairs = np.abs(np.subtract.outer(track.frames, track.frames))
        longest = int(pairs[0, -1])
        if longest < pairs.size:  # few gaps or none: all lags up to the longest
            return cls(np.arange(longest + 1.0), pairs)
        distinct, which = np.unique(pairs, return_inverse=True)
        return cls(distinct.astype(float), which.reshape(pairs.shape))


def most_likely_power(track: Displacements, free: float) -> Fractional:
    """Maximise the likelihood of D and α by Newton's method."""
    lags = Lags.of(track)
    at = np.array([math.log(free), 1.0])
    low, high = np.array([at[0] - _LN_D, _EXPONENTS[0]]), np.array([at[0] + _LN_D, _EXPONENTS[1]])
    here = _likelihood(track, lags, free, 1.0)
    if not math.isfinite(here.value):
        return Fractional(here.value, free, 1.0, math.nan)
    for _ in range(_MOST_STEPS):
        step, gain = _newton(here, low - at, high - at)
        if 2 * gain < _LAST_STEP_SIGMAS**2:
            break
        there = _likelihood(track, lags, *_powers(at + step))
        while not there.value > here.value and np.abs(step).max() > _NO_STEP:
            step /= 2
            there = _likelihood(track, lags, *_powers(at + step))
        if not there.value > here.value:  # rounding is all that is left
            step, gain = np.zeros(2), 0.0
            break
        at, here = at + step, there
    sigma = math.sqrt(float(np.linalg.inv(here.information)[1, 1]))
    return Fractional(here.value + gain, *_powers(at + step), sigma)


def _powers(at: FloatArray) -> tuple[float, float]:
    """Give D and α, from ln D and α."""
    return math.exp(at[0]), float(at[1])


def _newton(here: _There, least: FloatArray, most: FloatArray) -> tuple[FloatArray, float]:
    """Newton step inside a range, and the expected gain of the likelihood."""
    curvature = here.curvature
    if not (curvature[1, 1] > 0 and np.linalg.det(curvature) > 0):
        curvature = here.information
    alpha = float(np.clip(np.linalg.solve(curvature, here.slope)[1], least[1], most[1]))
    ln_d = (here.slope[0] - curvature[0, 1] * alpha) / curvature[0, 0]
    step: FloatArray = np.array([float(np.clip(ln_d, least[0], most[0])), alpha])
    return step, float(here.slope @ step - step @ curvature @ step / 2)


def _likelihood(track: Displacements, lags: Lags, d: float, exponent: float) -> _There:
    """Log-likelihood of fractional Brownian motion, all axes; −∞ where rounding spoils it."""
    before, there, after = (
        d * _msd(track, lags.distinct, power)
        for power in exponent + _EXPONENT_STEP * np.arange(-1, 2)
    )
    motion = covariance(lags, there)
    turn = covariance(lags, (after - before) / (2 * _EXPONENT_STEP))
    motion_curvature = covariance(lags, (after - 2 * there + before) / _EXPONENT_STEP**2)
    n = len(motion)
    value, slope = -0.5 * track.steps_nm.size * math.log(2 * math.pi), np.zeros(2)
    curvature, information = np.zeros((2, 2)), np.zeros((2, 2))
    for main, off_diagonal, steps in zip(*track.error, track.steps_nm, strict=True):
        sigma = motion.copy()
        flat = sigma.reshape(n * n)
        flat[:: n + 1] += main
        flat[1 :: n + 1] += off_diagonal
        flat[n :: n + 1] += off_diagonal
        try:
            inverse, log_determinant = _inverse(sigma)
        except np.linalg.LinAlgError:
            return _There(-math.inf, slope, curvature, information)
        value -= log_determinant / 2
        z = inverse @ steps
        value -= float(steps @ z) / 2
        by_d = -main[:, None] * inverse  # Σ_a W
        by_d[1:] -= off_diagonal[:, None] * inverse[:-1]
        by_d[:-1] -= off_diagonal[:, None] * inverse[1:]
        by_d.reshape(n * n)[:: n + 1] += 1
        by_alpha = turn @ inverse
        force = np.array([by_d @ steps, by_alpha @ steps])  # Σ_a z
        trace = np.array([np.trace(by_d), np.trace(by_alpha)])
        slope += (force @ z - trace) / 2
        fisher = np.empty((2, 2))
        fisher[0, 0], fisher[1, 1] = (np.einsum("ij,ji", by, by) / 2 for by in (by_d, by_alpha))
        fisher[0, 1] = fisher[1, 0] = np.einsum("ij,ji", by_d, by_alpha) / 2
        second = np.empty((2, 2))  # z·Σ_ab z − tr WΣ_ab
        second[0] = second[:, 0] = force @ z - trace
        second[1, 1] = z @ motion_curvature @ z - np.einsum("ij,ij", inverse, motion_curvature)
        curvature += force @ inverse @ force.T - fisher - second / 2
        information += fisher
    return _There(value, slope, curvature, information)


def _inverse(sigma: FloatArray) -> tuple[FloatArray, float]:
    """Invert a covariance by halves, and compute the logarithm of its determinant.

    This needs little but matrix products.  These release other threads, which LAPACK's inverse, as
    SciPy calls it, does not.
    """
    n = len(sigma)
    if n <= _MOST_ROWS_DIRECT:
        factor = np.linalg.cholesky(sigma)
        out = np.asarray(np.linalg.inv(sigma), dtype=np.float64)
        return out, 2 * float(np.log(np.diag(factor)).sum())
    half = n // 2
    first, one = _inverse(sigma[:half, :half])
    slopes = first @ sigma[:half, half:]
    last, other = _inverse(sigma[half:, half:] - sigma[half:, :half] @ slopes)
    out = np.empty_like(sigma)
    out[half:, half:] = last
    np.negative(slopes @ last, out=out[:half, half:])
    out[half:, :half] = out[:half, half:].T
    np.subtract(first, out[:half, half:] @ slopes.T, out=out[:half, :half])
    return out, one + other


def _msd(track: Displacements, lags: FloatArray, exponent: float) -> FloatArray:
    """Mean-squared displacement of averages over exposures for D = 1, without what is constant.

    |t|^α averaged over two exposures is [(t+e)^(α+2) + |t−e|^(α+2) − 2 t^(α+2)]/[e² (α+1)(α+2)].
    """
    e = track.exposure_s / track.interval_s
    smooth = lags**exponent
    if e > 0:
        high = exponent + 2
        closed = (lags + e) ** high + np.abs(lags - e) ** high - 2 * lags**high
        closed /= e**2 * (exponent + 1) * high
        far = lags * _SHORT_EXPOSURE > e
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
