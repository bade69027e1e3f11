"""Documents of ``iscat calibrate``, ``iscat fit`` and ``iscat simulate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import ConfigDict, Field

from iscat_analysis.records import EVENTS, TRACKS, Status, TrackStatus
from iscat_analysis.schemas.base import (
    ABSENT,
    Closed,
    Convention,
    Count,
    Document,
    Emission,
    Mode,
    Natural,
    Notes,
    NotNegative,
    Number,
    Parameter,
    Part,
    Scheme,
    Share,
    row_model,
)

if TYPE_CHECKING:
    Event = Closed
    Track = Closed
else:
    Event = row_model("Event", "One row of fits.csv.", EVENTS, Status)
    Track = row_model("Track", "One row of tracks.csv.", TRACKS, TrackStatus)


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


class FindingEntry(Closed):
    """One thing that was found, and what to do."""

    code: str
    """Which kind of finding, from the list in the manual"""
    severity: Literal["note", "caution", "fault"]
    """How much it matters"""
    values: dict[str, float | int | str]
    """The values of its sentence"""
    frames: tuple[Count, Count] | None
    """Frames that it is about [start, stop)"""
    text: str
    """The sentence, as it is printed"""
    remedy: str
    """What to do; empty where nothing is to be done"""


class Medians(Document):
    """Medians of one free parameter over the events that are ok."""

    sigma_median: Number
    """Standard deviation from the curvature of the likelihood [nm or kDa]"""
    crb_median: Number
    """Cramér–Rao bound [nm or kDa]"""
    qcrb_median: Number
    """Quantum Cramér–Rao bound [nm or kDa]"""
    holevo_median: Number = ABSENT
    """Holevo bound of all free parameters at once, if height and mass are both free [nm, kDa]"""
    sigma_over_crb_median: Number
    """Near 1 by construction: σ and CRB are both from the model"""
    information_fraction_median: Number
    """(QCRB/CRB)², or (Holevo/CRB)² if height and mass are both free: the share of the light's
    accessible information that is used"""
    systematic_median: Number = ABSENT
    """Error common to the movie, from calibrations [nm or kDa]"""
    repeat_over_crb: Number = ABSENT
    """Measured spread over the Cramér–Rao bound: from parts of the events' own frames and, at full
    length, from places without a particle; in mode track only from these places"""
    repeat_over_crb_ci95: tuple[Number, Number] = ABSENT
    """Its 95 % interval"""
    repeat_significance: Number = ABSENT
    """Its difference from 1, in standard errors"""
    repeat_events: Count = ABSENT
    """Events whose frames were compared"""
    repeat_whole: bool = ABSENT
    """Whether the noise was seen at the full length of the windows; otherwise in parts of them"""
    repeat_frames: list[Number] = ABSENT
    """Frames averaged; in mode track, frames from a frame to the middle of the background"""
    repeat_over_crb_by_frames: list[Number] = ABSENT
    """Spread of averages of this number of the events' own frames over their bound; in mode track,
    spread of single frames at this distance from the background, without a particle"""
    repeat_over_crb_by_frames_se: list[Number] = ABSENT
    """Its standard errors"""
    empty_over_crb: list[Number] = ABSENT
    """The same without a particle: between eight parts of a window, neighbouring eighths, quarters,
    halves, and whole windows; in mode track between successive frames, and of all against the
    background; empty if the field has no such places"""


class Input(Document):
    """The movie that was read."""

    path: str
    """Path as it was given"""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    """SHA-256 of its bytes"""
    shape: tuple[Count, Count, Count] | None = ABSENT
    """Frames, rows and columns"""


class Versions(Part):
    """Versions of this program, of Python and of the numerical libraries."""

    model_config = ConfigDict(extra="allow", validate_by_name=True)
    __pydantic_extra__: dict[str, str]

    program: str = Field(alias="iscat-analysis")
    """This program"""
    python: str
    """Python"""
    numpy: str
    """NumPy"""


class Spectrum(Closed):
    """Noise between neighbouring frames that is not white, or not of the expected size."""

    variance_over_shot: Number
    """Of a pixel, over the expected variance"""
    neighbour_correlation: list[Number]
    """Of a pixel with the next one, in x and in y"""
    row_share: NotNegative
    """Part of the variance that a whole row has in common"""
    column_share: NotNegative
    """Part of the variance that a whole column has in common"""


class Lines(Closed):
    """Flicker and changes of the light over the field, which were divided out of each frame."""

    row_share: NotNegative
    """Part of the noise variance that each row had in common"""
    column_share: NotNegative
    """Part of the noise variance that each column had in common"""
    smooth_degree: Count
    """Degree of the polynomial in x and y, of smooth changes; 0: none"""
    smooth_rms: NotNegative
    """Relative rms of smooth changes between frames that are compared"""
    fringe_periods_px: list[NotNegative]
    """Periods of fringes that passed over the field"""
    fringe_rms: NotNegative
    """Relative rms of their changes between frames that are compared"""
    seam_rows: list[Count]
    """First rows of parts of the field that had factors of their own"""
    seam_columns: list[Count]
    """First columns of such parts"""
    haze: NotNegative
    """Range of the light added to all pixels, over the mean light; 0: none"""


class Noise(Document):
    """Noise against averaging, and the drift of the fixed pattern."""

    noise_frames: list[Count]
    """Frames averaged"""
    noise_variance_over_shot: list[Number]
    """Variance over that of the photoelectrons"""
    shot_noise_limited_frames: int | None
    """Frames that may be averaged before other noise"""
    noise_spectrum: Spectrum | None
    """Between neighbouring frames; null if it is as expected"""


class Background(Noise):
    """A movie with background frames: its noise, and its drift to the frames after."""

    drift_px: tuple[float, float] | None
    """Drift of the fixed pattern along y and x [px]; null if there is no pattern to follow"""
    drift_error_px: tuple[float, float] | None
    """Its standard errors [px]"""


class JudgedBy(Closed):
    """The sample of pixels by which the noise of a large field was judged."""

    pixels: Count
    """Pixels that were looked at, in squares all over the field"""
    of: Count
    """Pixels of the field"""
    side_px: Count
    """Side of a square [px]"""
    corners_px: list[tuple[Count, Count]]
    """First row and column of each square"""
    seed: Count
    """Of their places"""
    noise_ratio: NotNegative
    """Noise variance between neighbouring frames over the light's"""
    noise_ratio_se: NotNegative
    """Its standard error, from the scatter of the squares"""


