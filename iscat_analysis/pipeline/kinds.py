"""Kinds of movie, each an object that knows how its movies are searched, fitted, shown and redrawn.

`kind_of` asks once which frames are compared with which, and everything after it asks the kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pandas as pd

from iscat_analysis.config import Config
from iscat_analysis.diagnosis import Prepared
from iscat_analysis.errors import ConfigError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.ranges import background_mode
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.records import EventView, FloatArray
from iscat_analysis.text import brief

if TYPE_CHECKING:
    from iscat_analysis.pipeline.stored import StoredResult

FOUND_COLUMNS = ("x_px", "y_px", "snr", "contrast", "mass_kda")
"""Columns of what a `Look` finds."""

Redraw = Callable[[int], EventView]
"""Row of the table → its images."""


@dataclass(frozen=True)
class Look:
    """What the search sees in some frames.

    Attributes
    ----------
    frame : int
        First of the frames `after`; the one that was asked for, or the nearest that has as many
        frames before and after it as are needed.
    before : (int, int) or None
        Frames of the background, half-open; None where it is known.
    after : (int, int)
        Frames that are compared with it, half-open.
    image : ndarray, shape (y, x)
        Contrast, after over before minus 1 (dark field: photoelectrons above background); NaN where
        a pixel is not used.
    threshold : float
        Signal-to-noise ratio above which `analyse` takes something for a particle.
    search : callable
        Threshold → what exceeds it.
    """

    frame: int
    before: tuple[int, int] | None
    after: tuple[int, int]
    image: FloatArray
    threshold: float
    search: Callable[[float], pd.DataFrame]

    __repr__ = brief

    def found(self, threshold: float | None = None) -> pd.DataFrame:
        """Give what exceeds a threshold.

        Parameters
        ----------
        threshold : float, optional
            Signal-to-noise ratio; default as configured.

        Returns
        -------
        pandas.DataFrame
            Columns `FOUND_COLUMNS`, strongest first: place [px], signal-to-noise ratio, contrast at
            the peak and mass [kDa] by the linear estimate, negative for a particle that leaves.
            What may be a side lobe of another is not listed.

        Raises
        ------
        ConfigError
            The threshold is not positive.
        """
        return self.search(positive_threshold(self.threshold if threshold is None else threshold))


class Search(Protocol):
    """A search of the frames that one is looking at."""

    window: int
    longest: int
    frames: tuple[int, int]

    def context(self, window: int) -> AnalysisContext:
        """Give models and threshold for windows of `window` frames."""

    def look(self, frame: int, window: int) -> Look:
        """Search the frames around one."""


@dataclass(frozen=True)
class Kind:
    """A kind of movie.

    Attributes
    ----------
    heading : str
        Its part of ``summary.json``.
    find : callable
        Measures the background, searches, and fits what is there.
    search : callable
        Prepares the search of the frames that one is looking at.
    stored : callable
        Prepares the images of stored rows.
    inject : callable or None
        Adds known particles and analyses the movie again; None where none can be added.
    keeps_parts : bool
        Finished parts are kept on disk, from which an interrupted run goes on.
    """

    heading: str
    find: Callable[[Prepared, Run], DetectionResult]
    search: Callable[[Prepared], Search]
    stored: Callable[[Prepared, StoredResult], Redraw]
    inject: Callable[[Prepared, Run, DetectionResult], dict[str, Any]] | None = None
    keeps_parts: bool = True


def kind_of(config: Config) -> Kind:
    """Give the kind of a movie; each takes a while to import."""
    match background_mode(config):
        case "sliding":
            from iscat_analysis.pipeline.landings import LANDING as KIND
        case "tracks" if config.optics.interferes:
            from iscat_analysis.pipeline.moving import MOVING as KIND
        case "tracks":
            from iscat_analysis.pipeline.moving import MOVING_IN_DARK_FIELD as KIND
        case _ if config.fit.follows_tracks:
            from iscat_analysis.pipeline.moving import FRAME_BY_FRAME as KIND
        case _:
            from iscat_analysis.pipeline.before_after import BEFORE_AFTER as KIND
    return KIND


def with_threshold(context: AnalysisContext, threshold: float) -> AnalysisContext:
    """Search with another threshold."""
    return replace(context, templates=replace(context.templates, threshold=threshold))


def candidate_table(rows: Iterable[tuple[float, ...]]) -> pd.DataFrame:
    """Make a table of candidates, the strongest first."""
    values = np.array([tuple(map(float, row)) for row in rows]).reshape(-1, len(FOUND_COLUMNS))
    order = np.argsort(-np.abs(values[:, FOUND_COLUMNS.index("snr")]), kind="stable")
    return pd.DataFrame(values[order], columns=list(FOUND_COLUMNS))


def positive_threshold(threshold: float) -> float:
    """Refuse a threshold that is no positive number."""
    if not (math.isfinite(threshold) and threshold > 0):
        raise ConfigError(f"threshold = {threshold:g} must be a positive signal-to-noise ratio")
    return threshold
