"""The report page of one analysis, and its figures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from itertools import chain
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import Markup, escape

from iscat_analysis.findings import Severity
from iscat_analysis.records import (
    EVENTS,
    PARAMETERS,
    TRACKS,
    Analysis,
    EventView,
    FloatArray,
    Status,
    free_parameters,
    tally,
)
from iscat_analysis.report.answer import (
    CONTRAST,
    EVENTS_KIND,
    TRACKS_KIND,
    Precision,
    RowKind,
    answers,
    as_contrasts,
    caution,
    headline,
    is_uncalibrated,
    label_of,
    main_parameter,
    main_quantity,
    not_a_mass,
    precision_of,
    row_kind,
    species_widths,
    track_lines,
    tracks_of,
)
from iscat_analysis.report.event_figures import (
    corner_figures,
    event_details,
    event_figures,
    films_shown,
)
from iscat_analysis.report.figures import page_figures
from iscat_analysis.report.numbers import (
    LABELS,
    UNITS,
    Fact,
    Table,
    decimals_for,
    fixed,
    number,
    numeric,
    of,
    percent,
    tabulate,
    with_interval,
    worded,
)
from iscat_analysis.report.page import Section, render_page
from iscat_analysis.report.species import (
    distribution_section,
    sizes_figure,
    sizes_section,
    species_figure,
)
from iscat_analysis.report.style import Sketch, drawn, publish
from iscat_analysis.report.tables import event_table
from iscat_analysis.schemas import jsonable
from iscat_analysis.units import count

_MODES = {
    "mass": "position and mass, height fixed",
    "localize": "position in three dimensions, mass fixed",
    "joint": "position in three dimensions and mass",
    "size": "position in three dimensions and diameter of a sphere",
    "track": "position and mass in every frame, linked into tracks",
}
_SIGNS = {
    "mass_kda": "Negative masses are particles that leave.",
    "contrast": "Dark particles that land, and bright ones that leave, have negative contrast.",
}
_DECIMALS = {
    **dict.fromkeys(("chi2_reduced", "p_value", "exponent", "p_confinement", "p_anomalous"), 2),
    **dict.fromkeys(("p_steady", "mass_scatter"), 2),
    **dict.fromkeys(("n_frames", "x_nm", "y_nm"), 0),
}
"""Decimals of columns whose numbers do not say themselves how many they need."""

_REMARKS = {
    "crosses": "A remark that makes no verdict: it came near another track, where numbers may be "
    "exchanged."
}


# ---- The whole page ------------------------------------------------------------------------------


def render_report(analysis: Analysis, *, folder: Path | None = None) -> str:
    """Make the report page of one analysis, and write its figures."""
    table = event_table(analysis)
    about = page_context(analysis, table, folder)
    return page_of(about, publish(drawn(page_sketches(analysis, table)), folder))


def publish_figures(analysis: Analysis, folder: Path, most: int) -> dict[str, Markup]:
    """Write the figures of a folder, images of `most` events at most."""
    sketches = chain(page_sketches(analysis, event_table(analysis)), event_figures(analysis, most))
    return publish(drawn(sketches), folder)


def page_sketches(analysis: Analysis, table: pd.DataFrame) -> Iterator[Sketch]:
    """List the figures of the page, with the functions that draw them."""
    yield from page_figures(analysis, table)
    if (found := _described(analysis, table, "distribution")) is not None:
        yield "species", partial(species_figure, found)
    if (sizes := _described(analysis, table, "sizes")) is not None:
        yield "sizes", partial(sizes_figure, sizes)
    yield from corner_figures(analysis)


def page_of(about: Mapping[str, Any], figures: Mapping[str, Markup]) -> str:
    """Combine text and figures."""
    shown = {
        "figures": figures,
        "histogram": next((name for name in figures if name.endswith("_histogram")), None),
        "corners": [name for name in figures if name.startswith("corner_")],
        "species": about["species"] and about["species"](figures),
    }
    return render_page("report.html", {**about, **shown})


def _described(analysis: Analysis, table: pd.DataFrame, name: str) -> dict[str, Any] | None:
    """Give what ``summary.json`` holds of species or sizes, where the rows are a fair sample.

    Single frames of a track may be flagged as much as they like.
    """
    tracked = name == "sizes" and analysis.tracks is not None
    found = analysis.summary.get(name) if tracked or caution(table) is None else None
    described = jsonable(found) if found else None
    return described if described and described.get("species", True) else None


def _species(
    analysis: Analysis, table: pd.DataFrame
) -> tuple[str, Callable[[Mapping[str, Markup]], Section | None]] | None:
    """Give the title of the section of species, or of sizes, and what makes it of the figures."""
    if (sizes := _described(analysis, table, "sizes")) is not None:
        return "Sizes", partial(sizes_section, sizes)
    if (found := _described(analysis, table, "distribution")) is None:
        return None

    def section(figures: Mapping[str, Markup]) -> Section | None:
        made = distribution_section(found, figures)
        if made is None or not is_uncalibrated(analysis):
            return made
        return replace(made, lead=f"On the model's own scale, which is not a mass. {made.lead}")

    return "Species", section


def page_context(
    analysis: Analysis, table: pd.DataFrame, folder: Path | None = None
) -> dict[str, Any]:
    """Collect everything that ``report.html`` shows except figures."""
    kind, source = row_kind(analysis), analysis.provenance.input_path
    rows, facts, cells = _SHOWN[kind](analysis, table)
    images = event_details(analysis, rows)
    sampled = [view for view in analysis.views if view.posterior is not None]
    started, title = _when(analysis.provenance.started), analysis.scheme_kind.title
    title = title.capitalize() if title.islower() else title
    cautions, lines = not_a_mass(analysis), headline(analysis, table)
    free = free_parameters(analysis.mode, table)
    precision = [precision_of(analysis, table, name) for name in free]
    kept = f"images of the first {len(images)} of {len(rows)} rows"
    left_out = (
        f"To keep this page small it holds the {kept}." if 0 < len(images) < len(rows) else ""
    )
    ranks = list(Severity)
    findings = sorted(analysis.findings, key=lambda f: -ranks.index(f.severity))
    species = _species(analysis, table)
    context: dict[str, Any] = {
        "title": PurePath(source.replace("\\", "/")).name or "Analysis",
        "subtitle": f"{title}, mode {analysis.mode}: {_MODES[analysis.mode]}. {started}".rstrip(),
        "footer": "iscat-analysis "
        f"{analysis.provenance.versions.get('iscat-analysis', '')}, {started}".rstrip(", "),
        "tracked": kind is TRACKS_KIND,
        "n_events": len(rows),
        "cautions": [line for line in lines if line in cautions],
        "headline": [line for line in lines if line not in cautions],
        "flagged": bool(len(rows)) and caution(rows, kind) is not None,
        "tiles": facts,
        "totals": f"{tally(rows).text(kind.noun)}.",
        "precision": _precision_table(analysis, precision),
        "has_holevo": any(math.isfinite(p.holevo) for p in precision),
        "budget": _budget_table(analysis),
        "spread_lines": species_widths(analysis.summary),
        "warnings": [f.text for f in findings if f.severity is not Severity.NOTE],
        "notes": [f.text for f in findings if f.severity is Severity.NOTE],
        "main_label": main_quantity(analysis).label.capitalize(),
        "signs": _SIGNS.get(main_quantity(analysis).column),
        "events": _openable(kind, rows, cells),
        "has_traces": any(detail.trace for detail in images.values()),
        "images": {str(row): list(packed) for row, packed in images.items()},
        "embedding_note": left_out,
        "films": list(films_shown(analysis, folder)),
        "track_lines": list(track_lines(analysis.summary)),
        "posterior": _posterior_table(sampled, table),
        "refused": _refused_table(sampled),
        "verdicts": _verdicts(analysis, table),
        "measured": list(measured_lines(analysis.summary)),
        "config": analysis.config_toml,
        "provenance": _provenance(analysis),
        "species": species and species[1],
    }
    parts = (
        ("summary", "Summary", True),
        ("distributions", "Distributions" if len(table) else "Field", True),
        ("films", "Films", context["films"]),
        ("species", species and species[0], species),
        ("precision", "Precision", len(table)),
        ("budget", "Budget", context["budget"].rows and len(table)),
        ("events", f"{kind.noun.capitalize()}s", len(rows)),
        ("posterior", "Posterior", context["posterior"].rows or context["refused"].rows),
        ("diagnostics", "Diagnostics", True),
        ("configuration", "Configuration", True),
        ("provenance", "Provenance", True),
    )
    return {**context, "nav": [(name, title) for name, title, shown in parts if shown]}


def _provenance(analysis: Analysis) -> list[tuple[str, Any]]:
    about = analysis.provenance
    return [
        ("Command", about.command),
        ("Input", about.input_path),
        ("SHA-256 of the input", about.input_sha256),
        ("Seed", "none" if about.seed is None else about.seed),
        ("Started", about.started),
        *((name, str(version)) for name, version in about.versions.items()),
    ]


def _when(started: str) -> str:
    """Format an ISO time; other text stays as it is."""
    try:
        moment = datetime.fromisoformat(started)
    except ValueError:
        return started
    zone = f" {moment.tzname()}" if moment.tzinfo else ""
    return f"{moment.day} {moment:%B %Y, %H:%M}{zone}"


# ---- Large numbers -------------------------------------------------------------------------------


def _facts(analysis: Analysis, table: pd.DataFrame) -> list[Fact]:
    """Make the large numbers at the top: counts and precision."""
    rows, found = tally(table), answers(analysis, table)
    facts = [Fact("Events", str(rows.number), note=f"{rows.ok} ok, {rows.flagged} flagged"), *found]
    if not found:
        return facts
    heights = analysis.summary.get("heights")
    if heights is not None and not heights["held"]:
        mean, error, spread = (fixed(heights[f"{key}_nm"], 1) for key in ("mean", "mean_se", "sd"))
        note = f"mean, to ± {error}, and standard deviation"
        facts.append(Fact("Heights", f"{mean} ± {spread}", "nm", note))
    name = main_parameter(analysis)
    if not (p := precision_of(analysis, table, name)).events:
        return facts
    label, unit = LABELS[name], UNITS[name]
    best, bound = p.best
    sigma = f"σ {number(p.sigma)}{p.shared}, CRB {number(p.crb)} {unit}"
    beside = f", {best} {number(bound)} {unit}"
    if is_uncalibrated(analysis):
        label, sigma, beside = "contrast", "median of the events' own ratios", ""
    over = Fact(f"σ of {label} over its CRB", number(p.over_crb), "×", sigma)
    if p.is_measured:
        low, high = (fixed(end, 2) for end in p.measured_ci95)
        note = f"95 % {low} to {high}; {sigma}"
        over = Fact(f"Measured spread of {label} over its CRB", fixed(p.measured, 2), "×", note)
    used = percent(p.information)
    information = Fact(f"Information on {label} used", used, note=f"({best} / CRB)²{beside}")
    return [*facts, over, information]


def _track_facts(analysis: Analysis, fits: pd.DataFrame) -> list[Fact]:
    rows = tally(tracks_of(analysis))
    note = f"{rows.ok} ok, {rows.flagged} flagged; {len(fits)} fitted positions"
    found = answers(analysis, fits)
    over = (replace(answer, note="over tracks that are ok") for answer in found)
    return [Fact("Tracks", str(rows.number), note=note), *over]


# ---- Tables --------------------------------------------------------------------------------------


def _precision_table(analysis: Analysis, precision: Sequence[Precision]) -> Table:
    kind = row_kind(analysis)
    where = (
        "of single frames where there is no particle"
        if analysis.mode_kind.follows_tracks
        else "from parts of the events' own frames, and at full length where there is no particle"
    )
    has_holevo = any(math.isfinite(p.holevo) for p in precision)
    columns = [
        worded("Medians", lambda p: f"{label_of(analysis, p['name'])} [{UNITS[p['name']]}]"),
        numeric("σ", of("sigma"), "from the curvature of the likelihood at its maximum"),
        numeric(
            "common",
            of("systematic"),
            "error that all events of the movie share, from calibrations; not part of σ, and not "
            "lessened by averaging",
        ),
        numeric(
            "CRB",
            of("crb"),
            "classical Cramér–Rao bound: the best any unbiased estimator can do with these images",
        ),
        numeric(
            "Holevo",
            of("holevo"),
            "the best that one measurement of the collected light can do for all free parameters "
            "at once",
        ),
        numeric(
            "QCRB",
            of("qcrb"),
            "quantum Cramér–Rao bound: the best any measurement can do with the collected light",
        ),
        numeric("σ / CRB", of("over_crb"), "median of the rows' ratios; near 1 by construction"),
        numeric(
            "measured / CRB",
            "measured_text",
            f"measured spread over the bound, with its 95 % interval: {where}",
        ),
        numeric(
            "light used",
            of("information", percent),
            f"({'Holevo' if has_holevo else 'QCRB'} / CRB) squared: the share that the images "
            "carry of what can be had of the light's information",
        ),
        numeric(kind.unit, "events"),
    ]
    known = {
        "common": any(math.isfinite(p.systematic) for p in precision),
        "Holevo": has_holevo,
        "measured / CRB": any(p.is_measured for p in precision),
    }
    columns = [column for column in columns if known.get(column.label, True)]
    rows = [
        {**vars(p), "measured_text": p.measured_text if p.is_measured else None} for p in precision
    ]
    caption = f"{kind.fits} whose status is ok; units in the first column"
    return replace(tabulate(rows, columns, caption), sortable=False)


def _budget_table(analysis: Analysis) -> Table:
    """Tabulate what the error of a mass is made of, and last what is common to all rows."""
    budget = list(analysis.summary.get("budget", ()))
    shared = [one for one in budget if one["sigma_rel"] and one["common"]]
    if len(shared) > 1:
        sigma, share = (
            math.hypot(*(one[key] for one in shared)) for key in ("sigma_mass_kda", "sigma_rel")
        )
        whole = {"name": "all that is shared", "kind": "", "common": True, "dof": None}
        budget.append({**whole, "sigma_mass_kda": sigma, "sigma_rel": share, "remedy": ""})

    def rows(common: bool) -> str:
        return "all rows" if common else ""

    def freedom(dof: float | None) -> str:
        return "" if dof is None else f"{dof:.0f}"

    columns = [
        worded("source", "name"),
        worded("known by", "kind", "measured, learned from pictures, or assumed"),
        worded("shared", of("common", rows), "shared by all rows: averaging does not lessen it"),
        numeric("σ [kDa]", of("sigma_mass_kda"), "median over the rows that are ok"),
        numeric("of the mass", of("sigma_rel", percent)),
        numeric("degrees of freedom", of("dof", freedom)),
        worded("what shrinks it", "remedy"),
    ]
    made = tabulate(budget, columns, "Medians over the rows whose status is ok")
    return replace(made, sortable=False)


def _posterior_table(views: Sequence[EventView], table: pd.DataFrame) -> Table:
    """Tabulate the chains that converged, one row for each parameter."""
    rows = []
    for view in views:
        chains = view.posterior
        if chains is None or not chains.converged:
            continue
        fit = table[table["event"] == view.event].iloc[0]
        bounds = chains.van_trees if chains.van_trees is not None else [None] * len(chains.names)
        for k, name in enumerate(chains.names):
            samples = chains.samples[..., k]
            low, median, high = np.quantile(samples, [0.15865, 0.5, 0.84135])
            middle, ends = with_interval(median, low, high)
            sigma = number(fit[f"sigma_{name}"], 2)
            rows.append(
                {
                    "event": str(view.event),
                    "parameter": f"{name.split('_')[0]} [{UNITS[name]}]",
                    "median": middle,
                    "central 68 %": ends,
                    "fit ± σ": f"{fixed(fit[name], decimals_for([(high - low) / 2]))} ± {sigma}",
                    "R̂": number(chains.r_hat[k], 4),
                    "ESS": number(chains.ess_bulk[k]),
                    "spread": number(float(np.std(samples))),
                    "van Trees": number(bounds[k]),
                }
            )
    columns = [numeric(label, label) for label in rows[0]] if rows else []
    return tabulate(rows, columns, "Chains that converged; posterior.nc holds them all")


def _refused_table(views: Sequence[EventView]) -> Table:
    refused = [
        (str(view.event), view.posterior.message)
        for view in views
        if view.posterior is not None and not view.posterior.converged
    ]
    return tabulate(refused, (numeric("event", 0), worded("why", 1)))


def _verdicts(analysis: Analysis, table: pd.DataFrame) -> list[Table]:
    """Count the verdicts and remarks on tracks, and on events or fitted positions."""
    judged = [(EVENTS_KIND, table, "rows", "Verdicts")]
    if analysis.tracks is not None:
        judged = [
            (TRACKS_KIND, analysis.tracks, "tracks", "Verdicts on tracks"),
            (EVENTS_KIND, table, "positions", "Verdicts on fitted positions"),
        ]
    return [_verdict_table(*each) for each in judged if len(each[1])]


def _verdict_table(kind: RowKind, rows: pd.DataFrame, counted: str, caption: str) -> Table:
    """Count verdicts and other flags, with what each means."""
    counts = tally(rows).status | tally(rows).left_out
    found = [(s.value, str(counts[s.value]), s.advice) for s in kind.status if s.value in counts]
    flags = rows["flags"].astype(str).str.split(";").explode()
    remarks = flags[~flags.isin([*kind.status, ""])].value_counts()
    plain = "A remark that makes no verdict."
    found += [(str(flag), str(n), _REMARKS.get(str(flag), plain)) for flag, n in remarks.items()]
    meaning = "what it means, and what to try"
    columns = (worded("status or flag", 0), numeric(counted, 1), worded(meaning, 2))
    return tabulate(found, columns, caption)


# ---- The table whose rows open -------------------------------------------------------------------


def _events_shown(analysis: Analysis, table: pd.DataFrame) -> Shown:
    """Give the events, their facts and the columns of their table."""
    shown = []
    for name, heading in _headings(analysis):
        if name in table:
            scale = 1e3 if name == "contrast" else 1.0
            values = scale * table[name].to_numpy(float)
            shown.append((heading, _cells(name, values, values, 3)))
    return table, _facts(analysis, table), shown


def _headings(analysis: Analysis) -> Iterator[tuple[str, str]]:
    """Name the columns of the table of events: place, each fitted quantity with its errors, fit."""
    headed = [column for column in EVENTS if column.heading]
    fitted = [name for name in ("z_nm", "mass_kda") if name in analysis.mode_kind.free]
    own = [column for column in headed if column.name.endswith(PARAMETERS)]
    rest = [column for column in headed if column not in own]
    last = rest.index(next(column for column in rest if column.name == "contrast")) + 1
    yield from ((column.name, column.heading) for column in rest[:last])
    for name in fitted:
        yield name, f"{label_of(analysis, name)} [{UNITS[name]}]"
        errors = [column for column in own if column.name.endswith(f"_{name}")]
        for column in sorted(errors, key=lambda column: "crb_" in column.name):
            yield column.name, f"{column.heading} [{column.unit}]"
    yield from ((column.name, column.heading) for column in rest[last:])


def _tracks_shown(analysis: Analysis, table: pd.DataFrame) -> Shown:
    """Give the tracks, their facts and the columns of their table."""
    tracks = tracks_of(analysis)
    names = {column.name: column.heading for column in TRACKS if column.heading}
    scale = 1.0
    if main_quantity(analysis) is CONTRAST:
        tracks, scale = as_contrasts(tracks) if len(tracks) else tracks, 1e3
        for name in (name for name in names if name.endswith("mass_kda")):
            names[name] = names[name].replace("mass", "contrast").replace("kDa", "10⁻³")
    elif is_uncalibrated(analysis):
        names["mass_kda"] = "mass, model scale [kDa]"
    shown = []
    for name, heading in names.items():
        if name in tracks:
            factor = scale if name.endswith("mass_kda") else 1.0
            error = tracks.get(f"sigma_{name}")
            digits = 3 if error is None and not name.startswith("sigma") else 2
            columns = (tracks[name], tracks[name] if error is None else error)
            values, spread = (factor * column.to_numpy(float) for column in columns)
            shown.append((heading, _cells(name, values, spread, digits)))
    numbered = tracks_of(analysis).rename(columns={"track": "event"})
    return numbered, _track_facts(analysis, table), shown


Shown = tuple[pd.DataFrame, list[Fact], list[tuple[str, list[str]]]]
_SHOWN: Mapping[RowKind, Callable[[Analysis, pd.DataFrame], Shown]] = {
    EVENTS_KIND: _events_shown,
    TRACKS_KIND: _tracks_shown,
}


def _cells(name: str, values: FloatArray, spread: FloatArray, digits: int) -> list[str]:
    """Write a column with so many digits of the median of `spread`; nothing if it is empty."""
    if not np.isfinite(values).any():
        return []
    decimals = _DECIMALS.get(name)
    if decimals is None:
        decimals = decimals_for([float(np.nanmedian(np.abs(spread)))], digits=digits)
    return [fixed(value, decimals) for value in values]


def _openable(
    kind: RowKind, table: pd.DataFrame, shown: Sequence[tuple[str, list[str]]]
) -> dict[str, Any]:
    """Write the rows of a table that a page opens; a column without numbers is left out."""
    columns = [(heading, cells) for heading, cells in shown if cells]
    lines = []
    for row in range(len(table)):
        status = kind.status(table["status"].iloc[row])
        flags = [f for f in str(table["flags"].iloc[row]).split(";") if f and f != status]
        mark = "status" if status == Status.OK.value else "status flagged"
        numbers = "".join(f'<td class="num">{cells[row]}' for _, cells in columns)
        lines.append(
            f'<tr id="row-{row}"><td><button type="button" class="toggle" aria-expanded="false">'
            f'{table["event"].iloc[row]}</button><td class="num">{table[kind.begins].iloc[row]}'
            f'{numbers}<td class="{mark}" title="{escape(status.advice)}">'
            f"{escape('; '.join([status.value, *flags]))}"
        )
    return {
        "columns": [kind.noun, kind.heading, *(heading for heading, _ in columns), "status"],
        "body": Markup("\n".join(lines)),  # the only text, the flags, is escaped
    }


# ---- Sentences -----------------------------------------------------------------------------------


def measured_lines(summary: Mapping[str, Any]) -> Iterator[str]:
    """Describe windows, drift and injected particles in sentences."""
    background, landing = summary.get("background"), summary.get("landing")
    if background and background["drift_px"] is not None:
        (y, x), (y_se, x_se) = background["drift_px"], background["drift_error_px"]
        yield (
            "Drift of the fixed pattern from the background to the frames after it: "
            f"{fixed(x, 4)} ± {fixed(x_se, 4)} px in x, {fixed(y, 4)} ± {fixed(y_se, 4)} px in y."
        )
    if landing:
        yield (
            f"Windows of {count(landing['window_frames'], 'frame')}; "
            f"{count(landing['frames_left_out'], 'frame')} left out."
        )
        if landing.get("searched_share") is not None:
            yield (
                f"{percent(landing['searched_share'])} of field and time were searched for "
                f"particles with a signal-to-noise ratio of {number(landing['searched_snr'])}."
            )
        if landing["drift_px"] is not None:
            y, x = landing["drift_px"]
            yield f"Drift of the fixed pattern: {fixed(x, 3)} px in x, {fixed(y, 3)} px in y."
    injection = summary.get("injection")
    if injection and injection["added"]:
        yield _injection_line(injection)


def _injection_line(injection: Mapping[str, Any]) -> str:
    """Say how many particles that were added to the movie were found again, and how well."""
    line = (
        f"Of {injection['added']} landings and leavings added to the movie, "
        f"{injection['recovered']} were found again."
    )
    if injection.get("predicted") is not None:
        share, best = (fixed(100 * injection[key], 0) for key in ("recall", "predicted"))
        line += (
            f" That is {share} %; where each is alone, the Fisher information predicts {best} %."
        )
    if injection.get("stay_frames"):
        line += f" Every particle stayed at least {injection['stay_frames']} frames."
    if injection.get("bias_rel") is None:
        return line + (
            " Too few are isolated to say how far their masses are off: add fewer to a movie as "
            "short as this one."
        )
    bias, error = (fixed(100 * injection[key], 1) for key in ("bias_rel", "bias_rel_se"))
    spread, doubt = (fixed(injection[f"spread_over_crb{end}"], 2) for end in ("", "_se"))
    return line + (
        f" The masses of isolated ones are off by {bias} ± {error} %, and their spread is {spread} "
        f"± {doubt} times the bound."
    )
