"""Documents of ``iscat bounds``."""

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