class Landing(Document):
    """A landing movie: its windows, what was searched, and its drift."""

    window_frames: Natural = ABSENT
    """Frames in each window"""
    landings: Count = ABSENT
    """Events that land"""
    leavings: Count = ABSENT
    """Events that leave"""
    noise_frames: list[Count] = ABSENT
    """Frames averaged"""
    noise_variance_over_shot: list[Number] = ABSENT
    """Variance over that of the photoelectrons"""
    shot_noise_limited_frames: int | None = ABSENT
    """Frames that may be averaged before other noise"""
    noise_spectrum: Spectrum | None = ABSENT
    """Between neighbouring frames; null if as expected"""
    judged_by: JudgedBy = ABSENT
    """Of fields of more than 512 × 512 pixels: where noise was judged"""
    stride_frames: Natural = ABSENT
    """From one searched boundary to the next"""
    boundaries_searched: Count = ABSENT
    """Boundaries that share the expected false alarms"""
    searched_share: Share | None = ABSENT
    """Share of field and time in which a particle of searched_snr is found; elsewhere residuals of
    bright or badly described particles hide it"""
    searched_snr: NotNegative = ABSENT
    """Median signal-to-noise ratio of the events that are ok"""
    partly_searched: list[tuple[Count, Count, Share]] = ABSENT
    """Frames [start, stop) in which a part of the field was hidden, and the share that was not"""
    frames_left_out: Count = ABSENT
    """Frames that the camera dropped or repeated"""
    drift_px: list[float] | None = ABSENT
    """Drift over the movie along y and x [px]"""
    drift_corrected: bool = ABSENT
    """Whether the motion of the fixed pattern was divided out"""
    drift_frames: list[float] | None = ABSENT
    """Mean frames of the blocks in which it was followed"""
    drift_x_px: list[float] | None = ABSENT
    """Motion along x in each block [px]"""
    drift_y_px: list[float] | None = ABSENT
    """Motion along y in each block [px]"""
    drift_error_px: Number = ABSENT
    """Standard error from one block to the next [px]"""
    chunks: Count = ABSENT
    """Parts in time that the movie was analysed in"""
    tiles: Count = ABSENT
    """Parts of the field that each of them was divided into"""


