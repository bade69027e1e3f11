"""Colours and ranges of images of events, and small files of them."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray
from PIL import Image

RESIDUAL_LIMIT = 4.0
"""Residual images span at least ± this many standard deviations."""

DIVERGING = LinearSegmentedColormap.from_list("residual", ["#00528C", "#FAFAF8", "#BE4600"])
"""Of residuals."""

GREYS = mpl.colormaps["gray"]
"""Of data and model."""

_NOTHING = 255  # of a palette: transparent


def display_range(images: Sequence[NDArray[np.floating[Any]]], scheme: str) -> tuple[float, float]:
    """Choose the grey scale that images share."""
    values = np.concatenate([np.ravel(image) for image in images])
    values = values[np.isfinite(values)]
    if not values.size:
        return -1.0, 1.0
    if scheme == "darkfield":
        low, high = (float(v) for v in np.quantile(values, [0.002, 0.999]))
        return (low, high) if high > low else (low, low + 1.0)
    limit = float(np.quantile(np.abs(values), 0.998))
    return (-limit, limit) if limit > 0 else (-1.0, 1.0)


def residual_limit(residual: NDArray[np.float64]) -> float:
    """Choose the range of a residual image: a few standard deviations, more where it needs more.

    Shapes: `residual` (y, x).
    """
    values = np.abs(residual[np.isfinite(residual)])
    return max(RESIDUAL_LIMIT, math.ceil(np.quantile(values, 0.995))) if values.size else 4.0


def shaded(values: NDArray[np.floating[Any]], shades: int, first: int = 0) -> NDArray[np.uint8]:
    """Give every pixel of an image the number of its shade, for `png_of`."""
    inside = np.rint(np.clip(np.nan_to_num(values), 0, 1) * (shades - 1)) + first
    return np.where(np.isfinite(values), inside, _NOTHING).astype(np.uint8)


def png_of(shades: NDArray[np.uint8], colours: NDArray[np.float64]) -> str:
    """Write a small PNG file.

    Shapes: `shades` (y, x), `colours` (n, 4).
    """
    picture = Image.fromarray(np.minimum(shades, len(colours)).astype(np.uint8))
    palette = np.rint(255 * colours[:, :3]).astype(int).ravel().tolist()
    picture.putpalette([*palette, 127, 127, 127])
    buffer = io.BytesIO()
    # noise never repeats itself: looking for that takes four times as long, and saves nothing
    picture.save(buffer, "PNG", transparency=len(colours), compress_type=Image.HUFFMAN_ONLY)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
