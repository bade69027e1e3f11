"""The page of a batch: what many movies say, side by side, on common axes and in the size of print.

Everything arrives as the tables that are written beside it; nothing is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.records import FloatArray
from iscat_analysis.report.numbers import (
    Column,
    Fact,
    Table,
    fixed,
    link,
    number,
    numeric,
    of,
    percent,
    plain,
    probability,
    tabulate,
    unbroken,
    worded,
)
from iscat_analysis.report.numbers import intervals as interval_columns
from iscat_analysis.report.page import (
    PALETTE,
    Chart,
    Row,
    Section,
    curves,
    interval,
    intervals,
    marks,
    render_document,
)
from iscat_analysis.report.species import binding_charts
from iscat_analysis.schemas import jsonable
from iscat_analysis.units import count

LONG = 30
"""Rows above which a table scrolls, and can be narrowed; and samples in one figure of stacked
distributions."""

_SHARE = "of the particles that came, corrected for those that were missed; without outliers"
_HOLM = "corrected for the number of comparisons"


@dataclass(frozen=True, eq=False)
class Curve:
    """Masses of one movie."""

    movie: str
    sample: str
    group: str
    masses_kda: FloatArray
    grid_kda: FloatArray
    density: FloatArray


@dataclass(frozen=True, eq=False)
class BatchContents:
    """The tables of a batch, as its page shows them.

    Attributes
    ----------
    movies, species, shifts : DataFrame
        As they are written, with the panel of each row in a column ``group``.
    curves : sequence of Curve
        Masses of all movies.
    equilibria : sequence of (str, mapping, sequence of str)
        Condition, document ``kd`` and remarks of each series.
    calibrations : sequence of (str, str, str)
        What was calibrated, by what, and its page.
    failed : sequence of (str, str)
        What was not analysed, and why.
    mass_label : str
        Heading of masses.
    """

    movies: pd.DataFrame
    species: pd.DataFrame
    shifts: pd.DataFrame
    curves: Sequence[Curve]
    equilibria: Sequence[tuple[str, Mapping[str, Any], Sequence[str]]]
    calibrations: Sequence[tuple[str, str, str]]
    failed: Sequence[tuple[str, str]]
    mass_label: str

    @property
    def links(self) -> dict[str, Any]:
        """Every movie's name, a link to its report where there is one."""
        pages = zip(self.movies["movie"], self.movies["report"], strict=True)
        return {name: link(report, name) for name, report in pages}

    @property
    def labels(self) -> list[Column]:
        """Columns that say which movie a row is of."""
        links = self.links
        return [
            worded("movie", lambda row: links.get(row["movie"], row["movie"])),
            *_SAMPLE,
            numeric("c [nM]", "concentration_nm"),
        ]


_SAMPLE = (worded("sample", of("sample", unbroken)), worded("condition", of("condition", unbroken)))


def batch_page(title: str, subtitle: str, batch: BatchContents) -> str:
    """Make the page of a batch."""
    sections = [_overview(batch)]
    if masses := list(_mass_charts(batch)):
        sections.append(Section("masses", "Masses", charts=masses))
    if len(batch.species):
        sections.append(_species_section(batch))
    if batch.equilibria:
        sections.append(_equilibria(batch))
    if batch.movies["rate"].notna().any():
        sections.append(_landing(batch))
    sections.append(_quality(batch))
    return render_document(title, subtitle, sections)


def summary_line(movies: pd.DataFrame) -> str:
    """Describe the batch in one line."""
    return f"{count(len(movies), 'movie')} of {count(movies['sample'].nunique(), 'sample')}"


def _table(rows: pd.DataFrame, columns: Sequence[Column], caption: str = "") -> Table:
    """Make a table of a data frame, which scrolls if it is long."""
    made = tabulate(rows.to_dict("records"), columns, caption)
    return replace(made, tall=len(rows) > LONG)


# ---- Sections ------------------------------------------------------------------------------------


