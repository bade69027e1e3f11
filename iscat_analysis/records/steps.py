"""Records between steps: movies and sums of their frames, candidates, fits, verdicts, results."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import MODES, SCHEMES, ModeKind, SchemeKind
from iscat_analysis.findings import Finding, warnings_in
from iscat_analysis.text import brief

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Mapper = Callable[..., Iterable[Any]]
"""`map`, or the one of a pool."""


class Progress(Protocol):
    """Callback for the progress of a step; the command line draws a bar on stderr."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""


class Status(StrEnum):
    """The verdict on one fit; `advice` says what each asks of the user."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    AT_BOUND = "at_bound"
    AMBIGUOUS_Z = "ambiguous_z"
    AMBIGUOUS_SIZE = "ambiguous_size"
    AMBIGUOUS_DIRECTION = "ambiguous_direction"
    POOR_FIT = "poor_fit"
    TOO_CLOSE = "too_close"
    SATURATED = "saturated"
    UNCALIBRATED_OPTICS = "uncalibrated_optics"
    SIDELOBE = "sidelobe"
    NOT_DETECTED = "not_detected"
    NONLINEAR = "nonlinear"
    PROCESSED = "processed"
    CHANGING = "changing"
    EXTENDED = "extended"
    LARGE = "large"

    @property
    def advice(self) -> str:
        """What the status means and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "The fit converged, inside its bounds, and agrees with the data.",
    Status.SIDELOBE: "Not larger than the residual of a brighter particle beside it, and not "
    "counted: check focus, NA and aberrations to tell whether it is a particle.",
    Status.NOT_DETECTED: "No particle stands out from the noise of the region, as noise alone does "
    "in at most 1 of 100 regions: use more frames or more light, or check where it was cut out.",
    Status.NOT_CONVERGED: "The fit did not converge: check the optics, or enlarge fit.roi_nm.",
    Status.AT_BOUND: "The best value of a parameter is beyond its bound: of a height (widen "
    "fit.z_range_nm; at the coverslip check optics.focus_nm and the indices), of a position (no "
    "particle there, or wrong optics), or of a mass (below a calibration.offset).",
    Status.LARGE: "It is no dipole, so that its contrast does not give its mass: the column model "
    "says which sphere on the coverslip describes it, with its diameter.",
    Status.POOR_FIT: "The model does not describe the data: check focus, NA, pixel size, gain and "
    "neighbours; a large particle that fit.spheres does not describe needs mode size.",
    Status.CHANGING: "The light of the particle changes beside its step: the particle settles, "
    "bleaches, blinks or moves, or another one is at the same place; the mass is that of the mean "
    "change.",
    Status.EXTENDED: "The image is wider than that of a point: the particle wiggles by more than "
    "particle.wiggle_nm, or has separate parts, or the optics are not those configured; its mass "
    "is too small.",
    Status.AMBIGUOUS_SIZE: "Another diameter explains the data almost as well: use more frames, "
    "another focus, or a narrower fit.diameter_range_nm.",
    Status.AMBIGUOUS_Z: "Another height explains the data almost as well: use more frames, "
    "another focus, or a narrower fit.z_range_nm.",
    Status.AMBIGUOUS_DIRECTION: "Another direction of a rod explains the data almost as well: use "
    "more frames, another focus or another polarisation.",
    Status.TOO_CLOSE: "Another particle is nearer than detection.min_separation_nm: "
    "treat the mass as shared between them.",
    Status.SATURATED: "The camera is saturated here: lower the exposure or the laser power.",
    Status.UNCALIBRATED_OPTICS: "The contrast is right, but the mass scale was measured with "
    "other optics: measure standards with these optics (iscat calibrate mass).",
    Status.NONLINEAR: "The counts of the whole movie are not in proportion to its light, so that "
    "all masses are wrong by the same factor: a line says by how much and why.",
    Status.PROCESSED: "The frames were interpolated, smoothed or sharpened, which changes their "
    "noise and their particles: analyse the raw frames of the camera.",
}

