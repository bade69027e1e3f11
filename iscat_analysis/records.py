"""What the stages hand to one another: frozen dataclasses, axes (t, y, x), units in the names."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Protocol

import numpy as np
import pandas as pd
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Mapper = Callable[..., Iterable[Any]]
"""`map`, or the one of a pool."""

PARAMETERS = ("x_nm", "y_nm", "z_nm", "mass_kda")
"""The particle's parameters, in the order every matrix and vector uses."""

FREE_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "mass": ("x_nm", "y_nm", "mass_kda"),
    "localize": ("x_nm", "y_nm", "z_nm"),
    "joint": PARAMETERS,
    "track": PARAMETERS,
}
"""What each mode fits."""


def free_parameters(mode: str, fits: pd.DataFrame) -> tuple[str, ...]:
    """Tell what was fitted: in mode ``track`` the height only where ``track.free`` asks for it.

    Parameters
    ----------
    mode : str
        Key of `FREE_PARAMETERS`.
    fits : pandas.DataFrame
        With a column ``sigma_…`` of each, empty where it was held fixed.

    Returns
    -------
    tuple of str
        A subset of `PARAMETERS`, in that order.
    """
    names = FREE_PARAMETERS[mode]
    fitted = tuple(name for name in names if fits[f"sigma_{name}"].notna().any())
    return fitted if mode == "track" and fitted else names


EVENT_COLUMNS = (
    "event", "frame", "n_before", "n_after", "x_px", "y_px", "x_nm", "y_nm", "z_nm", "mass_kda",
    "contrast", "sigma_x_nm", "sigma_y_nm", "sigma_z_nm", "sigma_mass_kda",
    "crb_x_nm", "crb_y_nm", "crb_z_nm", "crb_mass_kda",
    "qcrb_x_nm", "qcrb_y_nm", "qcrb_z_nm", "qcrb_mass_kda",
    "n_scattered", "snr", "chi2_reduced", "p_value", "status", "flags",
)  # fmt: skip
"""The columns of ``fits.csv``, in order."""

FRAME_COLUMN = "frame_ci95"
"""Column of ``fits.csv`` after `EVENT_COLUMNS`, of landing movies: half-width of the 95 % interval
of ``frame`` [frames]."""

REPEAT_COLUMNS = ("repeat_x_nm", "repeat_y_nm", "repeat_z_nm", "repeat_mass_kda")
"""Columns of ``fits.csv``: standard errors of an event as disjoint parts of its own frames show
them; of a single frame, as the empty places of that frame do."""

TRACK_COLUMNS = (
    "track", "first_frame", "last_frame", "n_frames", "mass_kda", "sigma_mass_kda", "crb_mass_kda",
    "d_um2_s", "sigma_d_um2_s", "crb_d_um2_s", "diameter_nm", "sigma_diameter_nm",
    "refractive_index", "confinement_nm", "status", "flags",
    "d_low_um2_s", "d_high_um2_s", "d_disagreement", "p_confinement", "exponent", "sigma_exponent",
    "p_anomalous", "p_steady", "sigma_refractive_index", "contrast", "mass_scatter", "p_mass",
    "n_mass_frames", "n_d_frames", "x_nm", "y_nm", "z_nm", "nearest_nm", "begins", "ends",
)  # fmt: skip
"""The columns of ``tracks.csv``, in order."""


class Progress(Protocol):
    """Told how far a stage has come; the command line turns it into a bar on stderr."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress.

    Parameters
    ----------
    stage : str
        Name of the stage.
    done, total : int
        Steps finished, and steps there are.
    """


