"""Does the model describe the data?  Three tests of the residuals of one fit, and their verdict.

`scatter`
    Pearson's χ², two-sided: noise stronger or weaker than the camera's.  Cells that expect few
    counts are pooled, and the variance carries the fourth moment of the counts.
`structure`
    Rao's score test against smooth changes of the image around the particle, Hermite–Gauss modes up
    to `ORDER`: a wrong focus or aperture, a neighbour.  A few directions, so that a misfit
    that drowns in the χ² of a thousand pixels is seen.
`outlier`
    The least likely pixel, by the exact tail of its counts: a dead, hot or saturated one.

Each p-value is uniform on good data; `goodness_of_fit` joins them by Šidák's rule.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, gammainc, gammaincc, ndtr, pdtr, pdtrc

from iscat_analysis._kernels.score_test import score_statistic
from iscat_analysis._kernels.scoring import CONDITIONAL, FLOOR
from iscat_analysis.inference.likelihood import LEVEL, Likelihood

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ORDER = 6
"""Largest order of the modes: (ORDER + 1)(ORDER + 2)/2 = 28 directions."""

WAIST = 0.5
"""Waist of the modes over λ/NA; with `ORDER` they reach 2 λ/NA from the particle."""

POOLED_COUNTS = 5.0
"""Cells that expect fewer counts are joined until they expect as many."""

MANY_COUNTS = 1e6
"""Counts above which tails are normal: 5 σ out to a few per cent."""

_DARK = 1e-100  # expected light below which a pixel knows nothing of relative changes
_TESTS = 3
_NARROWEST = 0.1  # variance of a sum of squares over that of normal residuals, at least
_SUSPECTS = 8  # largest residuals whose exact tail is looked up
_DEPENDENT = 1e-8  # share of a mode outside the fitted directions that counts as none
_FINEST = 1e-11  # tail below which whole counts are not told from continuous ones


def goodness_of_fit(
    likelihood: Likelihood, theta: FloatArray, free: BoolArray
) -> tuple[float, float]:
    """Judge one fit.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    theta : ndarray, shape (5,)
        The estimate.
    free : ndarray of bool, shape (5,)
        Which parameters were fitted.

    Returns
    -------
    chi2_reduced : float
        χ² over its degrees of freedom; NaN without any.
    p_value : float
        Probability that good data look worse in any of the three tests; NaN without degrees of
        freedom.

    Notes
    -----
    Z. Šidák, J. Am. Stat. Assoc. 62, 626 (1967).
    """
    view = _look(likelihood, theta)
    chi2, spread_p = _scatter(view, free)
    if not math.isfinite(spread_p):
        return chi2, math.nan
    worst = min(spread_p, _structure(likelihood, theta, free, view), _outlier(view))
    return chi2, -math.expm1(_TESTS * math.log1p(-min(worst, 1 - 1e-16)))


def scatter(likelihood: Likelihood, theta: FloatArray, free: BoolArray) -> tuple[float, float]:
    """Pearson's χ² and its two-sided p-value.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    theta : ndarray, shape (5,)
        The estimate.
    free : ndarray of bool, shape (5,)
        Which parameters were fitted.

    Returns
    -------
    chi2_reduced, p_value : float
        NaN without degrees of freedom.

    Notes
    -----
    The squared residual of a count of excess kurtosis κ has variance 2 + κ; χ² follows a gamma law
    with that variance.
    """
    return _scatter(_look(likelihood, theta), free)


def structure(likelihood: Likelihood, theta: FloatArray, free: BoolArray) -> float:
    """Test for smooth changes of the image around the particle.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    theta : ndarray, shape (5,)
        The estimate.
    free : ndarray of bool, shape (5,)
        Which parameters were fitted.

    Returns
    -------
    float
        The p-value, uniform on good data.

    Notes
    -----
    A mode B multiplies the expected counts by 1 + ε B.  Its score, made independent of the fitted
    directions, is compared with its information (C. R. Rao, Proc. Camb. Phil. Soc. 44, 50, 1948).
    """
    return _structure(likelihood, theta, free, _look(likelihood, theta))


def outlier(likelihood: Likelihood, theta: FloatArray) -> float:
    """Test for the least likely pixel among all.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    theta : ndarray, shape (5,)
        The estimate.

    Returns
    -------
    float
        The p-value, two-sided, for as many pixels as there are.
    """
    return _outlier(_look(likelihood, theta))


@dataclass(frozen=True)
class _View:
    """Used pixels of one fit, each array of shape (n,) but the last two."""

    observed: FloatArray  # counts after landing
    rate: FloatArray  # their expectation
    total: FloatArray | None  # counts before and after; None unless conditional
    share: FloatArray  # of the variance that is not read noise; 1 where that is part of the rate
    residual: FloatArray  # in standard deviations
    weight: FloatArray  # root of the information on ln(intensity)
    relative: FloatArray  # d ln(intensity) / d signal
    gradient: FloatArray  # (4, n), of the signal
    used: BoolArray  # (ny, nx)


def _look(likelihood: Likelihood, theta: FloatArray) -> _View:
    place = (float(value) for value in theta[:4])
    signal, gradient = likelihood.model.amplitude_gradient(likelihood.grid, *place)
    conditional = likelihood.kind == CONDITIONAL
    used = likelihood.data[3 if conditional else 2] > 0
    c0, c1, c2, c3 = (c[used] for c in likelihood.data)
    level, s = math.exp(theta[LEVEL]), signal[used]
    if conditional:
        bright = np.maximum(1 + s, FLOOR)
        p = c2 * level * bright / (1 + c2 * level * bright)
        rate, total, share = c1 * p, c1, c3
        weight = np.sqrt(share * rate * (1 - p))
        residual = (c0 - rate) * share / np.maximum(weight, FLOOR)
        relative = 1 / bright
    else:
        # A background of read noise alone may be measured below zero.
        rate = np.maximum(level * (c1 + c2 * s) + c3, FLOOR)
        light = np.maximum(level * (c1 + c2 * s), FLOOR)
        total, share = None, np.ones(s.size)
        weight = light / np.sqrt(rate)
        residual = (c0 - rate) / np.sqrt(rate)
        relative = c2 * level / np.where(light > _DARK, light, math.inf)
    return _View(c0, rate, total, share, residual, weight, relative, gradient[:, used], used)


def _scatter(view: _View, free: BoolArray) -> tuple[float, float]:
    residual, kurtosis = _cells(view)
    freedom = residual.size - int(np.count_nonzero(free))
    if freedom <= 0:
        return math.nan, math.nan
    chi2 = float(np.sum(residual**2))
    above = _gamma_above(chi2, freedom, float(kurtosis.mean()))
    return chi2 / freedom, 2 * min(above, 1 - above)


def _gamma_above(chi2: float, freedom: float, excess: float) -> float:
    """Upper tail of a sum of squares of variance (2 + excess)·freedom."""
    spread = max(1 + excess / 2, _NARROWEST)
    return float(gammaincc(freedom / spread / 2, chi2 / spread / 2))


def _kurtosis(view: _View) -> FloatArray:
    """Excess kurtosis of each pixel's counts."""
    if view.total is None:
        return 1 / view.rate
    p = view.rate / view.total
    return view.share * (1 / np.maximum(view.rate * (1 - p), 1.0) - 6 / view.total)


