"""Filtered sliding contrast of a chunk without the known steps, and which of its peaks are steps.

The filter is linear and a step reaches no farther than its image and the template.  Steps that are
new or fitted again therefore change the maps only near them.  Where common light, motion of the
pattern or correlated noise is removed as well, a step changes the whole field, and the maps are
computed again.

A peak near a higher one waits until that one is fitted and subtracted.  If it is still there, it
must exceed the residual of the fits, which `iscat_analysis.search.peaks` measures.  The level that
a peak needs at a place and boundary is the larger of these and the threshold of the search, and the
share of field and time that has been searched follows from it, for each signal-to-noise ratio.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.landing.neighbours import Neighbours, Step
from iscat_analysis.records import FloatArray, Mapper
from iscat_analysis.search.frames import EVERYWHERE, Box
from iscat_analysis.search.peaks import EXCEEDS, EXPLAINS, RINGS, is_hidden, size_on_ring
from iscat_analysis.search.sliding import STRIDES, Filter, MapArray, Peak, sliding_maps
from iscat_analysis.search.templates import FAR_LOBE, LARGEST_IMAGE, NEAR, SIDELOBE


class StepMaps:
    """The maps of one chunk, updated from search to search."""

    def __init__(self, neighbours: Neighbours, matched: Filter) -> None:
        self._context, self._chunk = neighbours.context, neighbours.chunk
        self._neighbours, self._pattern, self.matched = neighbours, neighbours.pattern, matched
        self.is_local = maps_are_local(self._context, moving=self._pattern is not None)
        self._maps: tuple[MapArray, FloatArray] | None = None
        self._known: list[Step] = []
        self._near: list[list[Step]] = []  # of those known, which were taken off each map

    def without(self, steps: Sequence[Step], mapper: Mapper) -> tuple[MapArray, FloatArray]:
        """Subtract known steps."""
        if self.is_local:
            maps = self._maps or sliding_maps(
                self._chunk, self.matched, STRIDES, in_place=self._chunk.lends_blocks, mapper=mapper
            )
            old, now = set(self._known), set(steps)
            for step in (*self._known, *steps):
                if step not in old or step not in now:
                    self._add(maps, step, 1.0 if step in old else -1.0)
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
            snr[boundary][box] += np.float32(scale) * response

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
            if {*old} != {*now}
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


@dataclass(frozen=True)
class SidelobeFilter:
    """Separates steps from side lobes of other steps."""

    first: int
    stride: int
    window: int
    roi_px: int

    def sift(
        self, peaks: Sequence[Peak], steps: Sequence[Step], snr: MapArray
    ) -> tuple[list[Peak], list[Peak]]:
        """Sort peaks into steps, peaks that wait, and side lobes.

        Shapes: `snr` (n, y, x).
        """
        fresh: list[Peak] = []
        doubtful: list[Peak] = []
        dated = np.array([step.at.frame for step in steps])
        places = np.array([(step.start.x_px, step.start.y_px) for step in steps]).reshape(-1, 2)
        for peak, waits in zip(peaks, self._waiting(peaks), strict=True):
            if waits:
                continue
            met = np.flatnonzero(np.abs(dated - peak.frame) <= (STRIDES + 1) * self.stride)
            there = places[met]
            away = np.hypot(there[:, 0] - peak.x_px, there[:, 1] - peak.y_px)
            order = np.argsort(away, kind="stable")
            order = order[: np.searchsorted(away[order], LARGEST_IMAGE * self.roi_px, "right")]
            near = [(steps[met[i]], away[i].item(), i) for i in order.tolist()]
            if any(self._is_residue(step, distance, peak) for step, distance, _ in near):
                continue
            size = self._left_over(peak, near, there, snr)
            if abs(peak.snr) > size:
                fresh.append(peak)
            elif not is_hidden(peak.snr, size):
                doubtful.append(peak)
        return fresh, doubtful

    def _waiting(self, peaks: Sequence[Peak]) -> list[bool]:
        """Tell which peaks may be side lobes of a higher one.

        A peak that waits makes others wait as well, or its own rings would be taken for particles.
        """
        table = np.array([(p.frame, p.x_px, p.y_px, abs(p.snr)) for p in peaks]).reshape(-1, 4)
        reach, side = STRIDES * self.stride, self.roi_px
        waiting = []
        for number, (frame, x, y, snr) in enumerate(table.tolist()):
            higher = table[:number]
            apart = np.abs(higher[:, 0] - frame)
            dx, dy = np.abs(higher[:, 1] - x), np.abs(higher[:, 2] - y)
            away = np.maximum(dx, dy)
            share = np.where(away < side, SIDELOBE, FAR_LOBE)
            lobe = (away < LARGEST_IMAGE * side) & (snr < share * higher[:, 3])
            lobe &= apart <= reach + self.stride
            same = (apart < reach) & (np.hypot(dx, dy) < NEAR * side)
            waiting.append(bool((lobe | same).any()))
        return waiting

    def _is_residue(self, step: Step, distance: float, peak: Peak) -> bool:
        """Whether a peak may be the residual of a fitted step, so many pixels away."""
        on_top = distance < self.roi_px / 6
        if on_top and abs(step.at.frame - peak.frame) > self.stride:
            return False
        # of a fitted step, below which a peak on top of it is what its fit left over
        share = 0.15 if on_top else 0.0 if step.is_measured else RINGS
        return distance < 1.5 * self.roi_px and abs(peak.snr) < share * abs(step.start.snr)

    def _left_over(
        self, peak: Peak, near: Sequence[tuple[Step, float, int]], places: FloatArray, snr: MapArray
    ) -> float:
        """Signal-to-noise ratio that a peak must have not to be a residual of the fits.

        The nearest steps, each with its distance and its index among the places of all, are tried
        first; the search ends with one whose residual is higher than the peak.

        Shapes: `places` (n, 2), `snr` (n, y, x).
        """
        size = max(
            (self._inside(step, peak) for step, away, _ in near if away < self.roi_px / 2),
            default=0.0,
        )
        j = round((peak.frame - self.first) / self.stride) - 1
        for _, _, i in near:
            if is_hidden(peak.snr, size):
                break
            x, y = places[i].tolist()
            others = np.delete(places, i, axis=0)
            beside = size_on_ring(snr[j], (x, y), (peak.x_px, peak.y_px), others)
            size = max(size, EXCEEDS * beside)
        return size

    def _inside(self, step: Step, peak: Peak) -> float:
        """Residual inside the fitted region of a step, which a peak must exceed.

        A window with only some of the frames of the step shows only a part of the misfit.
        """
        part = max(1 - abs(step.at.frame - peak.frame) / self.window, 0.0)
        return part * math.sqrt(EXPLAINS * step.excess)


LEVELS = np.geomspace(1.0, 64.0, 25)
"""Signal-to-noise ratios, in thresholds, at which the share of the places is kept."""


@dataclass(frozen=True)
class Searched:
    """At each boundary, the share of the field in which particles of each level are found.

    Shapes: `frames` (n,), `shares` (n, levels).
    """

    frames: NDArray[np.int64]
    shares: FloatArray

    @classmethod
    def joined(cls, parts: Sequence[Searched]) -> Searched:
        """Put chunks together."""
        nothing = cls(np.empty(0, dtype=np.int64), np.empty((0, LEVELS.size)))
        parts = [nothing, *parts]
        frames = np.concatenate([part.frames for part in parts])
        return cls(frames, np.concatenate([part.shares for part in parts]))

    def summary(self, snr: float, threshold: float, stride: int) -> dict[str, Any]:
        """Say what part was searched for particles of a signal-to-noise ratio."""
        level = max(snr / threshold, 1.0)
        share = np.array([np.interp(level, LEVELS, each) for each in self.shares])
        spans = []
        for value, run in groupby(
            zip(self.frames.tolist(), share.round(3).tolist(), strict=True), lambda each: each[1]
        ):
            held = [frame for frame, _ in run]
            if value < 0.999:
                half = stride // 2
                spans.append([max(held[0] - half, 0), held[-1] - half + stride, value])
        return {
            "searched_share": float(share.mean()) if share.size else None,
            "searched_snr": level * threshold,
            "partly_searched": spans,
        }


def searched_shares(
    neighbours: Neighbours,
    core: tuple[int, int],
    steps: Sequence[Step],
    peaks: Sequence[Peak],
    maps: tuple[MapArray, FloatArray],
    own: Box = EVERYWHERE,
) -> Searched:
    """Give the shares at the boundaries of a core, from the last search and what was found."""
    snr, effective = maps
    chunk, window, stride = neighbours.chunk, neighbours.window, neighbours.stride
    roi_px, threshold = neighbours.roi_px, neighbours.context.templates.threshold
    frames = chunk.first + chunk.edges[1:-1]
    lit = effective > 0  # frames, and pixels, that were left out are told by themselves
    inside = np.flatnonzero((frames >= core[0]) & (frames < core[1]) & lit)
    high = [peak for peak in peaks if SIDELOBE * abs(peak.snr) > threshold]
    bright = [step for step in steps if step.is_measured]
    shares = np.ones((inside.size, LEVELS.size))
    for row, j in enumerate(inside.tolist()):
        reach = (STRIDES + 1) * stride
        now = int(frames[j])
        near = [step for step in bright if abs(step.at.frame - now) <= reach]
        waits = [peak for peak in high if abs(peak.frame - now) <= reach]
        if not near and not waits:
            continue
        asked = np.full(chunk.shape, threshold)
        for peak in waits:
            _raise_near_unsubtracted(asked, peak, roi_px)
        for step in near:
            part = max(1 - abs(step.at.frame - now) / window, 0.0)
            left = part * math.sqrt(EXPLAINS * step.excess)
            _raise_near_fitted(asked, step, snr[j], left, roi_px)
        sizes = np.sort(asked[own][chunk.usable[own]]) / threshold
        shares[row] = np.searchsorted(sizes, LEVELS * (1 + 1e-9)) / sizes.size
    return Searched(frames[inside].astype(np.int64), shares)


def _raise_near_unsubtracted(asked: FloatArray, peak: Peak, roi_px: int) -> None:
    """Raise the needed level around a peak that was not subtracted."""
    for half, share in ((LARGEST_IMAGE * roi_px, FAR_LOBE), (roi_px, SIDELOBE)):
        box = tuple(
            slice(max(math.ceil(c - half), 0), max(math.floor(c + half) + 1, 0))
            for c in (peak.y_px, peak.x_px)
        )
        np.maximum(asked[box], share * abs(peak.snr), out=asked[box])


def _raise_near_fitted(
    asked: FloatArray, step: Step, snr: NDArray[Any], inside: float, roi_px: int
) -> None:
    """Raise the needed level around a bright step, by the residual of its fit."""
    centre = step.start.x_px, step.start.y_px
    y, x = (np.arange(n) - c for n, c in zip(asked.shape, centre[::-1], strict=True))
    away = np.hypot(y[:, None], x[None, :])
    radii = np.arange(4.0, LARGEST_IMAGE * roi_px + 4.0, 4.0)
    rings = [EXCEEDS * size_on_ring(snr, centre, (centre[0] + r, centre[1])) for r in radii]
    left = np.interp(away, radii, rings, right=0.0)
    np.maximum(left, np.where(away < roi_px / 2, inside, 0.0), out=left)
    np.maximum(asked, left, out=asked)
