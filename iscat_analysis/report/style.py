"""How figures look, in files and inside a page, and the parts that many of them have."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from PIL import Image

from iscat_analysis.records import BoolArray, FloatArray

DPI, PRINT_DPI = 140, 300
"""Resolution of the PNG files, and of those whose figures have the size of print."""

VERMILLION, BLUE, PURPLE, GREY, INK = "#D55E00", "#0072B2", "#CC79A7", "#8A8F96", "#1B1D21"
GRID = "#E7E4DD"

HALO = [withStroke(linewidth=1.6, foreground="black", alpha=0.7)]
"""Makes white text readable on any image."""

_THEME = {
    INK: "ink",
    BLUE: "qcrb",
    VERMILLION: "sigma",
    PURPLE: "flag",
    GREY: "plain",
    GRID: "grid",
}
"""Variables of ``style.css`` that take the place of these colours inside a page."""

STYLE: Any = {
    "font.size": 9,
    "text.color": INK,
    "axes.facecolor": "none",
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titley": 1.0,  # no axis has numbers above it, and none are looked for
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "figure.autolayout": False,
    "figure.constrained_layout.use": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "iscat-analysis",
    "pdf.fonttype": 42,  # letters, which can be edited
}
"""Settings of Matplotlib to draw and save under."""

_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))
_NO_PDF_METADATA = dict.fromkeys(("Creator", "CreationDate", "Producer"))


def new_figure(width: float, height: float, *, constrained: bool = True) -> Figure:
    """Make a figure that no window shows."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


Style = dict[str, Any]
"""How something is drawn: arguments of Matplotlib's."""

Sketch = tuple[str, Callable[[], Figure | None]]
"""Name of a figure, and what draws it; nothing where there is nothing to show."""


def drawn(sketches: Iterable[Sketch]) -> Iterator[tuple[str, Figure]]:
    """Draw figures one after the other."""
    for name, draw in sketches:
        if (figure := draw()) is not None:
            yield name, figure


def publish(
    figures: Iterable[tuple[str, Figure]], folder: Path | None = None, *, printed: bool = False
) -> dict[str, Markup]:
    """Write figures as PNG and SVG files, and as SVG for a page.

    Equal figures give equal files at any time.
    """
    inline = {}
    with mpl.rc_context(STYLE):
        for name, figure in figures:
            if (engine := figure.get_layout_engine()) is not None:
                _place_empty_names(figure)
                engine.execute(figure)
                # laid out once; with an engine, or "none", each file would be drawn twice
                figure.set_layout_engine(None)
            if folder is not None:
                _write_png(figure, folder / f"{name}.png", PRINT_DPI if printed else DPI)
                _hold_labels(figure)
            if folder is not None and printed:
                figure.savefig(folder / f"{name}.pdf", metadata=_NO_PDF_METADATA)
            buffer = io.StringIO()
            figure.savefig(buffer, format="svg", metadata=_NO_METADATA)
            if folder is not None:
                (folder / f"{name}.svg").write_text(buffer.getvalue(), encoding="utf-8")
            inline[name] = inline_svg(buffer.getvalue(), name)
    return inline


def _write_png(figure: Figure, path: Path, dpi: int) -> None:
    """Write a figure in three colours: its ground is opaque, and four take twice as long."""
    figure.set_dpi(dpi)
    canvas: Any = figure.canvas  # of `new_figure`
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    image.save(path, format="png", dpi=(dpi, dpi), compress_level=1)


def _place_empty_names(figure: Figure) -> None:
    """Put the names of axes without a name inside them, where Matplotlib looks for no place."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if not axis.label.get_text():
                axis.set_label_coords(0.5, 0.5)


def _hold_labels(figure: Figure) -> None:
    """Keep the names of axes where they were drawn, so that no file looks for their places again.

    A tenth of drawing is to find how far the numbers beside an axis reach.
    """
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            name = axis.label
            place = name.get_transform().transform(name.get_position())
            axis.set_label_coords(*axes.transAxes.inverted().transform(place))


def inline_svg(svg: str, name: str) -> Markup:
    """Fit an SVG file of Matplotlib's into a page that holds others."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", svg, count=1, flags=re.DOTALL)
    svg = re.sub(r' (xmlns|xmlns:xlink|width|height|version)="[^"]*"', "", svg, count=5)
    svg = svg.replace("fill: #ffffff", "fill: none", 1)  # the ground of the figure
    for color, variable in _THEME.items():
        svg = svg.replace(color.lower(), f"var(--{variable})")
    svg = re.sub(r'( id="|"#|url\(#)', rf"\g<1>{name}-", svg)
    return Markup(svg)  # Matplotlib escapes every text


