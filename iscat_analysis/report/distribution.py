"""The section of the report that shows what species there are.

Everything arrives as ``summary["distribution"]``; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from iscat_analysis.report.numbers import decimals_for, fixed, number
from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, VERMILLION, new_figure

_COLUMNS = (
    {"label": "mass [kDa]", "numeric": True},
    {"label": "95 %", "numeric": True},
    {"label": "width [kDa]", "numeric": True, "title": "beyond the events' measurement errors"},
    {"label": "95 %", "numeric": True},
    {"label": "events", "numeric": True, "title": "that were seen"},
    {"label": "landing", "numeric": True},
    {"label": "leaving", "numeric": True},
    {"label": "detected", "numeric": True, "title": "chance that such a particle is detected"},
    {"label": "came", "numeric": True, "title": "events corrected for those that were missed"},
    {"label": "95 %", "numeric": True},
    {"label": "fraction", "numeric": True, "title": "of the particles that came"},
    {"label": "95 %", "numeric": True},
)


def distribution_section(found: Mapping[str, Any]) -> dict[str, Any] | None:
    """Lay out a distribution as one section of a page."""
    species = found["species"]
    if not species:
        return None
    width = found["histogram"]["high_kda"][0] - found["histogram"]["low_kda"][0]
    return {
        "id": "species",
        "title": "Species",
        "lead": _lead(found),
        "heading": "Masses and species",
        "figure": "species",
        "caption": f"Landing and leaving by |mass|, in bins of {width:g} kDa; the species are "
        "fitted to the events, not to the bins.",
        "tables": [
            {
                "caption": "Species by mass; intervals from "
                f"{found['draws']} simulated repetitions",
                "columns": list(_COLUMNS),
                "rows": _rows(species),
            }
        ],
        "notes": [f"{note[:1].upper()}{note[1:]}." for note in found["notes"]],
    }


def _lead(found: Mapping[str, Any]) -> str:
    described = [item for item in found["species"] if not item.get("background")]
    fitted = len(described)
    count = sum(not item["outlier"] for item in described)
    rivals = [row["delta_bic"] for row in found["selection"] if row["species"] != fitted]
    text = (
        f"{count} species explain {found['events']} events best (BIC), fitted to the events "
        "themselves, each with its own error."
        if count > 1
        else f"One species explains {found['events']} events best (BIC)."
    )
    if count < fitted:
        text += " What lies apart from them in one or two events is listed, and is no species."
    for item in found["species"]:
        if item.get("background"):
            share = 100 * item["count"] / found["events"]
            text += f" {share:.2g} % of the events are background, which is no species."
    if rivals:
        text += f" The next best number is worse by {number(min(rivals), 2)};"
    support = found["support"]
    if support is not None and support == support:
        text += f" in {100 * support:.0f} % of simulated repetitions the same number wins."
    elif rivals:
        text = text[:-1] + "."
    return text


def _rows(species: Sequence[Mapping[str, Any]]) -> list[list[Any]]:
    """Write the species, each column with as many decimals as its narrowest interval supports."""
    columns: list[list[Any]] = []
    for key, bounds, factor, unit in (
        ("mass_kda", "mass", 1.0, ""),
        ("width_kda", "width", 1.0, ""),
        ("count", "", 1.0, ""),
        ("landing", "", 1.0, ""),
        ("leaving", "", 1.0, ""),
        ("efficiency", "", 100.0, " %"),
        ("count_corrected", "corrected", 1.0, ""),
        ("fraction", "fraction", 100.0, " %"),
    ):
        low: list[Any] = [s.get(f"{bounds}_low") for s in species]
        high: list[Any] = [s.get(f"{bounds}_high") for s in species]
        halves = [
            factor * (q - p) / 2 if p is not None and q is not None else None
            for p, q in zip(low, high, strict=True)
        ]
        decimals = decimals_for(halves) if bounds else int(factor > 1)
        columns.append(
            ["—" if s[key] is None else fixed(factor * s[key], decimals) + unit for s in species]
        )
        if bounds:
            columns.append(
                [
                    "—"
                    if half is None or half != half
                    else f"{fixed(factor * p, decimals)} to {fixed(factor * q, decimals)}"
                    for p, q, half in zip(low, high, halves, strict=True)
                ]
            )
    return [list(row) for row in zip(*columns, strict=True)]


def species_figure(found: Mapping[str, Any]) -> Figure | None:
    """Draw masses, species and the efficiency of their detection."""
    if not found["species"]:
        return None
    bars, curves = found["histogram"], found["curves"]
    width = bars["high_kda"][0] - bars["low_kda"][0]
    mass, efficiency = np.array(curves["mass_kda"]), np.array(curves["efficiency"])
    density, error = (width * np.array(curves[key], float) for key in ("density", "density_se"))
    missed = efficiency.min() < 1
    figure = new_figure(9.6, 3.4)
    panels = figure.subplots(1, 2, width_ratios=(2.2, 1)) if missed else [figure.add_subplot()]
    panels[0].stairs(
        bars["count"], [*bars["low_kda"], bars["high_kda"][-1]], fill=True, color=GREY, alpha=0.5,
        label="events",
    )  # fmt: skip
    panels[0].fill_between(
        mass,
        np.maximum(density - 1.96 * error, 0),
        density + 1.96 * error,
        color=BLUE,
        alpha=0.2,
        lw=0,
    )
    panels[0].plot(mass, density, color=BLUE, lw=1, label="kernel density, 95 %")
    model = width * np.array(curves["model"])
    panels[0].plot(mass, model, color=VERMILLION, lw=1.6, label="species")
    panels[0].set(xlabel="|mass| [kDa]", ylabel=f"events per {width:g} kDa")
    if missed:
        corrected = width * np.array(curves["model_corrected"])
        panels[0].plot(mass, corrected, "--", color=PURPLE, label="corrected for what was missed")
        panels[1].plot(mass, efficiency, color=INK)
        known = [s for s in found["species"] if not s.get("background")]
        at = [s["mass_kda"] for s in known]
        panels[1].plot(at, [s["efficiency"] for s in known], "o", color=VERMILLION)
        panels[1].set(xlabel="|mass| [kDa]", title="Chance of detection", ylim=(0, 1.05))
    for rung in found["species"]:
        if rung.get("n"):
            panels[0].axvline(rung["mass_kda"], color=GREY, lw=0.8, ls=":", zorder=0)
            panels[0].annotate(
                str(rung["n"]), (rung["mass_kda"], 1.0), xycoords=("data", "axes fraction"),
                ha="center", va="bottom", color=INK,
            )  # fmt: skip
    panels[0].legend(loc="best")  # said, because without it Matplotlib warns where that is slow
    return figure
