"""The likelihood of all particles that move over an unknown, constant background.

The counts n of pixel p in frame t are Poisson with w_t B_p (1 + C_tp), C the sum of the signals of
all particles.  Given their sum over the frames the counts of a pixel are multinomial with
p_t ∝ w_t (1 + C_tp), from which B has dropped out.  The score of that likelihood is the Poisson
score with the background that is most likely given the particles,

    B̂_p = Σ_t n_tp / Σ_t w_t (1 + C_tp),

put in (envelope theorem), so that fitting the particles over B̂ and B̂ under the particles in turn
ends at its maximum, and nothing is left of the particles in their background.  Turns alone converge
as slowly as the particles move.  How the rows follow a change of the background is known from their
informations, so that Newton's method sees where the turns would end (`fit_jointly`).

Nearly all rows converge by plain Fisher scoring.  The kernel of the search with a step control is
compiled only when the first row needs it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.background_response import Slopes
from iscat_analysis._kernels.canvas import (
    Brush,
    Canvas,
    Counts,
    Field,
    Light,
    Pictures,
    Rows,
    add_squares,
    draw_frames,
    subtract_expected,
)
from iscat_analysis._kernels.lens import LatticeLens, RoundLens, StampLens
from iscat_analysis._kernels.moving import Fits, Room, Scene, Search, Totals, fit_frames
from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.scoring import CONVERGED, maximize
from iscat_analysis._kernels.track_precision import Judgements, judge_frames
from iscat_analysis.inference.fit import window_nm
from iscat_analysis.inference.laws import POISSON
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.model import blurred, spreads
from iscat_analysis.optics.pixels import BAND, RINGS, sample_picture, weights_between
from iscat_analysis.optics.waves import axial_table
from iscat_analysis.records import BoolArray, FloatArray, IntArray, Mapper
from iscat_analysis.tracking.rows import BackgroundEstimate, Judged, Localizations, Response


@dataclass(frozen=True)
class Exposures:
    """Counts, and what they stand for."""

    counts: Counts
    gain: float = 1.0
    offset: float = 0.0

    def electrons(self, *where: slice | int) -> NDArray[np.float32]:
        """Give the photoelectrons of some frames."""
        out = np.asarray(np.subtract(self.counts[where], self.offset, dtype=np.float32))
        out *= np.float32(self.gain)
        return out

    def in_electrons(self, sums: Any, of: int) -> FloatArray:
        """Convert sums of counts."""
        return np.asarray(self.gain * (sums - of * self.offset))


def _at_one_height(model: ForwardModel, pixel_nm: float, half_px: float, band: float) -> Pictures:
    """Sharp picture at the model's height."""
    lens, samples = sample_picture(model, pixel_nm, half_px, band)
    nodes, heights = samples.astype(np.float32), samples.reshape(1, 1, 1, 2, -1)
    return Pictures(heights, 0.0, 1.0, 0.0, lens, lens.window[None], nodes)


def _blurred(sharp: Pictures, band: float, variances_nm2: FloatArray) -> Pictures:
    """Give a picture at one height the weights of every blur."""
    inverse = sharp.lens.inv_step

    def window(variance_nm2: float) -> FloatArray:
        parts = spreads(variance_nm2, each_axis=True)
        return sum((n * weights_between(v * inverse**2, band) for n, v in parts), np.zeros(1))

    return sharp._replace(windows=np.stack([window(q) for q in variances_nm2.tolist()]))


def _along_z(
    model: ForwardModel, variances_nm2: FloatArray, z_range_nm: tuple[float, float]
) -> Pictures:
    """Tables of a model for every blur, along z."""
    tables = [
        axial_table(blurred(model, float(q), upwards=True).wave, z_range_nm) for q in variances_nm2
    ]
    heights = np.stack([table.heights for table in tables])
    one, lens = tables[0], model.lens
    window = np.zeros((1, 0, 0)) if isinstance(lens, RoundLens) else lens.window[None]
    return Pictures(
        heights, one.first_nm, one.step_nm, one.kappa, lens, window, np.zeros((2, 0, 0))
    )


def blank(room: NDArray[np.float32], rows: Localizations) -> Canvas:
    """Make an empty canvas.

    Shapes: `room` (t, y, x).
    """
    nothing = np.zeros(len(room), dtype=bool)
    return Canvas(room, np.zeros_like(rows.theta), np.zeros_like(rows.theta), nothing)


