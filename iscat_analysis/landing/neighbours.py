"""Steps and what they do to each other's light.

A neighbour that lands or leaves in the frames of a step enters its likelihood through ρ, pixel by
pixel: the factor (1 + φ_a C)/(1 + φ_b C), φ the share of the light of the frames after and before
in which it is there.

Of two bright spheres the fields add up, and not their contrasts: with the fields e of all, the mean
light over frames is 1 + Σ φ_k C_k + Σ φ_kl 2 Re(e_k · e_l*), with φ_kl the share in which both are
there.

Where the sample drifts, a particle moves with it: the mean of C over a window is its expansion to
second order in the shift since the step, mean and smear.  In the pattern, whose motion is divided
out, it is held with the share f of the light that makes the pattern, which is taken off again:
(1 + φ_a C_a)/(1 + φ_b C_b) · (1 + f C_b)/(1 + f C_a).
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import derivatives
from iscat_analysis.fitting.context import AnalysisContext, farthest_px
from iscat_analysis.fitting.events import Region
from iscat_analysis.fitting.pattern import SPAN, MovingPattern
from iscat_analysis.last_used import LastUsed
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.sized import SeatedModel
from iscat_analysis.records import Candidate, ComplexArray, FitResult, FloatArray
from iscat_analysis.search.dating import StepFrame
from iscat_analysis.search.frames import Chunk
from iscat_analysis.search.sliding import MapArray
from iscat_analysis.search.templates import LARGEST_IMAGE

_IMAGE_BYTES = 40_000_000  # of the images of steps that a chunk holds
WHOLE = (slice(None), slice(None))
"""All of an image."""


_NUMBERS = count()


@dataclass(frozen=True)
class Drawn:
    """The image of a step, drawn where it is needed: a chunk has thousands."""

    rows: tuple[int, int]
    columns: tuple[int, int]
    draw: Callable[[], NDArray[np.floating]]
    held: LastUsed[NDArray[Any]]
    number: int = field(default_factory=_NUMBERS.__next__)  # by which it is held

    @property
    def image(self) -> MapArray:
        """Contrast in single precision, (y, x)."""
        return self._made("image", lambda: self.draw().astype(np.float32))

    @property
    def slopes(self) -> FloatArray:
        """Derivatives of the contrast, (5, y, x)."""
        return self._made("slopes", lambda: derivatives(self.image.astype(np.float64)))

    def measured(self, image: FloatArray) -> Drawn:
        """Give what the movie shows there."""
        kept = image.astype(np.float32)
        return Drawn(self.rows, self.columns, lambda: kept, self.held)

    def _made(self, kind: str, make: Callable[[], NDArray[Any]]) -> NDArray[Any]:
        """Give what is held of a kind, or make it."""
        values = self.held.get((self.number, kind))
        if values is None:
            values = make()
            self.held.hold((self.number, kind), values, values.nbytes)
        return values


@dataclass(frozen=True, eq=False)
class Step:
    """One particle that lands or leaves; one that was fitted again is another step."""

    sign: int
    at: StepFrame
    start: Candidate
    drawn: Drawn
    theta: FloatArray | None = None
    snr: float = math.inf
    excess: float = 0.0
    is_measured: bool = False  # its image is the movie's, and not the model's
    sphere: tuple[SeatedModel, FitResult] | None = None  # that it is, and not a dipole

    @property
    def corner(self) -> tuple[int, int]:
        """First row and first column of its image."""
        return self.drawn.rows[0], self.drawn.columns[0]

    @property
    def image(self) -> MapArray:
        """Its contrast, (y, x)."""
        return self.drawn.image


class Neighbours:
    """Which steps overlap, and the light of a step in the frames of another."""

    def __init__(
        self,
        context: AnalysisContext,
        chunk: Chunk,
        window: int,
        pattern: MovingPattern | None = None,
    ) -> None:
        self.context, self.chunk, self.window, self.pattern = context, chunk, window, pattern
        self.roi_px = context.roi_px
        self.stride = int(chunk.edges[1] - chunk.edges[0])
        self._farthest_px = farthest_px(context.config, chunk.shape)
        self.are_spheres = context.model.is_sized
        nominal = context.model.material.mass_kda
        self._contrast_per_kda = (
            context.model.peak_contrast(context.config.particle.nominal_height_nm, nominal)
            / nominal
        )
        self._power = np.concatenate([[0.0], np.cumsum(chunk.power)])
        self._images: LastUsed[NDArray[Any]] = LastUsed(_IMAGE_BYTES)

    def draw_sphere(
        self, sign: int, at: StepFrame, sphere: SeatedModel, fit: FitResult, excess: float = 0.0
    ) -> Step:
        """Make a step of a sphere, whose contrast is drawn where it is."""
        pixel = self.context.pixel_nm
        start = Candidate(fit.x_nm / pixel, fit.y_nm / pixel, fit.z_nm, fit.mass_kda, fit.snr)
        drawn = self.draw(sign, at, start, sphere)
        return replace(drawn, theta=fit.theta, snr=fit.snr, excess=excess, sphere=(sphere, fit))

    def draw(
        self, sign: int, at: StepFrame, start: Candidate, sphere: SeatedModel | None = None
    ) -> Step:
        """Make a step, whose contrast is drawn where it is."""
        context, half = self.context, self._half(start)
        sides = []
        for centre, size in zip((start.y_px, start.x_px), self.chunk.shape, strict=True):
            middle = round(centre)
            sides.append((max(middle - half, 0), min(middle + half + 1, size)))
        shown = at.frame + sign * self.window // 2

        def image() -> FloatArray:
            pixel = context.pixel_nm
            place = start.x_px * pixel, start.y_px * pixel
            model = context.wide_at(*place, shown, reach_px=half)
            if sphere is not None:
                model = sphere.in_place_of(model)
            grid = PixelGrid.region(sides[0], sides[1], pixel)
            return model.image(grid, *place, start.z_nm, start.mass_kda)

        drawn = Drawn(sides[0], sides[1], image, self._images)
        return Step(sign, at, start, drawn)

    def _half(self, start: Candidate) -> int:
        """From the centre to the edge of a step's image [pixels].

        Strong rings reach far, and fall as the square of the distance.
        """
        # up to which the image of one region and its surroundings is enough
        strength = max(start.snr / 30.0, 1.0)
        regions = min(strength, max(LARGEST_IMAGE, math.sqrt(strength * LARGEST_IMAGE)))
        return round(min(self.roi_px * regions, self._farthest_px))

    def reach_px(self, step: Step) -> float:
        """Farthest centre of a fitted square that holds pixels of a step's image."""
        return self._half(step.start) + self.roi_px / 2 + 2

    def overlaps(self, step: Step, start: int, stop: int) -> bool:
        """Whether a step lies inside frames relative to the chunk."""
        first = self.chunk.first
        return start < step.at.last_turn - first and step.at.first_turn - first < stop

    def presence(self, step: Step, frames: slice) -> float:
        """Share of the frames' light that shines while the particle is there."""
        power = self._power
        whole = power[frames.stop] - power[frames.start]
        if whole <= 0:
            return 0.0
        if step.at.rise:
            turns = np.clip(step.at.turns - self.chunk.first, frames.start, frames.stop)
            turned = power[turns].mean()
        else:
            turn = min(max(step.at.frame - self.chunk.first, frames.start), frames.stop)
            turned = power[turn]
        later = (power[frames.stop] - turned) / whole
        return float(later if step.sign > 0 else 1 - later)

    def _presences(self, step: Step) -> FloatArray:
        """Give `presence` in every block of the chunk, (blocks,)."""
        edges = self.chunk.edges
        turns = step.at.turns if step.at.rise else np.array([step.at.frame])
        turned = np.clip((turns - self.chunk.first)[:, None], edges[:-1], edges[1:])
        ends, whole = self._power[edges[1:]], np.diff(self._power[edges])
        later = (ends - self._power[turned].mean(axis=0)) / np.where(whole > 0, whole, 1.0)
        return np.asarray(later if step.sign > 0 else 1 - later)

    def in_blocks(self, frames: NDArray[np.int64]) -> Iterator[tuple[float, slice]]:
        """Divide frames as blocks do: the middle of each part, and it relative to the chunk."""
        for start in range(0, frames.size, self.stride):
            part = frames[start : start + self.stride]
            yield float(part.mean()), self.chunk.cut(int(part[0]), int(part[-1]) + 1)

    def light_in(self, frames: slice, steps: Iterable[Step]) -> FloatArray:
        """Give the factor by which steps change the light of frames, (y, x)."""
        light = np.ones(self.chunk.shape)
        for step in steps:
            light[self.box(step)] *= 1 + self.presence(step, frames) * step.image
        return light

    def box(self, step: Step) -> tuple[slice, slice]:
        """Pixels of the field that a step's image covers."""
        return slice(*step.drawn.rows), slice(*step.drawn.columns)

    def factor(
        self, step: Step, before: slice, after: slice, inside: tuple[slice, slice] = WHOLE
    ) -> FloatArray:
        """Light after over light before that a step's particle makes, pixel by pixel."""
        image = step.image[inside].astype(np.float64)
        shares = self.presence(step, before), self.presence(step, after)
        if self.pattern is None:
            return (1 + shares[1] * image) / (1 + shares[0] * image)
        blocks, windows = self._presences(step), (before, after)
        held = tuple(float(self.pattern.weights(before, after, w) @ blocks) for w in windows)
        if shares == held:
            return np.ones(image.shape)
        light = [
            (1 + share * self.seen(step, self._present(step, window), inside))
            / (1 + known * self.seen(step, window, inside))
            for window, share, known in zip(windows, shares, held, strict=True)
        ]
        return light[1] / light[0]

    def apply(
        self, ratio: FloatArray, step: Step, before: slice, after: slice, region: Region
    ) -> None:
        """Multiply the pixels of a region that a step's image covers with `factor`."""
        if self.pattern is None and not self.overlaps(step, before.start, after.stop):
            return  # there in all of these frames, or in none
        shared = self.shared(step, region)
        if shared is not None:
            here, inside = shared
            ratio[here] *= self.factor(step, before, after, inside)

    def interfere(
        self,
        ratio: FloatArray,
        step: Step,
        others: Sequence[Step],
        before: slice,
        after: slice,
        region: Region,
    ) -> None:
        """Multiply by what the fields of bright spheres make of each other's light.

        The contrasts of all of them, that of the step included, are in the ratio and the model.
        """
        if not self.are_spheres or self.pattern is not None:
            return
        shown = [step, *(s for s in others if self._is_seen_beside(s, step, region))]
        fields = [self._field(s, region) for s in shown]
        contrasts = [2 * e[0].real + np.sum(np.abs(e) ** 2, axis=0) for e in fields]
        light = []
        for frames in (before, after):
            total, product = 1.0, 1.0
            for k, one in enumerate(shown):
                share = self.presence(one, frames)
                total = total + share * contrasts[k]
                product = product * (1 + share * contrasts[k])
                for one_field, other in zip(fields[:k], shown, strict=False):
                    both = self._together(one, other, frames)
                    total = total + both * _crossed(one_field, fields[k])
            light.append(total / product)
        ratio *= light[1] / light[0]

    def crossed(self, step: Step, other: Step, region: Region) -> FloatArray | float:
        """Give what the fields of two bright spheres make of each other's light."""
        if not self.are_spheres or not self._is_seen_beside(other, step, region):
            return 0.0
        return _crossed(self._field(step, region), self._field(other, region))

    def _is_seen_beside(self, other: Step, step: Step, region: Region) -> bool:
        """Whether the light that two fields make together is more than noise."""
        shared = self.shared(other, region)
        if shared is None:
            return False
        # contrast of a neighbour times the step's, below which fields do not meet
        return bool(np.abs(other.image[shared[1]]).max() * step.start.snr > 0.5)

    def _field(self, step: Step, region: Region) -> ComplexArray:
        """Field of a step's particle over the reference, (1 or 2, y, x)."""
        pixel, start = self.context.pixel_nm, step.start
        place = start.x_px * pixel, start.y_px * pixel
        grid = PixelGrid.region(region.rows, region.columns, pixel)
        dx, dy = np.meshgrid(grid.x_nm - place[0], grid.y_nm - place[1])
        model = self.context.wide_at(*place, step.at.frame + step.sign * self.window // 2)
        return model.field(dx, dy, start.z_nm, start.mass_kda)

    def _together(self, one: Step, other: Step, frames: slice) -> float:
        """Share of the frames' light that shines while both particles are there."""
        shares = self.presence(one, frames), self.presence(other, frames)
        return min(shares) if one.sign == other.sign else max(sum(shares) - 1, 0.0)

    def own_factor(
        self, step: Step, before: slice, after: slice, inside: tuple[slice, slice]
    ) -> FloatArray:
        """`factor` of the step that is fitted, but for its image at its mean place in a window."""
        with_it = after if step.sign > 0 else before
        model = 1 + self.seen(step, with_it, inside, smeared=False)
        return self.factor(step, before, after, inside) / model**step.sign

    def change(self, step: Step, before: slice, after: slice) -> tuple[NDArray[np.floating], float]:
        """Contrast that a step's particle makes between ranges of frames: a multiple of an image.

        A weak one has the same image, its own, at all times.
        """
        # contrast up to which several add up
        strong = abs(step.start.mass_kda * self._contrast_per_kda) > 0.05
        if strong or step.is_measured or self.pattern is not None:
            return self.factor(step, before, after) - 1, 1.0
        return step.image, self.presence(step, after) - self.presence(step, before)

    def add_change(self, total: FloatArray, step: Step, before: slice, after: slice) -> None:
        """Add to a field the contrast that a step's particle makes between ranges of frames."""
        image, share = self.change(step, before, after)
        total[self.box(step)] += share * image

    def _present(self, step: Step, frames: slice) -> slice:
        """Select the frames in which the particle is there; all frames if it is in none."""
        turn = min(max(step.at.frame - self.chunk.first, frames.start), frames.stop)
        part = slice(turn, frames.stop) if step.sign > 0 else slice(frames.start, turn)
        return part if part.start < part.stop else frames

    def seen(
        self, step: Step, frames: slice, inside: tuple[slice, slice], *, smeared: bool = True
    ) -> FloatArray:
        """Mean of a moving particle's contrast over frames, or its contrast at the mean place."""
        image = step.image[inside].astype(np.float64)
        if self.pattern is None:
            return image
        (y, x), (yy, yx, xx) = self.pattern.moments(frames, step.at.frame)
        if not smeared:
            yy, yx, xx = y * y, y * x, x * x
        return np.asarray(
            image
            + np.einsum(
                "k,kyx->yx", [-y, -x, yy / 2, yx, xx / 2], step.drawn.slopes[(slice(None), *inside)]
            )
        )

    def of(
        self, steps: Sequence[Step], frames: int = 0
    ) -> tuple[list[array[int]], list[array[int]]]:
        """List for each step the others that its fit must include, and those that it depends on.

        Others are near in time within the windows, or within `frames` if these are more.
        """
        x, y, frame = np.array([(s.start.x_px, s.start.y_px, s.at.frame) for s in steps]).T
        reach = np.array([self.reach_px(s) for s in steps])
        windows = SPAN if self.pattern is None else self.pattern.windows
        seen, bound = [], []
        for i in range(len(steps)):
            dt = np.abs(frame - frame[i])
            dx, dy = np.abs(x - x[i]), np.abs(y - y[i])
            close = dt < max((1 + windows) * self.window, frames)
            close |= self.are_spheres  # what stands there all the time has a field too
            near = close & (np.maximum(dx, dy) < reach)
            near[i] = False
            seen.append(array("i", np.flatnonzero(near).tolist()))
            near &= (dt < 2 * self.window) & (np.hypot(dx, dy) < self.roi_px / 2)
            bound.append(array("i", np.flatnonzero(near).tolist()))
        return seen, bound

    def shown(self, step: Step, region: Region) -> tuple[tuple[slice, slice], FloatArray] | None:
        """Which pixels of a region show a step, and its contrast there, as frames are corrected."""
        shared = self.shared(step, region)
        if self.context.lines is None:
            return None if shared is None else (shared[0], step.image[shared[1]].astype(np.float64))
        total = np.zeros(self.chunk.shape)
        total[self.box(step)] = step.image
        return WHOLE, self.context.left(total)[region.slices]

    def shared(
        self, step: Step, region: Region
    ) -> tuple[tuple[slice, slice], tuple[slice, slice]] | None:
        """Where a step's image and a region overlap: in the region, and in the image."""
        (y, below), (x, beyond) = step.drawn.rows, step.drawn.columns
        (first, last), (begin, end) = region.rows, region.columns
        top, bottom = max(y, first), min(below, last)
        left, right = max(x, begin), min(beyond, end)
        if top >= bottom or left >= right:
            return None
        here = slice(top - first, bottom - first), slice(left - begin, right - begin)
        return here, (slice(top - y, bottom - y), slice(left - x, right - x))


def _crossed(one: ComplexArray, two: ComplexArray) -> FloatArray:
    """Light that two fields make together beyond that of each."""
    return np.asarray(2 * np.sum(one * np.conj(two), axis=0).real)


def distance_px(one: Step, two: Step) -> float:
    """Distance between two steps."""
    return math.hypot(one.start.x_px - two.start.x_px, one.start.y_px - two.start.y_px)
