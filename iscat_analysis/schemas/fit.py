"""Documents of ``iscat fit`` and ``iscat simulate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from iscat_analysis.records import EVENTS, TRACKS, Status, TrackStatus
from iscat_analysis.schemas.base import (
    Closed,
    Convention,
    Count,
    Document,
    Emission,
    Error,
    High,
    KnownError,
    Mode,
    Natural,
    Notes,
    NotNegative,
    Number,
    Parameter,
    Scheme,
    Share,
    key,
    maybe,
    row_model,
)
from iscat_analysis.schemas.calibration import Learned

if TYPE_CHECKING:
    Event = Closed
    Track = Closed
else:
    Event = row_model("Event", "One row of fits.csv.", EVENTS, Status)
    Track = row_model("Track", "One row of tracks.csv.", TRACKS, TrackStatus)


class FindingEntry(Closed):
    """One thing that was found, and what to do."""

    code: str = key("Which kind of finding, from the list in the manual")
    severity: Literal["note", "caution", "fault"] = key("How much it matters")
    values: dict[str, float | int | str] = key("The values of its sentence")
    frames: tuple[Count, Count] | None = key("Frames that it is about [start, stop)")
    text: str = key("The sentence, as it is printed")
    remedy: str = key("What to do; empty where nothing is to be done")


class Medians(Document):
    """Medians of one free parameter over the events that are ok."""

    sigma_median: Number = key("Standard deviation by the likelihood's curvature [nm or kDa]")
    crb_median: Number = key("Cramér–Rao bound [nm or kDa]")
    qcrb_median: Number = key("Quantum Cramér–Rao bound [nm or kDa]")
    holevo_median: Number = maybe("Holevo bound, if height and mass are both free [nm, kDa]")
    sigma_over_crb_median: Number = key("Near 1 by construction: σ and CRB are both from the model")
    information_fraction_median: Number = key(
        "(QCRB/CRB)², or (Holevo/CRB)² if height and mass are both free: the share of the light's "
        "accessible information that is used"
    )
    systematic_median: Number = maybe("Error common to the movie, from calibrations [nm or kDa]")
    repeat_over_crb: Number = maybe(
        "Measured spread over the Cramér–Rao bound: from parts of the events' own frames and, at "
        "full length, from places without a particle; in mode track only from these places"
    )
    repeat_over_crb_ci95: tuple[Number, Number] = maybe("Its 95 % interval")
    repeat_significance: Number = maybe("Its difference from 1, in standard errors")
    repeat_events: Count = maybe("Events whose frames were compared")
    repeat_whole: bool = maybe("Whether it holds at the full length of the windows")
    repeat_frames: list[Number] = maybe("Frames averaged; in mode track, to the background")
    repeat_over_crb_by_frames: list[Number] = maybe(
        "Spread of averages of this number of the events' own frames over their bound; in mode "
        "track, spread of single frames at this distance from the background, without a particle"
    )
    repeat_over_crb_by_frames_se: list[Number] = maybe("Its standard errors")
    empty_over_crb: list[Number] = maybe(
        "The same without a particle: between eight parts of a window, neighbouring eighths, "
        "quarters, halves, and whole windows; in mode track between successive frames, and of all "
        "against the background; empty if the field has no such places"
    )


class Input(Document):
    """The movie that was read."""

    path: str = key("Path as it was given")
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] = key("SHA-256 of its bytes")
    shape: tuple[Count, Count, Count] | None = maybe("Frames, rows and columns")


class Versions(BaseModel):
    """Versions of this program, of Python and of the numerical libraries."""

    model_config = ConfigDict(extra="allow", validate_by_name=True)
    __pydantic_extra__: dict[str, str]

    program: str = Field(alias="iscat-analysis", description="This program")
    python: str = key("Python")
    numpy: str = key("NumPy")


class Spectrum(Closed):
    """Noise between neighbouring frames that is not white, or not of the expected size."""

    variance_over_shot: Number = key("Of a pixel, over the expected variance")
    neighbour_correlation: list[Number] = key("Of a pixel with the next one, in x and in y")
    row_share: NotNegative = key("Part of the variance that a whole row has in common")
    column_share: NotNegative = key("Part of the variance that a whole column has in common")


class Lines(Closed):
    """Flicker and changes of the light over the field, which were divided out of each frame."""

    row_share: NotNegative = key("Part of the noise variance that each row had in common")
    column_share: NotNegative = key("Part of the noise variance that each column had in common")
    smooth_degree: Count = key("Degree of the polynomial in x and y, of smooth changes; 0: none")
    smooth_rms: NotNegative = key("Relative rms of smooth changes between frames that are compared")
    fringe_periods_px: list[NotNegative] = key("Periods of fringes that passed over the field")
    fringe_rms: NotNegative = key("Relative rms of their changes between frames that are compared")
    seam_rows: list[Count] = key("First rows of parts of the field that had factors of their own")
    seam_columns: list[Count] = key("First columns of such parts")
    haze: NotNegative = key("Range of the light added to all pixels, over the mean light; 0: none")


class Noise(Document):
    """Noise against averaging, and the drift of the fixed pattern."""

    noise_frames: list[Count] = key("Frames averaged")
    noise_variance_over_shot: list[Number] = key("Variance over that of the photoelectrons")
    shot_noise_limited_frames: int | None = key("Frames that may be averaged before other noise")
    noise_spectrum: Spectrum | None = key("Between neighbouring frames; null if it is as expected")


class Background(Noise):
    """A movie with background frames: its noise, and its drift to the frames after."""

    drift_px: tuple[float, float] | None = key("Of the fixed pattern along y and x [px]")
    drift_error_px: tuple[float, float] | None = key("Its standard errors [px]")


class JudgedBy(Closed):
    """The sample of pixels by which the noise of a large field was judged."""

    pixels: Count = key("Pixels that were looked at, in squares all over the field")
    of: Count = key("Pixels of the field")
    side_px: Count = key("Side of a square [px]")
    corners_px: list[tuple[Count, Count]] = key("First row and column of each square")
    seed: Count = key("Of their places")
    noise_ratio: NotNegative = key("Noise variance between neighbouring frames over the light's")
    noise_ratio_se: NotNegative = key("Its standard error, from the scatter of the squares")


class Landing(Document):
    """A landing movie: its windows, what was searched, and its drift."""

    window_frames: Natural = maybe("Frames in each window")
    landings: Count = maybe("Events that land")
    leavings: Count = maybe("Events that leave")
    noise_frames: list[Count] = maybe("Frames averaged")
    noise_variance_over_shot: list[Number] = maybe("Variance over that of the photoelectrons")
    shot_noise_limited_frames: int | None = maybe("Frames that may be averaged before other noise")
    noise_spectrum: Spectrum | None = maybe("Between neighbouring frames; null if as expected")
    judged_by: JudgedBy = maybe("Of fields of more than 512 × 512 pixels: where noise was judged")
    stride_frames: Natural = maybe("From one searched boundary to the next")
    boundaries_searched: Count = maybe("Boundaries that share the expected false alarms")
    searched_share: Share | None = maybe(
        "Share of field and time in which a particle of searched_snr is found; elsewhere residuals "
        "of bright or badly described particles hide it"
    )
    searched_snr: NotNegative = maybe("Median signal-to-noise ratio of the events that are ok")
    partly_searched: list[tuple[Count, Count, Share]] = maybe("[start, stop), share not hidden")
    frames_left_out: Count = maybe("Frames that the camera dropped or repeated")
    drift_px: list[float] | None = maybe("Drift over the movie along y and x [px]")
    drift_corrected: bool = maybe("Whether the motion of the fixed pattern was divided out")
    drift_frames: list[float] | None = maybe("Mean frames of the blocks in which it was followed")
    drift_x_px: list[float] | None = maybe("Motion along x in each block [px]")
    drift_y_px: list[float] | None = maybe("Motion along y in each block [px]")
    drift_error_px: Number = maybe("Standard error from one block to the next [px]")
    chunks: Count = maybe("Parts in time that the movie was analysed in")
    tiles: Count = maybe("Parts of the field that each of them was divided into")


class Injection(Closed):
    """Known particles added to the movie: how many were found again, and how well."""

    stay_frames: Count | None = maybe("Least stay of an added particle [frames]")
    added: Count = key("Steps added: each particle lands, and leaves unless the movie ends first")
    recovered: Count = key("Steps found again")
    recall: Share = key("Their share")
    predicted: Share = maybe("Expected from the Fisher information where searched")
    isolated: Count = key("Steps with no other one near in place and time")
    recall_isolated: Share = key("Share of these that was found")
    bias_rel: float = maybe("Mean relative error of the mass; of two or more isolated")
    bias_rel_se: NotNegative = maybe("Its standard error")
    spread_over_crb: NotNegative = maybe("Standard deviation of mass errors in units of their CRB")
    spread_over_crb_se: NotNegative = maybe("Its standard error")
    pull_std: NotNegative = maybe("The same in units of σ")
    frame_within_1: Share = maybe("Share whose frame is off by one at most")
    frame_in_interval: Share = maybe("Share whose frame lies inside frame_ci95")


class Across(Closed):
    """How much wider than σ a species is."""

    mass_kda: Number = key("Its mass [kDa]")
    width_kda: Number = key("Its width beyond σ [kDa]")
    width_low: Number = key("End of the 95 % interval of the width [kDa]")
    width_high: High
    count: Number = key("Its events")
    spread_over_sigma: Number = key("Scatter of its events over their median σ")
    explained_kda: NotNegative = maybe("Width that the budget explains [kDa]")


class Repeats(Closed):
    """Whether the measured spread agrees with σ."""

    understated: bool = key("Whether σ is smaller than the measured spread; --strict fails then")
    message: str = key("Warning for the user; empty if they agree")
    cause: str = key("The likely kind of noise")


class CameraNumber(Closed):
    """A number of the camera."""

    value: Number = key("The number that was used; of a map the mean")
    se: NotNegative = key("Its standard error; 0 if it is not known")
    from_: str = Field(
        alias="from",
        description="measured from the movie's light, dark frames, rounding, effective (of frames "
        "that are not raw), metadata, configured or assumed",
    )


class CameraLaw(Closed):
    """How the counts of the camera grow with the light."""

    kind: str = key(
        "linear, offset, read noise, noisy light, gamma, saturation, or other light, which does "
        "not follow the laser"
    )
    value: Number = key("Exponent of gamma, filling of pixels, or share of light")
    se: KnownError
    contrast: Number = key("Contrast that is measured, over the true one")
    contrast_se: KnownError
    alike: list[str] = key("Other laws that describe the pixels as well")
    flickers: bool = key("Whether the laser's power changes enough to distinguish the laws")


class CameraNumbers(Closed):
    """The camera: numbers, their errors, and where they come from."""

    gain_e_per_adu: CameraNumber = key("Photoelectrons per count [e]")
    offset_adu: CameraNumber = key("Counts in the dark [counts]")
    read_noise_e: CameraNumber = key("Read noise, standard deviation per frame [e]")
    light_adu: NotNegative = maybe("If known: counts above the offset in the usual pixel")
    law: CameraLaw = maybe("If the pixels differ in brightness: how counts grow with the light")


class Processed(Closed):
    """Processing of the frames after the camera."""

    kind: Literal["interpolated", "smoothed", "sharpened"] = key("What it was")
    finest: NotNegative = key("Noise of the finest patterns over that of coarser ones; 1 if raw")
    uneven: NotNegative = key("Its relative change from frame to frame; 0 if raw")


class Changes(Closed):
    """Clear changes between averages of 20 frames, in the first 2000 frames at most."""

    number: Count = key("Changes above 12 standard deviations, away from each other")
    staying: Share = key("Share that stay, with one image: particles that land or leave")
    moving: Share = key("Share around which there are three images or more: particles that move")


class Blocks(Closed):
    """Mode track without background frames: blocks of frames, each with its own background."""

    number: Count = key("How many")
    frames: Count = key("Frames of the longest")
    drift_px: tuple[float, float] | None = key(
        "Shift of the fixed pattern from the first frames to the last (y, x) [px]; null if it was "
        "not measured, or there is no pattern to follow"
    )
    drift_over_counting: Number = key("Variance it adds to a background over counting noise")


class Heights(Closed):
    """Heights of the particles in mode mass, beyond the errors of each."""

    mean_nm: Number = key("Mean [nm]; if heights are held, one scoring step from there")
    mean_se_nm: KnownError
    sd_nm: NotNegative = key("Standard deviation of the heights [nm]")
    sd_ci95_nm: tuple[NotNegative, NotNegative] = key("Its 95 % interval [nm]")
    events: Count = key("Events used")
    held: bool = key("Whether one height was held for all, so that no row has its own")
    mean_is_of_learned_optics: bool = key(
        "Whether the optics were learned from the same particles: focus and common height cannot "
        "be told apart then, and the mean is that of the learned optics"
    )


class Extension(Closed):
    """Width of the particles' images beyond that of the model."""

    variance_nm2: Number = key("Variance of positions along each axis, from the widths [nm²]")
    variance_se_nm2: Error
    posterior_mean_nm2: Number = key("Mean of its posterior, with length, motion and prior [nm²]")
    posterior_sd_nm2: Number = key("Its standard deviation [nm²]")
    flagged: Count = key("Rows that are flagged extended for it")
    paired: Count = key("Rows that have the mass of two halves")