SEVERITY = tuple(status for status in _ADVICE if status is not Status.OK)
"""Flags of a fit, worst first: perhaps no particle; none above the noise; no estimate; no estimate
inside the bounds; no dipole and so no mass; a model that does not describe the data, their change
in time or their width; one of several diameters, heights or directions; a mass shared with a
neighbour; pixels left out; a mass on the scale of other optics; counts that are not in proportion
to the light; frames that were processed."""

NO_EVENT = frozenset({Status.SIDELOBE, Status.NOT_DETECTED})
"""Verdicts on rows that are no particles: they are in no count, histogram or species."""


def verdict(flags: Iterable[Status]) -> tuple[Status, tuple[Status, ...]]:
    """Sort the flags of a fit; the status is the worst one."""
    ordered = tuple(sorted(set(flags) - {Status.OK}, key=SEVERITY.index))
    return (ordered[0] if ordered else Status.OK), ordered


class TrackStatus(StrEnum):
    """The verdict on one track; worst first."""

    FEW_FRAMES = "few_frames"
    POOR_FITS = "poor_fits"
    AMBIGUOUS_SIZE = "ambiguous_size"
    OTHER_PARTICLE = "other_particle"
    MASS_VARIES = "mass_varies"
    PARTLY_SEEN = "partly_seen"
    SHORT_WAY = "short_way"
    NOT_FREE = "not_free"
    STANDS_STILL = "stands_still"
    NEAR_WALL = "near_wall"
    UNCALIBRATED_OPTICS = "uncalibrated_optics"
    OK = "ok"

    @property
    def advice(self) -> str:
        """What the status means and what to try."""
        return _TRACK_ADVICE[self]


_TRACK_ADVICE = {
    TrackStatus.OK: "The frames agree on one mass, and the particle diffuses freely.",
    TrackStatus.FEW_FRAMES: "Fewer of its positions than track.min_frames can be used (those at "
    "the border of the field, too close to another particle or not converged cannot): no "
    "diffusion coefficient.",
    TrackStatus.POOR_FITS: "Fewer than half of its frames are ok, so that poor fits are used too; "
    "its errors are enlarged by the factor by which the masses of its frames scatter beyond theirs "
    "(mass_scatter): see the status of its rows in fits.csv.",
    TrackStatus.AMBIGUOUS_SIZE: "Another diameter explains all its frames almost as well: "
    "optical_probability says how likely this one is.",
    TrackStatus.OTHER_PARTICLE: "Its images and its motion are those of a homogeneous sphere of "
    "another refractive index rather than of the particle of [particle], so that its optical "
    "diameter is wrong: give [particle] its refractive_index, or its shell.",
    TrackStatus.MASS_VARIES: "Its frames differ in mass by more than their errors, or the masses "
    "of all tracks change together: motion blurs the image, particles met, the particle changed, "
    "or the focus drifts.",
    TrackStatus.PARTLY_SEEN: "It is seen in some of the frames only, but moves too slowly to have "
    "gone far in the others: there the background contains it, and its mass is too small; record "
    "for longer, or give background frames without it.",
    TrackStatus.SHORT_WAY: "It moved so little that it can hardly be told from the background "
    "learnt with it: mass and D are wrong together, D as the mass to the power of -2; record for "
    "longer, or give background frames without it.",
    TrackStatus.NOT_FREE: "It does not diffuse freely: p_confinement, p_anomalous and p_steady "
    "say in which way; D is that of free diffusion.",
    TrackStatus.STANDS_STILL: "Its D is not above zero within its error: take d_high_um2_s as an "
    "upper limit, or record for longer.",
    TrackStatus.NEAR_WALL: "The coverslip slows it by more than 5 %: its diameter is too large, "
    "its index too small.",
    TrackStatus.UNCALIBRATED_OPTICS: Status.UNCALIBRATED_OPTICS.advice,
}