def _overview(batch: BatchContents) -> Section:
    movies = batch.movies
    done = movies[movies["state"] == "done"]
    analysed = done[done["role"] != "flat"]
    cautioned = int((done["cautions"].fillna("") != "").sum())
    whole = f"of {len(movies)}" if len(done) < len(movies) else "all of the table"
    facts = [
        Fact("Movies", str(len(done)), note=whole),
        Fact("Samples", str(analysed["sample"].nunique())),
        Fact("Events", str(int(analysed["events"].sum()))),
        Fact("With cautions", str(cautioned), note="see the quality"),
    ]
    failed = tabulate(batch.failed, (worded("not analysed", 0), worded("why", 1)))
    columns = worded("calibration", lambda row: link(row[2], row[0])), worded("from", 1)
    tables = [*([failed] if batch.failed else []), tabulate(batch.calibrations, columns)]
    return Section("day", "The day", facts=facts, tables=tables)


def _species_section(batch: BatchContents) -> Section:
    tables = [_shift_table(batch)] if len(batch.shifts) else []
    return Section(
        "species",
        "Species",
        charts=list(_species_charts(batch)),
        notes=[_species_note(batch.shifts)],
        tables=[*tables, _species_table(batch)],
    )


def _species_note(shifts: pd.DataFrame) -> str:
    note = (
        "Species of different movies are one kind where their masses are within 10 % or three "
        "standard errors."
    )
    if shifts.empty:
        return note
    note += (
        f" Samples are compared with {shifts['reference'].iloc[0]}, the first of the table: p is "
        "the chance of at least such a shift where there is none, corrected for the number of "
        "comparisons (Holm). The error of the mass scale, which all movies of the day share, is "
        "not in the shifts."
    )
    if shifts["scatter"].isna().any():
        note += (
            " Kinds without replicates are compared with their counting errors alone, which do not "
            "hold how movies of one sample differ: record replicates before believing a small p."
        )
    return note


def _shift_table(batch: BatchContents) -> Table:
    """Lay out one row for each kind and sample: mass, shift, share, shift."""
    of_kind = batch.shifts.set_index("quantity")
    masses, shares = (of_kind.loc[[name]] for name in ("mass_kda", "share"))
    both = masses.merge(shares, on=["kind", "sample"], suffixes=("", "_of_share"))

    def columns(label: str, shift: str, end: str, title: str) -> list[Column]:
        is_share = bool(end)
        ends = (f"low{end}", f"high{end}")
        moved = (f"shift_low{end}", f"shift_high{end}")
        return [
            *interval_columns(label, f"value{end}", ends, in_percent=is_share, title=title),
            *interval_columns(shift, f"shift{end}", moved, in_percent=is_share),
            numeric("p", of(f"p_holm{end}", probability), _HOLM),
        ]

    every = [
        numeric("kind [kDa]", of("kind_mass_kda", "{:.3g}".format)),
        *_SAMPLE,
        numeric("movies", of("movies", int)),
        *columns(batch.mass_label, "shift [kDa]", "", "intervals with the scatter between movies"),
        *columns("share", "shift", "_of_share", _SHARE),
    ]
    return _table(both, every, "Species by sample, and their shifts")


def _species_table(batch: BatchContents) -> Table:
    def kind(row: Any) -> str:
        return "apart" if row["outlier"] else str(row["kind"])

    columns = [
        worded("kind", kind, "one number for species of one mass; apart: an outlier"),
        *batch.labels,
        *interval_columns(batch.mass_label, "mass_kda"),
        *interval_columns("width [kDa]", "width_kda", title="beyond the events' errors"),
        numeric("events", of("count", fixed, 0)),
        *interval_columns("share", "share", in_percent=True, title=_SHARE),
        numeric("detected", of("efficiency", percent, 0)),
    ]
    return _table(batch.species, columns, "Species by movie")


