"""Does the model describe the data?  Three tests of the residuals of one fit, and their verdict.

scatter
    Pearson's χ², two-sided: noise stronger or weaker than the camera's.  Cells that expect few
    counts are pooled, and the variance carries the fourth moment of the counts.
structure
    Rao's score test against smooth changes of the image around the particle, Hermite–Gauss modes up
    to `ORDER`: a wrong focus or aperture, a neighbour.  A few directions, so that a misfit
    that drowns in the χ² of a thousand pixels is seen.
outlier
    The least likely pixel, by the exact tail of its counts: a dead, hot or saturated one.

Each p-value (`three_tests`) is uniform on good data; `goodness_of_fit` joins them by Šidák's rule.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincc

from iscat_analysis._kernels.goodness import count_and_test
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.noise_models import MANY_COUNTS

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ORDER = 6
"""Largest order of the modes: (ORDER + 1)(ORDER + 2)/2 = 28 directions."""

WAIST = 0.5
"""Waist of the modes over λ/NA; with `ORDER` they reach 2 λ/NA from the particle."""

POOLED_COUNTS = 5.0
"""Cells that expect fewer counts are joined until they expect as many."""

_LEAST_VARIANCE_RATIO = 0.1  # variance of a sum of squares over that of normal residuals, at least
_SUSPECTS = 8  # largest residuals whose exact tail is looked up
_DEPENDENT = 1e-8  # share of a mode outside the fitted directions that counts as none
_NORMAL = 1e-4  # excess kurtosis that changes no p-value


def goodness_of_fit(
    likelihood: Likelihood,
    theta: FloatArray,
    free: BoolArray,
    derivatives: FloatArray | None = None,
) -> tuple[float, float]:
    """Judge one fit.

    Notes
    -----
    Z. Šidák, J. Am. Stat. Assoc. 62, 626 (1967).

    Shapes: `theta` (5,), `free` (5,), `derivatives` (ny, ROWS, nx).
    """
    chi2, p_values = three_tests(likelihood, theta, free, derivatives)
    if math.isnan(p_values[0]):
        return chi2, math.nan
    return chi2, -math.expm1(len(p_values) * math.log1p(-min(*p_values, 1 - 1e-16)))


def three_tests(
    likelihood: Likelihood,
    theta: FloatArray,
    free: BoolArray,
    derivatives: FloatArray | None = None,
) -> tuple[float, tuple[float, float, float]]:
    """Test one fit for the scatter of its residuals, for structure in them, and for outliers.

    Notes
    -----
    The squared residual of a count of excess kurtosis κ has variance 2 + κ; χ² follows a gamma law
    with that variance.  A smooth mode B multiplies the expected counts by 1 + ε B.  Its score, made
    independent of the fitted directions, is compared with its information (C. R. Rao, Proc. Camb.
    Phil. Soc. 44, 50, 1948).

    Shapes: `theta` (5,), `free` (5,), `derivatives` (ny, ROWS, nx).
    """
    rows = likelihood.derivatives(theta) if derivatives is None else derivatives
    free = np.asarray(free, dtype=np.bool_)
    optics, grid = likelihood.model.optics, likelihood.grid
    rate, tails = np.empty(grid.shape), np.empty((3, _SUSPECTS))
    chi2, pixels, excess, least_rate, mode_chi2, modes, mode_excess, least, count = count_and_test(
        likelihood.noise.code, likelihood.data, math.exp(theta[LEVEL]), rows, grid.x_nm, grid.y_nm,
        theta, WAIST * optics.wavelength_nm / optics.na, ORDER, free, _DEPENDENT, _NORMAL,
        MANY_COUNTS, rate, tails,
    )  # fmt: skip
    cells = pixels
    if likelihood.noise.pools_few and least_rate < POOLED_COUNTS:
        residual, kurtosis = _pooled(likelihood, rate)
        chi2, cells, excess = float(residual @ residual), residual.size, float(kurtosis.sum())
    freedom = cells - int(np.count_nonzero(free))
    if freedom <= 0:
        return math.nan, (math.nan, math.nan, math.nan)
    above = _gamma_above(chi2, freedom, excess / cells)
    structure = _gamma_above(mode_chi2, modes, mode_excess) if modes else 1.0
    if count:
        least = min(least, 2 * float(likelihood.noise.tails(*tails[:, :count]).min()))
    outlier = likelihood.noise.least_of_all(rate[likelihood.used], least)
    return chi2 / freedom, (2 * min(above, 1 - above), structure, outlier)


def _gamma_above(chi2: float, freedom: float, excess: float) -> float:
    """Upper tail of a sum of squares of variance (2 + excess)·freedom."""
    spread = max(1 + excess / 2, _LEAST_VARIANCE_RATIO)
    return float(gammaincc(freedom / spread / 2, chi2 / spread / 2))


def _pooled(likelihood: Likelihood, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals in standard deviations and their excess kurtosis, cells of few counts pooled."""
    used = likelihood.used
    rate = rate[used]
    few = rate < POOLED_COUNTS
    excess = likelihood.data[0][used] - rate
    order = np.argsort(-rate[few])
    bins = (np.cumsum(rate[few][order]) / POOLED_COUNTS).astype(int)
    pooled = (np.bincount(bins, v[few][order]) for v in (rate, excess))
    together, surplus = (np.asarray(v) for v in pooled)
    filled = together > 0
    rate = np.concatenate([rate[~few], together[filled]])
    excess = np.concatenate([excess[~few], surplus[filled]])
    return excess / np.sqrt(rate), 1 / rate