class Status(StrEnum):
    """The verdict on one fit; `advice` says what each asks of the user."""

    OK = "ok"
    NOT_CONVERGED = "not_converged"
    AT_BOUND = "at_bound"
    AMBIGUOUS_Z = "ambiguous_z"
    POOR_FIT = "poor_fit"
    TOO_CLOSE = "too_close"
    SATURATED = "saturated"
    SIDELOBE = "sidelobe"

    @property
    def advice(self) -> str:
        """What the status means and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "The fit converged, inside its bounds, and agrees with the data.",
    Status.NOT_CONVERGED: "The fit did not settle: check the optics, or enlarge fit.roi_nm.",
    Status.AT_BOUND: "The data pull a parameter beyond its bound: widen fit.z_range_nm; where that "
    "begins at 0, the coverslip, check optics.focus_nm and the indices; or leave the event out.",
    Status.AMBIGUOUS_Z: "Another height explains the data almost as well: use more frames, "
    "another focus, or a narrower fit.z_range_nm.",
    Status.POOR_FIT: "The model does not describe the data: check focus, NA, gain and neighbours.",
    Status.TOO_CLOSE: "Another particle is nearer than detection.min_separation_nm: "
    "treat the mass as shared between them.",
    Status.SIDELOBE: "Not larger than what the model leaves over of a brighter particle beside it, "
    "and not counted: check focus, NA and aberrations to tell whether it is a particle.",
    Status.SATURATED: "The camera is saturated here: lower the exposure or the laser power.",
}


SEVERITY = (
    Status.SIDELOBE,
    Status.NOT_CONVERGED,
    Status.AT_BOUND,
    Status.POOR_FIT,
    Status.AMBIGUOUS_Z,
    Status.TOO_CLOSE,
    Status.SATURATED,
)
"""What is remarked on a fit, worst first: perhaps no particle; no estimate; none inside the bounds;
a model that does not describe the data; one of several heights; a mass shared with a neighbour;
pixels left out."""


def verdict(flags: Iterable[Status]) -> tuple[Status, tuple[Status, ...]]:
    """Put the remarks on a fit in order.

    Parameters
    ----------
    flags : iterable of Status
        Every condition that was noticed, in any order.

    Returns
    -------
    status : Status
        The worst of them, or ok.
    flags : tuple of Status
        All of them, worst first, each once.
    """
    ordered = tuple(sorted(set(flags) - {Status.OK}, key=SEVERITY.index))
    return (ordered[0] if ordered else Status.OK), ordered


def track_numbers(fits: pd.DataFrame) -> pd.Series[int]:
    """Give the track of every row.

    Parameters
    ----------
    fits : pandas.DataFrame
        With ``track``, or from mode ``track`` alone, where ``event`` is the number of the track.

    Returns
    -------
    pandas.Series
        Whole numbers, missing where a row belongs to no track.
    """
    return fits["track"] if "track" in fits else fits["event"]


class TrackStatus(StrEnum):
    """The verdict on one track; worst first."""

    FEW_FRAMES = "few_frames"
    POOR_FITS = "poor_fits"
    MASS_VARIES = "mass_varies"
    NOT_FREE = "not_free"
    STANDS_STILL = "stands_still"
    NEAR_WALL = "near_wall"
    OK = "ok"

    @property
    def advice(self) -> str:
        """What the status means and what to try."""
        return _TRACK_ADVICE[self]


_TRACK_ADVICE = {
    TrackStatus.OK: "The frames agree on one mass, and the particle diffuses freely.",
    TrackStatus.FEW_FRAMES: "Fewer positions than track.min_frames: no diffusion coefficient.",
    TrackStatus.POOR_FITS: "Fewer than half of its frames are ok, so that its mass is that of a "
    "selection: see the status of its rows in fits.csv.",
    TrackStatus.MASS_VARIES: "Its frames differ in mass by more than their errors: motion blurs "
    "the picture, particles met, or the particle changed.",
    TrackStatus.NOT_FREE: "It does not diffuse freely: p_confinement, p_anomalous and p_steady "
    "say which way, and D is that of free diffusion.",
    TrackStatus.STANDS_STILL: "Its D is not above zero within its error: take d_high_um2_s as an "
    "upper limit, or record for longer.",
    TrackStatus.NEAR_WALL: "The coverslip, so near, slows it by more than 5 %: its diameter "
    "is too large, its index too small.",
}


@dataclass(frozen=True)
class StackMetadata:
    """What a movie file says of itself; None where it is silent.

    Attributes
    ----------
    pixel_size_nm : float or None
        In the sample plane [nm].
    exposure_ms : float or None
        Exposure of one frame [ms].
    frame_rate_hz : float or None
        Frames per second [Hz].
    source : str
        Which metadata spoke: ``"ome"``, ``"imagej"``, ``"micromanager"``, ``"tiff"``, ``"none"``…
    """

    pixel_size_nm: float | None = None
    exposure_ms: float | None = None
    frame_rate_hz: float | None = None
    source: str = "none"


class FrameSource(Protocol):
    """A movie that is read a few frames at a time."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""

    @property
    def name(self) -> str:
        """What messages call it."""

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)`` as stored, shape (stop − start, y, x) [counts]."""


class CountSource(FrameSource, Protocol):
    """A movie and the type of its numbers."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts."""


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

    def cut(self, region: tuple[slice, slice]) -> Windows:
        """Give the sums of some pixels.

        Parameters
        ----------
        region : (slice, slice)
            Rows and columns.

        Returns
        -------
        Windows
            Views of these pixels, nothing is copied.
        """
        return replace(
            self,
            before_e=self.before_e[region],
            after_e=self.after_e[region],
            read_variance_before_e2=self.read_variance_before_e2[region],
            read_variance_after_e2=self.read_variance_after_e2[region],
            masked=self.masked[region],
            saturated=self.saturated[region],
        )