class Injection(Closed):
    """Known particles added to the movie: how many were found again, and how well."""

    stay_frames: Count | None = ABSENT
    """Least number of frames that an added particle stays; recall is not for shorter stays"""
    added: Count
    """Steps added: each particle lands, and leaves unless the movie ends first"""
    recovered: Count
    """Steps found again"""
    recall: Share
    """Their share"""
    predicted: Share = ABSENT
    """Recall expected from the Fisher information of the masses added, in the share searched"""
    isolated: Count
    """Steps with no other one near in place and time"""
    recall_isolated: Share
    """Share of these that was found"""
    bias_rel: float = ABSENT
    """Mean relative error of the mass; from here on: of two or more isolated"""
    bias_rel_se: NotNegative = ABSENT
    """Its standard error"""
    spread_over_crb: NotNegative = ABSENT
    """Standard deviation of mass errors in units of their CRB"""
    spread_over_crb_se: NotNegative = ABSENT
    """Its standard error"""
    pull_std: NotNegative = ABSENT
    """The same in units of σ"""
    frame_within_1: Share = ABSENT
    """Share whose frame is off by one at most"""
    frame_in_interval: Share = ABSENT
    """Share whose frame lies inside frame_ci95"""


class Across(Closed):
    """How much wider than σ a species is."""

    mass_kda: Number
    """Its mass [kDa]"""
    width_kda: Number
    """Its width beyond σ [kDa]"""
    width_low: Number
    """End of the 95 % interval of the width [kDa]"""
    width_high: Number
    """The other end [kDa]"""
    count: Number
    """Its events"""
    spread_over_sigma: Number
    """Scatter of its events over their median σ"""
    explained_kda: NotNegative = ABSENT
    """Width that the budget explains [kDa]"""


class Repeats(Closed):
    """Whether the measured spread agrees with σ."""

    understated: bool
    """Whether σ is smaller than the measured spread; --strict fails then"""
    message: str
    """Warning for the user; empty if they agree"""
    cause: str
    """The likely kind of noise"""


class CameraNumber(Closed):
    """A number of the camera."""

    value: Number
    """The number that was used; of a map the mean"""
    se: NotNegative
    """Its standard error; 0 if it is not known"""
    from_: str = Field(alias="from")
    """measured from the movie's light, dark frames, rounding, effective (of frames that are not
    raw), metadata, configured or assumed"""


class CameraLaw(Closed):
    """How the counts of the camera grow with the light."""

    kind: str
    """linear, offset, read noise, noisy light, gamma, saturation, or other light, which does not
    follow the laser"""
    value: Number
    """Its parameter: the exponent of gamma, the filling of pixels, or a share of the light"""
    se: NotNegative
    """Its standard error"""
    contrast: Number
    """Contrast that is measured, over the true one"""
    contrast_se: NotNegative
    """Its standard error"""
    alike: list[str]
    """Other laws that describe the pixels as well"""
    flickers: bool
    """Whether the laser's power changes enough to distinguish the laws"""


class CameraNumbers(Closed):
    """The camera: numbers, their errors, and where they come from."""

    gain_e_per_adu: CameraNumber
    """Photoelectrons per count [e]"""
    offset_adu: CameraNumber
    """Counts in the dark [counts]"""
    read_noise_e: CameraNumber
    """Read noise, standard deviation per frame [e]"""
    light_adu: NotNegative = ABSENT
    """If known: counts above the offset in the usual pixel"""
    law: CameraLaw = ABSENT
    """If the pixels differ in brightness: how counts grow with the light"""


class Processed(Closed):
    """Processing of the frames after the camera."""

    kind: Literal["interpolated", "smoothed", "sharpened"]
    """What it was"""
    finest: NotNegative
    """Noise of the finest patterns over that of coarser ones; 1 if raw"""
    uneven: NotNegative
    """Its relative change from frame to frame; 0 if raw"""


class Changes(Closed):
    """Clear changes between averages of 20 frames, in the first 2000 frames at most."""

    number: Count
    """Changes above 12 standard deviations, away from each other"""
    staying: Share
    """Share that stay, with one image: particles that land or leave"""
    moving: Share
    """Share around which there are three images or more: particles that move"""


class Blocks(Closed):
    """Mode track without background frames: blocks of frames, each with its own background."""

    number: Count
    """How many"""
    frames: Count
    """Frames of the longest"""
    drift_px: tuple[float, float] | None
    """Shift of the fixed pattern from the first frames to the last (y, x) [px]; null if it was not
    measured, or there is no pattern to follow"""
    drift_over_counting: Number
    """Variance that this shift adds to a background within its block, over its counting noise"""


