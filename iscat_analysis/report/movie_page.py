"""The result page of one analysis: the answer first, and below it what it rests on.

The first screen says what is in the sample and whether to believe it, in numbers; everything else
is unfolded.  The page draws its figures itself from `movie_figures`, and particles that are
selected in one figure are marked in all.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import PurePath
from textwrap import shorten
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.findings import Finding, Severity, Subject, worst_first
from iscat_analysis.findings.results import INTERRUPTED, NOT_A_MASS, NOTHING_FOUND
from iscat_analysis.records import (
    EVENTS,
    PARAMETERS,
    POOR_P,
    TRACKS,
    Analysis,
    EventView,
    FloatArray,
    tally,
)
from iscat_analysis.report.answer import (
    EVENTS_KIND,
    TRACKS_KIND,
    RowKind,
    answers,
    caution,
    is_uncalibrated,
    main_parameter,
    precision_of,
    rejection,
    species_widths,
    track_lines,
    tracks_of,
)
from iscat_analysis.report.movie_figures import COLOURS, Sample, figures_of
from iscat_analysis.report.numbers import (
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
from iscat_analysis.report.page import render_page
from iscat_analysis.report.pictures import event_details, films_shown
from iscat_analysis.report.vega import VegaFigure, figure, payload
from iscat_analysis.units import count

_MODES = {
    "mass": "position and mass, height fixed",
    "localize": "position in three dimensions, mass fixed",
    "joint": "position in three dimensions and mass",
    "size": "position in three dimensions and diameter of a sphere",
    "track": "position and mass in every frame, linked into tracks",
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


REMEDY_LETTERS = 130
"""Longest remedy on the first screen; the whole sentence stands among the findings."""
MUCH_NOISE = 0.2
"""Share by which the variance may differ from the light's before it is doubted."""


# ---- The whole page ------------------------------------------------------------------------------


def render_report(analysis: Analysis) -> str:
    """Make the result page of one analysis, with everything that it shows inside."""
    sample = Sample(analysis)
    return render_page("report.html", page_context(sample, dict(figures_of(sample))))


def page_context(sample: Sample, figures: Mapping[str, VegaFigure]) -> dict[str, Any]:
    """Collect everything that ``report.html`` shows."""
    analysis, kind, findings = sample.analysis, sample.kind, _all_findings(sample)
    sampled = [view for view in analysis.views if view.posterior is not None]
    images = event_details(analysis, sample.rows)
    columns = _columns(sample)
    holds = {
        **payload(figures),
        "trace": figure("trace", {}).specification,
        "table": columns,
        "images": images,
        "kind": kind.noun,
        "movie": _movie_name(analysis),
        "quantity": sample.quantity.label.strip("|"),
        "unit": sample.quantity.unit,
        "rows": len(sample.rows),
    }
    left_out = f"images of the first {len(images)} of {len(sample.rows)} are in this page"
    return {
        "title": _movie_name(analysis) or "Analysis",
        "meta": _meta(analysis),
        "footer": f"iscat-analysis {analysis.provenance.versions.get('iscat-analysis', '')}",
        "answer_title": sample.quantity.label.capitalize() if len(sample.rows) else "Nothing found",
        "answer_axis": sample.quantity.axis,
        "counts": f"{count(len(sample.rows), kind.noun)}, {int(sample.is_ok.sum())} ok",
        "species": _species_table(sample),
        "facts": [] if sample.species else _facts(sample),
        "trust": trust(sample, findings),
        "findings": findings,
        "figures": figures,
        "noun": kind.noun,
        "tables": ["fits", "tracks"] if kind is TRACKS_KIND else ["fits"],
        "rows": len(sample.rows),
        "headings": [column["heading"] for column in columns],
        "embedding": left_out if 0 < len(images) < len(sample.rows) else "",
        "payload": holds,
        "films": list(films_shown(analysis)),
        "precision": _precision_table(sample),
        "budget": _budget_table(sample),
        "spread_lines": species_widths(analysis.summary),
        "lines": [*track_lines(analysis.summary), *measured_lines(analysis.summary)],
        "posterior": _posterior_table(sampled, sample.fits),
        "refused": _refused_table(sampled),
        "corners": [name for name in figures if name.startswith("corner_")],
        "verdicts": _verdicts(analysis, sample.fits),
        "notes": _species_notes(sample),
        "config": analysis.config_toml,
        "provenance": _provenance(analysis),
    }


