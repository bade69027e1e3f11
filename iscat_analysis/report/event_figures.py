"""The images and the posterior of single events."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from iscat_analysis.records import Analysis, EventView, FloatArray, PosteriorResult
from iscat_analysis.report.numbers import LABELS, UNITS, number
from iscat_analysis.report.style import BLUE, INK, new_figure

EVENT_FIGURES = 12
"""Events whose images are drawn into the folder, at most."""

CORNER_FIGURES = 20
"""Posteriors that are drawn, at most."""

IMAGE_BYTES = 2_000_000
"""Event images inside the page, at most; the events after that are table rows only."""

RESIDUAL_LIMIT = 4.0
"""Residual images span at least ± this many standard deviations."""

CREDIBLE_LEVELS = (0.95, 0.75, 0.5, 0.25)
"""Shades of a posterior's joint densities: the share of the probability inside each."""

POSTERIOR_BINS = 24
"""Bins per axis of a drawn posterior."""

DIVERGING = LinearSegmentedColormap.from_list("residual", ["#00528C", "#FAFAF8", "#BE4600"])

HALO = [withStroke(linewidth=1.6, foreground="black", alpha=0.7)]
"""Makes white text readable on any image."""


def event_figures(analysis: Analysis, most: int) -> Iterator[tuple[str, Figure]]:
    """Draw the images of the first events.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    most : int
        How many, at most.

    Yields
    ------
    name : str
        ``event_NNNN``; for a track, which has one view of each of its frames, with a number.
    figure : Figure
        Data, model and residual.
    """
    seen: dict[int, int] = {}
    for view in analysis.views[:most]:
        seen[view.event] = nth = seen.get(view.event, 0) + 1
        name = f"event_{view.event:04d}" + (f"_{nth}" if nth > 1 else "")
        yield name, triptych(view, analysis.scheme, analysis.pixel_size_nm)


def corner_figures(analysis: Analysis) -> Iterator[tuple[str, Figure]]:
    """Draw the first converged posteriors.

    Parameters
    ----------
    analysis : Analysis
        What was found.

    Yields
    ------
    name : str
        ``corner_NNNN``.
    figure : Figure
        A corner plot.
    """
    sampled = [
        (view.event, view.posterior)
        for view in analysis.views
        if view.posterior is not None and view.posterior.converged
    ]
    for event, posterior in sampled[:CORNER_FIGURES]:
        yield f"corner_{event:04d}", corner(posterior, event)


def event_images(analysis: Analysis, table: pd.DataFrame) -> dict[int, tuple[str, str]]:
    """Pack the images of the first events for the page, as many as `IMAGE_BYTES` hold.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    table : pandas.DataFrame
        From `event_table`.

    Returns
    -------
    dict of int to (str, str)
        By row of the table: data, model and residual side by side as a PNG in base64, and the
        ranges of their scales in words.
    """
    gray = mpl.colormaps["gray"]
    unit = "photoelectrons" if analysis.scheme == "darkfield" else "contrast"
    packed: dict[int, tuple[str, str]] = {}
    spent = 0
    for row, view in views_of_rows(table, analysis.views):
        low, high = display_range([view.contrast, view.model], analysis.scheme)
        limit = residual_limit(view.residual)
        gap = np.zeros((view.contrast.shape[0], 2, 4))
        strip = [
            gray((view.contrast - low) / (high - low)), gap,
            gray((view.model - low) / (high - low)), gap,
            DIVERGING((view.residual / limit + 1) / 2),
        ]  # fmt: skip
        buffer = io.BytesIO()
        imsave(buffer, np.concatenate(strip, axis=1), format="png")
        text = base64.b64encode(buffer.getvalue()).decode("ascii")
        spent += len(text)
        if spent > IMAGE_BYTES:
            break
        packed[row] = (text, f"{unit} {number(low)} to {number(high)}; residual ±{limit:g} σ")
    return packed


def views_of_rows(table: pd.DataFrame, views: Sequence[EventView]) -> list[tuple[int, EventView]]:
    """Pair each view with its row: by position where the numbers agree, else by number.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns `EVENT_COLUMNS`.
    views : sequence of EventView
        In any order; one whose event is not in the table is left out.

    Returns
    -------
    list of (int, EventView)
        Row and view.
    """
    numbers = table["event"].tolist()
    if [view.event for view in views] == numbers:
        return list(enumerate(views))
    first: dict[int, int] = {}
    for row, event in enumerate(numbers):
        first.setdefault(event, row)
    return [(first[view.event], view) for view in views if view.event in first]


