"""Page and figures of `iscat benchmark`: what was achieved, beside what can be.

Everything arrives as the content of ``benchmark.json``; nothing is computed here but what is shown.
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
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from iscat_analysis.report.estimators import (
    contest_figures,
    contest_parts,
    contest_sections,
    part_figures,
)
from iscat_analysis.report.numbers import LABELS, UNITS
from iscat_analysis.report.page import render_page
from iscat_analysis.report.style import BLUE, INK, VERMILLION, new_figure, publish

BENCHMARK_NAMES = frozenset(
    {"benchmark.json", "benchmark.html", "benchmark.bib", "config.toml", "figures"}
)
"""Everything `write_benchmark` leaves in its folder."""

ENOUGH_RANKS = 100
"""Posteriors below which the uniformity of their ranks is not tested: a p-value would mislead."""

MODES = ("mass", "size", "localize", "joint")

_LABELS = {**LABELS, "diameter_nm": "diameter"}
_UNITS = {**UNITS, "diameter_nm": "nm"}
_TITLES = {
    "mass": "Mass: position and mass, height known",
    "size": "Size: position in three dimensions and diameter of a sphere",
    "localize": "Localize: position in three dimensions, mass or diameter known",
    "joint": "Joint: position in three dimensions and mass",
}
_SCHEMES = {"iscat": "iSCAT", "cobri": "COBRI", "darkfield": "dark field"}
_BASELINES = {"gaussian": "Gaussian least squares", "peak": "peak contrast"}
_FIGURES = {
    "photons": "Spread against photons",
    "heights": "Spread against height",
    "pulls": "Pulls: (estimate − truth) / σ",
    "ranks": "Ranks of the truth among the draws of its posterior",
}
_AXES = {"photons": ("collected scattered photons", "log"), "z": ("height [nm]", "linear")}


def render_benchmark(study: Mapping[str, Any], *, folder: Path | None = None) -> str:
    """Make the page of a study, and write its figures."""
    others = "estimators" in study
    figures = benchmark_figures(study)
    if others:
        figures = chain(figures, contest_figures(study), part_figures(_named_parts(study)))
    drawn = publish(figures, folder)
    sections = [*(contest_sections(study, drawn) if others else ()), _summary(study)]
    sections += [_mode_section(study, mode, drawn) for mode in MODES if mode in study]
    sections.append(
        {
            "id": "how",
            "title": "How this was measured",
            "notes": [
                "Photoelectrons of the fitted region are drawn from the expected images with "
                "Poisson statistics and read noise, before and after landing, and fitted by the "
                "code that fits movies, from starts up to a pixel off, at any height of the range "
                "and with a mass up to half as large again. The spread is over fits that neither "
                "failed nor were flagged for an ambiguous height or diameter.",
                "The Cramér–Rao bound (CRB) holds for the same free parameters, frames, camera "
                "noise and measured background; the quantum bound (QCRB) for the collected "
                "scattered light and any measurement of it.",
                "Confidence intervals are 95 %. Gaussian least squares and peak contrast see the "
                "contrast image; their masses are calibrated on the noiseless particle itself.",
            ],
            "tables": [
                {
                    "caption": "Versions",
                    "columns": ["package", "version"],
                    "rows": [list(pair) for pair in study["versions"].items()],
                }
            ],
            "code": f"{study['command']}\n\n{study['config']}",
        }
    )
    scheme = _SCHEMES.get(study["scheme"], study["scheme"])
    return render_page(
        "document.html",
        {
            "title": "Estimators beside their bounds",
            "subtitle": f"{scheme}: {study['trials']} repetitions of one experiment in each mode, "
            f"seed {study['seed']}",
            "sections": sections,
            "nav": [(s["id"], s.get("short", s["title"])) for s in sections],
            "footer": f"iscat-analysis {study['versions']['iscat-analysis']}",
        },
    )


def _named_parts(study: Mapping[str, Any]) -> dict[str, Any]:
    return {f"estimators-{mode}": part for mode, part in contest_parts(study).items()}


def _summary(study: Mapping[str, Any]) -> dict[str, Any]:
    facts = []
    for mode in MODES:
        if mode not in study:
            continue
        names = _scored(study[mode])
        ratios = [study[mode][name]["spread_over_crb"] for name in names]
        finite = [r for r in ratios if math.isfinite(r)]
        low, high = (min(finite), max(finite)) if finite else (math.nan, math.nan)
        facts.append(
            {
                "label": f"spread / CRB, {mode}",
                "value": f"{low:.2f}–{high:.2f}" if finite else "—",
                "note": f"over {', '.join(_LABELS[n] for n in names)}; "
                f"{study[mode]['failed']} of {study[mode]['trials']} fits failed",
            }
        )
    rows = []
    for mode in MODES:
        for name in _scored(study[mode]) if mode in study else ():
            entry = study[mode][name]
            baselines = entry.get("baselines", {})
            rows.append(
                [
                    mode,
                    f"{_LABELS[name]} [{_UNITS[name]}]",
                    _with(entry["spread_over_crb"], entry["spread_over_crb_ci95"]),
                    _plain(entry["spread_over_qcrb"]),
                    *(
                        _plain(baselines[b]["rmse_over_crb"]) if b in baselines else "—"
                        for b in _BASELINES
                    ),
                ]
            )
    return {
        "id": "summary",
        "title": "Summary",
        "lead": "A ratio of 1 to the CRB means that no unbiased estimator can do better with these "
        "counts. The last columns show what other estimators make of the same counts: "
        "root-mean-square error over the CRB.",
        "facts": facts,
        "tables": [
            {
                "caption": "Every free parameter in every mode",
                "columns": [
                    "mode",
                    "parameter",
                    _number("spread / CRB", "with its 95 % confidence interval"),
                    _number("spread / QCRB"),
                    *(_number(f"{label} / CRB") for label in _BASELINES.values()),
                ],
                "rows": rows,
            }
        ],
    }


def _scored(entry: Mapping[str, Any]) -> list[str]:
    """Name the parameters of a mode that have a score."""
    return [name for name in _LABELS if name in entry]


def _mode_section(
    study: Mapping[str, Any], mode: str, drawn: Mapping[str, Markup]
) -> dict[str, Any]:
    entry, at = study[mode], study[mode]["at"]
    names = _scored(entry)
    charts = [
        {"id": f"{mode}-{stem}", "title": title, "svg": drawn[f"{stem}_{mode}"], "wide": True}
        for stem, title in _FIGURES.items()
        if f"{stem}_{mode}" in drawn
    ]
    flags = (
        ", ".join(f"{n} {flag.replace('_', ' ')}" for flag, n in entry["flagged"].items() if n)
        or "none"
    )
    diameter = at.get("diameter_nm")
    what = f"{at['mass_kda']:,.0f} kDa" if diameter is None else f"A sphere of {diameter:.4g} nm"
    lead = (
        f"{what} at z = {at['z_nm']:.3g} nm, focus at {at['focus_nm']:.0f} nm; "
        f"{at['n_scattered']['collected']:,.0f} scattered photons collected; "
        f"{at['pixels']} × {at['pixels']} pixels of {at['pixel_size_nm']:.4g} nm; "
        f"{at['n_before']} frames before and {at['n_after']} after landing. "
        f"{entry['fits_per_second']:.0f} fits per second of processor time; flagged: {flags}."
    )
    return {
        "id": mode,
        "short": mode.capitalize(),
        "title": _TITLES[mode],
        "lead": lead.replace("-", "−"),
        "tables": [
            {
                "caption": "Achieved and possible",
                "columns": [
                    "parameter",
                    _number("truth"),
                    _number("bias"),
                    _number("spread"),
                    _number("CRB"),
                    _number("QCRB"),
                    _number("pull mean"),
                    _number("pull σ"),
                ],
                "rows": [_row(entry, at, name) for name in names],
            },
            {
                "caption": "Truths inside the stated intervals",
                "columns": [
                    "parameter",
                    _number("68 %", "share of truths within one stated σ"),
                    _number("95 %", "share of truths within 1.96 stated σ"),
                    _number("posterior 68 %", "share of truths inside the credible interval"),
                    _number("posterior 95 %", "share of truths inside the credible interval"),
                ],
                "rows": [_coverage_row(entry, name) for name in names],
            },
        ],
        "charts": charts,
    }


def _row(entry: Mapping[str, Any], at: Mapping[str, Any], name: str) -> list[Any]:
    e = entry[name]
    return [
        f"{_LABELS[name]} [{_UNITS[name]}]",
        at[name],
        _with_error(e["bias"], e["bias_se"]),
        _with(e["spread"], e["spread_ci95"]),
        _plain(e["crb"]),
        _plain(e["qcrb"]),
        _plain(e["pull_mean"], 2),
        _plain(e["pull_std"]),
    ]


def _coverage_row(entry: Mapping[str, Any], name: str) -> list[Any]:
    kinds = ("coverage68", "coverage95", "posterior_coverage68", "posterior_coverage95")
    shares = [_percent(entry[name][kind], entry[name][f"{kind}_ci95"]) for kind in kinds]
    return [f"{_LABELS[name]} [{_UNITS[name]}]", *shares]


def benchmark_figures(study: Mapping[str, Any]) -> Iterator[tuple[str, Figure]]:
    """Draw the figures."""
    for mode in MODES:
        if mode not in study:
            continue
        names = _scored(study[mode])
        for axis, stem in (("photons", "photons"), ("z", "heights")):
            curve = study["curves"][axis][mode]
            yield f"{stem}_{mode}", _panels(names, partial(_draw_curve, axis, curve))
        for kind, draw in (("pulls", _draw_pulls), ("ranks", _draw_ranks)):
            bins = study["histograms"][kind][mode]
            if bins:
                yield f"{kind}_{mode}", _panels(names, partial(draw, bins))


def _panels(names: Sequence[str], draw: Callable[[Axes, str], None]) -> Figure:
    figure = new_figure(2.9 * len(names), 2.9)
    for position, name in enumerate(names):
        axes = figure.add_subplot(1, len(names), position + 1)
        draw(axes, name)
        axes.set_title(f"{_LABELS[name]} [{_UNITS[name]}]")
        if position:
            axes.set_ylabel("")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=len(labels), fontsize=8)
    return figure


def _draw_curve(axis: str, curve: Mapping[str, Any], axes: Axes, name: str) -> None:
    label, scale = _AXES[axis]
    x, line = np.asarray(curve["at"], float), curve[name]
    fine = curve.get("bounds", curve)
    at = np.asarray(fine["at"], float)
    axes.plot(at, _floats(fine[name]["crb"]), color=INK, label="CRB")
    axes.plot(at, _floats(fine[name]["qcrb"]), color=BLUE, linestyle="--", label="QCRB")
    spread = _floats(line["spread"])
    ends = np.array([_floats(pair) for pair in line["spread_ci95"]]).T
    reach = np.maximum(np.stack([spread - ends[0], ends[1] - spread]), 0)
    axes.errorbar(x, spread, reach, color=VERMILLION, fmt="o", markersize=4, label="spread")
    axes.set_xscale(scale)
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(10, subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel(label)
    axes.set_ylabel("standard deviation")


def _draw_pulls(found: Mapping[str, Any], axes: Axes, name: str) -> None:
    bins = found[name]
    edges = np.asarray(bins["edges"], float)
    axes.stairs(_floats(bins["counts"]), edges, fill=True, color=VERMILLION, label="fits")
    axes.plot((edges[1:] + edges[:-1]) / 2, _floats(bins["expected"]), color=INK, label="normal")
    axes.set_ylim(0, 1.25 * max(_floats(bins["counts"]).max(), 1.0))
    axes.set_xlabel("(estimate − truth) / σ")
    axes.set_ylabel("fits")


def _draw_ranks(found: Mapping[str, Any], axes: Axes, name: str) -> None:
    bins = found[name]
    counts = _floats(bins["counts"])
    edges = np.linspace(0, bins["possible"], counts.size + 1)
    axes.stairs(counts, edges, fill=True, color=BLUE, label="posteriors")
    axes.axhline(float(counts.mean()), color=INK, linewidth=1, label="uniform")
    if counts.sum() >= ENOUGH_RANKS:
        axes.set_title(f"p = {bins['p_value']:.2g}", loc="right", fontsize=8)
    axes.set_ylim(0, 1.25 * max(counts.max(), 1.0))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_xlabel("rank of the truth")
    axes.set_ylabel("posteriors")


def _floats(values: Sequence[float | None]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([math.nan if v is None else v for v in values], dtype=float)


def _number(label: str, title: str | None = None) -> dict[str, Any]:
    return {"label": label, "numeric": True, "title": title}


def _plain(value: float | None, digits: int = 3) -> str:
    if value is None or not math.isfinite(value):
        return "—"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        size = 0 if value == 0 else math.floor(math.log10(abs(value)))
        return f"{value:.{max(0, digits - 1 - size)}f}".replace("-", "−")
    return f"{value:.{digits}g}".replace("-", "−")


def _percent(value: float | None, interval: Sequence[float]) -> str:
    if value is None or not math.isfinite(value):
        return "—"
    low, high = (f"{100 * end:.1f}" for end in interval)
    return f"{100 * value:.1f} % [{low}, {high}]"


def _with_error(value: float | None, error: float) -> str:
    if value is None or not math.isfinite(value):
        return "—"
    return f"{_plain(value, 2)} ± {_plain(error, 2)}"


def _with(value: float | None, interval: Sequence[float]) -> str:
    if value is None or not math.isfinite(value):
        return "—"
    return f"{_plain(value)} [{_plain(interval[0])}, {_plain(interval[1])}]"
