"""Pages of `iscat benchmark` and of challenges: estimators beside each other and the bounds.

Everything arrives as ``benchmark.json`` and ``challenge.json``; nothing is computed here but what
is shown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

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
from iscat_analysis.report.page import Chart, Section, render_document
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    INK,
    VERMILLION,
    Style,
    floats,
    legend,
    new_figure,
    one_panel,
    plain_log,
    publish,
    row_of_panels,
    whiskers,
    whole_numbers,
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
_FIGURES = {
    "photons": "Spread against photons",
    "heights": "Spread against height",
    "pulls": "Pulls: (estimate − truth) / σ",
    "ranks": "Ranks of the truth among the draws of its posterior",
}
_COLOURS = ("#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#6A3D9A", "#8A8F96", "#B15928")
_MARKERS = "os^Dv<>PXph*"
_MAP_COLOURS = ("#56B4E9", "#E69F00", "#009E73", "#CC79A7", "#F0E442", "#D55E00", "#8A8F96")

_AXES = {
    "photons": ("collected scattered photons", True),
    "mass": ("mass [kDa]", True),
    "height": ("height [nm]", False),
    "focus": ("focus [nm]", False),
    "density": ("other particles per µm²", True),
    "wrong_focus": ("error of the focus that estimators are told [nm]", False),
}

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


def _legend_below(figure: Figure) -> None:
    legend(figure, where="lower center", columns=2 + 2 * len(figure.axes))


# ---- A benchmark ---------------------------------------------------------------------------------


def render_benchmark(study: Mapping[str, Any], *, folder: Path | None = None) -> str:
    """Make the page of a study, and write its figures."""
    others = "estimators" in study
    figures = benchmark_figures(study)
    if others:
        named = {f"estimators-{mode}": part for mode, part in contest_parts(study).items()}
        figures = chain(figures, contest_figures(study), part_figures(named))
    drawn = publish(figures, folder)
    code = f"{study['command']}\n\n{study['config']}"
    sections = [
        *(contest_sections(study, drawn) if others else ()),
        _summary(study),
        *(_mode_section(study, mode, drawn) for mode in MODES if mode in study),
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
        ratios = floats(entry[name]["spread_over_crb"] for name in names)
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


def _mode_section(study: Mapping[str, Any], mode: str, drawn: Mapping[str, Markup]) -> Section:
    entry, at = study[mode], study[mode]["at"]
    rows = [{"name": name, **entry[name]} for name in _named(entry)]
    charts = [
        Chart(f"{mode}-{stem}", title, drawn[f"{stem}_{mode}"], wide=True)
        for stem, title in _FIGURES.items()
        if f"{stem}_{mode}" in drawn
    ]
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
        charts=charts,
        tables=[
            tabulate(rows, achieved, "Achieved and possible"),
            tabulate(rows, covered, "Truths inside the stated intervals"),
        ],
        short=mode.capitalize(),
    )


def benchmark_figures(study: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw the figures."""
    for mode in (mode for mode in MODES if mode in study):
        names = _named(study[mode])
        for key, axis, stem in (("photons", "photons", "photons"), ("z", "height", "heights")):
            curve = study["curves"][key][mode]
            yield f"{stem}_{mode}", _panels(names, partial(_draw_curve, axis, curve))
        for kind, draw in (("pulls", _draw_pulls), ("ranks", _draw_ranks)):
            if bins := study["histograms"][kind][mode]:
                yield f"{kind}_{mode}", _panels(names, partial(draw, bins))


def _panels(names: Sequence[str], draw: Callable[[Axes, str], None]) -> Figure:
    figure, panels = row_of_panels(len(names), 2.9, 2.9)
    for axes, name in zip(panels, names, strict=True):
        draw(axes, name)
        axes.set_title(parameter(name))
        if axes is not panels[0]:
            axes.set_ylabel("")
    legend(figure)
    return figure