@dataclass(frozen=True)
class Candidate:
    """A place where something seems to have landed.

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
        Height of the ratio elsewhere at its distance from a known particle; the largest of them.
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
    """

    z_nm: float
    log_likelihood_gap: float


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
        Where the likelihood has its maximum, as it takes its parameters.
    estimate : ndarray, shape (5,)
        The same with the bias of order 1/N taken off; what the estimates above say.
    box : Box
        Where it was searched.
    free : tuple of str
        Names of the free parameters, a subset of `PARAMETERS` in that order.
    sigma : ndarray, shape (4,)
        Standard deviations from the observed information, in the order of `PARAMETERS`;
        NaN where not free.
    covariance : ndarray, shape (n_free, n_free)
        Inverse observed information.
    contrast : float
        Signed peak contrast of the model over the plane, at the estimate.
    log_likelihood : float
        At its maximum, without terms that do not depend on the parameters.
    snr : float
        √(2 Δℓ) against no particle, a level that is free being fitted in both.
    iterations : int
        Scoring steps taken by the best start.
    chi2_reduced, p_value : float
        Goodness of fit of the fitted pixels.
    status : Status
        The verdict.
    flags : tuple of Status
        Every condition that was noticed, worst first, the status among them unless it is ok.
    alternatives : tuple of Alternative
        Other heights, best first.
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

    def shifted(self, x_nm: float, y_nm: float) -> FitResult:
        """Give the same fit in coordinates with another origin.

        Parameters
        ----------
        x_nm, y_nm : float
            Added to the place [nm]; `theta` and `estimate` stay those of the likelihood.

        Returns
        -------
        FitResult
            In the other coordinates.
        """
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


@dataclass(frozen=True)
class Trace:
    """Contrast of one landing or leaving against frame.

    Each frame is set against the mean of those without the particle, and projected onto the fitted
    picture with the weights of the likelihood: where the picture is right, a frame with the
    particle has the contrast of the event, and one without it has 0, but for noise.

    Attributes
    ----------
    first : int
        Number of the first frame.
    contrast : ndarray, shape (t,)
        Signed peak contrast of the particle in each frame; NaN where a frame was left out.
    sigma : float
        Standard deviation of one frame that its photoelectrons and read noise make.
    frame : int
        First frame of the new state.
    half_width : int
        `frame` ± `half_width` holds the step with a probability of 95 %.
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
    """Everything one run of the main job found; what the report is made of.

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
    warnings : tuple of str
        One line each.
    tracks : pandas.DataFrame or None
        Mode ``track``: one row per track, columns `TRACK_COLUMNS`.
    films : tuple of Film
        Tracks that are shown frame by frame.
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
    warnings: tuple[str, ...] = field(default=())
    tracks: pd.DataFrame | None = None
    films: tuple[Film, ...] = ()
