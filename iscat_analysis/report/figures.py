"""The figures of one analysis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from iscat_analysis.records import Analysis, BoolArray, FloatArray, Status, counted, free_parameters
from iscat_analysis.report.answer import main_quantity
from iscat_analysis.report.budget import budget_figure
from iscat_analysis.report.event_figures import HALO, scale_bar
from iscat_analysis.report.field import field_axes
from iscat_analysis.report.headline import as_contrasts, label_of
from iscat_analysis.report.movie_figure import movie_figure
from iscat_analysis.report.numbers import UNITS
from iscat_analysis.report.scales import display_range
from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, VERMILLION, Sketch, new_figure
from iscat_analysis.report.track_figures import track_figures

NUMBERED_EVENTS = 100
"""Events in the overview that may carry their number; the others are rings only."""

LARGEST_FIELD = 640
"""Longer side of an image of the field that is shown pixel by pixel [px]."""

MOST_POINTS = 800
"""Points of a figure that tell their event when the pointer is over them; more become an image."""

_NAMES = {"mass_kda": "mass", "z_nm": "height", "n_scattered": "photon"}


def page_figures(analysis: Analysis, table: pd.DataFrame) -> Iterator[Sketch]:
    """Name the figures of the report page, and what draws them."""
    main = main_quantity(analysis).column
    fitted = np.isfinite(counted(table)[main].to_numpy(float)).any()
    if analysis.tracks is not None:
        yield from track_figures(analysis, table)
    elif np.asarray(analysis.ratio_image).size:
        yield "overview", partial(overview, analysis, table)
    if fitted and analysis.tracks is None:
        yield f"{_NAMES.get(main, main)}_histogram", partial(histogram, analysis, table)
        yield "timeline", partial(timeline, analysis, table)
    if fitted:
        yield "precision", partial(precision, analysis, table)
    yield "spread", partial(spread_figure, analysis, label_of)
    yield "budget", partial(budget_figure, analysis)
    yield "diagnostics", partial(diagnostics, analysis, table)
    power_known = np.isfinite(np.asarray(analysis.power, float))
    if analysis.summary.get("timeline"):  # which has the power of every frame too
        yield "movie", partial(movie_figure, analysis)
    elif power_known.size > 1 and power_known.any():
        yield "power", partial(power, analysis)


def _points(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    rows: BoolArray,
    mark: str,
    *,
    linked: bool = True,
    **style: Any,
) -> None:
    """Draw points with the table rows they stand for, if the table is on the page."""
    at = np.flatnonzero(rows & np.isfinite(x) & np.isfinite(y))
    (line,) = axes.plot(x[at], y[at], mark, ls="none", **style)
    if linked and at.size <= MOST_POINTS:
        line.set_gid("rows-" + "_".join(map(str, at)))
    elif at.size > MOST_POINTS:
        line.set_rasterized(True)


def overview(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw the field of view with its events numbered."""
    image = np.asarray(analysis.ratio_image, float)
    rows, columns = image.shape
    figure, axes, per_inch = field_axes((rows, columns))
    low, high = display_range([image], analysis.scheme)
    # Matplotlib leaves the pixels of small images to the browser, and averages those of large ones.
    interpolation = "none" if max(rows, columns) <= LARGEST_FIELD else "antialiased"
    shown = axes.imshow(
        image,
        cmap="gray",
        vmin=low,
        vmax=high,
        interpolation=interpolation,
        aspect=per_inch[0] / per_inch[1],
    )
    scale_bar(axes, columns, rows, analysis.pixel_size_nm)
    unit = "photoelectrons" if analysis.scheme == "darkfield" else "contrast"
    figure.colorbar(shown, ax=axes, label=unit, fraction=0.05, pad=0.02)
    x, y = table["x_px"].to_numpy(float), table["y_px"].to_numpy(float)
    _points(axes, x, y, np.isfinite(x), "o", mfc="none", mec="#F0E442", ms=11, mew=1)
    first = table.drop_duplicates("event")[["event", "x_px", "y_px"]].dropna()
    _number(axes, first.to_numpy(float), per_inch, (rows, columns))
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    return figure


def _number(
    axes: Axes, events: FloatArray, per_inch: tuple[float, float], shape: tuple[int, int]
) -> None:
    """Write each event's number beside its ring, where it covers no other ring and no number.

    `events` has the rows (number, x, y) [px]; `per_inch` is pixels to an inch along x and y.
    """
    ring, high = 0.08 * per_inch[0], 0.08 * per_inch[1]
    wide, tall = 0.065 * per_inch[0], 0.1 * per_inch[1]
    taken = [(x - ring, y - high, x + ring, y + high) for _, x, y in events]
    taken.append((0.0, shape[0] * 0.9, shape[1] * 0.35, float(shape[0])))
    for number, x, y in events[:NUMBERED_EVENTS]:
        text = f"{number:.0f}"
        width = wide * len(text)
        for left, top in (
            (x + 1.3 * ring, y - tall / 2),
            (x - 1.3 * ring - width, y - tall / 2),
            (x - width / 2, y - 1.3 * high - tall),
            (x - width / 2, y + 1.3 * high),
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
                    ha="center", va="center", in_layout=False, path_effects=HALO,
                )  # fmt: skip
                break


