"""The figure of the measured spread."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from iscat_analysis.records import Analysis, Status
from iscat_analysis.report.style import BLUE, GREY, INK, VERMILLION, new_figure


def spread_figure(analysis: Analysis, label_of: Callable[[Analysis, str], str]) -> Figure | None:
    """Draw the measured spread over the bound against the frames averaged.

    In mode ``track``, where none are, against the frames since the background.
    """
    found = {
        name: part
        for name, part in analysis.summary.get("precision", {}).items()
        if part.get("repeat_over_crb") is not None
    }
    if not found:
        return None
    good = analysis.table["status"] != Status.SIDELOBE.value
    window = float(np.median(analysis.table.loc[good, "n_after"]))
    figure = new_figure(3.0 * len(found), 3.0)
    for column, (name, part) in enumerate(found.items()):
        axes = figure.add_subplot(1, len(found), column + 1)
        axes.axhline(1.0, color=INK, lw=1)
        if analysis.mode == "track":
            _draw_frames(axes, part)
        else:
            _draw_windows(axes, part, window)
        axes.set_title(label_of(analysis, name))
        if column == 0:
            axes.set_ylabel("spread over CRB")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, fontsize=8)
    return figure


def _draw_windows(axes: Axes, part: Mapping[str, Any], window: float) -> None:
    """Draw the spread of averages against their frames."""
    _draw_curve(axes, part, "o", BLUE, "own frames")
    if part["empty_over_crb"]:
        lengths = window * np.array([1 / 8, 1 / 4, 1 / 2, 1])
        axes.plot(lengths, part["empty_over_crb"][1:], "s", color=GREY, ms=4, label="no particle")
    ratio, (low, high) = part["repeat_over_crb"], part["repeat_over_crb_ci95"]
    axes.errorbar(
        [window], [ratio], [[ratio - low], [high - ratio]], fmt="D", color=VERMILLION, ms=5,
        lw=1.2, label="estimates",
    )  # fmt: skip
    axes.set(xscale="log", xlabel="frames averaged")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _draw_frames(axes: Axes, part: Mapping[str, Any]) -> None:
    """Draw the spread of single frames against their distance from the background."""
    _draw_curve(axes, part, "s", GREY, "no particle")
    axes.axhline(part["repeat_over_crb"], color=VERMILLION, lw=1.2, label="all frames")
    axes.axhspan(*part["repeat_over_crb_ci95"], color=VERMILLION, alpha=0.2, lw=0)
    axes.axhline(part["empty_over_crb"][0], color=BLUE, lw=1, ls="--", label="successive frames")
    axes.set_xlabel("frames since the background")


def _draw_curve(axes: Axes, part: Mapping[str, Any], mark: str, color: str, label: str) -> None:
    axes.errorbar(
        part["repeat_frames"], part["repeat_over_crb_by_frames"],
        part["repeat_over_crb_by_frames_se"], fmt=mark, color=color, ms=3.5, lw=1, label=label,
    )  # fmt: skip