def _cells(view: _View) -> tuple[FloatArray, FloatArray]:
    """Residuals in standard deviations and their excess kurtosis, cells of few counts pooled."""
    if view.total is not None:
        return view.residual, _kurtosis(view)
    rate, excess = view.rate, view.observed - view.rate
    few = rate < POOLED_COUNTS
    if np.any(few):
        order = np.argsort(-rate[few])
        bins = (np.cumsum(rate[few][order]) / POOLED_COUNTS).astype(int)
        pooled = (np.bincount(bins, v[few][order]) for v in (rate, excess))
        together, surplus = (np.asarray(v) for v in pooled)
        filled = together > 0
        rate = np.concatenate([rate[~few], together[filled]])
        excess = np.concatenate([excess[~few], surplus[filled]])
    return excess / np.sqrt(rate), 1 / rate


def _structure(likelihood: Likelihood, theta: FloatArray, free: BoolArray, view: _View) -> float:
    level = np.ones((1, view.rate.size))
    fitted = np.concatenate([view.gradient * view.relative, level])[np.asarray(free, dtype=bool)]
    modes = _modes(likelihood, theta)[:, view.used]
    vectors = np.concatenate([fitted, modes]) * view.weight
    leverage = np.empty(view.rate.size)
    chi2, freedom = score_statistic(vectors, len(fitted), view.residual, _DEPENDENT, leverage)
    if not freedom:
        return 1.0
    return _gamma_above(chi2, freedom, float(np.sum(_kurtosis(view) * leverage**2)) / freedom)