def _equilibria(batch: BatchContents) -> Section:
    """Tabulate K_D of every series, and whether the movies follow the equilibrium."""
    charts = [
        chart
        for n, (condition, found, _) in enumerate(batch.equilibria, 1)
        for chart in binding_charts(jsonable(found), f"-{n}", condition)
    ]

    def ends(row: Any) -> str:
        high = number(row["kd_high"]) if math.isfinite(row["kd_high"]) else "∞"
        return f"{number(row['kd_low'])} to {high}"

    reactions = {"dimer": "2 M ⇌ D", "ab": "A + B ⇌ AB"}
    columns = [
        worded("condition", lambda row: row["condition"] or "—"),
        worded("reaction", lambda row: reactions[row["model"]]),
        numeric("movies", lambda row: len(row["samples"])),
        numeric("K_D [nM]", of("kd_nm")),
        numeric("95 %", ends, "of the profile likelihood"),
        numeric("p", of("p_value", probability), "whether the movies follow the equilibrium"),
        worded("remarks", lambda row: "; ".join(row["remarks"]) or "none"),
    ]
    rows = [
        {**found, "condition": condition, "remarks": remarks}
        for condition, found, remarks in batch.equilibria
    ]
    tables = [tabulate(rows, columns)]
    return Section("equilibrium", "Equilibrium", charts=charts, tables=tables)


def _landing(batch: BatchContents) -> Section:
    known = batch.movies[batch.movies["rate"].notna()]
    per = f"landings per {known['rate_unit'].iloc[0]}"
    columns = [
        *batch.labels,
        numeric("landed", of("landings", int)),
        numeric("left", of("leavings", int)),
        *interval_columns(per, "rate", ("rate_from", "rate_to")),
    ]
    tables = [_table(known, columns, "Landings")]
    return Section("landing", "Landing", charts=[_rates_chart(batch.movies)], tables=tables)


def _quality(batch: BatchContents) -> Section:
    """Tabulate the quality of every movie."""
    links, states = batch.links, {"done": "done", "failed": "failed", "missing": "not yet"}

    def cautions(row: Any) -> str:
        return row["cautions" if row["state"] == "done" else "why"] or "none"

    def ok(row: Any) -> str:
        return percent(row["ok"] / row["events"] if row["events"] else None, 1)

    columns = [
        worded("movie", lambda row: links[row["movie"]]),
        worded("role", "role"),
        _SAMPLE[0],
        *(worded(name, of(name, plain)) for name in batch.movies.attrs.get("further", ())),
        worded("state", of("state", states.get)),
        worded("cautions", cautions),
        worded("answer", of("answer", plain)),
        numeric("events", of("events", fixed, 0)),
        numeric("ok", ok, "events with status ok"),
        numeric("noise", of("noise_over_shot", fixed, 2), "variance over shot noise"),
        numeric("drift [px]", of("drift_px", fixed, 2), "of the fixed pattern"),
        numeric("focus [nm]", of("focus_shift_nm", fixed, 0), "from the day's, if measured"),
        numeric("p < 0.01", of("small_p_values", percent, 1), "1 % where the model holds"),
        numeric("spread/CRB", of("repeat_over_crb", fixed, 2), "between parts of the frames"),
        worded("standards", of("standards_seen", unbroken)),
        worded("optics", of("optics", unbroken, 80)),
        worded("mass scale", of("mass_scale", unbroken, 80)),
        numeric("beyond", of("outside_standards", percent, 1), "masses beyond the standards"),
    ]
    return Section("quality", "Movies and their quality", tables=[_table(batch.movies, columns)])


# ---- Figures -------------------------------------------------------------------------------------


