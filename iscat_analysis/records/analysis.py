"""Data of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import MODES, SCHEMES, ModeKind, SchemeKind
from iscat_analysis.findings import Finding, warnings_in
from iscat_analysis.records.steps import FloatArray, PosteriorResult


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
