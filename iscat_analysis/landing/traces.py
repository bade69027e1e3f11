"""What a report shows of a step in time: its contrast against frame, and a ratiometric clip."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.pattern import MovingPattern
from iscat_analysis.fitting.regions import Region, region_around
from iscat_analysis.landing.neighbours import Neighbours
from iscat_analysis.landing.tasks import TaskBuilder
from iscat_analysis.records import BoolArray, Clip, FloatArray, Trace
from iscat_analysis.search.sliding import Chunk, Patch, frame_heights

if TYPE_CHECKING:
    from iscat_analysis.landing.steps import StepEvent

TRACE_WINDOWS = 2
"""Windows on either side of a step that its trace covers; a chunk holds as many around its core."""

CLIP_NM = 1800.0
"""Side of the square that a clip shows, at most [nm]."""

CLIP_PIXELS = 25
"""Pixels along it, at most; smaller ones are summed."""

CLIP_STEPS = 6
"""Images of a clip from the first that reaches the step to the one at the step."""


def patch_of(fitted: StepEvent, chunk: Chunk, window: int) -> Patch:
    """Copy the frames around a step, for `trace_of` and `clip_of`."""
    region = fitted.event.region
    turn, reach = fitted.step.at.frame, TRACE_WINDOWS * window
    return chunk.patch(turn - reach, turn + reach, region.rows, region.columns)


def trace_of(
    fitted: StepEvent, patch: Patch, chunk: Chunk, neighbours: Neighbours, tasks: TaskBuilder
) -> Trace | None:
    """Measure the contrast of a step's particle in every frame around the step."""
    event = fitted.event
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
    heights = heights - tasks.added(step, fitted.others, region, patch, image)
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


def clip_of(
    fitted: StepEvent,
    patch: Patch,
    context: AnalysisContext,
    chunk: Chunk,
    window: int,
    pattern: MovingPattern | None = None,
) -> Clip | None:
    """Set windows that slide over a step against those before them."""
    turn, start = fitted.step.at.frame, fitted.event.candidate
    side = min(context.roi_px, 2 * math.ceil(CLIP_NM / context.pixel_nm / 2) - 1)
    fold = math.ceil(side / CLIP_PIXELS)
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
    # windows begin and end where others do, so that the parts between are summed once
    ends = [turn + k * window // CLIP_STEPS for k in range(-2 * CLIP_STEPS, 2 * CLIP_STEPS + 1)]
    (before_e, after_e), (n_before, n_after), (power_before, power_after) = map(
        _on_both_sides, patch.windows(ends)
    )
    # near the ends of a movie, the frames of the fit
    least = min(window / 2, n_before[CLIP_STEPS], n_after[CLIP_STEPS])
    held = np.flatnonzero(np.minimum(n_before, n_after) >= max(least, 1))
    if len(held) < 2:
        return None
    ratio = power_after[held] / power_before[held]
    expected_e = before_e[held] * ratio[:, None, None]
    if pattern and local:
        for expected, k in zip(expected_e, held, strict=True):
            first, middle, last = (ends[k + side * CLIP_STEPS] for side in (0, 1, 2))
            spans = (first, middle), (middle, last)
            seen = [pattern.seen(local, chunk.cut(*span)) for span in spans]
            expected *= seen[1] / seen[0]
    images = _ratio(after_e[held], expected_e, patch.usable, fold)
    frames = tuple(ends[CLIP_STEPS + k] for k in held)
    return Clip(frames, window, images.astype(np.float32))


def _on_both_sides(parts: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Sum the `CLIP_STEPS` parts before each end, and those after it, where there are as many."""
    summed = np.cumsum(np.concatenate([0 * parts[:1], parts]), axis=0)
    middle = summed[CLIP_STEPS:-CLIP_STEPS]
    return middle - summed[: -2 * CLIP_STEPS], summed[2 * CLIP_STEPS :] - middle


def _ratio(after: FloatArray, expected: FloatArray, used: BoolArray, fold: int) -> FloatArray:
    """Give counts over those expected, less 1, of squares of pixels; NaN where none is used."""
    number, rows, columns = after.shape
    squares = (number, rows // fold, fold, columns // fold, fold)
    sums = [
        np.where(used, part, 0.0).reshape(squares).sum(axis=(2, 4)) for part in (after, expected)
    ]
    ratio = np.full(sums[0].shape, np.nan)
    np.divide(sums[0], sums[1], out=ratio, where=sums[1] > 0)
    return ratio - 1