def power(analysis: Analysis) -> Figure:
    """Draw the laser power of each frame used."""
    figure = new_figure(7.0, 2.3)
    axes = figure.add_subplot()
    axes.axhline(1.0, color=GREY, lw=0.8, ls="--")
    axes.plot(analysis.power_frames, analysis.power, color=BLUE, lw=0.8)
    axes.set(xlabel="frame", ylabel="laser power, relative")
    axes.locator_params(axis="y", nbins=5)
    return figure


def _main_values(analysis: Analysis, table: pd.DataFrame) -> tuple[FloatArray, FloatArray, str]:
    """Give the main quantity of every row, its σ, and the label of its axis."""
    main = main_quantity(analysis)
    values = table[main.column].to_numpy(float)
    if f"sigma_{main.column}" in table:
        sigma = table[f"sigma_{main.column}"].to_numpy(float)
    else:
        sigma = as_contrasts(table.assign(contrast=values))["sigma_mass_kda"].to_numpy(float)
    return values, sigma, f"{main.label} [{main.unit}]" if main.unit else main.label


def histogram(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw the histogram of the main quantity: mass, contrast or height."""
    table = counted(table)
    values, sigma, label = _main_values(analysis, table)
    finite, good = np.isfinite(values), _is_ok(table)
    bins = histogram_bins(float(np.ptp(values[finite])), sigma[good & np.isfinite(sigma)])
    edges = np.histogram_bin_edges(values[finite], bins=bins)
    figure = new_figure(6.2, 3.2)
    axes = figure.add_subplot()
    ok, every = (np.histogram(values[part], bins=edges)[0] for part in (finite & good, finite))
    axes.stairs(ok, edges, fill=True, color=BLUE, label="ok")
    if (every > ok).any():
        axes.stairs(every, edges, baseline=ok, fill=True, color=PURPLE, label="flagged")
        figure.legend(loc="outside upper right", ncols=2)
    axes.set(xlabel=label, ylabel="events")
    axes.yaxis.set_major_locator(MaxNLocator(6, integer=True))
    return figure


def timeline(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw the main quantity against the frame."""
    values, _, label = _main_values(analysis, table)
    spans = analysis.summary.get("landing", {}).get("partly_searched", ())
    figure = new_figure(6.2, 3.3 if spans else 2.8)
    if not spans:
        axes = figure.add_subplot()
    else:
        axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(5, 1))
        for start, stop, share in spans:
            below.fill_between((start, stop), 100 * (1 - share), color=VERMILLION, lw=0)
        below.set(ylim=(0, 100), ylabel="hidden [%]", xlabel="frame")
    frames, good = table["frame"].to_numpy(float), _is_ok(table)
    _points(axes, frames, values, good, "o", color=BLUE, ms=3.5, alpha=0.8, mew=0, label="ok")
    if not good.all():
        _points(axes, frames, values, ~good, "x", color=PURPLE, ms=4, label="flagged")
        figure.legend(loc="outside upper right", ncols=2)
    axes.set(xlabel="" if spans else "frame", ylabel=label)
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
    return figure


def _is_ok(table: pd.DataFrame) -> BoolArray:
    return np.asarray(table["status"] == Status.OK.value, dtype=bool)


