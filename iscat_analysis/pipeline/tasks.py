"""From a step and its neighbours to its likelihood: when, which frames, which pixels, which ρ.

A neighbour nearer than ``detection.min_separation_nm`` is kept out: the window ends where it lands
or leaves.  Others enter through ρ.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.forward import PixelGrid
from iscat_analysis.likelihood import Likelihood, conditional
from iscat_analysis.pipeline.neighbours import Neighbours, Step, distance_px, region_around
from iscat_analysis.pipeline.scene import Region, Scene
from iscat_analysis.records import Windows
from iscat_analysis.sliding import Chunk, Patch, StepFrame, crosstalk, locate_step

FEWEST_FRAMES = 10
"""A neighbour that would leave fewer is fitted beside the step, and both are flagged."""


@dataclass(frozen=True)
class Task:
    """A step's likelihood and what it is made of.

    Attributes
    ----------
    likelihood : Likelihood
        Of the counts before and after.
    region : Region
        Its pixels, in the full frame.
    windows : Windows
        The sums, those with the particle as "after".
    at : StepFrame
        When.
    n_before, n_after : int
        Frames before and after the step that are used.
    crowded : bool
        Whether a close neighbour could not be kept out of them.
    """

    likelihood: Likelihood
    region: Region
    windows: Windows
    at: StepFrame
    n_before: int
    n_after: int
    crowded: bool


class TaskBuilder:
    """Builds the likelihoods of the steps of one chunk.

    Parameters
    ----------
    scene : Scene
        Models.
    chunk : Chunk
        The frames.
    window : int
        Frames before and after a step.
    neighbours : Neighbours
        Of the same chunk.
    """

    def __init__(self, scene: Scene, chunk: Chunk, window: int, neighbours: Neighbours) -> None:
        self._scene = scene
        self._chunk = chunk
        self._window = window
        self._neighbours = neighbours
        self._roi_px = scene.roi_px
        self._stride = int(chunk.edges[1] - chunk.edges[0])

    def build(
        self, index: int, steps: Sequence[Step], near: Sequence[Sequence[int]]
    ) -> Task | None:
        """Set up the likelihood of a step with its neighbours in place; None without frames."""
        scene, chunk, step = self._scene, self._chunk, steps[index]
        region = region_around(self._roi_px, chunk.shape, step.start)
        neighbours = [steps[i] for i in near[index]]
        limit_px = scene.config.detection.min_separation_nm / scene.pixel_nm
        close = [s for s in neighbours if distance_px(s, step) < limit_px]
        span, crowded = self._span(step, close)
        patch = chunk.patch(*span, region.rows, region.columns)
        if len(patch.counts) < 2:
            return None
        at = self._locate(step, neighbours, region, patch)
        if at is None:
            return None
        span, crowded = self._span(replace(step, at=at), close)
        gap = min(at.gap, self._window // 5)
        begin, end = max(span[0], chunk.first), min(span[1], chunk.stop)
        first = (begin, max(at.frame - gap, begin))
        second = (min(at.frame + gap, end), end)
        if begin < patch.first or end > patch.first + len(patch.counts):
            patch = chunk.patch(begin, end, region.rows, region.columns)
        before, n_before, power_before = patch.window(*first)
        after, n_after, power_after = patch.window(*second)
        if not n_before or not n_after:
            return None
        ratio = np.full(before.shape, power_after / power_before)
        cuts = chunk.cut(*first), chunk.cut(*second)
        for other in neighbours:
            shared = self._neighbours.shared(other, region)
            if shared is not None:
                part, image = shared
                here = (
                    slice(part.rows[0] - region.rows[0], part.rows[1] - region.rows[0]),
                    slice(part.columns[0] - region.columns[0], part.columns[1] - region.columns[0]),
                )
                ratio[here] *= self._neighbours.factor(other, image, *cuts)
        read = chunk.camera.read_variance_e2(chunk.shape)[region.slices]
        variances = [n_before * read, n_after * read]
        if step.sign < 0:
            before, after, ratio = after, before, 1 / ratio
            variances.reverse()
        counts = (n_before, n_after)[:: step.sign]
        ranges = (first, second)[:: step.sign]
        grid = PixelGrid.region(region.rows, region.columns, scene.pixel_nm)
        used = chunk.usable[region.slices]
        likelihood = conditional(
            scene.model, grid, before, after, ratio,
            read_variance_before_e2=variances[0], read_variance_after_e2=variances[1],
            masked=~used,
        )  # fmt: skip
        windows = Windows(
            before_e=before,
            after_e=after,
            n_before=counts[0],
            n_after=counts[1],
            power_ratio=(power_after / power_before) ** step.sign,
            read_variance_before_e2=variances[0],
            read_variance_after_e2=variances[1],
            masked=~used,
            saturated=chunk.saturated[region.slices],
            frames_before=ranges[0],
            frames_after=ranges[1],
            power=np.empty(0),
        )
        return Task(likelihood, region, windows, at, n_before, n_after, crowded)

    def _span(self, step: Step, close: Sequence[Step]) -> tuple[tuple[int, int], bool]:
        """Frames used around a step, and whether another one could not be kept out of them."""
        frame = step.at.frame
        begin, end = frame - self._window, frame + self._window
        crowded = False
        for other in sorted(close, key=lambda s: abs(s.at.frame - frame)):
            gap = min(other.at.gap, self._window // 5)
            if other.at.frame <= frame - FEWEST_FRAMES - gap:
                begin = max(begin, other.at.frame + gap)
            elif other.at.frame >= frame + FEWEST_FRAMES + gap:
                end = min(end, other.at.frame - gap)
            else:
                crowded = True
        return (begin, end), crowded

    def _locate(
        self, step: Step, neighbours: Sequence[Step], region: Region, patch: Patch
    ) -> StepFrame | None:
        shared = self._neighbours.shared(step, region)
        if shared is None:
            return None
        _, image = shared
        if image.shape != (region.rows[1] - region.rows[0], region.columns[1] - region.columns[0]):
            return None
        known = np.zeros(len(patch.counts))
        frames = np.arange(patch.first, patch.first + known.size)
        for other in neighbours:
            near = distance_px(other, step) < self._roi_px
            both = self._neighbours.shared(other, region) if near else None
            if both is None or not frames[0] < other.at.frame <= frames[-1]:
                continue
            part, inside = both
            padded = np.zeros(image.shape)
            padded[
                part.rows[0] - region.rows[0] : part.rows[1] - region.rows[0],
                part.columns[0] - region.columns[0] : part.columns[1] - region.columns[0],
            ] = inside
            height = crosstalk(patch, image, padded)
            known += other.sign * height * (frames >= other.at.frame)
        reach = self._stride + self._stride // 2 + 1
        search = (step.at.frame - reach, step.at.frame + reach + 1)
        return locate_step(patch, step.sign * image, search, known=step.sign * known)