def _movie_name(analysis: Analysis) -> str:
    return PurePath(analysis.provenance.input_path.replace("\\", "/")).name


def _meta(analysis: Analysis) -> str:
    """Say what was analysed: frames, seconds, microscope and mode."""
    shape = (analysis.summary.get("input") or {}).get("shape")
    parts = []
    if shape is not None:
        rate = (analysis.summary.get("motion") or {}).get("frame_rate_hz")
        parts.append(f"{count(shape[0], 'frame')} of {shape[2]} × {shape[1]} pixels")
        parts += [f"{number(shape[0] / rate)} s"] if rate else []
    title = analysis.scheme_kind.title
    parts += [title, f"mode {analysis.mode}: {_MODES[analysis.mode]}"]
    return " · ".join([*parts, *filter(None, [_when(analysis.provenance.started)])])


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


# ---- The answer ----------------------------------------------------------------------------------


def _species_table(sample: Sample) -> list[dict[str, Any]]:
    """Tabulate the species, each number beside its error or interval."""
    rows = []
    for k, each in enumerate(sample.species):
        digits = decimals_for([each.sigma])
        width = fixed(each.width, digits)
        rows.append(
            {
                "colour": COLOURS[k % len(COLOURS)],
                "value": fixed(each.value, digits),
                "se": fixed(each.sigma, digits),
                "shared": fixed(each.systematic, digits) if each.systematic > 0 else "",
                "width": width if width.strip("0.") else "",
                "count": fixed(each.count, 0),
                "counts": "–".join(fixed(end, 0) for end in (each.count_low, each.count_high)),
                "share": percent(each.share, 0),
                "shares": "–".join(fixed(100 * e, 0) for e in (each.share_low, each.share_high)),
                "landing": fixed(each.landing, 0),
                "leaving": fixed(each.leaving, 0),
            }
        )
    return rows


def _species_notes(sample: Sample) -> list[str]:
    found = sample.described("sizes") or sample.described("distribution") or {}
    return list(found.get("notes", ()))


def _facts(sample: Sample) -> list[Fact]:
    """Give the answer where there are no species: a single value, a range, or a height."""
    analysis = sample.analysis
    facts = list(answers(analysis, sample.counted))
    heights = analysis.summary.get("heights")
    if facts and heights is not None and not heights["held"]:
        mean, error, spread = (fixed(heights[f"{key}_nm"], 1) for key in ("mean", "mean_se", "sd"))
        note = f"mean, to ± {error}, and standard deviation"
        facts.append(Fact("Heights", f"{mean} ± {spread}", "nm", note))
    return facts


# ---- Whether to believe it -----------------------------------------------------------------------


@dataclass(frozen=True)
class Trust:
    """One line of the first screen: whether one subject is as it should be."""

    subject: Subject
    severity: Severity
    text: str
    remedy: str = ""
    more: int = 0
    target: str = "findings"

    @property
    def grade(self) -> str:
        """Class of its colour."""
        return {Severity.NOTE: "good", Severity.CAUTION: "warn", Severity.FAULT: "bad"}[
            self.severity
        ]


def _all_findings(sample: Sample) -> list[Finding]:
    """List all findings, the most severe first; those of the table of results are among them."""
    analysis, table = sample.analysis, sample.counted
    judged = table if sample.kind is EVENTS_KIND else tracks_of(analysis)
    found = list(analysis.findings)
    if analysis.summary.get("interrupted"):
        found.insert(0, INTERRUPTED())
    if table.empty:
        found.append(NOTHING_FOUND())
    else:
        own = (rejection(table), caution(judged, sample.kind) if len(judged) else None)
        found += [each for each in own if each is not None]
        found += [NOT_A_MASS()] if is_uncalibrated(analysis) else []
    return worst_first({finding.text: finding for finding in found}.values())