@dataclass(frozen=True)
class StackMetadata:
    """Metadata of a movie file; None where the file has no value.

    Attributes
    ----------
    pixel_size_nm : float or None
        In the sample plane [nm].
    exposure_ms : float or None
        Exposure of one frame [ms].
    frame_rate_hz : float or None
        Frames per second [Hz]; the camera's own, where frames are missing.
    ticks : tuple of int or None
        Number of camera intervals from the first frame to each frame, shape (t,), if frames are
        missing; None if none is missing or this is not known.
    gain_e_per_adu : float or None
        Photoelectrons per count, from the camera's driver.
    offset_adu : float or None
        Counts in the dark, from the camera's driver.
    wavelength_nm : float or None
        Of the illumination, in vacuum [nm].
    na : float or None
        Numerical aperture of the objective.
    magnification : float or None
        Of the objective, as engraved.
    binning : float or None
        Pixels of the sensor along a side of one of the movie.
    displayed_hz : float or None
        Frames per second at which ImageJ shows the movie [Hz]; the camera may have been faster.
    source : str
        Source of the metadata: ``"ome"``, ``"imagej"``, ``"micromanager"``, ``"tiff"``, the name
        of a file beside it, ``"none"``…
    """

    pixel_size_nm: float | None = None
    exposure_ms: float | None = None
    frame_rate_hz: float | None = None
    ticks: tuple[int, ...] | None = None
    gain_e_per_adu: float | None = None
    offset_adu: float | None = None
    wavelength_nm: float | None = None
    na: float | None = None
    magnification: float | None = None
    binning: float | None = None
    displayed_hz: float | None = None
    source: str = "none"

    @property
    def values(self) -> dict[str, Any]:
        """All values that are known, by their names."""
        known = vars(self).items()
        return {name: value for name, value in known if name != "source" and value is not None}


class FrameSource(Protocol):
    """A movie that is read a few frames at a time."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""

    @property
    def name(self) -> str:
        """Name in messages."""

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)`` as stored, shape (stop − start, y, x) [counts]."""


@dataclass(frozen=True)
class InPlace:
    """Memory-mapped frames of a file, which are read-only.

    Attributes
    ----------
    counts : ndarray, shape (t, y, x)
        The stored counts; they may be used as long as `check` does not raise.
    check : callable
        Raises DataError if the file has become shorter: reading beyond its end kills the process.
    let_go : callable
        Releases the memory of all frames; they are read from the file again when they are used.
    """

    counts: NDArray[Any]
    check: Callable[[], None]
    let_go: Callable[[], None]


class CountSource(FrameSource, Protocol):
    """A movie and the type of its numbers."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts."""


@runtime_checkable
class PlacedSource(Protocol):
    """A movie whose frames can be memory-mapped."""

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """Frames ``[start, stop)`` without a copy; None where they have to be read."""


@dataclass(frozen=True)
class Windows:
    """Photoelectrons summed before and after the particles bound.

    The raw counts are summed, never rescaled frames, so that both sums stay Poisson; laser power
    enters through `power_ratio` alone (physics.md, section 4).

    Attributes
    ----------
    before_e, after_e : ndarray, shape (y, x)
        Summed photoelectrons [e].  With a known background `before_e` is its expectation for
        `n_before` = 1 frame.
    n_before, n_after : int
        Frames in each sum; `n_before` = 0 where the background is known.
    power_ratio : float
        ρ, total power after over total power before.
    read_variance_before_e2, read_variance_after_e2 : ndarray, shape (y, x)
        Read-noise variance of each sum [e²].
    masked : ndarray of bool, shape (y, x)
        Pixels that must not be used: dead, hot or saturated.
    saturated : ndarray of bool, shape (y, x)
        The saturated ones among them.
    frames_before, frames_after : (int, int)
        The half-open frame ranges.
    power : ndarray, shape (t,)
        Power of every frame in both ranges over the mean power before; before first.
    """

    before_e: FloatArray
    after_e: FloatArray
    n_before: int
    n_after: int
    power_ratio: float
    read_variance_before_e2: FloatArray
    read_variance_after_e2: FloatArray
    masked: BoolArray
    saturated: BoolArray
    frames_before: tuple[int, int]
    frames_after: tuple[int, int]
    power: FloatArray

    @property
    def left_out(self) -> tuple[int, int]:
        """Numbers of dead, hot or noisy pixels, and of saturated ones."""
        defects = self.masked & ~self.saturated
        return int(defects.sum()), int(self.saturated.sum())

    def cut(self, region: tuple[slice, slice]) -> Windows:
        """Give the sums of some pixels."""
        images = {name: value for name, value in vars(self).items() if np.ndim(value) == 2}
        return replace(self, **{name: image[region] for name, image in images.items()})


