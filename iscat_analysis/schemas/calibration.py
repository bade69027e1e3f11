"""Documents of ``iscat calibrate``, and of optics that a fit learns."""

from __future__ import annotations

from typing import Any, Literal

from iscat_analysis.schemas.base import (
    ABSENT,
    Closed,
    Count,
    Document,
    Notes,
    NotNegative,
    Number,
    Share,
)


class Estimate(Closed):
    """A measured number."""

    value: float
    """The estimate"""
    se: NotNegative
    """Its standard error"""
    ci95: tuple[float, float]
    """Its 95 % interval"""


class PhotonTransfer(Closed):
    """Variance against mean, in groups of pixels."""

    mean_adu: list[float]
    """Mean [counts]"""
    variance_adu2: list[float]
    """Variance between frames [counts²]"""
    variance_se: list[NotNegative]
    """Its standard error [counts²]"""
    fit_adu2: list[Number]
    """The fitted line [counts²]"""
    pixels: list[Count]
    """How many pixels"""


class Averaging(Closed):
    """Noise against averaging."""

    n_frames: list[Count]
    """Frames averaged before and after"""
    contrast_noise: list[NotNegative]
    """Standard deviation of the contrast of a pixel"""
    contrast_noise_se: list[Number]
    """Its standard error"""
    shot_noise: list[Number]
    """What the photoelectrons alone would give"""
    excess: list[Number]
    """Variance over that of the photoelectrons"""
    excess_se: list[Number]
    """Its standard error"""
    comparisons: list[Count]
    """How many pairs of averages"""


class Camera(Document):
    """What iscat calibrate camera prints and writes as camera.json."""

    recordings: list[str] = ABSENT
    """In the file: the stacks"""
    dark: str | None = ABSENT
    """In the file: the dark"""
    gain_e_per_adu: Estimate | None
    """Photoelectrons per count [e]"""
    offset_adu: Estimate
    """Counts in the dark [counts]"""
    offset_from: Literal["dark", "given", "flicker", "line"]
    """Where the offset is from"""
    read_noise_adu: Estimate | None
    """Read noise, standard deviation [counts]"""
    read_noise_e: Estimate | None
    """Read noise, standard deviation [e]"""
    read_noise_below_e: NotNegative | None
    """Upper limit, 95 %, of a read noise too small to measure [e]"""
    shot_limited_frames: Count | None
    """Frames that may be averaged before other noise shows"""
    verdict: str
    """The same as a sentence"""
    frames: Count
    """Frames that were used"""
    masked_pixels: dict[str, Count]
    """Pixels left out, by reason"""
    photon_transfer: PhotonTransfer
    """Variance against mean"""
    noise: Averaging
    """Noise against averaging"""
    notes: Notes
    out: str = ABSENT
    """The folder that was written; not in the file"""


class ContrastPeak(Closed):
    """A peak of the contrasts."""

    contrast: NotNegative
    """Size of the peak's contrast"""
    contrast_se: NotNegative
    """Its standard error"""
    width: NotNegative
    """Standard deviation of the peak beyond the events' own"""
    count: NotNegative
    """Events in it"""


class Standard(Closed):
    """A standard, and the mass of its peak on the line."""

    mass_kda: float
    """Known mass [kDa]"""
    mass_se: NotNegative
    """Its standard error [kDa]"""
    contrast: float
    """Signed contrast of its peak"""
    contrast_se: NotNegative
    """Its standard error"""
    width: NotNegative
    """Standard deviation of the peak beyond the events' own"""
    count: NotNegative
    """Events in it"""
    found_kda: float
    """Its mass by the line [kDa]"""
    residual_percent: float
    """found_kda beside mass_kda [%]"""
    low_kda: Number
    """Lower end of the prediction interval [kDa]"""
    high_kda: Number
    """Upper end [kDa]"""


class Histogram(Closed):
    """A histogram."""

    edges: list[NotNegative]
    """Edges of the bins"""
    counts: list[Count]
    """Events in each"""


