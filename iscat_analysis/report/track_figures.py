"""The figures of a movie of moving particles: where they went, how heavy and how fast they are."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from iscat_analysis.records import Analysis, BoolArray, FloatArray, TrackStatus, track_numbers
from iscat_analysis.report.answer import main_quantity, tracks_of
from iscat_analysis.report.event_figures import scale_bar
from iscat_analysis.report.field import field_axes
from iscat_analysis.report.scales import display_range
from iscat_analysis.report.size_plane import has_plane, size_plane
from iscat_analysis.report.style import BLUE, GREY, INK, PURPLE, Sketch, new_figure

MOST_TRACKS = 400
"""Tracks whose points tell their row when the pointer is over them; more become an image."""

MSD_TRACKS = 6
"""Tracks whose mean-squared displacement is drawn: the longest that are ok."""

MSD_PART = 4
"""Longest lag: the track's length over this; beyond, few displacements are left."""

_MOST_VERTICES = 20_000  # of paths in the page; more become an image
_CELLS = 120  # of a density, along each axis
_LEAST_WIDTH = 0.012  # of an axis, of a track whose error would not be seen
_FAR = 3.0  # times the masses of tracks that are ok, up to where the scale of colours goes
_UM2 = 1e6  # nm²
_NO_MASS = (0.6, 0.6, 0.6, 1.0)


def track_figures(analysis: Analysis, fits: pd.DataFrame) -> Iterator[Sketch]:
    """Name the figures of the tracks, and what draws them."""
    tracks = tracks_of(analysis)
    if np.asarray(analysis.ratio_image).size:
        yield "overview", partial(trajectories, analysis, fits)
    size, _ = masses(analysis)
    moving = tracks["d_um2_s"].to_numpy(float) > 0
    if (np.isfinite(size) & moving).any():
        yield "mass_d", partial(mass_d, analysis)
    if has_plane(analysis):
        yield "size_plane", partial(size_plane, analysis)
    if np.isfinite(size).any():
        yield "distributions", partial(distributions, analysis)
    yield "msd", partial(msd, analysis, fits)


def masses(analysis: Analysis) -> tuple[FloatArray, FloatArray]:
    """Give the main quantity of every track, mass or contrast, and its σ.

    Shapes: `values, sigma` (tracks,).
    """
    tracks, column = tracks_of(analysis), main_quantity(analysis).column
    mass = tracks["mass_kda"].abs().to_numpy(float)
    sigma = tracks["sigma_mass_kda"].to_numpy(float)
    if column != "contrast":
        return mass, sigma
    size = tracks["contrast"].abs().to_numpy(float)
    with np.errstate(invalid="ignore", divide="ignore"):
        return size, sigma * size / mass


def mass_label(analysis: Analysis) -> str:
    """Name the axis of masses or contrasts."""
    main = main_quantity(analysis)
    if main.column == "contrast":
        return "|contrast|"
    return "mass [kDa]" if main.column == "mass_kda" else "mass, model scale [kDa]"


def path_colors(analysis: Analysis) -> tuple[Normalize, Colormap, str]:
    """Colours of masses, and at which ends of their scale some lie beyond it.

    All tracks are drawn, and the scale covers them; but where one that is flagged lies far from
    those that are ok, these would all have one colour.
    """
    values, _ = masses(analysis)
    good = _ok(tracks_of(analysis)) & np.isfinite(values)
    known = values[np.isfinite(values)]
    if not known.size:
        return Normalize(0.0, 1.0), mpl.colormaps["viridis"], "neither"
    trusted = values[good] if good.any() else known
    low = max(float(known.min()), float(trusted.min()) / _FAR)
    high = min(float(known.max()), float(trusted.max()) * _FAR)
    below, above = known.min() < low, known.max() > high
    beyond = {(True, True): "both", (True, False): "min", (False, True): "max"}
    if high <= low:
        low, high = 0.9 * low, 1.1 * high or 1.0
    ends = beyond.get((bool(below), bool(above)), "neither")
    return Normalize(low, high), mpl.colormaps["viridis"], ends


