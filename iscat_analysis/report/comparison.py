"""The figure of samples beside each other.

Everything arrives as the document ``species_comparison`` and histograms; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iscat_analysis.report.numbers import number
from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, VERMILLION, new_figure
from iscat_analysis.text import in_figure

_COLOURS = (GREY, VERMILLION, BLUE, PURPLE)
_NAMED = 12  # samples whose names fit beside an axis
_LONGEST = 24  # letters of a name


def comparison_figure(
    found: Mapping[str, Any], histograms: Sequence[Mapping[str, Any]]
) -> Iterator[tuple[str, Figure]]:
    """Draw mass distributions over each other, shifts and differences of fractions."""
    pairs = found["comparisons"]
    figure = new_figure(11.5, max(3.4, 1.6 + 0.3 * min(len(pairs), _NAMED)))
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.8, 1, 1))
    for place, drawn in enumerate(histograms):
        colour = _COLOURS[place % len(_COLOURS)]
        left.stairs(
            drawn["share"], drawn["edges"], color=colour, fill=place == 0, lw=1.2,
            alpha=0.5 if place == 0 else 0.9, label=_short(drawn["source"]),
        )  # fmt: skip
    width = histograms[0]["edges"][1] - histograms[0]["edges"][0]
    left.set(xlabel="|mass| [kDa]", ylabel=f"share of events per {number(width, 2)} kDa")
    left.legend()
    _intervals(middle, pairs, "shift_kda", "shift", "shift [kDa]")
    _intervals(right, pairs, "difference", "difference", "difference of fractions")
    right.set_yticklabels([])
    handles, labels = middle.get_legend_handles_labels()
    right.legend(handles, labels, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    right.locator_params(axis="x", nbins=5)
    yield "comparison", figure


def _intervals(
    axes: Axes, pairs: Sequence[Mapping[str, Any]], value: str, name: str, label: str
) -> None:
    """Draw one point with its 95 % interval for each sample and species."""
    kinds = len(pairs[0]["species"])
    for i in range(kinds):
        colour = (VERMILLION, BLUE, PURPLE, INK)[i % 4]
        rows = [pair["species"][i] for pair in pairs]
        known = [place for place, row in enumerate(rows) if row[value] is not None]
        at = [rows[p][value] for p in known]
        places = [p + 0.6 * ((i + 0.5) / kinds - 0.5) for p in known]
        reach = [
            [rows[p][value] - rows[p][f"{name}_low"] for p in known],
            [rows[p][f"{name}_high"] - rows[p][value] for p in known],
        ]
        axes.errorbar(
            at, places, xerr=reach, fmt="o", ms=3.5, lw=1, color=colour,
            label=f"{number(rows[0]['mass_kda'])} kDa",
        )  # fmt: skip
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
    return in_figure(name if len(name) <= _LONGEST else f"{name[: _LONGEST - 1]}…")
