"""Documents of ``iscat benchmark``."""

from __future__ import annotations

from typing import Any

from iscat_analysis.schemas.base import (
    Convention,
    Count,
    Document,
    Emission,
    Interval,
    Natural,
    Number,
    Scheme,
    Share,
    key,
    maybe,
)


class Score(Document):
    """How one free parameter was estimated [nm or kDa]."""

    bias: Number = key("Mean of estimate minus truth")
    bias_se: Number = key("Its standard error")
    spread: Number = key("Standard deviation of the estimates")
    spread_ci95: Interval = key("Its 95 % confidence interval")
    spread_robust: Number = maybe("The same from the quartiles, which outliers do not touch")
    crb: Number = key("Joint Cramér–Rao bound")
    qcrb: Number = key("Quantum Cramér–Rao bound")
    spread_over_crb: Number = key("1 for an efficient estimator")
    spread_over_crb_ci95: Interval = key("Its 95 % confidence interval")
    spread_over_qcrb: Number = key("Distance to the quantum bound")
    spread_over_qcrb_ci95: Interval = maybe("Its 95 % confidence interval")
    coverage68: Share = key("Share of intervals of 1 σ that hold the truth")
    coverage68_ci95: Interval = key("Its 95 % confidence interval")
    coverage95: Share = key("Share of intervals of 1.96 σ that hold the truth")
    coverage95_ci95: Interval = key("Its 95 % confidence interval")
    pull_mean: Number = key("Mean of (estimate − truth)/σ")
    pull_std: Number = key("Its standard deviation, 1 where σ is right")
    posterior_coverage68: Number = maybe("Share of central 68 % intervals that hold the truth")
    posterior_coverage68_ci95: Interval = maybe("Its 95 % confidence interval")
    posterior_coverage95: Number = maybe("Share of central 95 % intervals that hold the truth")
    posterior_coverage95_ci95: Interval = maybe("Its 95 % confidence interval")
    posterior_width_over_crb: Number = maybe("Posterior standard deviation over the CRB")
    baselines: dict[str, dict[str, Any]] = maybe("The same of a Gaussian fit and of the peak")


class ModeStudy(Document):
    """One mode; its free parameters are keys."""

    x_nm: Score = key("Column")
    y_nm: Score = key("Row")
    z_nm: Score = maybe("Height, where it is free")
    mass_kda: Score = maybe("Mass, where it is free")
    trials: Natural = key("Repetitions")
    failed: Count = key("Repetitions without an estimate")
    flagged: dict[str, Count] = maybe("Repetitions by status")
    fits_per_second: Number = key("Per second of processor time")
    seed: int = key("Seed of this mode")
    at: dict[str, Any] = maybe("The experiment")


class Benchmark(Document):
    """What iscat benchmark prints and writes as benchmark.json."""

    mass: ModeStudy = key("Mode mass: bias, spread, bounds, coverage and pulls by parameter")
    localize: ModeStudy = key("Mode localize, likewise")
    joint: ModeStudy = key("Mode joint, likewise")
    curves: dict[str, Any] = maybe("Spread and bounds against photons and against height")
    histograms: dict[str, Any] = maybe("Pulls, and ranks of posteriors")
    trials: Natural = key("Repetitions in each mode")
    seed: int = key("Same seed, same numbers")
    scheme: Scheme = maybe("Optical scheme")
    emission: Emission = maybe("Emission model")
    convention: Convention = maybe("Formulas")
    command: str = key("The command line")
    config: str = key("The configuration, as TOML")
    versions: dict[str, str] = key("Of this program and the numerical libraries")
