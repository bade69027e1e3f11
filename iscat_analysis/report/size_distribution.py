"""The section of the report that shows how large spheres are.

Everything arrives as ``summary["sizes"]``; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.report.numbers import decimals_for, fixed
from iscat_analysis.report.style import GREY, INK, VERMILLION, new_figure

_COLUMNS = (
    {"label": "median diameter [nm]", "numeric": True},
    {"label": "95 %", "numeric": True},
    {"label": "geometric standard deviation", "numeric": True,
     "title": "of the diameters, beyond their errors"},
    {"label": "95 %", "numeric": True},
    {"label": "fraction", "numeric": True, "title": "of the spheres that were seen"},
    {"label": "95 %", "numeric": True},
    {"label": "spheres", "numeric": True},
)  # fmt: skip


def sizes_section(found: Mapping[str, Any]) -> dict[str, Any]:
    """Lay out populations of diameters as one section of a page."""
    many = len(found["populations"])
    return {
        "id": "species",
        "title": "Sizes",
        "lead": f"{many} log-normal populations of diameters explain {found['spheres']} spheres "
        "best (BIC), each with its own error."
        if many > 1
        else f"One log-normal population of diameters explains {found['spheres']} spheres best "
        "(BIC), each with its own error.",
        "heading": "Diameters and populations",
        "figure": "sizes",
        "caption": "Diameters of spheres that were seen. The curve has the errors of the "
        "diameters; each bar reaches from the median of a population over one geometric standard "
        "deviation without them.",
        "tables": [
            {
                "caption": "Populations by diameter; intervals from "
                f"{found['draws']} simulated repetitions",
                "columns": list(_COLUMNS),
                "rows": _rows(found["populations"]),
            }
        ],
        "notes": [f"{note[:1].upper()}{note[1:]}." for note in found["notes"]],
    }


def _rows(populations: list[Mapping[str, Any]]) -> list[list[str]]:
    """Write the populations, each number with as many decimals as its interval supports."""
    rows = []
    for each in populations:
        row = []
        for key, name, factor, unit in (
            ("diameter_nm", "diameter", 1.0, ""),
            ("geometric_sd", "geometric_sd", 1.0, ""),
            ("fraction", "fraction", 100.0, " %"),
        ):
            low, high = factor * each[f"{name}_low"], factor * each[f"{name}_high"]
            decimals = decimals_for([(high - low) / 2])
            row += [
                fixed(factor * each[key], decimals) + unit,
                f"{fixed(low, decimals)} to {fixed(high, decimals)}",
            ]
        rows.append([*row, fixed(each["count"], 0) + (", outlier" if each["outlier"] else "")])
    return rows


def sizes_figure(found: Mapping[str, Any]) -> Figure:
    """Draw the histogram of diameters and the populations."""
    bars, curve = found["histogram"], found["curve"]
    width = bars["high_nm"][0] - bars["low_nm"][0]
    diameter, model = np.array(curve["diameter_nm"]), width * np.array(curve["model"])
    figure = new_figure(9.6, 3.4)
    axes = figure.add_subplot()
    axes.stairs(
        bars["count"], [*bars["low_nm"], bars["high_nm"][-1]], fill=True, color=GREY, alpha=0.5,
        label="spheres",
    )  # fmt: skip
    axes.plot(diameter, model, color=VERMILLION, lw=1.6, label="populations, with errors")
    for each in found["populations"]:
        middle, spread = each["diameter_nm"], each["geometric_sd"]
        axes.errorbar(
            middle, np.interp(middle, diameter, model) / 2,
            xerr=[[middle * (1 - 1 / spread)], [middle * (spread - 1)]], color=INK, marker="o",
            ms=4, capsize=3,
        )  # fmt: skip
    axes.set(xlabel="diameter [nm]", ylabel=f"spheres per {width:g} nm", ylim=(0, None))
    axes.legend(loc="best")
    return figure
