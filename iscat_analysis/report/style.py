"""How figures for print look: Matplotlib's own objects, no global state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

DPI = 140
"""Resolution of the PNG files."""

VERMILLION, BLUE, PURPLE, GREY, INK = "#D55E00", "#0072B2", "#CC79A7", "#8A8F96", "#1B1D21"

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "iscat-analysis",
}
"""Settings of Matplotlib to draw and save under."""


def new_figure(width: float, height: float, *, constrained: bool = True) -> Figure:
    """Make a figure of its own, which no window shows.

    Parameters
    ----------
    width, height : float
        Size [inches].
    constrained : bool
        Whether Matplotlib finds the places of what is drawn.

    Returns
    -------
    Figure
        Empty.
    """
    figure = Figure(figsize=(width, height), layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, stem: Path) -> None:
    """Write a figure as PNG and SVG, the same at any time.

    Parameters
    ----------
    figure : Figure
        What to write.
    stem : Path
        Of the two files.
    """
    figure.savefig(stem.with_suffix(".png"), dpi=DPI, pil_kwargs={"compress_level": 3})
    figure.set_layout_engine("none")  # everything has its place
    figure.savefig(stem.with_suffix(".svg"), metadata={"Date": None})


def log_y(axes: Axes) -> None:
    """Set a logarithmic y axis with plain numbers.

    Parameters
    ----------
    axes : Axes
        With what it shows already drawn.
    """
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    steps = {200.0: (1.0,), 20.0: (1.0, 2.0, 5.0), 4.0: (1.0, 2.0, 3.0, 5.0, 7.0)}
    finest = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)
    subs = next((subs for span, subs in steps.items() if high / low > span), finest)
    axes.yaxis.set_major_locator(LogLocator(subs=subs))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
