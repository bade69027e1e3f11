"""The figures of a movie of moving particles: where they went, how heavy and how fast they are."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from iscat_analysis.config import parse_config
from iscat_analysis.optics.scatterers import Sphere, material, scattering_length_nm, sphere_of
from iscat_analysis.records import Analysis, BoolArray, FloatArray, TrackStatus, track_numbers
from iscat_analysis.report.answer import track_quantity, tracks_of
from iscat_analysis.report.style import (
    BLUE,
    GREY,
    INK,
    Sketch,
    Style,
    field_figure,
    judged,
    legend,
    new_figure,
    one_panel,
    plain_log,
    points,
)
from iscat_analysis.units import sphere_mass_kda

MOST_TRACKS = 400
"""Tracks whose errors are drawn beside their points; more would hide them."""

MSD_PART = 4
"""Longest lag of a mean-squared displacement: the track's length over this."""

INDICES = (1.36, 1.40, 1.46, 1.52, 1.60)
"""Refractive indices whose lines are drawn, of spheres that do not absorb."""

_UM2 = 1e6  # nm²


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
    """Give the size of every track, mass or contrast, and its σ.

    Shapes: `values, sigma` (tracks,).
    """
    values, sigma = track_quantity(analysis).values(tracks_of(analysis))
    return np.abs(values), sigma


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
    low = max(float(known.min()), float(trusted.min()) / 3)
    high = min(float(known.max()), float(trusted.max()) * 3)
    below, above = known.min() < low, known.max() > high
    beyond = ("both" if above else "min") if below else ("max" if above else "neither")
    if high <= low:
        low, high = 0.9 * low, 1.1 * high or 1.0
    return Normalize(low, high), mpl.colormaps["viridis"], beyond


def _shades(analysis: Analysis) -> list[Any]:
    """Give every track its colour; grey if its mass is not known."""
    norm, colors, _ = path_colors(analysis)
    values, _ = masses(analysis)
    return [colors(norm(size)) if np.isfinite(size) else "0.6" for size in values]


def _scale_beside(figure: Figure, axes: Axes, analysis: Analysis) -> None:
    """Draw the scale of masses, with an arrow at an end beyond which some lie."""
    norm, colors, beyond = path_colors(analysis)
    shown, label = mpl.cm.ScalarMappable(norm, colors), track_quantity(analysis).axis
    figure.colorbar(shown, ax=axes, label=label, fraction=0.05, pad=0.02, extend=beyond)


def trajectories(analysis: Analysis, fits: pd.DataFrame) -> Figure:
    """Draw the field with the paths of its particles, coloured by mass."""
    tracks = tracks_of(analysis)
    image = np.asarray(analysis.ratio_image, float)
    smooth: Style = {"interpolation": "antialiased"}
    pixel_nm = analysis.pixel_size_nm
    figure, axes, _ = field_figure(image, analysis.scheme, pixel_nm, bright=2.0, style=smooth)
    paths = dict(iter(fits.sort_values("frame").groupby(track_numbers(fits))))
    lines = [paths[track][["x_px", "y_px"]].to_numpy(float) for track in tracks["track"]]
    drawn = LineCollection(lines, colors=_shades(analysis), linewidths=1.1, capstyle="round")
    drawn.set_rasterized(sum(map(len, lines)) > 20_000)
    axes.add_collection(drawn)
    starts = np.array([line[0] for line in lines]).reshape(-1, 2)
    every = np.ones(len(tracks), dtype=bool)
    points(axes, starts[:, 0], starts[:, 1], every, style={"mfc": "none", "mec": "white", "ms": 5})
    _scale_beside(figure, axes, analysis)
    return figure


def mass_d(analysis: Analysis) -> Figure:
    """Draw the density of tracks over mass and diffusion coefficient."""
    tracks = tracks_of(analysis)
    mass, sigma = masses(analysis)
    d, d_sigma = (tracks[name].to_numpy(float) for name in ("d_um2_s", "sigma_d_um2_s"))
    usable = np.isfinite(mass) & (d > 0)
    good = usable & _ok(tracks)
    figure, axes = one_panel(5.2, 4.0)
    x_ends, y_ends = _span(mass[usable], sigma[usable]), _log_span(d[usable], d_sigma[usable])
    shown = good if good.any() else usable
    cells = 120  # along each axis; the outermost have their middles at the ends of the axes
    x, y = np.linspace(*x_ends, cells), np.log(np.geomspace(*y_ends, cells))
    hills = _hills(y, np.log(d[shown]), d_sigma[shown] / d[shown]).T
    density = hills @ _hills(x, mass[shown], sigma[shown])
    shade = LinearSegmentedColormap.from_list("shade", ["#FFFFFF00", BLUE])
    half = 0.5 / (cells - 1)
    place: Style = {"extent": (-half, 1 + half, -half, 1 + half), "transform": axes.transAxes}
    how: Style = {"origin": "lower", "aspect": "auto", "interpolation": "bilinear"}
    axes.imshow(density, cmap=shade, vmin=0, **how, **place)
    for rows, color, name in judged(usable, good, INK):
        if rows.sum() <= MOST_TRACKS:
            style: Style = {"ls": "none", "elinewidth": 0.6, "alpha": 0.6, "color": color}
            axes.errorbar(mass[rows], d[rows], _bars(tracks, rows), sigma[rows], **style)
        points(axes, mass, d, rows, style={"color": color, "ms": 3, "mew": 0, "label": name})
    if (usable & ~good).any():
        legend(figure)
    axes.set(xlim=x_ends, ylim=y_ends, xlabel=track_quantity(analysis).axis, ylabel="D [µm²/s]")
    plain_log(axes, "y")
    return figure


