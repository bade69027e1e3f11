"""Estimates beside the bounds: bias, spread, coverage, pulls, each with its uncertainty.

Small pure functions on arrays; no trial is left out silently: callers choose the trials and report
how many they left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, chi2, norm

from iscat_analysis.errors import ConfigError
from iscat_analysis.records import BoolArray, FloatArray

MIN_TRIALS = 8
"""Fewer trials have no spread worth stating."""

_NOTHING = (math.nan, math.nan)

PULL_EDGES = np.linspace(-5, 5, 41)
"""Bins of the pull histograms; the outer ones take what lies beyond."""


@dataclass(frozen=True)
class Score:
    """One parameter of one mode, estimated again and again."""

    crb: float
    qcrb: float
    bias: float = math.nan
    bias_se: float = math.nan
    spread: float = math.nan
    spread_ci95: tuple[float, float] = _NOTHING
    spread_robust: float = math.nan
    spread_over_crb: float = math.nan
    spread_over_crb_ci95: tuple[float, float] = _NOTHING
    spread_over_qcrb: float = math.nan
    spread_over_qcrb_ci95: tuple[float, float] = _NOTHING
    coverage68: float = math.nan
    coverage68_ci95: tuple[float, float] = _NOTHING
    coverage95: float = math.nan
    coverage95_ci95: tuple[float, float] = _NOTHING
    pull_mean: float = math.nan
    pull_std: float = math.nan


def score(error: FloatArray, sigma: FloatArray, crb: float, qcrb: float) -> Score:
    """Set one parameter's estimates beside its bounds.

    Shapes: `error` (n,), `sigma` (n,).
    """
    kept = np.isfinite(error)
    error, sigma = error[kept], sigma[kept]
    n = error.size
    if n < MIN_TRIALS:
        return Score(crb, qcrb)
    spread = float(np.std(error, ddof=1))
    interval = spread_interval(error)
    over_crb, over_qcrb = (
        [_ratio(value, bound) for value in (spread, *interval)] for bound in (crb, qcrb)
    )
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
        spread_over_crb=over_crb[0],
        spread_over_crb_ci95=(over_crb[1], over_crb[2]),
        spread_over_qcrb=over_qcrb[0],
        spread_over_qcrb_ci95=(over_qcrb[1], over_qcrb[2]),
        coverage68=share(narrow),
        coverage68_ci95=share_interval(narrow),
        coverage95=share(wide),
        coverage95_ci95=share_interval(wide),
        pull_mean=float(np.mean(pull)) if pull.size else math.nan,
        pull_std=float(np.std(pull, ddof=1)) if pull.size > 1 else math.nan,
    )


def spread_error(error: FloatArray) -> float:
    """Relative standard error of a standard deviation.

    Shapes: `error` (n,).
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

    Shapes: `error` (n,).
    """
    spread = float(np.std(error, ddof=1))
    reach = float(norm.ppf(0.975)) * spread_error(error)
    if not math.isfinite(reach):
        return spread, spread
    return spread * math.exp(-reach), spread * math.exp(reach)


def share(inside: BoolArray) -> float:
    """Share of trials that something holds for.

    Shapes: `inside` (n,).
    """
    return float(np.mean(inside)) if inside.size else math.nan


def share_interval(inside: BoolArray) -> tuple[float, float]:
    """Give the 95 % interval of a share.

    Shapes: `inside` (n,).
    """
    n = inside.size
    if not n:
        return math.nan, math.nan
    found = binomtest(int(np.count_nonzero(inside)), n)
    low, high = found.proportion_ci(0.95, method="wilson")
    return float(low), float(high)


def pull_histogram(pull: FloatArray) -> dict[str, list[float]]:
    """Histogram of pulls beside the normal expectation.

    Shapes: `pull` (n,).
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

    Notes
    -----
    S. Talts et al., arXiv:1804.06788 (2018).

    Shapes: `ranks` (n,), `counts` (bins,).
    """
    if possible % bins:
        raise ConfigError(f"possible = {possible} ranks do not fall evenly into bins = {bins}")
    counts = np.bincount(np.asarray(ranks) // (possible // bins), minlength=bins).astype(float)
    expected = counts.sum() / bins
    statistic = float(np.sum((counts - expected) ** 2) / expected) if expected else 0.0
    return float(chi2.sf(statistic, bins - 1)), counts


def _ratio(value: float, bound: float) -> float:
    return value / bound if math.isfinite(bound) and bound > 0 else math.nan
