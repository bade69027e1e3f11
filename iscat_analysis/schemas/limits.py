"""Documents of ``iscat bounds`` and ``iscat benchmark``: what estimates may reach, and reach."""

from __future__ import annotations

from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import ConfigDict, Field

from iscat_analysis.schemas.base import (
    ABSENT,
    Closed,
    Convention,
    Count,
    Document,
    Emission,
    Interval,
    Matrix4,
    Mode,
    Natural,
    Notes,
    NotNegative,
    Number,
    Parameter,
    Positive,
    Scheme,
    Share,
)

Sigma = TypeVar("Sigma", bound=Closed)


class Experiment(Document):
    """The experiment whose bounds are computed."""

    scheme: Scheme
    mode: Mode
    free: list[Parameter]
    x_nm: float
    y_nm: float
    z_nm: float
    mass_kda: float
    focus_nm: float
    attenuation: float
    na: float
    pixel_size_nm: float
    photons_per_pixel: float
    pixels: int
    n_before: int
    n_after: int


class Scattered(Document):
    """Scattered photons in all frames after."""

    camera: float
    """On the field of pixels"""
    collected: float
    """Through the pupil"""


class Place(Closed):
    """Standard deviations of the position."""

    x_nm: Positive
    """[nm]"""
    y_nm: Positive
    """[nm]"""
    z_nm: Positive
    """[nm]"""


class PerPhoton(Place):
    """Standard deviations for one photon."""

    mass_rel: Positive
    """Relative to the mass"""
    z_nm_phase_free: Positive = ABSENT
    """The phase between particle and reference unknown [nm]"""


class Planned(Place):
    """Standard deviations for the planned frames."""

    mass_kda: Positive
    """[kDa]"""
    z_nm_phase_free: Positive = ABSENT
    """The phase between particle and reference unknown [nm]"""


class Kinds(Document, Generic[Sigma]):
    """Bounds of each kind: for planned frames, or for one photon, scattered or collected."""

    crb_single: Sigma
    """Everything else known"""
    crb_joint: Sigma
    """Over the mode's free parameters; null where not identifiable"""
    qcrb: Sigma
    """Quantum, everything else known"""
    qcrb_joint: Sigma
    """Quantum, over all four parameters"""
    qcrb_dong2021: Sigma
    """Quantum, with the mode weight of Dong et al. (2021)"""


class Free(Closed):
    """Standard deviations of the parameters that are free."""

    x_nm: Positive = ABSENT
    """[nm]"""
    y_nm: Positive = ABSENT
    """[nm]"""
    z_nm: Positive = ABSENT
    """[nm]"""
    mass_kda: Positive = ABSENT
    """[kDa]"""


class Holevo(Free):
    """Holevo bound of one measurement of all free parameters, for the planned frames."""

    weight: Literal["qfi"]
    """Every parameter weighs as much as the light knows of it"""
    sum: Positive
    """Tr WV; the number of free parameters where no two are in conflict"""


class Crosstalk(Document):
    """The combination of free parameters that is determined worst."""

    inflation: Number
    direction: dict[str, Number]


class Scan(Document):
    """Bounds along an axis."""

    name: str
    label: str
    here: Number
    columns: dict[str, list[Number | str]]


class Optimum(Document):
    """The best value of a setting."""

    model_config = ConfigDict(extra="allow", validate_by_name=True)

    of: str
    wanted: str = Field(alias="for")
    value: Number
    bound: Number
    configured: Number
    bound_configured: Number
    note: str


class DetectionLimit(Closed):
    """The faintest particle that can be detected in all frames."""

    false_alarm: float
    """Probability that noise alone is taken for a particle"""
    miss: float
    """Probability that the particle is not found"""
    threshold_known: float
    """Of the signal-to-noise ratio, if the position is known"""
    threshold_searched: float
    """The same where the field of [bounds] is searched"""
    snr_known: float
    """Signal-to-noise ratio that a particle needs, position known"""
    snr_searched: float
    """The same, field searched"""
    mass_known_kda: NotNegative
    """Its mass, position known [kDa]"""
    mass_searched_kda: NotNegative
    """Its mass, field searched [kDa]"""
    snr_per_amplitude: float
    """Square root of the empty field's Fisher information"""


class Compared(Closed):
    """A setting before and after."""

    configured: float
    best: float


class PupilSigma(Closed):
    """Standard deviations for the planned frames [nm, kDa]."""

    configured: Positive
    """Joint CRB as configured; null where not identifiable"""
    best: Positive
    """Joint CRB with the best pupil"""
    holevo: Positive
    """What the measurement of the Holevo bound reaches together"""
    qcrb: Positive
    """Quantum, everything else known"""


class PupilSum(Closed):
    """Sum of variances over each parameter's own quantum bound."""

    configured: Number
    best: Positive
    holevo: Positive
    """Below which no measurement comes"""


class PupilShare(Closed):
    """Holevo bound over the sum of variances: 1 where no measurement is better."""

    configured: Share
    best: Share
    quiet: Share
    """Best pupil, with a known background and without read noise"""


class Pupil(Document):
    """The pupil that comes nearest to the Holevo bound at the same light on the particle."""

    for_: list[Parameter] = Field(alias="for")
    """Parameters chosen"""
    settings: dict[str, Compared]
    """By key of [optics], each aberration by its own name"""
    photons_per_pixel: float
    """Background per pixel and frame that the attenuation leaves [e]"""
    peak_e: float
    """Brightest pixel in a frame [e]"""
    transmitted_over_collected: NotNegative
    """Share of the collected light that passes"""
    sigma: dict[Parameter, PupilSigma]
    sum: PupilSum
    share: PupilShare
    descents: list[Share]
    """Share at the end of each descent, best first, in a smaller field"""
    near: Count
    """Descents that end within 1 % of the best"""
    evaluations: Natural
    """Pupils tried"""