class StandardsCamera(Closed):
    """The camera of the standards."""

    pixel_size_nm: NotNegative = ABSENT
    """Pixel side [nm]"""
    samples_per_pixel: Literal["auto"] | Count
    """Samples per pixel, per axis"""
    fill_factor: Share
    """Share of a pixel's area that detects light"""
    gain_e_per_adu: NotNegative = ABSENT
    """Photoelectrons per count, where it is one number"""
    offset_adu: float = ABSENT
    """Counts in the dark, where they are one number"""


class StandardsCovariance(Closed):
    """Errors of the optics of the standards."""

    names: list[str]
    """Learned keys of [optics]"""
    matrix: list[list[float]]
    """Their covariance"""


class Standards(Closed):
    """Optics and camera with which the standards were recorded and analysed."""

    optics: dict[str, Any]
    """Keys of [optics]"""
    covariance: StandardsCovariance | None
    """Of these, where they were learned"""
    height_nm: NotNegative
    """Height of the particles [nm]"""
    camera: StandardsCamera
    """The camera"""


class MassCalibration(Document):
    """What iscat calibrate mass prints and writes as calibration.json.

    The line between contrast and mass: contrast = gradient · mass + sign · offset.
    """

    source: str = ABSENT
    """In the file: the table of events"""
    gradient_per_kda: float
    """Signed peak contrast per kDa"""
    gradient_se: NotNegative
    """Its standard error"""
    offset: float
    """Contrast at zero mass"""
    offset_se: NotNegative
    """Its standard error"""
    covariance: tuple[tuple[float, float], tuple[float, float]]
    """Of gradient and offset"""
    chi2: NotNegative
    """χ² of the standards about the line"""
    dof: Count
    """Its degrees of freedom"""
    landing: Literal["dark", "bright"]
    """Whether a landing particle makes its position darker or brighter"""
    events: Count
    """Landing events that were used"""
    standards: list[Standard]
    """The standards, lightest first"""
    peaks: list[ContrastPeak]
    """Every peak that was found"""
    notes: Notes
    recorded: Standards | None
    """Optics and camera of the standards, null if unknown"""
    histogram: Histogram = ABSENT
    """In the file: sizes of the contrasts"""
    out: str = ABSENT
    """The folder that was written; not in the file"""


class OpticsParameter(Closed):
    """A parameter of the optics."""

    parameter: str
    """Its key in [optics], or the name of an aberration"""
    value: float
    """Its value"""
    sigma: Number
    """Its standard error, null where it was not measured"""
    crb: Number
    """Its Cramér–Rao bound, null where it was not measured"""
    configured: float
    """What the configuration says"""
    state: Literal["measured", "prior", "dropped", "given"]
    """measured; prior, because images tell little of it beyond its usual error; dropped, because it
    does not improve the fits; or given, because it was not to be learned"""


class HeldOut(Closed):
    """How well optics describe images that were held out."""

    p_values: list[float]
    """Of each picture"""
    chi2_reduced: list[float]
    """Of each picture"""
    uniform_p: float
    """Chance that uniform p-values look less uniform"""


class Twin(Closed):
    """Other optics that give the same images."""

    settings: dict[str, float | bool | str]
    """Its parameters"""
    gap: float
    """Log-likelihood by which it is worse"""


class Template(Document):
    """What iscat calibrate optics --measured prints and writes as template.json."""

    accepted: bool
    """Whether the template may be used"""
    refusals: list[str]
    """Why it may not, one line each"""
    particles: Count
    """Pictures that made it"""
    contaminated: Count
    """Pictures left out, because something else happened in them"""
    determined: float
    """Degrees of freedom of the image that the data determine"""
    peak_se: float
    """Relative standard error of the peak, common to all contrasts"""
    pixel_nm: float
    """Pixel side [nm]"""
    roi_nm: float
    """Side of the square in which it is known [nm]"""
    held_out: HeldOut
    """Pictures that were held out, by a template of the others"""
    source: dict[str, str]
    """Source of the images"""
    out: str = ABSENT
    """When printed: the output folder"""


