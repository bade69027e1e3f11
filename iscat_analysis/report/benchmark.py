"""Pages of `iscat benchmark` and of challenges: estimators beside each other and the bounds.

Everything arrives as ``benchmark.json`` and ``challenge.json``; nothing is computed here but what
is shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from iscat_analysis.config import SCHEMES
from iscat_analysis.records import PARAMETERS
from iscat_analysis.report.numbers import (
    LABELS,
    UNITS,
    Fact,
    Table,
    bracketed,
    number,
    numeric,
    of,
    parameter,
    percent,
    tabulate,
    worded,
)
from iscat_analysis.report.page import (
    Chart,
    Row,
    Section,
    curves,
    heatmap,
    interval,
    intervals,
    marks,
    render_document,
)

ENOUGH_RANKS = 100
"""Posteriors below which the uniformity of their ranks is not tested: a p-value would mislead."""

MODES = ("mass", "size", "localize", "joint")

_TITLES = {
    "mass": "Mass: position and mass, height known",
    "size": "Size: position in three dimensions and diameter of a sphere",
    "localize": "Localize: position in three dimensions, mass or diameter known",
    "joint": "Joint: position in three dimensions and mass",
}
_BASELINES = {"gaussian": "Gaussian least squares", "peak": "peak contrast"}
_AXES = {
    "photons": ("collected scattered photons", "x"),
    "mass": ("mass [kDa]", "x"),
    "height": ("height [nm]", ""),
    "focus": ("focus [nm]", ""),
    "density": ("other particles per µm²", "x"),
    "wrong_focus": ("error of the focus that estimators are told [nm]", ""),
}

_UNRANKED = ("below the bound", "does not follow the particle")
"""How the verdicts begin of estimators that are not ranked."""

_HOW = (
    "Every estimator was given the same counts, and a start up to a pixel off. Efficiency is the "
    "squared Cramér–Rao bound (CRB) over the mean square error: 1 is the most that an unbiased "
    "estimator can reach on average. Spread is that about the line of error against truth; its "
    "slope is the gradient of the bias, and an estimator whose spread lies below the bound that "
    "belongs to its own bias knew more than the counts: it is flagged and not ranked.",
    "Information kept is efficiency times the share of particles that were answered, averaged over "
    "all parameters; one that an estimator does not give counts as 0.",
    "QCRB is the quantum bound of the collected light for each parameter alone, Holevo that of one "
    "measurement for all of them. Intervals are 95 %, by 1000 resamples of the trials, the same "
    "for all estimators.",
)
_MEASURED = (
    "Photoelectrons of the fitted region are drawn from the expected images with Poisson "
    "statistics and read noise, before and after landing, and fitted by the code that fits movies, "
    "from starts up to a pixel off, at any height of the range and with a mass up to half as large "
    "again. The spread is over fits that neither failed nor were flagged for an ambiguous height "
    "or diameter.",
    "The Cramér–Rao bound (CRB) holds for the same free parameters, frames, camera noise and "
    "measured background; the quantum bound (QCRB) for the collected scattered light and any "
    "measurement of it.",
    "Confidence intervals are 95 %. Gaussian least squares and peak contrast see the contrast "
    "image; their masses are calibrated on the noiseless particle itself.",
)


def _versions(document: Mapping[str, Any]) -> Table:
    columns = worded("package", 0), worded("version", 1)
    return tabulate(document["versions"].items(), columns, "Versions")


def _footer(document: Mapping[str, Any]) -> str:
    return f"iscat-analysis {document['versions']['iscat-analysis']}"


def _named(entry: Mapping[str, Any]) -> list[str]:
    """Name the parameters of a mode that have a score."""
    return [name for name in LABELS if name in entry]


def _interval(key: str) -> Callable[[Any], str]:
    """Make the cell of a statistic with its interval."""
    return lambda row: bracketed(row.get(key), row.get(f"{key}_ci95", ()))


def _bias(row: Any) -> str:
    """Write a bias with its standard error."""
    known = number(row.get("bias"))
    return known if known == "—" else f"{known} ± {number(row['bias_se'], 2)}"


# ---- A benchmark ---------------------------------------------------------------------------------


def render_benchmark(study: Mapping[str, Any]) -> str:
    """Make the page of a study."""
    code = f"{study['command']}\n\n{study['config']}"
    sections = [
        *(contest_sections(study) if "estimators" in study else ()),
        _summary(study),
        *(_mode_section(study, mode) for mode in MODES if mode in study),
        Section(
            "how", "How this was measured", notes=_MEASURED, tables=[_versions(study)], code=code
        ),
    ]
    subtitle = (
        f"{SCHEMES[study['scheme']].title}: {study['trials']} repetitions of one experiment in "
        f"each mode, seed {study['seed']}"
    )
    return render_document(
        "Estimators beside their bounds", subtitle, sections, frame={"footer": _footer(study)}
    )


def _summary(study: Mapping[str, Any]) -> Section:
    modes = [mode for mode in MODES if mode in study]
    facts = []
    for mode in modes:
        entry, names = study[mode], _named(study[mode])
        ratios = np.array([entry[name]["spread_over_crb"] for name in names], float)
        finite = ratios[np.isfinite(ratios)]
        named = ", ".join(LABELS[n] for n in names)
        note = f"over {named}; {entry['failed']} of {entry['trials']} fits failed"
        value = f"{finite.min():.2f}–{finite.max():.2f}" if finite.size else "—"
        facts.append(Fact(f"spread / CRB, {mode}", value, note=note))
    rows = [
        {"mode": mode, "name": name, **study[mode][name]}
        for mode in modes
        for name in _named(study[mode])
    ]

    def baseline(key: str) -> Callable[[Any], str]:
        return lambda row: number(row.get("baselines", {}).get(key, {}).get("rmse_over_crb"))

    columns = [
        worded("mode", "mode"),
        worded("parameter", of("name", parameter)),
        numeric("spread / CRB", _interval("spread_over_crb"), "with its 95 % confidence interval"),
        numeric("spread / QCRB", of("spread_over_qcrb")),
        *(numeric(f"{label} / CRB", baseline(key)) for key, label in _BASELINES.items()),
    ]
    lead = (
        "A ratio of 1 to the CRB means that no unbiased estimator can do better with these counts. "
        "The last columns show what other estimators make of the same counts: root-mean-square "
        "error over the CRB."
    )
    table = tabulate(rows, columns, "Every free parameter in every mode")
    return Section("summary", "Summary", lead, facts, tables=[table])


def _mode_section(study: Mapping[str, Any], mode: str) -> Section:
    entry, at = study[mode], study[mode]["at"]
    rows = [{"name": name, **entry[name]} for name in _named(entry)]
    flagged = [f"{n} {flag.replace('_', ' ')}" for flag, n in entry["flagged"].items() if n]
    diameter = at.get("diameter_nm")
    what = f"{at['mass_kda']:,.0f} kDa" if diameter is None else f"A sphere of {diameter:.4g} nm"
    lead = (
        f"{what} at z = {at['z_nm']:.3g} nm, focus at {at['focus_nm']:.0f} nm; "
        f"{at['n_scattered']['collected']:,.0f} scattered photons collected; "
        f"{at['pixels']} × {at['pixels']} pixels of {at['pixel_size_nm']:.4g} nm; "
        f"{at['n_before']} frames before and {at['n_after']} after landing. "
        f"{entry['fits_per_second']:.0f} fits per second of processor time; "
        f"flagged: {', '.join(flagged) or 'none'}."
    )

    def share(key: str) -> Callable[[Any], str]:
        def cell(row: Any) -> str:
            low, high = (percent(end, 1).removesuffix(" %") for end in row[f"{key}_ci95"])
            known = percent(row[key], 1)
            return known if known == "—" else f"{known} [{low}, {high}]"

        return cell

    achieved = [
        worded("parameter", of("name", parameter)),
        numeric("truth", lambda row: at[row["name"]]),
        numeric("bias", _bias),
        numeric("spread", _interval("spread")),
        numeric("CRB", of("crb")),
        numeric("QCRB", of("qcrb")),
        numeric("pull mean", of("pull_mean", number, 2)),
        numeric("pull σ", of("pull_std")),
    ]
    credible = "share of truths inside the credible interval"
    covered = [
        achieved[0],
        numeric("68 %", share("coverage68"), "share of truths within one stated σ"),
        numeric("95 %", share("coverage95"), "share of truths within 1.96 stated σ"),
        numeric("posterior 68 %", share("posterior_coverage68"), credible),
        numeric("posterior 95 %", share("posterior_coverage95"), credible),
    ]
    return Section(
        mode,
        _TITLES[mode],
        lead.replace("-", "−"),
        charts=list(mode_charts(study, mode)),
        tables=[
            tabulate(rows, achieved, "Achieved and possible"),
            tabulate(rows, covered, "Truths inside the stated intervals"),
        ],
        short=mode.capitalize(),
    )


def mode_charts(study: Mapping[str, Any], mode: str) -> Iterator[Chart]:
    """Show the spread along light and height, and the histograms of pulls and ranks."""
    names = _named(study[mode])
    of = f"-{mode}"
    for key, stem in (("photons", "photons"), ("z", "heights")):
        curve = study["curves"][key][mode]
        fine = curve.get("bounds", curve)
        parts = [
            part
            for name in names
            for part in (
                *_bounds(fine["at"], fine[name], parameter(name)),
                _points("spread", curve["at"], curve[name], "spread", parameter(name)),
            )
        ]
        yield curves(stem, parts, of=of)
    if pulls := study["histograms"]["pulls"][mode]:
        parts = []
        for name in names:
            bins, panel = pulls[name], parameter(name)
            edges = np.asarray(bins["edges"], float)
            parts.append(marks("bar", "fits", edges, bins["counts"], panel=panel))
            middle = (edges[1:] + edges[:-1]) / 2
            parts.append(marks("line", "normal", middle, bins["expected"], panel=panel))
        yield curves("pulls", parts, of=of)
    if ranks := study["histograms"]["ranks"][mode]:
        parts = []
        for name in names:
            counts, most = np.asarray(ranks[name]["counts"], float), ranks[name]["possible"]
            known = f", p = {ranks[name]['p_value']:.2g}" if counts.sum() >= ENOUGH_RANKS else ""
            panel, edges = parameter(name) + known, np.linspace(0, most, counts.size + 1)
            parts.append(marks("bar", "posteriors", edges, counts, panel=panel))
            parts.append(marks("line", "uniform", [0, most], [counts.mean()] * 2, panel=panel))
        yield curves("ranks", parts, of=of)


def _bounds(at: Any, bounds: Mapping[str, Any], panel: str) -> Iterator[list[Row]]:
    """Make the lines of both bounds."""
    yield marks("line", "CRB", at, bounds["crb"], panel=panel)
    yield marks("line", "QCRB", at, bounds["qcrb"], panel=panel, dash="dashed")


def _points(
    series: str, at: Sequence[float], line: Mapping[str, Any], key: str, panel: str = ""
) -> list[Row]:
    """Make the points of a statistic with its intervals."""
    ends = np.asarray(line[f"{key}_ci95"], float).reshape(-1, 2).T
    return marks("point", series, at, line[key], ends, panel=panel)


# ---- Other people's estimators -------------------------------------------------------------------


def render_challenge(document: Mapping[str, Any]) -> str:
    """Make the page of scored results."""
    table_1 = document.get("table_1")
    sections = [
        ranking_section(document, document["parts"]),
        *(_part_section(name, part) for name, part in document["parts"].items()),
        *([_table_1(table_1)] if table_1 else []),
        _made(document),
    ]
    about = document.get("challenge")
    blind = "truth withheld" if about and about["blind"] else "truth open"
    subtitle = f"version {about['version']}, {blind}" if about else "one's own simulation"
    return render_document(
        document["title"], subtitle, sections, frame={"footer": _footer(document)}
    )


def contest_parts(study: Mapping[str, Any]) -> dict[str, Any]:
    """See the estimators of a benchmark as parts, one for each mode."""
    every = study["estimators"].items()
    return {
        mode: {
            "mode": mode,
            "about": "",
            "trials": study["trials"],
            "estimators": {who: entry[mode] for who, entry in every if mode in entry},
            "paired": study["paired"].get(mode, {}),
        }
        for mode in MODES
        if any(mode in entry for _, entry in every)
    }


def contest_sections(study: Mapping[str, Any]) -> list[Section]:
    """Make the sections of a benchmark that other estimators took part in."""
    curve, parts = study["estimator_curves"], contest_parts(study)
    charts = [_curve_chart(axis, curve[axis]) for axis in _AXES if axis in curve]
    if study["detection"]["mass_kda"] and study["detection"]["estimators"]:
        charts.append(_recall_chart(study["detection"]))
    where = f"Where each leaves the bound, mode {curve['mode']}"
    sections = [
        ranking_section(study, parts),
        *(
            _part_section(f"estimators-{mode}", part, f"Estimators, mode {mode}")
            for mode, part in parts.items()
        ),
        Section("estimators-curves", where, charts=charts, tables=[_best_table(curve)]),
    ]
    if study["estimator_map"]["parameters"]:
        sections.append(_map_section(study["estimator_map"]))
    return sections


def _map_section(found: Mapping[str, Any]) -> Section:
    """Say who is best where, in a map and with all who are as good in a table."""
    rows = []
    for name in _named(found["parameters"]):
        for row, column in np.ndindex(len(found["height_nm"]), len(found["photons"])):
            cell = {key: table[row][column] for key, table in found["parameters"][name].items()}
            at = {"height": found["height_nm"][row], "photons": found["photons"][column]}
            rows.append({"parameter": LABELS[name], **at, **cell})
    columns = [
        worded("parameter", "parameter"),
        numeric("height [nm]", of("height")),
        numeric("photons", of("photons")),
        worded("best", lambda row: row["best"] or "—"),
        numeric("information kept", of("kept", number, 2)),
        worded("as good", lambda row: ", ".join(row["equal"] or ()) or "—"),
    ]
    cells = [
        {
            "panel": row["parameter"],
            "row": f"{row['height']:.0f}",
            "column": f"{row['photons']:g}",
            "value": row["best"] or "—",
            "text": f"{number(row['kept'], 2)}{'+' if row['equal'] else ''}" if row["best"] else "",
        }
        for row in sorted(rows, key=lambda row: -row["height"])
    ]
    return Section(
        "estimators-map",
        f"Who is best where, mode {found['mode']}",
        charts=[heatmap("best-estimator", cells, {"trials": found["trials"]})],
        tables=[tabulate(rows, columns, "The same, with all that are as good")],
    )


def ranking_section(document: Mapping[str, Any], parts: Mapping[str, Any]) -> Section:
    """Rank the estimators; those that know more than the counts, or do not look, come last."""
    remarks: dict[str, str] = {}
    for part in parts.values():
        for who, entry in part["estimators"].items():
            for scored in (entry[name] for name in LABELS if name in entry):
                if _unranked(scored):
                    remarks[who] = scored["verdict"]
    places = [{**one, "remark": remarks.get(one["estimator"], "")} for one in document["ranking"]]
    places.sort(key=lambda one: bool(one["remark"]))
    columns = [
        worded("place", lambda row: "—" if row["remark"] else row["place"]),
        worded("estimator", "estimator"),
        numeric("information kept", of("kept")),
        worded("", lambda row: f"not ranked: {row['remark']}" if row["remark"] else ""),
    ]
    ranked = [{"place": place, **one} for place, one in enumerate(places, 1)]
    tables = [tabulate(ranked, columns, "Information kept, over all parameters and parts")]
    return Section("ranking", "Ranking", notes=_HOW, tables=tables)


def _unranked(scored: Mapping[str, Any]) -> bool:
    """Tell whether an estimator knows more than the counts, or does not look at them."""
    return bool(scored.get("verdict", "").startswith(_UNRANKED))


def _part_section(name: str, part: Mapping[str, Any], title: str = "") -> Section:
    bounds = part.get("bounds") or {}
    lead = "; ".join(
        f"{LABELS[p]}: CRB {number(b['crb'])}, Holevo {number(b['holevo'])}, "
        f"QCRB {number(b['qcrb'])} {UNITS[p]}"
        for p, b in bounds.items()
    )
    tables = [
        tabulate(scored, _SCORES, f"{parameter(p)}, by efficiency")
        for p in LABELS
        if (scored := _scored(part, p))
    ]
    tables += [table for table in (_paired(part), _failures(part), _recall(part)) if table.rows]
    entries = part["estimators"].items()
    notes = [f"{who}: {'; '.join(e['notes'])}." for who, e in entries if e.get("notes")]
    about = f"{part['about']}; " if part["about"] else ""
    return Section(
        name,
        title or name.replace("_", " "),
        f"{about}mode {part['mode']}, {part['trials']} particles. {lead}",
        charts=list(_reached_charts(name, part)),
        tables=tables,
        notes=notes,
    )


def _scored(part: Mapping[str, Any], name: str) -> list[dict[str, Any]]:
    """Give the scores of a parameter, by efficiency; those below the bound come last."""
    found = [
        {"who": who, "seconds_per_fit": entry.get("seconds_per_fit"), **entry[name]}
        for who, entry in part["estimators"].items()
        if name in entry
    ]
    return sorted(found, key=lambda e: (_unranked(e), -(e.get("efficiency_crb") or 0.0)))


_SCORES = (
    worded("estimator", "who"),
    worded("remark", lambda e: e.get("verdict", "")),
    numeric("efficiency", _interval("efficiency_crb")),
    numeric("spread / CRB", _interval("spread_over_crb")),
    numeric("/ Holevo", of("spread_over_holevo")),
    numeric("/ QCRB", of("spread_over_qcrb")),
    numeric("bias", _bias),
    numeric("rmse", of("rmse")),
    numeric("pull σ", _interval("pull_std")),
    numeric("68 %", of("coverage68", percent)),
    numeric("answered", lambda e: f"{e['answered']} of {e['answered'] + e['failed']}"),
    numeric("ms each", of("seconds_per_fit", lambda s: number(None if s is None else 1000 * s))),
)


def _paired(part: Mapping[str, Any]) -> Table:
    rows = [
        {"parameter": LABELS[p], "who": who, "to": found["to"], **one}
        for p, found in part.get("paired", {}).items()
        for who, one in found.items()
        if isinstance(one, Mapping)
    ]
    columns = [
        worded("parameter", "parameter"),
        worded("estimator", "who"),
        worded("to", "to"),
        numeric("mean square errors", _interval("mse_ratio")),
        numeric("both", "trials"),
    ]
    return tabulate(rows, columns, "On the same counts")


def _failures(part: Mapping[str, Any]) -> Table:
    rows = [
        (who, why, times)
        for who, entry in part["estimators"].items()
        for why, times in entry.get("failures", {}).items()
    ]
    columns = worded("estimator", 0), worded("why", 1), numeric("particles", 2)
    return tabulate(rows, columns, "Without an answer")


def _recall(part: Mapping[str, Any]) -> Table:
    rows = [
        {"who": who, "false_alarms": entry["false_alarms"], **one}
        for who, entry in part["estimators"].items()
        for one in entry.get("recall", ())
    ]
    columns = [
        worded("results", "who"),
        numeric("mass [kDa]", "mass_kda"),
        numeric("found", lambda row: f"{row['found']} of {row['events']}"),
        numeric("recall at the rate", _interval("recall")),
        numeric("matched filter", of("matched_filter")),
        numeric("false alarms", "false_alarms"),
    ]
    return tabulate(rows, columns, "Detection")


def _best_table(curves: Mapping[str, Any]) -> Table:
    """Say who is best where: the highest efficiency at each point, of each parameter."""
    rows = []
    for axis, (label, _) in _AXES.items():
        curve = curves.get(axis, {"at": ()})
        for k, at in enumerate(curve["at"]):
            row = {"along": label, "at": at}
            for name in PARAMETERS:
                reached = {
                    who: float(np.asarray(line[name]["efficiency_crb"], float)[k])
                    for who, line in curve["estimators"].items()
                    if name in line
                }
                known = {who: value for who, value in reached.items() if math.isfinite(value)}
                best = max(known, key=known.__getitem__, default="")
                row[name] = f"{best} {number(float(known[best]), 2)}" if best else "—"
            rows.append(row)
    columns = [
        worded("along", "along"),
        numeric("at", of("at")),
        *(worded(LABELS[name], name) for name in PARAMETERS),
    ]
    return tabulate(rows, columns, "Where each is best, with its efficiency")


def _table_1(rows: Sequence[Mapping[str, Any]]) -> Section:
    names = list(dict.fromkeys(who for row in rows for who in row["achieved"]))
    bounds = {"printed": "printed", "QCRB": "qcrb", "CRB": "crb"}

    def achieved(who: str) -> Callable[[Any], str]:
        return lambda row: number(row["achieved"].get(who))

    columns = [
        worded("part", lambda row: row["part"].replace("_", " ")),
        worded("parameter", lambda row: LABELS[row["parameter"]]),
        *(numeric(label, of(key)) for label, key in bounds.items()),
        *(numeric(who, achieved(who)) for who in names),
    ]
    lead = (
        "For one collected scattered photon: bound and root mean square error times the root of "
        "the photons [nm; mass relative]."
    )
    tables = [tabulate(rows, columns, "Printed, quantum bound, Cramér–Rao bound, and achieved")]
    return Section("table-1", "Table 1 of Dong et al. (2021)", lead, tables=tables)


def _made(document: Mapping[str, Any]) -> Section:
    about, tables = document.get("challenge") or {}, document["results_sha256"].items()
    files = [(f"challenge, {key}", str(value)) for key, value in about.items()]
    files += [(name, f"SHA-256 {value}") for name, value in tables]
    note = f"Bootstrap seed {document['seed']}; the same command gives the same bytes."
    hashes = tabulate(files, (worded("what", 0), worded("value", 1)), "Files")
    return Section(
        "how",
        "How this was made",
        notes=[note],
        tables=[hashes, _versions(document)],
        code=document["command"],
    )


# ---- Figures of estimators -----------------------------------------------------------------------


def _curve_chart(axis: str, curve: Mapping[str, Any]) -> Chart:
    label, log = _AXES[axis]
    parts: list[list[Row]] = []
    for name in _named(curve["bounds"]):
        panel = parameter(name)
        parts += _bounds(curve["at"], curve["bounds"][name], panel)
        for who, lines in curve["estimators"].items():
            parts.append(_points(who, curve["at"], lines[name], "rmse", panel))
    return curves("estimators", parts, {"x": label, "log": log}, of=f"-{axis}")


def _recall_chart(found: Mapping[str, Any]) -> Chart:
    at = found["mass_kda"]
    parts = [marks("line", "best possible", at, found["matched_filter"])]
    parts += [_points(who, at, line, "recall") for who, line in found["estimators"].items()]
    return curves("recall", parts, {"rate": f"{100 * found['false_alarm_rate']:.3g}"})


def _reached_charts(name: str, part: Mapping[str, Any]) -> Iterator[Chart]:
    """Show spread over CRB of every estimator, with its interval."""
    rows = [
        interval(e["who"], e["spread_over_crb"], e["spread_over_crb_ci95"], panel=LABELS[p])
        for p in LABELS
        for e in _scored(part, p)
        if e.get("spread_over_crb") is not None
    ]
    if rows:
        yield intervals("reached", rows, of=f"-{name}")