class Fluctuation(Closed):
    """Slow fluctuation of contrasts while particles are there, part of sigma_mass_kda."""

    probability: Share = key("Probability that contrasts fluctuate")
    relative: NotNegative = key("Standard deviation over the contrast, if they do")
    relative_se: KnownError
    frames: NotNegative = key("Correlation time [frames]")


class Mixture(BaseModel):
    """How a mixture of populations was chosen."""

    selection: list[dict[str, Any]] = key("Log-likelihood and BIC of each number tried")
    support: Number = key("Share of simulated repetitions in which BIC chose the same number")
    draws: int = key("Simulated repetitions")
    seed: int = key("Seed of the bootstrap")
    notes: Notes


class Distribution(Mixture, Document):
    """Species, as a mixture fitted to the events that are ok, each with its own error."""

    branch: Literal["magnitude", "landing", "leaving"] = key("Which events; magnitude: all, |mass|")
    events: Count = key("Events used")
    species: list[dict[str, Any]] = key(
        "By rising mass [kDa], that where the peak of a species is highest; mean_kda is its mean; "
        "*_low and *_high are 95 % intervals of a parametric bootstrap; "
        "width_kda is beyond measurement error; mass_systematic is the error of the mass scale, "
        "which the interval of the mass includes; efficiency is for particles that stay as long "
        "as the window, and half of those that stay stay_frames are found; count is of the events "
        "found, count_corrected and fraction are of the particles that landed; an outlier is no "
        "species, but fewer than three events, or the background, which comes last and has "
        "neither mass nor fraction; a species that is detected less than once in 20 times, or "
        "whose share is not known to a factor of three, is not determined, and count_corrected, "
        "fraction and interval are null"
    )
    histogram: dict[str, Any] = key("Columns low_kda, high_kda, count, count_low, count_high")
    curves: dict[str, Any] = key(
        "Columns mass_kda [kDa]; density (kernel), density_se, model and model_corrected [events "
        "per kDa]; efficiency"
    )
    bandwidth_kda: Number = key("Bandwidth of the kernel density [kDa]")