class Heights(Closed):
    """Heights of the particles in mode mass, beyond the errors of each."""

    mean_nm: Number
    """Mean [nm]; if heights are held, one scoring step from there"""
    mean_se_nm: NotNegative
    """Its standard error [nm]"""
    sd_nm: NotNegative
    """Standard deviation of the heights [nm]"""
    sd_ci95_nm: tuple[NotNegative, NotNegative]
    """Its 95 % interval [nm]"""
    events: Count
    """Events used"""
    held: bool
    """Whether one height was held for all, so that no row has its own"""
    mean_is_of_learned_optics: bool
    """Whether the optics were learned from the same particles: focus and common height cannot be
    told apart then, and the mean is that of the learned optics"""


class Extension(Closed):
    """Width of the particles' images beyond that of the model."""

    variance_nm2: Number
    """Variance of positions along each axis, from the widths [nm²]"""
    variance_se_nm2: Number
    """Its standard error [nm²]"""
    posterior_mean_nm2: Number
    """Mean of its posterior, with length, motion and prior [nm²]"""
    posterior_sd_nm2: Number
    """Its standard deviation [nm²]"""
    flagged: Count
    """Rows that are flagged extended for it"""
    paired: Count
    """Rows that have the mass of two halves"""


class Fluctuation(Closed):
    """Slow fluctuation of contrasts while particles are there, part of sigma_mass_kda."""

    probability: Share
    """Probability that contrasts fluctuate"""
    relative: NotNegative
    """Standard deviation over the contrast, if they do"""
    relative_se: NotNegative
    """Its standard error"""
    frames: NotNegative
    """Correlation time [frames]"""


class Mixture(Part):
    """How a mixture of populations was chosen."""

    selection: list[dict[str, Any]]
    """Log-likelihood and BIC of each number tried"""
    support: Number
    """Share of simulated repetitions in which BIC chose the same number"""
    draws: int
    """Simulated repetitions"""
    seed: int
    """Seed of the bootstrap"""
    notes: Notes


class Distribution(Mixture, Document):
    """Species, as a mixture fitted to the events that are ok, each with its own error."""

    branch: Literal["magnitude", "landing", "leaving"]
    """Which events; magnitude: all, |mass|"""
    events: Count
    """Events used"""
    species: list[dict[str, Any]]
    """By rising mass [kDa], that where the peak of a species is highest; mean_kda is its mean;
    *_low and *_high are 95 % intervals of a parametric bootstrap; width_kda is beyond measurement
    error; mass_systematic is the error of the mass scale, which the interval of the mass includes;
    efficiency is for particles that stay as long as the window, and half of those that stay
    stay_frames are found; count is of the events found, count_corrected and fraction are of the
    particles that landed; an outlier is no species, but fewer than three events, or the background,
    which comes last and has neither mass nor fraction; a species that is detected less than once in
    20 times, or whose share is not known to a factor of three, is not determined, and
    count_corrected, fraction and interval are null"""
    histogram: dict[str, Any]
    """Columns low_kda, high_kda [kDa], count, and its 95 % interval count_low, count_high"""
    curves: dict[str, Any]
    """Columns mass_kda [kDa]; density (kernel), density_se, model and model_corrected [events per
    kDa]; efficiency"""
    bandwidth_kda: Number
    """Bandwidth of the kernel density [kDa]"""


class Sizes(Mixture, Closed):
    """Populations of diameters, as a log-normal mixture in which each sphere has its own error."""

    spheres: Count
    """Spheres used"""
    populations: list[dict[str, Any]]
    """By rising median diameter_nm [nm]; geometric_sd is of the diameters beyond their errors;
    fraction is of the spheres seen; *_low and *_high are 95 % intervals of a parametric bootstrap,
    that of the median with the error common to all spheres, diameter_systematic; an outlier has
    fewer than three spheres"""
    histogram: dict[str, Any]
    """Columns low_nm, high_nm [nm], count, and its 95 % interval count_low, count_high"""
    curve: dict[str, Any]
    """Columns diameter_nm [nm] and model [spheres per nm], with errors"""


class BudgetEntry(Closed):
    """One source of the error of a mass: medians over the rows that are ok."""

    name: str
    """What it is"""
    kind: Literal["measured", "learned", "assumed"]
    """How its size is known"""
    common: bool
    """Whether all rows share it; these add up to systematic_mass_kda"""
    sigma_mass_kda: Number
    """Its standard deviation [kDa]; null if it is not known"""
    sigma_rel: Number
    """The same over the mass"""
    dof: Number
    """Degrees of freedom; null if there are many, or it was not measured"""
    remedy: str
    """What would reduce it"""