def trust(sample: Sample, found: Sequence[Finding]) -> list[Trust]:
    """Say of camera, optics, errors and scale whether to believe them, the worst first."""
    lines = []
    for subject, reassure in _REASSURING.items():
        doubts = [
            each
            for each in found
            if each.kind.subject is subject and each.severity is not Severity.NOTE
        ]
        if doubts:
            first = doubts[0]
            text, remedy = first.brief
            remedy = shorten(remedy, REMEDY_LETTERS, placeholder=" …")
            lines.append(Trust(subject, first.severity, text, remedy, len(doubts) - 1))
        elif (line := reassure(sample)) is not None:
            lines.append(line)
    return worst_first(lines)


def _camera(sample: Sample) -> Trust | None:
    summary = sample.analysis.summary
    found = summary.get("landing") or summary.get("background") or {}
    ratios = [ratio for ratio in found.get("noise_variance_over_shot", ()) if ratio is not None]
    text, severity = "Nothing is wrong with the camera's numbers", Severity.NOTE
    if ratios and abs(ratios[0] - 1) < MUCH_NOISE:
        text = f"The camera's noise is as expected: {fixed(ratios[0], 2)} × that of the light"
    elif ratios:
        text, severity = f"The noise is {number(ratios[0])} × that of the light", Severity.CAUTION
    return Trust(Subject.CAMERA, severity, text, target="diagnostics")


def _optics(sample: Sample) -> Trust | None:
    p_values = sample.counted["p_value"].dropna()
    if not p_values.size:
        return None
    good = int((p_values >= POOR_P).sum())
    text = f"The optics describe the particles: p ≥ {POOR_P:g} for {good} of {p_values.size} fits"
    return Trust(Subject.OPTICS, Severity.NOTE, text, target="diagnostics")


def _errors(sample: Sample) -> Trust | None:
    table = sample.counted
    p = precision_of(sample.analysis, table, main_parameter(sample.analysis))
    if p.is_measured:
        text = f"Errors are right: the measured spread is {p.measured_text} times the bound"
    elif p.events:
        text = "Errors follow from the noise; there are too few frames to measure them"
    else:
        return None
    return Trust(Subject.ERRORS, Severity.NOTE, text, target="precision")


def _scale(sample: Sample) -> Trust | None:
    budget = sample.analysis.summary.get("budget", ())
    shared = [one["sigma_rel"] for one in budget if one["common"] and one["sigma_rel"]]
    if not shared:
        return None
    worst = max((one for one in budget if one["common"]), key=lambda one: one["sigma_rel"] or 0)
    sized = sample.quantity.column.endswith("diameter_nm")
    known = math.hypot(*shared) / (3 if sized else 1)
    what = (
        "diameters"
        if sized
        else f"{sample.quantity.label}{'es' if sample.quantity.label.endswith('s') else 's'}"
    )
    text = f"The scale of {what} is known to ± {percent(known)}"
    remedy = f"Most of it: {worst['name']}"
    return Trust(Subject.SCALE, Severity.NOTE, text, remedy, target="budget")


_REASSURING = {
    Subject.CAMERA: _camera,
    Subject.OPTICS: _optics,
    Subject.ERRORS: _errors,
    Subject.SCALE: _scale,
}
"""What is said of each subject where there is no doubt."""


# ---- The table of particles ----------------------------------------------------------------------


