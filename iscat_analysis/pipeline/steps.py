"""Steps in one chunk of a landing movie: found, dated and fitted, with their neighbours in view.

Each step is fitted on the frames just before and just after it, by the conditional likelihood of
those very frames.  A neighbour that lands or leaves in them enters through ρ, pixel by pixel: the
factor (1 + φ_a C)/(1 + φ_b C), φ the share of the light of the frames after and before in which it
is there.  One nearer than ``detection.min_separation_nm`` is kept out instead: the window ends
where it lands or leaves.  Turns of all fits with all others in place settle in two or three sweeps;
what they explain is taken off the sliding contrast, which is then searched again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.fit import fit_particle, search_box, start_theta
from iscat_analysis.forward import PixelGrid
from iscat_analysis.likelihood import Likelihood, conditional
from iscat_analysis.pipeline.field import Event, Region, Scene
from iscat_analysis.records import (
    FREE_PARAMETERS,
    Candidate,
    FitResult,
    FloatArray,
    Status,
    Windows,
)
from iscat_analysis.sliding import (
    STRIDES,
    Chunk,
    Filter,
    Patch,
    Peak,
    StepFrame,
    crosstalk,
    find_steps,
    locate_step,
    make_filter,
    sliding_maps,
)

ROUNDS = 6
"""Searches at most; each takes what was found so far off the contrast."""

FEWEST_FRAMES = 10
"""A neighbour that would leave fewer is fitted beside the step, and both are flagged."""

LARGEST_IMAGE = 3.5
"""Regions from the centre to the edge of a strong particle's image; the rings go on, faintly."""

_SWEEPS = 2  # fits of what has neighbours, with everything else in place
_SIDELOBE = 0.5  # of a stronger peak, below which a peak in its region waits for the next round
_FAR_LOBE = 0.05  # the same where only its outer rings reach
_FAINT_SNR = 30.0  # up to which the image of one region and its surroundings is enough
_WEAK = 0.05  # contrast up to which several add up
_RESIDUE = 0.15  # of a fitted step, below which a peak on top of it is what its fit left over
_RINGS = 0.04  # the same for the rest of its region
_EXPLAINED = 0.7  # of the threshold; a fit that reaches less is what other steps explain
_SAME_PX = 1.5
_SATURATION_NM = 500.0


