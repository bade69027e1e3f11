"""The figures of one analysis, for its folder, its page, and one at a time for a notebook."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from iscat_analysis.records import Analysis, BoolArray, FloatArray, Status, counted, free_parameters
from iscat_analysis.report import track_figures
from iscat_analysis.report.answer import label_of, main_quantity
from iscat_analysis.report.numbers import UNITS
from iscat_analysis.report.plots import histogram_bins
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    HALO,
    INK,
    PURPLE,
    VERMILLION,
    Sketch,
    Style,
    around,
    field_figure,
    floats,
    judged,
    legend,
    new_figure,
    one_panel,
    plain_log,
    points,
    row_of_panels,
    whiskers,
    whole_numbers,
)

_NAMES = {"mass_kda": "mass", "z_nm": "height", "n_scattered": "photon"}


def page_figures(analysis: Analysis, table: pd.DataFrame) -> Iterator[Sketch]:
    """Name the figures of the report page, and what draws them."""
    main = main_quantity(analysis).column
    fitted = np.isfinite(counted(table)[main].to_numpy(float)).any()
    if analysis.tracks is not None:
        yield from track_figures.track_figures(analysis, table)
    elif np.asarray(analysis.ratio_image).size:
        yield "overview", partial(overview, analysis, table)
    if fitted and analysis.tracks is None:
        yield f"{_NAMES.get(main, main)}_histogram", partial(histogram, analysis, table)
        yield "timeline", partial(timeline, analysis, table)
    if fitted:
        yield "precision", partial(precision, analysis, table)
    yield "spread", partial(spread, analysis)
    yield "budget", partial(budget, analysis)
    yield "diagnostics", partial(diagnostics, analysis, table)
    if analysis.summary.get("timeline"):
        yield "movie", partial(movie_figure, analysis)


# ---- The field -----------------------------------------------------------------------------------


def overview(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw the field of view with its events numbered."""
    image = np.asarray(analysis.ratio_image, float)
    # Matplotlib leaves the pixels of small images to the browser, and averages those of large ones.
    how = "none" if max(image.shape) <= 640 else "antialiased"
    figure, axes, shown = field_figure(
        image, analysis.scheme, analysis.pixel_size_nm, style={"interpolation": how}
    )
    unit = analysis.scheme_kind.image_unit
    figure.colorbar(shown, ax=axes, label=unit, fraction=0.05, pad=0.02)
    x, y = table["x_px"].to_numpy(float), table["y_px"].to_numpy(float)
    ring: Style = {"mfc": "none", "mec": "#F0E442", "ms": 11, "mew": 1}
    points(axes, x, y, np.isfinite(x), style=ring)
    white: Style = {"color": "white", "fontsize": 7, "path_effects": HALO, "in_layout": False}
    first = table.drop_duplicates("event")[["event", "x_px", "y_px"]].dropna()
    for number, *place in first.head(100).to_numpy(float):
        beside: Style = {"xytext": (7, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(f"{number:.0f}", place, annotation_clip=True, **beside, **white)
    return figure


# ---- The main quantity ---------------------------------------------------------------------------


def histogram(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw the histogram of the main quantity: mass, contrast or height."""
    table, main = counted(table), main_quantity(analysis)
    values, sigma = main.values(table)
    finite, good = np.isfinite(values), _is_ok(table)
    bins = histogram_bins(float(np.ptp(values[finite])), sigma[good & np.isfinite(sigma)])
    edges = np.histogram_bin_edges(values[finite], bins=bins)
    figure, axes = one_panel(6.2, 3.2)
    ok, every = (np.histogram(values[part], bins=edges)[0] for part in (finite & good, finite))
    _stacked(axes, edges, ok, every - ok, PURPLE)
    legend(figure)
    whole_numbers(axes, main.axis)
    return figure


def _stacked(axes: Axes, edges: Any, ok: FloatArray, flagged: FloatArray, color: str) -> None:
    """Draw numbers of events that are ok, and of others above them."""
    axes.stairs(ok, edges, fill=True, color=BLUE, label="ok" if flagged.any() else None)
    if flagged.any():
        style: Style = {"fill": True, "color": color, "label": "flagged"}
        axes.stairs(ok + flagged, edges, baseline=ok, **style)


def timeline(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw the main quantity against the frame."""
    main = main_quantity(analysis)
    values = table[main.column].to_numpy(float)
    spans = analysis.summary.get("landing", {}).get("partly_searched", ())
    figure = new_figure(6.2, 3.3 if spans else 2.8)
    if not spans:
        axes = figure.add_subplot()
    else:
        axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(5, 1))
        for start, stop, share in spans:
            below.fill_between((start, stop), 100 * (1 - share), color=VERMILLION, lw=0)
        below.set(ylim=(0, 100), ylabel="hidden [%]", xlabel="frame")
    frames, every = table["frame"].to_numpy(float), np.ones(len(table), dtype=bool)
    for rows, color, name in judged(every, _is_ok(table)):
        mark, width = ("o", 0) if name == "ok" else ("x", 1)
        style: Style = {"color": color, "ms": 3.5, "mew": width, "label": name}
        points(axes, frames, values, rows, mark, style=style)
    if not _is_ok(table).all():
        legend(figure)
    axes.set(xlabel="" if spans else "frame", ylabel=main.axis)
    axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
    return figure


def _is_ok(table: pd.DataFrame) -> BoolArray:
    return np.asarray(table["status"] == Status.OK.value, dtype=bool)


# ---- Precision -----------------------------------------------------------------------------------


def precision(analysis: Analysis, table: pd.DataFrame) -> Figure:
    """Draw each event's σ and QCRB against its CRB, for every free parameter."""
    free, good = free_parameters(analysis.mode, table), _is_ok(table)
    figure, panels = row_of_panels(len(free), 3.0, 3.4)
    panels[0].set_ylabel("σ and QCRB")
    linked = analysis.tracks is None
    for axes, name in zip(panels, free, strict=True):
        sigma, crb, qcrb = (
            table[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb")
        )
        usable = np.isfinite(crb) & (crb > 0)
        axes.set(title=label_of(analysis, name), xlabel=f"CRB [{UNITS[name]}]")
        if not usable.any():
            axes.text(0.5, 0.5, "no bound", ha="center", va="center", transform=axes.transAxes)
            continue
        ends = np.array([crb[usable].min() / 1.15, crb[usable].max() * 1.15])
        axes.plot(ends, ends, color=INK, lw=1.2, label="CRB")
        for values, rows, mark, color, label in (
            (qcrb, usable, "s", BLUE, "QCRB"),
            (sigma, usable & good, "o", VERMILLION, "σ"),
            (sigma, usable & ~good, "x", PURPLE, "σ, flagged"),
        ):
            if rows.any():
                style: Style = {"ms": 3.5, "mew": mark == "x", "color": color, "label": label}
                points(axes, crb, values, rows, mark, linked=linked, style=style)
        axes.set_xlim(*ends)
        plain_log(axes, "x", "y")
    legend(figure)
    return figure


def spread(analysis: Analysis) -> Figure | None:
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
    figure, panels = row_of_panels(len(found), 3.0, 3.0)
    panels[0].set_ylabel("spread over CRB")
    for axes, (name, part) in zip(panels, found.items(), strict=True):
        axes.axhline(1.0, color=INK, lw=1)
        if analysis.mode_kind.follows_tracks:
            _draw_frames(axes, part)
        else:
            _draw_windows(axes, part, window)
        axes.set_title(label_of(analysis, name))
    legend(figure)
    return figure


def _draw_windows(axes: Axes, part: Mapping[str, Any], window: float) -> None:
    """Draw the spread of averages against their frames."""
    _draw_curve(axes, part, "o", BLUE, "own frames")
    if part["empty_over_crb"]:
        lengths = window * np.array([1 / 8, 1 / 4, 1 / 2, 1])
        axes.plot(lengths, part["empty_over_crb"][1:], "s", color=GREY, ms=4, label="no particle")
    ends = np.array(part["repeat_over_crb_ci95"])[:, None]
    mark: Style = {"fmt": "D", "color": VERMILLION, "ms": 5, "label": "estimates"}
    whiskers(axes, [window], [part["repeat_over_crb"]], ends, style=mark)
    plain_log(axes, "x")
    axes.set_xlabel("frames averaged")


def _draw_frames(axes: Axes, part: Mapping[str, Any]) -> None:
    """Draw the spread of single frames against their distance from the background."""
    _draw_curve(axes, part, "s", GREY, "no particle")
    axes.axhline(part["repeat_over_crb"], color=VERMILLION, lw=1.2, label="all frames")
    axes.axhspan(*part["repeat_over_crb_ci95"], color=VERMILLION, alpha=0.2, lw=0)
    axes.axhline(part["empty_over_crb"][0], color=BLUE, lw=1, ls="--", label="successive frames")
    axes.set_xlabel("frames since the background")


def _draw_curve(axes: Axes, part: Mapping[str, Any], mark: str, color: str, label: str) -> None:
    spread, error = (floats(part[f"repeat_over_crb_by_frames{end}"]) for end in ("", "_se"))
    style: Style = {"fmt": mark, "color": color, "label": label, "ms": 3.5}
    whiskers(axes, part["repeat_frames"], spread, around(spread, error), style=style)


def budget(analysis: Analysis) -> Figure | None:
    """Draw a bar for each source of the error of a mass, the largest first."""
    known = [one for one in analysis.summary.get("budget", ()) if one["sigma_rel"]]
    known = sorted(known, key=lambda one: -one["sigma_rel"])
    known = [one for one in known if one["sigma_rel"] > 1e-3 * known[0]["sigma_rel"]]
    if not known:
        return None
    figure, axes = one_panel(6.5, 0.7 + 0.3 * len(known))
    colors = {"measured": BLUE, "learned": VERMILLION, "assumed": GREY}
    for place, one in enumerate(known):
        long, alpha = 100 * one["sigma_rel"], 1.0 if one["common"] else 0.5
        axes.barh(place, long, height=0.6, color=colors[one["kind"]], alpha=alpha)
        text = f" {one['kind']}{'' if one['common'] else ', each row its own'}"
        axes.annotate(text, (long, place), va="center", fontsize=8, color=INK)
    axes.set_yticks(range(len(known)), [fill(one["name"], 34) for one in known])
    axes.invert_yaxis()
    axes.set_xlim(0, 170 * known[0]["sigma_rel"])
    axes.set_xlabel("standard deviation over the mass [%]")
    return figure


def diagnostics(analysis: Analysis, table: pd.DataFrame) -> Figure | None:
    """Draw the tests of model and noise."""
    columns = [table[name].to_numpy(float) for name in ("chi2_reduced", "p_value")]
    chi2, p_value = (values[np.isfinite(values)] for values in columns)
    noise = analysis.summary.get("landing") or analysis.summary.get("background") or {}
    measured = len(noise.get("noise_frames", ())) > 1
    number = (chi2.size > 1) + (p_value.size > 1) + measured
    if not number:
        return None
    figure, panels = row_of_panels(number, 3.2, 2.7)
    left = iter(panels)
    if chi2.size > 1:
        axes = next(left)
        axes.hist(chi2, bins=int(np.clip(np.sqrt(chi2.size), 8, 40)), color=GREY)
        axes.axvline(1.0, color=INK, lw=1, ls="--")
        whole_numbers(axes, "reduced χ²")
    if p_value.size > 1:
        axes = next(left)
        axes.hist(p_value, bins=20, range=(0.0, 1.0), color=GREY)
        axes.axhline(p_value.size / 20, color=INK, lw=1, ls="--")
        whole_numbers(axes, "p-value")
    if measured:
        axes = next(left)
        axes.axhline(1.0, color=INK, lw=1, ls="--")
        over_shot = floats(noise["noise_variance_over_shot"])
        axes.plot(noise["noise_frames"], over_shot, "o", color=VERMILLION, ms=4)
        plain_log(axes, "x")
        axes.set(xlabel="frames averaged", ylabel="variance over shot noise")
    return figure


# ---- Where in the movie? -------------------------------------------------------------------------


def movie_figure(analysis: Analysis) -> Figure:
    """Draw light, noise, focus, drift and events of a movie, on one axis of frames."""
    course = analysis.summary["timeline"]
    frames, noise, focus, x, y = (
        floats(course[name])
        for name in ("frames", "noise_over_expected", "focus_nm", "drift_x_px", "drift_y_px")
    )
    if not analysis.scheme_kind.interferes:
        focus = focus * np.nan
    rows: list[tuple[str, Any, Any, str]] = [
        ("light,\nrelative", analysis.power_frames, [analysis.power], "-"),
        ("noise,\nvariance over\nexpected", frames, [noise], "o"),
        ("focus\n[nm]", frames, [focus], "-"),
        ("drift\n[px]", frames, [x, y], "-"),
    ]
    rows = [row for row in rows if np.isfinite(row[2]).any()]
    figure = new_figure(7.0, 1.47 + 0.72 * len(rows))
    panels = figure.subplots(len(rows) + 1, 1, sharex=True, squeeze=False)[:, 0]
    for axes, (label, at, lines, mark) in zip(panels, rows, strict=False):
        for values, color, name in zip(lines, (BLUE, VERMILLION), "xy", strict=False):
            named = name if len(lines) > 1 else None
            axes.plot(at, values, mark, color=color, lw=1, ms=2.5, label=named)
        _name_row(axes, label)
    edges = course["events"]["edges"]
    ok, flagged = (np.array(course["events"][name]) for name in ("ok", "flagged"))
    _stacked(panels[-1], edges, ok, flagged, VERMILLION)
    _name_row(panels[-1], "events")
    narrow = 0.004 * (edges[-1] - edges[0])  # the least that is seen of an interval
    for one in course["intervals"]:
        style: Style = {"color": PURPLE, "alpha": 0.3, "label": "left out"}
        if one["what"].startswith("partly"):
            style = {"color": GREY, "alpha": 0.2, "label": "partly hidden"}
        for axes in panels:
            axes.axvspan(one["start"], max(one["stop"], one["start"] + narrow), lw=0, **style)
    panels[-1].set(xlabel="frame", xlim=(edges[0], edges[-1]))
    panels[-1].xaxis.set_major_locator(MaxNLocator(7, integer=True))
    legend(figure)
    return figure


def _name_row(axes: Axes, label: str) -> None:
    """Name a row at its left, with 0.7 inches for its numbers: measuring takes half of drawing."""
    axes.set_ylabel(label, rotation=0, ha="right", va="center")
    figure = axes.get_figure(root=True)
    beside = ScaledTranslation(-0.7, 0, figure.dpi_scale_trans) if figure else axes.transAxes
    axes.yaxis.set_label_coords(0, 0.5, transform=axes.transAxes + beside)
    axes.yaxis.set_major_locator(MaxNLocator(3, integer=label == "events"))
