"""How figures of Matplotlib look, and the parts that many of them have."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from iscat_analysis.records import BoolArray, FloatArray

DPI, PRINT_DPI = 140, 300
"""Resolution of the PNG files, and of those whose figures have the size of print."""

VERMILLION, BLUE, PURPLE, GREY, INK = "#D55E00", "#0072B2", "#CC79A7", "#8A8F96", "#1B1D21"

HALO = [withStroke(linewidth=1.6, foreground="black", alpha=0.7)]
"""Makes white text readable on any image."""

PALETTES: Mapping[str, tuple[str, ...]] = {
    "colour-blind safe": (BLUE, VERMILLION, PURPLE, "#009E73", "#E69F00", "#56B4E9"),
    "greys": ("#000000", "#555555", "#888888", "#AAAAAA", "#333333", "#777777"),
}
"""Colours of samples, by name."""

FONTS = ("sans-serif", "serif", "monospace")
"""Families of letters."""

Format = Literal["svg", "pdf", "png"]

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


def new_figure(width: float, height: float, *, constrained: bool = True) -> Figure:
    """Make a figure that no window shows."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


Style = dict[str, Any]
"""How something is drawn: arguments of Matplotlib's."""

# ---- Parts of figures ----------------------------------------------------------------------------


def floats(values: Iterable[float | None]) -> FloatArray:
    """Make an array of numbers of a JSON document, NaN for null."""
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def one_panel(width: float, height: float) -> tuple[Figure, Axes]:
    """Make a figure of one panel."""
    figure = new_figure(width, height)
    return figure, figure.add_subplot()


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


def scale_bar(axes: Axes, columns: int, rows: int, pixel_size_nm: float) -> None:
    """Draw a scale bar into the lower left corner of an image."""
    bars = [50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000]
    length_nm = max([b for b in bars if b <= 0.4 * columns * pixel_size_nm], default=bars[0])
    x, y = 0.04 * columns - 0.5, 0.955 * rows - 0.5
    wide, tall = length_nm / pixel_size_nm, 0.012 * rows
    axes.add_patch(Rectangle((x, y), wide, tall, fc="white", ec="black", lw=0.6, zorder=3))
    text = f"{length_nm / 1000:g} µm"
    axes.text(x, y - 0.015 * rows, text, color="white", fontsize=8, path_effects=HALO, zorder=3)


# ---- A histogram with its gates, for the app -----------------------------------------------------


def histogram_figure(
    samples: Sequence[tuple[str, Any]],
    *,
    size_cm: tuple[float, float] = (12.0, 8.0),
    font: tuple[str, float] = ("sans-serif", 9.0),
    palette: str = "colour-blind safe",
    gates: Sequence[Any] = (),
    curve: tuple[Any, Any] | None = None,
    density: bool = True,
) -> Figure:
    """Draw histograms over each other, shaded gates, and the curve of the species.

    A sample is its name and a `MassHistogram`; several are drawn as shares.  The font has a family
    and a size [pt].
    """
    colours = PALETTES[palette]
    shares = len(samples) > 1
    with mpl.rc_context({**STYLE, "font.family": font[0], "font.size": font[1]}):
        figure, axes = one_panel(*(side / 2.54 for side in size_cm))
        for place, (name, mass) in enumerate(samples):
            scale = 1.0 / max(mass.counts.sum(), 1.0) if shares else 1.0
            colour = colours[place % len(colours)]
            style: Style = {"color": colour if shares else GREY, "alpha": 0.9 if shares else 0.45}
            axes.stairs(mass.counts * scale, mass.edges, fill=not shares, label=name, **style)
            if density:
                axes.plot(mass.at, mass.density * scale, color=colour, lw=1.2)
        if curve is not None:
            axes.plot(*map(np.asarray, curve), color=VERMILLION, lw=1.6, label="species")
        for each in gates:
            axes.axvspan(each.low, each.high, color=BLUE, alpha=0.12, lw=0)
            text = f"{each.mean:.3g}\n{each.count}"
            middle = ((each.low + each.high) / 2, 0.98)
            place_of: Style = {"xycoords": ("data", "axes fraction"), "ha": "center"}
            axes.annotate(text, middle, color=INK, va="top", **place_of)
        bar = samples[0][1].bar if samples else 1.0
        label = "share of events" if shares else "events"
        axes.set(xlabel="mass [kDa]", ylabel=f"{label} per {bar:g}", ylim=(0, None))
        axes.set_xlim(left=min((float(mass.edges[0]) for _, mass in samples), default=0.0))
        if shares or curve is not None:
            axes.legend(loc="best")
    return figure


def figure_bytes(figure: Figure, kind: Format, *, dpi: int = 300) -> bytes:
    """Write a figure as a file's contents."""
    buffer = io.BytesIO()
    with mpl.rc_context(STYLE):
        figure.savefig(buffer, format=kind, dpi=dpi)
    return buffer.getvalue()