@dataclass(frozen=True)
class Step:
    """One particle that lands or leaves.

    Attributes
    ----------
    sign : int
        1 where it lands, −1 where it leaves.
    at : StepFrame
        When.
    start : Candidate
        Where, and its mass (positive); `snr` is that of the search.
    corner : (int, int)
        Row and column of the first pixel of `image`.
    image : ndarray
        Its contrast around it.
    theta : ndarray, shape (5,), or None
        Latest estimate.
    snr : float
        √(2 Δℓ) of it against no particle, with the neighbours in place.
    """

    sign: int
    at: StepFrame
    start: Candidate
    corner: tuple[int, int]
    image: FloatArray
    theta: FloatArray | None = None
    snr: float = math.inf


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
    """

    step: Step
    event: Event
    region: Region
    windows: Windows
    n_before: int
    n_after: int


@dataclass(frozen=True)
class _Task:
    """A step's likelihood and what it is made of."""

    likelihood: Likelihood
    region: Region
    windows: Windows
    at: StepFrame
    n_before: int
    n_after: int
    crowded: bool


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

    Attributes
    ----------
    strongest : ndarray, shape (2, y, x)
        Of all boundaries, the one with the largest signal-to-noise ratio at each pixel: that
        ratio, and the amplitude.
    rounds : int
        Searches made.
    """

    def __init__(self, scene: Scene, chunk: Chunk, window: int, pool: ThreadPoolExecutor) -> None:
        self._scene = scene
        self._chunk = chunk
        self._window = window
        self._pool = pool
        self._strides = STRIDES
        self._roi_px = scene.roi_px
        nominal = scene.model.material.mass_kda
        self._contrast_per_kda = (
            scene.model.peak_contrast(scene.config.particle.height_nm, nominal) / nominal
        )
        self._stride = int(chunk.edges[1] - chunk.edges[0])
        self._power = np.concatenate([[0.0], np.cumsum(chunk.power)])
        self.strongest = np.zeros((2, *chunk.shape))
        self.rounds = 0

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
        matched = make_filter(self._chunk, self._scene.templates.images[0])
        steps: list[Step] = []
        rejected: list[Step] = []
        for self.rounds in range(1, ROUNDS + 1):
            fresh = [
                s
                for s in self._search(matched, steps)
                if not any(
                    _distance(s, r) < _SAME_PX and _apart(s, r) <= self._stride for r in rejected
                )
            ]
            if not fresh:
                break
            known = len(steps)
            steps = steps + fresh
            seen, bound = self._neighbourhood(steps)
            chosen = set(range(known, len(steps)))
            for _ in range(_SWEEPS):
                steps = self._improve(steps, chosen, seen)
                chosen = {
                    i for i, others in enumerate(bound)
                    if others and (i >= known or max(others) >= known)
                }  # fmt: skip
                if not chosen:
                    break
            credible = self._credible(steps)
            kept = {id(s) for s in credible}
            rejected += [s for s in steps if id(s) not in kept]
            steps = credible
        if not steps:
            return []
        seen, _ = self._neighbourhood(steps)
        own = [i for i, s in enumerate(steps) if keep[0] <= s.at.frame < keep[1]]
        found = self._pool.map(lambda i: self._finish(i, steps, seen), own)
        fitted = [f for f in found if f is not None]
        return sorted(fitted, key=lambda f: (f.step.at.frame, f.step.start.y_px, f.step.start.x_px))

    # ---- search ----------------------------------------------------------------------------

    def _search(self, matched: Filter, steps: Sequence[Step]) -> list[Step]:
        scene, chunk = self._scene, self._chunk
        polarity = {"both": 0, "bright": 1, "dark": -1}[scene.config.detection.polarity]
        polarity *= int(scene.templates.signs[0])

        def explained(_: int, before: slice, after: slice) -> FloatArray | None:
            near = [s for s in steps if self._overlaps(s, before.start, after.stop)]
            if not near:
                return None
            total = np.zeros(chunk.shape)
            for step in near:
                rows, columns = _spans(step.corner, step.image.shape)
                here = (slice(*rows), slice(*columns))
                total[here] += self._change(step, before, after)
            return total

        snr, effective = sliding_maps(
            chunk, matched, self._strides,
            explained=explained if steps else None, mapper=self._pool.map,
        )  # fmt: skip
        if not steps and len(snr):
            where = np.argmax(np.abs(snr), axis=0)
            best = np.take_along_axis(snr, where[None], axis=0)[0].astype(np.float64)
            frames = np.maximum(effective[where], 1e-9)
            self.strongest = np.stack([np.abs(best), best / np.sqrt(frames * matched.norm)])
        peaks = find_steps(
            chunk, matched, snr, effective, scene.templates.threshold, polarity=polarity
        )
        fresh: list[Peak] = []
        taller: list[Peak] = []
        for peak in peaks:
            # one that waits casts its shadow too, or its rings would be taken for particles
            waits = any(self._shadows(p, peak) for p in taller)
            taller.append(peak)
            if not waits and not any(self._is_residue(step, peak) for step in steps):
                fresh.append(peak)
        return [self._begin(peak) for peak in fresh]

    def _shadows(self, one: Peak, peak: Peak) -> bool:
        """Whether a peak may be nothing but the side lobe of a stronger one."""
        reach = self._strides * self._stride
        apart = abs(one.frame - peak.frame)
        if apart > reach + self._stride:
            return False
        dx, dy = abs(one.x_px - peak.x_px), abs(one.y_px - peak.y_px)
        if apart < reach and math.hypot(dx, dy) < self._roi_px / 6:
            return True
        far = max(dx, dy) >= self._roi_px
        if far and max(dx, dy) >= LARGEST_IMAGE * self._roi_px:
            return False
        return abs(peak.snr) < (_FAR_LOBE if far else _SIDELOBE) * abs(one.snr)

    def _is_residue(self, step: Step, peak: Peak) -> bool:
        """Whether a peak may be what a fitted step left over: the model is never quite right."""
        if abs(step.at.frame - peak.frame) > (self._strides + 1) * self._stride:
            return False
        start = step.start
        distance = math.hypot(start.x_px - peak.x_px, start.y_px - peak.y_px)
        on_top = distance < self._roi_px / 6
        if on_top and abs(step.at.frame - peak.frame) > self._stride:
            return False
        share = _RESIDUE if on_top else _RINGS
        return distance < 1.5 * self._roi_px and abs(peak.snr) < share * abs(start.snr)

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
        at = StepFrame(peak.frame, self._stride, 1.0, 1.0)
        return self._with_image(Step(sign, at, start, (0, 0), np.empty((0, 0))))

    def _with_image(self, step: Step) -> Step:
        """Draw the step's contrast anew."""
        scene, start = self._scene, step.start
        half = self._half(step)
        spans = []
        for centre, size in zip((start.y_px, start.x_px), self._chunk.shape, strict=True):
            middle = round(centre)
            spans.append((max(middle - half, 0), min(middle + half + 1, size)))
        grid = PixelGrid.region(spans[0], spans[1], scene.pixel_nm)
        pixel = scene.pixel_nm
        image = scene.wide.image(
            grid, start.x_px * pixel, start.y_px * pixel, start.z_nm, start.mass_kda
        )
        return replace(step, corner=(spans[0][0], spans[1][0]), image=image)

    def _half(self, step: Step) -> int:
        """From the centre to the edge of a step's image [pixels]; strong rings reach far."""
        return round(self._roi_px * min(max(step.start.snr / _FAINT_SNR, 1.0), LARGEST_IMAGE))

    # ---- neighbours ------------------------------------------------------------------------

    def _overlaps(self, step: Step, start: int, stop: int) -> bool:
        """Whether a step lies inside frames relative to the chunk."""
        return start < step.at.frame - self._chunk.first < stop

    def _presence(self, step: Step, frames: slice) -> float:
        """Share of the frames' light that shines while the particle is there."""
        power = self._power
        whole = power[frames.stop] - power[frames.start]
        if whole <= 0:
            return 0.0
        turn = min(max(step.at.frame - self._chunk.first, frames.start), frames.stop)
        later = (power[frames.stop] - power[turn]) / whole
        return float(later if step.sign > 0 else 1 - later)

    def _factor(self, step: Step, image: FloatArray, before: slice, after: slice) -> FloatArray:
        """Light after over light before that a step's particle makes, pixel by pixel."""
        factor: FloatArray = (1 + self._presence(step, after) * image) / (
            1 + self._presence(step, before) * image
        )
        return factor

    def _change(self, step: Step, before: slice, after: slice) -> FloatArray:
        """Contrast that a step's particle makes between two ranges of frames."""
        image = step.image
        if abs(step.start.mass_kda * self._contrast_per_kda) > _WEAK:
            return self._factor(step, image, before, after) - 1
        return (self._presence(step, after) - self._presence(step, before)) * image

    def _neighbourhood(self, steps: Sequence[Step]) -> tuple[list[list[int]], list[list[int]]]:
        """For each step, others that its fit should know of, and those that it depends on."""
        x, y, frame = (
            np.array(values, dtype=float)
            for values in zip(
                *((s.start.x_px, s.start.y_px, s.at.frame) for s in steps), strict=True
            )
        )
        reach = np.array([self._half(s) for s in steps]) + self._roi_px / 2 + 2
        seen, bound = [], []
        for i in range(len(steps)):
            dt = np.abs(frame - frame[i])
            dx, dy = np.abs(x - x[i]), np.abs(y - y[i])
            near = (dt < 3 * self._window) & (np.maximum(dx, dy) < reach)
            near[i] = False
            seen.append([int(k) for k in np.flatnonzero(near)])
            near &= (dt < 2 * self._window) & (np.hypot(dx, dy) < self._roi_px / 2)
            bound.append([int(k) for k in np.flatnonzero(near)])
        return seen, bound

    def _shared(self, step: Step, region: Region) -> tuple[Region, FloatArray] | None:
        """Part of a step's image inside a region."""
        rows, columns = _spans(step.corner, step.image.shape)
        top, bottom = max(rows[0], region.rows[0]), min(rows[1], region.rows[1])
        left, right = max(columns[0], region.columns[0]), min(columns[1], region.columns[1])
        if top >= bottom or left >= right:
            return None
        inside = step.image[
            top - rows[0] : bottom - rows[0], left - columns[0] : right - columns[0]
        ]
        return Region((top, bottom), (left, right)), inside

    # ---- one step --------------------------------------------------------------------------

    def _improve(
        self, steps: Sequence[Step], chosen: set[int], near: Sequence[Sequence[int]]
    ) -> list[Step]:
        """Fit the chosen steps, each with the others as they were."""

        def one(index: int) -> Step:
            step = steps[index]
            task = self._task(index, steps, near)
            if task is None:
                return step
            likelihood = task.likelihood
            start = step.start
            box = search_box(
                likelihood, start, self._quick_mode, self._scene.config.fit.z_range_nm, level=True
            )
            theta = start_theta(likelihood, start) if step.theta is None else step.theta.copy()
            theta = np.where(box.free, np.clip(theta, box.lower, box.upper), theta)
            best = likelihood.maximize(theta, box.free, box.lower, box.upper)
            mass = float(likelihood.model.scale.mass(best.theta[3]))
            pixel = self._scene.pixel_nm
            if mass <= 0:
                return replace(step, at=task.at, snr=0.0)
            moved = replace(
                start,
                x_px=float(best.theta[0]) / pixel,
                y_px=float(best.theta[1]) / pixel,
                mass_kda=mass,
            )
            snr = math.sqrt(2 * max(best.log_likelihood, 0.0))
            return self._with_image(
                replace(step, at=task.at, start=moved, theta=best.theta, snr=snr)
            )

        improved = list(steps)
        for index, step in zip(sorted(chosen), self._pool.map(one, sorted(chosen)), strict=True):
            improved[index] = step
        return improved

    @property
    def _quick_mode(self) -> str:
        """Where z is free it is found last, from all heights at once."""
        return "mass" if "mass_kda" in FREE_PARAMETERS[self._scene.mode] else "localize"

    def _task(
        self, index: int, steps: Sequence[Step], near: Sequence[Sequence[int]]
    ) -> _Task | None:
        scene, chunk, step = self._scene, self._chunk, steps[index]
        region = _region(self._roi_px, chunk.shape, step.start)
        neighbours = [steps[i] for i in near[index]]
        limit_px = scene.config.detection.min_separation_nm / scene.pixel_nm
        close = [s for s in neighbours if _distance(s, step) < limit_px]
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
            shared = self._shared(other, region)
            if shared is not None:
                part, image = shared
                here = (
                    slice(part.rows[0] - region.rows[0], part.rows[1] - region.rows[0]),
                    slice(part.columns[0] - region.columns[0], part.columns[1] - region.columns[0]),
                )
                ratio[here] *= self._factor(other, image, *cuts)
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
        return _Task(likelihood, region, windows, at, n_before, n_after, crowded)

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
        shared = self._shared(step, region)
        if shared is None:
            return None
        _, image = shared
        if image.shape != (region.rows[1] - region.rows[0], region.columns[1] - region.columns[0]):
            return None
        known = np.zeros(len(patch.counts))
        frames = np.arange(patch.first, patch.first + known.size)
        for other in neighbours:
            both = self._shared(other, region) if _distance(other, step) < self._roi_px else None
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

    def _finish(
        self, index: int, steps: Sequence[Step], near: Sequence[Sequence[int]]
    ) -> FittedStep | None:
        """Fit a step for good and judge it."""
        scene, step = self._scene, steps[index]
        task = self._task(index, steps, near)
        if task is None:
            return None
        likelihood = task.likelihood
        if likelihood.n_pixels < 0.5 * math.prod(likelihood.grid.shape):
            return None
        fit = fit_particle(
            likelihood, step.start, scene.mode, scene.config.fit.z_range_nm, level=True
        )
        if fit.mass_kda <= 0 and "mass_kda" in fit.free:
            return None
        fit = _judged(scene, unbiased(likelihood, fit), task)
        local = Region(
            (0, task.region.rows[1] - task.region.rows[0]),
            (0, task.region.columns[1] - task.region.columns[0]),
        )
        event = Event(local, fit, likelihood)
        if event.snr < _EXPLAINED * scene.templates.threshold:
            return None
        step = replace(step, at=task.at)
        return FittedStep(step, event, task.region, task.windows, task.n_before, task.n_after)

    def _credible(self, steps: Sequence[Step]) -> list[Step]:
        """Leave out what the others explain, and the weaker of two steps that describe one."""
        kept: list[Step] = []
        for step in sorted(steps, key=lambda s: -s.start.snr):
            if step.snr > _EXPLAINED * self._scene.templates.threshold and not any(
                s.sign == step.sign
                and _distance(s, step) < _SAME_PX
                and abs(s.at.frame - step.at.frame) <= max(2, s.at.half_width + step.at.half_width)
                for s in kept
            ):
                kept.append(step)
        return kept