def distributions(analysis: Analysis) -> Figure:
    """Draw the distributions of mass and D, every track with its error."""
    tracks = tracks_of(analysis)
    figure = new_figure(7.4, 4.2)
    panels = figure.subplots(2, 2, sharex="col", height_ratios=[2, 3], squeeze=False)
    good = _ok(tracks)
    d, d_sigma = (tracks[name].to_numpy(float) for name in ("d_um2_s", "sigma_d_um2_s"))
    columns = [
        (*masses(analysis), track_quantity(analysis).axis, False),
        (np.where(d > 0, d, np.nan), d_sigma, "D [µm²/s]", True),
    ]
    for (above, below), (value, error, label, log) in zip(panels.T, columns, strict=True):
        usable = np.isfinite(value)
        below.set(xlabel=label, yticks=[])
        above.set(yticks=[])
        if not usable.any():
            below.text(0.5, 0.5, "none is known", ha="center", transform=below.transAxes)
            continue
        ends = (_log_span if log else _span)(value[usable], error[usable])
        grid = np.geomspace(*ends, 400) if log else np.linspace(*ends, 400)
        shown = usable & good if (usable & good).any() else usable
        at, wide = (np.log(value), error / value) if log else (value, error)
        curve = _hills(np.log(grid) if log else grid, at[shown], wide[shown]).sum(axis=0)
        above.fill_between(grid, curve, color=BLUE, alpha=0.3, lw=0)
        above.plot(grid, curve, color=BLUE, lw=1)
        rank = np.argsort(np.argsort(value)).astype(float)
        for rows, color, _ in judged(usable, good):
            if usable.sum() <= MOST_TRACKS:
                style: Style = {"ls": "none", "elinewidth": 0.7, "color": color}
                bars = _bars(tracks, rows) if log else error[rows]
                below.errorbar(value[rows], rank[rows], xerr=bars, **style)
            points(below, value, rank, rows, style={"color": color, "ms": 2.5, "mew": 0})
        above.set(ylim=(0, None))
        for axes in (above, below):
            axes.spines.left.set_visible(False)
        below.set_xlim(ends)
        if log:
            plain_log(below, "x")
    panels[0, 0].set_title("tracks that are ok" if good.any() else "tracks, all flagged")
    panels[1, 0].set_ylabel("tracks, by size")
    return figure


def msd(analysis: Analysis, fits: pd.DataFrame) -> Figure | None:
    """Draw mean-squared displacements of the six longest tracks beside what their D says."""
    tracks, motion = tracks_of(analysis), analysis.summary.get("motion", {})
    rate, exposure = motion.get("frame_rate_hz"), motion.get("exposure_ms")
    usable = tracks[tracks["d_um2_s"].notna() & (tracks["n_d_frames"] >= 2 * MSD_PART)]
    if rate is None or usable.empty:
        return None
    exposure_s = 1 / rate if exposure is None else exposure / 1e3
    ranked = usable.iloc[np.lexsort([-usable["n_d_frames"], ~_ok(usable)])]
    numbers, shades = track_numbers(fits), _shades(analysis)
    figure, axes = one_panel(6.2, 3.6)
    for row in ranked.head(6).index:
        track = tracks.loc[row]
        path = fits[numbers == track["track"]].drop_duplicates("frame").sort_values("frame")
        lags, measured, error = mean_squared_displacement(path)
        seconds = lags / rate
        predicted = 4 * track["d_um2_s"] * (seconds - exposure_s / 3) + error / _UM2
        axes.plot(1e3 * seconds, measured / _UM2, "o", color=shades[row], ms=3, mew=0)
        axes.plot(1e3 * seconds, predicted, color=shades[row], lw=1.2)
    axes.plot([], [], "o", color=GREY, ms=3, label="measured")
    axes.plot([], [], color=GREY, lw=1.2, label="from D, errors and blur")
    axes.legend()
    axes.set(xlabel="lag [ms]", ylabel="MSD in x and y [µm²]")
    plain_log(axes, "x", "y")
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
        if first.size:
            squares = ((places[second] - places[first]) ** 2).sum(axis=1)
            found.append((lag, squares.mean(), np.mean(noise[first] + noise[second])))
    at, square, error = np.array(found, dtype=float).reshape(-1, 3).T
    return at, square, error