def _draw_bounds(axes: Axes, at: Any, bounds: Mapping[str, Any]) -> None:
    axes.plot(at, floats(bounds["crb"]), color=INK, label="CRB")
    axes.plot(at, floats(bounds["qcrb"]), color=BLUE, linestyle="--", label="QCRB")


def _draw_curve(axis: str, curve: Mapping[str, Any], axes: Axes, name: str) -> None:
    label, logarithmic = _AXES[axis]
    line, fine = curve[name], curve.get("bounds", curve)
    _draw_bounds(axes, fine["at"], fine[name])
    ends = np.transpose([floats(pair) for pair in line["spread_ci95"]])
    style: Style = {"color": VERMILLION, "label": "spread"}
    whiskers(axes, curve["at"], floats(line["spread"]), ends, style=style)
    axes.set(xscale="log" if logarithmic else "linear", xlabel=label, ylabel="standard deviation")
    plain_log(axes, "y")


def _draw_pulls(found: Mapping[str, Any], axes: Axes, name: str) -> None:
    bins = found[name]
    counts, edges = floats(bins["counts"]), floats(bins["edges"])
    axes.stairs(counts, edges, fill=True, color=VERMILLION, label="fits")
    axes.plot((edges[1:] + edges[:-1]) / 2, floats(bins["expected"]), color=INK, label="normal")
    axes.set_ylim(0, 1.25 * max(counts.max(), 1.0))
    whole_numbers(axes, "(estimate − truth) / σ", "fits")


def _draw_ranks(found: Mapping[str, Any], axes: Axes, name: str) -> None:
    bins = found[name]
    counts = floats(bins["counts"])
    edges = np.linspace(0, bins["possible"], counts.size + 1)
    axes.stairs(counts, edges, fill=True, color=BLUE, label="posteriors")
    axes.axhline(float(counts.mean()), color=INK, linewidth=1, label="uniform")
    if counts.sum() >= ENOUGH_RANKS:
        axes.set_title(f"p = {bins['p_value']:.2g}", loc="right", fontsize=8)
    axes.set_ylim(0, 1.25 * max(counts.max(), 1.0))
    whole_numbers(axes, "rank of the truth", "posteriors")


# ---- Other people's estimators -------------------------------------------------------------------


