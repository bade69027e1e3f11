"""Steps in one chunk of a landing movie: found, dated and fitted, with their neighbours in view.

Each step is fitted on the frames just before and just after it, by the conditional likelihood of
those very frames.  Turns of all fits with all others in place settle in two or three sweeps; what
they explain is taken off the sliding contrast, which is then searched again.  `neighbours` says
what steps do to each other's light, `tasks` sets up the likelihood of one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.inference.fit import (
    POOR_FIT_P,
    detection_snr,
    fit_particle,
    search_box,
    start_theta,
)
from iscat_analysis.movie.drift import Trajectory
from iscat_analysis.pipeline.field import Event
from iscat_analysis.pipeline.neighbours import (
    Neighbours,
    Step,
    distance_px,
)
from iscat_analysis.pipeline.pattern import MovingPattern
from iscat_analysis.pipeline.repeats import step_controls, step_repeats
from iscat_analysis.pipeline.scene import Region, Scene, judge, reported_steps
from iscat_analysis.pipeline.sidelobes import Sieve
from iscat_analysis.pipeline.tasks import Task, TaskBuilder
from iscat_analysis.pipeline.traces import clip_of, patch_of, trace_of
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Candidate,
    Clip,
    FloatArray,
    Status,
    Trace,
    Windows,
)
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.residue import chi2_excess
from iscat_analysis.search.sliding import (
    STRIDES,
    Chunk,
    Filter,
    MapArray,
    Peak,
    StepFrame,
    find_steps,
    make_filter,
    sliding_maps,
)
from iscat_analysis.search.templates import LARGEST_IMAGE, refuse_flood

ROUNDS = 6
"""Searches at most; each takes what was found so far off the contrast."""

_SWEEPS = 10  # fits of what has neighbours that still move, with everything else in place
_EXPLAINED = 0.7  # of the threshold; a fit that reaches less is what other steps explain
_SAME_PX = 1.5


@dataclass(frozen=True)
class FittedStep:
    """A step with its final fit.

    Attributes
    ----------
    step : Step
        When and where.
    event : Event
        The fit; its region counts from its own first pixel, as `windows` does.
    region : Region
        In the full frame.
    windows : Windows
        The sums of the region, those with the particle as "after".
    n_before, n_after : int
        Frames before and after the step that were used.
    repeats : ndarray
        From `iscat_analysis.pipeline.repeats.step_repeats`.
    others : tuple of Step
        Those that the fit knew of.
    trace : Trace or None
        From `iscat_analysis.pipeline.traces.trace_of`.
    clip : Clip or None
        From `iscat_analysis.pipeline.traces.clip_of`.
    """

    step: Step
    event: Event
    region: Region
    windows: Windows
    n_before: int
    n_after: int
    repeats: FloatArray
    others: tuple[Step, ...] = ()
    trace: Trace | None = None
    clip: Clip | None = None


class ChunkFitter:
    """Finds and fits the steps of one chunk.

    Parameters
    ----------
    scene : Scene
        Models and template; `wide` reaches over a step's image.
    chunk : Chunk
        The frames.
    window : int
        Frames before and after a step.
    pool : ThreadPoolExecutor
        Runs the fits; the result does not depend on its size.
    trajectory : Trajectory, optional
        Of the fixed pattern, whose motion is then divided out.
    excess_noise : str
        What is known of noise beyond the expected; with it a search that a thousand places pass is
        given up.

    Attributes
    ----------
    strongest : ndarray, shape (2, y, x)
        Of all boundaries, the one with the largest signal-to-noise ratio at each pixel: that
        ratio, and the amplitude.
    rounds : int
        Searches made.
    """

    def __init__(
        self,
        scene: Scene,
        chunk: Chunk,
        window: int,
        pool: ThreadPoolExecutor,
        trajectory: Trajectory | None = None,
        *,
        excess_noise: str = "",
    ) -> None:
        self._excess_noise = excess_noise
        pattern = MovingPattern(chunk, trajectory, pool.map) if trajectory else None
        chunk = pattern.chunk if pattern else chunk
        self._scene = scene
        self._chunk = chunk
        self._pattern = pattern
        self._window = window
        self._pool = pool
        self._strides = STRIDES
        self._roi_px = scene.roi_px
        self._neighbours = Neighbours(scene, chunk, window, pattern)
        self._tasks = TaskBuilder(scene, chunk, window, self._neighbours, pattern)
        self._stride = int(chunk.edges[1] - chunk.edges[0])
        self._sieve = Sieve(chunk.first, self._stride, window, scene.roi_px)
        self._maps: tuple[MapArray, FloatArray] | None = None
        self._doubtful: list[Peak] = []
        self._near: list[list[Step]] = []  # steps that each of the maps knows of
        self.strongest = np.zeros((2, *chunk.shape))
        self.rounds = 0
        self.empty: EmptySpread | None = None  # noise where nothing lands or leaves

    def run(self, keep: tuple[int, int]) -> list[FittedStep]:
        """Find and fit every step.

        Parameters
        ----------
        keep : (int, int)
            Frames whose steps are wanted; those outside are only seen as neighbours.

        Returns
        -------
        list of FittedStep
            In order of frame.
        """
        templates = self._scene.templates
        matched = make_filter(self._chunk, templates.images[0], templates.noise)
        steps: list[Step] = []
        rejected: list[Step] = []
        for self.rounds in range(1, ROUNDS + 1):
            fresh = [
                s
                for s in self._search(matched, steps)
                if not any(
                    distance_px(s, r) < _SAME_PX and _apart(s, r) <= self._stride for r in rejected
                )
            ]
            if not fresh:
                break
            known = len(steps)
            steps = steps + fresh
            seen, bound = self._neighbours.of(steps)
            chosen = set(range(known, len(steps)))
            for _ in range(_SWEEPS):
                improved = self._improve(steps, chosen, seen)
                moved = {i for i in chosen if _has_moved(steps[i], improved[i])}
                steps = improved
                chosen = {i for i, others in enumerate(bound) if moved.intersection(others)}
                if not chosen:
                    break
            if "z_nm" in FREE_PARAMETERS[self._scene.mode]:
                steps = self._lifted(steps, set(range(known, len(steps))), seen)
            credible = self._credible(steps)
            kept = {id(s) for s in credible}
            rejected += [s for s in steps if id(s) not in kept]
            steps = credible
        if not steps:
            return []
        lobes = [self._begin(peak) for peak in self._doubtful]
        everything = steps + lobes
        seen = [[k for k in near if k < len(steps)] for near in self._neighbours.of(everything)[0]]
        # steps of the other polarity are fitted too: their rings have the one that is reported
        sign = reported_steps(self._scene)
        own = [
            i
            for i, s in enumerate(everything)
            if keep[0] <= s.at.frame < keep[1] and sign * s.sign >= 0
        ]
        found = self._pool.map(lambda i: self._finish(i, everything, seen), own)
        finished = [(i >= len(steps), *f) for i, f in zip(own, found, strict=True) if f is not None]
        fitted = self._judged(finished)
        if fitted and not self._pattern:
            described = [f for f in fitted if f.event.fit.status == Status.OK] or fitted
            self.empty = step_controls(
                scene=self._scene, chunk=self._chunk, window=self._window,
                fits=[(f.step, f.event.fit) for f in described],
                steps=everything, neighbours=self._neighbours,
            )  # fmt: skip
        return sorted(fitted, key=lambda f: (f.step.at.frame, f.step.start.y_px, f.step.start.x_px))

    def with_traces(self, fitted: Sequence[FittedStep], clips: int) -> list[FittedStep]:
        """Add what the report shows of steps beside their images.

        Parameters
        ----------
        fitted : sequence of FittedStep
            From `run`.
        clips : int
            How many, the first, have a clip.

        Returns
        -------
        list of FittedStep
            With trace and clip, where the frames allow.
        """
        chunk, window = self._chunk, self._window

        def one(number: int) -> FittedStep:
            step = fitted[number]
            patch = patch_of(step, chunk, window)
            trace = trace_of(step, patch, chunk, self._neighbours, self._tasks)
            clip = None
            if number < clips:
                clip = clip_of(step, patch, self._scene, chunk, window, self._pattern)
            return replace(step, trace=trace, clip=clip)

        return list(self._pool.map(one, range(len(fitted))))

    # ---- search ----------------------------------------------------------------------------

    def _search(self, matched: Filter, steps: Sequence[Step]) -> list[Step]:
        scene, chunk = self._scene, self._chunk
        moving, edges, count = self._pattern, chunk.edges, chunk.edges.size - 2
        near = []
        for j in range(count):
            low, high = max(j + 1 - self._strides, 0), min(j + 1 + self._strides, count + 1)
            span = slice(int(edges[low]), int(edges[high]))
            if moving:
                middle = int(edges[j + 1])
                span = moving.span(slice(span.start, middle), slice(middle, span.stop))
            near.append([s for s in steps if self._neighbours.overlaps(s, span.start, span.stop)])

        def explained(j: int, before: slice, after: slice) -> FloatArray | None:
            if not near[j]:
                return moving.contrast[j] if moving else None
            total = np.zeros(chunk.shape)
            for step in near[j]:
                total[self._neighbours.box(step)] += self._neighbours.change(step, before, after)
            total = scene.left(total)
            return total + moving.contrast[j] * (1 + total) if moving else total

        self._maps = snr, effective = sliding_maps(
            chunk, matched, self._strides,
            explained=explained if steps or moving else None,
            earlier=self._maps,
            changed=[j for j, old in enumerate(self._near) if _ids(old) != _ids(near[j])],
            mapper=self._pool.map,
        )  # fmt: skip
        self._near = near
        if not steps and len(snr):
            where = np.argmax(np.abs(snr), axis=0)
            best = np.take_along_axis(snr, where[None], axis=0)[0].astype(np.float64)
            frames = np.maximum(effective[where], 1e-9)
            self.strongest = np.stack([np.abs(best), best / np.sqrt(frames * matched.norm)])
        peaks = find_steps(chunk, matched, snr, effective, scene.templates.threshold)
        refuse_flood(
            len(peaks), self._excess_noise, frames=f" in frames {chunk.first}:{chunk.stop}"
        )
        fresh, self._doubtful = self._sieve.sift(peaks, steps, snr)
        return [self._begin(peak) for peak in fresh]

    def _begin(self, peak: Peak) -> Step:
        scene = self._scene
        sign = 1 if peak.amplitude > 0 else -1
        mass = float(scene.model.scale.mass(np.asarray(abs(peak.amplitude))))
        if "mass_kda" not in FREE_PARAMETERS[scene.mode]:
            mass = scene.model.material.mass_kda
        mass = max(mass, 1e-3 * scene.model.material.mass_kda)
        start = Candidate(
            peak.x_px, peak.y_px, scene.config.particle.height_nm, mass, abs(peak.snr)
        )
        at = StepFrame(peak.frame, self._stride, 1.0, 1.0, 1.0)
        return self._neighbours.drawn(Step(sign, at, start, (0, 0), np.empty((0, 0))))

    # ---- one step --------------------------------------------------------------------------

    def _improve(
        self, steps: Sequence[Step], chosen: set[int], near: Sequence[Sequence[int]]
    ) -> list[Step]:
        """Fit the chosen steps at the heights that they have, each with the others as they were."""
        z_range = self._scene.config.fit.z_range_nm

        def fitted(step: Step, task: Task) -> Step:
            likelihood, start = task.likelihood, _displaced(step.start, *task.offset_px)
            box = search_box(likelihood, start, self._quick_mode, z_range, level=True)
            theta = start_theta(likelihood, start) if step.theta is None else step.theta.copy()
            theta = np.where(box.free, np.clip(theta, box.lower, box.upper), theta)
            best = likelihood.maximize(theta, box.free, box.lower, box.upper)
            if likelihood.model.scale.mass(best.theta[3]) <= 0:
                return replace(step, at=task.at, snr=0.0)
            return self._moved(step, task, best.theta, detection_snr(likelihood, best, box))

        return self._refitted(steps, chosen, near, fitted)

    def _lifted(
        self, steps: Sequence[Step], chosen: set[int], near: Sequence[Sequence[int]]
    ) -> list[Step]:
        """Fit the chosen steps at all heights, so that their rings are those of their own."""
        z_range = self._scene.config.fit.z_range_nm

        def fitted(step: Step, task: Task) -> Step:
            start = _displaced(step.start, *task.offset_px)
            fit = fit_particle(
                task.likelihood, start, self._scene.mode, z_range, level=True, correct_bias=False
            )
            return self._moved(step, task, fit.theta, fit.snr) if fit.mass_kda > 0 else step

        return self._refitted(steps, chosen, near, fitted)

    def _refitted(
        self,
        steps: Sequence[Step],
        chosen: set[int],
        near: Sequence[Sequence[int]],
        fitted: Callable[[Step, Task], Step],
    ) -> list[Step]:
        def one(index: int) -> Step:
            task = self._tasks.build(index, steps, near)
            return steps[index] if task is None else fitted(steps[index], task)

        refitted = list(steps)
        for index, step in zip(sorted(chosen), self._pool.map(one, sorted(chosen)), strict=True):
            refitted[index] = step
        return refitted

    def _moved(self, step: Step, task: Task, theta: FloatArray, snr: float) -> Step:
        """Put a step where a fit found it."""
        likelihood, (y_px, x_px) = task.likelihood, task.offset_px
        pixel = self._scene.pixel_nm
        start = replace(
            step.start,
            x_px=float(theta[0]) / pixel - x_px,
            y_px=float(theta[1]) / pixel - y_px,
            z_nm=float(theta[2]),
            mass_kda=float(likelihood.model.scale.mass(theta[3])),
        )
        excess = chi2_excess(likelihood.residuals(theta))
        return self._neighbours.drawn(
            replace(step, at=task.at, start=start, theta=theta, snr=snr, excess=excess)
        )

    @property
    def _quick_mode(self) -> str:
        """Where z is free it is found after place and mass, from all heights at once."""
        return "mass" if "mass_kda" in FREE_PARAMETERS[self._scene.mode] else "localize"

    def _finish(
        self, index: int, steps: Sequence[Step], near: Sequence[Sequence[int]]
    ) -> tuple[FittedStep, Task] | None:
        """Fit a step for good."""
        scene, step = self._scene, steps[index]
        task = self._tasks.build(index, steps, near)
        if task is None:
            return None
        likelihood = task.likelihood
        if likelihood.n_pixels < 0.5 * math.prod(likelihood.grid.shape):
            return None
        y_px, x_px = task.offset_px
        start = _displaced(step.start, y_px, x_px)
        fit = fit_particle(likelihood, start, scene.mode, scene.config.fit.z_range_nm, level=True)
        if fit.mass_kda <= 0 and "mass_kda" in fit.free:
            return None
        pixel = scene.pixel_nm
        fit = replace(fit, x_nm=fit.x_nm - x_px * pixel, y_nm=fit.y_nm - y_px * pixel)
        local = Region(
            (0, task.region.rows[1] - task.region.rows[0]),
            (0, task.region.columns[1] - task.region.columns[0]),
        )
        event = Event(local, fit, likelihood)
        if event.snr < _EXPLAINED * scene.templates.threshold:
            return None
        step = replace(step, at=task.at)
        seen = near[index] if scene.lines is None else [i for i in range(len(steps)) if i != index]
        others = tuple(steps[i] for i in seen)
        repeats = step_repeats(
            self._chunk, event, task.region, task.windows, step,
            others, self._neighbours, self._pattern,
        )  # fmt: skip
        fitted = FittedStep(
            step, event, task.region, task.windows, task.n_before, task.n_after, repeats, others
        )
        return fitted, task

    def _judged(self, finished: Sequence[tuple[bool, FittedStep, Task]]) -> list[FittedStep]:
        """Judge all steps, those that may be side lobes, or explain less than they leave, too."""
        judged = []
        for lobe, one, task in finished:
            event = one.event
            near = (
                other.event.described
                for _, other, _ in finished
                if _apart(other.step, one.step) < self._window
                and distance_px(other.step, one.step) < LARGEST_IMAGE * self._roi_px
            )
            fit = judge(
                self._scene, event.fit, task.region, task.windows.saturated,
                sidelobe=lobe or event.described.is_dwarfed(near),
                too_close=task.crowded,
                poor_fit=task.at.p_constant < POOR_FIT_P,
            )  # fmt: skip
            judged.append(replace(one, event=replace(event, fit=fit)))
        return judged

    def _credible(self, steps: Sequence[Step]) -> list[Step]:
        """Leave out what the others explain, and the weaker of two steps that describe one."""
        kept: list[Step] = []
        for step in sorted(steps, key=lambda s: -s.start.snr):
            if step.snr > _EXPLAINED * self._scene.templates.threshold and not any(
                s.sign == step.sign
                and distance_px(s, step) < _SAME_PX
                and abs(s.at.frame - step.at.frame) <= max(2, s.at.half_width + step.at.half_width)
                for s in kept
            ):
                kept.append(step)
        return kept


def _ids(steps: Sequence[Step]) -> set[int]:
    """Tell apart the very same steps from those that were fitted anew."""
    return {id(step) for step in steps}


def _has_moved(old: Step, new: Step) -> bool:
    """Whether a fit changed what the neighbours see by more than its error."""
    if old.theta is None or old.at.frame != new.at.frame:
        return True
    tolerance = max(old.start.mass_kda, new.start.mass_kda) / max(new.snr, 1.0)
    return abs(new.start.mass_kda - old.start.mass_kda) > tolerance


def _displaced(start: Candidate, y_px: float, x_px: float) -> Candidate:
    """Move a candidate."""
    return replace(start, x_px=start.x_px + x_px, y_px=start.y_px + y_px)


def _apart(one: Step, two: Step) -> int:
    return abs(one.at.frame - two.at.frame)
