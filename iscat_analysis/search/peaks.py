"""Peaks of smooth fields that are known at pixels only."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

SAMPLED = 0.85
"""Of a peak's height that the pixel next to it has at least."""

_ORDER = 5  # of the spline: a parabola misses 1 % of the height of a peak between four pixels
_REACH_PX = 6  # of the pixels that the spline goes through
_FINE = np.linspace(-0.625, 0.625, 11)


def summit(field: NDArray[Any], row: int, column: int) -> tuple[float, float, float]:
    """Find the top of a smooth field, or its bottom, between its pixels.

    Parameters
    ----------
    field : ndarray, shape (y, x)
        The field.
    row, column : int
        A pixel that no neighbour of its sign exceeds in magnitude.

    Returns
    -------
    dy, dx : float
        From the pixel to there; never out of the field.
    above : float
        Magnitude there above that at the pixel, ≥ 0.
    """
    value = float(field[row, column])
    around = np.arange(-_REACH_PX, _REACH_PX + 1)
    patch = field[
        np.ix_(*(_mirrored(c + around, n) for c, n in zip((row, column), field.shape, strict=True)))
    ]
    spline = _spline()
    fine = math.copysign(1.0, value) * (spline @ patch @ spline.T)
    y, x = (
        np.flatnonzero((c + _FINE >= 0) & (c + _FINE <= n - 1))
        for c, n in zip((row, column), field.shape, strict=True)
    )
    fine = fine[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
    i, j = (int(k) for k in np.unravel_index(int(fine.argmax()), fine.shape))
    (dy, above), (dx, beside) = vertex(fine[:, j], i), vertex(fine[i], j)
    spacing = float(_FINE[1] - _FINE[0])
    height = float(fine[i, j]) + above + beside
    return (
        float(_FINE[y[i]]) + spacing * dy,
        float(_FINE[x[j]]) + spacing * dx,
        max(height - abs(value), 0.0),
    )


def _mirrored(places: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Fold indices that lie outside back into an axis, at its first and last pixel."""
    period = max(2 * (size - 1), 1)
    folded = places % period
    return np.minimum(folded, period - folded) if size > 1 else np.zeros_like(places)


@cache
def _spline() -> NDArray[np.float64]:
    """Weights of the pixels at the places of `_FINE`, shape (len(_FINE), 2·_REACH_PX + 1)."""
    pixels = np.eye(2 * _REACH_PX + 1)
    places = [_REACH_PX + _FINE]
    return np.stack(
        [map_coordinates(one, places, order=_ORDER, mode="mirror") for one in pixels], axis=1
    )


def vertex(line: NDArray[Any], index: int) -> tuple[float, float]:
    """Vertex of the parabola through a maximum and its two neighbours.

    Parameters
    ----------
    line : ndarray, shape (n,)
        The field along one axis.
    index : int
        Where it has a maximum.

    Returns
    -------
    shift : float
        From the maximum to the vertex, at most half a step; 0 at an end of the line.
    above : float
        Height of the vertex above the maximum.
    """
    if not 0 < index < line.size - 1:
        return 0.0, 0.0
    low, mid, high = (float(v) for v in line[index - 1 : index + 2])
    bend = low - 2 * mid + high
    if bend >= 0:
        return 0.0, 0.0
    shift = max(-0.5, min(0.5 * (low - high) / bend, 0.5))
    return shift, 0.25 * (high - low) * shift
