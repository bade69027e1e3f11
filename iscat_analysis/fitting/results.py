"""Results of a movie: the table and the images that follow from the events."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.bounds.quantum import quantum_information
from iscat_analysis.camera import Trajectory
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event, Fitted, photons_scale
from iscat_analysis.inference.nuisances import NOTHING, Evidence, evidence_of, pair_of
from iscat_analysis.optics.model import collected_area_nm2
from iscat_analysis.pieces.regions import line_of
from iscat_analysis.records import (
    DIPOLE,
    FRAME_COLUMN,
    FREE_PARAMETERS,
    NO_MODEL,
    Clip,
    ComplexArray,
    EventView,
    FloatArray,
    PosteriorResult,
    Status,
    Trace,
    Windows,
    make_rows,
)
from iscat_analysis.search.empty import EmptySpread


@dataclass(frozen=True)
class Compared:
    """The frames that are compared, and their light."""

    frames_before: tuple[int, int]
    frames_after: tuple[int, int]
    power_ratio: float
    power: FloatArray
    masked_pixels: int

    @classmethod
    def of(cls, windows: Windows) -> Compared:
        """Describe the sums of two ranges of frames."""
        return cls(
            windows.frames_before, windows.frames_after, windows.power_ratio, windows.power,
            int(windows.masked.sum()),
        )  # fmt: skip


@dataclass(frozen=True)
class Followed:
    """What the description of tracks needs beside their rows."""

    windows: Windows
    parts: tuple[Windows, ...] = ()
    masses: pd.DataFrame | None = None


@dataclass(frozen=True)
class DetectionResult:
    """What was found in a movie; the same record for all background modes."""

    context: AnalysisContext
    fits: pd.DataFrame
    views: tuple[EventView, ...]
    image: FloatArray
    compared: Compared
    summary: Mapping[str, Any]
    repeats: tuple[FloatArray, ...] = ()
    empty: EmptySpread | None = None
    followed: Followed | None = None
    trajectory: Trajectory | None = None
    optics: Mapping[str, Any] = field(default_factory=dict)
    evidence: FloatArray | None = None  # of every row, in the order of `Evidence`
    interrupted: bool = False


def collected_photons(context: AnalysisContext, event: Event) -> float:
    """Scattered photons that the pupil collected from one particle in the frames after."""
    windows = event.windows
    model = event.likelihood.model  # that of its place
    area = collected_area_nm2(model, event.fit.z_nm, event.fit.mass_kda)
    if context.additive:
        per_pixel = photons_scale(context, windows)
    else:
        per_pixel = windows.power_ratio * float(windows.before_e[~windows.masked].mean())
    return per_pixel * area / context.pixel_nm**2


def lines_of(
    context: AnalysisContext, events: Sequence[Event], *, mapper: Callable[..., Iterable[Any]] = map
) -> list[dict[str, Any]]:
    """Make the rows of ``fits.csv`` as plain records."""
    heights = {event.fit.estimate[2] for event in events if event.sphere is None}
    known = {}
    alike = not context.model.is_measured and not context.model.is_sized
    if len(heights) == 1 and alike:  # of heights that are not fitted
        (height,) = heights
        known[height] = quantum_information(context.model, height)
    return list(mapper(lambda event: _line(context, event, known), events))


def evidence_beside(
    context: AnalysisContext, events: Sequence[Event], *, mapper: Callable[..., Iterable[Any]] = map
) -> FloatArray:
    """Test parameters that the fit of each event holds, where masses are fitted.

    Shapes: result (n, 11), in the order of `Evidence`.
    """
    if "z_nm" in FREE_PARAMETERS[context.mode]:
        return np.full((len(events), len(NOTHING)), np.nan)
    rows = mapper(lambda event: evidence_of(event.likelihood, event.fit, event.rise), events)
    return np.array(list(rows)).reshape(-1, len(NOTHING))


def _line(
    context: AnalysisContext, event: Event, quantum: Mapping[float, ComplexArray]
) -> dict[str, Any]:
    line: dict[str, Any] = {
        "frame": event.frame,
        "n_before": event.n_before,
        "n_after": event.n_after,
    }
    line |= line_of(
        event.likelihood, event.fit, collected_photons(context, event), event.flags,
        sign=event.sign,
        quantum=None if event.sphere else quantum.get(event.fit.estimate[2]),
    )  # fmt: skip
    if context.spheres_of(context.model) and event.sphere is None:
        line["model"] = NO_MODEL if Status.POOR_FIT in event.flags else DIPOLE
    if event.half_width is not None:
        line[FRAME_COLUMN] = event.half_width
    if context.config.fit.pairs:
        pair = pair_of(
            event.likelihood, event.fit, Evidence(*evidence_of(event.likelihood, event.fit))
        )
        line |= pair._asdict() | {"pair_mass_kda": event.sign * pair.pair_mass_kda}
    return line


def table_of(context: AnalysisContext, events: Sequence[Event]) -> pd.DataFrame:
    """Make a table of events whose frames are given."""
    return make_rows(lines_of(context, events), {"event": range(len(events))})


def view_of(
    number: int,
    fitted: Fitted,
    *,
    posterior: PosteriorResult | None = None,
    trace: Trace | None = None,
    clip: Clip | None = None,
) -> EventView:
    """Images of one event for the report."""
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
