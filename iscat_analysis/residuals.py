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

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr, bdtrc, chdtrc, gammainc, gammaincc
from scipy.stats import gamma

from iscat_analysis._kernels.scoring import CONDITIONAL
from iscat_analysis.likelihood import LEVEL, Likelihood

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ORDER = 6
"""Largest order of the modes: (ORDER + 1)(ORDER + 2)/2 = 28 directions."""

WAIST = 0.5
"""Waist of the modes over λ/NA; with `ORDER` they reach 2 λ/NA from the particle."""

POOLED_COUNTS = 5.0
"""Cells that expect fewer counts are joined until they expect as many."""

_TESTS = 3
_SUSPECTS = 8  # largest residuals whose exact tail is looked up
_DEPENDENT = 1e-9  # share of a mode outside the fitted directions that counts as none


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
    chi2, spread_p = scatter(likelihood, theta, free)
    if not math.isfinite(spread_p):
        return chi2, math.nan
    worst = min(spread_p, structure(likelihood, theta, free), outlier(likelihood, theta))
    return chi2, -math.expm1(_TESTS * math.log1p(-min(worst, 1 - 1e-16)))


def scatter(likelihood: Likelihood, theta: FloatArray, free: BoolArray) -> tuple[float, float]:
    """Pearson's χ² and its two-sided p-value.

    Parameters
    ----------
    likelihood, theta, free
        As in `goodness_of_fit`.

    Returns
    -------
    chi2_reduced, p_value : float
        NaN without degrees of freedom.

    Notes
    -----
    The squared residual of a count of variance v and excess kurtosis κ has variance 2 + κ; χ²
    follows a gamma law with that variance.
    """
    residual, kurtosis = _cells(likelihood, theta)
    freedom = residual.size - int(np.count_nonzero(free))
    if freedom <= 0:
        return math.nan, math.nan
    chi2 = float(residual @ residual)
    variance = (2.0 + float(kurtosis.mean())) * freedom
    law = gamma(2 * freedom**2 / variance / 2, scale=variance / freedom)
    return chi2 / freedom, float(min(1.0, 2 * min(law.sf(chi2), law.cdf(chi2))))


def structure(likelihood: Likelihood, theta: FloatArray, free: BoolArray) -> float:
    """p-value of the score test against smooth changes of the image.

    Parameters
    ----------
    likelihood, theta, free
        As in `goodness_of_fit`.

    Returns
    -------
    float
        1 where the fitted directions leave none to test.

    Notes
    -----
    A mode B multiplies the expected counts by 1 + ε B.  Its score, made independent of the fitted
    directions, is compared with its information (C. R. Rao, Proc. Camb. Phil. Soc. 44, 50, 1948).
    """
    weight, relative = _whitening(likelihood, theta)
    used = weight > 0
    modes = _modes(likelihood, theta)[:, used] * weight[used]
    signal, gradient = likelihood.model.gradient(
        likelihood.grid, *theta[:3], float(likelihood.model.scale.mass(theta[3]))
    )
    del signal
    directions = np.concatenate([gradient * relative, np.ones((1, *weight.shape))])
    fitted = directions[np.asarray(free, dtype=bool)][:, used] * weight[used]
    residual = likelihood.residuals(theta)[used]
    size = np.linalg.norm(fitted, axis=1)
    basis, _ = np.linalg.qr((fitted[size > 0] / size[size > 0, None]).T)
    modes = modes / np.linalg.norm(modes, axis=1)[:, None]
    modes = modes - (modes @ basis) @ basis.T
    values, vectors = np.linalg.eigh(modes @ modes.T)
    kept = values > _DEPENDENT * values[-1]
    score = vectors[:, kept].T @ (modes @ residual)
    return float(chdtrc(int(kept.sum()), float(np.sum(score**2 / values[kept]))))


def outlier(likelihood: Likelihood, theta: FloatArray) -> float:
    """p-value of the least likely pixel among all.

    Parameters
    ----------
    likelihood, theta
        As in `goodness_of_fit`.

    Returns
    -------
    float
        Two-sided, for as many pixels as there are.
    """
    residual = np.nan_to_num(likelihood.residuals(theta))
    suspects = np.argsort(-np.abs(residual), axis=None)[:_SUSPECTS]
    count, tail = likelihood.n_pixels, 1.0
    rate, trials = _expected(likelihood, theta)
    observed = likelihood.data[0]
    for i in suspects:
        k, mean = math.floor(observed.flat[i] + 1e-9), rate.flat[i]
        if not _conditional(likelihood):
            above = float(gammainc(k, mean)) if k > 0 else 1.0
            below = float(gammaincc(k + 1, mean))
        else:
            # read noise takes its share of the variance, as if that share of the counts were lost
            share = likelihood.data[3].flat[i]
            n = round(share * trials.flat[i])
            k = min(round(share * observed.flat[i]), n)
            p = mean / trials.flat[i]
            above = float(bdtrc(k - 1, n, p)) if k > 0 else 1.0
            below = float(bdtr(k, n, p))
        tail = min(tail, 2 * min(above, below))
    return -math.expm1(count * math.log1p(-min(max(tail, 0.0), 1 - 1e-16)))


def _conditional(likelihood: Likelihood) -> bool:
    return likelihood.kind == CONDITIONAL


def _expected(likelihood: Likelihood, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Expected counts after landing, and the total they are a part of (conditional only)."""
    level = math.exp(theta[LEVEL])
    signal = likelihood.signal(theta)
    c0, c1, c2, c3 = likelihood.data
    del c0
    if _conditional(likelihood):
        q = c2 * level * (1 + signal)
        return c1 * q / (1 + q), c1
    return level * (c1 + c2 * signal) + c3, c1


def _cells(likelihood: Likelihood, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals in standard deviations and their excess kurtosis, cells of few counts pooled."""
    residual = likelihood.residuals(theta)
    used = np.isfinite(residual)
    rate, total = _expected(likelihood, theta)
    rate = rate[used]
    if _conditional(likelihood):
        p = rate / total[used]
        return residual[used], (1 - 6 * p * (1 - p)) / np.maximum(rate * (1 - p), 1.0)
    excess = likelihood.data[0][used] - rate
    few = rate < POOLED_COUNTS
    if np.any(few):
        order = np.argsort(rate[few])[::-1]
        sums = np.cumsum(rate[few][order])
        bins = (sums / POOLED_COUNTS).astype(int)
        pooled_rate = np.bincount(bins, rate[few][order])
        pooled = np.bincount(bins, excess[few][order])
        filled = pooled_rate > 0
        rate = np.concatenate([rate[~few], pooled_rate[filled]])
        excess = np.concatenate([excess[~few], pooled[filled]])
    return excess / np.sqrt(rate), 1 / rate


def _whitening(likelihood: Likelihood, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Root of each pixel's information on ln(intensity), and d ln(intensity)/d signal."""
    rate, total = _expected(likelihood, theta)
    signal = likelihood.signal(theta)
    c1, c2, c3 = likelihood.data[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        if _conditional(likelihood):
            weight = np.sqrt(c3 * rate * (1 - rate / total))
            relative = 1 / (1 + signal)
        else:
            light = rate - c3
            weight = light / np.sqrt(rate)
            relative = c2 * math.exp(theta[LEVEL]) / light
    usable = np.isfinite(likelihood.residuals(theta)) & np.isfinite(weight) & np.isfinite(relative)
    return np.where(usable, weight, 0.0), np.where(usable, relative, 0.0)


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
