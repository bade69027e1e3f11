"""Documents of ``iscat benchmark``."""

from __future__ import annotations

from typing import Any

from iscat_analysis.schemas.base import (
    Convention,
    Count,
    Document,
    Emission,
    Ends,
    Error,
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
    bias_se: Error
    spread: Number = key("Standard deviation of the estimates")
    spread_ci95: Ends
    spread_robust: Number = maybe("The same from the quartiles, which outliers do not touch")
    crb: Number = key("Joint Cramér–Rao bound")
    qcrb: Number = key("Quantum Cramér–Rao bound")
    spread_over_crb: Number = key("1 for an efficient estimator")
    spread_over_crb_ci95: Ends
    spread_over_qcrb: Number = key("Distance to the quantum bound")
    spread_over_qcrb_ci95: Interval = maybe("Its 95 % confidence interval")
    coverage68: Share = key("Share of intervals of 1 σ that hold the truth")
    coverage68_ci95: Ends
    coverage95: Share = key("Share of intervals of 1.96 σ that hold the truth")
    coverage95_ci95: Ends
    pull_mean: Number = key("Mean of (estimate − truth)/σ")
    pull_std: Number = key("Its standard deviation, 1 where σ is right")
    posterior_coverage68: Number = maybe("Share of central 68 % intervals that hold the truth")
    posterior_coverage68_ci95: Interval = maybe("Its 95 % confidence interval")
    posterior_coverage95: Number = maybe("Share of central 95 % intervals that hold the truth")
    posterior_coverage95_ci95: Interval = maybe("Its 95 % confidence interval")
    posterior_width_over_crb: Number = maybe("Posterior standard deviation over the CRB")
    baselines: dict[str, dict[str, Any]] = maybe("The same of a Gaussian fit and of the peak")


class EstimatorScore(Document):
    """How an estimator found one parameter [nm or kDa]; each statistic also with `_ci95`."""

    answered: Count = key("Particles with an estimate")
    failed: Count = key("Particles without")
    crb: Number = key("Joint Cramér–Rao bound, root mean square over the particles")
    qcrb: Number = key("Quantum Cramér–Rao bound")
    holevo: Number = key("Holevo bound: one measurement for all free parameters")
    bias: Number = maybe("Mean of estimate minus truth")
    bias_se: Number = maybe("Its standard error")
    spread: Number = maybe("Standard deviation about the line of error against truth")
    rmse: Number = maybe("Root mean square error")
    spread_over_crb: Number = maybe("1 for an efficient estimator without bias")
    spread_over_qcrb: Number = maybe("Distance to the quantum bound")
    spread_over_holevo: Number = maybe("Distance to the Holevo bound")
    efficiency_crb: Number = maybe("CRB² over the mean square error")
    efficiency_qcrb: Number = maybe("QCRB² over the mean square error")
    efficiency_holevo: Number = maybe("Holevo² over the mean square error")
    bias_gradient: Number = maybe("Slope of the bias along the parameter itself")
    biased_bound_over_crb: Number = maybe("Bound of an estimator with these gradients, over CRB")
    spread_over_biased_bound: Number = maybe("Less than 1 is impossible from the counts alone")
    pull_mean: Number = maybe("Mean of (estimate − truth)/σ")
    pull_std: Number = maybe("Its standard deviation, 1 where σ is right")
    coverage68: Number = maybe("Share of intervals of 1 σ that hold the truth")
    coverage95: Number = maybe("Share of intervals of 1.96 σ that hold the truth")
    below_bound: bool = maybe("Whether the spread is below its own bound by more than chance")
    verdict: str = key("What a reader must know before the numbers are believed; mostly empty")


class EstimatorEntry(Document):
    """One estimator in one mode, or one table of results in one part of a challenge."""

    x_nm: EstimatorScore = maybe("Column")
    y_nm: EstimatorScore = maybe("Row")
    z_nm: EstimatorScore = maybe("Height")
    mass_kda: EstimatorScore = maybe("Mass")
    trials: Natural = key("Particles")
    failed: Count = key("Particles without an answer")
    failures: dict[str, Count] = maybe("The same by what went wrong")
    seconds_per_fit: Number = maybe("Clock, for one particle")
    processor_seconds_per_fit: Number = maybe("Of processors")
    peak_mb: Number = maybe("Most memory of its process [MB]")
    false_alarms: Count = maybe("Results that are of no particle")
    false_alarms_per_movie: Number = maybe("At which recall is stated")
    recall: list[dict[str, Any]] = maybe("By mass, beside the matched filter's")
    notes: list[str] = maybe("How columns were understood")


class Ranked(Document):
    """A place in the ranking."""

    estimator: str = key("Name")
    kept: Number = key("Efficiency times the share answered, mean over parameters")
    below_bound: bool = key("Whether it knew more than the counts, and is not ranked")


class ChallengePart(Document):
    """Particles of one kind."""

    kind: str = key("stacks, movie, or table")
    mode: str = key("What was free")
    about: str = key("In words")
    trials: Natural = key("Particles")
    collected: Number = key("Scattered photons of one particle, mean")
    bounds: dict[str, dict[str, Number]] = key("By parameter [nm, kDa]")
    estimators: dict[str, EstimatorEntry] = key("By name")
    paired: dict[str, Any] = key("Ratios of mean square errors on the same counts")


class Challenge(Document):
    """What iscat challenge score writes, and iscat benchmark --truth --results."""

    title: str = key("Of the page")
    challenge: dict[str, Any] | None = maybe("Name, version, hashes")
    results_sha256: dict[str, str] = key("Of every table that was scored")
    parts: dict[str, ChallengePart] = key("By name")
    ranking: list[Ranked] = key("Best first")
    table_1: list[dict[str, Any]] = maybe("Table 1 of Dong et al. (2021) with achieved numbers")
    seed: int = key("Of the bootstrap")
    command: str = key("The command line")
    versions: dict[str, str] = key("Of this program and the numerical libraries")


class ModeStudy(Document):
    """One mode; its free parameters are keys."""

    x_nm: Score = key("Column")
    y_nm: Score = key("Row")
    z_nm: Score = maybe("Height, where it is free")
    mass_kda: Score = maybe("Mass, where it is free")
    diameter_nm: Score = maybe("Diameter of a sphere, where it is free")
    trials: Natural = key("Repetitions")
    failed: Count = key("Repetitions without an estimate")
    flagged: dict[str, Count] = maybe("Repetitions by status")
    fits_per_second: Number = key("Per second of processor time")
    seed: int = key("Seed of this mode")
    at: dict[str, Any] = maybe("The experiment")


class Benchmark(Document):
    """What iscat benchmark prints and writes as benchmark.json."""

    mass: ModeStudy = maybe("Mode mass: bias, spread, bounds, coverage and pulls by parameter")
    size: ModeStudy = maybe("Mode size, likewise; of spheres, which have this in place of mass")
    localize: ModeStudy = key("Mode localize, likewise")
    joint: ModeStudy = maybe("Mode joint, likewise; not of spheres")
    estimators: dict[str, dict[str, Any]] = maybe("With --estimator: by name and mode")
    ranking: list[Ranked] = maybe("With --estimator: best first")
    paired: dict[str, Any] = maybe("Ratios of mean square errors on the same counts, by mode")
    estimator_curves: dict[str, Any] = maybe("Errors of estimators against all that was varied")
    estimator_map: dict[str, Any] = maybe("Who keeps most information, by height and photons")
    detection: dict[str, Any] = maybe("Recall of estimators against mass")
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
