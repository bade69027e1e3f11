"""Tiles of a large field: chunks in space, as a movie is cut into chunks of time.

A tile has a core, whose particles are its own, and a halo around it as wide as the picture of a
strong particle reaches, so that every particle of the core is seen with all its neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from iscat_analysis.records import BoolArray, FloatArray

Box = tuple[slice, slice]
"""Rows and columns."""

EVERYWHERE: Box = (slice(None), slice(None))
"""All pixels."""


def middle_of_box(box: Box, shape: tuple[int, int], side_px: int) -> Box:
    """Give the middle of a box in an image, of at most a given side."""
    low, high = zip(*(part.indices(n)[:2] for part, n in zip(box, shape, strict=True)), strict=True)
    begins = [max(a, (a + b - side_px) // 2) for a, b in zip(low, high, strict=True)]
    rows, columns = (
        slice(begin, min(begin + side_px, b)) for begin, b in zip(begins, high, strict=True)
    )
    return rows, columns


def is_within(box: Box, y_px: float, x_px: float, margin_px: float) -> bool:
    """Whether a place is in a box of pixels, or nearer to it than a margin."""
    return all(
        (part.start is None or place >= part.start - 0.5 - margin_px)
        and (part.stop is None or place < part.stop - 0.5 + margin_px)
        for place, part in zip((y_px, x_px), box, strict=True)
    )


@dataclass(frozen=True)
class Tile:
    """Half-open ranges of full-frame pixels: the core of a tile, and the core with its halo."""

    core_rows: tuple[int, int]
    core_columns: tuple[int, int]
    rows: tuple[int, int]
    columns: tuple[int, int]
    field: tuple[int, int]

    @property
    def here(self) -> Box:
        """Index of the tile in a full frame."""
        return slice(*self.rows), slice(*self.columns)

    @property
    def core(self) -> Box:
        """Index of the core in a full frame."""
        return slice(*self.core_rows), slice(*self.core_columns)

    @property
    def inner(self) -> Box:
        """Index of the core in the tile; without an end where the field ends."""
        rows, columns = (
            slice(low - first if low > first else None, high - first if high < last else None)
            for (low, high), (first, last) in (
                (self.core_rows, self.rows),
                (self.core_columns, self.columns),
            )
        )
        return rows, columns

    @property
    def corner(self) -> tuple[int, int]:
        """First row and first column."""
        return self.rows[0], self.columns[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that the tile has, with its halo."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    @property
    def share(self) -> float:
        """Share of the field that the core has."""
        (top, bottom), (left, right) = self.core_rows, self.core_columns
        return (bottom - top) * (right - left) / math.prod(self.field)

    @property
    def is_central(self) -> bool:
        """Whether its core holds the middle of the field."""
        y, x = (np.array((n - 1) / 2) for n in self.field)
        return bool(self.holds(y, x))

    def holds(self, y_px: FloatArray, x_px: FloatArray, margin_px: float = 0.0) -> BoolArray:
        """Tell which places of the field are in the core; beyond the edge of the field it goes on.

        Shapes: `y_px, x_px` (n,), result (n,).
        """
        kept = np.ones(np.shape(y_px), dtype=np.bool_)
        for place, (low, high), size in zip(
            (y_px, x_px), (self.core_rows, self.core_columns), self.field, strict=True
        ):
            if low > 0:
                kept &= place >= low - 0.5 - margin_px
            if high < size:
                kept &= place < high - 0.5 + margin_px
        return kept


def cut_field(shape: tuple[int, int], parts: tuple[int, int], halo_px: int) -> list[Tile]:
    """Cut a field into so many rows and columns of tiles."""
    edges = [
        np.linspace(0, size, number + 1).round().astype(int).tolist()
        for size, number in zip(shape, parts, strict=True)
    ]
    tiles = []
    for core_rows in pairwise(edges[0]):
        for core_columns in pairwise(edges[1]):
            rows, columns = (
                (max(low - halo_px, 0), min(high + halo_px, size))
                for (low, high), size in zip((core_rows, core_columns), shape, strict=True)
            )
            tiles.append(Tile(core_rows, core_columns, rows, columns, shape))
    return tiles


@dataclass(frozen=True)
class FieldSums:
    """What some frames say of the whole field, or of a tile: made once for all of its tiles.

    Shapes: `good, power` (t,), the others (y, x).
    """

    span: tuple[int, int]
    good: BoolArray
    power: FloatArray
    level_e: float
    mean_e: FloatArray
    usable: BoolArray
    saturated: BoolArray

    def part(self, here: Box) -> FieldSums:
        """Copy what belongs to some pixels."""
        return replace(
            self,
            mean_e=self.mean_e[here].copy(),
            usable=self.usable[here].copy(),
            saturated=self.saturated[here].copy(),
        )