class Sizes(Mixture, Closed):
    """Populations of diameters, as a log-normal mixture in which each sphere has its own error."""

    spheres: Count = key("Spheres used")
    populations: list[dict[str, Any]] = key(
        "By rising median diameter_nm [nm]; geometric_sd is of the diameters beyond their errors; "
        "fraction is of the spheres seen; *_low and *_high are 95 % intervals of a parametric "
        "bootstrap, that of the median with the error common to all spheres, diameter_systematic; "
        "an outlier has fewer than three spheres"
    )
    histogram: dict[str, Any] = key("Columns low_nm, high_nm, count, count_low, count_high")
    curve: dict[str, Any] = key("Columns diameter_nm [nm] and model [spheres per nm], with errors")


class BudgetEntry(Closed):
    """One source of the error of a mass: medians over the rows that are ok."""

    name: str = key("What it is")
    kind: Literal["measured", "learned", "assumed"] = key("How its size is known")
    common: bool = key("Whether all rows share it; these add up to systematic_mass_kda")
    sigma_mass_kda: Number = key("Its standard deviation [kDa]; null if it is not known")
    sigma_rel: Number = key("The same over the mass")
    dof: Number = key("Degrees of freedom; null if there are many, or it was not measured")
    remedy: str = key("What would reduce it")


