"""A sample of the pixels of a large field, by which its noise is judged.

Small squares, one at random in each part of the field, are put side by side as frames of a small
movie.  What is measured on it has the error of a movie of that size, which is small enough: the
squares scatter by more where the field is not alike everywhere, and that scatter is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import CountSource, PlacedSource

LARGEST_PX = 2**18
"""Pixels of a field, up to which all of them are looked at."""

_SIDE, _ALONG = 64, 4  # of a square, and squares along each axis: together 256 × 256 pixels


@dataclass(frozen=True)
class FieldSample:
    """Squares of a field of a shape, by their first rows and columns."""

    shape: tuple[int, int]
    corners: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, shape: tuple[int, int]) -> FieldSample | None:
        """Choose squares, always the same in fields of one shape; None where the field is small."""
        if math.prod(shape) <= LARGEST_PX or min(shape) < _SIDE * _ALONG:
            return None
        rng = np.random.default_rng(1)
        edges = [np.linspace(0, size, _ALONG + 1).astype(int) for size in shape]
        corners = [
            (int(rng.integers(top, bottom - _SIDE + 1)), int(rng.integers(left, right - _SIDE + 1)))
            for top, bottom in pairwise(edges[0])
            for left, right in pairwise(edges[1])
        ]
        return cls(shape, tuple(corners))

    def taken(self, images: NDArray[Any]) -> NDArray[Any]:
        """Cut the squares out of images and put them side by side.

        Shapes: `images` (…, y, x), result (…, 256, 256).
        """
        side = _SIDE * _ALONG
        out = np.empty((*images.shape[:-2], side, side), dtype=images.dtype)
        for number, (top, left) in enumerate(self.corners):
            y, x = (_SIDE * k for k in divmod(number, _ALONG))
            square = images[..., top : top + _SIDE, left : left + _SIDE]
            out[..., y : y + _SIDE, x : x + _SIDE] = square
        return out

    def camera(self, camera: Camera) -> Camera:
        """Give the camera of the squares."""
        return camera.mapped(self.taken)

    def scatter(self, counts: NDArray[Any], camera: Camera) -> tuple[float, float]:
        """Noise between neighbouring frames over that of the light, and its standard error.

        The error follows from the scatter of the squares.

        Shapes: `counts` (t, 256, 256), `camera` that of the squares.
        """
        steady = camera.steady(counts)
        if steady is None:
            return math.nan, math.nan
        electrons, _ = steady
        noise = np.square(np.diff(electrons, axis=0)).mean(axis=0) / 2
        light = electrons.mean(axis=0) + camera.read_variance_e2((_SIDE * _ALONG, _SIDE * _ALONG))
        each, expected = (
            image.reshape(_ALONG, _SIDE, _ALONG, _SIDE).mean(axis=(1, 3)).ravel()
            for image in (noise, light)
        )
        ratio = each / expected
        return float(ratio.mean()), float(ratio.std(ddof=1) / math.sqrt(ratio.size))

    def summary(self, ratio: float, error: float) -> dict[str, Any]:
        """Give what ``summary.json`` says of it."""
        return {
            "pixels": _SIDE**2 * len(self.corners),
            "of": math.prod(self.shape),
            "side_px": _SIDE,
            "corners_px": [list(corner) for corner in self.corners],
            "seed": 1,
            "noise_ratio": ratio,
            "noise_ratio_se": error,
        }


class CutFrames:
    """Frames of a movie, of which only some of the pixels are kept.

    Where frames lie in the file as they are, the others are not read.
    """

    def __init__(
        self,
        movie: CountSource,
        shape: tuple[int, int],
        cut: Callable[[NDArray[Any]], NDArray[Any]],
    ) -> None:
        self._movie, self._cut = movie, cut
        self.shape = (movie.shape[0], *shape)
        self.name, self.dtype = movie.name, movie.dtype

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        movie = self._movie
        placed = movie.in_place(start, stop) if isinstance(movie, PlacedSource) else None
        if placed is not None:
            placed.check()
            out = np.array(self._cut(placed.counts))
            placed.let_go()
            return out
        # some megabytes of whole frames are read at a time
        step = max(1, 2**24 // (math.prod(movie.shape[1:]) * movie.dtype.itemsize))
        out = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        for first in range(start, stop, step):
            end = min(first + step, stop)
            out[first - start : end - start] = self._cut(movie.read(first, end))
        return out


def sampled(movie: CountSource, camera: Camera) -> tuple[CountSource, Camera]:
    """Give a movie of a sample of the pixels and its camera; a small field as it is."""
    sample = FieldSample.of((movie.shape[1], movie.shape[2]))
    if sample is None:
        return movie, camera
    side = _SIDE * _ALONG
    return CutFrames(movie, (side, side), sample.taken), sample.camera(camera)


def whole_frames(shape: tuple[int, ...], most: int, least: int = 16) -> int:
    """Say how many whole frames tell as much as so many of 256 × 256 pixels."""
    return min(most, max(least, 256**2 * most // math.prod(shape)))
