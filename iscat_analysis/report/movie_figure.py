"""Where in the movie?  Light, noise, focus, drift and events, one below the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from iscat_analysis.records import Analysis
from iscat_analysis.report.style import BLUE, GREY, PURPLE, VERMILLION, new_figure

_ROW, _EDGES = 0.72, 0.75  # height of a row, and what axis and legend take [inches]
_NUMBERS = 0.7  # room for the numbers beside a row [inches]; to measure it takes half of drawing
_NARROWEST = 0.004  # of the axis, of an interval that is seen

Row = tuple[str, Callable[[Axes], None]]


def movie_figure(analysis: Analysis) -> Figure:
    """Draw what was where in a movie, on one axis of frames."""
    told = analysis.summary["timeline"]
    rows = _rows(analysis, told)
    figure = new_figure(7.0, _EDGES + _ROW * len(rows))
    panels = np.atleast_1d(figure.subplots(len(rows), 1, sharex=True))
    first, last = told["events"]["edges"][0], told["events"]["edges"][-1]
    narrow = _NARROWEST * (last - first)
    for axes, (label, draw) in zip(panels, rows, strict=True):
        draw(axes)
        for one in told["intervals"]:
            hidden = one["what"].startswith("partly")
            stop = max(one["stop"], one["start"] + narrow)
            axes.axvspan(
                one["start"], stop, lw=0, color=GREY if hidden else PURPLE,
                alpha=0.2 if hidden else 0.3, label="partly hidden" if hidden else "left out",
            )  # fmt: skip
        axes.set_ylabel(label, rotation=0, ha="right", va="center")
        beside = ScaledTranslation(-_NUMBERS, 0, figure.dpi_scale_trans)
        axes.yaxis.set_label_coords(0, 0.5, transform=axes.transAxes + beside)
        axes.yaxis.set_major_locator(MaxNLocator(3))
    panels[-1].yaxis.set_major_locator(MaxNLocator(3, integer=True))
    panels[-1].set(xlabel="frame", xlim=(first, last))
    panels[-1].xaxis.set_major_locator(MaxNLocator(7, integer=True))
    marks: dict[str, Any] = {}
    for axes in panels:
        marks |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    if marks:
        figure.legend(marks.values(), marks.keys(), loc="outside upper right", ncols=4, fontsize=8)
    return figure


def _rows(analysis: Analysis, told: Mapping[str, Any]) -> list[Row]:
    """Name the rows that have something to show, and what draws each."""
    frames = np.array(told["frames"], dtype=float)
    noise, focus, x, y = (
        np.array(told[name], dtype=float)
        for name in ("noise_over_expected", "focus_nm", "drift_x_px", "drift_y_px")
    )

    def light(axes: Axes) -> None:
        axes.axhline(1.0, color=GREY, lw=0.8, ls="--")
        axes.plot(analysis.power_frames, analysis.power, color=BLUE, lw=0.8)

    def noise_row(axes: Axes) -> None:
        axes.axhline(1.0, color=GREY, lw=0.8, ls="--")
        axes.plot(frames, noise, "o", color=VERMILLION, ms=2.5)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.95), max(high, 1.05))

    def drift(axes: Axes) -> None:
        axes.plot(frames, x, color=BLUE, lw=1.2, label="x")
        axes.plot(frames, y, color=VERMILLION, lw=1.2, label="y")

    def events(axes: Axes) -> None:
        counted = told["events"]
        ok, flagged = (np.array(counted[name]) for name in ("ok", "flagged"))
        several = flagged.any()
        axes.stairs(ok, counted["edges"], fill=True, color=BLUE, label="ok" if several else None)
        if several:
            axes.stairs(
                ok + flagged, counted["edges"], baseline=ok, fill=True, color=VERMILLION,
                label="flagged",
            )  # fmt: skip

    rows: list[tuple[bool, Row]] = [
        (np.isfinite(np.asarray(analysis.power, float)).any(), ("light,\nrelative", light)),
        (np.isfinite(noise).any(), ("noise,\nvariance over\nexpected", noise_row)),
        (
            analysis.scheme != "darkfield" and np.isfinite(focus).any(),
            ("focus\n[nm]", lambda axes: _line(axes, frames, focus)),
        ),
        (np.isfinite(x).any(), ("drift\n[px]", drift)),
        (True, ("events", events)),
    ]
    return [row for shown, row in rows if shown]


def _line(axes: Axes, frames: np.ndarray[Any, Any], values: np.ndarray[Any, Any]) -> None:
    """Draw a number against frame.

    Shapes: `frames, values` (n,).
    """
    axes.plot(frames, values, color=BLUE, lw=1.2)
    low, high = axes.get_ylim()
    if high - low < 1.0:  # of a focus that stays
        axes.set_ylim(low - 1.0, high + 1.0)
