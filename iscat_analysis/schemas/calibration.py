"""Documents of ``iscat calibrate``, and of optics that a fit learns."""

from __future__ import annotations

from typing import Any, Literal

from iscat_analysis.schemas.base import (
    Closed,
    Count,
    Document,
    KnownError,
    Notes,
    NotNegative,
    Number,
    Share,
    Written,
    key,
    maybe,
)


class Estimate(Closed):
    """A measured number."""

    value: float = key("The estimate")
    se: KnownError
    ci95: tuple[float, float] = key("Its 95 % interval")


class PhotonTransfer(Closed):
    """Variance against mean, in groups of pixels."""

    mean_adu: list[float] = key("Mean [counts]")
    variance_adu2: list[float] = key("Variance between frames [counts²]")
    variance_se: list[NotNegative] = key("Its standard error [counts²]")
    fit_adu2: list[Number] = key("The fitted line [counts²]")
    pixels: list[Count] = key("How many pixels")


class Averaging(Closed):
    """Noise against averaging."""

    n_frames: list[Count] = key("Frames averaged before and after")
    contrast_noise: list[NotNegative] = key("Standard deviation of the contrast of a pixel")
    contrast_noise_se: list[Number] = key("Its standard error")
    shot_noise: list[Number] = key("What the photoelectrons alone would give")
    excess: list[Number] = key("Variance over that of the photoelectrons")
    excess_se: list[Number] = key("Its standard error")
    comparisons: list[Count] = key("How many pairs of averages")


class Camera(Document):
    """What iscat calibrate camera prints and writes as camera.json."""

    recordings: list[str] = maybe("In the file: the stacks")
    dark: str | None = maybe("In the file: the dark")
    gain_e_per_adu: Estimate | None = key("Photoelectrons per count [e]")
    offset_adu: Estimate = key("Counts in the dark [counts]")
    offset_from: Literal["dark", "given", "flicker", "line"] = key("Where the offset is from")
    read_noise_adu: Estimate | None = key("Read noise, standard deviation [counts]")
    read_noise_e: Estimate | None = key("Read noise, standard deviation [e]")
    read_noise_below_e: NotNegative | None = key("95 % limit of one too small [e]")
    shot_limited_frames: Count | None = key("Frames that may be averaged before other noise shows")
    verdict: str = key("The same as a sentence")
    frames: Count = key("Frames that were used")
    masked_pixels: dict[str, Count] = key("Pixels left out, by reason")
    photon_transfer: PhotonTransfer = key("Variance against mean")
    noise: Averaging = key("Noise against averaging")
    notes: Notes
    out: Written


class ContrastPeak(Closed):
    """A peak of the contrasts."""

    contrast: NotNegative = key("Size of the peak's contrast")
    contrast_se: KnownError
    width: NotNegative = key("Standard deviation of the peak beyond the events' own")
    count: NotNegative = key("Events in it")


class Standard(Closed):
    """A standard, and the mass of its peak on the line."""

    mass_kda: float = key("Known mass [kDa]")
    mass_se: KnownError
    contrast: float = key("Signed contrast of its peak")
    contrast_se: KnownError
    width: NotNegative = key("Standard deviation of the peak beyond the events' own")
    count: NotNegative = key("Events in it")
    found_kda: float = key("Its mass by the line [kDa]")
    residual_percent: float = key("found_kda beside mass_kda [%]")
    low_kda: Number = key("Lower end of the prediction interval [kDa]")
    high_kda: Number = key("Upper end [kDa]")


class Histogram(Closed):
    """A histogram."""

    edges: list[NotNegative] = key("Edges of the bins")
    counts: list[Count] = key("Events in each")


class StandardsCamera(Closed):
    """The camera of the standards."""

    pixel_size_nm: NotNegative = maybe("Pixel side [nm]")
    samples_per_pixel: Literal["auto"] | Count = key("Samples per pixel, per axis")
    fill_factor: Share = key("Share of a pixel's area that detects light")
    gain_e_per_adu: NotNegative = maybe("Photoelectrons per count, where it is one number")
    offset_adu: float = maybe("Counts in the dark, where they are one number")


class StandardsCovariance(Closed):
    """Errors of the optics of the standards."""

    names: list[str] = key("Learned keys of [optics]")
    matrix: list[list[float]] = key("Their covariance")


class Standards(Closed):
    """Optics and camera with which the standards were recorded and analysed."""

    optics: dict[str, Any] = key("Keys of [optics]")
    covariance: StandardsCovariance | None = key("Of these, where they were learned")
    height_nm: NotNegative = key("Height of the particles [nm]")
    camera: StandardsCamera = key("The camera")


class MassCalibration(Document):
    """What iscat calibrate mass prints and writes as calibration.json.

    The line between contrast and mass: contrast = gradient · mass + sign · offset.
    """

    source: str = maybe("In the file: the table of events")
    gradient_per_kda: float = key("Signed peak contrast per kDa")
    gradient_se: KnownError
    offset: float = key("Contrast at zero mass")
    offset_se: KnownError
    covariance: tuple[tuple[float, float], tuple[float, float]] = key("Of gradient and offset")
    chi2: NotNegative = key("χ² of the standards about the line")
    dof: Count = key("Its degrees of freedom")
    landing: Literal["dark", "bright"] = key("What a landing particle makes its position")
    events: Count = key("Landing events that were used")
    standards: list[Standard] = key("The standards, lightest first")
    peaks: list[ContrastPeak] = key("Every peak that was found")
    notes: Notes
    recorded: Standards | None = key("Optics and camera of the standards, null if unknown")
    histogram: Histogram = maybe("In the file: sizes of the contrasts")
    out: Written


