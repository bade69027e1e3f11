"""Filtered sliding contrast of a chunk, without the steps that are known.

The filter is linear and a step reaches no farther than its image and the template.  Steps that are
new or fitted again therefore change the maps only near them.  Where common light, motion of the
pattern or correlated noise is removed as well, a step changes the whole field, and the maps are
computed again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from iscat_analysis._kernels.stepping import add_image
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.pattern import MovingPattern
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.records import FloatArray, Mapper
from iscat_analysis.search.sliding import STRIDES, Chunk, Filter, MapArray, sliding_maps


class StepMaps:
    """The maps of one chunk, updated from search to search."""

    def __init__(
        self,
        context: AnalysisContext,
        chunk: Chunk,
        matched: Filter,
        neighbours: Neighbours,
        pattern: MovingPattern | None = None,
    ) -> None:
        self._context, self._chunk, self.matched = context, chunk, matched
        self._neighbours, self._pattern = neighbours, pattern
        self.is_local = maps_are_local(context, moving=pattern is not None)
        self._maps: tuple[MapArray, FloatArray] | None = None
        self._known: list[Step] = []
        self._near: list[list[Step]] = []  # of those known, which were taken off each map

    def without(self, steps: Sequence[Step], mapper: Mapper) -> tuple[MapArray, FloatArray]:
        """Subtract known steps."""
        if self.is_local:
            maps = self._maps or sliding_maps(
                self._chunk, self.matched, STRIDES, in_place=self._chunk.lends_blocks, mapper=mapper
            )
            for step in _missing(self._known, steps):
                self._add(maps, step, 1.0)
            for step in _missing(steps, self._known):
                self._add(maps, step, -1.0)
        else:
            maps = self._anew(steps, mapper)
        self._maps, self._known = maps, list(steps)
        return maps

    def _windows(self, boundary: int) -> tuple[slice, slice]:
        """Frames before and after a boundary that are compared there, relative to the chunk."""
        edges = self._chunk.edges
        low, high = max(boundary + 1 - STRIDES, 0), min(boundary + 1 + STRIDES, edges.size - 1)
        middle = int(edges[boundary + 1])
        return slice(int(edges[low]), middle), slice(middle, int(edges[high]))

    def _add(self, maps: tuple[MapArray, FloatArray], step: Step, share: float) -> None:
        """Add a multiple of the contrast of a step to the maps around it."""
        snr, effective = maps
        here = int(np.searchsorted(self._chunk.edges, step.at.frame - self._chunk.first))
        filtered = None
        for boundary in range(max(here - STRIDES - 1, 0), min(here + STRIDES, len(snr))):
            before, after = self._windows(boundary)
            if not self._neighbours.overlaps(step, before.start, after.stop):
                continue
            image, part = self._neighbours.change(step, before, after)
            if filtered is None or image is not filtered[0]:
                filtered = image, *self.matched.response(step.corner, image)
            _, box, response = filtered
            scale = share * part * math.sqrt(effective[boundary])
            corner = box[0].start, box[1].start
            add_image(snr[boundary], corner, response, np.float32(scale))

    def _anew(self, steps: Sequence[Step], mapper: Mapper) -> tuple[MapArray, FloatArray]:
        """Compute the maps again where the known steps have changed."""
        moving, chunk = self._pattern, self._chunk
        near = []
        for boundary in range(chunk.edges.size - 2):
            before, after = self._windows(boundary)
            span = moving.span(before, after) if moving else slice(before.start, after.stop)
            near.append([s for s in steps if self._neighbours.overlaps(s, span.start, span.stop)])

        def explained(boundary: int, before: slice, after: slice) -> FloatArray | None:
            if not near[boundary]:
                return moving.contrast[boundary] if moving else None
            total = np.zeros(chunk.shape)
            for step in near[boundary]:
                self._neighbours.add_change(total, step, before, after)
            total = self._context.left(total)
            return total + moving.contrast[boundary] * (1 + total) if moving else total

        changed = [
            j
            for j, (old, now) in enumerate(zip(self._near or near, near, strict=True))
            if _ids(old) != _ids(now)
        ]
        self._near = near
        return sliding_maps(
            chunk, self.matched, STRIDES,
            explained=explained if steps or moving else None,
            earlier=self._maps, changed=changed, mapper=mapper,
        )  # fmt: skip


def maps_are_local(context: AnalysisContext, *, moving: bool) -> bool:
    """Whether a step changes the maps near it alone, so that nobody makes them again."""
    return not moving and context.lines is None and context.templates.noise is None


def _ids(steps: Sequence[Step]) -> set[int]:
    """Give the identities of steps; one that was fitted again is another object."""
    return {id(step) for step in steps}


def _missing(some: Sequence[Step], others: Sequence[Step]) -> list[Step]:
    """Give the steps of one list that are not in another."""
    there = _ids(others)
    return [step for step in some if id(step) not in there]
