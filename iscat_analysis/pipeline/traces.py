"""What a report shows of a step in time: its contrast against frame, and a ratiometric clip."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from iscat_analysis.pipeline.neighbours import Neighbours
from iscat_analysis.pipeline.pattern import MovingPattern
from iscat_analysis.pipeline.regions import Region, region_around
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.pipeline.tasks import TaskBuilder
from iscat_analysis.records import BoolArray, Clip, FloatArray, Trace
from iscat_analysis.search.sliding import Chunk, Patch, frame_heights

if TYPE_CHECKING:
    from iscat_analysis.pipeline.steps import StepEvent

TRACE_WINDOWS = 2
"""Windows on either side of a step that its trace covers; a chunk holds as many around its core."""

CLIP_NM = 1800.0
"""Side of the square that a clip shows, at most [nm]."""

CLIP_PIXELS = 25
"""Pixels along it, at most; smaller ones are summed."""

CLIP_STEPS = 6
"""Images of a clip from the first that reaches the step to the one at the step."""


def patch_of(fitted: StepEvent, chunk: Chunk, window: int) -> Patch:
    """Copy the frames around a step, for `trace_of` and `clip_of`.

    Parameters
    ----------
    fitted : StepEvent
        The step.
    chunk : Chunk
        The frames.
    window : int
        Frames before and after a step.

    Returns
    -------
    Patch
        `TRACE_WINDOWS` on either side, of the pixels that were fitted.
    """
    region = fitted.event.region
    turn, reach = fitted.step.at.frame, TRACE_WINDOWS * window
    return chunk.patch(turn - reach, turn + reach, region.rows, region.columns)


def trace_of(
    fitted: StepEvent, patch: Patch, chunk: Chunk, neighbours: Neighbours, tasks: TaskBuilder
) -> Trace | None:
    """Measure the contrast of a step's particle in every frame around the step.

    Parameters
    ----------
    fitted : StepEvent
        The step; what its neighbours make is taken off.
    patch : Patch
        From `patch_of`.
    chunk : Chunk
        The frames.
    neighbours : Neighbours
        Of the chunk.
    tasks : TaskBuilder
        Of the chunk.

    Returns
    -------
    Trace or None
        None where the region holds too little of the picture.
    """
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
    unit = fit.contrast * step.start.mass_kda / fit.mass_kda  # contrast of the image
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
    scene: Scene,
    chunk: Chunk,
    window: int,
    pattern: MovingPattern | None = None,
) -> Clip | None:
    """Set windows that slide over a step against those before them.

    Parameters
    ----------
    fitted : StepEvent
        The step.
    patch : Patch
        From `patch_of`.
    scene : Scene
        Its pixel size.
    chunk : Chunk
        The frames.
    window : int
        Frames before and after a step.
    pattern : MovingPattern, optional
        Of the chunk, where its motion is corrected.

    Returns
    -------
    Clip or None
        None where the frames around the step are too few for a second image.
    """
    turn, start = fitted.step.at.frame, fitted.event.candidate
    side = min(scene.roi_px, 2 * math.ceil(CLIP_NM / scene.pixel_nm / 2) - 1)
    fold = math.ceil(side / CLIP_PIXELS)
    square, whole = region_around(side, chunk.shape, start), fitted.event.region
    sides = []
    for (low, high), (first, last) in (
        (square.rows, whole.rows), (square.columns, whole.columns)
    ):  # fmt: skip
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
    light, n, power = patch.windows(ends)
    own = n[CLIP_STEPS : 3 * CLIP_STEPS].reshape(2, -1).sum(axis=1)
    least = min(window / 2, *own)  # near the ends of a movie, the frames of the fit
    frames, after_e, expected_e = [], [], []
    for k in range(CLIP_STEPS, 3 * CLIP_STEPS + 1):
        before, after = slice(k - CLIP_STEPS, k), slice(k, k + CLIP_STEPS)
        if min(n[before].sum(), n[after].sum()) < max(least, 1):
            continue
        expected = light[before].sum(axis=0) * (power[after].sum() / power[before].sum())
        if pattern and local:
            spans = (ends[k - CLIP_STEPS], ends[k]), (ends[k], ends[k + CLIP_STEPS])
            seen = [pattern.seen(local, chunk.cut(*span)) for span in spans]
            expected *= seen[1] / seen[0]
        frames.append(ends[k])
        after_e.append(light[after].sum(axis=0))
        expected_e.append(expected)
    if len(frames) < 2:
        return None
    images = _ratio(np.array(after_e), np.array(expected_e), patch.usable, fold)
    return Clip(tuple(frames), window, images.astype(np.float32))


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
