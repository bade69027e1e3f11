"""From a step and its neighbours to its likelihood, and what a report shows of it in time.

A neighbour nearer than ``detection.min_separation_nm`` is kept out: the window ends where it lands
or leaves.  Others enter through ρ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.fitting.events import Event, Region, Told, region_around
from iscat_analysis.fitting.pattern import LocalPattern
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.landing.neighbours import Neighbours, Step, distance_px
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import BoolArray, Candidate, Clip, FitResult, FloatArray, Trace, Windows
from iscat_analysis.search.dating import StepFrame, crosstalk, frame_heights, locate_step
from iscat_analysis.search.frames import Patch
from iscat_analysis.trust.changing_light import SAME_NM

FEWEST_FRAMES = 10
"""A neighbour that would leave fewer is fitted beside the step, and both are flagged."""

TRACE_FRAMES = 400
"""Frames with a particle that tell how steady its light is, unless three windows are more."""


@dataclass(frozen=True)
class Task:
    """A step's likelihood and what it is made of."""

    likelihood: Likelihood
    region: Region
    patch: Patch
    windows: Windows
    at: StepFrame
    crowded: bool
    offset_px: FloatArray

    def displaced(self, start: Candidate) -> Candidate:
        """Move a candidate to where it is in the frames with its particle."""
        y_px, x_px = self.offset_px
        return replace(start, x_px=start.x_px + x_px, y_px=start.y_px + y_px)

    def event(self, fit: FitResult, likelihood: Likelihood, sign: int) -> Event:
        """Make an event of a fit."""
        at, windows = self.at, self.windows
        n_before, n_after = (windows.n_before, windows.n_after)[::sign]  # in time
        return Event(
            self.region, fit, likelihood, windows, (), at.frame, n_before, n_after, sign,
            at.half_width, at.rise,
        )  # fmt: skip


@dataclass(frozen=True)
class StepEvent:
    """A step after its last fit, with the estimates from parts of its frames."""

    event: Event
    step: Step
    others: tuple[Step, ...]
    repeats: FloatArray
    told: Told | None = None  # of a sphere whose picture does not tell its index
    crowded: bool = False  # as of its `Task`
    lobe: bool = False  # found where the fit of a known step may have left a residual