class OpticsParameter(Closed):
    """A parameter of the optics."""

    parameter: str = key("Its key in [optics], or the name of an aberration")
    value: float = key("Its value")
    sigma: Number = key("Its standard error, null where it was not measured")
    crb: Number = key("Its Cramér–Rao bound, null where it was not measured")
    configured: float = key("What the configuration says")
    state: Literal["measured", "prior", "dropped", "given"] = key(
        "measured; prior, because images tell little of it beyond its usual error; dropped, "
        "because it does not improve the fits; or given, because it was not to be learned"
    )


class HeldOut(Closed):
    """How well optics describe images that were held out."""

    p_values: list[float] = key("Of each picture")
    chi2_reduced: list[float] = key("Of each picture")
    uniform_p: float = key("Chance that uniform p-values look less uniform")


class Twin(Closed):
    """Other optics that give the same images."""

    settings: dict[str, float | bool | str] = key("Its parameters")
    gap: float = key("Log-likelihood by which it is worse")


class Template(Document):
    """What iscat calibrate optics --measured prints and writes as template.json."""

    accepted: bool = key("Whether the template may be used")
    refusals: list[str] = key("Why it may not, one line each")
    particles: Count = key("Pictures that made it")
    contaminated: Count = key("Pictures left out, because something else happened in them")
    determined: float = key("Degrees of freedom of the image that the data determine")
    peak_se: float = key("Relative standard error of the peak, common to all contrasts")
    pixel_nm: float = key("Pixel side [nm]")
    roi_nm: float = key("Side of the square in which it is known [nm]")
    held_out: HeldOut = key("Pictures that were held out, by a template of the others")
    source: dict[str, str] = key("Source of the images")
    out: Written


class OpticsPictures(Closed):
    """Data of the page."""

    measured: list[list[float]] = key("Average contrast of the particles")
    model: list[list[float]] = key("The same, by the microscope that was found")
    residual: list[list[float]] = key("Their difference in standard deviations")
    pixel_nm: float = key("Pixel side [nm]")
    radius_nm: list[float] = key("Distance from the particle [nm]")
    radial: list[float] = key("Average contrast on rings")
    radial_se: list[float] = key("Its standard error")
    radial_model: list[float] = key("The same, by the microscope that was found")
    wavefront_nm: list[list[Number]] = key("Aberrations over the pupil [nm], null outside")
    transmission: list[list[Number]] = key("Amplitude that the mask passes, null outside")
    na: float = key("Radius of the pupil")


class Optics(Document):
    """What iscat calibrate optics prints and writes as optics.json."""

    accepted: bool = key("Whether the result may be used")
    refusals: list[str] = key("Why it may not, one line each")
    parameters: list[OpticsParameter] = key("Every parameter")
    names: list[str] = key("The measured ones, in the order of covariance")
    covariance: list[list[float]] = key("Of the measured parameters")
    correlation: list[list[float]] = key("Of the measured parameters")
    settings: dict[str, float | bool | str] = key("Keys of [optics]; aberrations by name [nm]")
    untold: list[str] = key("Parameters of which the images tell little: state prior")
    dropped: list[str] = key("Aberrations that improve nothing")
    undecided: list[str] = key("Discrete properties that the images do not determine")
    twin: Twin | None = key("A second microscope that is as likely")
    held_out: HeldOut = key("Pictures that were not fitted, in the measured microscope")
    held_out_as_configured: HeldOut = key("The same in the configured microscope")
    particles: Count = key("Pictures that were used")
    contaminated: Count = key("Pictures left out because something else happened in them")
    source: dict[str, str] = key("Movie, its hash, and the program's version")
    pictures: OpticsPictures = maybe("In the file: data of the page")
    notes: Notes
    out: Written


class Learned(Closed):
    """The test of the optics by ``optics.calibrate``, and the learned optics."""

    tested: Count = maybe("Bright isolated particles, or tracks")
    median_p: Share = maybe("Median p-value of the brightest with the configured optics")
    log_bayes_factor: Number = maybe("Of other optics over the configured ones, by all images")
    left_over: Number = maybe("Residual image of the configured optics over the image, rms")
    left_over_then: Number = maybe("Of learned optics used though held-out images reject them")
    calibrated: bool = key("Whether the analysis used learned optics")
    reason: str = maybe("Why not, if the test asked for it or was not possible")
    accepted: bool = maybe("Whether the learned optics could be used")
    refusals: list[str] = maybe("Why not, one line each")
    parameters: list[OpticsParameter] = maybe("Every parameter")
    names: list[str] = maybe("Parameters that images may tell, in the order of covariance")
    values: list[float] = maybe("Of the optics of the analysis, learned or as configured")
    covariance: list[list[float]] = maybe("Of their errors, prior included")
    field_px: list[float] | None = maybe("Centre x, y and half the longer side of its field [px]")
    twin: Twin | None = maybe("Second optics that are as likely")
    notes: list[str] = maybe("What the user should know, one line each")