def _outlier(view: _View) -> float:
    suspects = np.argsort(-np.abs(view.residual))[:_SUSPECTS]
    least = min((_tail(view, int(i)) for i in suspects), default=1.0)
    if view.total is not None:
        return -math.expm1(view.rate.size * math.log1p(-min(least, 1 - 1e-16)))
    # counts are whole: what each pixel can attain below `least` is less than that
    below = _attainable(view.rate, least)
    return -math.expm1(float(np.sum(np.log1p(-np.minimum(below, 1 - 1e-16)))))


def _tail(view: _View, i: int) -> float:
    """Two-sided probability of a count as far out as pixel i's."""
    k, mean = float(view.observed[i]), float(view.rate[i])
    n = math.inf if view.total is None else float(view.total[i]) * float(view.share[i])
    variance = (
        mean if view.total is None else n * (mean / view.total[i]) * (1 - mean / view.total[i])
    )
    if variance > MANY_COUNTS:
        return float(2 * ndtr(-abs(view.residual[i])))
    if view.total is None:
        k = max(math.floor(k + 1e-9), 0)
        above = float(gammainc(k, mean)) if k > 0 else 1.0
        return min(1.0, 2 * min(above, float(gammaincc(k + 1, mean))))
    # read noise takes its share of the variance, as if that share of the counts were lost
    share, total = float(view.share[i]), float(view.total[i])
    n, p, k = share * total, mean / total, share * k
    above = float(betainc(k, n - k + 1, p)) if k > 0 else 1.0
    below = float(betainc(n - k, k + 1, 1 - p)) if k < n else 1.0
    return min(1.0, 2 * min(above, below))


def _attainable(rate: FloatArray, tail: float) -> FloatArray:
    """Probability that a Poisson count has a two-sided tail of at most `tail`, for each rate."""
    half = tail / 2
    if half < _FINEST or half >= 0.5:
        return np.full(rate.size, min(tail, 1.0))
    out = np.full(rate.size, tail)
    few = rate < MANY_COUNTS
    mean = rate[few]
    # Bernstein's and Chernoff's inequalities enclose the counts, halving finds them
    depth = -math.log(half)
    farthest = np.ceil(mean + depth / 3 + np.sqrt(depth**2 / 9 + 2 * mean * depth))
    least = np.maximum(np.floor(mean - np.sqrt(2 * mean * depth)) - 1, -1.0)
    limit = half * (1 + 1e-9)
    above = _first(lambda k: pdtrc(k, mean) <= limit, np.floor(mean) - 1, farthest)
    below = _first(lambda k: pdtr(k, mean) > limit, least, np.ceil(mean) + 1) - 1
    out[few] = pdtrc(above, mean) + np.where(below >= 0, pdtr(np.maximum(below, 0), mean), 0.0)
    return out


def _first(
    holds: Callable[[FloatArray], BoolArray], low: FloatArray, high: FloatArray
) -> FloatArray:
    """Find the smallest whole numbers above `low` for which something holds; at `high` it does."""
    while np.any(high - low > 1):
        middle = np.where(high - low > 1, np.floor((low + high) / 2), high)
        there = holds(middle)
        low, high = np.where(there, low, middle), np.where(there, middle, high)
    return high


def _modes(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Hermite–Gauss modes around the particle, shape (modes, ny, nx)."""
    optics, grid = likelihood.model.optics, likelihood.grid
    waist = WAIST * optics.wavelength_nm / optics.na
    along, across = (
        _hermite((axis - centre) / waist)
        for axis, centre in ((grid.x_nm, theta[0]), (grid.y_nm, theta[1]))
    )
    pairs = [(i, j) for i in range(ORDER + 1) for j in range(ORDER + 1 - i)]
    return np.stack([across[j][:, None] * along[i] for i, j in pairs])


def _hermite(t: FloatArray) -> FloatArray:
    """Hermite functions of order 0 to ORDER, shape (ORDER + 1, n), by their recurrence."""
    out = np.empty((ORDER + 1, t.size))
    out[0] = np.exp(-(t**2) / 2)
    out[1] = math.sqrt(2) * t * out[0]
    for n in range(2, ORDER + 1):
        out[n] = math.sqrt(2 / n) * t * out[n - 1] - math.sqrt((n - 1) / n) * out[n - 2]
    return out
