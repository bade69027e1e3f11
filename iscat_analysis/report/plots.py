"""Figures for papers: few, each drawn into the axes that it is given, and returning them.

Without axes a figure is made, which shows itself in a notebook without pyplot.  No setting of
Matplotlib's outlasts a call, and none is changed for axes that are given.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import partial, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from iscat_analysis.config import SCHEMES
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.records import (
    Analysis,
    BoolArray,
    EventView,
    FloatArray,
    PosteriorResult,
    Status,
    Trace,
    counted,
    free_parameters,
    track_numbers,
)
from iscat_analysis.report.answer import (
    CONTRAST,
    DIAMETER,
    Quantity,
    as_diameters,
    label_of,
    main_parameter,
    main_quantity,
    precision_of,
    species_of,
    track_quantity,
)
from iscat_analysis.report.movie_figures import (
    CREDIBLE_LEVELS,
    MOST_ERRORS,
    bin_width,
    credible_shades,
)
from iscat_analysis.report.numbers import UNITS, number, parameter
from iscat_analysis.report.pictures import display_range, residual_limit, trace_data
from iscat_analysis.report.style import (
    BLUE,
    DPI,
    GREY,
    HALO,
    INK,
    PRINT_DPI,
    PURPLE,
    STYLE,
    VERMILLION,
    Style,
    floats,
    judged,
    new_figure,
    plain_log,
    points,
    scale_bar,
    whiskers,
)
from iscat_analysis.report.tables import event_table

SKY = "#56B4E9"
"""Colour of what leaves."""

DIVERGING = LinearSegmentedColormap.from_list("residual", ["#00528C", "#FAFAF8", "#BE4600"])
"""Colours of residuals."""

EVENT_FIGURES = 12
"""Events whose images are written, at most."""

P = ParamSpec("P")
R = TypeVar("R")


# ---- Axes and files ------------------------------------------------------------------------------


class Panels(np.ndarray[Any, np.dtype[np.object_]]):
    """Axes of one figure, which show it in a notebook."""

    def _repr_png_(self) -> bytes:
        return _png(figure_of(self))


def figure_of(drawn: Axes | Panels) -> Figure:
    """Give the figure of what was drawn, which shows itself in a notebook too."""
    first: Any = drawn if isinstance(drawn, Axes) else drawn.flat[0]
    figure: Figure = first.get_figure(root=True)
    setattr(figure, "_repr_png_", partial(_png, figure))  # noqa: B010
    return figure


def _png(figure: Figure) -> bytes:
    return contents(figure, "png", DPI)


def contents(figure: Figure, kind: str, dpi: int = PRINT_DPI) -> bytes:
    """Write a figure as a file's contents, the same at any time."""
    undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=undated.get(kind))
    return buffer.getvalue()


