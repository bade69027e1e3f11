"""Figures of many movies, on common axes and in the size of print."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator

from iscat_analysis.records import FloatArray
from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, VERMILLION, log_y, new_figure
from iscat_analysis.text import in_figure

WIDTH_INCHES = 7.2
"""Two columns of a journal."""

ROWS_STACKED = 30
"""Samples in one figure of stacked distributions; more go into further ones."""

_COLORS = (BLUE, VERMILLION, "#009E73", PURPLE, "#56B4E9", "#E69F00", GREY)
_NAMED = 8  # entries of a legend
_SHORT = 4  # of them in one column
_HEADROOM = 1.25  # of a panel, for its legend
_TICKS = 24  # samples named along an axis
_BINS = 60
_QUANTILE = 0.995  # of all masses that an axis shows


@dataclass(frozen=True, eq=False)
class Curve:
    """Masses of one movie."""

    movie: str
    sample: str
    group: str
    masses_kda: FloatArray
    grid_kda: FloatArray
    density: FloatArray


def batch_figures(
    curves: Sequence[Curve], movies: pd.DataFrame, species: pd.DataFrame, *, mass_label: str
) -> Iterator[tuple[str, Figure]]:
    """Draw the figures of a batch."""
    shown = [curve for curve in curves if curve.masses_kda.size]
    if shown:
        limit = _limit(shown, species)
        yield "overlaid", _overlaid(shown, limit, mass_label)
        samples = list(dict.fromkeys((curve.group, curve.sample) for curve in shown))
        order = list(dict.fromkeys(group for group, _ in samples))
        samples.sort(key=lambda pair: order.index(pair[0]))
        edges = np.linspace(0, limit, _BINS + 1)
        for start in range(0, len(samples), ROWS_STACKED):
            name = "stacked" if start == 0 else f"stacked_{start // ROWS_STACKED + 1}"
            rows = samples[start : start + ROWS_STACKED]
            yield name, _stacked(shown, samples, rows, edges, mass_label)
    real = species[~species["outlier"]]
    if len(real):
        yield "species", _species(real, mass_label)
        known = real[real["concentration_nm"] > 0]
        if known["concentration_nm"].nunique() > 1:
            yield "shares", _shares(known)
    rates = movies[movies["rate"].notna()]
    if len(rates):
        yield "rates", _rates(rates)


def _limit(curves: Sequence[Curve], species: pd.DataFrame) -> float:
    """Upper end of the mass axis: beyond every species and almost all events."""
    masses = np.concatenate([curve.masses_kda for curve in curves])
    heaviest = species["mass_kda"][~species["outlier"]].max() if len(species) else math.nan
    return 1.1 * float(np.fmax(np.quantile(masses, _QUANTILE), heaviest))


def shades(count: int) -> list[str]:
    """Give colours that can be told apart: named ones, or steps of a scale where there are many."""
    if count <= len(_COLORS):
        return list(_COLORS[:count])
    scale = mpl.colormaps["viridis"]
    return [to_hex(scale(0.05 + 0.8 * k / (count - 1))) for k in range(count)]


def _overlaid(curves: Sequence[Curve], limit: float, label: str) -> Figure:
    """Draw one panel for each group, all movies with the same axes."""
    groups = list(dict.fromkeys(curve.group for curve in curves))
    columns = min(len(groups), 2)
    rows = math.ceil(len(groups) / columns)
    figure = new_figure(WIDTH_INCHES, 0.5 + 2.1 * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels: list[Axes] = list(grid.ravel())
    for group, panel in zip(groups, panels, strict=False):
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
            panel.legend(fontsize=6, ncols=1 if len(samples) <= _SHORT else 2)
        elif len(samples) > _NAMED:
            title = f"{in_figure(group)}: {len(samples)} samples, from dark to bright"
            panel.set_title(title.strip(": "))
    panels[0].set(xlim=(0, limit))
    panels[0].set_ylim(0, _HEADROOM * panels[0].get_ylim()[1])
    _leave_out(panels, len(groups), columns)
    figure.supxlabel(label, fontsize=9)
    figure.supylabel("events per kDa [%]", fontsize=9)
    return figure


def _leave_out(panels: Sequence[Axes], shown: int, columns: int) -> None:
    """Hide unused panels, and label the axes of the panels above them."""
    for panel in panels[shown:]:
        panel.set_visible(False)
    for panel in panels[max(0, shown - columns) : shown]:
        panel.tick_params(labelbottom=True)


def _stacked(
    curves: Sequence[Curve],
    samples: Sequence[tuple[str, str]],
    rows: Sequence[tuple[str, str]],
    edges: FloatArray,
    label: str,
) -> Figure:
    """Draw one row for each sample; all have the same bins and the same scale."""
    groups = list(dict.fromkeys(group for group, _ in samples))
    colors = dict(zip(groups, shades(len(groups)), strict=True))
    shares: dict[tuple[str, str], list[FloatArray]] = {key: [] for key in rows}
    number = dict.fromkeys(rows, 0)
    for curve in curves:
        key = (curve.group, curve.sample)
        if key in shares:
            counts = np.histogram(curve.masses_kda, edges)[0]
            shares[key].append(100 * counts / curve.masses_kda.size)
            number[key] += curve.masses_kda.size
    step = 1.05 * max(float(np.mean(each, axis=0).max()) for each in shares.values())
    figure = new_figure(WIDTH_INCHES, 0.9 + 0.29 * len(rows))
    axes = figure.add_subplot()
    for k, key in enumerate(rows):
        base, color = -k * step, colors[key[0]]
        mean = np.mean(shares[key], axis=0)
        axes.stairs(base + mean, edges, baseline=base, fill=True, color=color, alpha=0.35, lw=0)
        axes.stairs(base + mean, edges, baseline=None, color=color, lw=0.8)
    axes.set_yticks([-k * step for k in range(len(rows))])
    axes.set_yticklabels([_named(key, number[key], len(groups)) for key in rows], fontsize=7)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.set(xlim=(0, edges[-1]), ylim=(-(len(rows) - 1) * step - 0.05 * step, step * 1.05))
    axes.set_xlabel(label)
    return figure


def _named(key: tuple[str, str], events: int, groups: int) -> str:
    group, sample = key
    name = f"{group}: {sample}" if groups > 1 and group and group != sample else sample
    name = name if len(name) <= 34 else f"{name[:33]}…"
    return f"{in_figure(name)}  ({events})"


def _places(table: pd.DataFrame, axes: Axes) -> FloatArray:
    """Position of the sample of every row on an axis with the names of samples."""
    samples = list(dict.fromkeys(table["sample"]))
    place = {sample: k for k, sample in enumerate(samples)}
    # Movies of one sample stand beside each other.
    turn = table.groupby("sample")["movie"].transform(lambda m: pd.factorize(m)[0]).to_numpy(float)
    many = table.groupby("sample")["movie"].transform("nunique").to_numpy(float)
    every = math.ceil(len(samples) / _TICKS)
    ticks = range(0, len(samples), every)
    names = [in_figure(s if len(s) <= 22 else f"{s[:21]}…") for s in samples[::every]]
    slant = {"rotation": 90} if len(names) > 6 else {}
    axes.set_xticks(list(ticks), names, fontsize=7, **slant)  # type: ignore[arg-type]
    axes.set_xlim(-0.6, len(samples) - 0.4)
    middle = np.array([place[s] for s in table["sample"]], dtype=np.float64)
    return np.asarray(middle + 0.5 * ((turn + 0.5) / many - 0.5))


def _bars(
    axes: Axes,
    x: FloatArray,
    rows: pd.DataFrame,
    names: tuple[str, str, str],
    color: str,
    label: str | None,
    marker: str = "o",
) -> None:
    value, low, high = (rows[name].to_numpy(float) for name in names)
    reach = np.nan_to_num(np.maximum([value - low, high - value], 0.0))
    axes.errorbar(
        x, value, reach, fmt=marker, ms=3.5, lw=1, color=color, label=label, ls="none", capsize=0
    )


def _species(species: pd.DataFrame, label: str) -> Figure:
    """Draw mass of every species against the sample."""
    figure = new_figure(WIDTH_INCHES, 3.4)
    axes = figure.add_subplot()
    place = _places(species, axes)
    kinds = sorted(species["kind"].unique())
    for kind, color in zip(kinds, shades(len(kinds)), strict=True):
        chosen = (species["kind"] == kind).to_numpy()
        names = ("mass_kda", "mass_low", "mass_high")
        _bars(axes, place[chosen], species[chosen], names, color, None)
    axes.set_ylabel(label)
    masses = species["mass_kda"]
    if masses.max() > 5 * max(masses.min(), 1e-9):
        log_y(axes)
    axes.grid(axis="y", color="#E7E4DD", lw=0.6)
    return figure


def _shares(species: pd.DataFrame) -> Figure:
    """Draw the share of every species against the concentration, a panel for each group."""
    groups = list(dict.fromkeys(species["group"]))
    columns = min(len(groups), 2)
    rows = math.ceil(len(groups) / columns)
    figure = new_figure(WIDTH_INCHES, 0.5 + 2.2 * rows)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    panels: list[Axes] = list(grid.ravel())
    kinds = sorted(species["kind"].unique())
    mean = species.groupby("kind")["mass_kda"].mean()
    for group, panel in zip(groups, panels, strict=False):
        for kind, color in zip(kinds, shades(len(kinds)), strict=True):
            chosen = species[(species["kind"] == kind) & (species["group"] == group)]
            if chosen.empty:
                continue
            label = f"{mean[kind]:.3g} kDa" if len(kinds) <= _NAMED else None
            names = ("share", "share_low", "share_high")
            x = chosen["concentration_nm"].to_numpy(float)
            _bars(panel, x, chosen, names, color, label)
        panel.set_xscale("log")
        panel.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        panel.set_title(in_figure(group))
    panels[0].set_ylim(-0.03, 1.3)
    panels[0].set_yticks([0, 0.25, 0.5, 0.75, 1])
    named = [panel.get_legend_handles_labels() for panel in panels]
    handles = {label: handle for pair in named for handle, label in zip(*pair, strict=True)}
    if handles:
        entries = (list(handles.values()), list(handles))
        panels[0].legend(*entries, fontsize=6, ncols=2, loc="upper left")
    _leave_out(panels, len(groups), columns)
    figure.supxlabel("concentration [nM]", fontsize=9)
    figure.supylabel("share of the particles that came", fontsize=9)
    return figure


def _rates(movies: pd.DataFrame) -> Figure:
    """Draw how many landed per time, against concentration where it is known, else the sample."""
    known = movies[movies["concentration_nm"] > 0]
    against = known["concentration_nm"].nunique() > 1
    figure = new_figure(WIDTH_INCHES, 3.2)
    axes = figure.add_subplot()
    table = known if against else movies
    x = table["concentration_nm"].to_numpy(float) if against else _places(table, axes)
    groups = list(dict.fromkeys(table["group"]))
    for group, color in zip(groups, shades(len(groups)), strict=True):
        chosen = (table["group"] == group).to_numpy()
        names = ("rate", "rate_from", "rate_to")
        label = (in_figure(group) or "no condition") if 1 < len(groups) <= _NAMED else None
        _bars(axes, x[chosen], table[chosen], names, color, label)
    blank = movies[(movies["role"] == "blank")]
    if against and len(blank):
        axes.axhline(float(blank["rate"].mean()), color=INK, lw=0.8, ls=":", label="blank")
    if against:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.set_xlabel("concentration [nM]")
    axes.set_ylim(bottom=0)
    axes.yaxis.set_major_locator(MaxNLocator(6))
    axes.set_ylabel(f"landings per {movies['rate_unit'].iloc[0]}")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
