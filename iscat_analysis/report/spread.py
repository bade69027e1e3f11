"""What the report says of the measured spread, and of what it cannot show."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from scipy.special import bdtrc

from iscat_analysis.records import Analysis, Status
from iscat_analysis.report.numbers import decimals_for, fixed, number
from iscat_analysis.report.style import BLUE, GREY, INK, VERMILLION, new_figure

_POOR = 0.01  # p-value that a good fit has in 1 of 100
_CHANCE = 1e-4  # that so many fits are poor, below which the model is rejected


def counted(table: pd.DataFrame) -> pd.DataFrame:
    """Leave out the rows that stay in the table but are no events: side lobes of others.

    Parameters
    ----------
    table : pandas.DataFrame
        With a column ``status``.

    Returns
    -------
    pandas.DataFrame
        The rows that count as events.
    """
    return table[table["status"] != "sidelobe"]


def rejection(table: pd.DataFrame) -> str:
    """Say that the model of the image is rejected, where it is.

    Parameters
    ----------
    table : pandas.DataFrame
        With the columns ``p_value`` and ``status``.

    Returns
    -------
    str
        One sentence; empty where no more fits are poor than chance makes so.
    """
    table = counted(table)
    p = table["p_value"].to_numpy(float)
    p = p[np.isfinite(p)]
    poor = int(np.count_nonzero(p < _POOR))
    if not p.size or float(bdtrc(poor - 1, p.size, _POOR)) > _CHANCE:
        return ""
    return (
        f"The model is rejected: {poor} of {p.size} fits have a p-value below {_POOR:g}, where "
        f"{number(_POOR * p.size, 2)} would by chance. Errors of the model, such as a wrong focus, "
        "aperture or pixel size, are not in σ, and in the spread only as rings left over of "
        "other particles; they show in how far the species are wider than σ."
    )


def species_widths(summary: Mapping[str, Any]) -> list[str]:
    """Say how much wider than σ the species are.

    Parameters
    ----------
    summary : mapping
        What ``summary.json`` holds.

    Returns
    -------
    list of str
        One sentence per species; relative to its size where masses are not calibrated.
    """
    lines = []
    calibrated = summary.get("mass_scale") == "calibration"
    for one in summary.get("across_particles") or ():
        values = [one[f"width_{key}"] for key in ("kda", "low", "high")]
        if not all(value is not None and math.isfinite(value) for value in values):
            continue
        unit, name = " kDa", f"at {number(one['mass_kda'])} kDa"
        if not calibrated:
            unit, name = " %", "of contrast"
            values = [100 * value / one["mass_kda"] for value in values]
        decimals = decimals_for([(values[2] - values[1]) / 2])
        width, low, high = (fixed(value, decimals) for value in values)
        lines.append(
            f"Across particles: beyond the σ of its {one['count']:.0f} events the species {name} "
            f"is {width}{unit} ({low} to {high}) wide, so that its events scatter by "
            f"{number(one['spread_over_sigma'])} times σ."
        )
    return lines


def spread_figure(analysis: Analysis, label_of: Callable[[Analysis, str], str]) -> Figure | None:
    """Draw the measured spread over the bound against the frames averaged.

    In mode ``track``, where none are, against the frames since the background.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    label_of : callable
        Says what a parameter is called.

    Returns
    -------
    Figure or None
        One panel for each free parameter; None where nothing was measured.
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
    for place, (name, part) in enumerate(found.items()):
        axes = figure.add_subplot(1, len(found), place + 1)
        axes.axhline(1.0, color=INK, lw=1)
        if analysis.mode == "track":
            _draw_frames(axes, part)
        else:
            _draw_windows(axes, part, window)
        axes.set_title(label_of(analysis, name))
        if place == 0:
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