class Scale(Closed):
    """The conversion of the mass scale from the optics of the standards to those of the movie."""

    carried: Number = key("Contrast per kDa with these optics over that with the standards'")
    optics: Literal["recorded", "configured"] = key("Where the standards' optics come from")
    refusal: str | None = key("Why the model cannot convert the scale; rows are flagged")


class Break(Closed):
    """Frames before and after which are not compared with each other."""

    start: Count = key("First frame that is left out, or the first one after a cut")
    stop: Count = key("One past the last; the same as start where none is left out")
    cause: str = key("What it looks like")


class Text(Closed):
    """A rectangle of pixels into which a text is burnt."""

    rows: tuple[Count, Count] = key("Rows [start, stop)")
    columns: tuple[Count, Count] = key("Columns [start, stop)")


class LeftOut(Closed):
    """Frames and pixels that are no measurement."""

    analysed: list[tuple[Count, Count]] = key("Frames [start, stop) that are analysed together")
    breaks: list[Break] = key("Where landing movies break, and why")
    texts: list[Text] = key("Texts that are burnt in")


class Interval(Closed):
    """Frames of which something is to be said."""

    start: Count = key("First frame")
    stop: Count = key("One past the last; the same as start for a cut")
    what: str = key("What it is")


class EventCounts(Closed):
    """Events in parts of the movie."""

    edges: list[Count] = key("Frames at which the parts begin, and one past the last")
    ok: list[Count] = key("Events whose status is ok")
    flagged: list[Count] = key("Other events, side lobes left out")