class TaskBuilder:
    """Builds the likelihoods of the steps of one chunk."""

    def __init__(self, neighbours: Neighbours) -> None:
        self.neighbours = neighbours
        self._context, self._chunk = neighbours.context, neighbours.chunk
        self._window, self._pattern = neighbours.window, neighbours.pattern
        self._roi_px, self._stride = neighbours.roi_px, neighbours.stride
        self._search_reach = self._stride + self._stride // 2 + 1  # of a date, in frames
        self.rise = {1: 0, -1: 0}  # frames over which most landings, and leavings, take place

    def build(
        self, index: int, steps: Sequence[Step], near: Sequence[Sequence[int]]
    ) -> Task | None:
        """Set up the likelihood of a step with its neighbours in place; None without frames."""
        context, chunk, moving, step = self._context, self._chunk, self._pattern, steps[index]
        region = region_around(self._roi_px, chunk.shape, step.start)
        neighbours = [steps[i] for i in near[index]]
        limit_px = context.config.detection.min_separation_nm / context.pixel_nm
        close = [s for s in neighbours if distance_px(s, step) < limit_px]
        span, crowded = self._span(step, close)
        # with the frames that a first date may add
        reach = self._search_reach if step.theta is None else 0
        held = chunk.patch(span[0] - reach, span[1] + reach, region.rows, region.columns)
        patch = held.frames(*span)
        local = moving.local(region, step.at.frame) if moving else None
        at = self._locate(step, neighbours, region, patch, local) if len(patch.counts) > 1 else None
        if at is None:
            return None
        if moving and at.frame != step.at.frame:
            local = moving.local(region, at.frame)
        step = replace(step, at=at)
        span, crowded = self._span(step, close)
        gap = at.kept_out(self._window)
        begin, end = max(span[0], chunk.first), min(span[1], chunk.stop)
        spans = (begin, max(at.frame - gap, begin)), (min(at.frame + gap, end), end)
        if begin < held.first or end > held.first + len(held.counts):
            held = chunk.patch(begin, end, region.rows, region.columns)
        patch = held.frames(begin, end)
        # a particle that leaves is fitted as one that lands, the other way round in time
        windows = patch.windows(*spans[:: step.sign])
        if not windows.n_before or not windows.n_after:
            return None
        cuts = chunk.cut(*spans[0]), chunk.cut(*spans[1])
        ratio = np.full(region.shape, windows.power_ratio**step.sign)
        for other in neighbours:
            self.neighbours.apply(ratio, other, *cuts, region)
        self.neighbours.interfere(ratio, step, neighbours, *cuts, region)
        if context.lines is not None:
            there = [self._present(steps, span, cut) for cut in cuts]
            taken = [context.lines.taken(signal)[region.slices] for signal in there]
            ratio *= taken[0] / taken[1]
        offset = np.zeros(2)
        if moving and local:
            seen = [local.seen(cut) for cut in cuts]
            ratio *= seen[1] / seen[0]
            shared = self.neighbours.shared(step, region)
            if shared is not None:
                here, inside = shared
                ratio[here] *= self.neighbours.own_factor(step, *cuts, inside)
            with_it = cuts[1] if step.sign > 0 else cuts[0]
            offset = moving.shift(with_it) - moving.at(at.frame)
        place = (step.start.x_px * context.pixel_nm, step.start.y_px * context.pixel_nm)
        likelihood = conditional(
            context.model_at(*place, sum(windows.frames_after) // 2),
            PixelGrid.region(region.rows, region.columns, context.pixel_nm),
            windows.before_e,
            windows.after_e,
            ratio**step.sign,
            read_variances_e2=(windows.read_variance_before_e2, windows.read_variance_after_e2),
            masked=windows.masked,
        )
        likelihood = context.with_prior(likelihood, step.start.mass_kda)
        return Task(likelihood, region, patch, windows, at, crowded, offset)

    def trace_spans(
        self, step: Step, windows: Windows, others: Sequence[Step]
    ) -> tuple[tuple[tuple[int, int], tuple[int, int]], tuple[Step, ...]]:
        """Give the frames without and with a particle that tell how steady its light is.

        They go on through small steps at its place, which may be changes of its light, and end at
        others that are close.  The steps that add light of their own are given as well.
        """
        pixel = self._context.pixel_nm
        limit_px = self._context.config.detection.min_separation_nm / pixel
        close = [s for s in others if distance_px(s, step) < limit_px]
        changes = {
            s
            for s in close
            if distance_px(s, step) * pixel < SAME_NM
            and 3 * s.start.mass_kda <= step.start.mass_kda
        }
        own = tuple(s for s in others if s not in changes)
        without, there = windows.frames_before, windows.frames_after
        # signal-to-noise ratio of a frame below which no more than a window tells
        if step.at.per_frame_snr < 2.0:
            return (without, there), own
        reach = 3 * self._window
        reaches = (reach, max(reach, TRACE_FRAMES))[:: step.sign]
        low = max(step.at.frame - reaches[0], self._chunk.first)
        high = min(step.at.frame + reaches[1], self._chunk.stop)
        for other in (s for s in close if s not in changes):
            gap = other.at.kept_out(self._window)
            if other.at.frame < step.at.frame:
                low = max(low, other.at.frame + gap)
            else:
                high = min(high, other.at.frame - gap)
        (begin, first), (second, end) = sorted((without, there))
        spans = (min(low, begin), first), (second, max(high, end))
        return (spans if step.sign > 0 else spans[::-1]), own

    def _present(self, steps: Sequence[Step], span: tuple[int, int], cut: slice) -> FloatArray:
        """Contrast over the field, in some frames, of what lands or leaves in a span of them."""
        total = np.zeros(self._chunk.shape)
        for step in steps:
            if span[0] < step.at.frame < span[1]:
                total[self.neighbours.box(step)] += self.neighbours.presence(step, cut) * step.image
        return total

    def _span(self, step: Step, close: Sequence[Step]) -> tuple[tuple[int, int], bool]:
        """Frames used around a step, and whether another one could not be kept out of them."""
        frame = step.at.frame
        begin, end = frame - self._window, frame + self._window
        crowded = False
        for other in close:
            gap = other.at.kept_out(self._window)
            if other.at.frame <= frame - FEWEST_FRAMES - gap:
                begin = max(begin, other.at.frame + gap)
            elif other.at.frame >= frame + FEWEST_FRAMES + gap:
                end = min(end, other.at.frame - gap)
            else:
                crowded = True
        return (begin, end), crowded

    def _locate(
        self,
        step: Step,
        neighbours: Sequence[Step],
        region: Region,
        patch: Patch,
        pattern: LocalPattern | None,
    ) -> StepFrame | None:
        shared = self.neighbours.shared(step, region)
        if shared is None:
            return None
        image = step.image[shared[1]].astype(np.float64)
        if image.shape != (region.rows[1] - region.rows[0], region.columns[1] - region.columns[0]):
            return None
        known = self.added(step, neighbours, region, patch, image, pattern)
        reach = self._search_reach
        search = (step.at.frame - reach, step.at.frame + reach + 1)
        return locate_step(
            patch, step.sign * image, search,
            known=step.sign * known, expected_rise=self.rise[step.sign],
        )  # fmt: skip

    def added(
        self,
        step: Step,
        neighbours: Sequence[Step],
        region: Region,
        patch: Patch,
        image: FloatArray,
        pattern: LocalPattern | None,
    ) -> FloatArray:
        """Height that neighbours, and the motion of the pattern, add to each frame.

        Shapes: `image` (ny, nx), result (t,).
        """
        known = np.zeros(len(patch.counts))
        frames = np.arange(patch.first, patch.first + known.size)
        seen, images = [], []
        for other in neighbours:
            near = self.neighbours.are_spheres or distance_px(other, step) < self._roi_px
            both = self.neighbours.shared(other, region) if near else None
            if both is None or not frames[0] < other.at.frame <= frames[-1]:
                continue
            here, inside = both
            padded = np.zeros(image.shape)
            padded[here] = other.image[inside]
            if step.sign * (other.at.frame - step.at.frame) > 0:  # the step's particle is there
                padded += self.neighbours.crossed(step, other, region)
            seen.append(other)
            images.append(padded)
        if self.neighbours.are_spheres:  # frames are set against their mean light, theirs included
            cut = self._chunk.cut(int(frames[0]), int(frames[-1]) + 1)
            light = 1 + self.neighbours.presence(step, cut) * image
            light += sum(
                self.neighbours.presence(s, cut) * own for s, own in zip(seen, images, strict=True)
            )
            images = [one / light for one in images]
        for other, height in zip(seen, crosstalk(patch, image, images), strict=True):
            known += other.sign * height * (frames >= other.at.turns[:, None]).mean(axis=0)
        own = self.neighbours.shared(step, region)
        if pattern and own is not None:  # which moves, and the particle with it
            centres, cuts = zip(*self.neighbours.in_blocks(frames), strict=True)
            light = np.maximum(patch.mean_e, 1e-300)
            patterns = [pattern.seen(cut) / light - 1 for cut in cuts]
            moved = [self.neighbours.seen(step, cut, own[1]) - image for cut in cuts]
            there = (frames >= step.at.frame) == (step.sign > 0)
            known += np.interp(frames, centres, crosstalk(patch, image, patterns))
            known += there * np.interp(frames, centres, crosstalk(patch, image, moved))
        return known


CLIP_STEPS = 6
"""Images of a clip from the first that reaches the step to the one at the step."""


def patch_of(fitted: StepEvent, neighbours: Neighbours) -> Patch:
    """Copy the frames around a step, for `trace_of` and `clip_of`."""
    region = fitted.event.region
    # Windows on either side of a step that its trace covers; a chunk holds as many around its
    # core.
    turn, reach = fitted.step.at.frame, 2 * neighbours.window
    return neighbours.chunk.patch(turn - reach, turn + reach, region.rows, region.columns)


def trace_of(fitted: StepEvent, patch: Patch, tasks: TaskBuilder) -> Trace | None:
    """Measure the contrast of a step's particle in every frame around the step."""
    event, neighbours, chunk = fitted.event, tasks.neighbours, tasks.neighbours.chunk
    fit, windows, region = event.fit, event.windows, event.region
    step, turn = fitted.step, fitted.step.at.frame
    shown = neighbours.shown(step, region)  # as of the last sweep, close to the final fit
    if shown is None or shown[1].shape != region.shape:
        return None
    image = shown[1]
    light = float(chunk.power[chunk.cut(*windows.frames_before)].sum())
    mean = windows.before_e / light
    patch = replace(patch, mean_e=mean, usable=patch.usable & (mean > 0))
    heights, weight, scale = frame_heights(patch, image)
    moving = neighbours.pattern
    local = None if moving is None else moving.local(region, turn)
    heights = heights - tasks.added(step, fitted.others, region, patch, image, local)
    frames = np.arange(patch.first, patch.first + heights.size)
    without = (frames >= windows.frames_before[0]) & (frames < windows.frames_before[1])
    level = np.average(heights[without], weights=weight[without])
    unit = fit.contrast  # of the image
    if event.sphere is None:
        unit *= step.start.mass_kda / fit.mass_kda
    contrast = np.where(weight > 0, (heights - level) * unit, np.nan)
    ranges = windows.frames_before, windows.frames_after
    return Trace(
        first=patch.first,
        contrast=contrast,
        sigma=abs(unit) / math.sqrt(scale),
        frame=turn,
        half_width=step.at.half_width,
        used=(min(r[0] for r in ranges), max(r[1] for r in ranges)),
        before=0.0 if step.sign > 0 else fit.contrast,
        after=fit.contrast if step.sign > 0 else 0.0,
    )


def clip_of(fitted: StepEvent, patch: Patch, neighbours: Neighbours) -> Clip | None:
    """Set windows that slide over a step against those before them."""
    context, chunk, pattern = neighbours.context, neighbours.chunk, neighbours.pattern
    window, turn, start = neighbours.window, fitted.step.at.frame, fitted.event.candidate
    # Side of the square that a clip shows, at most [nm].
    side = min(context.roi_px, 2 * math.ceil(1800.0 / context.pixel_nm / 2) - 1)
    # Pixels along it, at most; smaller ones are summed.
    fold = math.ceil(side / 25)
    square, whole = region_around(side, chunk.shape, start), fitted.event.region
    sides = []
    for (low, high), (first, last) in ((square.rows, whole.rows), (square.columns, whole.columns)):
        low, high = max(low, first), min(high, last)
        sides.append((low, high - (high - low) % fold))
    region = Region(sides[0], sides[1])
    local = pattern.local(region, turn) if pattern else None
    (top, bottom), (left, right) = sides
    patch = patch.part(
        slice(top - whole.rows[0], bottom - whole.rows[0]),
        slice(left - whole.columns[0], right - whole.columns[0]),
    )
    ends = [turn + k * window // CLIP_STEPS for k in range(-2 * CLIP_STEPS, 2 * CLIP_STEPS + 1)]
    sums = [patch.window(*span) for span in zip(ends, ends[CLIP_STEPS:], strict=False)]
    pairs = list(zip(sums, sums[CLIP_STEPS:], strict=False))  # of windows before and after
    counted = np.array([min(one[1], other[1]) for one, other in pairs])
    # near the ends of a movie, the frames of the fit
    held = np.flatnonzero(counted >= max(min(window / 2, counted[CLIP_STEPS]), 1)).tolist()
    if len(held) < 2:
        return None
    images = []
    for k in held:
        (before_e, _, before), (after_e, _, after) = pairs[k]
        expected_e = before_e * (after / before)
        if local is not None:
            first, middle, last = ends[k : k + 2 * CLIP_STEPS + 1 : CLIP_STEPS]
            seen = [local.seen(chunk.cut(*span)) for span in ((first, middle), (middle, last))]
            expected_e *= seen[1] / seen[0]
        images.append(_ratio(after_e, expected_e, patch.usable, fold))
    frames = tuple(ends[CLIP_STEPS + k] for k in held)
    return Clip(frames, window, np.array(images, dtype=np.float32))


def _ratio(after: FloatArray, expected: FloatArray, used: BoolArray, fold: int) -> FloatArray:
    """Give counts over those expected, less 1, of squares of pixels; NaN where none is used."""
    squares = after.shape[0] // fold, fold, after.shape[1] // fold, fold
    both = (np.where(used, part, 0.0).reshape(squares) for part in (after, expected))
    sums = [part.sum(axis=(1, 3)) for part in both]
    ratio = np.full(sums[0].shape, np.nan)
    np.divide(sums[0], sums[1], out=ratio, where=sums[1] > 0)
    return ratio - 1