class Target(Document):
    """What reaches a wanted precision."""

    parameter: Parameter
    value: float
    effort: list[dict[str, Any]]
    budget: list[dict[str, Any]]
    note: str


class RodSigma(Free):
    """Standard deviations of a rod for the planned frames; null where not identifiable."""

    azimuth_deg: Positive
    """Of the direction in the image [degrees]"""
    tilt_deg: Positive
    """Of the angle to the optical axis [degrees]"""


class RodBounds(Closed):
    """Bounds of a rod whose direction is unknown; all others hold it."""

    aspect_ratio: float
    """Length over width"""
    azimuth_deg: float
    """Its direction in the image, from x towards y [degrees]"""
    tilt_deg: float
    """Its angle to the optical axis [degrees]"""
    crb_single: RodSigma
    """Everything else known"""
    crb_joint: RodSigma
    """Over the mode's free parameters and both angles"""
    unidentifiable: list[str]
    """Directions that the image does not show"""


class Bounds(Document):
    """What iscat bounds prints: classical and quantum Cramér–Rao bounds of one particle."""

    at: Experiment
    """The experiment"""
    n_scattered: Scattered
    """Scattered photons in all frames after"""
    per_photon: Kinds[PerPhoton]
    """For one scattered photon [nm; mass_rel is relative]"""
    actual: Kinds[Planned]
    """For the planned frames [nm, kDa]"""
    fisher: Matrix4
    """Fisher information of all frames, order x, y, z, mass [1/nm², 1/(nm kDa), 1/kDa²]"""
    qfi: Matrix4
    """Quantum Fisher information of the light"""
    qfi_imaginary: Matrix4
    """Its imaginary part; where not zero, no single measurement is best for both parameters"""
    holevo: Holevo
    """Holevo bound over the mode's free parameters"""
    information_fraction: dict[Parameter, Number]
    """Share of the light's information"""
    information_fraction_joint: dict[Parameter, Number]
    """Share of the best measurement of all free parameters: (Holevo / CRB joint)²"""
    incompatible: dict[str, float]
    """Pairs that no single measurement estimates best, and how strongly, from 0 to 1"""
    unidentifiable: list[str]
    """Directions that the image does not show"""
    crosstalk: Crosstalk
    """The direction worst hidden among the free parameters"""
    convention: Convention
    """Formulas"""
    emission: Emission
    """Emission model"""
    warnings: Notes
    rod: RodBounds = ABSENT
    """With particle.model = "rod" """
    detection: DetectionLimit = ABSENT
    """Smallest mass that is detected; not in dark field"""
    scan: Scan = ABSENT
    """With --scan"""
    optimum: Optimum = ABSENT
    """With --optimize focus or attenuation"""
    pupil: Pupil = ABSENT
    """With --optimize pupil"""
    target: Target = ABSENT
    """With --target"""


class OpticsParameter(Closed):
    """A parameter of the optics that would be fitted."""

    parameter: str
    value: float
    """As configured"""
    sigma: Positive
    """Standard deviation, all fitted together"""
    usual_error: float
    """Standard deviation without any image"""
    determined: bool
    """Whether the images know it twice as well as that"""


class EventsNeeded(Closed):
    """Number of particles of one mass for each goal; null if no number is enough."""

    mass_kda: float
    snr: NotNegative
    """Signal-to-noise ratio of one picture"""
    identified: Number
    """Events that determine everything that can be"""
    focus_nm: Number
    mass_rel: Number


class OpticsBounds(Document):
    """What iscat bounds --for optics prints: how well particles would determine the optics."""

    at: dict[str, Number]
    """The experiment"""
    events: Natural
    """Particles that are fitted together"""
    snr: NotNegative
    """Signal-to-noise ratio of one picture"""
    parameters: list[OpticsParameter]
    names: list[str]
    """Parameters, in the order of covariance"""
    covariance: list[list[Number]]
    """Of these, fitted together"""
    unidentifiable: list[str]
    """Parameters of which the images tell little, one sentence each"""
    common: dict[str, dict[Parameter, Number]]
    """Mode: standard deviation common to all fits, from the error of the optics [nm, kDa]"""
    single: dict[str, dict[Parameter, Number]]
    """Mode: Cramér–Rao bound of one particle if the optics are known [nm, kDa]"""
    goals: dict[str, float]
    """Precisions for which the number of particles is given"""
    needed: list[EventsNeeded]
    """Their price, for several masses"""
    warnings: Notes


class Table1Row(Closed):
    """One row of Table 1."""

    quantity: Literal["x", "y", "z_iscat", "z_cobri", "mass"]
    """Parameter, and scheme"""
    unit: Literal["nm", "relative"]
    """Unit of the row"""
    printed: Positive
    """As published"""
    authors: Positive
    """The authors' formulas by their rectangle rule"""
    dong2021: Positive
    """The same formulas integrated exactly"""
    exact: Positive
    """Exact"""
    reciprocal: Positive
    """Exact, with an emission that conserves energy"""


class Comparison(Document):
    """What iscat bounds --preset dong2021 prints: Table 1 of Dong et al. (2021), five ways."""

    table_1: Annotated[list[Table1Row], Field(min_length=5, max_length=5)]
    """Per photon"""


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