def _mass_charts(batch: BatchContents) -> Iterator[Chart]:
    """Show the masses of all movies: densities over each other, and shares by sample."""
    shown = [curve for curve in batch.curves if curve.masses_kda.size]
    if not shown:
        return
    species = batch.species[~batch.species["outlier"]]
    # the axis of masses ends beyond every species and almost all events
    almost = np.quantile(np.concatenate([curve.masses_kda for curve in shown]), 0.995)
    limit = 1.1 * float(np.fmax(almost, species["mass_kda"].max() if len(species) else 0))
    groups = list(dict.fromkeys(curve.group for curve in shown))
    several = len(groups) > 1
    parts = []
    for curve in shown:
        inside = curve.grid_kda <= limit
        at, density = curve.grid_kda[inside], 100 * curve.density[inside] / curve.masses_kda.size
        panel = curve.group or ("no condition" if several else "")
        parts.append(marks("line", curve.sample, at, density, panel=panel))
    words = {"x": batch.mass_label, "span": [0, limit], "columns": min(len(groups), 2)}
    yield curves("overlaid", parts, words)
    samples = sorted(
        dict.fromkeys((curve.group, curve.sample) for curve in shown),
        key=lambda pair: groups.index(pair[0]),
    )
    edges = np.linspace(0, limit, 61)
    for start in range(0, len(samples), LONG):
        parts = []
        for group, sample in samples[start : start + LONG]:
            own = [c.masses_kda for c in shown if (c.group, c.sample) == (group, sample)]
            mean = np.mean([100 * np.histogram(m, edges)[0] / m.size for m in own], axis=0)
            name = f"{group}: {sample}" if several and group not in ("", sample) else sample
            panel = f"{name}  ({sum(masses.size for masses in own)})"
            parts.append(marks("bar", group, edges, mean, panel=panel))
        part = f", {start // LONG + 1}" if start else ""
        yield curves("stacked", parts, {**words, "part": part}, of=part.replace(", ", "-"))


def _by_sample(table: pd.DataFrame, names: Sequence[str], series: Sequence[str]) -> list[Row]:
    """Make a row for each value; movies of one sample lie below each other."""
    lanes = table.groupby("sample")["movie"].transform(lambda m: pd.factorize(m)[0]).tolist()
    values = table[list(names)].to_numpy(float).tolist()
    return [
        interval(sample, value, ends, series=each, lane=f"{lane:03d}")
        for sample, lane, each, (value, *ends) in zip(
            table["sample"], lanes, series, values, strict=True
        )
    ]


def _species_charts(batch: BatchContents) -> Iterator[Chart]:
    """Show mass and share of every species."""
    species = batch.species[~batch.species["outlier"]]
    if species.empty:
        return
    mean = species.groupby("kind")["mass_kda"].mean()
    kinds = {kind: f"{mean[kind]:.3g} kDa" for kind in sorted(species["kind"].unique())}
    colours = dict(zip(kinds.values(), PALETTE, strict=False)) if len(kinds) <= len(PALETTE) else {}
    masses, names = species["mass_kda"], ("mass_kda", "mass_low", "mass_high")
    log = "x" if masses.max() > 5 * max(masses.min(), 1e-9) else ""
    rows = _by_sample(species, names, species["kind"].map(kinds))
    words = {"x": batch.mass_label, "log": log, "colours": colours}
    yield intervals("species-masses", rows, words)
    known = species[species["concentration_nm"] > 0]
    if known["concentration_nm"].nunique() > 1:
        parts = []
        for (group, kind), rows in known.groupby(["group", "kind"], sort=False):
            value, *ends = rows[["share", "share_low", "share_high"]].to_numpy(float).T
            at = rows["concentration_nm"]
            parts.append(marks("point", kinds[kind], at, value, ends, panel=str(group)))
        yield curves("shares", parts, words)


def _rates_chart(movies: pd.DataFrame) -> Chart:
    """Show how many landed per time, against concentration where it is known, else the sample."""
    rated = movies[movies["rate"].notna()]
    known = rated[rated["concentration_nm"] > 0]
    label = f"landings per {movies['rate_unit'].iloc[0]}"
    names = ["rate", "rate_from", "rate_to"]
    if known["concentration_nm"].nunique() < 2:
        groups = [group or "no condition" for group in rated["group"]]
        rows = _by_sample(rated, names, groups)
        return intervals("rates", rows, {"x": label, "y": "", "log": ""})
    parts = []
    for group, rows in known.groupby("group", sort=False):
        value, *ends = rows[names].to_numpy(float).T
        at = rows["concentration_nm"]
        parts.append(marks("point", str(group) or "no condition", at, value, ends))
    blank = rated[rated["role"] == "blank"]
    if len(blank):
        across = [known["concentration_nm"].min(), known["concentration_nm"].max()]
        level = [float(blank["rate"].mean())] * 2
        parts.append(marks("line", "blank", across, level, dash="dotted"))
    return curves("rates", parts, {"x": "concentration [nM]", "y": label, "log": "x"})