class Timeline(Closed):
    """What was where in a movie, on one axis of frames; null where a part says nothing."""

    frames: list[float] = key("Mean frames of the places at which some frames were looked at")
    light_e: list[Number] = key("Mean light of a pixel [photoelectrons]")
    noise_over_expected: list[Number] = key("Variance between frames over light and read noise")
    focus_nm: list[Number] = key("Focus with which the frames were fitted [nm]")
    drift_x_px: list[Number] = key("Shift of the fixed pattern along x from the first place [px]")
    drift_y_px: list[Number] = key("The same along y [px]")
    intervals: list[Interval] = key("Frames that were left out, or partly hidden")
    events: EventCounts = key("Events per time")


class Motion(Document):
    """Medians and counts of the tracks of a movie; medians are over those that are ok."""

    frame_rate_hz: Number = key("Frames per second; null: there is no D")
    exposure_ms: Number = key("Time over which motion is averaged; null: all of it")
    status: dict[str, Count] = key("Tracks by status")
    flags: dict[str, Count] = key("Tracks by remark")
    medians: dict[str, Number] = key("Of n_frames, mass, D, diameter and refractive index")
    sigma_d_over_d_median: Number = key("Median of σ of D over D")
    begin_inside: Count = key("Tracks that begin inside the field after the first frame")
    end_inside: Count = key("Tracks that end inside the field before the last frame")
    cross_border: Count = key("Tracks that begin or end at the border of the field")
    crossed: Count = key("Tracks that came nearer than detection.min_separation_nm to another")


