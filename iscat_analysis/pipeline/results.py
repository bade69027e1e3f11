"""What is found in a movie: from judged events to the table and the views."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from iscat_analysis.bounds.classical import ComplexArray
from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.movie.drift import Trajectory
from iscat_analysis.optics.collected import collected_area_nm2
from iscat_analysis.pieces.regions import line_of, lines_from, numbered
from iscat_analysis.pipeline.events import Event, Fitted
from iscat_analysis.pipeline.regions import photons_scale
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import (
    FRAME_COLUMN,
    Clip,
    EventView,
    FloatArray,
    PosteriorResult,
    Trace,
    Windows,
)
from iscat_analysis.search.empty import EmptySpread


@dataclass(frozen=True)
class Compared:
    """Which frames of a movie stand against which.

    Attributes
    ----------
    frames_before, frames_after : (int, int)
        Half-open ranges; nothing before where the background is known or the windows slide.
    power_ratio : float
        Light after over light before; 1 where each frame is weighed by its own.
    power : ndarray, shape (t,)
        Relative light of every frame of both ranges, before first; NaN where one was left out.
    masked_pixels : int
        Pixels that are not used.
    """

    frames_before: tuple[int, int]
    frames_after: tuple[int, int]
    power_ratio: float
    power: FloatArray
    masked_pixels: int

    @classmethod
    def of(cls, windows: Windows) -> Compared:
        """Describe the sums of two ranges of frames.

        Parameters
        ----------
        windows : Windows
            The sums.

        Returns
        -------
        Compared
            Without their images.
        """
        return cls(
            windows.frames_before, windows.frames_after, windows.power_ratio, windows.power,
            int(windows.masked.sum()),
        )  # fmt: skip


@dataclass(frozen=True)
class Followed:
    """What the tracks of a movie are described with, beside their rows.

    Attributes
    ----------
    windows : Windows
        The background, and all frames in which particles were followed.
    parts : tuple of Windows
        The backgrounds of blocks of frames, where there are several.
    masses : pandas.DataFrame or None
        Over a background that was learnt with the tracks: ``mass_kda``, ``sigma_mass_kda`` and
        ``crb_mass_kda`` by the exact likelihood of all frames, indexed by track.
    """

    windows: Windows
    parts: tuple[Windows, ...] = ()
    masses: pd.DataFrame | None = None


@dataclass(frozen=True)
class Found:
    """What was found in a movie, whichever frames stand against which.

    Attributes
    ----------
    scene : Scene
        Models, threshold and the configuration as it was used.
    fits : pandas.DataFrame
        Columns `EVENT_COLUMNS`, with the errors of the likelihoods alone; of a landing movie also
        `FRAME_COLUMN`, of one in mode ``track`` also ``track``.
    views : tuple of EventView
        Images, in the order of the fits, or one per track; of the first events only, where there
        are many.
    image : ndarray, shape (y, x)
        Contrast of the field; of a landing movie that of the strongest step at each pixel.
    compared : Compared
        Frames and their light.
    heading : str
        Under which ``summary.json`` has `summary`.
    summary : mapping
        What was learnt of the background; empty where there is nothing to say.
    repeats : tuple of ndarray
        What parts of the frames of each row say, from `iscat_analysis.inference.repeats`; of
        single frames, what they say where there is no particle.
    empty : EmptySpread or None
        The noise of whole windows, or of single frames, where there is no particle.
    followed : Followed or None
        Mode ``track``.
    trajectory : Trajectory or None
        Of the fixed pattern, where its motion was divided out.
    optics : mapping
        What the test of the optics found, where the tracks themselves made it.
    interrupted : bool
        Whether the user stopped it; what was finished is kept.
    """

    scene: Scene
    fits: pd.DataFrame
    views: tuple[EventView, ...]
    image: FloatArray
    compared: Compared
    heading: str
    summary: Mapping[str, Any]
    repeats: tuple[FloatArray, ...] = ()
    empty: EmptySpread | None = None
    followed: Followed | None = None
    trajectory: Trajectory | None = None
    optics: Mapping[str, Any] = field(default_factory=dict)
    interrupted: bool = False


def collected_photons(scene: Scene, event: Event) -> float:
    """Scattered photons that the pupil collected from one particle in the frames after.

    Parameters
    ----------
    scene : Scene
        Models.
    event : Event
        The particle, and the sums that give the background light.

    Returns
    -------
    float
        Photoelectrons (the quantum efficiency counts as part of the collection).
    """
    windows = event.windows
    area = collected_area_nm2(scene.model, event.fit.z_nm, event.fit.mass_kda)
    if scene.additive:
        per_pixel = photons_scale(scene, windows)
    else:
        per_pixel = windows.power_ratio * float(windows.before_e[~windows.masked].mean())
    return per_pixel * area / scene.pixel_nm**2


def lines_of(
    scene: Scene, events: Sequence[Event], *, mapper: Callable[..., Iterable[Any]] = map
) -> list[dict[str, Any]]:
    """Make the lines of ``fits.csv``.

    Parameters
    ----------
    scene : Scene
        Models.
    events : sequence of Event
        The events.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    list of dict
        As from `line_of`; with `FRAME_COLUMN`, where steps were dated.
    """
    heights = {event.fit.estimate[2] for event in events}
    known = {}
    if len(heights) == 1 and not scene.model.is_measured:  # of heights that are not fitted
        (height,) = heights
        known[height] = quantum_information(scene.model, height)
    return list(mapper(lambda event: _line(scene, event, known), events))


def _line(scene: Scene, event: Event, quantum: Mapping[float, ComplexArray]) -> dict[str, Any]:
    line = line_of(
        event.likelihood, event.fit, collected_photons(scene, event), flags=event.flags,
        frame=event.frame, n_before=event.n_before, n_after=event.n_after, sign=event.sign,
        quantum=quantum.get(event.fit.estimate[2]),
    )  # fmt: skip
    return line if event.half_width is None else line | {FRAME_COLUMN: event.half_width}


def table_of(scene: Scene, events: Sequence[Event]) -> pd.DataFrame:
    """Make a table of events whose frames are given.

    Parameters
    ----------
    scene : Scene
        Models.
    events : sequence of Event
        The events, in their order.

    Returns
    -------
    pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    """
    return numbered(lines_from(lines_of(scene, events)), range(len(events)))


def view_of(
    number: int,
    fitted: Fitted,
    *,
    posterior: PosteriorResult | None = None,
    trace: Trace | None = None,
    clip: Clip | None = None,
) -> EventView:
    """Images of one event for the report.

    Parameters
    ----------
    number : int
        Of the event.
    fitted : Fitted
        The event.
    posterior : PosteriorResult, optional
        Its chain, where sampled.
    trace, clip : Trace, Clip, optional
        Of landing movies.

    Returns
    -------
    EventView
        Measured signal, model and residuals.
    """
    likelihood, theta = fitted.likelihood, fitted.fit.theta
    unit = likelihood.data[2] if not likelihood.model.rho else 1.0
    return EventView(
        event=number,
        row_px=fitted.region.rows[0],
        column_px=fitted.region.columns[0],
        contrast=likelihood.measured_signal() * unit,
        model=likelihood.signal(theta) * unit,
        residual=likelihood.residuals(theta),
        posterior=posterior,
        trace=trace,
        clip=clip,
    )