def unbiased(likelihood: Likelihood, fit: FitResult) -> FitResult:
    """Take the first-order bias of maximum likelihood off the mass.

    A position that is fitted follows the noise to where it adds to the particle, so that the
    amplitude comes out too large by 1/SNR²: 1 % at 10.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    fit : FitResult
        Its estimate.

    Returns
    -------
    FitResult
        With mass and contrast corrected; `theta` stays where the likelihood has its maximum.

    Notes
    -----
    M. J. Box, J. R. Stat. Soc. B 33, 171 (1971): −½ F⁻¹ Σ w g tr(F⁻¹ H), g and H the gradient and
    the second derivatives of the expectation, here of ln(1 + C) plus the level.
    """
    if "mass_kda" not in fit.free or not np.all(np.isfinite(fit.covariance)):
        return fit
    theta, model = fit.theta, likelihood.model
    signal, first, second = model.amplitude_hessian(likelihood.grid, *(float(t) for t in theta[:4]))
    index = [i for i in range(5) if fit.box.free[i]]
    bright = 1 + signal
    gradient = np.ones((5, *signal.shape))
    gradient[:4] = first / bright
    hessian = np.zeros((5, 5, *signal.shape))
    hessian[:4, :4] = second / bright - gradient[:4, None] * gradient[None, :4]
    weight = likelihood.signal_information(signal) * bright**2
    gradient = gradient[index].reshape(len(index), -1)
    bend = hessian[np.ix_(index, index)].reshape(len(index), len(index), -1)
    fisher = (gradient * weight.ravel()) @ gradient.T
    unit = 1 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
    inverse = np.linalg.pinv(fisher * np.outer(unit, unit), hermitian=True) * np.outer(unit, unit)
    traces = np.einsum("ij,ijp->p", inverse, bend)
    bias = -0.5 * inverse @ (gradient @ (weight.ravel() * traces))
    shift = float(bias[index.index(3)]) * model.scale.slope(float(theta[3]))
    sigma = float(fit.sigma[3])
    if not math.isfinite(shift) or abs(shift) > sigma:
        return fit
    mass = fit.mass_kda - shift
    return replace(fit, mass_kda=mass, contrast=model.peak_contrast(fit.z_nm, mass))