class Summary(Document):
    """What iscat fit writes into its output folder as summary.json."""

    events: Count = key("How many events there are")
    mode: Mode = key("Mode: which parameters were free")
    scheme: Scheme = key("Optical scheme")
    emission: Emission = key("Emission model")
    convention: Convention = key("Formulas")
    mass_scale: str = key("Its source: a calibration, volume and density of spheres, or the model")
    scale: Scale = maybe("With a calibration: its conversion to the optics of the movie")
    status: dict[str, Count] = key("Events by status")
    no_events: dict[str, Count] = maybe("Rows of fits.csv that are no events, by status")
    frames_before: tuple[Count, Count] | None = key("Background frames [start, stop)")
    frames_after: tuple[Count, Count] | None = key("Fitted frames [start, stop)")
    power_ratio: Number = key("Total laser power after over before")
    power_spread: Number = key("Standard deviation of the relative power")
    masked_pixels: Count = key("Dead, hot or saturated pixels that were left out")
    detection_threshold_snr: Number = key("Signal over noise above which a candidate counts")
    medians: dict[str, Number] = key("Medians over the events with status ok")
    precision: dict[Parameter, Medians] = key("Spread beside the bounds, by free parameter")
    seconds: dict[str, NotNegative] = key("Wall time by stage [s]")
    input: Input = key("The movie")
    seed: int | None = key("Seed of the posterior sampler")
    versions: Versions = key("Of this program, Python and the numerical libraries")
    findings: list[FindingEntry] = key("What the user should know, the most severe first")
    warnings: list[str] = key("Sentences of the findings that are more than a note, as printed")
    interrupted: bool = maybe("Whether an interrupt ended the run early")
    camera: CameraNumbers = maybe("The camera's numbers, and where they come from")
    background: Background = maybe("Movies with background frames: noise and drift")
    landing: Landing = maybe("Landing movies: windows, search, noise and drift")
    injection: Injection = maybe("With --inject: known particles added to the movie")
    left_out: LeftOut = maybe("Frames and pixels that are no measurement")
    timeline: Timeline = maybe("Light, noise, focus, drift and events against frame")
    processing: Processed = maybe("If the frames were processed after the camera")
    changes: Changes = maybe("Landing movies and mode track: whether particles land or move")
    blocks: Blocks = maybe("Mode track: blocks of frames, each with its own background")
    tracks: Count = maybe("Mode track: tracks found")
    motion: Motion = maybe("Mode track: medians and counts of the tracks")
    budget: list[BudgetEntry] = maybe("If masses are fitted: the sources of their error")
    across_particles: list[Across] = maybe("Width of each species beyond σ, poor fits counted")
    heights: Heights = maybe("Mode mass: mean and spread of the heights")
    extension: Extension = maybe("Mode mass: width of the images beyond that of the model")
    fluctuation: Fluctuation = maybe("Mode mass: slow fluctuation of contrasts, if likely")
    repeats: Repeats = maybe("Whether the measured spread agrees with σ")
    lines: Lines = maybe("Changes of rows, columns or smooth light, corrected")
    optics: Learned = maybe("If the optics were tested: the test, and the learned optics")
    distribution: Distribution | None = maybe("Species; null if no masses, or of spheres")
    sizes: Sizes | None = maybe("Spheres: populations of diameters; null for fewer than ten")


class Fit(Summary):
    """What iscat fit prints: the summary, with events and tracks in place of their numbers."""

    events: list[Event] = key("The rows of fits.csv")  # type: ignore[assignment]
    tracks: list[Track] = maybe("Mode track: the rows of tracks.csv")  # type: ignore[assignment]
    out: str = key("Output folder")


class TrueEvent(Closed):
    """One particle of a simulated movie, or one that moves in one frame."""

    event: Count = key("Number of the particle")
    frame: int = key("First frame with the particle")
    leave: int | None = key("First frame without it again")
    x_px: float = key("Column, 0-based; an integer is a pixel's centre [px]")
    y_px: float = key("Row, downwards, 0-based; an integer is a pixel's centre [px]")
    x_nm: float = key("x_px times the pixel size [nm]")
    y_nm: float = key("y_px times the pixel size [nm]")
    z_nm: float = key("Height above the coverslip [nm]")
    mass_kda: float = key("Mass [kDa]")
    contrast: Number = key("Signed peak contrast; null in dark field, or if it moves up and down")
    track: int | None = maybe("Number of the track; null for particles that do not move")
    d_um2_s: Number = maybe("Diffusion coefficient along each axis [µm²/s]")
    x_middle_nm: Number = maybe("Column in the middle of the exposure; x_nm is its average [nm]")
    y_middle_nm: Number = maybe("Row in the middle of the exposure [nm]")
    z_middle_nm: Number = maybe("Height in the middle of the exposure [nm]")


class Simulate(Document):
    """What iscat simulate prints: the movie that was written and the truth beside it."""

    stack: str = key("The movie")
    truth: str = key("The CSV file of the truth")
    events: list[TrueEvent] = key("The rows of that file")