@dataclass(frozen=True)
class Candidate:
    """A place where the search finds a possible particle.

    Attributes
    ----------
    x_px, y_px : float
        Sub-pixel position; integer = pixel centre, y down the rows.
    z_nm : float
        Height of the template that matched best [nm].
    mass_kda : float
        Linear estimate of the mass [kDa]; negative where the contrast has the other sign.
    snr : float
        Matched-filter signal over its noise.
    beside : float
        Largest ratio at other places with the same distance from a known particle.
    """

    x_px: float
    y_px: float
    z_nm: float
    mass_kda: float
    snr: float
    beside: float = 0.0


@dataclass(frozen=True)
class Alternative:
    """Another height that a fit converged to.

    Attributes
    ----------
    z_nm : float
        The height [nm].
    log_likelihood_gap : float
        Log-likelihood of the best height minus that of this one, ≥ 0.
    mass_kda : float
        The mass [kDa]: in mode size, another diameter may have another mass.
    """

    z_nm: float
    log_likelihood_gap: float
    mass_kda: float = math.nan


@dataclass(frozen=True)
class Box:
    """Bounds of θ = (x, y, z, amplitude, level) and which of them are free.

    Attributes
    ----------
    free : ndarray of bool, shape (5,)
        Free parameters.
    lower, upper : ndarray, shape (5,)
        Bounds [nm, amplitude, 1].
    """

    free: BoolArray
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True)
class FitResult:
    """One maximum-likelihood fit.

    Attributes
    ----------
    x_nm, y_nm, z_nm, mass_kda : float
        Estimate in the full frame [nm, kDa]; a parameter that was not free holds its fixed value.
    theta : ndarray, shape (5,)
        Maximum of the likelihood, in the parameters of the likelihood.
    estimate : ndarray, shape (5,)
        The maximum minus the bias of order 1/N; the estimates above are computed from it.
    box : Box
        Bounds of the search.
    free : tuple of str
        Names of the free parameters, a subset of `PARAMETERS` in that order.
    sigma : ndarray, shape (4,)
        Standard deviations from the observed information, in the order of `PARAMETERS`;
        NaN where not free.  With few photons, those of positions follow from the likelihood three
        errors away, if this is larger; see `iscat_analysis.inference.fit.reach`.
    covariance : ndarray, shape (n_free, n_free)
        Inverse observed information, with these standard deviations.
    contrast : float
        Signed peak contrast of the model over the plane, at the estimate.
    log_likelihood : float
        At its maximum, without terms that do not depend on the parameters.
    snr : float
        √(2 Δℓ) against no particle; a free level is fitted in both.
    iterations : int
        Scoring steps taken by the best start.
    chi2_reduced, p_value : float
        Goodness of fit of the fitted pixels.
    status : Status
        The verdict.
    flags : tuple of Status
        All flags, worst first, including the status unless it is ok.
    alternatives : tuple of Alternative
        Other heights, best first.
    sigma_index : float
        Standard deviation of the refractive index of a sphere, where it was fitted.
    size_probability : float
        Posterior probability of the diameter among all that were found; NaN where it is not free.
    """

    x_nm: float
    y_nm: float
    z_nm: float
    mass_kda: float
    theta: FloatArray
    estimate: FloatArray
    box: Box
    free: tuple[str, ...]
    sigma: FloatArray
    covariance: FloatArray
    contrast: float
    log_likelihood: float
    snr: float
    iterations: int
    chi2_reduced: float
    p_value: float
    status: Status
    flags: tuple[Status, ...] = ()
    alternatives: tuple[Alternative, ...] = ()
    sigma_index: float = math.nan
    size_probability: float = math.nan

    def shifted(self, x_nm: float, y_nm: float) -> FitResult:
        """Give the same fit in coordinates with another origin."""
        return replace(self, x_nm=self.x_nm + x_nm, y_nm=self.y_nm + y_nm)