def room_for(field: Field, near: Pictures, free: BoolArray) -> Room:
    """Allocate the scratch memory of the kernels that fit rows.

    Shapes: `free` (5,).
    """
    index, area = np.flatnonzero(free[:4]), field.side**2
    pixels, line = np.empty(15 * area, near.nodes.dtype), np.empty(area, np.float32)
    work = np.empty(0 if isinstance(near.lens, StampLens) else 10 * area)
    small, ways = np.empty((11, 5)), np.empty((4, index.size))
    return Room(pixels, line, _profile(near, 2), index, small, ways, work)


def _profile(pictures: Pictures, orders: int) -> FloatArray:
    """Make room for a profile, as `iscat_analysis._kernels.scoring.blank_profile` does."""
    lens, (channels, width) = pictures.lens, pictures.heights.shape[3:]
    if isinstance(lens, StampLens):
        return np.empty((0, 0, 0))
    if isinstance(lens, LatticeLens):
        return np.empty((orders * channels, 2 * lens.half + 1, 2 * lens.half + 1))
    return np.empty((width // POWERS, POWERS, orders * channels))


def fit_with_search(
    field: Field, near: Pictures, search: Search, place: IntArray, room: Room, rows: Rows
) -> tuple[float, int]:
    """Fit a row whose plain steps diverge; its θ is overwritten with the estimate.

    Returns its log-likelihood over that without the particle, and how the fit ended.
    """
    row, top, bottom, left, right = place[2:].tolist()
    group, shape, start = int(rows.group[row]), (4, bottom - top, right - left), room.small[10]
    data = room.pixels[: math.prod(shape)].reshape(shape).astype(np.float64)
    heights = near.heights[min(group, len(near.heights) - 1)]
    table = heights, near.first_nm, near.step_nm, near.kappa
    lens = near.lens
    if not isinstance(lens, RoundLens):
        lens = lens._replace(window=near.windows[min(group, len(near.windows) - 1)])
    x, y, offsets, weights = field.pixels
    pixels = x[left:right], y[top:bottom], offsets, weights
    lower = np.maximum(search.lower, start - search.reach)
    upper = np.minimum(search.upper, start + search.reach)
    box = search.free, lower, upper, search.max_step, search.tolerance, search.passes, -math.inf
    picture, theta = (table, tuple(lens), pixels), rows.theta[row]
    value, _, outcome, _ = maximize(picture, (POISSON.code, data), box, (0.0, 0.0), theta)
    return value, outcome


DRAWN = 4
"""Side of the square in which a particle is drawn, over that in which it is fitted."""

COARSE = 2
"""Of the fitted square's side, by which it is cut while particles are still being looked for."""

BLOCK = 32
"""Frames that one thread takes at a time."""

_SLACK = np.array([0.1, 0.1, 0.01, 0.05])
"""How far particles may go from their rings: pixels, wavelengths, relative."""
_NO_LIMIT = 1e300


class MovingField:
    """A movie in memory, and the pictures of the particles that move in it."""

    def __init__(
        self,
        exposures: Exposures,
        read_e2: FloatArray,
        used: BoolArray,
        near: ForwardModel,
        far: ForwardModel,
        *,
        pixel_nm: float,
        roi_px: int,
        z_range_nm: tuple[float, float] | None,
        pool: ThreadPoolExecutor,
        saturated: BoolArray | None = None,
    ) -> None:
        self.exposures, self.used = exposures, used
        self.saturated = np.zeros_like(used) if saturated is None else saturated
        self.read_e2 = np.ascontiguousarray(np.broadcast_to(read_e2, used.shape), dtype=float)
        self.pixel_nm, self.roi_px = pixel_nm, roi_px
        self._pool, self._models, self._z_range_nm = pool, (near, far), z_range_nm
        self._room_of_slopes = np.empty(0, dtype=np.int16)
        self._drawn: tuple[Localizations, Canvas, bool] | None = None
        rows, columns = used.shape
        wavelength = near.optics.wavelength_nm
        resolution = wavelength / near.optics.na
        drawn, beyond = DRAWN * roi_px, pixel_nm / 2 + resolution  # where a particle is still seen
        along_z = z_range_nm is not None
        if along_z:  # rings reach farther, but tables end in the corners of the square
            beyond = max(beyond, roi_px * pixel_nm / 4)
            drawn = min(drawn, 2 * int(far.reach_nm / (math.sqrt(2) * pixel_nm) - 1))
        pixels = near.pixels(PixelGrid.region((0, rows), (0, columns), pixel_nm))
        slack = _SLACK * np.array([pixel_nm, pixel_nm, wavelength, 1.0])
        self._whole = Field(pixels, pixel_nm, roi_px, drawn, slack, along_z)
        self._coarse = self._whole  # the rings tell one fringe from the next
        if not along_z:
            self._coarse = Field(pixels, pixel_nm, roi_px // COARSE, roi_px, slack, True)
        self.free = np.array([True, True, along_z, True, False])
        self.fringe_nm = near.fringe_nm
        self.heights_nm = low, high = z_range_nm or (near.height_nm, near.height_nm)
        largest = 100 * abs(near.scale.amplitude(near.material.mass_kda))
        right, bottom = (columns - 1) * pixel_nm + beyond, (rows - 1) * pixel_nm + beyond
        reach = window_nm(pixel_nm)
        self._search = Search(
            free=self.free,
            reach=np.array([reach, reach, _NO_LIMIT, _NO_LIMIT, 0.0]),
            lower=np.array([-beyond, -beyond, low, 0.0 if along_z else -largest, 0.0]),
            upper=np.array([right, bottom, high, largest, 0.0]),
            max_step=np.array([0.25, 0.25, 0.1, _NO_LIMIT, 1.0]) * [*[wavelength] * 3, 1.0, 1.0],
            tolerance=2e-4,  # as in `Likelihood.maximize`
            passes=40,
        )
        near_px = (roi_px + 1) / 2 + _SLACK[0] + reach / pixel_nm
        seen_px = max(rows, columns) + resolution / pixel_nm
        self._reaches_px = (near_px, BAND), (min((drawn + 1) / 2, seen_px) + 1, RINGS)
        self.set_blurs(np.zeros(1))

    @cached_property
    def _sharp(self) -> list[tuple[Pictures, float]]:
        """Sharp pictures at the model's height, to fit and to draw, with their bands."""
        far, pixel = self._models[1], self.pixel_nm
        return [(_at_one_height(far, pixel, *reach), reach[1]) for reach in self._reaches_px]

    @cached_property
    def _room(self) -> NDArray[np.float32]:
        """Of the canvas, shape (t, y, x)."""
        return np.empty(self.exposures.counts.shape, dtype=np.float32)

    @cached_property
    def total_e(self) -> FloatArray:
        """Photoelectrons of all frames, shape (y, x) [e]."""
        counts = self.exposures.counts
        total = self.sum_of(
            lambda first: np.sum(counts[first : first + BLOCK], axis=0, dtype=np.float64)
        )
        return self.exposures.in_electrons(total, self.frames)

    @cached_property
    def frame_totals(self) -> FloatArray:
        """Photoelectrons in the used pixels of each frame, shape (t,) [e]."""
        counts = self.exposures.counts
        total = counts.sum(axis=(1, 2), dtype=np.float64)
        total -= counts[:, ~self.used].sum(axis=1, dtype=np.float64)
        return self.exposures.in_electrons(total, int(self.used.sum()))

    @property
    def mapper(self) -> Mapper:
        """`map` in threads."""
        return self._pool.map

    @property
    def frames(self) -> int:
        """Frames in the movie."""
        return len(self.exposures.counts)

    def renew(self, block: Callable[[int, int], NDArray[Any]]) -> None:
        """Replace the frames."""

        def put(part: int) -> None:
            first, last = part * BLOCK, min((part + 1) * BLOCK, self.frames)
            self.exposures.counts[first:last] = block(first, last)

        self.share(put, math.ceil(self.frames / BLOCK))
        for told in ("total_e", "frame_totals"):
            self.__dict__.pop(told, None)
        self.draw_anew()

    def set_blurs(self, variances_nm2: FloatArray) -> None:
        """Make the pictures of blurs, which `Localizations.group` numbers.

        Shapes: `variances_nm2` (groups,).
        """
        if self._z_range_nm is None:
            near, far = (_blurred(*sharp, variances_nm2) for sharp in self._sharp)
        else:
            along = variances_nm2, self._z_range_nm
            near, far = (_along_z(model, *along) for model in self._models)
        self._pictures = near, far
        self.draw_anew()

    def fit(
        self,
        ground: BackgroundEstimate,
        rows: Localizations,
        *,
        sweeps: int = 1,
        coarse: bool = False,
    ) -> tuple[Localizations, BackgroundEstimate, BoolArray]:
        """Fit every row over a background, and estimate the background under the rows.

        In the last fit, rows that overlap are corrected for each other's changes.  The response of
        all rows to a change of the background is kept: `response` tells where turns would end.

        Shapes: `converged` (n,).
        """
        light, canvas = self._light(ground), self._canvas_for(rows, coarse=coarse)
        side = (self._coarse if coarse else self._whole).side if sweeps else 0
        slopes = self._slopes_of(len(rows.frame), side)
        fitted, done, expected, sums = self._fit_frames(
            light, rows, canvas, slopes, sweeps=sweeps, coarse=coarse
        )
        self._drawn = fitted, canvas, coarse
        if sweeps:
            own = np.ascontiguousarray(fitted.fisher[:, self.free[:4]][:, :, self.free[:4]])
            starts = rows.starts(self.frames)
            self.response = Response(
                slopes, starts, light, canvas.total, own, self._search, self._pool
            )
            if not coarse:  # among rows that are only tried some would be pushed away
                fitted = self.response.together(fitted)
        stretch = ground.power.sum() + sums
        level = np.where(stretch > 0, self.total_e / np.where(stretch > 0, stretch, 1.0), 1.0)
        expected += light.background.sum()
        lit = expected > 0
        power = np.where(lit, self.frame_totals / np.where(lit, expected, 1.0), 1.0)
        return fitted, BackgroundEstimate(np.maximum(level, 1e-3), power / power.mean()), done

    def refit(
        self, ground: BackgroundEstimate, rows: Localizations, *, sweeps: int
    ) -> tuple[Localizations, BoolArray]:
        """Fit all particles of a few frames in the smaller square.

        Shapes: `converged` (n,).
        """
        times, frame = np.unique(rows.frame, return_inverse=True)
        light = self._light(ground)
        light = light._replace(counts=light.counts[times], power=light.power[times])
        canvas, slopes = (
            blank(np.empty_like(self._room[times]), rows),
            self._slopes_of(len(frame), 0),
        )
        some = replace(rows, frame=frame)
        fitted, done, *_ = self._fit_frames(
            light, some, canvas, slopes, sweeps=sweeps, coarse=True, at_once=4
        )
        return replace(fitted, frame=rows.frame), done

    def _fit_frames(
        self,
        light: Light,
        rows: Localizations,
        canvas: Canvas,
        slopes: Slopes,
        *,
        sweeps: int,
        coarse: bool,
        at_once: int = BLOCK,
    ) -> tuple[Localizations, BoolArray, FloatArray, FloatArray]:
        """Draw the rows of frames, and fit each of them `sweeps` times.

        Returns the rows, which fits converged, the signal of all rows in every frame, and its sum
        over the frames.
        """
        # a tolerance of 0.02 where the next turn goes on with the fit
        search = self._search if sweeps > 1 else self._search._replace(tolerance=0.02)
        n, frames = len(rows.frame), len(light.counts)
        particles = Rows(rows.starts(frames), rows.theta.copy(), rows.group)
        fits = Fits(np.full(n, CONVERGED, np.int64), np.zeros((n, 4, 4)), np.empty(n))
        expected, background = np.zeros(frames), light.background.astype(np.float32)

        def some(first: int) -> NDArray[np.float32]:
            last = min(first + at_once, frames)
            field, near = self._paint(particles, (first, last), canvas, coarse=coarse)
            room = room_for(field, near, self.free)
            scene = Scene(light, field, near, canvas, slopes, room)
            totals = Totals(background, expected, np.zeros(self.used.shape, dtype=np.float32))
            place = np.array([first, 0, particles.starts[first], 0, 0, 0, 0])
            while not fit_frames(scene, search, particles, (last, sweeps), fits, totals, place):
                row = int(place[2])
                fits.gain[row], fits.outcome[row] = fit_with_search(
                    field, near, search, place, room, particles
                )
            return totals.sums

        sums = self.sum_of(some, frames, at_once)
        if sweeps:
            snr = np.sqrt(2 * np.maximum(fits.gain, 0.0))
            rows = replace(rows, theta=particles.theta, fisher=fits.information, snr=snr)
        return rows, fits.outcome == CONVERGED, expected, sums

    def draw_anew(self) -> None:
        """Mark all pictures to be drawn again in the next pass."""
        self._drawn = None

    def draw(
        self, ground: BackgroundEstimate, rows: Localizations, *, coarse: bool = True
    ) -> NDArray[np.float32]:
        """Draw the rows of all frames, so that `residual` only has to subtract them.

        Shapes: result (t, y, x).
        """
        self.draw_anew()  # rings that stayed where rows were before are not good enough
        self.fit(ground, rows, sweeps=0, coarse=coarse)
        return self._room

    def residual(
        self, ground: BackgroundEstimate, rows: Localizations, first: int, last: int
    ) -> NDArray[np.float32]:
        """Give the counts of some frames minus their expectation.

        Shapes: result (last - first, y, x).
        """
        if self._drawn is not None and self._drawn[0] is rows and self._drawn[2]:
            signal = self._drawn[1].total[first:last]
        else:
            within = rows.only((rows.frame >= first) & (rows.frame < last))
            canvas = blank(np.empty_like(self._room[first:last]), within)
            starts = np.searchsorted(within.frame, np.arange(first, last + 1)).astype(np.int64)
            particles = Rows(starts, within.theta, within.group)
            self._paint(particles, (0, last - first), canvas, coarse=True)
            signal = canvas.total
        left = np.empty_like(signal)
        subtract_expected(self._light(ground), signal, first, left)
        return left

    def superposed(
        self,
        ground: BackgroundEstimate,
        rows: Localizations,
        which: IntArray,
        corner: IntArray,
        owner: IntArray,
        side: int,
    ) -> FloatArray:
        """Sum squares around some rows by their owners, after all rows are subtracted.

        Shapes: `which` (n,), `corner` (n, 2), `owner` (n,), result (3, owners, side, side): what is
        left over, the light, and the variance of read noise.
        """
        total, light = self.draw(ground, rows), self._light(ground)
        out = np.zeros((int(owner.max()) + 1, 3, side, side))

        def add(number: int) -> None:
            mine = np.flatnonzero(owner == number)
            frame, place = rows.frame[which[mine]], np.ascontiguousarray(corner[mine])
            add_squares(light, total, frame, place, owner[mine], out)

        self.share(add, len(out))
        return np.moveaxis(out, 1, 0)

    def judge(self, ground: BackgroundEstimate, rows: Localizations) -> Judged:
        """Compute the information on every row."""
        n, light = len(rows.frame), self._light(ground)
        particles = Rows(rows.starts(self.frames), rows.theta, rows.group)
        fisher, (turned, ways) = np.zeros((n, 4, 4)), np.full((2, n, 4, 4), np.nan)
        bias, numbers = np.zeros((n, 4)), np.zeros((n, 6))
        out = Judgements(fisher, turned, ways, bias, numbers)
        canvas, slopes = self._canvas_for(rows, coarse=False), self._slopes_of(n, self._whole.side)

        def some(part: int) -> None:
            span = part * BLOCK, min((part + 1) * BLOCK, self.frames)
            field, near = self._paint(particles, span, canvas, coarse=False)
            scene = Scene(light, field, near, canvas, slopes, room_for(field, near, self.free))
            judge_frames(scene, self.free, particles, *span, out)

        self.share(some, math.ceil(self.frames / BLOCK))
        index = np.flatnonzero(self.free[:4])
        part = np.ix_(np.arange(n), index, np.arange(index.size))
        good = np.isfinite(turned[part]).all(axis=(1, 2))
        v, ov = ways[part][good], turned[part][good]
        o = ov @ np.linalg.inv(v)
        observed, shift = np.full(fisher.shape, np.nan), np.zeros(bias.shape)
        observed[np.ix_(good, index, index)] = (o + np.swapaxes(o, 1, 2)) / 2
        shift[np.ix_(good, index)] = np.einsum("nik,njk,nj->ni", v, v, bias[good][:, index])
        return Judged(fisher, observed, shift, slopes, *numbers.T)

    def sum_of(
        self,
        block: Callable[[int], NDArray[np.floating[Any]]],
        frames: int | None = None,
        at_once: int = BLOCK,
    ) -> FloatArray:
        """Run a function on blocks of frames and sum the results in order."""
        firsts = range(0, self.frames if frames is None else frames, at_once)
        total: FloatArray = np.zeros(())
        for part in self.mapper(block, firsts):
            total = total + part.astype(np.float64)
        return total

    def share(self, task: Callable[[int], None], count: int) -> None:
        """Run numbered tasks in threads."""
        list(self.mapper(task, range(count)))

    def holds(self, theta: FloatArray) -> BoolArray:
        """Tell which positions are in the field.

        Shapes: `theta` (..., 5), result (...).
        """
        rows, columns = self.used.shape
        places = theta[..., :2] / self.pixel_nm
        within = (places >= -0.5) & (places < np.array([columns, rows]) - 0.5)
        return np.asarray(within.all(axis=-1))

    def on_wall(self, rows: Localizations) -> BoolArray:
        """Tell which rows ended at a limit of the search.

        Shapes: result (n,).
        """
        search = self._search
        near = (rows.theta <= search.lower + 1e-6) | (rows.theta >= search.upper - 1e-6)
        near[:, 3] &= rows.theta[:, 3] >= search.upper[3]  # no mass is the end of none
        return np.asarray((near & self.free).any(axis=1))

    def _paint(
        self, rows: Rows, span: tuple[int, int], canvas: Canvas, *, coarse: bool
    ) -> tuple[Field, Pictures]:
        """Update a range of frames of the canvas to the current rows.

        Returns the squares and the pictures in which they are fitted.
        """
        field, (near, far) = self._coarse if coarse else self._whole, self._pictures
        if coarse and not self.free[2]:
            far = near  # where little is drawn
        room = np.empty(max(field.drawn, field.side) ** 2, near.nodes.dtype)
        brushes = (Brush(pictures, _profile(pictures, 1), room) for pictures in (near, far))
        draw_frames(field, *brushes, rows, *span, canvas)
        return field, near

    def _light(self, ground: BackgroundEstimate) -> Light:
        level, read = (np.where(self.used, part, 0.0) for part in (ground.level, self.read_e2))
        shot = self.exposures
        return Light(shot.counts, shot.gain, shot.offset, ground.power, level, read)

    def _canvas_for(self, rows: Localizations, *, coarse: bool) -> Canvas:
        """Give the canvas, with the frames marked in which it holds other rows than these."""
        canvas = blank(self._room, rows)
        if self._drawn is not None and self._drawn[2] == coarse:
            old, last, _ = self._drawn
            here, there = rows.starts(self.frames), old.starts(self.frames)
            same = np.diff(here) == np.diff(there)
            mine = np.flatnonzero(np.repeat(same, np.diff(here)))
            theirs = np.flatnonzero(np.repeat(same, np.diff(there)))
            other = rows.group[mine] != old.group[theirs]
            other |= rows.track[mine] != old.track[theirs]
            same[rows.frame[mine[other]]] = False
            canvas.rings[mine], canvas.squares[mine] = last.rings[theirs], last.squares[theirs]
            canvas.drawn[:] = last.drawn & same
        self._drawn = rows, canvas, coarse
        return canvas

    def _slopes_of(self, rows: int, side: int) -> Slopes:
        """Allocate slopes, reusing the memory of the previous ones."""
        free = int(self.free[:4].sum())
        size = rows * free * side**2
        if self._room_of_slopes.size < size:
            # It is cleared where it is first used, as long as a fit takes: once, for all to come.
            # room for 2.0 times the rows of the first fit: memory that is not touched is free
            self._room_of_slopes = np.empty(
                round(2.0 * rows) * free * self._whole.side**2, np.int16
            )
        values = self._room_of_slopes[:size].reshape(rows, free, side**2)
        squares, units, moves = np.zeros((rows, 4), dtype=np.int64), *np.zeros((2, rows, free))
        return Slopes(squares, values, units, moves)
