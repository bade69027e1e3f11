"""Stored counts of frames that lie in one or several arrays, as in the files of one recording."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.records import CountSource, InPlace, PlacedSource
from iscat_analysis.search.sliding.tiles import EVERYWHERE, Box


class StoredFrames:
    """Arrays of frames, one after the other, indexed as one array (t, y, x)."""

    def __init__(self, parts: Sequence[NDArray[Any]]) -> None:
        self._parts = parts
        self._edges = np.cumsum([0, *map(len, parts)]).tolist()
        self.shape = (int(self._edges[-1]), int(parts[0].shape[1]), int(parts[0].shape[2]))
        self.dtype = parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def views(self, start: int, stop: int, box: Box = EVERYWHERE) -> StoredFrames:
        """View a box of pixels in frames ``[start, stop)``."""
        held = list(zip(pairwise(self._edges), self._parts, strict=True))
        near = [one for one in held if one[0][0] < stop and start < one[0][1]] or held[:1]
        return StoredFrames(
            [part[(slice(max(start - low, 0), stop - low), *box)] for (low, _), part in near]
        )

    def array(self, start: int, stop: int, box: Box = EVERYWHERE) -> NDArray[Any]:
        """Give a box of pixels in frames ``[start, stop)``: a view where one array has them all.

        Shapes: result (stop − start, y, x).
        """
        parts = self.views(start, stop, box)._parts
        return parts[0] if len(parts) == 1 else np.concatenate(parts)


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