class OpticsPictures(Closed):
    """Data of the page."""

    measured: list[list[float]]
    """Average contrast of the particles"""
    model: list[list[float]]
    """The same, by the microscope that was found"""
    residual: list[list[float]]
    """Their difference in standard deviations"""
    pixel_nm: float
    """Pixel side [nm]"""
    radius_nm: list[float]
    """Distance from the particle [nm]"""
    radial: list[float]
    """Average contrast on rings"""
    radial_se: list[float]
    """Its standard error"""
    radial_model: list[float]
    """The same, by the microscope that was found"""
    wavefront_nm: list[list[Number]]
    """Aberrations over the pupil [nm], null outside"""
    transmission: list[list[Number]]
    """Amplitude that the mask passes, null outside"""
    na: float
    """Radius of the pupil"""


class Optics(Document):
    """What iscat calibrate optics prints and writes as optics.json."""

    accepted: bool
    """Whether the result may be used"""
    refusals: list[str]
    """Why it may not, one line each"""
    parameters: list[OpticsParameter]
    """Every parameter"""
    names: list[str]
    """The measured ones, in the order of covariance"""
    covariance: list[list[float]]
    """Of the measured parameters"""
    correlation: list[list[float]]
    """Of the measured parameters"""
    settings: dict[str, float | bool | str]
    """Keys of [optics]; aberrations by name [nm]"""
    untold: list[str]
    """Parameters of which the images tell little: state prior"""
    dropped: list[str]
    """Aberrations that improve nothing"""
    undecided: list[str]
    """Discrete properties that the images do not determine"""
    twin: Twin | None
    """A second microscope that is as likely"""
    held_out: HeldOut
    """Pictures that were not fitted, in the measured microscope"""
    held_out_as_configured: HeldOut
    """The same in the configured microscope"""
    particles: Count
    """Pictures that were used"""
    contaminated: Count
    """Pictures left out because something else happened in them"""
    source: dict[str, str]
    """Movie, its hash, and the program's version"""
    pictures: OpticsPictures = ABSENT
    """In the file: data of the page"""
    notes: Notes
    out: str = ABSENT
    """The folder that was written; not in the file"""


class Learned(Closed):
    """The test of the optics by ``optics.calibrate``, and the learned optics."""

    tested: Count = ABSENT
    """Bright isolated particles, or tracks"""
    median_p: Share = ABSENT
    """Median p-value of the brightest with the configured optics"""
    log_bayes_factor: Number = ABSENT
    """Of other optics over the configured ones, by all images"""
    left_over: Number = ABSENT
    """What the configured optics leave over of the images, beyond the noise, over the images (root
    mean square)"""
    left_over_then: Number = ABSENT
    """The same with learned optics that are used although images that were held out reject them"""
    calibrated: bool
    """Whether the analysis used learned optics"""
    reason: str = ABSENT
    """Why not, if the test asked for it or was not possible"""
    accepted: bool = ABSENT
    """Whether the learned optics could be used"""
    refusals: list[str] = ABSENT
    """Why not, one line each"""
    parameters: list[OpticsParameter] = ABSENT
    """Every parameter"""
    names: list[str] = ABSENT
    """Parameters that images may tell, in the order of covariance"""
    values: list[float] = ABSENT
    """Of the optics of the analysis, learned or as configured"""
    covariance: list[list[float]] = ABSENT
    """Of their errors, by images and by what is known without them"""
    field_px: list[float] | None = ABSENT
    """Centre x, y and half the longer side of the field of its terms [pixels]; null without any"""
    twin: Twin | None = ABSENT
    """Second optics that are as likely"""
    notes: list[str] = ABSENT
    """What the user should know, one line each"""
