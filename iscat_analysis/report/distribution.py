"""The section of the report that shows what species there are.

Everything arrives as ``summary["distribution"]``; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from iscat_analysis.report.numbers import decimals_for, fixed, number

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
    """Lay out a distribution as one section of a page.

    Parameters
    ----------
    found : mapping
        What ``summary.json`` holds under ``distribution``.

    Returns
    -------
    dict or None
        A section as ``document.html`` takes it (id, title, lead, charts, tables, notes); None where
        there are no species to show.
    """
    species = found["species"]
    if not species:
        return None
    charts = [_masses_chart(found)]
    if min(found["curves"]["efficiency"]) < 1:
        charts.append(_efficiency_chart(found))
    return {
        "id": "species",
        "title": "Species",
        "lead": _lead(found),
        "charts": charts,
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
    fitted = len(found["species"])
    count = sum(not item["outlier"] for item in found["species"])
    rivals = [row["delta_bic"] for row in found["selection"] if row["species"] != fitted]
    text = (
        f"{count} species explain {found['events']} events best (BIC), fitted to the events "
        "themselves, each with its own error."
        if count > 1
        else f"One species explains {found['events']} events best (BIC)."
    )
    if count < fitted:
        text += " What lies apart from them in one or two events is listed, and is no species."
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
            [{"text": fixed(factor * s[key], decimals) + unit, "sort": s[key]} for s in species]
        )
        if bounds:
            columns.append(
                [
                    "—" if half is None or half != half
                    else f"{fixed(factor * p, decimals)} to {fixed(factor * q, decimals)}"
                    for p, q, half in zip(low, high, halves, strict=True)
                ]
            )  # fmt: skip
    return [list(row) for row in zip(*columns, strict=True)]


def _masses_chart(found: Mapping[str, Any]) -> dict[str, Any]:
    histogram, curves = found["histogram"], found["curves"]
    width = histogram["high_kda"][0] - histogram["low_kda"][0]
    mass = curves["mass_kda"]
    density = [width * d for d in curves["density"]]
    reach = [width * 1.96 * se for se in curves["density_se"]]
    edge = {"kind": "line", "color": "qcrb", "dash": True, "thin": True, "x": mass}
    series: list[dict[str, Any]] = [
        {"kind": "bars", "name": "events", "color": "plain", "opacity": 0.45,
         "edges": [*histogram["low_kda"], histogram["high_kda"][-1]],
         "counts": histogram["count"]},
        {"kind": "line", "name": "kernel density, 95 %", "color": "qcrb", "x": mass,
         "y": density, "thin": True},
        {**edge, "y": [max(d - r, 0.0) for d, r in zip(density, reach, strict=True)]},
        {**edge, "y": [d + r for d, r in zip(density, reach, strict=True)]},
        {"kind": "line", "name": "species", "color": "sigma", "x": mass,
         "y": [width * m for m in curves["model"]]},
    ]  # fmt: skip
    if min(curves["efficiency"]) < 1:
        series.append(
            {"kind": "line", "name": "corrected for what was missed", "color": "flag",
             "dash": True, "x": mass, "y": [width * m for m in curves["model_corrected"]]}
        )  # fmt: skip
    return {
        "id": "mixture",
        "title": "Masses and species",
        "caption": f"Landing and leaving by |mass|, in bins of {width:g} kDa; the species "
        "are fitted to the events, not to the bins.",
        "wide": True,
        "spec": {
            "height": 340,
            "x": {"label": "|mass| [kDa]"},
            "y": {"label": f"events per {width:g} kDa", "zero": True},
            "series": series,
        },
    }


def _efficiency_chart(found: Mapping[str, Any]) -> dict[str, Any]:
    curves = found["curves"]
    return {
        "id": "efficiency",
        "title": "Detection efficiency",
        "caption": "Chance that a particle exceeds the matched filter's threshold; points: the "
        "species.",
        "spec": {
            "height": 240,
            "x": {"label": "|mass| [kDa]"},
            "y": {"label": "detected", "zero": True},
            "series": [
                {"kind": "line", "name": "P(snr > threshold)", "color": "crb",
                 "x": curves["mass_kda"], "y": curves["efficiency"]},
                {"kind": "points", "name": "species", "color": "sigma",
                 "x": [s["mass_kda"] for s in found["species"]],
                 "y": [s["efficiency"] for s in found["species"]]},
            ],
        },
    }  # fmt: skip
