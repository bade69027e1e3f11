"""Steps in one chunk of a landing movie: found, dated and fitted, with their neighbours in view.

Each step is fitted on the frames just before and just after it, by the conditional likelihood of
those very frames.  Turns of all fits with all others in place settle in two or three sweeps; what
they explain is taken off the sliding contrast, which is then searched again.  `neighbours` says
what steps do to each other's light, `tasks` sets up the likelihood of one.

Bright steps that no dipole describes: spheres, and images as the movie shows them.

The search for dipoles would take the rings of a large particle for steps of their own; spheres are
therefore found by their light and fitted before all others.

A vesicle or an aggregate is no point, and what the model leaves over of it hides what lands in the
same frames, all over the field: each peak of it may be a particle with lobes of its own, for which
fainter ones wait.  Such a step is taken off with a picture of its own: the contrast
between the frames with and without it, averaged along rings around its centre of symmetry,

    C(r, φ) = Σ_k h_k(φ) c_k(r),    h = 1, cos φ, sin φ, cos 2φ, sin 2φ,

with c_k linear between knots.  The rings are those of a scatterer of any size in any polarisation;
a particle beside it is much narrower than a ring, counts as an outlier of it, and stays.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import compress, islice, takewhile

import numpy as np
from scipy import fft

from iscat_analysis.fitting.context import AnalysisContext, reported_steps
from iscat_analysis.fitting.events import (
    BRIGHT_SNR,
    IN_VAIN,
    Region,
    fit_flags,
    standing_out,
    with_index,
    with_spheres,
)
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.fit import (
    POOR_FIT_P,
    detection_snr,
    fit_particle,
    search_box,
    start_theta,
)
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.recognition import may_be_large, model_of, recognised, refitted
from iscat_analysis.landing.maps import Searched, SidelobeFilter, StepMaps, searched_shares
from iscat_analysis.landing.neighbours import Neighbours, Step, distance_px
from iscat_analysis.landing.split_frames import step_controls, step_repeats
from iscat_analysis.landing.tasks import (
    TRACE_FRAMES,
    StepEvent,
    Task,
    TaskBuilder,
    clip_of,
    patch_of,
    trace_of,
)
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Candidate,
    Clip,
    FitResult,
    FloatArray,
    Mapper,
    Trace,
)
from iscat_analysis.search.bright import BrightStep, find_bright_steps
from iscat_analysis.search.dating import StepFrame, common_rise, go_on_rising
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.frames import EVERYWHERE, Box, is_within
from iscat_analysis.search.peaks import RINGS, Described, chi2_excess, summits
from iscat_analysis.search.sliding import STRIDES, MapArray, Peak, find_steps, make_filter
from iscat_analysis.search.templates import LARGEST_IMAGE, ExcessNoise, refuse_flood

_LEAST_MISFIT_SHARE = 0.1  # share of a misfit that alone passes the threshold where it hides others
# Farthest that the centre may lie from the fit of the model, in sides of the region.
_LARGEST_SHIFT_SHARE = 0.35


def large_steps(neighbours: Neighbours, mapper: Mapper) -> tuple[list[Step], bool]:
    """Find bright steps that a sphere describes and a dipole does not; tell if trying is in vain.

    With wrong optics dipoles describe no bright step, and spheres neither.
    """
    context = neighbours.context
    if not context.spheres_of(context.model):
        return [], False
    chunk, window = neighbours.chunk, neighbours.window
    bright = find_bright_steps(chunk, window, context.config, mapper=mapper)
    clear = takewhile(lambda step: step.snr >= BRIGHT_SNR, bright.every())
    nominal, z_range = context.model.material.mass_kda, context.config.fit.z_range_nm

    def tried(step: BrightStep) -> list[tuple[int, Likelihood, FitResult]] | None:
        """Fit spheres that land or leave; None where a dipole suffices."""
        landing = _likelihood_of(context, step, 1)
        start = Candidate(step.x_px, step.y_px, context.height_nm(nominal), nominal, step.snr)
        dipole = fit_particle(landing, start, context.mode, z_range, level=True)
        if not may_be_large(landing, dipole):
            return None
        found = []
        for sign in (1, -1):
            likelihood = landing if sign > 0 else _likelihood_of(context, step, sign)
            spheres = context.spheres_of(likelihood.model)
            sphere = recognised(likelihood, dipole, spheres, z_range, level=True)
            if sphere is not None:
                found.append((sign, *sphere))
        return found

    steps: list[Step] = []
    vain = failed = 0
    while batch := list(islice(clear, IN_VAIN - vain)):
        for step, found in zip(batch, mapper(tried, batch), strict=True):
            vain = 0 if found else vain + 1
            failed += found is not None
            if found:
                sign, seated, fit = max(found, key=lambda one: one[2].log_likelihood)
                at = StepFrame.undated(step.frame, neighbours.stride)
                steps.append(neighbours.draw_sphere(sign, at, model_of(seated), fit))
    return steps, not steps and failed >= IN_VAIN


def _likelihood_of(context: AnalysisContext, step: BrightStep, sign: int) -> Likelihood:
    """Make the likelihood of a step that lands or leaves, in the square that is fitted at most."""
    rows, columns = (_middle(part, context.roi_px) for part in (step.rows, step.columns))
    (top, bottom), (left, right) = rows, columns
    y, x = step.rows[0], step.columns[0]
    windows = step.windows.cut((slice(top - y, bottom - y), slice(left - x, right - x)))
    before, after = (windows.before_e, windows.after_e)[::sign]
    one, other = (windows.read_variance_before_e2, windows.read_variance_after_e2)[::sign]
    model = context.model_at(step.x_px * context.pixel_nm, step.y_px * context.pixel_nm, step.frame)
    grid, ratio = PixelGrid.region(rows, columns, context.pixel_nm), windows.power_ratio**sign
    counts = before, after, ratio
    return conditional(model, grid, *counts, read_variances_e2=(one, other), masked=windows.masked)


def _middle(span: tuple[int, int], most: int) -> tuple[int, int]:
    """Give the middle of a range of pixels, as many as that at most."""
    first = span[0] + max(span[1] - span[0] - most, 0) // 2
    return first, first + min(span[1] - span[0], most)


def with_measured_images(
    steps: Sequence[Step], near: Sequence[Sequence[int]], neighbours: Neighbours
) -> list[Step]:
    """Give those steps their measured pictures of which what is left over could hide others.

    Two lobes of one picture that the model does not describe may both have been taken for steps:
    the weaker one is left out.
    """
    threshold = neighbours.context.templates.threshold
    chosen: list[int] = []
    lobes: set[int] = set()
    # those that are measured come first, then those of which the model leaves over most
    order = [(not s.is_measured, -s.excess, -s.start.snr, i) for i, s in enumerate(steps)]
    for *_, i in sorted(order):
        step = steps[i]
        sphere = neighbours.are_spheres or step.sphere is not None
        if not (step.is_measured or _hides_others(step, threshold, sphere=sphere)):
            continue
        middle = next((steps[k] for k in chosen if _is_lobe(step, steps[k], neighbours)), None)
        if middle is None:
            chosen.append(i)
        elif not middle.is_measured:
            lobes.add(i)
    measured = list(steps)
    for _ in range(2):  # since pictures overlap
        for i in chosen:
            others = [measured[k] for k in near[i] if k not in lobes]
            measured[i] = _measured(measured[i], others, neighbours)
    return [step for i, step in enumerate(measured) if i not in lobes]


def _hides_others(step: Step, threshold: float, *, sphere: bool) -> bool:
    """Whether the misfit of a step could hide others.

    It does if the model misses a little of a very bright picture, or nearly all of a picture.  In
    between it may be two particles that land at once.  A sphere that was fitted as one has the
    right picture, unless what it misses says otherwise.
    """
    if sphere:
        return step.excess > (threshold / _LEAST_MISFIT_SHARE) ** 2
    described = step.excess < 0.1 * step.snr**2
    if described and RINGS * step.start.snr > threshold:
        return True
    return step.excess > max(4 * step.snr**2, (threshold / _LEAST_MISFIT_SHARE) ** 2)


def _is_lobe(step: Step, brighter: Step, neighbours: Neighbours) -> bool:
    """Whether a step is in the middle of the picture of a brighter step, at the same time."""
    near = distance_px(step, brighter) < 2 * _LARGEST_SHIFT_SHARE * neighbours.roi_px
    return near and abs(step.at.frame - brighter.at.frame) <= neighbours.window // STRIDES


def _measured(step: Step, others: Sequence[Step], neighbours: Neighbours) -> Step:
    """Replace the picture of a step by the measured one, if there are frames for that."""
    chunk, window, roi_px = neighbours.chunk, neighbours.window, neighbours.roi_px
    rows, columns = step.drawn.rows, step.drawn.columns
    frame, gap = step.at.frame, min(step.at.gap, window // 5)
    begin, end = max(frame - window, chunk.first), min(frame + window, chunk.stop)
    spans = (begin, max(frame - gap, begin)), (min(frame + gap, end), end)
    patch = chunk.patch(begin, end, rows, columns)
    windows = patch.windows(*spans)
    if not windows.n_before or not windows.n_after:
        return step
    before, after = windows.before_e, windows.after_e
    ratio = np.full(before.shape, windows.power_ratio)
    cuts = chunk.cut(*spans[0]), chunk.cut(*spans[1])
    for other in others:
        neighbours.apply(ratio, other, *cuts, Region(rows, columns))
    used = patch.usable & (before > 0) & (after > 0)
    before, after = (np.where(used, part, 1.0) for part in (before * ratio, after))
    if step.sign < 0:
        before, after = after, before
    contrast = np.where(used, after / before - 1, 0.0)
    sigma = np.sqrt((1 / before + 1 / after) * (1 + contrast) ** 2)
    weight = np.where(used, 1 / sigma, 0.0)
    place = step.start.y_px - rows[0], step.start.x_px - columns[0]
    centre = _centre(contrast * weight, place, _LARGEST_SHIFT_SHARE * roi_px)
    image = np.maximum(ring_average(contrast, weight, centre), contrast.min())  # no light is less
    half = roi_px // 2
    y, x = (max(round(c) - half, 0) for c in place)
    core = slice(y, y + 2 * half + 1), slice(x, x + 2 * half + 1)
    excess = chi2_excess(((contrast - image) * weight)[core])
    return replace(step, drawn=step.drawn.measured(image), excess=excess, is_measured=True)


def _centre(
    signal: FloatArray, place: tuple[float, float], wander_px: float
) -> tuple[float, float]:
    """Find the point about which a picture is symmetric, near a place.

    Rings of even order look the same from the other side: the picture convolved with itself is
    highest at twice their centre.

    Shapes: `signal` (ny, nx).
    """
    size = [fft.next_fast_len(2 * n, real=True) for n in signal.shape]
    twice = fft.irfft2(fft.rfft2(signal, size) ** 2, size)
    low = [max(math.ceil(2 * (c - wander_px)), 1) for c in place]
    high = [math.floor(2 * (c + wander_px)) + 1 for c in place]
    near = twice[low[0] : high[0], low[1] : high[1]]
    i, j = np.unravel_index(int(np.argmax(near)), near.shape)
    at = np.array([[0, i + low[0], j + low[1]]], dtype=np.int64)
    dy, dx, _ = summits(twice[None], at)
    return float(at[0, 1] + dy[0]) / 2, float(at[0, 2] + dx[0]) / 2


def ring_average(
    contrast: FloatArray, weight: FloatArray, centre: tuple[float, float]
) -> FloatArray:
    """Average a picture along rings, with their first two harmonics; outliers count less.

    Shapes: `contrast, weight` (ny, nx), result (ny, nx).
    """
    y, x = (np.arange(n) - c for n, c in zip(contrast.shape, centre, strict=True))
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    # between knots; rings are half a wavelength apart, some two pixels
    radius = np.hypot(y[:, None], x[None, :]).ravel() / 0.6
    angle = np.arctan2(y[:, None], x[None, :] + 0 * y[:, None]).ravel()
    turns = angle, 2 * angle
    waves = [np.ones(angle.size), *(wave(turn) for turn in turns for wave in (np.cos, np.sin))]
    knot = np.floor(radius).astype(np.int64)
    part, places = radius - knot, (np.tile(np.arange(radius.size), 2), np.append(knot, knot + 1))
    rings = sparse.csr_matrix((np.append(1 - part, part), places))
    design = sparse.hstack([rings.multiply(wave[:, None]) for wave in waves], format="csr")
    value, accuracy = contrast.ravel(), weight.ravel()
    ridge = sparse.identity(design.shape[1]) * (1e-6 * float(np.mean(accuracy**2)))
    kept = accuracy**2
    image = np.zeros(value.size)
    # of the rings, with the outliers of the one before
    for _ in range(4):
        normal = design.T @ sparse.diags(kept) @ design + ridge
        image = design @ spsolve(normal.tocsc(), design.T @ (kept * value))
        off = np.abs(value - image) * accuracy
        scale = max(1.0, float(np.median(off[accuracy > 0])) / 0.6745)
        kept = accuracy**2 * np.minimum(1.0, 3 * scale / np.maximum(off, 1e-9)) ** 2
    return image.reshape(contrast.shape)


# Of the threshold; a fit that reaches less is what other steps explain
_LEAST_THRESHOLD_SHARE = 0.7
_SAME_PX = 1.5


class ChunkFitter:
    """Finds and fits the steps of one chunk."""

    def __init__(
        self,
        neighbours: Neighbours,
        pool: ThreadPoolExecutor,
        excess_noise: ExcessNoise | None = None,
        own: Box = EVERYWHERE,
        *,
        controlled: bool = True,
    ) -> None:
        self.neighbours, self._tasks = neighbours, TaskBuilder(neighbours)
        self._pool, self._excess_noise, self._controlled = pool, excess_noise, controlled
        self.mapper = pool.map
        self._tries_spheres = True
        self.own = own  # pixels of the chunk that count: those of the core of a tile
        self._context, chunk = neighbours.context, neighbours.chunk
        self._chunk, self._window, self._stride = chunk, neighbours.window, neighbours.stride
        self._sieve = SidelobeFilter(chunk.first, self._stride, self._window, neighbours.roi_px)
        self._doubtful: list[Peak] = []
        self._last: tuple[list[Peak], tuple[MapArray, FloatArray]] | None = None
        self.strongest = np.zeros((2, *chunk.shape), dtype=np.float32)  # of a figure
        self.rounds = 0
        self._direction = 1  # through places: next from the end whose regions are still held
        self.searched: Searched | None = None
        self.empty: EmptySpread | None = None  # noise where nothing lands or leaves

    def run(self, keep: tuple[int, int], core: tuple[int, int] | None = None) -> list[StepEvent]:
        """Find and fit every step."""
        templates = self._context.templates
        matched = make_filter(self._chunk, templates.images[0], templates.noise)
        maps = StepMaps(self.neighbours, matched)
        steps: list[Step] = []
        if self.neighbours.pattern is None:
            steps, in_vain = large_steps(self.neighbours, self.mapper)
            self._tries_spheres = not in_vain
        rejected: list[Step] = []
        for self.rounds in range(1, 10 + 1):  # each takes what was found so far off the contrast
            fresh = [
                s
                for s in self._search(maps, steps)
                if not any(
                    abs(s.at.frame - r.at.frame) <= self._stride and distance_px(s, r) < _SAME_PX
                    for r in rejected
                )
            ]
            if not fresh:
                break
            known = len(steps) if self.rounds > 1 else 0
            steps = steps + fresh
            seen, bound = self.neighbours.of(steps)
            relevant = self._relevant(steps, bound)
            new = relevant.intersection(range(known, len(steps)))
            chosen = new
            for _ in range(10):  # over what has neighbours that still move
                improved = self._refitted(self._improved, steps, chosen, seen)
                moved = {i for i in chosen if _has_moved(steps[i], improved[i])}
                steps = improved
                chosen = {i for i in relevant if moved.intersection(bound[i])}
                if not chosen:
                    break
            rise = {
                sign: common_rise([s.at.rise_profile for s in steps if s.sign == sign])
                for sign in self._tasks.rise
            }
            if rise != self._tasks.rise:
                self._tasks.rise = rise
                steps = self._refitted(self._improved, steps, relevant, seen)
            if "z_nm" in FREE_PARAMETERS[self._context.mode]:
                steps = self._refitted(self._lifted, steps, new, seen)
            credible = self._credible(steps)
            rejected += {*steps}.difference(credible)
            if steps := credible:
                near = self.neighbours.of(steps)[0]
                steps = with_measured_images(steps, near, self.neighbours)
        if core is not None and self._last is not None:
            self.searched = searched_shares(self.neighbours, core, steps, *self._last, self.own)
        self._last = None
        del maps  # fits need their memory
        if not steps:
            return []
        lobes = [self._begin(peak) for peak in self._doubtful]
        everything = steps + lobes
        seen, around = (
            [near[: bisect_left(near, len(steps))] for near in self.neighbours.of(everything, n)[0]]
            for n in (0, TRACE_FRAMES)
        )
        # steps of the other polarity are fitted too: their rings have the one that is reported
        sign = reported_steps(self._context)
        now = [
            i
            for i, s in enumerate(everything)
            if keep[0] <= s.at.frame < keep[1] and sign * s.sign >= 0
        ]
        # beyond the core of a tile, from which a last fit may lead into it
        own = [i for i in now if self._is_near_core(everything[i], 4.0)]
        order = _by_place(everything, own)
        finished = self.mapper(
            lambda i: self._finish(i, everything, seen, around, lobe=i >= len(steps)), order
        )
        found = dict(zip(order, finished, strict=True))
        beside = [steps[i] for i in sorted({*now}.difference(own)) if i < len(steps)]
        fitted = self._judged([one for i in own if (one := found[i]) is not None], beside)
        if fitted and not self.neighbours.pattern and self._controlled:
            events = standing_out([f.event for f in fitted])
            self.empty = step_controls(events, everything, self.neighbours, self.own)
        return sorted(fitted, key=lambda f: (f.step.at.frame, f.step.start.y_px, f.step.start.x_px))

    def shown(
        self, fitted: Sequence[StepEvent], clips: int
    ) -> list[tuple[Trace | None, Clip | None]]:
        """Give what the report shows of steps beside their images."""

        def one(number: int) -> tuple[Trace | None, Clip | None]:
            step = fitted[number]
            patch = patch_of(step, self.neighbours)
            trace = trace_of(step, patch, self._tasks)
            return trace, clip_of(step, patch, self.neighbours) if number < clips else None

        return list(self.mapper(one, range(len(fitted))))

    # ---- search ----------------------------------------------------------------------------

    def _search(self, maps: StepMaps, steps: Sequence[Step]) -> list[Step]:
        context, chunk, matched = self._context, self._chunk, maps.matched
        snr, effective = maps.without(steps, self.mapper)
        if not steps and len(snr):
            where = np.abs(snr).argmax(axis=0)
            best = np.take_along_axis(snr, where[None], axis=0)[0].astype(np.float64)
            frames = np.maximum(effective[where], 1e-9)
            self.strongest[:] = np.abs(best), best / np.sqrt(frames * matched.norm)
        peaks = find_steps(chunk, matched, snr, effective, context.templates.threshold)
        self._last = peaks, (snr, effective)
        fresh, self._doubtful = self._sieve.sift(peaks, steps, snr)
        refuse_flood(  # the rings of a few bright particles are no noise
            len(fresh), context.templates, self._excess_noise,
            images=len(snr), frames=f" in frames {chunk.first}:{chunk.stop}",
        )  # fmt: skip
        return [self._begin(peak) for peak in fresh]

    def _begin(self, peak: Peak) -> Step:
        context = self._context
        sign = 1 if peak.amplitude > 0 else -1
        mass = float(context.model.scale.mass(np.asarray(abs(peak.amplitude))))
        if "mass_kda" not in FREE_PARAMETERS[context.mode]:
            mass = context.model.material.mass_kda
        mass = max(mass, 1e-3 * context.model.material.mass_kda)
        start = Candidate(peak.x_px, peak.y_px, context.height_nm(mass), mass, abs(peak.snr))
        return self.neighbours.draw(sign, StepFrame.undated(peak.frame, self._stride), start)

    def _relevant(self, steps: Sequence[Step], bound: Sequence[Sequence[int]]) -> set[int]:
        """Select the steps whose light reaches what is fitted in the core, and their neighbours.

        Others keep the values of the search.
        """
        reaches = [self._is_near_core(s, self.neighbours.reach_px(s)) for s in steps]
        return {
            i for i, others in enumerate(bound) if reaches[i] or any(reaches[k] for k in others)
        }

    def _is_near_core(self, step: Step, margin_px: float) -> bool:
        """Whether a step is in the core of a tile, or nearer to it than a margin."""
        return bool(is_within(self.own, step.start.y_px, step.start.x_px, margin_px))

    def _improved(self, step: Step, task: Task) -> Step:
        """Fit a step at its present height."""
        if step.sphere is not None:
            likelihood, fit = refitted(task.likelihood, *step.sphere, level=True)
            excess = chi2_excess(likelihood.residuals(fit.theta))
            return self.neighbours.draw_sphere(
                step.sign, task.at, model_of(likelihood), fit, excess
            )
        likelihood, start = task.likelihood, task.displaced(self._seated(step))
        begin, z_range = start_theta(likelihood, start), self._context.config.fit.z_range_nm
        # a free z is held, and found later from all heights at once
        mode = "mass" if "mass_kda" in FREE_PARAMETERS[self._context.mode] else "localize"
        box = search_box(likelihood, begin, mode, z_range, level=True)
        theta = begin if step.theta is None else step.theta.copy()
        if not box.free[2]:
            theta[2] = start.z_nm
        theta = np.where(box.free, np.clip(theta, box.lower, box.upper), theta)
        best = likelihood.maximize(theta, box)
        if likelihood.model.scale.mass(best.theta[3]) <= 0:
            return replace(step, at=task.at, snr=0.0)
        return self._moved(step, task, best.theta, detection_snr(likelihood, best, box))

    def _lifted(self, step: Step, task: Task) -> Step:
        """Fit a step at all heights, so that the rings fit too."""
        start, mode = task.displaced(step.start), self._context.mode
        z_range = self._context.config.fit.z_range_nm
        fit = fit_particle(task.likelihood, start, mode, z_range, level=True, correct_bias=False)
        return self._moved(step, task, fit.theta, fit.snr) if fit.mass_kda > 0 else step

    def _refitted(
        self,
        fitted: Callable[[Step, Task], Step],
        steps: Sequence[Step],
        chosen: set[int],
        near: Sequence[Sequence[int]],
    ) -> list[Step]:
        """Fit the chosen steps, with the others fixed."""

        def one(index: int) -> Step:
            task = self._tasks.build(index, steps, near)
            return steps[index] if task is None else fitted(steps[index], task)

        refitted, order = list(steps), _by_place(steps, chosen)[:: self._direction]
        self._direction = -self._direction
        for index, step in zip(order, self.mapper(one, order), strict=True):
            refitted[index] = step
        return refitted

    def _seated(self, step: Step) -> Candidate:
        """Set the height of a step to the expected one, unless its height is free."""
        if "z_nm" in FREE_PARAMETERS[self._context.mode]:
            return step.start
        return replace(step.start, z_nm=self._context.height_nm(step.start.mass_kda))

    def _moved(self, step: Step, task: Task, theta: FloatArray, snr: float) -> Step:
        """Set a step to its fitted position."""
        likelihood, (y_px, x_px) = task.likelihood, task.offset_px
        pixel = self._context.pixel_nm
        start = replace(
            step.start,
            x_px=float(theta[0]) / pixel - x_px,
            y_px=float(theta[1]) / pixel - y_px,
            z_nm=float(theta[2]),
            mass_kda=float(likelihood.model.scale.mass(theta[3])),
        )
        if step.is_measured:
            return replace(step, at=task.at, start=start, theta=theta, snr=snr)
        excess = chi2_excess(likelihood.residuals(theta))
        moved = self.neighbours.draw(step.sign, task.at, start)
        return replace(moved, theta=theta, snr=snr, excess=excess)

    def _finish(
        self,
        index: int,
        steps: Sequence[Step],
        near: Sequence[Sequence[int]],
        around: Sequence[Sequence[int]],
        *,
        lobe: bool,
    ) -> StepEvent | None:
        """Fit a step for good."""
        context, step = self._context, steps[index]
        task = self._tasks.build(index, steps, near)
        if task is None:
            return None
        likelihood = task.likelihood
        if likelihood.n_pixels < 0.5 * math.prod(likelihood.grid.shape):
            return None
        if step.sphere is None:
            start, z_range = task.displaced(self._seated(step)), context.config.fit.z_range_nm
            fit = fit_particle(likelihood, start, context.mode, z_range, level=True)
        else:
            likelihood, fit = refitted(likelihood, *step.sphere, level=True)
        if fit.mass_kda <= 0 and "mass_kda" in fit.free:
            return None
        y_nm, x_nm = context.pixel_nm * task.offset_px
        event = task.event(fit.shifted(-x_nm, -y_nm), likelihood, step.sign)
        if event.snr < _LEAST_THRESHOLD_SHARE * context.templates.threshold:
            return None
        event, told = with_index(context, event)
        step = replace(step, at=task.at)
        seen = near[index] if context.lines is None else sorted({*range(len(steps))} - {index})
        others = tuple(steps[i] for i in seen)
        far = others if context.lines is not None else [steps[i] for i in around[index]]
        spans, lighting = self._tasks.trace_spans(step, task.windows, far)
        repeats = step_repeats(spans, event, step, lighting, self.neighbours)
        return StepEvent(event, step, others, repeats, told, task.crowded, lobe)

    def _judged(self, finished: Sequence[StepEvent], beside: Sequence[Step]) -> list[StepEvent]:
        """Judge all steps, including side lobes and steps that explain less than they leave.

        Steps `beside` them are not reported, but their residuals may be found as steps.
        """
        if self._tries_spheres:
            fitted = [own.event for own in finished]
            events = with_spheres(self._context, fitted, self._pool, level=True)
            finished = [replace(o, event=e) for o, e in zip(finished, events, strict=True)]
        steps = [*(own.step for own in finished), *beside]
        settling = {
            sign: go_on_rising([step.at.settling for step in steps if step.sign == sign])
            for sign in (1, -1)
        }
        described = [own.event.described for own in finished]
        described += [
            Described(s.start.snr if s.theta is None else s.snr, s.excess) for s in beside
        ]
        frame = np.array([step.at.frame for step in steps])
        x_px, y_px = _places(steps)
        judged = []
        for number, own in enumerate(finished):
            away = np.hypot(x_px - x_px[number], y_px - y_px[number])
            at_once = np.abs(frame - frame[number]) < self._window
            near = np.flatnonzero(
                at_once & (away < LARGEST_IMAGE * self.neighbours.roi_px)
            ).tolist()
            flags = fit_flags(
                self._context,
                own.event,
                own.event.windows,
                sidelobe=own.lobe or described[number].is_dwarfed(described[i] for i in near),
                too_close=own.crowded,
                changing=steps[number].at.p_constant < POOR_FIT_P
                or (settling[steps[number].sign] and steps[number].at.rise > 0)
                or any(
                    away[i] < self.neighbours.roi_px / 2 and _outshines(steps[i], steps[number])
                    for i in near
                ),
            )
            judged.append(replace(own, event=replace(own.event, flags=flags)))
        return judged

    def _credible(self, steps: Sequence[Step]) -> list[Step]:
        """Drop steps that others explain, and the weaker of two that describe one particle."""
        steps = sorted(steps, key=lambda s: -s.start.snr)
        sign = np.array([s.sign for s in steps])
        frame = np.array([s.at.frame for s in steps])
        width = np.array([s.at.half_width for s in steps])
        x_px, y_px = _places(steps)
        kept = (
            np.array([s.snr for s in steps])
            > _LEAST_THRESHOLD_SHARE * self._context.templates.threshold
        )
        for number in np.flatnonzero(kept).tolist():
            same = kept[:number] & (sign[:number] == sign[number])
            same &= np.abs(frame[:number] - frame[number]) <= np.maximum(
                2, width[:number] + width[number]
            )
            away = np.hypot(x_px[:number] - x_px[number], y_px[:number] - y_px[number])
            kept[number] = not np.any(same & (away < _SAME_PX))
        return list(compress(steps, kept))


def _by_place(steps: Sequence[Step], chosen: Collection[int]) -> list[int]:
    """Sort steps so that those of one place, which have a region in common, follow each other."""
    return sorted(chosen, key=lambda i: (round(steps[i].start.y_px), steps[i].start.x_px))


def _has_moved(old: Step, new: Step) -> bool:
    """Whether a fit changed what the neighbours see by more than its error."""
    if old.theta is None or old.at.frame != new.at.frame:
        return True
    tolerance = max(old.start.mass_kda, new.start.mass_kda) / max(new.snr, 1.0)
    return abs(new.start.mass_kda - old.start.mass_kda) > tolerance


def _outshines(other: Step, step: Step) -> bool:
    """Whether a step may be what is left of another, much stronger one whose light rises slowly."""
    return other.at.rise > 0 and other.start.mass_kda > 5 * step.start.mass_kda


def _places(steps: Sequence[Step]) -> tuple[FloatArray, FloatArray]:
    """Give x and y of all [pixels]."""
    x_px, y_px = (np.array([getattr(s.start, axis) for s in steps]) for axis in ("x_px", "y_px"))
    return x_px, y_px