def _scale_beside(figure: Figure, axes: Axes, analysis: Analysis) -> None:
    """Draw the scale of masses, with an arrow at an end beyond which some lie."""
    norm, colors, beyond = path_colors(analysis)
    figure.colorbar(
        mpl.cm.ScalarMappable(norm, colors), ax=axes, label=mass_label(analysis),
        fraction=0.05, pad=0.02, extend=beyond,
    )  # fmt: skip


def trajectories(analysis: Analysis, fits: pd.DataFrame) -> Figure:
    """Draw the field with the paths of its particles, coloured by mass."""
    tracks = tracks_of(analysis)
    image = np.asarray(analysis.ratio_image, float)
    tall, columns = image.shape
    figure, axes, per_inch = field_axes((tall, columns))
    low, high = display_range([image], analysis.scheme)
    axes.imshow(
        image,
        cmap="gray",
        vmin=2 * low,
        vmax=2 * high,
        interpolation="antialiased",
        aspect=per_inch[0] / per_inch[1],
    )
    scale_bar(axes, columns, tall, analysis.pixel_size_nm)
    norm, colors, _ = path_colors(analysis)
    values, _ = masses(analysis)
    numbers = track_numbers(fits)
    paths = dict(iter(fits.sort_values("frame").groupby(numbers)))
    lines, shades = [], []
    for track, size in zip(tracks["track"], values, strict=True):
        lines.append(paths[track][["x_px", "y_px"]].to_numpy(float))
        shades.append(colors(norm(size)) if np.isfinite(size) else _NO_MASS)
    drawn = LineCollection(lines, colors=shades, linewidths=1.1, capstyle="round")
    drawn.set_rasterized(sum(map(len, lines)) > _MOST_VERTICES)
    axes.add_collection(drawn)
    starts = np.array([line[0] for line in lines]).reshape(-1, 2)
    _points(axes, starts[:, 0], starts[:, 1], np.arange(len(tracks)), mfc="none", mec="white", ms=5)
    _scale_beside(figure, axes, analysis)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(tall - 0.5, -0.5), xlabel="x [px]", ylabel="y [px]")
    return figure


def _points(axes: Axes, x: FloatArray, y: FloatArray, rows: NDArray[np.intp], **style: Any) -> None:
    """Draw points that know the rows of the table of tracks they stand for."""
    (line,) = axes.plot(x, y, "o", ls="none", **style)
    if len(rows) <= MOST_TRACKS:
        line.set_gid("rows-" + "_".join(map(str, rows)))
    else:
        line.set_rasterized(True)


def mass_d(analysis: Analysis) -> Figure:
    """Draw the density of tracks over mass and diffusion coefficient."""
    tracks = tracks_of(analysis)
    mass, sigma = masses(analysis)
    d, d_sigma = (tracks[name].to_numpy(float) for name in ("d_um2_s", "sigma_d_um2_s"))
    usable = np.isfinite(mass) & (d > 0)
    good = usable & _ok(tracks)
    figure = new_figure(5.2, 4.0)
    axes = figure.add_subplot()
    x_ends, y_ends = _span(mass[usable], sigma[usable]), _log_span(d[usable], d_sigma[usable])
    shown = good if good.any() else usable
    density = _density(
        (mass[shown], sigma[shown], np.array(x_ends)),
        (np.log(d[shown]), d_sigma[shown] / d[shown], np.log(y_ends)),
    )
    shade = LinearSegmentedColormap.from_list("shade", ["#FFFFFF00", BLUE])
    half = 0.5 / (_CELLS - 1)  # the outermost cells have their middles at the ends of the axes
    axes.imshow(
        density, cmap=shade, vmin=0, origin="lower", aspect="auto", interpolation="bilinear",
        extent=(-half, 1 + half, -half, 1 + half), transform=axes.transAxes,
    )  # fmt: skip
    for rows, color, mark in ((good, INK, "ok"), (usable & ~good, PURPLE, "flagged")):
        at = np.flatnonzero(rows)
        if at.size:
            if at.size <= MOST_TRACKS:
                axes.errorbar(
                    mass[at], d[at], xerr=sigma[at], yerr=_bars(tracks, at), ls="none",
                    color=color, elinewidth=0.6, alpha=0.6,
                )  # fmt: skip
            _points(axes, mass[at], d[at], at, color=color, ms=3, mew=0, label=mark)
    if (usable & ~good).any():
        figure.legend(loc="outside upper right", ncols=2)
    axes.set(
        yscale="log", xlim=x_ends, ylim=y_ends, xlabel=mass_label(analysis), ylabel="D [µm²/s]"
    )
    _plain_log(axes)
    return figure


