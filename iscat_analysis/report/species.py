"""Pages of species, of samples beside each other and of equilibria, and their figures.

Everything arrives as what the documents of the commands hold; nothing is computed here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from iscat_analysis.report.numbers import (
    Fact,
    fixed,
    number,
    numeric,
    of,
    percent,
    probability,
    tabulate,
    worded,
)
from iscat_analysis.report.numbers import intervals as interval_columns
from iscat_analysis.report.page import (
    Chart,
    Section,
    curves,
    interval,
    intervals,
    marks,
    notes_section,
    render_document,
)

_CORRECTED = ("corrected_low", "corrected_high")


# ---- Species of a table --------------------------------------------------------------------------


def species_page(found: Mapping[str, Any]) -> str:
    """Make the page of the document ``species``."""
    columns = (
        *interval_columns("mass [kDa]", "mass_kda"),
        *interval_columns("width [kDa]", "width_kda", title="beyond the events' own errors"),
        numeric("events", of("count", fixed, 0), "that were seen"),
        numeric("landing", of("landing", fixed, 0)),
        numeric("leaving", of("leaving", fixed, 0)),
        numeric("detected", of("efficiency", percent, 1), "chance to detect such a particle"),
        *interval_columns("came", "count_corrected", _CORRECTED, title="with those missed"),
        *interval_columns("fraction", "fraction", in_percent=True, title="of all that came"),
    )
    title = f"Species by mass; intervals from {found['draws']} simulated repetitions"
    tables = [tabulate(found["species"], columns, title)]
    charts = list(species_charts(found))
    part = Section("species", "Species", _lead(found), charts=charts, tables=tables)
    sections = [part, *notes_section("notes", "Notes", found["notes"])]
    return render_document("Species by mass", found["source"], sections)


def _lead(found: Mapping[str, Any]) -> str:
    described = [item for item in found["species"] if not item.get("background")]
    count = sum(not item["outlier"] for item in described)
    rivals = [row["delta_bic"] for row in found["selection"] if row["species"] != len(described)]
    text = (
        f"{count} species explain {found['events']} events best (BIC), fitted to the events "
        "themselves, each with its own error."
        if count > 1
        else f"One species explains {found['events']} events best (BIC)."
    )
    if count < len(described):
        text += " What lies apart from them in one or two events is listed, and is no species."
    for item in found["species"]:
        if item.get("background"):
            share = 100 * item["count"] / found["events"]
            text += f" {share:.2g} % of the events are background, which is no species."
    if rivals:
        text += f" The next best number is worse by {number(min(rivals), 2)}."
    if (support := found["support"]) is not None and support == support:
        text += f" In {100 * support:.0f} % of simulated repetitions the same number wins."
    return text


def species_charts(found: Mapping[str, Any]) -> Iterator[Chart]:
    """Show masses and species, and the chance of their detection."""
    if not found["species"]:
        return
    shape = {name: np.asarray(values, float) for name, values in found["curves"].items()}
    mass, efficiency, bars = shape["mass_kda"], shape["efficiency"], found["histogram"]
    low, high = bars["low_kda"], bars["high_kda"]
    width = float(high[0] - low[0])
    density, error = width * shape["density"], width * shape["density_se"]
    ends = [np.maximum(density - 1.96 * error, 0), density + 1.96 * error]
    smooth, missed = "kernel density, 95 %", efficiency.min() < 1
    rungs = [rung["mass_kda"] for rung in found["species"] if rung.get("n")]
    parts = [
        marks("bar", "events", [*low, high[-1]], bars["count"]),
        marks("line", "species", mass, width * shape["model"]),
        marks("band", smooth, mass, ends=ends),
        marks("line", smooth, mass, density),
        *([marks("rule", "steps of the ladder", rungs)] if rungs else []),
    ]
    if missed:
        corrected, label = width * shape["model_corrected"], "corrected for what was missed"
        parts.append(marks("line", label, mass, corrected, dash="dashed"))
    yield curves("species", parts, {"width": f"{width:g}"})
    if missed:
        known = [s for s in found["species"] if not s.get("background")]
        at, chance = ([s[name] for s in known] for name in ("mass_kda", "efficiency"))
        points = marks("point", "species", at, chance)
        yield curves("detection", [points, marks("line", "all masses", mass, efficiency)])


# ---- Samples and equilibria ----------------------------------------------------------------------


def comparison_page(found: Mapping[str, Any], histograms: Sequence[Mapping[str, Any]]) -> str:
    """Make the page of the document ``species_comparison``."""
    pairs = found["comparisons"]
    names = _named([found["source"], *(pair["source"] for pair in pairs)])
    tests = {"same": "one sample", "same_masses": "same masses", "same_fractions": "same fractions"}

    def chance(name: str) -> Any:
        return lambda row: probability(row[name]["p_value"])

    columns = (
        worded("sample", of("source", names.get)),
        *(numeric(f"p, {label}", chance(name)) for name, label in tests.items()),
    )
    tables = [tabulate(pairs, columns, f"Compared with {names[found['source']]}")]
    charts = list(comparison_charts(pairs, histograms))
    part = Section("comparison", "Comparison", charts=charts, tables=tables)
    sections = [part, *notes_section("notes", "Notes", found["notes"])]
    return render_document("Samples beside each other", found["source"], sections)


def comparison_charts(
    pairs: Sequence[Mapping[str, Any]], histograms: Sequence[Mapping[str, Any]]
) -> Iterator[Chart]:
    """Show mass distributions over each other, shifts and differences of fractions."""
    names = _named([one["source"] for one in (*histograms, *pairs)])
    edges = np.asarray(histograms[0]["edges"], float)
    middles, width = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    reference, *others = histograms
    parts = [marks("bar", names[reference["source"]], edges, reference["share"])]
    parts += [marks("line", names[one["source"]], middles, one["share"]) for one in others]
    yield curves("compared", parts, {"width": number(width, 2)})
    for name, key in (("shifts", "shift_kda"), ("fractions", "difference")):
        stem = key.removesuffix("_kda")
        rows = [
            interval(
                names[pair["source"]],
                one[key],
                (one[f"{stem}_low"], one[f"{stem}_high"]),
                series=f"{number(one['mass_kda'])} kDa",
                lane=f"{k:02d}",
            )
            for pair in pairs
            for k, one in enumerate(pair["species"])
        ]
        yield intervals(name, rows)


def _named(sources: Sequence[str]) -> dict[str, str]:
    """Name tables by their files, or folders where the file is named as all are."""
    paths = {source: PurePath(source) for source in sources}
    names = {
        source: path.parent.name if path.stem == "fits" and path.parent.name else path.name
        for source, path in paths.items()
    }
    return names if len(set(names.values())) == len(names) else {one: one for one in names}


def binding_page(found: Mapping[str, Any]) -> str:
    """Make the page of the document ``kd``."""
    _, reaction, complexes = _REACTIONS[found["model"]]
    low, high = found["kd_low"], found["kd_high"]
    ends = f"95 %: {number(low)} to {'∞' if high is None else number(high)}"
    facts = [
        Fact("K_D", number(found["kd_nm"]), "nM", ends),
        Fact("Movies or tables", str(len(found["samples"]))),
        Fact("Model", f"p = {probability(found['p_value'])}", note=reaction),
    ]
    totals = [key for key in ("concentration_nm", "a_nm", "b_nm") if key in found["samples"][0]]
    names = _named([row["path"] for row in found["samples"]])
    columns = (
        worded("table", of("path", names.get)),
        *(numeric(key.replace("_nm", " [nM]"), of(key)) for key in totals),
        numeric("events", of("events", fixed, 0)),
        *interval_columns(complexes, "complexes", in_percent=True),
        numeric("by K_D", of("predicted", percent)),
        numeric("pull", of("pull", number, 2), "distance in standard errors"),
    )
    tables = [tabulate(found["samples"], columns, f"Share of {complexes} among the particles")]
    part = Section("kd", "Equilibrium", "", facts, list(binding_charts(found)), tables)
    sections = [part, *notes_section("notes", "Notes", found["notes"])]
    return render_document("Equilibrium constant", found["source"], sections)


_REACTIONS = {"dimer": ("monomers", "2 M ⇌ D", "dimers"), "ab": ("A and B", "A + B ⇌ AB", "AB")}


def binding_charts(found: Mapping[str, Any], of: str = "", condition: str = "") -> Iterator[Chart]:
    """Show fractions of complexes with their intervals, the equilibrium and the profile."""
    partners, _, complexes = _REACTIONS[found["model"]]
    dimer, rows = found["model"] == "dimer", found["samples"]
    at = [row["concentration_nm"] if dimer else row["a_nm"] + row["b_nm"] for row in rows]
    share, low, high, predicted = (
        np.array([row.get(key) for row in rows], float)
        for key in ("complexes", "complexes_low", "complexes_high", "predicted")
    )
    known = found["curve"]
    line = (
        marks("line", "equilibrium", known["concentration_nm"], known["complexes"])
        if dimer
        else marks("point", "equilibrium", at, predicted)
    )
    words = {"title": f"K_D, {condition}" if condition else "K_D", "partners": partners}
    points = marks("point", "tables, 95 %", at, share, [low, high])
    yield curves("kd", [points, line], {**words, "complexes": complexes}, of=of)
    limit, best = 3.84, found["kd_nm"]
    log_kd, lost = (np.asarray(found["profile"][key], float) for key in ("ln_kd_nm", "deviance"))
    inside = lost <= 2.2 * limit
    kd, lost = np.exp(log_kd[inside]), lost[inside]
    parts = [marks("point", "profile", kd, lost), marks("rule", "best", [best])]
    if kd.size > 1:
        root = np.sign(kd - best) * np.sqrt(lost)
        fine = np.geomspace(kd[0], kd[-1], 100)
        parts.append(marks("line", "profile", fine, np.interp(np.log(fine), np.log(kd), root) ** 2))
        parts.append(marks("line", "95 %", kd[[0, -1]], [limit] * 2, dash="dashed"))
    yield curves("profile", parts, {**words, "span": [0, 2.2 * limit]}, of=of)