@dataclass(frozen=True)
class PosteriorResult:
    """An ensemble of posterior samples and the verdict on it.

    Attributes
    ----------
    names : tuple of str
        Parameter names with units, as in `PARAMETERS`.
    samples : ndarray, shape (chain, draw, parameter)
        Draws after burn-in, one chain per walker.
    log_likelihood : ndarray, shape (chain, draw)
        At each draw.
    tau : ndarray, shape (parameter,)
        Integrated autocorrelation time [steps].
    r_hat : ndarray, shape (parameter,)
        Split R̂.
    ess_bulk, ess_tail : ndarray, shape (parameter,)
        Effective sample sizes.
    acceptance : float
        Mean acceptance fraction.
    converged : bool
        Whether every criterion holds; if not, the samples must not be reported as a posterior.
    message : str
        Which criterion failed, or that all hold.
    van_trees : ndarray, shape (parameter,), or None
        With an informative prior, the least root-mean-square error of any estimate over particles
        of that prior [nm, kDa].
    """

    names: tuple[str, ...]
    samples: FloatArray
    log_likelihood: FloatArray
    tau: FloatArray
    r_hat: FloatArray
    ess_bulk: FloatArray
    ess_tail: FloatArray
    acceptance: float
    converged: bool
    message: str
    van_trees: FloatArray | None = None

    __repr__ = brief


@dataclass(frozen=True)
class Trace:
    """Contrast of one landing or leaving against frame.

    Each frame is compared with the mean of the frames without the particle, and projected onto the
    fitted image with the weights of the likelihood.  If the image is right, a frame with the
    particle has the contrast of the event, and a frame without it has 0, apart from noise.

    Attributes
    ----------
    first : int
        Number of the first frame.
    contrast : ndarray, shape (t,)
        Signed peak contrast of the particle in each frame; NaN where a frame was left out.
    sigma : float
        Standard deviation of one frame from its photoelectrons and read noise.
    frame : int
        First frame of the new state.
    half_width : int
        `frame` ± `half_width` contains the step with a probability of 95 %.
    used : (int, int)
        Half-open range of frames within which the event was fitted.
    before, after : float
        Fitted contrast before and after the step; one of them is 0.
    """

    first: int
    contrast: FloatArray
    sigma: float
    frame: int
    half_width: int
    used: tuple[int, int]
    before: float
    after: float

    __repr__ = brief


@dataclass(frozen=True)
class Clip:
    """Ratiometric images of one landing or leaving, of windows that slide over its step.

    Attributes
    ----------
    frames : tuple of int
        First frame of the window after, of each image.
    window_frames : int
        Frames in each of the two windows.
    contrast : ndarray of float32, shape (n, y, x)
        After over before minus 1; NaN where a pixel was left out.
    """

    frames: tuple[int, ...]
    window_frames: int
    contrast: NDArray[np.float32]

    __repr__ = brief