def display_range(images: Sequence[FloatArray], scheme: str) -> tuple[float, float]:
    """Choose the grey scale that images share.

    Parameters
    ----------
    images : sequence of ndarray
        Contrast (dark field: photoelectrons).
    scheme : str
        As in `Analysis`.

    Returns
    -------
    float, float
        Symmetric about zero for contrast, from the lowest to the highest in dark field; always a
        proper interval.
    """
    values = np.concatenate([np.ravel(image) for image in images])
    values = values[np.isfinite(values)]
    if not values.size:
        return -1.0, 1.0
    if scheme == "darkfield":
        low, high = (float(v) for v in np.quantile(values, [0.002, 0.999]))
        return (low, high) if high > low else (low, low + 1.0)
    limit = float(np.quantile(np.abs(values), 0.998))
    return (-limit, limit) if limit > 0 else (-1.0, 1.0)


def residual_limit(residual: FloatArray) -> float:
    """Choose the range of a residual image: a few standard deviations, more where it needs more.

    Parameters
    ----------
    residual : ndarray, shape (y, x)
        Residual [standard deviations].

    Returns
    -------
    float
        Half the range, at least `RESIDUAL_LIMIT`.
    """
    values = np.abs(residual[np.isfinite(residual)])
    return max(RESIDUAL_LIMIT, math.ceil(np.quantile(values, 0.995))) if values.size else 4.0


def credible_shades(counts: FloatArray) -> NDArray[np.int64]:
    """Say of each cell of a histogram which of the `CREDIBLE_LEVELS` contain it.

    Parameters
    ----------
    counts : ndarray, any shape
        Samples in each cell.

    Returns
    -------
    ndarray of int, same shape
        0 outside all regions of highest density, `len(CREDIBLE_LEVELS)` in the innermost.
    """
    flat = counts.ravel()
    order = np.argsort(-flat, kind="stable")
    before = np.cumsum(flat[order]) - flat[order]
    total = max(float(flat.sum()), 1.0)
    shades = np.zeros(flat.size, dtype=np.int64)
    for level in CREDIBLE_LEVELS:
        shades[order] += (before < level * total) & (flat[order] > 0)
    return shades.reshape(counts.shape)


def scale_bar(axes: Axes, columns: int, rows: int, pixel_size_nm: float) -> None:
    """Draw a scale bar into the lower left corner of an image.

    Parameters
    ----------
    axes : Axes
        Where the image is shown, in pixels.
    columns, rows : int
        Its shape.
    pixel_size_nm : float
        In the sample plane [nm].
    """
    bars = [50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000]
    length_nm = max([b for b in bars if b <= 0.4 * columns * pixel_size_nm], default=bars[0])
    x, y = 0.04 * columns - 0.5, 0.955 * rows - 0.5
    axes.add_patch(
        Rectangle(
            (x, y),
            length_nm / pixel_size_nm,
            0.012 * rows,
            fc="white",
            ec="black",
            lw=0.6,
            zorder=3,
        )
    )
    text = f"{length_nm / 1000:g} µm"
    axes.text(x, y - 0.015 * rows, text, color="white", fontsize=8, path_effects=HALO, zorder=3)


def triptych(view: EventView, scheme: str, pixel_size_nm: float) -> Figure:
    """Draw data, model and residual of one event.

    Parameters
    ----------
    view : EventView
        Its images.
    scheme : str
        ``"iscat"``, ``"cobri"`` or ``"darkfield"``.
    pixel_size_nm : float
        Side of a pixel [nm].

    Returns
    -------
    Figure
        Three panels.
    """
    rows, columns = view.contrast.shape
    aspect = float(np.clip(rows / columns, 0.3, 3.0))
    figure = new_figure(8.4, 2.55 * aspect + 1.0, constrained=False)
    low, high = display_range([view.contrast, view.model], scheme)
    limit = residual_limit(view.residual)
    unit = "photoelectrons" if scheme == "darkfield" else "contrast"
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
            scale_bar(axes, columns, rows, pixel_size_nm)
    return figure


def corner(posterior: PosteriorResult, event: int) -> Figure:
    """Draw a posterior: each parameter, and each pair.

    Parameters
    ----------
    posterior : PosteriorResult
        A chain that converged.
    event : int
        Number of the event.

    Returns
    -------
    Figure
        Its shades hold 25, 50, 75 and 95 % of the samples.
    """
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