def distributions(analysis: Analysis) -> Figure:
    """Draw the distributions of mass and D, every track with its error."""
    tracks = tracks_of(analysis)
    figure = new_figure(7.4, 4.2)
    panels = figure.subplots(2, 2, sharex="col", height_ratios=[2, 3], squeeze=False)
    good = _ok(tracks)
    mass, sigma = masses(analysis)
    d, d_sigma = (tracks[name].to_numpy(float) for name in ("d_um2_s", "sigma_d_um2_s"))
    columns = [
        (mass, sigma, np.isfinite(mass), mass_label(analysis), False),
        (d, d_sigma, np.isfinite(d) & (d > 0), "D [µm²/s]", True),
    ]
    for (above, below), (value, error, usable, label, log) in zip(panels.T, columns, strict=True):
        below.set(xlabel=label, yticks=[])
        above.set(yticks=[])
        if not usable.any():
            below.text(0.5, 0.5, "none is known", ha="center", transform=below.transAxes)
            continue
        ends = (_log_span if log else _span)(value[usable], error[usable])
        grid = np.geomspace(*ends, 400) if log else np.linspace(*ends, 400)
        shown = usable & good if (usable & good).any() else usable
        at, wide = (np.log(value), error / value) if log else (value, error)
        curve = _density_1d(np.log(grid) if log else grid, at[shown], wide[shown])
        above.fill_between(grid, curve, color=BLUE, alpha=0.3, lw=0)
        above.plot(grid, curve, color=BLUE, lw=1)
        order, rank = np.argsort(value[usable]), np.arange(usable.sum(), dtype=float)
        rows = np.flatnonzero(usable)[order]
        bars = _bars(tracks, rows) if log else error[rows]
        for part, color in ((good[rows], BLUE), (~good[rows], PURPLE)):
            if part.any() and rows.size <= MOST_TRACKS:
                below.errorbar(
                    value[rows][part], rank[part],
                    xerr=bars[..., part], ls="none", color=color, elinewidth=0.7,
                )  # fmt: skip
            if part.any():
                _points(
                    below, value[rows][part], rank[part], rows[part], color=color, ms=2.5, mew=0
                )
        above.set(ylim=(0, None))
        above.spines.left.set_visible(False)
        below.spines.left.set_visible(False)
        if log:
            below.set_xscale("log")
            _plain_log(below, "x")
        below.set_xlim(ends)
    panels[0, 0].set_title("tracks that are ok" if good.any() else "tracks, all flagged")
    panels[1, 0].set_ylabel("tracks, by size")
    return figure


def msd(analysis: Analysis, fits: pd.DataFrame) -> Figure | None:
    """Draw mean-squared displacements beside what each track's D says of them."""
    tracks, motion = tracks_of(analysis), analysis.summary.get("motion", {})
    rate, exposure = motion.get("frame_rate_hz"), motion.get("exposure_ms")
    usable = tracks[tracks["d_um2_s"].notna() & (tracks["n_d_frames"] >= 2 * MSD_PART)]
    if rate is None or usable.empty:
        return None
    exposure_s = 1 / rate if exposure is None else exposure / 1e3
    ranked = usable.assign(bad=usable["status"] != str(TrackStatus.OK)).sort_values(
        ["bad", "n_d_frames"], ascending=[True, False]
    )
    numbers = track_numbers(fits)
    norm, colors, _ = path_colors(analysis)
    values, _ = masses(analysis)
    figure = new_figure(6.2, 3.6)
    axes = figure.add_subplot()
    for row in ranked.head(MSD_TRACKS).index:
        track = tracks.loc[row]
        path = fits[numbers == track["track"]].drop_duplicates("frame").sort_values("frame")
        lags, measured, error = mean_squared_displacement(path)
        shade = colors(norm(values[row])) if np.isfinite(values[row]) else _NO_MASS
        seconds = lags / rate
        predicted = 4 * track["d_um2_s"] * (seconds - exposure_s / 3) + error / _UM2
        axes.plot(1e3 * seconds, measured / _UM2, "o", color=shade, ms=3, mew=0)
        axes.plot(1e3 * seconds, predicted, color=shade, lw=1.2)
    axes.plot([], [], "o", color=GREY, ms=3, label="measured")
    axes.plot([], [], color=GREY, lw=1.2, label="from D, errors and blur")
    axes.legend()
    axes.set(xscale="log", yscale="log", xlabel="lag [ms]", ylabel="MSD in x and y [µm²]")
    for which in ("x", "y"):
        _plain_log(axes, which)
    _scale_beside(figure, axes, analysis)
    return figure