class Scale(Closed):
    """The conversion of the mass scale from the optics of the standards to those of the movie."""

    carried: Number
    """Contrast per kDa with these optics over that with the standards'"""
    optics: Literal["recorded", "configured"]
    """Source of the standards' optics: stored with the calibration, or else the configuration"""
    refusal: str | None
    """Why the model cannot convert the scale; rows are flagged"""


class Break(Closed):
    """Frames before and after which are not compared with each other."""

    start: Count
    """First frame that is left out, or the first one after a cut"""
    stop: Count
    """One past the last; the same as start where none is left out"""
    cause: str
    """What it looks like"""


class Text(Closed):
    """A rectangle of pixels into which a text is burnt."""

    rows: tuple[Count, Count]
    """Rows [start, stop)"""
    columns: tuple[Count, Count]
    """Columns [start, stop)"""


class LeftOut(Closed):
    """Frames and pixels that are no measurement."""

    analysed: list[tuple[Count, Count]]
    """Frames [start, stop) that are analysed together"""
    breaks: list[Break]
    """Where landing movies break, and why"""
    texts: list[Text]
    """Texts that are burnt in"""


class Interval(Closed):
    """Frames of which something is to be said."""

    start: Count
    """First frame"""
    stop: Count
    """One past the last; the same as start for a cut"""
    what: str
    """What it is"""


class EventCounts(Closed):
    """Events in parts of the movie."""

    edges: list[Count]
    """Frames at which the parts begin, and one past the last"""
    ok: list[Count]
    """Events whose status is ok"""
    flagged: list[Count]
    """Other events, side lobes left out"""


class Timeline(Closed):
    """What was where in a movie, on one axis of frames; null where a part says nothing."""

    frames: list[float]
    """Mean frames of the places at which some frames were looked at"""
    light_e: list[Number]
    """Mean light of a pixel [photoelectrons]"""
    noise_over_expected: list[Number]
    """Variance between neighbouring frames over that of light and read noise"""
    focus_nm: list[Number]
    """Focus with which the frames were fitted [nm]"""
    drift_x_px: list[Number]
    """Shift of the fixed pattern along x from the first place [px]"""
    drift_y_px: list[Number]
    """The same along y [px]"""
    intervals: list[Interval]
    """Frames that were left out, or partly hidden"""
    events: EventCounts
    """Events per time"""


class Motion(Document):
    """Medians and counts of the tracks of a movie; medians are over those that are ok."""

    frame_rate_hz: Number
    """Frames per second; null: there is no D"""
    exposure_ms: Number
    """Time over which motion is averaged; null: all of it"""
    status: dict[str, Count]
    """Tracks by status"""
    flags: dict[str, Count]
    """Tracks by remark"""
    medians: dict[str, Number]
    """Of n_frames, mass, D, diameter and refractive index"""
    sigma_d_over_d_median: Number
    """Median of σ of D over D"""
    begin_inside: Count
    """Tracks that begin inside the field after the first frame"""
    end_inside: Count
    """Tracks that end inside the field before the last frame"""
    cross_border: Count
    """Tracks that begin or end at the border of the field"""
    crossed: Count
    """Tracks that came nearer than detection.min_separation_nm to another"""


