"""The images and the posterior of single events."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from iscat_analysis.records import Analysis, EventView, FloatArray, PosteriorResult
from iscat_analysis.report.films import clip_shown
from iscat_analysis.report.numbers import LABELS, UNITS, number
from iscat_analysis.report.scales import (
    DIVERGING,
    GREYS,
    display_range,
    png_of,
    residual_limit,
    shaded,
)
from iscat_analysis.report.style import BLUE, INK, Sketch, new_figure
from iscat_analysis.report.traces import draw_trace, trace_svg, trace_words

CORNER_FIGURES = 20
"""Posteriors that are drawn, at most."""

DETAIL_BYTES = 2_000_000
"""Images, traces and clips of events inside the page, at most; the events after that are table rows
only."""

CREDIBLE_LEVELS = (0.95, 0.75, 0.5, 0.25)
"""Shades of a posterior's joint densities: the share of the probability inside each."""

POSTERIOR_BINS = 24
"""Bins per axis of a drawn posterior."""

_TRACE_INCHES = 2.1  # height of a drawn trace
_SHADES = 64  # of each scale of the images in the page

HALO = [withStroke(linewidth=1.6, foreground="black", alpha=0.7)]
"""Makes white text readable on any image."""


class EventDetail(NamedTuple):
    """What the page shows of one event when its row is opened; may be empty."""

    images: str
    scales: str
    trace: Markup
    words: str
    clip: Markup
    sliding: str


def event_figures(analysis: Analysis, most: int) -> Iterator[Sketch]:
    """Name the images of the first events, and what draws them."""
    seen: dict[int, int] = {}
    for view in analysis.views[:most]:
        seen[view.event] = nth = seen.get(view.event, 0) + 1
        name = f"event_{view.event:04d}" + (f"_{nth}" if nth > 1 else "")
        yield name, partial(triptych, view, analysis.scheme, analysis.pixel_size_nm)


def corner_figures(analysis: Analysis) -> Iterator[Sketch]:
    """Name the first converged posteriors, and what draws them."""
    sampled = [
        (view.event, view.posterior)
        for view in analysis.views
        if view.posterior is not None and view.posterior.converged
    ]
    for event, posterior in sampled[:CORNER_FIGURES]:
        yield f"corner_{event:04d}", partial(corner, posterior, event)


def event_details(analysis: Analysis, table: pd.DataFrame) -> dict[int, EventDetail]:
    """Pack what the page shows of the first events, as many as `DETAIL_BYTES` hold."""
    unit = "photoelectrons" if analysis.scheme == "darkfield" else "contrast"
    packed: dict[int, EventDetail] = {}
    spent = 0
    for row, view in views_of_rows(table, analysis.views):
        low, high = display_range([view.contrast, view.model], analysis.scheme)
        limit = residual_limit(view.residual)
        scales = f"{unit} {number(low)} to {number(high)}; residual ±{limit:g} σ"
        images = _strip(view, low, high, limit)
        trace = clip = Markup()
        words = sliding = ""
        if view.trace is not None:
            trace, words = trace_svg(view.trace), trace_words(view.trace)
        if view.clip is not None:
            turn = view.trace.frame if view.trace else view.clip.frames[0]
            clip, sliding = clip_shown(view.clip, low, high, turn)
        detail = EventDetail(images, scales, trace, words, clip, sliding)
        spent += sum(map(len, detail))
        if spent > DETAIL_BYTES:
            break
        packed[row] = detail
    return packed


def _strip(view: EventView, low: float, high: float, limit: float) -> str:
    """Put data, model and residual side by side, with a palette of `_SHADES` for each scale."""
    data, model = (
        shaded((part - low) / (high - low), _SHADES) for part in (view.contrast, view.model)
    )
    residual = shaded((view.residual / limit + 1) / 2, _SHADES, _SHADES)
    gap = shaded(np.full((view.contrast.shape[0], 2), np.nan), _SHADES)
    ramp = np.linspace(0, 1, _SHADES)
    return png_of(
        np.concatenate([data, gap, model, gap, residual], axis=1),
        np.concatenate([GREYS(ramp), DIVERGING(ramp)]),
    )


def views_of_rows(table: pd.DataFrame, views: Sequence[EventView]) -> list[tuple[int, EventView]]:
    """Assign views to rows: by position where the numbers agree, else by number."""
    numbers = table["event"].tolist()
    if [view.event for view in views] == numbers:
        return list(enumerate(views))
    first: dict[int, int] = {}
    for row, event in enumerate(numbers):
        first.setdefault(event, row)
    return [(first[view.event], view) for view in views if view.event in first]


def credible_shades(counts: FloatArray) -> NDArray[np.int64]:
    """Tell for each cell of a histogram which of the `CREDIBLE_LEVELS` contain it."""
    flat = counts.ravel()
    order = np.argsort(-flat, kind="stable")
    before = np.cumsum(flat[order]) - flat[order]
    total = max(float(flat.sum()), 1.0)
    shades = np.zeros(flat.size, dtype=np.int64)
    for level in CREDIBLE_LEVELS:
        shades[order] += (before < level * total) & (flat[order] > 0)
    return shades.reshape(counts.shape)


def scale_bar(axes: Axes, columns: int, rows: int, pixel_size_nm: float) -> None:
    """Draw a scale bar into the lower left corner of an image."""
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
    """Draw data, model and residual of one event, and its contrast against frame."""
    rows, columns = view.contrast.shape
    aspect = float(np.clip(rows / columns, 0.3, 3.0))
    below = 0.0 if view.trace is None else _TRACE_INCHES
    height = 2.55 * aspect + 1.0 + below
    figure = new_figure(8.4, height, constrained=False)
    if view.trace is not None:
        draw_trace(
            figure.add_axes((0.075, 0.5 / height, 0.875, (below - 0.6) / height)), view.trace
        )
    low, high = display_range([view.contrast, view.model], scheme)
    limit = residual_limit(view.residual)
    unit = "photoelectrons" if scheme == "darkfield" else "contrast"
    panels: list[tuple[str, Any, Any, float, float, str]] = [
        ("data", view.contrast, "gray", low, high, unit),
        ("model", view.model, "gray", low, high, unit),
        ("residual", view.residual, DIVERGING, -limit, limit, "σ"),
    ]
    bar_bottom, bottom = (below + 0.48) / height, (below + 0.62) / height
    tall = 2.55 * aspect / height
    for place, (title, image, cmap, lower, upper, label) in enumerate(panels):
        x = 0.02 + place * 0.33
        axes = figure.add_axes((x, bottom, 0.3, tall))
        shown = axes.imshow(image, cmap=cmap, vmin=lower, vmax=upper, interpolation="nearest")
        axes.set(xticks=[], yticks=[], title=f"event {view.event}, {title}" if not place else title)
        axes.spines[:].set_visible(False)
        bar = figure.add_axes((x, bar_bottom, 0.3, 0.062 / height))
        figure.colorbar(shown, cax=bar, orientation="horizontal", label=label).ax.locator_params(
            nbins=4
        )
        if not place:
            scale_bar(axes, columns, rows, pixel_size_nm)
    return figure


def corner(posterior: PosteriorResult, event: int) -> Figure:
    """Draw a posterior: each parameter, and each pair."""
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