def mean_squared_displacement(path: pd.DataFrame) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lags [frames], mean-squared displacement, and what the errors of places add to it [nm²]."""
    frames = path["frame"].to_numpy(int)
    places = path[["x_nm", "y_nm"]].to_numpy(float)
    noise = (path[["sigma_x_nm", "sigma_y_nm"]] ** 2).sum(axis=1).to_numpy(float)
    most = max((frames[-1] - frames[0]) // MSD_PART, 1)
    lags = np.unique(np.geomspace(1, most, 16).round().astype(int))
    found = []
    for lag in lags:
        _, first, second = np.intersect1d(frames + lag, frames, return_indices=True)
        steps = places[second] - places[first]
        if len(steps):
            square = np.mean(np.sum(steps**2, axis=1))
            found.append((float(lag), float(square), float(np.mean(noise[first] + noise[second]))))
    at, square, error = np.array(found).reshape(-1, 3).T
    return at, square, error


def _ok(tracks: pd.DataFrame) -> BoolArray:
    return np.asarray(tracks["status"] == str(TrackStatus.OK), dtype=bool)


def _bars(tracks: pd.DataFrame, rows: NDArray[np.intp]) -> FloatArray:
    """Lengths of the error bars of D, 68 %: on a logarithmic axis they stay above zero."""
    d, sigma = (tracks[name].to_numpy(float)[rows] for name in ("d_um2_s", "sigma_d_um2_s"))
    factor = np.exp(sigma / d)
    return np.array([d - d / factor, d * factor - d])


def _span(values: FloatArray, errors: FloatArray) -> tuple[float, float]:
    wide = np.where(np.isfinite(errors), errors, 0.0)
    low, high = float((values - 2 * wide).min()), float((values + 2 * wide).max())
    pad = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    return max(low - pad, 0.0), high + pad


def _log_span(values: FloatArray, errors: FloatArray) -> tuple[float, float]:
    wide = np.exp(np.minimum(np.where(np.isfinite(errors), errors, 0.0) / values, 1.0))
    return float((values / wide).min()) / 1.4, float((values * wide).max()) * 1.4


def _density_1d(grid: FloatArray, values: FloatArray, errors: FloatArray) -> FloatArray:
    """Add up a normal curve for each track."""
    width = np.maximum(errors, _LEAST_WIDTH * (grid[-1] - grid[0]))[:, None]
    hills = np.exp(-(((grid - values[:, None]) / width) ** 2) / 2) / width
    return np.asarray(hills.sum(axis=0))


def _density(
    x: tuple[FloatArray, FloatArray, FloatArray], y: tuple[FloatArray, FloatArray, FloatArray]
) -> FloatArray:
    """Add up a normal hill for each track; each of x and y has values, errors and ends."""
    parts = []
    for values, errors, ends in (x, y):
        grid = np.linspace(ends[0], ends[1], _CELLS)
        width = np.maximum(errors, _LEAST_WIDTH * (ends[1] - ends[0]))[:, None]
        parts.append(np.exp(-(((grid - values[:, None]) / width) ** 2) / 2) / width)
    return np.asarray(parts[1].T @ parts[0])


def _plain_log(axes: Axes, which: str = "y") -> None:
    """Label a logarithmic axis with plain numbers."""
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axes.get_xlim() if which == "x" else axes.get_ylim()
    subs = (1.0,) if high / low > 300 else (1.0, 2.0, 5.0)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
