"""Documents of ``iscat bounds``."""

from __future__ import annotations

from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import ConfigDict, Field

from iscat_analysis.schemas.base import (
    Closed,
    Convention,
    Count,
    Document,
    Emission,
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
    key,
    maybe,
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

    camera: float = key("On the field of pixels")
    collected: float = key("Through the pupil")


class Place(Closed):
    """Standard deviations of the position."""

    x_nm: Positive = key("[nm]")
    y_nm: Positive = key("[nm]")
    z_nm: Positive = key("[nm]")


class PerPhoton(Place):
    """Standard deviations for one photon."""

    mass_rel: Positive = key("Relative to the mass")
    z_nm_phase_free: Positive = maybe("The phase between particle and reference unknown [nm]")


class Planned(Place):
    """Standard deviations for the planned frames."""

    mass_kda: Positive = key("[kDa]")
    z_nm_phase_free: Positive = maybe("The phase between particle and reference unknown [nm]")


class Kinds(Document, Generic[Sigma]):
    """Bounds of each kind: for planned frames, or for one photon, scattered or collected."""

    crb_single: Sigma = key("Everything else known")
    crb_joint: Sigma = key("Over the mode's free parameters; null where not identifiable")
    qcrb: Sigma = key("Quantum, everything else known")
    qcrb_joint: Sigma = key("Quantum, over all four parameters")
    qcrb_dong2021: Sigma = key("Quantum, with the mode weight of Dong et al. (2021)")


class Free(Closed):
    """Standard deviations of the parameters that are free."""

    x_nm: Positive = maybe("[nm]")
    y_nm: Positive = maybe("[nm]")
    z_nm: Positive = maybe("[nm]")
    mass_kda: Positive = maybe("[kDa]")


class Holevo(Free):
    """Holevo bound of one measurement of all free parameters, for the planned frames."""

    weight: Literal["qfi"] = key("Every parameter weighs as much as the light knows of it")
    sum: Positive = key("Tr WV; the number of free parameters where no two are in conflict")


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

    false_alarm: float = key("Probability that noise alone is taken for a particle")
    miss: float = key("Probability that the particle is not found")
    threshold_known: float = key("Of the signal-to-noise ratio, if the position is known")
    threshold_searched: float = key("The same where the field of [bounds] is searched")
    snr_known: float = key("Signal-to-noise ratio that a particle needs, position known")
    snr_searched: float = key("The same, field searched")
    mass_known_kda: NotNegative = key("Its mass, position known [kDa]")
    mass_searched_kda: NotNegative = key("Its mass, field searched [kDa]")
    snr_per_amplitude: float = key("Square root of the empty field's Fisher information")


class Compared(Closed):
    """A setting before and after."""

    configured: float
    best: float


class PupilSigma(Closed):
    """Standard deviations for the planned frames [nm, kDa]."""

    configured: Positive = key("Joint CRB as configured; null where not identifiable")
    best: Positive = key("Joint CRB with the best pupil")
    holevo: Positive = key("What the measurement of the Holevo bound reaches together")
    qcrb: Positive = key("Quantum, everything else known")


class PupilSum(Closed):
    """Sum of variances over each parameter's own quantum bound."""

    configured: Number
    best: Positive
    holevo: Positive = key("Below which no measurement comes")


class PupilShare(Closed):
    """Holevo bound over the sum of variances: 1 where no measurement is better."""

    configured: Share
    best: Share
    quiet: Share = key("Best pupil, with a known background and without read noise")


class Pupil(Document):
    """The pupil that comes nearest to the Holevo bound at the same light on the particle."""

    for_: list[Parameter] = Field(alias="for", description="Parameters chosen")
    settings: dict[str, Compared] = key("By key of [optics], each aberration by its own name")
    photons_per_pixel: float = key("Background per pixel and frame that the attenuation leaves [e]")
    peak_e: float = key("Brightest pixel in a frame [e]")
    transmitted_over_collected: NotNegative = key("Share of the collected light that passes")
    sigma: dict[Parameter, PupilSigma]
    sum: PupilSum
    share: PupilShare
    descents: list[Share] = key("Share at the end of each descent, best first, in a smaller field")
    near: Count = key("Descents that end within 1 % of the best")
    evaluations: Natural = key("Pupils tried")


class Target(Document):
    """What reaches a wanted precision."""

    parameter: Parameter
    value: float
    effort: list[dict[str, Any]]
    budget: list[dict[str, Any]]
    note: str


class RodSigma(Free):
    """Standard deviations of a rod for the planned frames; null where not identifiable."""

    azimuth_deg: Positive = key("Of the direction in the image [degrees]")
    tilt_deg: Positive = key("Of the angle to the optical axis [degrees]")


class RodBounds(Closed):
    """Bounds of a rod whose direction is unknown; all others hold it."""

    aspect_ratio: float = key("Length over width")
    azimuth_deg: float = key("Its direction in the image, from x towards y [degrees]")
    tilt_deg: float = key("Its angle to the optical axis [degrees]")
    crb_single: RodSigma = key("Everything else known")
    crb_joint: RodSigma = key("Over the mode's free parameters and both angles")
    unidentifiable: list[str] = key("Directions that the image does not show")


class Bounds(Document):
    """What iscat bounds prints: classical and quantum Cramér–Rao bounds of one particle."""

    at: Experiment = key("The experiment")
    n_scattered: Scattered = key("Scattered photons in all frames after")
    per_photon: Kinds[PerPhoton] = key("For one scattered photon [nm; mass_rel is relative]")
    actual: Kinds[Planned] = key("For the planned frames [nm, kDa]")
    fisher: Matrix4 = key("Fisher information, order x, y, z, mass [1/nm², 1/(nm kDa), 1/kDa²]")
    qfi: Matrix4 = key("Quantum Fisher information of the light")
    qfi_imaginary: Matrix4 = key("Its imaginary part; 0 where one measurement is best for both")
    holevo: Holevo = key("Holevo bound over the mode's free parameters")
    information_fraction: dict[Parameter, Number] = key("Share of the light's information")
    information_fraction_joint: dict[Parameter, Number] = key("(Holevo / CRB joint)²")
    incompatible: dict[str, float] = key("Pairs that no measurement estimates best, from 0 to 1")
    unidentifiable: list[str] = key("Directions that the image does not show")
    crosstalk: Crosstalk = key("The direction worst hidden among the free parameters")
    convention: Convention = key("Formulas")
    emission: Emission = key("Emission model")
    warnings: Notes
    rod: RodBounds = maybe('With particle.model = "rod"')
    detection: DetectionLimit = maybe("Smallest mass that is detected; not in dark field")
    scan: Scan = maybe("With --scan")
    optimum: Optimum = maybe("With --optimize focus or attenuation")
    pupil: Pupil = maybe("With --optimize pupil")
    target: Target = maybe("With --target")


class OpticsParameter(Closed):
    """A parameter of the optics that would be fitted."""

    parameter: str
    value: float = key("As configured")
    sigma: Positive = key("Standard deviation, all fitted together")
    usual_error: float = key("Standard deviation without any image")
    determined: bool = key("Whether the images know it twice as well as that")


class EventsNeeded(Closed):
    """Number of particles of one mass for each goal; null if no number is enough."""

    mass_kda: float
    snr: NotNegative = key("Signal-to-noise ratio of one picture")
    identified: Number = key("Events that determine everything that can be")
    focus_nm: Number
    mass_rel: Number


class OpticsBounds(Document):
    """What iscat bounds --for optics prints: how well particles would determine the optics."""

    at: dict[str, Number] = key("The experiment")
    events: Natural = key("Particles that are fitted together")
    snr: NotNegative = key("Signal-to-noise ratio of one picture")
    parameters: list[OpticsParameter]
    names: list[str] = key("Parameters, in the order of covariance")
    covariance: list[list[Number]] = key("Of these, fitted together")
    unidentifiable: list[str] = key("Parameters of which the images tell little, one sentence each")
    common: dict[str, dict[Parameter, Number]] = key("By mode: σ that all fits share [nm, kDa]")
    single: dict[str, dict[Parameter, Number]] = key("The same: CRB of one if they are known")
    goals: dict[str, float] = key("Precisions for which the number of particles is given")
    needed: list[EventsNeeded] = key("Their price, for several masses")
    warnings: Notes


class Table1Row(Closed):
    """One row of Table 1."""

    quantity: Literal["x", "y", "z_iscat", "z_cobri", "mass"] = key("Parameter, and scheme")
    unit: Literal["nm", "relative"] = key("Unit of the row")
    printed: Positive = key("As published")
    authors: Positive = key("The authors' formulas by their rectangle rule")
    dong2021: Positive = key("The same formulas integrated exactly")
    exact: Positive = key("Exact")
    reciprocal: Positive = key("Exact, with an emission that conserves energy")


class Comparison(Document):
    """What iscat bounds --preset dong2021 prints: Table 1 of Dong et al. (2021), five ways."""

    table_1: Annotated[list[Table1Row], Field(min_length=5, max_length=5)] = key("Per photon")
