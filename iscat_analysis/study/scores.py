"""Estimates beside the bounds: bias, spread, coverage, pulls, each with its uncertainty.

Small pure functions on arrays; no trial is left out silently: callers choose the trials and report
how many they left out.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2, norm

from iscat_analysis.errors import ConfigError
from iscat_analysis.records import BoolArray, FloatArray

MIN_TRIALS = 8
"""Fewer trials have no spread worth stating."""

PULL_EDGES = np.linspace(-5, 5, 41)
"""Bins of the pull histograms; the outer ones take what lies beyond."""


@dataclass(frozen=True)
class Score:
    """One parameter of one mode, estimated again and again.

    Attributes
    ----------
    bias, bias_se : float
        Mean error and its standard error.
    spread : float
        Standard deviation of the estimates.
    spread_ci95 : (float, float)
        Its 95 % confidence interval, see `spread_interval`.
    spread_robust : float
        From the quartiles, for a normal distribution.
    crb, qcrb : float
        Joint Cramér–Rao bound over the free parameters, and quantum bound for the collected light.
    spread_over_crb, spread_over_qcrb : float
        Ratios.
    spread_over_crb_ci95, spread_over_qcrb_ci95 : (float, float)
        Their intervals.
    coverage68, coverage95 : float
        Share of trials whose truth lies within 1 and 1.96 stated σ; 68.3 % and 95 % if σ is right.
    coverage68_ci95, coverage95_ci95 : (float, float)
        Their intervals, see `share_interval`.
    pull_mean, pull_std : float
        Of (estimate − truth)/σ.
    """

    bias: float
    bias_se: float
    spread: float
    spread_ci95: tuple[float, float]
    spread_robust: float
    crb: float
    qcrb: float
    spread_over_crb: float
    spread_over_crb_ci95: tuple[float, float]
    spread_over_qcrb: float
    spread_over_qcrb_ci95: tuple[float, float]
    coverage68: float
    coverage68_ci95: tuple[float, float]
    coverage95: float
    coverage95_ci95: tuple[float, float]
    pull_mean: float
    pull_std: float

    def plain(self) -> dict[str, Any]:
        """As nested plain values, for JSON."""
        return asdict(self)


def score(error: FloatArray, sigma: FloatArray, crb: float, qcrb: float) -> Score:
    """Set one parameter's estimates beside its bounds.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Estimate minus truth; NaN is left out.
    sigma : ndarray, shape (n,)
        Stated standard deviations; NaN where the estimator states none.
    crb, qcrb : float
        Bounds, in the same unit.

    Returns
    -------
    Score
        NaN throughout for fewer than `MIN_TRIALS` trials.
    """
    kept = np.isfinite(error)
    error, sigma = error[kept], sigma[kept]
    n = error.size
    if n < MIN_TRIALS:
        nothing, none = math.nan, (math.nan, math.nan)
        return Score(
            nothing, nothing, nothing, none, nothing, crb, qcrb, nothing, none, nothing, none,
            nothing, none, nothing, none, nothing, nothing,
        )  # fmt: skip
    spread = float(np.std(error, ddof=1))
    interval = spread_interval(error)
    quartiles = np.quantile(error, [0.25, 0.75])
    pull = (error / sigma)[np.isfinite(sigma)]
    narrow, wide = (np.abs(pull) < k for k in (1.0, float(norm.ppf(0.975))))
    return Score(
        bias=float(np.mean(error)),
        bias_se=spread / math.sqrt(n),
        spread=spread,
        spread_ci95=interval,
        spread_robust=float((quartiles[1] - quartiles[0]) / (2 * norm.ppf(0.75))),
        crb=crb,
        qcrb=qcrb,
        spread_over_crb=_ratio(spread, crb),
        spread_over_crb_ci95=(_ratio(interval[0], crb), _ratio(interval[1], crb)),
        spread_over_qcrb=_ratio(spread, qcrb),
        spread_over_qcrb_ci95=(_ratio(interval[0], qcrb), _ratio(interval[1], qcrb)),
        coverage68=share(narrow),
        coverage68_ci95=share_interval(narrow),
        coverage95=share(wide),
        coverage95_ci95=share_interval(wide),
        pull_mean=float(np.mean(pull)) if pull.size else math.nan,
        pull_std=float(np.std(pull, ddof=1)) if pull.size > 1 else math.nan,
    )


def spread_error(error: FloatArray) -> float:
    """Relative standard error of a standard deviation.

    Parameters
    ----------
    error : ndarray, shape (n,)
        A sample of any distribution with a fourth moment.

    Returns
    -------
    float
        √[(κ − 1)/4n] with κ the sample's unbiased kurtosis; 1/√(2n) for a normal distribution.
    """
    n = error.size
    centred = error - np.mean(error)
    second = float(np.mean(centred**2))
    if second == 0 or n < MIN_TRIALS:
        return math.nan
    excess = float(np.mean(centred**4)) / second**2 - 3
    unbiased = (n - 1) / ((n - 2) * (n - 3)) * ((n + 1) * excess + 6)
    return math.sqrt(max(2 + unbiased, 0.1) / (4 * (n - 1)))


def spread_interval(error: FloatArray) -> tuple[float, float]:
    """Give the 95 % interval of a standard deviation.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Sample.

    Returns
    -------
    low, high : float
        Symmetric in the logarithm, with the sample's own kurtosis in place of the normal one
        (D. G. Bonett, Comput. Stat. Data Anal. 50, 775, 2006).
    """
    spread = float(np.std(error, ddof=1))
    reach = float(norm.ppf(0.975)) * spread_error(error)
    if not math.isfinite(reach):
        return spread, spread
    return spread * math.exp(-reach), spread * math.exp(reach)


def share(inside: BoolArray) -> float:
    """Share of trials that something holds for.

    Parameters
    ----------
    inside : ndarray of bool, shape (n,)
        For which it holds.

    Returns
    -------
    float
        NaN without trials.
    """
    return float(np.mean(inside)) if inside.size else math.nan


def share_interval(inside: BoolArray) -> tuple[float, float]:
    """Give the 95 % interval of a share.

    Parameters
    ----------
    inside : ndarray of bool, shape (n,)
        For which trials it holds.

    Returns
    -------
    low, high : float
        Of the score test, which is right for few trials too and stays within 0 and 1
        (E. B. Wilson, J. Am. Stat. Assoc. 22, 209, 1927); NaN without trials.
    """
    n = inside.size
    if not n:
        return math.nan, math.nan
    found = binomtest(int(np.count_nonzero(inside)), n)
    low, high = found.proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def pull_histogram(pull: FloatArray) -> dict[str, list[float]]:
    """Histogram of pulls beside the normal expectation.

    Parameters
    ----------
    pull : ndarray, shape (n,)
        (estimate − truth)/σ; NaN is left out.

    Returns
    -------
    dict
        ``edges``, ``counts``, ``expected``.
    """
    finite = pull[np.isfinite(pull)]
    counts = np.histogram(np.clip(finite, PULL_EDGES[0], PULL_EDGES[-1]), PULL_EDGES)[0]
    within = norm.cdf(PULL_EDGES)
    within[0], within[-1] = 0.0, 1.0
    return {
        "edges": PULL_EDGES.tolist(),
        "counts": counts.tolist(),
        "expected": (finite.size * np.diff(within)).tolist(),
    }


def rank_test(ranks: NDArray[np.int64], possible: int, bins: int = 20) -> tuple[float, FloatArray]:
    """Test whether ranks are uniform.

    Parameters
    ----------
    ranks : ndarray of int, shape (n,)
        0 … possible − 1.
    possible : int
        Number of possible ranks, a multiple of `bins`.
    bins : int
        Cells of the χ² test.

    Returns
    -------
    p_value : float
        Of Pearson's χ² for equal cells.
    counts : ndarray, shape (bins,)
        Ranks in each cell.

    Raises
    ------
    ConfigError
        `possible` is not a multiple of `bins`.

    Notes
    -----
    S. Talts et al., arXiv:1804.06788 (2018).
    """
    if possible % bins:
        raise ConfigError(f"possible = {possible} ranks do not fall evenly into bins = {bins}")
    counts = np.bincount(np.asarray(ranks) // (possible // bins), minlength=bins).astype(float)
    expected = counts.sum() / bins
    statistic = float(np.sum((counts - expected) ** 2) / expected) if expected else 0.0
    return float(chi2.sf(statistic, bins - 1)), counts


def _ratio(value: float, bound: float) -> float:
    return value / bound if math.isfinite(bound) and bound > 0 else math.nan
