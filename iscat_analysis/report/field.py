"""The axes of a field of view, whatever its shape."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iscat_analysis.report.style import new_figure

MOST_ELONGATED = 5.0
"""Longer side over the shorter one, beyond which pixels are stretched: nothing could be told."""

_WIDE_IN = 5.2  # of the axes, beside what is written
_TALL_IN = (1.0, 7.5)
_WRITTEN_IN = (1.0, 0.5)  # beside the axes and below them
_TITLE_IN = 0.25


def field_axes(shape: tuple[int, int]) -> tuple[Figure, Axes, tuple[float, float]]:
    """Make a figure for a field of view."""
    true = shape[0] / shape[1]
    drawn = float(np.clip(true, 1 / MOST_ELONGATED, MOST_ELONGATED))
    stretched = drawn / true
    tall = float(np.clip(_WIDE_IN * drawn, *_TALL_IN))
    title = 0.0 if drawn == true else _TITLE_IN
    figure = new_figure(_WIDE_IN + _WRITTEN_IN[0], tall + _WRITTEN_IN[1] + title)
    axes = figure.add_subplot()
    if drawn != true:
        stretch = "tall as wide" if stretched > 1 else "wide as tall"
        times = max(stretched, 1 / stretched)
        axes.set_title(f"pixels are drawn {times:.2g} times as {stretch}", fontsize=8)
    wide = min(_WIDE_IN, tall / drawn)
    return figure, axes, (shape[1] / wide, shape[0] / (wide * drawn))