@dataclass(frozen=True)
class EventView:
    """What a report shows of one fitted event.

    Attributes
    ----------
    event : int
        Number in the table.
    row_px, column_px : int
        Full-frame index of the first pixel of the images.
    contrast : ndarray, shape (y, x)
        Measured contrast, after over before minus 1 (dark field: photoelectrons above background).
    model : ndarray, shape (y, x)
        Fitted model, in the same unit.
    residual : ndarray, shape (y, x)
        (data − model) in standard deviations.
    posterior : PosteriorResult or None
        The chain, where sampled.
    trace : Trace or None
        Contrast against frame, of landing movies.
    clip : Clip or None
        Of landing movies, the first events.
    """

    event: int
    row_px: int
    column_px: int
    contrast: FloatArray
    model: FloatArray
    residual: FloatArray
    posterior: PosteriorResult | None = None
    trace: Trace | None = None
    clip: Clip | None = None

    __repr__ = brief


@dataclass(frozen=True)
class Film:
    """Some frames of one track, in a square that follows it.

    Attributes
    ----------
    track : int
        Its number.
    frames : tuple of int
        Which frames.
    why : str
        Why this track is shown.
    contrast, model, residual : ndarray, shape (t, y, x)
        As in `EventView`.
    """

    track: int
    frames: tuple[int, ...]
    why: str
    contrast: FloatArray
    model: FloatArray
    residual: FloatArray

    __repr__ = brief


@dataclass(frozen=True)
class Provenance:
    """Where a result came from.

    Attributes
    ----------
    command : str
        The command line, or the library call.
    input_path : str
        The movie.
    input_sha256 : str
        Hash of the movie's bytes.
    versions : mapping of str to str
        iscat-analysis, Python and each numerical dependency.
    seed : int or None
        Of the posterior sampler.
    started : str
        ISO 8601, UTC.
    """

    command: str
    input_path: str
    input_sha256: str
    versions: Mapping[str, str]
    seed: int | None
    started: str


@dataclass(frozen=True)
class Analysis:
    """All results of one run of the main job, from which the report is made.

    Attributes
    ----------
    config_toml : str
        The resolved configuration.
    mode : str
        ``"mass"``, ``"localize"``, ``"joint"`` or ``"track"``.
    scheme : str
        ``"iscat"``, ``"cobri"`` or ``"darkfield"``.
    pixel_size_nm : float
        In the sample plane [nm].
    table : pandas.DataFrame
        One row per event, columns `EVENT_COLUMNS`.
    views : tuple of EventView
        One per event, in the same order.
    ratio_image : ndarray, shape (y, x)
        Contrast of the whole field.
    power : ndarray, shape (t,)
        Laser power of each frame used, relative.
    power_frames : ndarray of int, shape (t,)
        The frames' numbers.
    summary : mapping
        What ``summary.json`` holds.
    provenance : Provenance
        Versions, hash, command.
    findings : tuple of Finding
        What the user should know beside the numbers, in the order in which it was found.
    tracks : pandas.DataFrame or None
        Mode ``track``: one row per track, columns `TRACK_COLUMNS`.
    films : tuple of Film
        Tracks that are shown frame by frame.
    response : pandas.DataFrame or None
        Counts and photoelectrons of a camera that was found not to be linear.
    """

    config_toml: str
    mode: str
    scheme: str
    pixel_size_nm: float
    table: pd.DataFrame
    views: tuple[EventView, ...]
    ratio_image: FloatArray
    power: FloatArray
    power_frames: NDArray[np.int64]
    summary: Mapping[str, Any]
    provenance: Provenance
    findings: tuple[Finding, ...] = ()
    tracks: pd.DataFrame | None = None
    films: tuple[Film, ...] = ()
    response: pd.DataFrame | None = None

    __repr__ = brief

    @property
    def mode_kind(self) -> ModeKind:
        """What its mode means."""
        return MODES[self.mode]

    @property
    def scheme_kind(self) -> SchemeKind:
        """What its scheme means, with the unit of its images."""
        return SCHEMES[self.scheme]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences of the findings that are more than a note."""
        return tuple(warnings_in(self.findings))
