"""The page of a batch: what many movies say, side by side, on common axes and in the size of print.

Everything arrives as the tables that are written beside it; nothing is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from iscat_analysis.records import FloatArray
from iscat_analysis.report.numbers import (
    Column,
    Fact,
    Table,
    fixed,
    intervals,
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
from iscat_analysis.report.page import Chart, Section, render_document
from iscat_analysis.report.species import binding_figure
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    GRID,
    INK,
    PURPLE,
    VERMILLION,
    new_figure,
    one_panel,
    plain_log,
    publish,
    whiskers,
)
from iscat_analysis.schemas import jsonable
from iscat_analysis.text import in_figure
from iscat_analysis.units import count

LONG = 30
"""Rows above which a table scrolls, and can be narrowed; and samples in one figure of stacked
distributions."""

_SHARE = "of the particles that came, corrected for those that were missed; without outliers"
_HOLM = "corrected for the number of comparisons"

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
_WIDTH = 7.2  # inches: two columns of a journal
_COLORS = (BLUE, VERMILLION, "#009E73", PURPLE, "#56B4E9", "#E69F00", GREY)
_NAMED = 8  # entries of a legend


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


def batch_page(title: str, subtitle: str, batch: BatchContents, folder: Path | None = None) -> str:
    """Make the page of a batch, and write its figures."""
    drawn = publish(_figures(batch), folder, printed=True)
    masses = _charts(drawn, "overlaid", "stacked")
    sections = [_overview(batch)]
    if masses:
        sections.append(Section("masses", "Masses", charts=masses))
    if len(batch.species):
        sections.append(_species_section(batch, drawn))
    if batch.equilibria:
        sections.append(_equilibria(batch, drawn))
    if batch.movies["rate"].notna().any():
        sections.append(_landing(batch, drawn))
    sections.append(_quality(batch))
    return render_document(title, subtitle, sections)


def summary_line(movies: pd.DataFrame) -> str:
    """Describe the batch in one line."""
    return f"{count(len(movies), 'movie')} of {count(movies['sample'].nunique(), 'sample')}"


def _table(rows: pd.DataFrame, columns: Sequence[Column], caption: str = "") -> Table:
    """Make a table of a data frame, which scrolls if it is long."""
    made = tabulate(rows.to_dict("records"), columns, caption)
    return replace(made, tall=len(rows) > LONG)


def _charts(drawn: Mapping[str, Markup], *kinds: str) -> list[Chart]:
    charts = []
    for figure, svg in drawn.items():
        kind, _, nth = figure.partition("_")
        if kind in kinds:
            title, caption = _CHARTS[kind]
            name = f"figure-{figure.replace('_', '-')}"
            words = (f"{title}, {nth}", "") if nth else (title, caption)
            charts.append(Chart(name, words[0], svg, words[1], wide=True))
    return charts


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


def _species_section(batch: BatchContents, drawn: Mapping[str, Markup]) -> Section:
    tables = [_shift_table(batch)] if len(batch.shifts) else []
    return Section(
        "species",
        "Species",
        charts=_charts(drawn, "species", "shares"),
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
            *intervals(label, f"value{end}", ends, in_percent=is_share, title=title),
            *intervals(shift, f"shift{end}", moved, in_percent=is_share),
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
        *intervals(batch.mass_label, "mass_kda"),
        *intervals("width [kDa]", "width_kda", title="beyond the events' errors"),
        numeric("events", of("count", fixed, 0)),
        *intervals("share", "share", in_percent=True, title=_SHARE),
        numeric("detected", of("efficiency", percent, 0)),
    ]
    return _table(batch.species, columns, "Species by movie")


def _equilibria(batch: BatchContents, drawn: Mapping[str, Markup]) -> Section:
    """Tabulate K_D of every series, and whether the movies follow the equilibrium."""
    charts = [
        replace(chart, title=f"K_D, {condition}" if condition else "K_D")
        for chart, (condition, *_) in zip(_charts(drawn, "kd"), batch.equilibria, strict=True)
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


def _landing(batch: BatchContents, drawn: Mapping[str, Markup]) -> Section:
    known = batch.movies[batch.movies["rate"].notna()]
    per = f"landings per {known['rate_unit'].iloc[0]}"
    columns = [
        *batch.labels,
        numeric("landed", of("landings", int)),
        numeric("left", of("leavings", int)),
        *intervals(per, "rate", ("rate_from", "rate_to")),
    ]
    tables = [_table(known, columns, "Landings")]
    return Section("landing", "Landing", charts=_charts(drawn, "rates"), tables=tables)


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


def _figures(batch: BatchContents) -> Iterator[tuple[str, Figure]]:
    """Draw the figures of a batch."""
    species = batch.species[~batch.species["outlier"]]
    shown = [curve for curve in batch.curves if curve.masses_kda.size]
    if shown:
        # the axis of masses ends beyond every species and almost all events
        almost = np.quantile(np.concatenate([curve.masses_kda for curve in shown]), 0.995)
        limit = 1.1 * float(np.fmax(almost, species["mass_kda"].max() if len(species) else 0))
        yield "overlaid", _overlaid(shown, limit, batch.mass_label)
        samples = list(dict.fromkeys((curve.group, curve.sample) for curve in shown))
        order = list(dict.fromkeys(group for group, _ in samples))
        samples.sort(key=lambda pair: order.index(pair[0]))
        edges = np.linspace(0, limit, 61)
        for start in range(0, len(samples), LONG):
            name = "stacked" if start == 0 else f"stacked_{start // LONG + 1}"
            rows = {pair: order.index(pair[0]) for pair in samples[start : start + LONG]}
            yield name, _stacked(shown, rows, edges, batch.mass_label, shades(len(order)))
    if len(species):
        yield "species", _species(species, batch.mass_label)
        known = species[species["concentration_nm"] > 0]
        if known["concentration_nm"].nunique() > 1:
            yield "shares", _shares(known)
    rates = batch.movies[batch.movies["rate"].notna()]
    if len(rates):
        yield "rates", _rates(rates)
    for n, (_, found, _) in enumerate(batch.equilibria, 1):
        for name, figure in binding_figure(jsonable(found)):
            yield (name if n == 1 else f"{name}_{n}"), figure


def shades(count: int) -> list[str]:
    """Give colours that can be told apart: named ones, or steps of a scale where there are many."""
    if count <= len(_COLORS):
        return list(_COLORS[:count])
    scale = mpl.colormaps["viridis"]
    return [to_hex(scale(0.05 + 0.8 * k / (count - 1))) for k in range(count)]


def _panels(
    groups: Sequence[str], height: float, x_label: str, y_label: str
) -> tuple[Figure, list[Axes]]:
    """Make a panel for each group, two in a row, all with the same axes."""
    columns = min(len(groups), 2)
    rows = math.ceil(len(groups) / columns)
    figure = new_figure(_WIDTH, 0.5 + height * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels: list[Axes] = list(grid.ravel())
    for panel in panels[len(groups) :]:
        panel.set_visible(False)
    for panel in panels[max(0, len(groups) - columns) : len(groups)]:
        panel.tick_params(labelbottom=True)
    figure.supxlabel(x_label, fontsize=9)
    figure.supylabel(y_label, fontsize=9)
    return figure, panels[: len(groups)]


def _overlaid(curves: Sequence[Curve], limit: float, label: str) -> Figure:
    """Draw one panel for each group, all movies with the same axes."""
    groups = list(dict.fromkeys(curve.group for curve in curves))
    figure, panels = _panels(groups, 2.1, label, "events per kDa [%]")
    for group, panel in zip(groups, panels, strict=True):
        inside = [curve for curve in curves if curve.group == group]
        samples = list(dict.fromkeys(curve.sample for curve in inside))
        for sample, color in zip(samples, shades(len(samples)), strict=True):
            label_once = in_figure(sample) if len(samples) <= _NAMED else None
            for curve in (c for c in inside if c.sample == sample and c.density.size):
                density = 100 * curve.density / curve.masses_kda.size
                panel.plot(curve.grid_kda, density, color=color, lw=1, label=label_once)
                label_once = None
        if group or len(groups) > 1:
            panel.set_title(in_figure(group) or "no condition")
        if panel.get_legend_handles_labels()[0]:
            panel.legend(fontsize=6, ncols=1 if 2 * len(samples) <= _NAMED else 2)
        elif len(samples) > _NAMED:
            title = f"{in_figure(group)}: {len(samples)} samples, from dark to bright"
            panel.set_title(title.strip(": "))
    panels[0].set(xlim=(0, limit))
    panels[0].set_ylim(0, 1.25 * panels[0].get_ylim()[1])  # with room for its legend
    return figure


def _stacked(
    curves: Sequence[Curve],
    rows: Mapping[tuple[str, str], int],
    edges: FloatArray,
    label: str,
    colors: Sequence[str],
) -> Figure:
    """Draw one row for each sample, with the number of its group; all have the same scale."""
    means, names = {}, []
    for group, sample in rows:
        own = [c.masses_kda for c in curves if (c.group, c.sample) == (group, sample)]
        shares = [100 * np.histogram(masses, edges)[0] / masses.size for masses in own]
        means[group, sample] = np.mean(shares, axis=0)
        several = len(colors) > 1 and group and group != sample
        name = _shortened(f"{group}: {sample}" if several else sample, 34)
        names.append(f"{name}  ({sum(masses.size for masses in own)})")
    step = 1.05 * max(float(mean.max()) for mean in means.values())
    figure, axes = one_panel(_WIDTH, 0.9 + 0.29 * len(rows))
    for k, (key, mean) in enumerate(means.items()):
        base, color = -k * step, colors[rows[key]]
        axes.stairs(base + mean, edges, baseline=base, fill=True, color=color, alpha=0.35, lw=0)
        axes.stairs(base + mean, edges, baseline=None, color=color, lw=0.8)
    axes.set_yticks([-k * step for k in range(len(rows))], names, fontsize=7)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set(xlim=(0, edges[-1]), ylim=(-(len(rows) - 1) * step - 0.05 * step, step * 1.05))
    axes.set_xlabel(label)
    return figure


def _shortened(name: str, longest: int) -> str:
    return in_figure(name if len(name) <= longest else f"{name[: longest - 1]}…")


def _places(table: pd.DataFrame, axes: Axes) -> FloatArray:
    """Position of the sample of every row on an axis with the names of samples."""
    samples = list(dict.fromkeys(table["sample"]))
    place = {sample: k for k, sample in enumerate(samples)}
    # Movies of one sample stand beside each other.
    turn = table.groupby("sample")["movie"].transform(lambda m: pd.factorize(m)[0]).to_numpy(float)
    many = table.groupby("sample")["movie"].transform("nunique").to_numpy(float)
    every = math.ceil(len(samples) / 24)
    names = [_shortened(sample, 22) for sample in samples[::every]]
    axes.set_xticks(range(0, len(samples), every), names, fontsize=7)
    axes.tick_params(axis="x", rotation=90 if len(names) > 6 else 0)
    axes.set_xlim(-0.6, len(samples) - 0.4)
    middle = np.array([place[s] for s in table["sample"]], dtype=np.float64)
    return np.asarray(middle + 0.5 * ((turn + 0.5) / many - 0.5))


def _points(
    axes: Axes, x: FloatArray, rows: pd.DataFrame, names: Sequence[str], **style: Any
) -> None:
    """Draw values and intervals of rows; `names` are the columns of value, lower and upper end."""
    value, low, high = (rows[name].to_numpy(float) for name in names)
    whiskers(axes, x, value, (low, high), style={"ms": 3.5, "ls": "none", "capsize": 0, **style})


def _species(species: pd.DataFrame, label: str) -> Figure:
    """Draw mass of every species against the sample."""
    figure, axes = one_panel(_WIDTH, 3.4)
    place = _places(species, axes)
    kinds = sorted(species["kind"].unique())
    for kind, color in zip(kinds, shades(len(kinds)), strict=True):
        chosen = (species["kind"] == kind).to_numpy()
        names = ("mass_kda", "mass_low", "mass_high")
        _points(axes, place[chosen], species[chosen], names, color=color)
    axes.set_ylabel(label)
    masses = species["mass_kda"]
    if masses.max() > 5 * max(masses.min(), 1e-9):
        plain_log(axes, "y")
    axes.grid(axis="y", color=GRID, lw=0.6)
    return figure


def _shares(species: pd.DataFrame) -> Figure:
    """Draw the share of every species against the concentration, a panel for each group."""
    groups = list(dict.fromkeys(species["group"]))
    labels = "concentration [nM]", "share of the particles that came"
    figure, panels = _panels(groups, 2.2, *labels)
    kinds = sorted(species["kind"].unique())
    mean = species.groupby("kind")["mass_kda"].mean()
    handles: dict[str, Any] = {}
    for group, panel in zip(groups, panels, strict=True):
        for kind, color in zip(kinds, shades(len(kinds)), strict=True):
            chosen = species[(species["kind"] == kind) & (species["group"] == group)]
            if chosen.empty:
                continue
            label = f"{mean[kind]:.3g} kDa" if len(kinds) <= _NAMED else None
            names, x = ("share", "share_low", "share_high"), chosen["concentration_nm"]
            _points(panel, x.to_numpy(float), chosen, names, color=color, label=label)
        panel.set_title(in_figure(group))
        marks, words = panel.get_legend_handles_labels()
        handles |= dict(zip(words, marks, strict=True))
    plain_log(panels[0], "x")
    panels[0].set(ylim=(-0.03, 1.3), yticks=[0, 0.25, 0.5, 0.75, 1])
    if handles:
        entries = list(handles.values()), list(handles)
        panels[0].legend(*entries, fontsize=6, ncols=2, loc="upper left")
    return figure


def _rates(movies: pd.DataFrame) -> Figure:
    """Draw how many landed per time, against concentration where it is known, else the sample."""
    known = movies[movies["concentration_nm"] > 0]
    against = known["concentration_nm"].nunique() > 1
    figure, axes = one_panel(_WIDTH, 3.2)
    table = known if against else movies
    x = table["concentration_nm"].to_numpy(float) if against else _places(table, axes)
    groups = list(dict.fromkeys(table["group"]))
    for group, color in zip(groups, shades(len(groups)), strict=True):
        chosen = (table["group"] == group).to_numpy()
        label = (in_figure(group) or "no condition") if 1 < len(groups) <= _NAMED else None
        names = ("rate", "rate_from", "rate_to")
        _points(axes, x[chosen], table[chosen], names, color=color, label=label)
    blank = movies[movies["role"] == "blank"]
    if against and len(blank):
        axes.axhline(float(blank["rate"].mean()), color=INK, lw=0.8, ls=":", label="blank")
    if against:
        plain_log(axes, "x")
        axes.set_xlabel("concentration [nM]")
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.set_ylabel(f"landings per {movies['rate_unit'].iloc[0]}")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