class Summary(Document):
    """What iscat fit writes into its output folder as summary.json."""

    events: Count
    """How many events there are"""
    mode: Mode
    """Mode: which parameters were free"""
    scheme: Scheme
    """Optical scheme"""
    emission: Emission
    """Emission model"""
    convention: Convention
    """Formulas"""
    mass_scale: str
    """Where the mass scale comes from: a calibration, the volume and density of spheres, or the
    model"""
    scale: Scale = ABSENT
    """With a calibration: its conversion to the optics of the movie"""
    status: dict[str, Count]
    """Events by status"""
    no_events: dict[str, Count] = ABSENT
    """Rows of fits.csv that are no events, by status"""
    frames_before: tuple[Count, Count] | None
    """Background frames [start, stop)"""
    frames_after: tuple[Count, Count] | None
    """Fitted frames [start, stop)"""
    power_ratio: Number
    """Total laser power after over before"""
    power_spread: Number
    """Standard deviation of the relative power"""
    masked_pixels: Count
    """Dead, hot or saturated pixels that were left out"""
    detection_threshold_snr: Number
    """Signal over noise above which a candidate counts"""
    medians: dict[str, Number]
    """Medians over the events with status ok"""
    precision: dict[Parameter, Medians]
    """Spread beside the bounds, by free parameter"""
    seconds: dict[str, NotNegative]
    """Wall time by stage [s]"""
    input: Input
    """The movie"""
    seed: int | None
    """Seed of the posterior sampler"""
    versions: Versions
    """Of this program, Python and the numerical libraries"""
    findings: list[FindingEntry]
    """What the user should know, the most severe first"""
    warnings: list[str]
    """Sentences of the findings that are more than a note, as printed"""
    interrupted: bool = ABSENT
    """Whether an interrupt ended the run early"""
    camera: CameraNumbers = ABSENT
    """The camera's numbers, and where they come from"""
    background: Background = ABSENT
    """Movies with background frames: noise and drift"""
    landing: Landing = ABSENT
    """Landing movies: windows, search, noise and drift"""
    injection: Injection = ABSENT
    """With --inject: known particles added to the movie"""
    left_out: LeftOut = ABSENT
    """Frames and pixels that are no measurement"""
    timeline: Timeline = ABSENT
    """Light, noise, focus, drift and events against frame"""
    processing: Processed = ABSENT
    """If the frames were processed after the camera"""
    changes: Changes = ABSENT
    """Landing movies and mode track: whether particles land or move"""
    blocks: Blocks = ABSENT
    """Mode track: blocks of frames, each with its own background"""
    tracks: Count = ABSENT
    """Mode track: tracks found"""
    motion: Motion = ABSENT
    """Mode track: medians and counts of the tracks"""
    budget: list[BudgetEntry] = ABSENT
    """If masses are fitted: the sources of their error"""
    across_particles: list[Across] = ABSENT
    """Width of each species beyond σ; if the model is rejected, poor fits are counted too"""
    heights: Heights = ABSENT
    """Mode mass: mean and spread of the heights"""
    extension: Extension = ABSENT
    """Mode mass: width of the images beyond that of the model"""
    fluctuation: Fluctuation = ABSENT
    """Mode mass: slow fluctuation of contrasts, if the frames speak for one"""
    repeats: Repeats = ABSENT
    """Whether the measured spread agrees with σ"""
    lines: Lines = ABSENT
    """If rows, columns or a smooth part of the light changed, and were corrected"""
    optics: Learned = ABSENT
    """If the optics were tested: the test, and the learned optics"""
    distribution: Distribution | None = ABSENT
    """Species; null if masses are not fitted once per event, and of spheres"""
    sizes: Sizes | None = ABSENT
    """Spheres: populations of diameters; null for fewer than ten"""


class Fit(Summary):
    """What iscat fit prints: the summary, with events and tracks in place of their numbers."""

    events: list[Event]  # type: ignore[assignment]
    """The rows of fits.csv"""
    tracks: list[Track] = ABSENT  # type: ignore[assignment]
    """Mode track: the rows of tracks.csv"""
    out: str
    """Output folder"""


class TrueEvent(Closed):
    """One particle of a simulated movie, or one that moves in one frame."""

    event: Count
    """Number of the particle"""
    frame: int
    """First frame with the particle"""
    leave: int | None
    """First frame without it again"""
    x_px: float
    """Column, 0-based; an integer is a pixel's centre [px]"""
    y_px: float
    """Row, downwards, 0-based; an integer is a pixel's centre [px]"""
    x_nm: float
    """x_px times the pixel size [nm]"""
    y_nm: float
    """y_px times the pixel size [nm]"""
    z_nm: float
    """Height above the coverslip [nm]"""
    mass_kda: float
    """Mass [kDa]"""
    contrast: Number
    """Signed peak contrast; null in dark field and for particles that move up and down"""
    track: int | None = ABSENT
    """Number of the track; null for particles that do not move"""
    d_um2_s: Number = ABSENT
    """Diffusion coefficient along each axis [µm²/s]"""
    x_middle_nm: Number = ABSENT
    """Column in the middle of the exposure; x_nm is its average [nm]"""
    y_middle_nm: Number = ABSENT
    """Row in the middle of the exposure [nm]"""
    z_middle_nm: Number = ABSENT
    """Height in the middle of the exposure [nm]"""


class Simulate(Document):
    """What iscat simulate prints: the movie that was written and the truth beside it."""

    stack: str
    """The movie"""
    truth: str
    """The CSV file of the truth"""
    events: list[TrueEvent]
    """The rows of that file"""