def precision(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw each event's σ and QCRB against its CRB, for every free parameter."""
    free = free_parameters(analysis.mode, table)
    figure = new_figure(3.0 * len(free), 3.4)
    good = _is_ok(table)
    for column, name in enumerate(free):
        axes = figure.add_subplot(1, len(free), column + 1)
        sigma, crb, qcrb = (
            table[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb")
        )
        usable = np.isfinite(crb) & (crb > 0)
        axes.set(title=label_of(analysis, name), xlabel=f"CRB [{UNITS[name]}]")
        if column == 0:
            axes.set_ylabel("σ and QCRB")
        if not usable.any():
            axes.text(0.5, 0.5, "no bound", ha="center", va="center", transform=axes.transAxes)
            continue
        ends = np.array([crb[usable].min() / 1.15, crb[usable].max() * 1.15])
        axes.plot(ends, ends, color=INK, lw=1.2, label="CRB")
        style: dict[str, Any] = {
            "ms": 3.5, "alpha": 0.7, "mew": 0, "linked": analysis.tracks is None
        }  # fmt: skip
        _points(axes, crb, qcrb, usable, "s", color=BLUE, label="QCRB", **style)
        _points(axes, crb, sigma, usable & good, "o", color=VERMILLION, label="σ", **style)
        if (usable & ~good).any():
            _points(axes, crb, sigma, usable & ~good, "x", color=PURPLE, label="σ, flagged",
                    linked=analysis.tracks is None, ms=4)  # fmt: skip
        axes.set(xscale="log", yscale="log", xlim=tuple(ends))
        _plain_log_ticks(axes)
    named = {
        text: mark
        for axes in figure.axes
        for mark, text in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if named:
        figure.legend(named.values(), named.keys(), loc="outside upper right", ncols=4, fontsize=8)
    return figure


def diagnostics(analysis: Analysis, table: pd.DataFrame) -> Figure | None:
    """Draw the tests of model and noise."""
    columns = [table[name].to_numpy(float) for name in ("chi2_reduced", "p_value")]
    chi2, p_value = (values[np.isfinite(values)] for values in columns)
    noise = analysis.summary.get("landing") or analysis.summary.get("background") or {}
    has_noise = len(noise.get("noise_frames", ())) > 1
    count = int(chi2.size > 1) + int(p_value.size > 1) + int(has_noise)
    if not count:
        return None
    figure = new_figure(3.2 * count, 2.7)
    panels = iter(np.atleast_1d(figure.subplots(1, count)))
    for values, label, window in ((chi2, "reduced χ²", None), (p_value, "p-value", (0.0, 1.0))):
        if values.size > 1:
            axes = next(panels)
            bins = 20 if window else int(np.clip(np.sqrt(values.size), 8, 40))
            axes.hist(values, bins=bins, range=window, color=GREY)
            if window:
                axes.axhline(values.size / bins, color=INK, lw=1, ls="--")
            else:
                axes.axvline(1.0, color=INK, lw=1, ls="--")
            axes.set(xlabel=label, ylabel="events")
            axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    if has_noise:
        axes = next(panels)
        axes.axhline(1.0, color=INK, lw=1, ls="--")
        over_shot = np.array(noise["noise_variance_over_shot"], dtype=float)
        axes.plot(noise["noise_frames"], over_shot, "o", color=VERMILLION, ms=4)
        axes.set(xscale="log", xlabel="frames averaged", ylabel="variance over shot noise")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_locator(NullLocator())
    return figure


def histogram_bins(extent: float, spread: FloatArray) -> int:
    """Count bins of two standard deviations, which do not blur neighbouring species."""
    width = 2 * float(np.median(spread)) if spread.size else 0.0
    return int(np.clip(extent / width, 10, 90)) if width > 0 else 10


def _plain_log_ticks(axes: Axes) -> None:
    """Label a log axis with plain numbers, few enough not to collide."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        narrow = high / low < 6
        axis.set_major_locator(MaxNLocator(4) if narrow else LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def spread_figure(analysis: Analysis, label_of: Callable[[Analysis, str], str]) -> Figure | None:
    """Draw the measured spread over the bound against the frames averaged.

    In mode ``track``, where none are, against the frames since the background.
    """
    found = {
        name: part
        for name, part in analysis.summary.get("precision", {}).items()
        if part.get("repeat_over_crb") is not None
    }
    if not found:
        return None
    window = float(np.median(counted(analysis.table)["n_after"]))
    figure = new_figure(3.0 * len(found), 3.0)
    for column, (name, part) in enumerate(found.items()):
        axes = figure.add_subplot(1, len(found), column + 1)
        axes.axhline(1.0, color=INK, lw=1)
        if analysis.mode == "track":
            _draw_frames(axes, part)
        else:
            _draw_windows(axes, part, window)
        axes.set_title(label_of(analysis, name))
        if column == 0:
            axes.set_ylabel("spread over CRB")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=3, fontsize=8)
    return figure


def _draw_windows(axes: Axes, part: Mapping[str, Any], window: float) -> None:
    """Draw the spread of averages against their frames."""
    _draw_curve(axes, part, "o", BLUE, "own frames")
    if part["empty_over_crb"]:
        lengths = window * np.array([1 / 8, 1 / 4, 1 / 2, 1])
        axes.plot(lengths, part["empty_over_crb"][1:], "s", color=GREY, ms=4, label="no particle")
    ratio, (low, high) = part["repeat_over_crb"], part["repeat_over_crb_ci95"]
    axes.errorbar(
        [window], [ratio], [[ratio - low], [high - ratio]], fmt="D", color=VERMILLION, ms=5,
        lw=1.2, label="estimates",
    )  # fmt: skip
    axes.set(xscale="log", xlabel="frames averaged")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _draw_frames(axes: Axes, part: Mapping[str, Any]) -> None:
    """Draw the spread of single frames against their distance from the background."""
    _draw_curve(axes, part, "s", GREY, "no particle")
    axes.axhline(part["repeat_over_crb"], color=VERMILLION, lw=1.2, label="all frames")
    axes.axhspan(*part["repeat_over_crb_ci95"], color=VERMILLION, alpha=0.2, lw=0)
    axes.axhline(part["empty_over_crb"][0], color=BLUE, lw=1, ls="--", label="successive frames")
    axes.set_xlabel("frames since the background")


def _draw_curve(axes: Axes, part: Mapping[str, Any], mark: str, color: str, label: str) -> None:
    axes.errorbar(
        part["repeat_frames"], part["repeat_over_crb_by_frames"],
        part["repeat_over_crb_by_frames_se"], fmt=mark, color=color, ms=3.5, lw=1, label=label,
    )  # fmt: skip
