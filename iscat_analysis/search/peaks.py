"""Peaks of smooth fields that are sampled at pixels."""

from __future__ import annotations

import math
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

FloatArray = NDArray[np.float64]

SAMPLED = 0.85
"""Of a peak's height that the pixel next to it has at least."""

_ORDER = 5  # of the spline: a parabola misses 1 % of the height of a peak between four pixels
_REACH_PX = 6  # of the pixels that the spline goes through
_FINE = np.linspace(-0.625, 0.625, 11)


def maxima(fields: NDArray[Any], least: float, reach: tuple[int, int, int]) -> NDArray[np.int64]:
    """Find local maxima above a threshold in a stack of fields.

    Shapes: `fields` (k, y, x), result (n, 3).
    """
    values = np.ascontiguousarray(fields).ravel()
    at = np.flatnonzero(values > least)
    place = np.stack(np.unravel_index(at, fields.shape))
    apart = [math.prod(fields.shape[axis + 1 :]) for axis in range(fields.ndim)]
    offsets = product(*(range(-n, n + 1) for n in reach))
    for offset in sorted(offsets, key=lambda o: sum(map(abs, o))):  # the nearest leave few others
        neighbour = at
        for axis in np.flatnonzero(offset):  # at an edge, the outermost pixel
            moved = np.minimum(np.maximum(place[axis] + offset[axis], 0), fields.shape[axis] - 1)
            neighbour = neighbour + apart[axis] * (moved - place[axis])
        kept = values[at] >= values[neighbour]
        at, place = at[kept], place[:, kept]
    return place.T


def summits(
    fields: NDArray[Any], at: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Find maxima or minima of smooth fields between the pixels.

    Shapes: `fields` (k, y, x), `at` (n, 3), `dy, dx` (n,), `above` (n,).
    """
    layer, *place = at.T
    value = fields[layer, place[0], place[1]].astype(np.float64)
    around = np.arange(-_REACH_PX, _REACH_PX + 1)
    y, x = (_mirrored(c[:, None] + around, n) for c, n in zip(place, fields.shape[1:], strict=True))
    patches = fields[layer[:, None, None], y[:, :, None], x[:, None, :]]
    spline = _spline()
    fine = np.where(value < 0, -1.0, 1.0)[:, None, None] * (spline @ patches @ spline.T)
    there = [c[:, None] + _FINE for c in place]
    inside = [(t >= 0) & (t <= n - 1) for t, n in zip(there, fields.shape[1:], strict=True)]
    fine[~(inside[0][:, :, None] & inside[1][:, None, :])] = -np.inf
    i, j = np.divmod(fine.reshape(-1, _FINE.size**2).argmax(axis=1), _FINE.size)
    each = np.arange(len(at))
    (dy, higher), (dx, neighbour) = vertices(fine[each, :, j], i), vertices(fine[each, i], j)
    height = fine[each, i, j] + higher + neighbour
    spacing = float(_FINE[1] - _FINE[0])
    return (
        _FINE[i] + spacing * dy,
        _FINE[j] + spacing * dx,
        np.maximum(height - np.abs(value), 0.0),
    )


def _mirrored(places: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """Reflect indices outside an axis at its first and last pixel."""
    period = max(2 * (size - 1), 1)
    folded = places % period
    return np.minimum(folded, period - folded) if size > 1 else np.zeros_like(places)


@cache
def _spline() -> FloatArray:
    """Weights of the pixels at the places of `_FINE`, shape (len(_FINE), 2·_REACH_PX + 1)."""
    pixels = np.eye(2 * _REACH_PX + 1)
    places = [_REACH_PX + _FINE]
    return np.stack(
        [map_coordinates(one, places, order=_ORDER, mode="mirror") for one in pixels], axis=1
    )


def vertices(lines: NDArray[Any], index: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """Vertices of the parabolas through maxima and their two neighbours.

    Shapes: `lines` (n, m), `index` (n,), `shift` (n,), `above` (n,).
    """
    each, last = np.arange(len(lines)), lines.shape[1] - 1
    before, after = np.maximum(index - 1, 0), np.minimum(index + 1, last)
    low, mid, high = (lines[each, place] for place in (before, index, after))
    inner = (index > 0) & (index < last) & np.isfinite(low) & np.isfinite(high)
    low, high = np.where(inner, low, mid), np.where(inner, high, mid)
    curvature = low - 2 * mid + high
    is_peak = curvature < 0
    shift = np.where(is_peak, 0.5 * (low - high) / np.where(is_peak, curvature, 1.0), 0.0).clip(
        -0.5, 0.5
    )
    return shift, 0.25 * (high - low) * shift
