"""Pages on which estimators stand beside each other and beside the bounds.

They show what ``benchmark.json`` and ``challenge.json`` hold; nothing is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle

from iscat_analysis.report.numbers import LABELS, UNITS, number, percent
from iscat_analysis.report.page import render_page
from iscat_analysis.report.style import BLUE, GREY, INK, log_y, new_figure, publish

CHALLENGE_NAMES = frozenset({"challenge.json", "challenge.html", "benchmark.bib", "figures"})
"""Everything the score of a challenge leaves in its folder."""

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


def render_challenge(document: Mapping[str, Any], *, folder: Path | None = None) -> str:
    """Make the page of scored results, and write its figures."""
    drawn = publish(part_figures(document["parts"]), folder)
    sections = [
        _ranking_section(document),
        *(_part_section(name, part, drawn) for name, part in document["parts"].items()),
        *([_table_1(document["table_1"])] if document.get("table_1") else []),
        _made(document),
    ]
    about = document.get("challenge")
    blind = "truth withheld" if about and about["blind"] else "truth open"
    return render_page(
        "document.html",
        {
            "title": document["title"],
            "subtitle": f"version {about['version']}, {blind}" if about else "one's own simulation",
            "sections": sections,
            "nav": [(s["id"], s.get("short", s["title"])) for s in sections],
            "footer": f"iscat-analysis {document['versions']['iscat-analysis']}",
        },
    )


def contest_parts(study: Mapping[str, Any]) -> dict[str, Any]:
    """See the estimators of a benchmark as parts, one for each mode."""
    parts: dict[str, Any] = {}
    for who, entry in study["estimators"].items():
        for mode, scored in entry.items():
            if isinstance(scored, Mapping):
                part = parts.setdefault(
                    mode, {"kind": "trials", "mode": mode, "about": "", "trials": study["trials"],
                           "estimators": {}, "paired": study["paired"].get(mode, {})},
                )  # fmt: skip
                part["estimators"][who] = scored
    return parts


def contest_sections(study: Mapping[str, Any], drawn: Mapping[str, Markup]) -> list[dict[str, Any]]:
    """Make the sections of a benchmark that other estimators took part in."""
    sections = [_ranking_section(study)]
    sections += [
        {**_part_section(f"estimators-{mode}", part, drawn), "title": f"Estimators, mode {mode}"}
        for mode, part in contest_parts(study).items()
    ]
    curves = study["estimator_curves"]
    charts = [
        {"id": f"estimators-{axis}", "title": f"Error against {_AXES[axis][0]}",
         "svg": drawn[f"estimators_{axis}"], "wide": True}
        for axis in _AXES if f"estimators_{axis}" in drawn
    ]  # fmt: skip
    if "estimators_recall" in drawn:
        rate = study["detection"]["false_alarm_rate"]
        charts.append(
            {"id": "estimators-recall", "title": "Recall against mass", "wide": True,
             "caption": f"False alarms in {100 * rate:.3g} % of empty regions; the matched filter "
             "at a known place is what no test can beat.", "svg": drawn["estimators_recall"]},
        )  # fmt: skip
    sections.append(
        {
            "id": "estimators-curves",
            "title": f"Where each leaves the bound, mode {curves['mode']}",
            "charts": charts,
            "tables": [_best_table(curves)],
        }
    )
    if "estimators_map" in drawn:
        sections.append(_map_section(study["estimator_map"], drawn["estimators_map"]))
    return sections


def _map_section(found: Mapping[str, Any], svg: Markup) -> dict[str, Any]:
    """Say who is best where, in a map and with all who are as good in a table."""
    rows = [
        [LABELS[p], number(height), number(photons), *_cell(found["parameters"][p], r, c)]
        for p in LABELS
        if p in found["parameters"]
        for r, height in enumerate(found["height_nm"])
        for c, photons in enumerate(found["photons"])
    ]
    columns = ["parameter", _numeric("height [nm]"), _numeric("photons"), "best",
               _numeric("information kept"), "as good"]  # fmt: skip
    return {
        "id": "estimators-map",
        "title": f"Who is best where, mode {found['mode']}",
        "charts": [
            {"id": "estimators-map-chart", "title": "Best estimator by light and height",
             "wide": True, "svg": svg,
             "caption": "Numbers are the information that the best one keeps, of "
             f"{found['trials']} particles each; + where another is as good, by the interval of "
             "the ratio of mean square errors on the same counts."},
        ],
        "tables": [{"caption": "The same, with all that are as good", "columns": columns,
                    "rows": rows}],
    }  # fmt: skip


def _cell(table: Mapping[str, Any], row: int, column: int) -> list[Any]:
    best, kept, equal = (table[key][row][column] for key in ("best", "kept", "equal"))
    return [best or "—", number(kept, 2), ", ".join(equal or ()) or "—"]


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


def _ranking_section(document: Mapping[str, Any]) -> dict[str, Any]:
    rows = []
    for place, one in enumerate(document["ranking"], 1):
        flag = "below the bound: not ranked" if one["below_bound"] else ""
        rows.append(["—" if flag else place, one["estimator"], number(one["kept"]), flag])
    return {
        "id": "ranking",
        "title": "Ranking",
        "notes": list(_HOW),
        "tables": [
            {
                "caption": "Information kept, over all parameters and parts",
                "columns": ["place", "estimator", _numeric("information kept"), ""],
                "rows": rows,
            }
        ],
    }


def _part_section(
    name: str, part: Mapping[str, Any], drawn: Mapping[str, Markup]
) -> dict[str, Any]:
    free = [p for p in LABELS if _scored(part, p)]
    bounds = part.get("bounds") or {}
    lead = "; ".join(
        f"{LABELS[p]}: CRB {number(b['crb'])}, Holevo {number(b['holevo'])}, "
        f"QCRB {number(b['qcrb'])} {UNITS[p]}"
        for p, b in bounds.items()
    )
    tables = [
        {"caption": f"{LABELS[p]} [{UNITS[p]}], by efficiency", "columns": _COLUMNS,
         "rows": [_row(who, e, part) for who, e in _scored(part, p)]}
        for p in free
    ]  # fmt: skip
    pairs = [
        [LABELS[p], who, found["to"], _with(one, "mse_ratio"), one["trials"]]
        for p, found in part.get("paired", {}).items()
        for who, one in found.items()
        if isinstance(one, Mapping)
    ]
    if pairs:
        columns = ["parameter", "estimator", "to", _numeric("mean square errors"), _numeric("both")]
        tables.append({"caption": "On the same counts", "columns": columns, "rows": pairs})
    tables += [table for table in (_failures(part), _recall(part)) if table["rows"]]
    notes = [f"{who}: {'; '.join(e['notes'])}." for who, e in part["estimators"].items()
             if e.get("notes")]  # fmt: skip
    charts = []
    if f"part_{name}" in drawn:
        charts = [{"id": f"{name}-reached", "title": "Spread over CRB", "wide": True,
                   "svg": drawn[f"part_{name}"]}]  # fmt: skip
    about = f"{part['about']}; " if part["about"] else ""
    return {
        "id": name, "title": name.replace("_", " "), "charts": charts, "tables": tables,
        "lead": f"{about}mode {part['mode']}, {part['trials']} particles. {lead}", "notes": notes,
    }  # fmt: skip


def _numeric(label: str) -> dict[str, Any]:
    return {"label": label, "numeric": True, "title": None}


_COLUMNS = [
    "estimator",
    *map(_numeric, ("efficiency", "spread / CRB", "/ Holevo", "/ QCRB", "bias", "rmse", "pull σ",
                    "68 %", "answered", "ms each")),
    "remark",
]  # fmt: skip


def _scored(part: Mapping[str, Any], parameter: str) -> list[tuple[str, Mapping[str, Any]]]:
    """Give the estimators of a parameter, by efficiency; those below the bound come last."""
    found = [
        (who, entry[parameter]) for who, entry in part["estimators"].items() if parameter in entry
    ]
    return sorted(
        found,
        key=lambda one: (bool(one[1].get("below_bound")), -(one[1].get("efficiency_crb") or 0.0)),
    )


def _row(who: str, e: Mapping[str, Any], part: Mapping[str, Any]) -> list[Any]:
    seconds = part["estimators"][who].get("seconds_per_fit")
    share = e.get("coverage68")
    share = math.nan if share is None else float(share)
    return [
        who, _with(e, "efficiency_crb"), _with(e, "spread_over_crb"),
        number(e.get("spread_over_holevo")), number(e.get("spread_over_qcrb")),
        f"{number(e.get('bias'))} ± {number(e.get('bias_se'), 2)}", number(e.get("rmse")),
        _with(e, "pull_std"), percent(share),
        f"{e['answered']} of {e['answered'] + e['failed']}",
        number(None if seconds is None else 1000 * seconds), e.get("verdict", ""),
    ]  # fmt: skip


def _failures(part: Mapping[str, Any]) -> dict[str, Any]:
    rows = [
        [who, why, times]
        for who, entry in part["estimators"].items()
        for why, times in entry.get("failures", {}).items()
    ]
    columns = ["estimator", "why", _numeric("particles")]
    return {"caption": "Without an answer", "columns": columns, "rows": rows}


def _recall(part: Mapping[str, Any]) -> dict[str, Any]:
    rows = [
        [who, one["mass_kda"], f"{one['found']} of {one['events']}", _with(one, "recall"),
         number(one["matched_filter"]), entry["false_alarms"]]
        for who, entry in part["estimators"].items()
        for one in entry.get("recall", ())
    ]  # fmt: skip
    columns = ["results", *map(_numeric, ("mass [kDa]", "found", "recall at the rate",
                                          "matched filter", "false alarms"))]  # fmt: skip
    return {"caption": "Detection", "columns": columns, "rows": rows}


def _best_table(curves: Mapping[str, Any]) -> dict[str, Any]:
    """Say who is best where: the highest efficiency at each point, of each parameter."""
    rows = []
    for axis, (label, _) in _AXES.items():
        curve = curves.get(axis)
        for k, at in enumerate(curve["at"] if curve else ()):
            row: list[Any] = [label, number(at)]
            for p in LABELS:
                known = {
                    who: float(lines[p]["efficiency_crb"][k])
                    for who, lines in (curve or {"estimators": {}})["estimators"].items()
                    if p in lines and _finite(lines[p]["efficiency_crb"][k])
                }
                best = max(known, key=lambda who: known[who]) if known else None
                row.append(f"{best} {number(known[best], 2)}" if best else "—")
            rows.append(row)
    columns = ["along", _numeric("at"), *(LABELS[p] for p in LABELS)]
    return {"caption": "Where each is best, with its efficiency", "columns": columns, "rows": rows}


def _table_1(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names = list(dict.fromkeys(who for row in rows for who in row["achieved"]))
    columns = ("printed", "QCRB", "CRB", *names)
    return {
        "id": "table-1",
        "title": "Table 1 of Dong et al. (2021)",
        "lead": "For one collected scattered photon: bound and root mean square error times the "
        "root of the photons [nm; mass relative].",
        "tables": [
            {
                "caption": "Printed, quantum bound, Cramér–Rao bound, and achieved",
                "columns": ["part", "parameter", *map(_numeric, columns)],
                "rows": [
                    [row["part"].replace("_", " "), LABELS[row["parameter"]],
                     *(number(row[k]) for k in ("printed", "qcrb", "crb")),
                     *(number(row["achieved"].get(who)) for who in names)]
                    for row in rows
                ],
            }
        ],
    }  # fmt: skip


def _made(document: Mapping[str, Any]) -> dict[str, Any]:
    rows = [list(pair) for pair in document["versions"].items()]
    about = document.get("challenge") or {}
    hashes = [[f"challenge, {key}", str(value)] for key, value in about.items()]
    hashes += [[name, f"SHA-256 {value}"] for name, value in document["results_sha256"].items()]
    return {
        "id": "how",
        "title": "How this was made",
        "notes": [f"Bootstrap seed {document['seed']}; the same command gives the same bytes."],
        "tables": [
            {"caption": "Files", "columns": ["what", "value"], "rows": hashes},
            {"caption": "Versions", "columns": ["package", "version"], "rows": rows},
        ],
        "code": document["command"],
    }


def _curve_figure(axis: str, curve: Mapping[str, Any]) -> Figure:
    names = [p for p in LABELS if p in curve["bounds"]]
    label, logarithmic = _AXES[axis]
    figure = new_figure(3.1 * len(names), 3.9)
    x = np.asarray(curve["at"], dtype=float)
    for place, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), place + 1)
        bounds = curve["bounds"][name]
        axes.plot(x, _floats(bounds["crb"]), color=INK, label="CRB")
        axes.plot(x, _floats(bounds["qcrb"]), color=BLUE, linestyle="--", label="QCRB")
        for k, (who, lines) in enumerate(curve["estimators"].items()):
            values = _floats(lines[name]["rmse"])
            if not np.isfinite(values).any():
                continue
            ends = np.array([_floats(pair) for pair in lines[name]["rmse_ci95"]]).T
            _points(axes, x, values, ends, k, who)
        axes.set_xscale("log" if logarithmic else "linear")
        log_y(axes)
        axes.set_title(f"{LABELS[name]} [{UNITS[name]}]")
        axes.set_xlabel(label)
        if not place:
            axes.set_ylabel("root mean square error")
    _legend(figure)
    return figure


def _map_figure(found: Mapping[str, Any], names: Sequence[str]) -> Figure:
    """Draw who is best at each height and light: a colour and a letter for each estimator."""
    tables = {p: found["parameters"][p] for p in LABELS if p in found["parameters"]}
    winners = {who for table in tables.values() for row in table["best"] for who in row if who}
    letters = {who: chr(ord("A") + k) for k, who in enumerate(w for w in names if w in winners)}
    colours = {who: _MAP_COLOURS[k % len(_MAP_COLOURS)] for k, who in enumerate(letters)}
    figure = new_figure(1.1 + 2.4 * len(tables), 3.6)
    every = figure.subplots(1, len(tables), squeeze=False)[0]
    for place, (axes, (name, table)) in enumerate(zip(every, tables.items(), strict=True)):
        for row, column in np.ndindex(len(found["height_nm"]), len(found["photons"])):
            best, kept, equal = (table[key][row][column] for key in ("best", "kept", "equal"))
            colour = colours.get(best, GREY)
            axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, alpha=0.6,
                                     edgecolor="white", linewidth=1.5))  # fmt: skip
            text = f"{letters[best]} {number(kept, 2)}{'+' if equal else ''}" if best else "—"
            axes.text(column, row, text, ha="center", va="center", fontsize=7.5, color=INK)
        axes.set_xlim(-0.5, len(found["photons"]) - 0.5)
        axes.set_ylim(-0.5, len(found["height_nm"]) - 0.5)
        axes.set_xticks(range(len(found["photons"])), [f"{v:g}" for v in found["photons"]])
        axes.set_yticks(range(len(found["height_nm"])), [f"{v:.0f}" for v in found["height_nm"]])
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.set_title(LABELS[name])
        axes.set_xlabel("collected photons")
        if not place:
            axes.set_ylabel("height [nm]")
    patches = [
        Patch(facecolor=colours[who], alpha=0.6, label=f"{letter} {who}")
        for who, letter in letters.items()
    ]
    figure.legend(
        handles=patches, loc="outside lower center", ncols=min(len(patches), 5) or 1, fontsize=8
    )
    return figure


def _recall_figure(found: Mapping[str, Any]) -> Figure:
    figure = new_figure(5.0, 3.9)
    axes = figure.add_subplot()
    x = np.asarray(found["mass_kda"], dtype=float)
    axes.plot(x, _floats(found["matched_filter"]), color=INK, label="best possible")
    for k, (who, lines) in enumerate(found["estimators"].items()):
        ends = np.array([_floats(pair) for pair in lines["recall_ci95"]]).T
        _points(axes, x, _floats(lines["recall"]), ends, k, who)
    axes.set_xscale("log")
    axes.set_xlabel("mass [kDa]")
    axes.set_ylabel("recall")
    _legend(figure)
    return figure


def _reached_figure(part: Mapping[str, Any]) -> Figure:
    """Draw spread over CRB of every estimator, with its interval."""
    names = [p for p in LABELS if _scored(part, p)]
    rows = max(len(_scored(part, p)) for p in names)
    figure = new_figure(3.4 * len(names), 0.8 + 0.27 * rows)
    for place, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), place + 1)
        scored = [(w, e) for w, e in _scored(part, name) if _finite(e.get("spread_over_crb"))]
        at = np.arange(len(scored))[::-1]
        values = _floats([e["spread_over_crb"] for _, e in scored])
        ends = np.array([_floats(e["spread_over_crb_ci95"]) for _, e in scored]).reshape(-1, 2).T
        axes.errorbar(
            values, at, xerr=_reach(values, ends), fmt="o", markersize=4, color=_COLOURS[0]
        )
        axes.axvline(1.0, color=INK, linewidth=1)
        axes.set_yticks(at, [who for who, _ in scored])
        axes.set_xscale("log")
        axes.set_title(f"{LABELS[name]}")
        axes.set_xlabel("spread / CRB")
    return figure


def _points(
    axes: Axes,
    x: np.ndarray[Any, Any],
    values: np.ndarray[Any, Any],
    ends: np.ndarray[Any, Any],
    k: int,
    label: str,
) -> None:
    axes.errorbar(
        x, values, _reach(values, ends), color=_COLOURS[k % len(_COLOURS)],
        fmt=_MARKERS[k % len(_MARKERS)], markersize=4, linewidth=0.8, label=label,
    )  # fmt: skip


def _reach(values: np.ndarray[Any, Any], ends: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.asarray(np.nan_to_num(np.maximum([values - ends[0], ends[1] - values], 0.0)))


def _legend(figure: Figure) -> None:
    known: dict[str, Any] = {}
    for axes in figure.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            known.setdefault(label, handle)
    figure.legend(
        list(known.values()), list(known), loc="outside lower center",
        ncols=min(len(known), 2 + 2 * len(figure.axes)), fontsize=7,
    )  # fmt: skip


def _with(entry: Mapping[str, Any], key: str) -> str:
    value = entry.get(key)
    if not _finite(value):
        return "—"
    low, high = entry[f"{key}_ci95"]
    return f"{number(value)} [{number(low)}, {number(high)}]"


def _finite(value: Any) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value)


def _floats(values: Sequence[float | None]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([math.nan if v is None else v for v in values], dtype=float)
