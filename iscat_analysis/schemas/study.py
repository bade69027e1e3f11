"""Documents of ``iscat benchmark``."""

from __future__ import annotations

from typing import Any

from iscat_analysis.schemas.base import (
    ABSENT,
    Convention,
    Count,
    Document,
    Emission,
    Interval,
    Natural,
    Number,
    Scheme,
    Share,
)


class Score(Document):
    """How one free parameter was estimated [nm or kDa]."""

    bias: Number
    """Mean of estimate minus truth"""
    bias_se: Number
    """Its standard error"""
    spread: Number
    """Standard deviation of the estimates"""
    spread_ci95: Interval
    """Its 95 % confidence interval"""
    spread_robust: Number = ABSENT
    """The same from the quartiles, which outliers do not touch"""
    crb: Number
    """Joint Cramér–Rao bound"""
    qcrb: Number
    """Quantum Cramér–Rao bound"""
    spread_over_crb: Number
    """1 for an efficient estimator"""
    spread_over_crb_ci95: Interval
    """Its 95 % confidence interval"""
    spread_over_qcrb: Number
    """Distance to the quantum bound"""
    spread_over_qcrb_ci95: Interval = ABSENT
    """Its 95 % confidence interval"""
    coverage68: Share
    """Share of intervals of 1 σ that hold the truth"""
    coverage68_ci95: Interval
    """Its 95 % confidence interval"""
    coverage95: Share
    """Share of intervals of 1.96 σ that hold the truth"""
    coverage95_ci95: Interval
    """Its 95 % confidence interval"""
    pull_mean: Number
    """Mean of (estimate − truth)/σ"""
    pull_std: Number
    """Its standard deviation, 1 where σ is right"""
    posterior_coverage68: Number = ABSENT
    """Share of central 68 % intervals that hold the truth"""
    posterior_coverage68_ci95: Interval = ABSENT
    """Its 95 % confidence interval"""
    posterior_coverage95: Number = ABSENT
    """Share of central 95 % intervals that hold the truth"""
    posterior_coverage95_ci95: Interval = ABSENT
    """Its 95 % confidence interval"""
    posterior_width_over_crb: Number = ABSENT
    """Posterior standard deviation over the CRB"""
    baselines: dict[str, dict[str, Any]] = ABSENT
    """The same of a Gaussian fit and of the peak"""


class EstimatorScore(Document):
    """How an estimator found one parameter [nm or kDa]; each statistic also with `_ci95`."""

    answered: Count
    """Particles with an estimate"""
    failed: Count
    """Particles without"""
    crb: Number
    """Joint Cramér–Rao bound, root mean square over the particles"""
    qcrb: Number
    """Quantum Cramér–Rao bound"""
    holevo: Number
    """Holevo bound: one measurement for all free parameters"""
    bias: Number = ABSENT
    """Mean of estimate minus truth"""
    bias_se: Number = ABSENT
    """Its standard error"""
    spread: Number = ABSENT
    """Standard deviation about the line of error against truth"""
    rmse: Number = ABSENT
    """Root mean square error"""
    spread_over_crb: Number = ABSENT
    """1 for an efficient estimator without bias"""
    spread_over_qcrb: Number = ABSENT
    """Distance to the quantum bound"""
    spread_over_holevo: Number = ABSENT
    """Distance to the Holevo bound"""
    efficiency_crb: Number = ABSENT
    """CRB² over the mean square error"""
    efficiency_qcrb: Number = ABSENT
    """QCRB² over the mean square error"""
    efficiency_holevo: Number = ABSENT
    """Holevo² over the mean square error"""
    bias_gradient: Number = ABSENT
    """Slope of the bias along the parameter itself"""
    biased_bound_over_crb: Number = ABSENT
    """Bound of an estimator with these gradients, over CRB"""
    spread_over_biased_bound: Number = ABSENT
    """Less than 1 is impossible from the counts alone"""
    pull_mean: Number = ABSENT
    """Mean of (estimate − truth)/σ"""
    pull_std: Number = ABSENT
    """Its standard deviation, 1 where σ is right"""
    coverage68: Number = ABSENT
    """Share of intervals of 1 σ that hold the truth"""
    coverage95: Number = ABSENT
    """Share of intervals of 1.96 σ that hold the truth"""
    below_bound: bool = ABSENT
    """Whether the spread is below its own bound by more than chance"""
    verdict: str
    """What a reader must know before the numbers are believed; mostly empty"""


