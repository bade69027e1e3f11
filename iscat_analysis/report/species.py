"""Species, sizes, samples beside each other and equilibria: their sections and figures.

Everything arrives as what ``summary.json`` and the documents of the commands hold; nothing is
computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iscat_analysis.report.numbers import number
from iscat_analysis.report.plots import contents, figure_of, plot_kd
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    INK,
    PURPLE,
    STYLE,
    VERMILLION,
    Style,
    floats,
    new_figure,
    one_panel,
    whiskers,
)
from iscat_analysis.text import in_figure

PALETTES: Mapping[str, tuple[str, ...]] = {
    "colour-blind safe": (BLUE, VERMILLION, PURPLE, "#009E73", "#E69F00", "#56B4E9"),
    "greys": ("#000000", "#555555", "#888888", "#AAAAAA", "#333333", "#777777"),
}
"""Colours of samples, by name."""

FONTS = ("sans-serif", "serif", "monospace")
"""Families of letters."""

Format = Literal["svg", "pdf", "png"]

_NAMED = 12  # samples whose names fit beside an axis
_CORRECTED = ("corrected_low", "corrected_high")


# ---- Species of a movie --------------------------------------------------------------------------


def species_figure(found: Mapping[str, Any]) -> Figure | None:
    """Draw masses, species and the efficiency of their detection."""
    if not found["species"]:
        return None
    curves = {name: floats(values) for name, values in found["curves"].items()}
    mass, efficiency = curves["mass_kda"], curves["efficiency"]
    missed = efficiency.min() < 1
    figure = new_figure(9.6, 3.4)
    panels = figure.subplots(1, 2, width_ratios=(2.2, 1)) if missed else [figure.add_subplot()]
    width = _bars(panels[0], found["histogram"], "kda", "events")
    density, error = width * curves["density"], width * curves["density_se"]
    low, high = np.maximum(density - 1.96 * error, 0), density + 1.96 * error
    panels[0].fill_between(mass, low, high, color=BLUE, alpha=0.2, lw=0)
    panels[0].plot(mass, density, color=BLUE, lw=1, label="kernel density, 95 %")
    panels[0].plot(mass, width * curves["model"], color=VERMILLION, lw=1.6, label="species")
    panels[0].set(xlabel="|mass| [kDa]", ylabel=f"events per {width:g} kDa")
    if missed:
        corrected = width * curves["model_corrected"]
        panels[0].plot(mass, corrected, "--", color=PURPLE, label="corrected for what was missed")
        panels[1].plot(mass, efficiency, color=INK)
        known = [s for s in found["species"] if not s.get("background")]
        at = [s["mass_kda"] for s in known]
        panels[1].plot(at, [s["efficiency"] for s in known], "o", color=VERMILLION)
        panels[1].set(xlabel="|mass| [kDa]", title="Chance of detection", ylim=(0, 1.05))
    for rung in found["species"]:
        if rung.get("n"):
            panels[0].axvline(rung["mass_kda"], color=GREY, lw=0.8, ls=":", zorder=0)
            place: Style = {"xycoords": ("data", "axes fraction"), "ha": "center"}
            panels[0].annotate(str(rung["n"]), (rung["mass_kda"], 1), va="bottom", **place)
    panels[0].legend(loc="best")  # named, because Matplotlib warns where its own choice is slow
    return figure


def _bars(axes: Axes, bars: Mapping[str, Any], unit: str, label: str) -> float:
    """Draw a histogram of a document; give the width of its bins."""
    low, high = bars[f"low_{unit}"], bars[f"high_{unit}"]
    edges = [*low, high[-1]]
    axes.stairs(bars["count"], edges, fill=True, color=GREY, alpha=0.5, label=label)
    return float(high[0] - low[0])


# ---- Samples and equilibria ----------------------------------------------------------------------


def comparison_figure(
    found: Mapping[str, Any], histograms: Sequence[Mapping[str, Any]]
) -> Iterator[tuple[str, Figure]]:
    """Draw mass distributions over each other, shifts and differences of fractions."""
    pairs = found["comparisons"]
    figure = new_figure(11.5, max(3.4, 1.6 + 0.3 * min(len(pairs), _NAMED)))
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.8, 1, 1))
    colours = (GREY, VERMILLION, BLUE, PURPLE)
    for place, drawn in enumerate(histograms):
        style: Style = {"color": colours[place % 4], "alpha": 0.9 if place else 0.5}
        name = _short(drawn["source"])
        left.stairs(drawn["share"], drawn["edges"], fill=not place, lw=1.2, label=name, **style)
    width = histograms[0]["edges"][1] - histograms[0]["edges"][0]
    left.set(xlabel="|mass| [kDa]", ylabel=f"share of events per {number(width, 2)} kDa")
    left.legend()
    _intervals(middle, pairs, ("shift_kda", "shift_low", "shift_high"), "shift [kDa]")
    differences = ("difference", "difference_low", "difference_high")
    _intervals(right, pairs, differences, "difference of fractions")
    right.set_yticklabels([])
    right.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    right.locator_params(axis="x", nbins=5)
    yield "comparison", figure


def _intervals(
    axes: Axes, pairs: Sequence[Mapping[str, Any]], names: tuple[str, str, str], label: str
) -> None:
    """Draw one point with its 95 % interval for each sample and species."""
    kinds = len(pairs[0]["species"])
    for i in range(kinds):
        colour = (VERMILLION, BLUE, PURPLE, INK)[i % 4]
        rows = [pair["species"][i] for pair in pairs]
        at, low, high = (floats(row[name] for row in rows) for name in names)
        places = np.arange(len(rows)) + 0.6 * ((i + 0.5) / kinds - 0.5)
        style: Style = {"ms": 3.5, "color": colour, "label": f"{number(rows[0]['mass_kda'])} kDa"}
        whiskers(axes, places, at, (low, high), along="x", style=style)
    axes.axvline(0, color=GREY, lw=0.8)
    axes.set(xlabel=f"{label}, 95 %", ylim=(len(pairs) - 0.5, -0.5))
    if len(pairs) <= _NAMED:
        axes.set_yticks(range(len(pairs)), [_short(pair["source"]) for pair in pairs])
    else:
        axes.set_ylabel("sample")


def _short(source: str) -> str:
    """Name a table by its folder where the file is named as all are."""
    path = PurePath(source)
    name = path.parent.name if path.stem == "fits" and path.parent.name else path.name
    return in_figure(name if len(name) <= 24 else f"{name[:23]}…")


def binding_figure(found: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw fractions of complexes with their intervals, the equilibrium and the profile."""
    yield "kd", figure_of(plot_kd(found))