def _columns(sample: Sample) -> list[dict[str, Any]]:
    """Write the columns of the table of particles; one without numbers is left out."""
    kind, rows = sample.kind, sample.rows
    columns: list[dict[str, Any]] = [
        {"heading": kind.noun, "of": "event"},
        {"heading": kind.heading, "of": "frame"},
    ]
    columns += [{"heading": heading, "cells": cells} for heading, cells in _shown(sample) if cells]
    advice, cells = {}, []
    for status, flags in zip(rows["status"], rows["flags"], strict=True):
        verdict = kind.status(status)
        advice[verdict.value] = verdict.advice
        others = [flag for flag in str(flags).split(";") if flag and flag != verdict]
        cells.append("; ".join([verdict.value, *others]))
    return [*columns, {"heading": "status", "cells": cells, "advice": advice}]


def _shown(sample: Sample) -> Iterator[tuple[str, list[str]]]:
    """Write the columns of the table, masses on the scale of the main quantity."""
    table = sample.scaled(sample.rows)
    for name, heading in _headings(sample):
        if name in table:
            factor = 1e3 if name == "contrast" else 1.0
            values = factor * table[name].to_numpy(float)
            error = table.get(f"sigma_{name}") if sample.kind is TRACKS_KIND else None
            spread = values if error is None else error.to_numpy(float)
            digits = 3 if error is None and not name.startswith("sigma") else 2
            yield heading, _cells(name, values, spread, digits)


def _headings(sample: Sample) -> Iterator[tuple[str, str]]:
    """Name the columns of the table: place, each fitted quantity with its errors, fit."""
    if sample.kind is TRACKS_KIND:
        unit = sample.unit("mass_kda")
        for column in (column for column in TRACKS if column.heading):
            name = column.heading
            if column.name.endswith("mass_kda"):
                name = name.replace("mass", sample.label("mass_kda")).replace("kDa", unit)
            yield column.name, name
        return
    headed = [column for column in EVENTS if column.heading]
    fitted = [name for name in ("z_nm", "mass_kda") if name in sample.analysis.mode_kind.free]
    own = [column for column in headed if column.name.endswith(PARAMETERS)]
    rest = [column for column in headed if column not in own]
    last = rest.index(next(column for column in rest if column.name == "contrast"))
    yield from ((column.name, column.heading) for column in rest[:last])
    if sample.label("mass_kda") != "contrast":
        yield rest[last].name, rest[last].heading
    for name in fitted:
        yield name, sample.parameter(name)
        errors = [column for column in own if column.name.endswith(f"_{name}")]
        for column in sorted(errors, key=lambda column: "crb_" in column.name):
            yield column.name, f"{column.heading} [{sample.unit(name)}]"
    yield from ((column.name, column.heading) for column in rest[last + 1 :])


def _cells(name: str, values: FloatArray, spread: FloatArray, digits: int) -> list[str]:
    """Write a column with so many digits of the median of `spread`; nothing if it is empty."""
    if not np.isfinite(values).any():
        return []
    decimals = _DECIMALS.get(name)
    if decimals is None:
        decimals = decimals_for([float(np.nanmedian(np.abs(spread)))], digits=digits)
    return [fixed(value, decimals) for value in values]


# ---- Tables --------------------------------------------------------------------------------------


def _precision_table(sample: Sample) -> Table:
    analysis, kind = sample.analysis, sample.kind
    precision = [sample.precision_of(name) for name in sample.free]
    where = (
        "of single frames where there is no particle"
        if analysis.mode_kind.follows_tracks
        else "from parts of the events' own frames, and at full length where there is no particle"
    )
    has_holevo = any(math.isfinite(p.holevo) for p in precision)
    columns = [
        worded("parameter", lambda p: sample.parameter(p["name"])),
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
    caption = f"Medians over the {kind.fits.lower()} whose status is ok"
    return replace(tabulate(rows, columns, caption), sortable=False)


def _budget_table(sample: Sample) -> Table:
    """Tabulate what the error of a mass is made of, and last what is common to all rows."""
    budget = list(sample.analysis.summary.get("budget", ()))
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
    if sample.unit("mass_kda") != UNITS["mass_kda"]:
        columns = [column for column in columns if column.label != "σ [kDa]"]
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