def _judged(scene: Scene, fit: FitResult, task: _Task) -> FitResult:
    """Add the verdicts that need the neighbourhood."""
    rows, columns = np.nonzero(task.windows.saturated)
    dx = (columns + task.region.columns[0]) * scene.pixel_nm - fit.x_nm
    dy = (rows + task.region.rows[0]) * scene.pixel_nm - fit.y_nm
    flags = [
        *([Status.SATURATED] if np.any(np.hypot(dx, dy) < _SATURATION_NM) else []),
        *(f for f in fit.flags if f != Status.POOR_FIT),
        *([Status.TOO_CLOSE] if task.crowded else []),
        *(f for f in fit.flags if f == Status.POOR_FIT),
    ]
    return replace(fit, status=Status(flags[0]) if flags else Status.OK, flags=tuple(flags))


def _region(side: int, shape: tuple[int, int], start: Candidate) -> Region:
    spans = []
    for centre, size in zip((start.y_px, start.x_px), shape, strict=True):
        first = round(centre - (side - 1) / 2)
        spans.append((max(first, 0), min(first + side, size)))
    return Region(spans[0], spans[1])


def _spans(
    corner: tuple[int, int], shape: tuple[int, ...]
) -> tuple[tuple[int, int], tuple[int, int]]:
    return (corner[0], corner[0] + shape[0]), (corner[1], corner[1] + shape[1])


def _distance(one: Step, two: Step) -> float:
    return math.hypot(one.start.x_px - two.start.x_px, one.start.y_px - two.start.y_px)


def _apart(one: Step, two: Step) -> int:
    return abs(one.at.frame - two.at.frame)
