"""The report's figures one at a time, for a notebook."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import Analysis, EventView, PosteriorResult, Status
from iscat_analysis.report import event_figures, figures, track_figures
from iscat_analysis.report.answer import main_quantity
from iscat_analysis.report.style import STYLE
from iscat_analysis.report.tables import event_table

SHOWN_FRAMES = 12
"""Frames around its own in which an event of a landing movie is marked in a film."""

_QUANTITIES = (("mass_kda", "mass", "kDa"), ("x_nm", "x", "nm"), ("y_nm", "y", "nm"),
               ("z_nm", "z", "nm"))  # fmt: skip


def draw(analysis: Analysis, kind: str) -> Figure:
    """Draw one figure of the whole analysis."""
    table = event_table(analysis)
    main = main_quantity(analysis).column
    kinds: dict[str, Callable[[], Figure]] = {
        "overview": lambda: figures.overview(analysis, table),
        "histogram": lambda: figures.histogram(analysis, table),
        "precision": lambda: figures.precision(analysis, table),
        "power": lambda: figures.power(analysis),
    }
    if analysis.tracks is not None:
        kinds["overview"] = lambda: track_figures.trajectories(analysis, table)
        kinds["histogram"] = lambda: track_figures.distributions(analysis)
    if kind not in kinds:
        raise ValueError(f"kind = {kind!r}: choose one of {', '.join(kinds)}")
    if kind in ("histogram", "precision") and not np.isfinite(table[main].to_numpy(float)).any():
        raise DataError(f"{_movie(analysis)}: no event was found, so there is no {kind} to draw")
    return _shown(kinds[kind])


def draw_event(analysis: Analysis, event: int) -> Figure:
    """Draw data, model and residual of one event."""
    return draw_view(view_of(analysis, event), analysis.scheme, analysis.pixel_size_nm)


def draw_view(view: EventView, scheme: str, pixel_size_nm: float) -> Figure:
    """Draw the images of one event."""
    return _shown(lambda: event_figures.triptych(view, scheme, pixel_size_nm))


def draw_corner(analysis: Analysis, event: int) -> Figure:
    """Draw the posterior of one event: each parameter, and each pair."""
    posterior = posterior_of(analysis, event)
    return _shown(lambda: event_figures.corner(posterior, event))


def view_of(analysis: Analysis, event: int) -> EventView:
    """Find the images of one event."""
    if isinstance(event, bool) or not isinstance(event, (int, np.integer)):
        raise ConfigError(f"event = {event!r}: events have whole numbers, as in view(0)")
    for view in analysis.views:
        if view.event == event:
            return view
    known = [view.event for view in analysis.views]
    held = f"it has events {min(known)} to {max(known)}" if known else "no event was found"
    raise DataError(f"{_movie(analysis)}: there is no event {event}; {held}")


def posterior_of(analysis: Analysis, event: int) -> PosteriorResult:
    """Find the converged chain of one event."""
    posterior = view_of(analysis, event).posterior
    if posterior is None:
        status = analysis.table.loc[analysis.table["event"] == event, "status"].iloc[0]
        why = "" if status == Status.OK else f" (its fit is {status})"
        raise DataError(
            f"{_movie(analysis)}: the posterior of event {event} was not sampled{why}; "
            "fit again with posterior.enabled = true"
        )
    if not posterior.converged:
        raise DataError(
            f"{_movie(analysis)}: the chain of event {event} has not converged "
            f"({posterior.message}), so it is not a posterior; raise posterior.steps"
        )
    return posterior


def event_facts(row: pd.Series[Any]) -> list[tuple[str, str]]:
    """Say in words what was found of an event: its numbers, with errors and bounds."""
    name, number = "event", row["event"]
    if "track" in row and pd.notna(row["track"]):
        name, number = "track", int(row["track"])
    when = "leaves at frame" if row["mass_kda"] < 0 else "frame"
    facts = [(name, f"{number}, {when} {row['frame']}")]
    for key, label, unit in _QUANTITIES:
        if not np.isfinite(row[key]):
            continue
        sigma, bound = row[f"sigma_{key}"], row[f"crb_{key}"]
        error = f" ± {sigma:.1f}" if np.isfinite(sigma) else ""
        beside = f" (CRB {bound:.1f})" if np.isfinite(bound) else ""
        facts.append((label, f"{row[key]:.1f}{error} {unit}{beside}"))
    status = Status(row["status"])
    return [
        *facts,
        ("contrast", f"{100 * row['contrast']:.3f} %, SNR {row['snr']:.1f}"),
        ("status", f"{status.value}: {status.advice}"),
    ]


def _movie(analysis: Analysis) -> str:
    return analysis.provenance.input_path or "the movie"


def _shown(make: Callable[[], Figure]) -> Figure:
    with mpl.rc_context(STYLE):
        figure = make()
    # A notebook asks an object for its picture; pyplot, with its global state, is not needed.
    setattr(figure, "_repr_png_", functools.partial(_png, figure))  # noqa: B010
    return figure


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return buffer.getvalue()