class EstimatorEntry(Document):
    """One estimator in one mode, or one table of results in one part of a challenge."""

    x_nm: EstimatorScore = ABSENT
    """Column"""
    y_nm: EstimatorScore = ABSENT
    """Row"""
    z_nm: EstimatorScore = ABSENT
    """Height"""
    mass_kda: EstimatorScore = ABSENT
    """Mass"""
    trials: Natural
    """Particles"""
    failed: Count
    """Particles without an answer"""
    failures: dict[str, Count] = ABSENT
    """The same by what went wrong"""
    seconds_per_fit: Number = ABSENT
    """Clock, for one particle"""
    processor_seconds_per_fit: Number = ABSENT
    """Of processors"""
    peak_mb: Number = ABSENT
    """Most memory of its process [MB]"""
    false_alarms: Count = ABSENT
    """Results that are of no particle"""
    false_alarms_per_movie: Number = ABSENT
    """At which recall is stated"""
    recall: list[dict[str, Any]] = ABSENT
    """By mass, beside the matched filter's"""
    notes: list[str] = ABSENT
    """How columns were understood"""


class Ranked(Document):
    """A place in the ranking."""

    estimator: str
    """Name"""
    kept: Number
    """Efficiency times the share answered, mean over parameters"""
    below_bound: bool
    """Whether it knew more than the counts, and is not ranked"""


class ChallengePart(Document):
    """Particles of one kind."""

    kind: str
    """stacks, movie, or table"""
    mode: str
    """What was free"""
    about: str
    """In words"""
    trials: Natural
    """Particles"""
    collected: Number
    """Scattered photons of one particle, mean"""
    bounds: dict[str, dict[str, Number]]
    """By parameter [nm, kDa]"""
    estimators: dict[str, EstimatorEntry]
    """By name"""
    paired: dict[str, Any]
    """Ratios of mean square errors on the same counts"""


class Challenge(Document):
    """What iscat challenge score writes, and iscat benchmark --truth --results."""

    title: str
    """Of the page"""
    challenge: dict[str, Any] | None = ABSENT
    """Name, version, hashes"""
    results_sha256: dict[str, str]
    """Of every table that was scored"""
    parts: dict[str, ChallengePart]
    """By name"""
    ranking: list[Ranked]
    """Best first"""
    table_1: list[dict[str, Any]] = ABSENT
    """Table 1 of Dong et al. (2021) with achieved numbers"""
    seed: int
    """Of the bootstrap"""
    command: str
    """The command line"""
    versions: dict[str, str]
    """Of this program and the numerical libraries"""


class ModeStudy(Document):
    """One mode; its free parameters are keys."""

    x_nm: Score
    """Column"""
    y_nm: Score
    """Row"""
    z_nm: Score = ABSENT
    """Height, where it is free"""
    mass_kda: Score = ABSENT
    """Mass, where it is free"""
    diameter_nm: Score = ABSENT
    """Diameter of a sphere, where it is free"""
    trials: Natural
    """Repetitions"""
    failed: Count
    """Repetitions without an estimate"""
    flagged: dict[str, Count] = ABSENT
    """Repetitions by status"""
    fits_per_second: Number
    """Per second of processor time"""
    seed: int
    """Seed of this mode"""
    at: dict[str, Any] = ABSENT
    """The experiment"""


class Benchmark(Document):
    """What iscat benchmark prints and writes as benchmark.json."""

    mass: ModeStudy = ABSENT
    """Mode mass: bias, spread, bounds, coverage and pulls by parameter"""
    size: ModeStudy = ABSENT
    """Mode size, likewise; of spheres, which have this in place of mass"""
    localize: ModeStudy
    """Mode localize, likewise"""
    joint: ModeStudy = ABSENT
    """Mode joint, likewise; not of spheres"""
    estimators: dict[str, dict[str, Any]] = ABSENT
    """With --estimator: by name and mode, as the estimators of a challenge's part"""
    ranking: list[Ranked] = ABSENT
    """With --estimator: best first"""
    paired: dict[str, Any] = ABSENT
    """Ratios of mean square errors on the same counts, by mode"""
    estimator_curves: dict[str, Any] = ABSENT
    """Errors of estimators against all that was varied"""
    estimator_map: dict[str, Any] = ABSENT
    """Who keeps most of the information, and who is as good, by height (rows) and photons"""
    detection: dict[str, Any] = ABSENT
    """Recall of estimators against mass"""
    curves: dict[str, Any] = ABSENT
    """Spread and bounds against photons and against height"""
    histograms: dict[str, Any] = ABSENT
    """Pulls, and ranks of posteriors"""
    trials: Natural
    """Repetitions in each mode"""
    seed: int
    """Same seed, same numbers"""
    scheme: Scheme = ABSENT
    """Optical scheme"""
    emission: Emission = ABSENT
    """Emission model"""
    convention: Convention = ABSENT
    """Formulas"""
    command: str
    """The command line"""
    config: str
    """The configuration, as TOML"""
    versions: dict[str, str]
    """Of this program and the numerical libraries"""