def render_challenge(document: Mapping[str, Any], *, folder: Path | None = None) -> str:
    """Make the page of scored results, and write its figures."""
    drawn = publish(part_figures(document["parts"]), folder)
    table_1 = document.get("table_1")
    sections = [
        _ranking_section(document),
        *(_part_section(name, part, drawn) for name, part in document["parts"].items()),
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


def contest_sections(study: Mapping[str, Any], drawn: Mapping[str, Markup]) -> list[Section]:
    """Make the sections of a benchmark that other estimators took part in."""
    curves = study["estimator_curves"]
    charts = [
        Chart(f"estimators-{axis}", f"Error against {label}", svg, wide=True)
        for axis, (label, _) in _AXES.items()
        if (svg := drawn.get(f"estimators_{axis}"))
    ]
    if "estimators_recall" in drawn:
        rate = study["detection"]["false_alarm_rate"]
        caption = (
            f"False alarms in {100 * rate:.3g} % of empty regions; the matched filter at a known "
            "place is what no test can beat."
        )
        recall = drawn["estimators_recall"]
        charts.append(Chart("estimators-recall", "Recall against mass", recall, caption, True))
    where = f"Where each leaves the bound, mode {curves['mode']}"
    sections = [
        _ranking_section(study),
        *(
            _part_section(f"estimators-{mode}", part, drawn, f"Estimators, mode {mode}")
            for mode, part in contest_parts(study).items()
        ),
        Section("estimators-curves", where, charts=charts, tables=[_best_table(curves)]),
    ]
    if "estimators_map" in drawn:
        sections.append(_map_section(study["estimator_map"], drawn["estimators_map"]))
    return sections


def _map_section(found: Mapping[str, Any], svg: Markup) -> Section:
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
    caption = (
        "Numbers are the information that the best one keeps, of "
        f"{found['trials']} particles each; + where another is as good, by the interval of the "
        "ratio of mean square errors on the same counts."
    )
    name = "Best estimator by light and height"
    return Section(
        "estimators-map",
        f"Who is best where, mode {found['mode']}",
        charts=[Chart("estimators-map-chart", name, svg, caption, True)],
        tables=[tabulate(rows, columns, "The same, with all that are as good")],
    )


def contest_figures(study: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw the curves of a benchmark that other estimators took part in."""
    curves = study["estimator_curves"]
    for axis in _AXES:
        if axis in curves:
            yield f"estimators_{axis}", _curve_figure(axis, curves[axis])
    if study["estimator_map"]["parameters"]:
        yield "estimators_map", _map_figure(study["estimator_map"], list(study["estimators"]))
    if study["detection"]["mass_kda"] and study["detection"]["estimators"]:
        yield "estimators_recall", _recall_figure(study["detection"])


def part_figures(parts: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw what each estimator reached of every parameter, of each part."""
    for name, part in parts.items():
        if any(_scored(part, p) for p in LABELS):
            yield f"part_{name}", _reached_figure(part)


def _ranking_section(document: Mapping[str, Any]) -> Section:
    places = [{"place": place, **one} for place, one in enumerate(document["ranking"], 1)]
    columns = [
        worded("place", lambda row: "—" if row["below_bound"] else row["place"]),
        worded("estimator", "estimator"),
        numeric("information kept", of("kept")),
        worded("", lambda row: "below the bound: not ranked" if row["below_bound"] else ""),
    ]
    tables = [tabulate(places, columns, "Information kept, over all parameters and parts")]
    return Section("ranking", "Ranking", notes=_HOW, tables=tables)


def _part_section(
    name: str, part: Mapping[str, Any], drawn: Mapping[str, Markup], title: str = ""
) -> Section:
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
    svg = drawn.get(f"part_{name}")
    charts = [Chart(f"{name}-reached", "Spread over CRB", svg, wide=True)] if svg else []
    about = f"{part['about']}; " if part["about"] else ""
    return Section(
        name,
        title or name.replace("_", " "),
        f"{about}mode {part['mode']}, {part['trials']} particles. {lead}",
        charts=charts,
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
    return sorted(
        found, key=lambda e: (bool(e.get("below_bound")), -(e.get("efficiency_crb") or 0.0))
    )


_SCORES = (
    worded("estimator", "who"),
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
    worded("remark", lambda e: e.get("verdict", "")),
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
                    who: floats(line[name]["efficiency_crb"])[k]
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


def _curve_figure(axis: str, curve: Mapping[str, Any]) -> Figure:
    names = _named(curve["bounds"])
    label, logarithmic = _AXES[axis]
    figure, panels = row_of_panels(len(names), 3.1, 3.9)
    panels[0].set_ylabel("root mean square error")
    for axes, name in zip(panels, names, strict=True):
        _draw_bounds(axes, curve["at"], curve["bounds"][name])
        for k, (who, lines) in enumerate(curve["estimators"].items()):
            _draw_points(axes, curve["at"], lines[name], "rmse", k, who)
        axes.set(xscale="log" if logarithmic else "linear", title=parameter(name), xlabel=label)
        plain_log(axes, "y")
    _legend_below(figure)
    return figure


def _draw_points(
    axes: Axes, at: Sequence[float], line: Mapping[str, Any], key: str, k: int, who: str
) -> None:
    """Draw a statistic of an estimator with its intervals, if any is known."""
    values = floats(line[key])
    if np.isfinite(values).any():
        ends = np.transpose([floats(pair) for pair in line[f"{key}_ci95"]])
        mark: Style = {"fmt": _MARKERS[k % len(_MARKERS)], "color": _COLOURS[k % len(_COLOURS)]}
        whiskers(axes, at, values, ends, style={**mark, "lw": 0.8, "label": who})


def _map_figure(found: Mapping[str, Any], names: Sequence[str]) -> Figure:
    """Draw who is best at each height and light: a colour and a letter for each estimator."""
    tables = {p: found["parameters"][p] for p in _named(found["parameters"])}
    winners = {who for table in tables.values() for row in table["best"] for who in row if who}
    letters = {who: chr(ord("A") + k) for k, who in enumerate(w for w in names if w in winners)}
    colours = {who: _MAP_COLOURS[k % len(_MAP_COLOURS)] for k, who in enumerate(letters)}
    heights, photons = found["height_nm"], found["photons"]
    figure = new_figure(1.1 + 2.4 * len(tables), 3.6)
    panels = figure.subplots(1, len(tables), squeeze=False)[0]
    panels[0].set_ylabel("height [nm]")
    for axes, (name, table) in zip(panels, tables.items(), strict=True):
        for row, column in np.ndindex(len(heights), len(photons)):
            best, kept, equal = (table[key][row][column] for key in ("best", "kept", "equal"))
            how: Style = {"facecolor": colours.get(best, GREY), "edgecolor": "white"}
            box = Rectangle((column - 0.5, row - 0.5), 1, 1, alpha=0.6, linewidth=1.5, **how)
            axes.add_patch(box)
            words = f"{letters[best]} {number(kept, 2)}{'+' if equal else ''}" if best else "—"
            axes.text(column, row, words, ha="center", va="center", fontsize=7.5, color=INK)
        axes.set(xlim=(-0.5, len(photons) - 0.5), ylim=(-0.5, len(heights) - 0.5))
        axes.set_xticks(range(len(photons)), [f"{v:g}" for v in photons])
        axes.set_yticks(range(len(heights)), [f"{v:.0f}" for v in heights])
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set(title=LABELS[name], xlabel="collected photons")
    patches = [
        Patch(facecolor=colours[who], alpha=0.6, label=f"{letter} {who}")
        for who, letter in letters.items()
    ]
    columns = min(len(patches), 5) or 1
    figure.legend(handles=patches, loc="outside lower center", ncols=columns, fontsize=8)
    return figure


def _recall_figure(found: Mapping[str, Any]) -> Figure:
    figure, axes = one_panel(5.0, 3.9)
    at = found["mass_kda"]
    axes.plot(at, floats(found["matched_filter"]), color=INK, label="best possible")
    for k, (who, line) in enumerate(found["estimators"].items()):
        _draw_points(axes, at, line, "recall", k, who)
    axes.set(xscale="log", xlabel="mass [kDa]", ylabel="recall")
    _legend_below(figure)
    return figure


def _reached_figure(part: Mapping[str, Any]) -> Figure:
    """Draw spread over CRB of every estimator, with its interval."""
    scores = {p: scored for p in LABELS if (scored := _scored(part, p))}
    rows = max(map(len, scores.values()))
    figure, panels = row_of_panels(len(scores), 3.4, 0.8 + 0.27 * rows)
    for axes, (name, scored) in zip(panels, scores.items(), strict=True):
        known = [e for e in scored if e.get("spread_over_crb") is not None]
        at = np.arange(len(known))[::-1]
        values = floats(e["spread_over_crb"] for e in known)
        ends = np.reshape([floats(e["spread_over_crb_ci95"]) for e in known], (-1, 2)).T
        whiskers(axes, at, values, ends, along="x", style={"color": _COLOURS[0]})
        axes.axvline(1.0, color=INK, linewidth=1)
        axes.set_yticks(at, [e["who"] for e in known])
        axes.set(xscale="log", title=LABELS[name], xlabel="spread / CRB")
    return figure
