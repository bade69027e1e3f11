"""How figures look, in files and inside a page."""

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
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from PIL import Image

DPI = 140
"""Resolution of the PNG files."""

PRINT_DPI = 300
"""The same of figures that have the size of print."""

VERMILLION, BLUE, PURPLE, GREY, INK = "#D55E00", "#0072B2", "#CC79A7", "#8A8F96", "#1B1D21"
GRID = "#E7E4DD"

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


def log_y(axes: Axes) -> None:
    """Set a logarithmic y axis with plain numbers."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    steps = {200.0: (1.0,), 20.0: (1.0, 2.0, 5.0), 4.0: (1.0, 2.0, 3.0, 5.0, 7.0)}
    finest = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    subs = next((subs for span, subs in steps.items() if high / low > span), finest)
    axes.yaxis.set_major_locator(LogLocator(subs=subs))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
