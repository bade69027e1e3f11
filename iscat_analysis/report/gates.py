"""The figure of a histogram with its gates and species; nothing is computed here."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, STYLE, VERMILLION, new_figure

PALETTES: Mapping[str, tuple[str, ...]] = {
    "colour-blind safe": (BLUE, VERMILLION, PURPLE, "#009E73", "#E69F00", "#56B4E9"),
    "greys": ("#000000", "#555555", "#888888", "#AAAAAA", "#333333", "#777777"),
}
"""Colours of samples, by name."""

FONTS = ("sans-serif", "serif", "monospace")
"""Families of letters."""

Format = Literal["svg", "pdf", "png"]


def histogram_figure(
    samples: Sequence[tuple[str, Any]],
    *,
    width_cm: float = 12.0,
    height_cm: float = 8.0,
    font_pt: float = 9.0,
    font: str = "sans-serif",
    palette: str = "colour-blind safe",
    gates: Sequence[Any] = (),
    curve: tuple[Any, Any] | None = None,
    density: bool = True,
) -> Figure:
    """Draw histograms over each other, shaded gates, and the curve of the species.

    A sample is its name and a `MassHistogram`; several are drawn as shares.
    """
    colours = PALETTES[palette]
    shares = len(samples) > 1
    with mpl.rc_context({**STYLE, "font.size": font_pt, "font.family": font}):
        figure = new_figure(width_cm / 2.54, height_cm / 2.54)
        axes = figure.add_subplot()
        for place, (name, seen) in enumerate(samples):
            scale = 1.0 / max(seen.counts.sum(), 1.0) if shares else 1.0
            colour = colours[place % len(colours)]
            axes.stairs(
                seen.counts * scale, seen.edges, fill=not shares, alpha=0.9 if shares else 0.45,
                color=colour if shares else GREY, label=name,
            )  # fmt: skip
            if density:
                axes.plot(seen.mass_kda, seen.density * scale, color=colour, lw=1.2)
        if curve is not None:
            axes.plot(np.asarray(curve[0]), np.asarray(curve[1]), color=VERMILLION, lw=1.6,
                      label="species")  # fmt: skip
        for each in gates:
            axes.axvspan(each.low_kda, each.high_kda, color=BLUE, alpha=0.12, lw=0)
            axes.annotate(
                f"{each.mean_kda:.0f} kDa\n{each.count}", color=INK, ha="center", va="top",
                xy=((each.low_kda + each.high_kda) / 2, 0.98), xycoords=("data", "axes fraction"),
            )  # fmt: skip
        bar = samples[0][1].bin_kda if samples else 1.0
        label = "share of events" if shares else "events"
        axes.set(xlabel="|mass| [kDa]", ylabel=f"{label} per {bar:g} kDa")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        if shares or curve is not None:
            axes.legend(loc="best")
    return figure


def figure_bytes(figure: Figure, kind: Format, *, dpi: int = 300) -> bytes:
    """Write a figure as a file's contents."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=dpi)
    return buffer.getvalue()