def _styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Draw in the style of this package, unless axes are given."""

    @wraps(draw)
    def styled(*args: P.args, **kwargs: P.kwargs) -> R:
        with mpl.rc_context(STYLE) if kwargs.get("ax") is None else nullcontext():
            return draw(*args, **kwargs)

    return styled


def _axes(ax: Axes | None, width: float, height: float) -> Axes:
    """Give the axes, or make some that show their figure in a notebook."""
    if ax is None:
        figure = new_figure(width, height)
        ax = figure.add_subplot()
        setattr(ax, "_repr_png_", partial(_png, figure))  # noqa: B010
    return ax


def _panels(ax: Any, *counts: int) -> Panels | None:
    """Give panels of which there may be so many; None where they are to be made."""
    if ax is None:
        return None
    given = np.atleast_1d(np.asarray(ax, dtype=object)).ravel()
    if given.size not in counts:
        allowed = " or ".join(map(str, sorted({*counts})))
        raise ConfigError(f"`ax`: has {given.size} axes, and this figure has {allowed}")
    return given.view(Panels)


def _made(axes: Iterable[Axes]) -> Panels:
    return np.array(list(axes), dtype=object).view(Panels)


def write_figures(
    analysis: Analysis,
    folder: Path,
    formats: Sequence[str] = ("png", "svg"),
    *,
    views: Iterable[EventView] | None = None,
) -> list[Path]:
    """Write the figures of an analysis, with images of the first events."""
    written = []
    folder.mkdir(exist_ok=True)
    for name, draw in _figures(analysis, analysis.views if views is None else views):
        figure = figure_of(draw())
        for kind in formats:
            written.append(folder / f"{name}.{kind}")
            written[-1].write_bytes(contents(figure, kind))
    return written


def _figures(
    analysis: Analysis, views: Iterable[EventView]
) -> Iterator[tuple[str, Callable[[], Axes | Panels]]]:
    """Name the figures of an analysis that have something to show, and what draws them."""
    tracks = analysis.tracks
    rows = counted(analysis.table) if tracks is None else tracks
    yield "field", partial(plot_field, analysis)
    if np.isfinite(_quantity(analysis).values(rows)[0]).any():
        yield "masses", partial(plot_masses, analysis)
        yield "precision", partial(plot_precision, analysis)
    if tracks is not None and (tracks["d_um2_s"] > 0).any():
        yield "tracks", partial(plot_tracks, analysis)
    first = {view.event: view for view in reversed(list(views))}
    for event, view in sorted(first.items())[:EVENT_FIGURES]:
        scheme, pixel_nm = analysis.scheme, analysis.pixel_size_nm
        yield f"event_{event:04d}", partial(plot_event, view, scheme, pixel_nm)
        if view.posterior is not None and view.posterior.converged:
            yield f"corner_{event:04d}", partial(plot_corner, view.posterior, event)


# ---- Masses --------------------------------------------------------------------------------------


@_styled
def plot_masses(
    analysis: Analysis, *, ax: Axes | None = None, bins: int | ArrayLike | None = None
) -> Axes:
    """Draw the histogram of the main quantity, landings and leavings by magnitude, and species."""
    quantity = _quantity(analysis)
    rows = counted(event_table(analysis)) if analysis.tracks is None else analysis.tracks
    values, sigma = quantity.values(rows)
    values = np.abs(values)
    known, good = np.isfinite(values), np.asarray(rows["status"] == Status.OK.value, dtype=bool)
    if not known.any():
        raise DataError(f"{_movie(analysis)}: no event was found, so there are no masses to draw")
    if bins is None:
        wide, ends = bin_width(values[known], sigma[known & good]), values[known]
        bins = np.arange(np.floor(ends.min() / wide) * wide, ends.max() + wide, wide)
    edges: Any = np.histogram_bin_edges(values[known], bins=bins)
    leaves = np.asarray((rows["mass_kda"] < 0) & ("landing" in analysis.summary), dtype=bool)
    parts = {
        "landing" if leaves.any() else "ok": (known & good & ~leaves, BLUE),
        "leaving": (known & good & leaves, SKY),
        "flagged": (known & ~good, GREY),
    }
    parts = {name: part for name, part in parts.items() if part[0].any()}
    axes = _axes(ax, 6.2, 3.4)
    style: Style = {"color": [color for _, color in parts.values()], "label": list(parts)}
    counts = axes.hist([values[rows] for rows, _ in parts.values()], edges, stacked=True, **style)
    top = float(np.max(counts[0]))
    found = species_of(analysis)
    if len(found):
        grid, density = _species_curve(analysis, quantity, float(np.mean(np.diff(edges))))
        axes.plot(grid, density, color=VERMILLION, lw=1.4, label="species")
        top = max(top, float(np.max(density, initial=0)))
        for value, events in found[[str(found.columns[0]), "count"]].to_numpy(float):
            place = value, float(np.interp(value, grid, density)) if grid.size else 0.0
            text = f"{number(value)} {quantity.unit}".strip() + f"\n{events:.0f}"
            above: Style = {"xytext": (0, 3), "textcoords": "offset points", "ha": "center"}
            axes.annotate(text, place, fontsize="small", **above)
    if len(parts) + len(found) > 1:
        axes.legend(fontsize="small")
    noun = "events" if analysis.tracks is None else "tracks"
    axes.set(xlabel=quantity.axis, ylabel=noun, ylim=(0, 1.25 * top))
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    return axes


def _quantity(analysis: Analysis) -> Quantity:
    """Choose what a histogram is of: of spheres that are followed, the optical diameter."""
    if analysis.tracks is None:
        return main_quantity(analysis)
    if analysis.summary.get("sizes"):
        column = "optical_diameter_nm"
        return Quantity(column, "optical diameter", "nm") if column in analysis.tracks else DIAMETER
    return track_quantity(analysis)


def _species_curve(
    analysis: Analysis, quantity: Quantity, width: float
) -> tuple[FloatArray, FloatArray]:
    """Give the events per bin that the species make, on the scale of a quantity."""
    if sizes := analysis.summary.get("sizes"):
        curve = sizes["curve"]
        return floats(curve["diameter_nm"]), width * floats(curve["model"])
    curve = analysis.summary["distribution"].get("curves") or {"mass_kda": (), "model": ()}
    mass, model = floats(curve["mass_kda"]), floats(curve["model"])
    if not quantity.power:
        return mass, width * model
    good = analysis.table[analysis.table["status"] == Status.OK.value]
    per = float((good[quantity.column] / good["mass_kda"] ** quantity.power).abs().median())
    mass, model = mass[mass > 0], model[mass > 0]
    slope = per * quantity.power * mass ** (quantity.power - 1)
    return per * mass**quantity.power, width * model / slope


# ---- Precision -----------------------------------------------------------------------------------


@_styled
def plot_precision(analysis: Analysis, *, ax: Any = None) -> Panels:
    """Draw each event's σ and QCRB against its CRB: a panel for each free parameter.

    One axes, if `ax` is one, takes the mass, or else the height.
    """
    table = event_table(analysis)
    names = free_parameters(analysis.mode, table)
    panels = _panels(ax, 1, len(names))
    if panels is None:
        figure = new_figure(3.0 * len(names), 3.2)
        panels = _made(figure.subplots(1, len(names), squeeze=False)[0])
    elif panels.size < len(names):
        names = (main_parameter(analysis),)
    for axes, name in zip(panels, names, strict=True):
        _draw_precision(axes, analysis, table, name)
    panels[0].set_ylabel("σ and QCRB")
    panels[0].legend(fontsize="small")
    return panels


def _draw_precision(axes: Axes, analysis: Analysis, table: pd.DataFrame, name: str) -> None:
    """Draw σ and QCRB of one parameter against its CRB, on the scale of the main quantity."""
    label, unit, scale = label_of(analysis, name), UNITS[name], np.ones(len(table))
    main, measured = main_quantity(analysis), precision_of(analysis, table, name)
    if name == "mass_kda" and main is DIAMETER:
        table, label, unit = as_diameters(table), main.label, main.unit
    elif name == "mass_kda" and main.power:
        label, unit = main.label, "10⁻³" if main is CONTRAST else main.unit
        scale = main.power * (table[main.column] / table[name]).abs().to_numpy(float)
        scale = 1e3 * scale if main is CONTRAST else scale
    sigma, crb, qcrb = (
        scale * table[f"{kind}_{name}"].to_numpy(float) for kind in ("sigma", "crb", "qcrb")
    )
    usable, good = np.isfinite(crb) & (crb > 0), np.asarray(table["status"] == Status.OK.value)
    title = f"{label}\nmeasured / CRB {measured.measured_text}" if measured.is_measured else label
    axes.set(title=title, xlabel=f"CRB [{unit}]" if unit else "CRB")
    if not usable.any():
        axes.text(0.5, 0.5, "no bound", ha="center", va="center", transform=axes.transAxes)
        return
    ends = np.array([crb[usable].min() / 1.15, crb[usable].max() * 1.15])
    axes.plot(ends, ends, color=INK, lw=1.2, label="CRB")
    for values, rows, mark, color, said in (
        (qcrb, usable, "s", BLUE, "QCRB"),
        (sigma, usable & good, "o", VERMILLION, "σ"),
        (sigma, usable & ~good, "x", PURPLE, "σ, flagged"),
    ):
        if rows.any():
            style: Style = {"ms": 3.5, "mew": mark == "x", "color": color, "label": said}
            points(axes, crb, values, rows, mark, style=style)
    axes.set_xlim(*ends)
    plain_log(axes, "x", "y")


# ---- The field -----------------------------------------------------------------------------------


@_styled
def plot_field(analysis: Analysis, *, ax: Axes | None = None) -> Axes:
    """Draw the field of view with a numbered ring for each event, or the paths of the tracks.

    A stored result has no image of the field: its places are drawn on an empty one.
    """
    image, table = np.asarray(analysis.ratio_image, float), event_table(analysis)
    places = table[["x_px", "y_px"]].to_numpy(float)
    rows, columns = image.shape if image.size else analysis.summary["input"]["shape"][-2:]
    axes = _axes(ax, 6.2, float(np.clip(5.2 * rows / columns, 1.5, 7.5)) + 0.5)
    bright = 1.0 if analysis.tracks is None else 2.0
    if image.size:
        low, high = (bright * end for end in display_range([image], analysis.scheme))
        shown = axes.imshow(image, "gray", vmin=low, vmax=high, interpolation="antialiased")
        scale_bar(axes, columns, rows, analysis.pixel_size_nm)
    if analysis.tracks is not None:
        _draw_paths(axes, analysis, table)
    else:
        ring: Style = {"mfc": "none", "mec": "#F0E442" if image.size else BLUE, "ms": 11, "mew": 1}
        every = np.ones(len(table), dtype=bool)
        points(axes, places[:, 0], places[:, 1], every, style=ring)
        white: Style = {"color": "white", "path_effects": HALO} if image.size else {"color": INK}
        first = table.drop_duplicates("event")[["event", "x_px", "y_px"]].dropna()
        for event, *place in first.head(100).to_numpy(float):
            beside: Style = {"xytext": (7, 0), "textcoords": "offset points", "va": "center"}
            axes.annotate(f"{event:.0f}", place, fontsize=7, in_layout=False, **beside, **white)
        if image.size:
            unit = analysis.scheme_kind.image_unit
            figure_of(axes).colorbar(shown, ax=axes, label=unit, fraction=0.05, pad=0.02)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    stretch = float(np.clip(rows / columns, 1 / 5, 5)) * columns / rows
    axes.set_aspect(stretch)
    if stretch != 1:  # else nothing could be recognised
        words = "tall as wide" if stretch > 1 else "wide as tall"
        times = max(stretch, 1 / stretch)
        axes.set_title(f"pixels are drawn {times:.2g} times as {words}", fontsize=8)
    return axes


def _draw_paths(axes: Axes, analysis: Analysis, fits: pd.DataFrame) -> None:
    """Draw the paths of tracks, coloured by mass; the scale covers those that are ok."""
    tracks, quantity = analysis.tracks, track_quantity(analysis)
    if tracks is None or tracks.empty:
        return
    sizes = np.abs(quantity.values(tracks)[0])
    good = np.isfinite(sizes) & _is_ok(tracks)
    trusted = sizes[good if good.any() else np.isfinite(sizes)]
    low, high = (float(trusted.min()), float(trusted.max())) if trusted.size else (0.0, 1.0)
    norm = Normalize(low, high if high > low else 1.1 * low)
    colors = mpl.colormaps["viridis"]
    paths = dict(iter(fits.sort_values("frame").groupby(track_numbers(fits))))
    lines = [paths[track][["x_px", "y_px"]].to_numpy(float) for track in tracks["track"]]
    shades = [colors(norm(size)) if np.isfinite(size) else "0.6" for size in sizes]
    drawn = LineCollection(lines, colors=shades, linewidths=1.1, capstyle="round")
    drawn.set_rasterized(sum(map(len, lines)) > 20_000)
    axes.add_collection(drawn)
    beyond = np.nanmin(sizes) < low, np.nanmax(sizes) > high
    extend = ("neither", "max", "min", "both")[2 * beyond[0] + beyond[1]]
    scale: Style = {"label": quantity.axis, "fraction": 0.05, "pad": 0.02, "extend": extend}
    shown = mpl.cm.ScalarMappable(norm, colors)
    figure_of(axes).colorbar(shown, ax=axes, **scale)


@_styled
def plot_tracks(analysis: Analysis, *, ax: Axes | None = None) -> Axes:
    """Draw mass, or contrast, and diffusion coefficient of every track with their errors."""
    tracks, quantity = analysis.tracks, track_quantity(analysis)
    if tracks is None:
        raise DataError(f"{_movie(analysis)}: has no tracks, which mode track makes")
    sizes, sigma = quantity.values(tracks)
    sizes = np.abs(sizes)
    d, d_sigma = (tracks[name].to_numpy(float) for name in ("d_um2_s", "sigma_d_um2_s"))
    usable = np.isfinite(sizes) & (d > 0)
    if not usable.any():
        raise DataError(f"{_movie(analysis)}: no track has both a mass and a D")
    axes = _axes(ax, 5.2, 4.0)
    factor = np.exp(d_sigma / d)  # the bars of a logarithmic axis stay above zero
    bars = np.array([d - d / factor, d * factor - d])
    for rows, color, name in judged(usable, _is_ok(tracks)):
        if rows.sum() <= MOST_ERRORS:
            style: Style = {"ls": "none", "elinewidth": 0.7, "alpha": 0.6, "color": color}
            axes.errorbar(sizes[rows], d[rows], bars[:, rows], sigma[rows], **style)
        dots: Style = {"color": color, "ms": 3.5, "mew": 0, "label": name}
        points(axes, sizes, d, rows, style=dots)
    if not _is_ok(tracks)[usable].all():
        axes.legend(fontsize="small")
    axes.set(xlabel=quantity.axis, ylabel="D [µm²/s]")
    plain_log(axes, "y")
    return axes


def _is_ok(rows: pd.DataFrame) -> BoolArray:
    return np.asarray(rows["status"] == Status.OK.value, dtype=bool)


def _movie(analysis: Analysis) -> str:
    return analysis.provenance.input_path or "the movie"


# ---- One event -----------------------------------------------------------------------------------


@_styled
def plot_event(view: EventView, scheme: str, pixel_size_nm: float, *, ax: Any = None) -> Panels:
    """Draw data, model and residual of one event, and its contrast against frame where known.

    `ax` are three axes, or four, of which the last takes the contrast.
    """
    panels, traced = _panels(ax, 3, 4), view.trace is not None
    rows, columns = view.contrast.shape
    if panels is None:
        tall = 2.55 * float(np.clip(rows / columns, 0.3, 3.0)) + 1.2
        figure = new_figure(8.4, tall + 2.0 * traced)
        grid = figure.add_gridspec(1 + traced, 3, height_ratios=(tall, 2.0)[: 1 + traced])
        places = [*(grid[0, k] for k in range(3)), *(grid[k, :] for k in range(1, 1 + traced))]
        panels = _made(figure.add_subplot(place) for place in places)
    grey = *display_range([view.contrast, view.model], scheme), "gray"
    limit = residual_limit(view.residual)
    unit = SCHEMES[scheme].image_unit
    for axes, image, (low, high, colours), title, label in zip(
        panels,
        (view.contrast, view.model, view.residual),
        (grey, grey, (-limit, limit, DIVERGING)),
        (f"event {view.event}, data", "model", "residual"),
        (unit, unit, "σ"),
        strict=False,
    ):
        shown = axes.imshow(image, colours, vmin=low, vmax=high, interpolation="nearest")
        axes.set(xticks=[], yticks=[], title=title)
        axes.spines[:].set_visible(False)
        bar: Style = {"orientation": "horizontal", "fraction": 0.05, "pad": 0.03}
        scale = figure_of(axes).colorbar(shown, ax=axes, label=label, **bar)
        scale.ax.locator_params(nbins=4)
    scale_bar(panels[0], columns, rows, pixel_size_nm)
    if view.trace is not None and panels.size == 4:
        _draw_trace(panels[3], view.trace)
    return panels


def _draw_trace(axes: Axes, trace: Trace) -> None:
    """Draw the contrast of every frame, means of some, and the fitted step."""
    told = trace_data(trace)
    frames, means, step = (
        np.array([floats(told[name]["frame"]), floats(told[name]["contrast"])])
        for name in ("frames", "means", "step")
    )
    half = max(trace.half_width, 0.5)
    axes.axvspan(trace.frame - half, trace.frame + half, color=BLUE, alpha=0.18, lw=0)
    axes.plot(frames[0] + 0.5, frames[1], color=GREY, lw=0.6, alpha=0.6)
    axes.plot(*means, ".", color=INK, ms=3.5)
    axes.plot(*step, color=VERMILLION, lw=1.6)
    axes.set(xlabel="frame", ylabel="contrast [10⁻³]", xlim=(frames[0, 0], frames[0, -1] + 1))


@_styled
def plot_corner(posterior: PosteriorResult, event: int) -> Panels:
    """Draw a posterior: each parameter, and each pair."""
    n, bins = len(posterior.names), 24
    flat = posterior.samples.reshape(-1, n)
    figure = new_figure(1.9 * n + 0.6, 1.9 * n + 0.6, constrained=False)
    grid = figure.subplots(n, n, squeeze=False, gridspec_kw={"wspace": 0.08, "hspace": 0.08})
    figure.subplots_adjust(left=0.14, right=0.98, bottom=0.12, top=0.93)
    ends = np.quantile(flat, [0.001, 0.999], axis=0).T
    pads = 0.05 * np.ptp(ends, axis=1)
    ends += np.outer(np.where(pads > 0, pads, 0.5), [-1, 1])
    quantiles = np.quantile(flat, [0.15865, 0.5, 0.84135], axis=0)
    shades = LinearSegmentedColormap.from_list("shades", ["white", BLUE])
    for i, j in np.ndindex(n, n):
        axes: Any = grid[i, j]
        if j > i:
            axes.set_axis_off()
            continue
        if i == j:
            axes.hist(flat[:, i], bins=bins, range=ends[i], color=BLUE, alpha=0.35)
            for value in quantiles[:, i]:
                axes.axvline(value, color=INK, lw=0.8, ls="--")
            axes.set_yticks([])
        else:
            span = [ends[j], ends[i]]
            counts, ex, ey = np.histogram2d(flat[:, j], flat[:, i], bins=bins, range=span)
            inside: Style = {"vmin": 0, "vmax": len(CREDIBLE_LEVELS), "rasterized": True}
            axes.pcolormesh(ex, ey, credible_shades(counts).T, cmap=shades, **inside)
            axes.set_ylim(*ends[i])
            axes.locator_params(axis="y", nbins=4)
        axes.set_xlim(*ends[j])
        axes.locator_params(axis="x", nbins=3)
        axes.tick_params(labelbottom=i == n - 1, labelleft=not j and i > 0)
        if i == n - 1:
            axes.set_xlabel(parameter(posterior.names[j]))
        if i and not j:
            axes.set_ylabel(parameter(posterior.names[i]))
        axes.ticklabel_format(useOffset=False)
    figure.suptitle(f"Posterior of event {event}", x=0.14, ha="left", fontsize=10)
    return _made(grid.ravel())


# ---- Equilibria ----------------------------------------------------------------------------------


@_styled
def plot_kd(found: Mapping[str, Any], *, ax: Any = None) -> Panels:
    """Draw fractions of complexes with their intervals and the equilibrium, and the likelihood.

    `found` is the document ``kd``; `ax` are two axes, or one for the fractions alone.
    """
    panels = _panels(ax, 1, 2)
    if panels is None:
        panels = _made(new_figure(9.6, 3.6).subplots(1, 2, width_ratios=(1.7, 1)))
    left, dimer = panels[0], found["model"] == "dimer"
    rows, names = found["samples"], ("complexes", "complexes_low", "complexes_high", "predicted")
    at = floats(row["concentration_nm"] if dimer else row["a_nm"] + row["b_nm"] for row in rows)
    share, low, high, predicted = (floats(row.get(name) for row in rows) for name in names)
    side = np.ones(at.size)
    for value in np.unique(at):  # replicates beside each other
        same = np.flatnonzero(at == value)
        side[same] = 1 + 0.06 * (np.arange(same.size) - (same.size - 1) / 2)
    whiskers(left, at * side, share, (low, high), style={"color": BLUE, "label": "tables, 95 %"})
    line: Style = {"color": VERMILLION, "label": "equilibrium"}
    if dimer:
        left.plot(found["curve"]["concentration_nm"], found["curve"]["complexes"], **line)
    else:
        left.plot(at * side, predicted, "_", ms=12, mew=1.6, **line)
    both, complexes = ("monomers", "dimers") if dimer else ("A and B", "AB")
    left.set(xscale="log", ylim=(0, 1))
    left.set(xlabel=f"{both} in all [nM]", ylabel=f"{complexes} among the particles")
    left.legend(loc="upper left")
    if panels.size == 2:
        _draw_profile(panels[1], found)
    return panels


def _draw_profile(axes: Axes, found: Mapping[str, Any]) -> None:
    """Draw twice the log-likelihood lost against K_D, and the limit of a 95 % interval."""
    limit, best = 3.84, found["kd_nm"]
    at, deviance = floats(found["profile"]["ln_kd_nm"]), floats(found["profile"]["deviance"])
    if at.size > 1:
        root = np.sign(at - np.log(best)) * np.sqrt(deviance)
        fine = np.linspace(at[0], at[-1], 100)
        axes.plot(np.exp(fine), np.interp(fine, at, root) ** 2, color=INK)
    axes.plot(np.exp(at), deviance, "o", ms=3.5, color=INK)
    axes.axhline(limit, color=GREY, lw=0.8, ls="--")
    axes.axvline(best, color=VERMILLION, lw=1)
    axes.set(xlabel="$K_D$ [nM]", ylabel="2 (largest log-likelihood − profile)")
    axes.set(ylim=(0, 2.2 * limit), title=f"$K_D$ = {number(best)} nM")
    low, high = found["kd_low"], found["kd_high"]
    if low and high:
        beyond = (high / low) ** 0.5
        axes.set_xlim(low / beyond, high * beyond)
