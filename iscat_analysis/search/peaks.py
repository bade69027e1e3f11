"""Peaks of smooth fields between pixels, and the residuals of a bright particle beside a candidate.

A model that is not quite right leaves rings around every bright particle, which the matched filter
takes for more.  How large they are is measured on the particle itself:

- around it, at the distance of the candidate: a second particle fills a small part of that ring, a
  misfit rises as high on much of it;
- in its fitted region: a second particle explains most of the χ² in excess, a peak of a misfit a
  small share.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from iscat_analysis._kernels.sliding import ring_heights
from iscat_analysis.records import FloatArray

SAMPLED = 0.85
"""Of a peak's height that the pixel next to it has at least."""

_REACH_PX = 6  # of the pixels that the spline goes through
_FINE = np.linspace(-0.625, 0.625, 11)


def maxima(
    fields: NDArray[Any], least: float, reach: tuple[int, int, int], *, both: bool = False
) -> NDArray[np.int64]:
    """Find local maxima above a threshold in a stack of fields; of `both` signs if wanted.

    Shapes: `fields` (k, y, x), result (n, 3).
    """
    values = np.ascontiguousarray(fields).ravel()
    at = np.flatnonzero((values > least) | (both & (values < -least)))
    place = np.stack(np.unravel_index(at, fields.shape))
    apart = [math.prod(fields.shape[axis + 1 :]) for axis in range(fields.ndim)]
    offsets = product(*(range(-n, n + 1) for n in reach))
    for offset in sorted(offsets, key=lambda o: sum(map(abs, o))):  # the nearest leave few others
        neighbour = at
        for axis in np.flatnonzero(offset):  # at an edge, the outermost pixel
            moved = np.minimum(np.maximum(place[axis] + offset[axis], 0), fields.shape[axis] - 1)
            neighbour = neighbour + apart[axis] * (moved - place[axis])
        kept = np.abs(values[at]) >= np.sign(values[at]) * values[neighbour]
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
    near = np.arange(2 * _REACH_PX + 1)  # mirrored at the first and the last pixel
    y, x = (
        np.pad(np.arange(size), _REACH_PX, mode="reflect")[at_pixel[:, None] + near]
        for at_pixel, size in zip(place, fields.shape[1:], strict=True)
    )
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
    above = np.maximum(height - np.abs(value), 0.0)
    return _FINE[i] + spacing * dy, _FINE[j] + spacing * dx, above


@cache
def _spline() -> FloatArray:
    """Weights of the pixels at the places of `_FINE`, shape (len(_FINE), 2·_REACH_PX + 1)."""
    pixels = np.eye(2 * _REACH_PX + 1)
    places = [_REACH_PX + _FINE]
    return np.stack(
        # of the spline: a parabola misses 1 % of the height of a peak between four pixels
        [map_coordinates(one, places, order=5, mode="mirror") for one in pixels],
        axis=1,
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


EXCEEDS = 1.5
"""Times the height of its ring that a particle must have."""

EXPLAINS = 0.5
"""Share of the χ² in excess that a particle inside the fitted region must explain."""


RINGS = 0.04
"""Share of a particle's signal-to-noise ratio that the model may leave over around it, where that
is not measured."""

_RING_PX = 2.0  # on either side of the candidate's distance


@dataclass(frozen=True)
class Described:
    """How well a fit describes its region: what it explains, and its misfit."""

    snr: float
    excess: float

    @classmethod
    def of(cls, snr: float, chi2_reduced: float, n_pixels: int) -> Described:
        """Make it of a fit."""
        return cls(snr, _significant((chi2_reduced - 1) * n_pixels, n_pixels))

    def is_dwarfed(self, others: Iterable[Described]) -> bool:
        """Whether it explains less than it leaves over, beside a particle that is far brighter.

        A model that is wrong leaves the same share of every particle, which the brighter one shows:
        so much of the excess is the particle's own.
        """
        brightest = max(others, key=lambda other: other.snr, default=self)
        own = brightest.excess * (self.snr / brightest.snr) ** 2 if brightest.snr else 0.0
        # Times the signal-to-noise ratio of an event from which on another one near it dwarfs it.
        return brightest.snr > 3.0 * self.snr and self.snr**2 < EXPLAINS * (self.excess - own)


def is_hidden(snr: float, size: float) -> bool:
    """Whether a candidate is too low to be listed, even as a side lobe."""
    # Share of what a particle must have from which a candidate is listed, as a side lobe.
    return abs(snr) <= 0.7 * size


def chi2_excess(residuals: NDArray[Any]) -> float:
    """Measure the misfit of a fit."""
    n = int(np.count_nonzero(np.isfinite(residuals)))
    return _significant(float(np.nansum(residuals**2)) - n, n)


def _significant(excess: float, n_pixels: int) -> float:
    """Excess of χ², 0 where it may be noise."""
    # of χ²'s own scatter, below which an excess may be noise
    return excess if excess > 3.0 * math.sqrt(2 * n_pixels) else 0.0


def size_on_ring(
    snr: NDArray[Any],
    centre: tuple[float, float],
    place: tuple[float, float],
    others: ArrayLike = (),
) -> float:
    """Give how high the map rises at a candidate's distance from a particle, beside its own peak.

    The highest peak there may be another particle that is not known yet, and a fifth of what is
    then left of the ring may be higher, for more: a misfit rises all around.

    Shapes: `snr` (y, x), `others` (n, 2), their x and y.
    """
    (x0, y0), (xc, yc) = centre, place
    distance = max(math.hypot(xc - x0, yc - y0), _RING_PX)
    reach = 2 * (distance + _RING_PX)  # farther away, others share no pixels with the ring
    known = np.asarray(others, dtype=np.float64).reshape(-1, 2)
    near = known[np.hypot(known[:, 0] - x0, known[:, 1] - y0) < reach]
    # of the ring, along it
    highest = np.empty(max(8, round(2 * math.pi * distance / 4.0)))
    ring = (float(x0), float(y0)), (float(xc), float(yc)), _RING_PX
    ring_heights(snr, *ring, 5.0, near, highest)  # but around the candidate, which is its own
    seen = np.sort(highest[highest >= 0])
    if not seen.size:
        return 0.0
    # share of the ring that is lower than what counts as its height
    return float(np.interp(0.8 * (seen.size - 1), np.arange(seen.size), seen))