# ---- Parts of figures ----------------------------------------------------------------------------


def floats(values: Iterable[float | None]) -> FloatArray:
    """Make an array of numbers of a JSON document, NaN for null."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def one_panel(width: float, height: float) -> tuple[Figure, Axes]:
    """Make a figure of one panel."""
    figure = new_figure(width, height)
    return figure, figure.add_subplot()


def row_of_panels(number: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Make a figure of panels side by side, each of this size."""
    figure = new_figure(width * number, height)
    return figure, list(figure.subplots(1, number, squeeze=False)[0])


def plain_log(axes: Axes, *which: str) -> None:
    """Make axes logarithmic, with plain numbers beside them, few enough not to collide."""
    for name in which:
        axes.set(**{f"{name}scale": "log"})
        axis = axes.xaxis if name == "x" else axes.yaxis
        low, high = axis.get_view_interval()
        subs = (1.0,) if high / low > 200 else (1.0, 2.0, 5.0)
        axis.set_major_locator(MaxNLocator(4) if high / low < 6 else LogLocator(subs=subs))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())


def legend(figure: Figure, *, where: str = "upper right", columns: int = 4) -> None:
    """Write one legend outside the panels, each label once."""
    known: dict[str, Any] = {
        label: handle
        for axes in figure.axes
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    if known:
        place: Any = f"outside {where}"
        figure.legend(known.values(), known.keys(), loc=place, ncols=columns, fontsize=8)


def points(
    axes: Axes,
    x: FloatArray,
    y: FloatArray,
    rows: BoolArray,
    mark: str = "o",
    *,
    style: Style | None = None,
) -> None:
    """Draw points of some rows; more than 800 as an image."""
    at = np.flatnonzero(rows & np.isfinite(x) & np.isfinite(y))
    (line,) = axes.plot(x[at], y[at], mark, ls="none", **(style or {}))
    line.set_rasterized(at.size > 800)


def judged(
    rows: BoolArray, good: BoolArray, color: str = BLUE
) -> Iterator[tuple[BoolArray, str, str]]:
    """Give the rows that are ok and those that are flagged, with colour and label, if any are."""
    for part, name in ((rows & good, "ok"), (rows & ~good, "flagged")):
        if part.any():
            yield part, color if name == "ok" else PURPLE, name


def whole_numbers(axes: Axes, x_label: str, y_label: str = "events") -> None:
    """Name the axes of a histogram, whose numbers are whole."""
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))


def whiskers(
    axes: Axes, at: Any, values: Any, ends: Any, *, along: str = "y", style: Style | None = None
) -> None:
    """Draw values with their intervals along an axis; `ends` are all lower and all upper ends."""
    values = np.asarray(values, dtype=float)
    low, high = np.asarray(ends, dtype=float)
    reach = np.nan_to_num(np.maximum([values - low, high - values], 0.0))
    x, y = (at, values) if along == "y" else (values, at)
    how: Style = {"fmt": "o", "ms": 4, "lw": 1, f"{along}err": reach, **(style or {})}
    axes.errorbar(x, y, **how)


def around(values: Any, reach: Any) -> tuple[FloatArray, FloatArray]:
    """Give the ends of intervals of this half length."""
    middle, half = np.asarray(values, dtype=float), np.asarray(reach, dtype=float)
    return middle - half, middle + half


def picture(
    axes: Axes,
    image: Any,
    half: float,
    limits: tuple[float, float],
    title: str,
    style: Style | None = None,
) -> None:
    """Draw an image whose half side is `half`, with its scale."""
    low, high = limits
    extent = (-half, half, half, -half)
    shown = axes.imshow(
        image, vmin=low, vmax=high, extent=extent, **{"cmap": "RdBu_r", **(style or {})}
    )
    axes.set_title(title)
    if (figure := axes.get_figure(root=True)) is not None:
        figure.colorbar(shown, ax=axes, shrink=0.8)


def scale_bar(axes: Axes, columns: int, rows: int, pixel_size_nm: float) -> None:
    """Draw a scale bar into the lower left corner of an image."""
    bars = [50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000]
    length_nm = max([b for b in bars if b <= 0.4 * columns * pixel_size_nm], default=bars[0])
    x, y = 0.04 * columns - 0.5, 0.955 * rows - 0.5
    wide, tall = length_nm / pixel_size_nm, 0.012 * rows
    axes.add_patch(Rectangle((x, y), wide, tall, fc="white", ec="black", lw=0.6, zorder=3))
    text = f"{length_nm / 1000:g} µm"
    axes.text(x, y - 0.015 * rows, text, color="white", fontsize=8, path_effects=HALO, zorder=3)