def _ok(tracks: pd.DataFrame) -> BoolArray:
    return np.asarray(tracks["status"] == str(TrackStatus.OK), dtype=bool)


def _bars(tracks: pd.DataFrame, rows: BoolArray) -> FloatArray:
    """Lengths of the error bars of D, 68 %: on a logarithmic axis they stay above zero."""
    d, sigma = (tracks[name].to_numpy(float)[rows] for name in ("d_um2_s", "sigma_d_um2_s"))
    factor = np.exp(sigma / d)
    return np.array([d - d / factor, d * factor - d])


def _span(values: FloatArray, errors: FloatArray) -> tuple[float, float]:
    wide = np.nan_to_num(errors)
    low, high = float((values - 2 * wide).min()), float((values + 2 * wide).max())
    pad = 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    return max(low - pad, 0.0), high + pad


def _log_span(values: FloatArray, errors: FloatArray) -> tuple[float, float]:
    wide = np.exp(np.minimum(np.nan_to_num(errors) / values, 1.0))
    return float((values / wide).min()) / 1.4, float((values * wide).max()) * 1.4


def _hills(grid: FloatArray, values: FloatArray, errors: FloatArray) -> FloatArray:
    """Give each track a normal curve, as wide as its error, shape (tracks, grid)."""
    width = np.maximum(errors, 0.012 * (grid[-1] - grid[0]))[:, None]  # else it is not visible
    return np.asarray(np.exp(-(((grid - values[:, None]) / width) ** 2) / 2) / width)


# ---- Size and light ------------------------------------------------------------------------------


def has_plane(analysis: Analysis) -> bool:
    """Tell whether a track has both diameters."""
    return "optical_diameter_nm" in tracks_of(analysis) and bool(_usable(analysis).any())


def size_plane(analysis: Analysis) -> Figure:
    """Draw the hydrodynamic diameters, and what their light says, with lines of constant index.

    Spheres of one material lie on a line of constant refractive index, a straight one while they
    are small beside the wavelength.
    """
    config = parse_config(tomllib.loads(analysis.config_toml))
    matter = material(config.particle, config.optics.wavelength_nm)
    sphere = sphere_of(config.particle, matter.permittivity, matter.mass_kda)
    if sphere is None:
        raise ValueError("only spheres have optical diameters")
    step = 1e-3  # of a diameter, for the slope along which its error is carried
    tracks = tracks_of(analysis)[_usable(analysis)]
    moved, optical = (tracks[f"{kind}diameter_nm"].to_numpy(float) for kind in ("", "optical_"))
    error, sigma = (tracks[f"sigma_{kind}diameter_nm"].to_numpy(float) for kind in ("", "optical_"))

    def lengths(diameters_nm: FloatArray, one: Sphere) -> FloatArray:
        """Scattering lengths of spheres of one material."""
        masses = [sphere_mass_kda(d, one.density_kg_m3) for d in diameters_nm.tolist()]
        return np.array([scattering_length_nm(one.of_mass(m), config.optics) for m in masses])

    length = lengths(optical, sphere)
    slope = (lengths(optical * (1 + step), sphere) - length) / (step * optical)
    figure, axes = one_panel(5.2, 4.2)
    ends = 0.7 * min(moved.min(), optical.min()), 1.3 * max(moved.max(), optical.max())
    diameters = np.linspace(*ends, 200)
    own = "shell" if sphere.shell_nm else f"{sphere.index.real:.2f}"
    drawn = [(f"{n:.2f}", replace(sphere, index=complex(n), shell_nm=0.0)) for n in INDICES]
    absorbs = abs(sphere.index.imag) >= step
    for label, one in [] if absorbs else [*drawn, (own, sphere)]:
        line = lengths(diameters, one)
        color, width = (BLUE, 1.4) if one is sphere else (GREY, 0.7)
        axes.plot(diameters, line, color=color, lw=width)
        beside: Style = {"xytext": (3, 0), "textcoords": "offset points", "va": "center"}
        axes.annotate(label, (diameters[-1], line[-1]), color=color, fontsize="small", **beside)
    good, up = _ok(tracks), np.abs(slope * sigma)
    for rows, color, name in judged(np.ones(good.size, dtype=bool), good, INK):
        dots: Style = {"fmt": "o", "ms": 3, "elinewidth": 0.7, "color": color, "label": name}
        axes.errorbar(moved[rows], length[rows], up[rows], error[rows], **dots)
    if not good.all():
        axes.legend(loc="upper left")
    axes.set(xlabel="hydrodynamic diameter [nm]", ylabel="scattering length [nm]")
    axes.set(xlim=ends, ylim=(0, None))
    return figure


def _usable(analysis: Analysis) -> BoolArray:
    """Tell which tracks have both diameters; shape (tracks,)."""
    tracks = tracks_of(analysis)
    return np.asarray(tracks[["diameter_nm", "optical_diameter_nm"]].notna().all(axis=1))