# ---- A histogram with its gates, for the app -----------------------------------------------------


def histogram_figure(
    samples: Sequence[tuple[str, Any]],
    *,
    size_cm: tuple[float, float] = (12.0, 8.0),
    font: tuple[str, float] = ("sans-serif", 9.0),
    palette: str = "colour-blind safe",
    gates: Sequence[Any] = (),
    curve: tuple[Any, Any] | None = None,
    density: bool = True,
) -> Figure:
    """Draw histograms over each other, shaded gates, and the curve of the species.

    A sample is its name and a `MassHistogram`; several are drawn as shares.  The font has a family
    and a size [pt].
    """
    colours = PALETTES[palette]
    shares = len(samples) > 1
    with mpl.rc_context({**STYLE, "font.family": font[0], "font.size": font[1]}):
        figure, axes = one_panel(*(side / 2.54 for side in size_cm))
        for place, (name, mass) in enumerate(samples):
            scale = 1.0 / max(mass.counts.sum(), 1.0) if shares else 1.0
            colour = colours[place % len(colours)]
            style: Style = {"color": colour if shares else GREY, "alpha": 0.9 if shares else 0.45}
            axes.stairs(mass.counts * scale, mass.edges, fill=not shares, label=name, **style)
            if density:
                axes.plot(mass.mass_kda, mass.density * scale, color=colour, lw=1.2)
        if curve is not None:
            axes.plot(*map(np.asarray, curve), color=VERMILLION, lw=1.6, label="species")
        for each in gates:
            axes.axvspan(each.low_kda, each.high_kda, color=BLUE, alpha=0.12, lw=0)
            text = f"{each.mean_kda:.0f} kDa\n{each.count}"
            middle = ((each.low_kda + each.high_kda) / 2, 0.98)
            place_of: Style = {"xycoords": ("data", "axes fraction"), "ha": "center"}
            axes.annotate(text, middle, color=INK, va="top", **place_of)
        bar = samples[0][1].bin_kda if samples else 1.0
        label = "share of events" if shares else "events"
        axes.set(xlabel="|mass| [kDa]", ylabel=f"{label} per {bar:g} kDa")
        axes.set(xlim=(0, None), ylim=(0, None))
        if shares or curve is not None:
            axes.legend(loc="best")
    return figure


def figure_bytes(figure: Figure, kind: Format, *, dpi: int = 300) -> bytes:
    """Write a figure as a file's contents."""
    return contents(figure, kind, dpi)
