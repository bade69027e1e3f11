"""Figures for print: PNG and SVG, drawn with Matplotlib's own objects and no global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from iscat_analysis.records import (
    FREE_PARAMETERS,
    Analysis,
    EventView,
    FloatArray,
    PosteriorResult,
    Status,
)
from iscat_analysis.report.numbers import LABELS, UNITS
from iscat_analysis.report.pack import (
    CREDIBLE_LEVELS,
    POSTERIOR_BINS,
    credible_shades,
    display_range,
    residual_limit,
)
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    INK,
    PURPLE,
    STYLE,
    VERMILLION,
    new_figure,
    save_figure,
)
from iscat_analysis.report.tables import event_table

EVENT_FIGURES = 50
"""Events whose images are drawn into the folder, at most."""

CORNER_FIGURES = 20
"""Posteriors drawn into the folder, at most."""

NUMBERED_EVENTS = 100
"""Events in the overview that may carry their number; the others are rings only."""

DIVERGING = LinearSegmentedColormap.from_list("residual", ["#00528C", "#FAFAF8", "#BE4600"])


def write_figures(
    analysis: Analysis, folder: Path, *, events: int = EVENT_FIGURES
) -> dict[str, int]:
    """Draw every figure, each as PNG and SVG.

    ``overview`` (the field with its events), ``precision`` (achieved σ against the bounds),
    ``mass_histogram`` or ``height_histogram``, ``power``, ``event_NNNN`` (data, model, residual)
    and ``corner_NNNN`` (converged posteriors).  What has no data is left out.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    folder : Path
        Made if absent.
    events : int
        Events whose images are drawn, at most.

    Returns
    -------
    dict of str to int
        How many figures of each kind were drawn: ``events``, ``corners``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table = event_table(analysis)
    free = FREE_PARAMETERS[analysis.mode]
    with mpl.rc_context(STYLE):
        if np.asarray(analysis.ratio_image).size:
            save_figure(_overview(analysis, table), folder / "overview")
        if np.asarray(analysis.power).size > 1:
            save_figure(_power(analysis), folder / "power")
        main = "mass_kda" if "mass_kda" in free else "z_nm"
        if np.isfinite(table[main].to_numpy(float)).any():
            name = "mass_histogram" if main == "mass_kda" else "height_histogram"
            save_figure(_histogram(table, main), folder / name)
            save_figure(_precision(table, free), folder / "precision")
        drawn = analysis.views[:events]
        names: set[str] = set()
        for view in drawn:
            name = f"event_{view.event:04d}"
            if name in names:  # a track has one view for each of its frames
                name += f"_{sum(known.startswith(name) for known in names) + 1}"
            names.add(name)
            save_figure(_triptych(view, analysis), folder / name)
        sampled = [
            (view, view.posterior)
            for view in analysis.views
            if view.posterior is not None and view.posterior.converged
        ][:CORNER_FIGURES]
        for view, posterior in sampled:
            save_figure(_corner(posterior, view.event), folder / f"corner_{view.event:04d}")
    return {"events": len(drawn), "corners": len(sampled)}


