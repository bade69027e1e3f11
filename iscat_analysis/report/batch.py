"""The page of a batch: what many movies say, side by side.

Everything arrives as the tables that are written beside it; nothing is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from iscat_analysis.report.batch_cells import (
    link,
    percent,
    plain,
    probability,
    share,
    unbroken,
    whole,
    with_interval,
)
from iscat_analysis.report.batch_figures import Curve, batch_figures
from iscat_analysis.report.binding import binding_figure
from iscat_analysis.report.numbers import fixed, number
from iscat_analysis.report.page import render_page
from iscat_analysis.report.style import publish
from iscat_analysis.schemas import jsonable
from iscat_analysis.units import count

LONG = 30
"""Rows above which a table scrolls, and can be narrowed."""

_SHARE = "of the particles that came, corrected for those that were missed; without outliers"

_CHARTS = {
    "overlaid": (
        "Masses, overlaid",
        "Kernel density of each movie, in percent of its events; all panels have the same axes.",
    ),
    "stacked": (
        "Masses, stacked",
        "Mean over the movies of each sample, in percent of the events; all rows have the same "
        "bins and the same scale. In brackets, the events.",
    ),
    "species": (
        "Mass of every species",
        "With 95 % intervals, statistical and of the mass scale; one colour for one kind.",
    ),
    "shares": (
        "Share against concentration",
        "Of the particles that came, outliers left out, with 95 % intervals.",
    ),
    "kd": (
        "Equilibrium",
        "Complexes among the particles that landed, with 95 % intervals, and the equilibrium that "
        "fits all movies together; on the right the likelihood, maximised over everything else.",
    ),
    "rates": ("Landing rate", "With 95 % Poisson intervals; not corrected for what was missed."),
}


def batch_page(
    title: str,
    *,
    subtitle: str,
    curves: Sequence[Curve],
    movies: pd.DataFrame,
    species: pd.DataFrame,
    shifts: pd.DataFrame,
    equilibria: Sequence[tuple[str, Mapping[str, Any], Sequence[str]]] = (),
    calibrations: Sequence[tuple[str, str, str]],
    failed: Sequence[tuple[str, str]],
    mass_label: str,
    folder: Path | None = None,
) -> str:
    """Make the page of a batch, and write its figures."""
    figures = chain(
        batch_figures(curves, movies, species, mass_label=mass_label), _binding(equilibria)
    )
    drawn = publish(figures, folder, printed=True)
    sections = [
        _overview(movies, failed, calibrations),
        _charts("masses", "Masses", drawn, ("overlaid", "stacked")),
        _species(species, shifts, drawn, mass_label, movies),
        _equilibria(equilibria, drawn),
        _landing(movies, drawn),
        _quality(movies),
    ]
    return render_page(
        "document.html",
        {
            "title": title,
            "subtitle": subtitle,
            "sections": [section for section in sections if section is not None],
        },
    )


def _overview(
    movies: pd.DataFrame,
    failed: Sequence[tuple[str, str]],
    calibrations: Sequence[tuple[str, str, str]],
) -> dict[str, Any]:
    done = movies[movies["state"] == "done"]
    analysed = done[done["role"] != "flat"]
    cautioned = int((done["cautions"].fillna("") != "").sum())
    tables = []
    if failed:
        columns: list[Any] = ["not analysed", "why"]
        tables.append({"columns": columns, "rows": [list(each) for each in failed]})
    rows = [[link(page, what), source] for what, source, page in calibrations]
    tables.append({"columns": ["calibration", "from"], "rows": rows})
    return {
        "id": "day",
        "title": "The day",
        "facts": [
            {
                "label": "Movies",
                "value": str(len(done)),
                "note": f"of {len(movies)}" if len(done) < len(movies) else "all of the table",
            },
            {"label": "Samples", "value": str(analysed["sample"].nunique())},
            {"label": "Events", "value": str(int(analysed["events"].sum()))},
            {"label": "With cautions", "value": str(cautioned), "note": "see the quality"},
        ],
        "tables": tables,
    }


def _charts(
    name: str, title: str, drawn: Mapping[str, Markup], kinds: Sequence[str]
) -> dict[str, Any] | None:
    charts = []
    for figure, svg in drawn.items():
        kind, _, number_of = figure.partition("_")
        if kind in kinds:
            heading, caption = _CHARTS[kind]
            charts.append(
                {
                    "id": f"figure-{figure.replace('_', '-')}",
                    "title": f"{heading}, {number_of}" if number_of else heading,
                    "caption": caption if not number_of else None,
                    "svg": svg,
                    "wide": True,
                }
            )
    return {"id": name, "title": title, "charts": charts} if charts else None


def _species(
    species: pd.DataFrame,
    shifts: pd.DataFrame,
    drawn: Mapping[str, Markup],
    mass_label: str,
    movies: pd.DataFrame,
) -> dict[str, Any] | None:
    if species.empty:
        return None
    section = _charts("species", "Species", drawn, ("species", "shares")) or {
        "id": "species",
        "title": "Species",
    }
    tables = []
    if len(shifts):
        tables.append(_shift_table(shifts, mass_label))
    tables.append(_species_table(species, mass_label, dict(_links(movies))))
    return {**section, "notes": _species_notes(shifts), "tables": tables}


def _species_notes(shifts: pd.DataFrame) -> list[str]:
    text = (
        "Species of different movies are one kind where their masses are within 10 % or three "
        "standard errors."
    )
    if shifts.empty:
        return [text]
    reference = shifts["reference"].iloc[0]
    text += (
        f" Samples are compared with {reference}, the first of the table: p is the chance of at "
        "least such a shift where there is none, corrected for the number of comparisons (Holm)."
        " The error of the mass scale, which all movies of the day share, is not in the shifts."
    )
    if shifts["scatter"].isna().any():
        text += (
            " Kinds without replicates are compared with their counting errors alone, which do not "
            "hold how movies of one sample differ: record replicates before believing a small p."
        )
    return [text]


def _shift_table(shifts: pd.DataFrame, mass_label: str) -> dict[str, Any]:
    """Lay out one row for each kind and sample: mass, shift, share, shift."""
    masses = shifts[shifts["quantity"] == "mass_kda"]
    parts = shifts[shifts["quantity"] == "share"].set_index(["kind", "sample"])
    rows = []
    for row in masses.to_dict("records"):
        part = parts.loc[(row["kind"], row["sample"])].to_dict()
        rows.append(
            [
                f"{row['kind_mass_kda']:.3g}",
                unbroken(row["sample"]),
                unbroken(row["condition"] or "—"),
                int(row["movies"]),
                *with_interval(row["value"], row["low"], row["high"]),
                *with_interval(row["shift"], row["shift_low"], row["shift_high"]),
                probability(row["p_holm"]),
                *with_interval(*(100 * part[name] for name in ("value", "low", "high")), unit=" %"),
                *with_interval(
                    *(100 * part[name] for name in ("shift", "shift_low", "shift_high")), unit=" %"
                ),
                probability(part["p_holm"]),
            ]
        )
    columns = [
        {"label": "kind [kDa]", "numeric": True},
        "sample",
        "condition",
        {"label": "movies", "numeric": True},
        {"label": mass_label, "numeric": True},
        {"label": "95 %", "numeric": True, "title": "with the scatter between movies"},
        {"label": "shift [kDa]", "numeric": True},
        {"label": "95 %", "numeric": True},
        {"label": "p", "numeric": True, "title": "corrected for the number of comparisons"},
        {"label": "share", "numeric": True, "title": _SHARE},
        {"label": "95 %", "numeric": True},
        {"label": "shift", "numeric": True},
        {"label": "95 %", "numeric": True},
        {"label": "p", "numeric": True, "title": "corrected for the number of comparisons"},
    ]
    caption = "Species by sample, and their shifts"
    return {"caption": caption, "columns": columns, "rows": rows, "tall": len(rows) > LONG}


def _species_table(
    species: pd.DataFrame, mass_label: str, links: Mapping[str, Any]
) -> dict[str, Any]:
    rows = []
    for row in species.to_dict("records"):
        rows.append(
            [
                "apart" if row["outlier"] else str(row["kind"]),
                links.get(row["movie"], row["movie"]),
                unbroken(row["sample"]),
                unbroken(row["condition"] or "—"),
                row["concentration_nm"],
                *with_interval(row["mass_kda"], row["mass_low"], row["mass_high"]),
                *with_interval(row["width_kda"], row["width_low"], row["width_high"]),
                f"{row['count']:.0f}",
                *with_interval(
                    *(100 * row[name] for name in ("share", "share_low", "share_high")), unit=" %"
                ),
                f"{100 * row['efficiency']:.0f} %",
            ]
        )
    columns = [
        {"label": "kind", "title": "one number for species of one mass; apart: an outlier"},
        "movie",
        "sample",
        "condition",
        {"label": "c [nM]", "numeric": True},
        {"label": mass_label, "numeric": True},
        {"label": "95 %", "numeric": True},
        {"label": "width [kDa]", "numeric": True, "title": "beyond the events' errors"},
        {"label": "95 %", "numeric": True},
        {"label": "events", "numeric": True},
        {"label": "share", "numeric": True, "title": _SHARE},
        {"label": "95 %", "numeric": True},
        {"label": "detected", "numeric": True},
    ]
    caption = "Species by movie"
    return {"caption": caption, "columns": columns, "rows": rows, "tall": len(rows) > LONG}


def _binding(
    equilibria: Sequence[tuple[str, Mapping[str, Any], Sequence[str]]],
) -> Iterator[tuple[str, Figure]]:
    """Draw the figure of every series: kd, kd_2, …."""
    for n, (_, found, _) in enumerate(equilibria, 1):
        for name, figure in binding_figure(jsonable(found)):
            yield (name if n == 1 else f"{name}_{n}"), figure


def _equilibria(
    equilibria: Sequence[tuple[str, Mapping[str, Any], Sequence[str]]], drawn: Mapping[str, Markup]
) -> dict[str, Any] | None:
    """Tabulate K_D of every series, and whether the movies follow the equilibrium."""
    if not equilibria:
        return None
    section = _charts("equilibrium", "Equilibrium", drawn, ("kd",)) or {}
    charts = section["charts"]
    rows = []
    for chart, (condition, found, notes) in zip(charts, equilibria, strict=True):
        chart["title"] = f"K_D, {condition}" if condition else "K_D"
        kd, low, high = (found[name] for name in ("kd_nm", "kd_low", "kd_high"))
        rows.append(
            [
                condition or "—",
                {"dimer": "2 M ⇌ D", "ab": "A + B ⇌ AB"}[found["model"]],
                len(found["samples"]),
                number(kd),
                f"{number(low)} to {number(high) if math.isfinite(high) else '∞'}",
                probability(found["p_value"]),
                "; ".join(notes) or "none",
            ]
        )
    columns = [
        "condition",
        "reaction",
        {"label": "movies", "numeric": True},
        {"label": "K_D [nM]", "numeric": True},
        {"label": "95 %", "numeric": True, "title": "of the profile likelihood"},
        {"label": "p", "numeric": True, "title": "whether the movies follow the equilibrium"},
        "remarks",
    ]
    return {**section, "tables": [{"columns": columns, "rows": rows}]}


def _landing(movies: pd.DataFrame, drawn: Mapping[str, Markup]) -> dict[str, Any] | None:
    known = movies[movies["rate"].notna()]
    if known.empty:
        return None
    unit = known["rate_unit"].iloc[0]
    links = dict(_links(movies))
    rows = [
        [
            links[row["movie"]],
            unbroken(row["sample"]),
            unbroken(row["condition"] or "—"),
            row["concentration_nm"],
            int(row["landings"]),
            int(row["leavings"]),
            *with_interval(row["rate"], row["rate_from"], row["rate_to"]),
        ]
        for row in known.to_dict("records")
    ]
    columns = [
        "movie",
        "sample",
        "condition",
        {"label": "c [nM]", "numeric": True},
        {"label": "landed", "numeric": True},
        {"label": "left", "numeric": True},
        {"label": f"landings per {unit}", "numeric": True},
        {"label": "95 %", "numeric": True},
    ]
    section = _charts("landing", "Landing", drawn, ("rates",)) or {}
    table = {"caption": "Landings", "columns": columns, "rows": rows, "tall": len(rows) > LONG}
    return {**section, "id": "landing", "title": "Landing", "tables": [table]}


def _quality(movies: pd.DataFrame) -> dict[str, Any]:
    """Tabulate the quality of every movie."""
    links = dict(_links(movies))
    further = list(movies.attrs.get("further", ()))
    rows = []
    for row in movies.to_dict("records"):
        failed = row["state"] != "done"
        text = row["why"] if failed else row["cautions"]
        rows.append(
            [
                links[row["movie"]],
                row["role"],
                unbroken(row["sample"]),
                *(plain(row[name]) for name in further),
                {"done": "done", "failed": "failed", "missing": "not yet"}[row["state"]],
                text or "none",
                plain(row["answer"]),
                whole(row["events"]),
                share(row["ok"], row["events"]),
                fixed(row["noise_over_shot"], 2),
                fixed(row["drift_px"], 2),
                fixed(row["focus_shift_nm"], 0),
                percent(row["small_p_values"]),
                fixed(row["repeat_over_crb"], 2),
                row["standards_seen"] or "—",
                unbroken(row["optics"] or "—", 80),
                unbroken(row["mass_scale"] or "—", 80),
                percent(row["outside_standards"]),
            ]
        )
    columns = [
        "movie",
        "role",
        "sample",
        *further,
        "state",
        "cautions",
        "answer",
        {"label": "events", "numeric": True},
        {"label": "ok", "numeric": True, "title": "events with status ok"},
        {"label": "noise", "numeric": True, "title": "variance over shot noise, in its windows"},
        {"label": "drift [px]", "numeric": True, "title": "of the fixed pattern"},
        {"label": "focus [nm]", "numeric": True, "title": "from the day's, where it was measured"},
        {"label": "p < 0.01", "numeric": True, "title": "1 % where the model holds"},
        {"label": "spread/CRB", "numeric": True, "title": "measured between parts of the frames"},
        "standards",
        "optics",
        "mass scale",
        {"label": "beyond", "numeric": True, "title": "masses beyond the standards"},
    ]
    table = {"columns": columns, "rows": rows, "tall": len(rows) > LONG}
    return {"id": "quality", "title": "Movies and their quality", "tables": [table]}


def _links(movies: pd.DataFrame) -> list[tuple[str, Any]]:
    """Make every movie's name a link to its report, where there is one."""
    pages = zip(movies["movie"], movies["report"], strict=True)
    return [(name, link(report, name)) for name, report in pages]


def summary_line(movies: pd.DataFrame) -> str:
    """Describe the batch in one line."""
    return f"{count(len(movies), 'movie')} of {count(movies['sample'].nunique(), 'sample')}"
