"""Stored counts of frames that lie in one or several arrays, as in the files of one recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.last_used import LastUsed
from iscat_analysis.records import CountSource, InPlace, PlacedSource
from iscat_analysis.search.sliding.tiles import EVERYWHERE, Box

REGION_BYTES = 40_000_000
"""Of the regions that a chunk or a tile holds."""

_SPREAD = 2  # times the frames that are asked for, that lie between the first and the last
_NO_COUNTS: NDArray[Any] = np.empty((0, 0, 0))


class StoredFrames:
    """Arrays of frames, one after the other, indexed as one array (t, y, x); or a box of them."""

    def __init__(self, parts: Sequence[NDArray[Any]], box: Box = EVERYWHERE) -> None:
        self._parts = parts
        ends = (part.indices(n)[:2] for part, n in zip(box, parts[0].shape[1:], strict=True))
        self._rows, self._columns = ends
        self._edges = np.cumsum([0, *map(len, parts)]).tolist()
        self.shape = (
            int(self._edges[-1]),
            self._rows[1] - self._rows[0],
            self._columns[1] - self._columns[0],
        )
        self.dtype = parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def views(self, start: int, stop: int, box: Box = EVERYWHERE) -> StoredFrames:
        """View a box of pixels in frames ``[start, stop)``."""
        held = list(zip(pairwise(self._edges), self._parts, strict=True))
        near = [one for one in held if one[0][0] < stop and start < one[0][1]] or held[:1]
        parts = [part[max(start - low, 0) : stop - low] for (low, _), part in near]
        ends = (part.indices(n)[:2] for part, n in zip(box, self.shape[1:], strict=True))
        rows, columns = (
            slice(first + low, first + high)
            for (first, _), (low, high) in zip((self._rows, self._columns), ends, strict=True)
        )
        return StoredFrames(parts, (rows, columns))

    def array(self, start: int, stop: int, box: Box = EVERYWHERE) -> NDArray[Any]:
        """Give a box of pixels in frames ``[start, stop)``: a view where one array has them all.

        Shapes: result (stop − start, y, x).
        """
        seen = self.views(start, stop, box)
        here = slice(None), slice(*seen._rows), slice(*seen._columns)
        parts = [part[here] for part in seen._parts]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def whole(self, start: int, stop: int) -> tuple[NDArray[Any], tuple[int, int]]:
        """Give contiguous frames ``[start, stop)``, and where in them these pixels begin.

        Shapes: result (stop − start, all y, all x).
        """
        seen = self.views(start, stop)
        if len(seen._parts) == 1 and seen._parts[0].flags.c_contiguous:
            return seen._parts[0], (self._rows[0], self._columns[0])
        return np.ascontiguousarray(seen.array(0, stop - start)), (0, 0)


class HeldRegions:
    """The regions that were copied last: steps at one place ask for them in each of their fits."""

    def __init__(self) -> None:
        self._held: LastUsed[tuple[int, NDArray[Any]]] = LastUsed(REGION_BYTES)

    def frames(
        self,
        wanted: slice,
        rows: tuple[int, int],
        columns: tuple[int, int],
        copied: Callable[[slice, tuple[int, int], tuple[int, int]], NDArray[Any]],
    ) -> NDArray[Any]:
        """Give frames of a region, of which those that are not held yet are copied.

        Shapes: result (t, y, x).
        """
        low, held = self._held.get((rows, columns)) or (wanted.start, _NO_COUNTS)
        high = low + len(held)
        first, last = min(low, wanted.start), max(high, wanted.stop)
        if last - first > _SPREAD * (len(held) + wanted.stop - wanted.start):
            return copied(wanted, rows, columns)
        parts = [copied(slice(first, low), rows, columns)] if first < low else []
        parts += [held] if len(held) else []
        parts += [copied(slice(high, last), rows, columns)] if high < last or not parts else []
        counts = parts[0] if len(parts) == 1 else np.concatenate(parts)
        self._held.hold((rows, columns), (first, counts), counts.nbytes)
        return counts[wanted.start - first : wanted.stop - first]


def frames_in_place(movie: CountSource, start: int, stop: int) -> list[InPlace]:
    """Map frames where they lie, in as few runs as there are; nothing if some have to be read."""
    if not isinstance(movie, PlacedSource):
        return []
    found: list[InPlace] = []
    while start < stop:
        run = movie.in_place(start, stop)
        few, many = 1, stop - start  # frames of a run that is one, and that is none
        if run is None:
            run = movie.in_place(start, start + few)
            while run is not None and many - few > 1:
                middle = (few + many) // 2
                longer = movie.in_place(start, start + middle)
                few, many, run = (few, middle, run) if longer is None else (middle, many, longer)
        if run is None:
            return []
        found.append(run)
        start += len(run.counts)
    return found