def _overview(analysis: Analysis, table: pd.DataFrame) -> Figure:
    image = np.asarray(analysis.ratio_image, float)
    rows, columns = image.shape
    height = float(np.clip(6.4 * rows / columns, 2.5, 9.0))
    figure = new_figure(7.4, height + 0.5)
    axes = figure.add_subplot()
    low, high = display_range([image], analysis.scheme)
    shown = axes.imshow(image, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
    _scale_bar(axes, columns, rows, analysis.pixel_size_nm)
    unit = "photoelectrons" if analysis.scheme == "darkfield" else "contrast"
    figure.colorbar(shown, ax=axes, label=unit, fraction=0.05, pad=0.02)
    if table["event"].is_unique:
        axes.plot(table["x_px"], table["y_px"], "o", mfc="none", mec="#F0E442", ms=11, mew=1)
    else:
        for _, track in table.groupby("event", sort=False):
            axes.plot(track["x_px"], track["y_px"], color="#56B4E9", lw=1)
    first = table.drop_duplicates("event")[["event", "x_px", "y_px"]].dropna()
    _number(axes, first.to_numpy(float), columns / 6.4, (rows, columns))
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    axes.set_title("Field of view")
    return figure


def _number(axes: Axes, events: FloatArray, per_inch: float, shape: tuple[int, int]) -> None:
    """Write each event's number beside its ring, where it covers no other ring and no number.

    `events` has the rows (number, x, y) [px]; `per_inch` is pixels to an inch of the figure.
    """
    ring, tall, wide = 0.08 * per_inch, 0.1 * per_inch, 0.065 * per_inch
    taken = [(x - ring, y - ring, x + ring, y + ring) for _, x, y in events]
    taken.append((0.0, shape[0] * 0.9, shape[1] * 0.35, float(shape[0])))
    for number, x, y in events[:NUMBERED_EVENTS]:
        text = f"{number:.0f}"
        width = wide * len(text)
        for left, top in (
            (x + 1.3 * ring, y - tall / 2),
            (x - 1.3 * ring - width, y - tall / 2),
            (x - width / 2, y - 1.3 * ring - tall),
            (x - width / 2, y + 1.3 * ring),
        ):
            box = (left, top, left + width, top + tall)
            inside = left > 0 and top > 0 and box[2] < shape[1] and box[3] < shape[0]
            if inside and not any(
                box[0] < other[2] and box[2] > other[0] and box[1] < other[3] and box[3] > other[1]
                for other in taken
            ):
                taken.append(box)
                axes.text(
                    left + width / 2, top + tall / 2, text, color="white", fontsize=7,
                    ha="center", va="center", in_layout=False,
                    path_effects=[withStroke(linewidth=1.6, foreground="black", alpha=0.7)],
                )  # fmt: skip
                break


def _scale_bar(axes: Axes, columns: int, rows: int, pixel_size_nm: float) -> None:
    bars = [50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000]
    length_nm = max([b for b in bars if b <= 0.4 * columns * pixel_size_nm], default=bars[0])
    length = length_nm / pixel_size_nm
    x, y = 0.04 * columns - 0.5, 0.955 * rows - 0.5
    thick = 0.012 * rows
    axes.add_patch(Rectangle((x, y), length, thick, fc="white", ec="black", lw=0.6, zorder=3))
    axes.text(
        x, y - 0.015 * rows, f"{length_nm / 1000:g} µm", color="white", fontsize=8, va="bottom",
        bbox={"boxstyle": "round,pad=0.1", "fc": "black", "ec": "none", "alpha": 0.45}, zorder=3,
    )  # fmt: skip


def _power(analysis: Analysis) -> Figure:
    figure = new_figure(7.0, 2.6)
    axes = figure.add_subplot()
    axes.axhline(1.0, color=GREY, lw=0.8, ls="--")
    axes.plot(analysis.power_frames, analysis.power, color=BLUE, lw=0.8)
    axes.set(xlabel="frame", ylabel="power, relative", title="Laser power")
    return figure


def _bins(extent: float, spread: FloatArray) -> int:
    """Count bins of two standard deviations, which do not blur neighbouring species."""
    width = 2 * float(np.median(spread)) if spread.size else 0.0
    return int(np.clip(extent / width, 10, 90)) if width > 0 else 10


def _histogram(table: pd.DataFrame, name: str) -> Figure:
    table = table[table["status"] != Status.SIDELOBE.value]
    values = table[name].to_numpy(float)
    finite = np.isfinite(values)
    good = (table["status"] == Status.OK.value).to_numpy()
    spread = table[f"sigma_{name}"].to_numpy(float)[good]
    bins = _bins(np.ptp(values[finite]), spread[np.isfinite(spread)])
    edges = np.histogram_bin_edges(values[finite], bins=bins)
    figure = new_figure(5.4, 3.4)
    axes = figure.add_subplot()
    groups = [values[finite & good], values[finite & ~good]]
    axes.hist(
        groups, bins=edges.tolist(), stacked=True, color=[BLUE, PURPLE], label=["ok", "flagged"]
    )
    if groups[1].size:
        axes.legend()
    title = "Masses" if name == "mass_kda" else "Heights"
    axes.set(xlabel=f"{LABELS[name]} [{UNITS[name]}]", ylabel="events", title=title)
    return figure


def _precision(table: pd.DataFrame, free: Sequence[str]) -> Figure:
    figure = new_figure(3.3 * len(free), 3.5)
    good = (table["status"] == Status.OK.value).to_numpy()
    for place, name in enumerate(free):
        axes = figure.add_subplot(1, len(free), place + 1)
        sigma, crb, qcrb = (
            table[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb")
        )
        usable = np.isfinite(crb) & (crb > 0)
        axes.set(title=LABELS[name], xlabel=f"CRB [{UNITS[name]}]")
        if place == 0:
            axes.set_ylabel("σ and QCRB")
        if not usable.any():
            axes.text(0.5, 0.5, "no bound", ha="center", va="center", transform=axes.transAxes)
            continue
        ends = np.array([crb[usable].min() / 1.15, crb[usable].max() * 1.15])
        axes.plot(ends, ends, color=INK, lw=1.2, label="CRB")
        marker: dict[str, Any] = {"ls": "none", "ms": 3.5, "alpha": 0.7, "mew": 0}
        axes.plot(crb[usable], qcrb[usable], "s", color=BLUE, label="QCRB", **marker)
        axes.plot(
            crb[usable & good], sigma[usable & good], "o", color=VERMILLION,
            label="achieved σ", **marker,
        )  # fmt: skip
        axes.plot(crb[usable & ~good], sigma[usable & ~good], "x", color=PURPLE, ms=4,
                  label="achieved σ, flagged" if (usable & ~good).any() else None)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlim=tuple(ends))
        _plain_log_ticks(axes)
        if place == 0:
            axes.legend(fontsize=7, loc="best")
    return figure


def _plain_log_ticks(axes: Axes) -> None:
    """Label a log axis with plain numbers, few enough not to collide."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        narrow = high / low < 6
        axis.set_major_locator(MaxNLocator(4) if narrow else LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def _triptych(view: EventView, analysis: Analysis) -> Figure:
    rows, columns = view.contrast.shape
    aspect = float(np.clip(rows / columns, 0.3, 3.0))
    figure = new_figure(8.4, 2.55 * aspect + 1.0, constrained=False)
    low, high = display_range([view.contrast, view.model], analysis.scheme)
    limit = residual_limit(view.residual)
    unit = "photoelectrons" if analysis.scheme == "darkfield" else "contrast"
    panels: list[tuple[str, Any, Any, float, float, str]] = [
        ("data", view.contrast, "gray", low, high, unit),
        ("model", view.model, "gray", low, high, unit),
        ("residual", view.residual, DIVERGING, -limit, limit, "σ"),
    ]
    bottom = 0.62 / (2.55 * aspect + 1.0)
    tall = 2.55 * aspect / (2.55 * aspect + 1.0)
    for place, (title, image, cmap, lower, upper, label) in enumerate(panels):
        x = 0.02 + place * 0.33
        axes = figure.add_axes((x, bottom, 0.3, tall))
        shown = axes.imshow(image, cmap=cmap, vmin=lower, vmax=upper, interpolation="nearest")
        axes.set(xticks=[], yticks=[], title=f"event {view.event}, {title}" if not place else title)
        axes.spines[:].set_visible(False)
        bar = figure.add_axes((x, bottom * 0.78, 0.3, bottom * 0.1))
        figure.colorbar(shown, cax=bar, orientation="horizontal", label=label).ax.locator_params(
            nbins=4
        )
        if not place:
            _scale_bar(axes, columns, rows, analysis.pixel_size_nm)
    return figure


def _corner(posterior: PosteriorResult, event: int) -> Figure:
    flat = posterior.samples.reshape(-1, len(posterior.names))
    n = len(posterior.names)
    figure = new_figure(1.9 * n + 0.6, 1.9 * n + 0.6, constrained=False)
    grid = figure.subplots(n, n, squeeze=False, gridspec_kw={"wspace": 0.08, "hspace": 0.08})
    figure.subplots_adjust(left=0.14, right=0.98, bottom=0.12, top=0.93)
    ends = []
    for values in flat.T:
        low, high = np.quantile(values, [0.001, 0.999])
        pad = 0.05 * (high - low) or 0.5
        ends.append((low - pad, high + pad))
    quantiles = np.quantile(flat, [0.15865, 0.5, 0.84135], axis=0)
    shades = LinearSegmentedColormap.from_list("shades", ["white", BLUE])
    for i in range(n):
        for j in range(n):
            axes = grid[i][j]
            if j > i:
                axes.set_axis_off()
                continue
            label_x = f"{LABELS[posterior.names[j]]} [{UNITS[posterior.names[j]]}]"
            if i == j:
                axes.hist(flat[:, i], bins=POSTERIOR_BINS, range=ends[i], color=BLUE, alpha=0.35)
                for value in quantiles[:, i]:
                    axes.axvline(value, color=INK, lw=0.8, ls="--")
                axes.set_yticks([])
            else:
                counts, ex, ey = np.histogram2d(
                    flat[:, j], flat[:, i], bins=POSTERIOR_BINS, range=[ends[j], ends[i]]
                )
                axes.pcolormesh(
                    ex, ey, credible_shades(counts).T, cmap=shades, vmin=0,
                    vmax=len(CREDIBLE_LEVELS), rasterized=True,
                )  # fmt: skip
                axes.set_ylim(*ends[i])
            axes.set_xlim(*ends[j])
            axes.locator_params(axis="x", nbins=3)
            if i != j:
                axes.locator_params(axis="y", nbins=4)
            if i < n - 1:
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel(label_x)
            if j or not i:
                axes.tick_params(labelleft=False)
            else:
                axes.set_ylabel(f"{LABELS[posterior.names[i]]} [{UNITS[posterior.names[i]]}]")
            axes.ticklabel_format(useOffset=False)
    figure.suptitle(f"Posterior of event {event}", x=0.14, ha="left", fontsize=10)
    return figure
