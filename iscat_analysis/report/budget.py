"""The budget of a mass on the page: a chart and a table of what its error is made of."""

from __future__ import annotations

import math
from collections.abc import Mapping
from textwrap import fill
from typing import Any

from matplotlib.figure import Figure

from iscat_analysis.records import Analysis
from iscat_analysis.report.numbers import number, percent
from iscat_analysis.report.style import BLUE, GREY, INK, VERMILLION, new_figure

COLUMNS = [
    {"label": "source"},
    {"label": "known by", "title": "measured, learned from pictures, or assumed"},
    {"label": "shared", "title": "shared by all rows: averaging does not lessen it"},
    {"label": "σ [kDa]", "numeric": True, "title": "median over the rows that are ok"},
    {"label": "of the mass", "numeric": True},
    {"label": "degrees of freedom", "numeric": True},
    {"label": "what shrinks it"},
]
"""Headings of the table."""

_COLORS = {"measured": BLUE, "learned": VERMILLION, "assumed": GREY}
_SHORTEST = 1e-3  # of the longest bar; shorter ones are not drawn
_LINE = 34  # letters of a name, beyond which it goes on below


def _sized(analysis: Analysis) -> list[Mapping[str, Any]]:
    """Give the entries whose share of the mass is known."""
    budget = analysis.summary.get("budget", ())
    return [one for one in budget if one["sigma_rel"] is not None and one["sigma_rel"] > 0]


def budget_rows(analysis: Analysis) -> list[list[str]]:
    """Write the table, and in its last line what is common to all rows."""
    budget = analysis.summary.get("budget", ())
    rows = [_row(one) for one in budget]
    shared = [one for one in _sized(analysis) if one["common"]]
    if len(shared) > 1:
        whole = {
            key: math.sqrt(sum(one[key] ** 2 for one in shared))
            for key in ("sigma_mass_kda", "sigma_rel")
        }
        rows.append(
            _row({"name": "all that is shared", "kind": "", "common": True, "dof": None,
                  "remedy": "", **whole})
        )  # fmt: skip
    return rows


def _row(one: Mapping[str, Any]) -> list[str]:
    share = one["sigma_rel"]
    return [
        one["name"],
        one["kind"],
        "all rows" if one["common"] else "",
        number(one["sigma_mass_kda"]),
        "—" if share is None else percent(share),
        "" if one["dof"] is None else f"{one['dof']:.0f}",
        one["remedy"],
    ]


def budget_figure(analysis: Analysis) -> Figure | None:
    """Draw a bar for each source of the error of a mass, the largest first."""
    known = sorted(_sized(analysis), key=lambda one: -one["sigma_rel"])
    known = [one for one in known if one["sigma_rel"] > _SHORTEST * known[0]["sigma_rel"]]
    if not known:
        return None
    figure = new_figure(6.5, 0.7 + 0.3 * len(known))
    axes = figure.add_subplot()
    for place, one in enumerate(known):
        axes.barh(
            place, 100 * one["sigma_rel"], height=0.6, color=_COLORS[one["kind"]],
            alpha=1.0 if one["common"] else 0.5,
        )  # fmt: skip
        axes.annotate(
            f" {one['kind']}{'' if one['common'] else ', each row its own'}",
            (100 * one["sigma_rel"], place), va="center", fontsize=8, color=INK,
        )  # fmt: skip
    axes.set_yticks(range(len(known)), [fill(one["name"], _LINE) for one in known])
    axes.invert_yaxis()
    axes.set_xlim(0, 170 * known[0]["sigma_rel"])
    axes.set_xlabel("standard deviation over the mass [%]")
    return figure
