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
from iscat_analysis._kernels.moving import Fits, Room, Search, fit_frames
from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.scoring import CONVERGED, maximize
from iscat_analysis._kernels.track_precision import judge_frames
from iscat_analysis.inference.fit import window_nm
from iscat_analysis.inference.laws import POISSON
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.model import blurred, spreads
from iscat_analysis.optics.stamp import BAND, RINGS, sample_picture, weights_between
from iscat_analysis.optics.waves import axial_table
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.tracking.rows import BackgroundEstimate, Judged, Localizations, Response

IntArray = NDArray[np.int64]


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


class PictureBook:
    """Makes pictures of particles with any blur."""

    def __init__(
        self,
        near: ForwardModel,
        far: ForwardModel,
        *,
        pixel_nm: float,
        near_px: float,
        far_px: float,
        z_range_nm: tuple[float, float] | None,
    ) -> None:
        self._near, self._far = near, far
        self._pixel_nm, self._z_range = pixel_nm, z_range_nm
        self._near_px, self._far_px = near_px, far_px

    def of(self, variances_nm2: FloatArray) -> tuple[Pictures, Pictures]:
        """Make the pictures of some blurs.

        Shapes: `variances_nm2` (groups,).
        """
        if self._z_range is not None:
            return (
                _along_z(self._near, variances_nm2, self._z_range),
                _along_z(self._far, variances_nm2, self._z_range),
            )
        return (
            _blurred(self._sharp_near, variances_nm2, BAND),
            _blurred(self._sharp_far, variances_nm2, RINGS),
        )

    @cached_property
    def _sharp_near(self) -> Pictures:
        return _at_one_height(self._far, self._pixel_nm, self._near_px, BAND)

    @cached_property
    def _sharp_far(self) -> Pictures:
        return _at_one_height(self._far, self._pixel_nm, self._far_px, RINGS)


def _at_one_height(model: ForwardModel, pixel_nm: float, half_px: float, band: float) -> Pictures:
    """Sharp picture at the model's height."""
    lens, samples = sample_picture(model, pixel_nm, half_px, band)
    return Pictures(
        samples.reshape(1, 1, 1, 2, -1), 0.0, 1.0, 0.0, lens, lens.window[None],
        samples.astype(np.float32),
    )  # fmt: skip


def _blurred(sharp: Pictures, variances_nm2: FloatArray, band: float) -> Pictures:
    """Give a picture at one height the weights of every blur."""
    inverse = sharp.lens.inv_step
    windows = [
        sum(
            share * weights_between(v * inverse**2, band)
            for share, v in spreads(float(q), each_axis=True)
        )
        for q in variances_nm2
    ]
    return sharp._replace(windows=np.stack(windows))


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


@dataclass(frozen=True)
class RenderPlan:
    """A canvas and the rows that are on it."""

    rows: Localizations
    canvas: Canvas
    coarse: bool

    def moved(self, rows: Localizations, frames: int) -> Canvas:
        """Set other rows; frames in which rows changed are marked."""
        old, canvas = self.rows, self.canvas
        here, there = rows.starts(frames), old.starts(frames)
        same = np.diff(here) == np.diff(there)
        mine = np.flatnonzero(np.repeat(same, np.diff(here)))
        theirs = np.flatnonzero(np.repeat(same, np.diff(there)))
        other = (rows.group[mine] != old.group[theirs]) | (rows.track[mine] != old.track[theirs])
        same[rows.frame[mine[other]]] = False
        rings, squares = np.zeros((2, *rows.theta.shape))
        rings[mine], squares[mine] = canvas.rings[theirs], canvas.squares[theirs]
        return Canvas(canvas.total, rings, squares, canvas.drawn & same)


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
    return Room(
        np.empty(15 * area, near.nodes.dtype), np.empty(area, np.float32), _profile(near, 2), index,
        np.empty((11, 5)), np.empty((4, index.size)),
        np.empty(0 if isinstance(near.lens, StampLens) else 10 * area),
    )  # fmt: skip


def _profile(pictures: Pictures, orders: int) -> FloatArray:
    """Make room for a profile, as `iscat_analysis._kernels.scoring.blank_profile` does."""
    lens, (channels, width) = pictures.lens, pictures.heights.shape[3:]
    if isinstance(lens, StampLens):
        return np.empty((0, 0, 0))
    if isinstance(lens, LatticeLens):
        return np.empty((orders * channels, 2 * lens.half + 1, 2 * lens.half + 1))
    return np.empty((width // POWERS, POWERS, orders * channels))


def draw_rows(
    field: Field, near: Pictures, far: Pictures, rows: Rows, first: int, last: int, canvas: Canvas
) -> None:
    """Update frames first…last − 1 of the canvas to the current rows."""
    draw_frames(
        field, near, far, rows, first, last, canvas, _profile(near, 1), _profile(far, 1),
        np.empty(max(field.drawn, field.side) ** 2),
    )  # fmt: skip


def fit_rows(
    light: Light, field: Field, near: Pictures, search: Search, rows: Rows, first: int, last: int,
    sweeps: int, canvas: Canvas, slopes: Slopes, fits: Fits, expected: FloatArray,
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """Fit the rows of frames first…last − 1, each `sweeps` times."""
    place = np.array([first, 0, rows.starts[first], 0, 0, 0, 0])
    room = room_for(field, near, search.free)
    background = light.background.astype(np.float32)
    while not fit_frames(
        light, field, near, search, rows, last, sweeps, canvas, slopes, fits, expected, background,
        sums, place, room,
    ):  # fmt: skip
        row = int(place[2])
        fits.gain[row], fits.outcome[row] = fit_with_search(
            field, near, search, place, room, int(rows.group[row]), rows.theta[row]
        )


def fit_with_search(
    field: Field, near: Pictures, search: Search, place: IntArray, room: Room, group: int,
    theta: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """Fit a row whose plain steps diverge; θ is overwritten with the estimate.

    Returns its log-likelihood over that without the particle, and how the fit ended.
    """
    top, bottom, left, right = place[3:]
    shape = 4, bottom - top, right - left
    start = room.small[10]
    data = room.pixels[: math.prod(shape)].reshape(shape).astype(np.float64)
    heights = near.heights[min(group, len(near.heights) - 1)]
    table = heights, near.first_nm, near.step_nm, near.kappa
    lens = near.lens
    if not isinstance(lens, RoundLens):
        lens = lens._replace(window=near.windows[min(group, len(near.windows) - 1)])
    x, y, offsets, weights = field.pixels
    value, _, outcome = maximize(
        table, tuple(lens), (x[left:right], y[top:bottom], offsets, weights), POISSON.code, data,
        search.free, np.maximum(search.lower, start - search.reach),
        np.minimum(search.upper, start + search.reach), search.max_step, search.tolerance,
        search.passes, theta, np.empty((5, 5)), -math.inf, (0.0, 0.0),
    )  # fmt: skip
    return value, outcome


DRAWN = 4
"""Side of the square in which a particle is drawn, over that in which it is fitted."""

COARSE = 2
"""Of the fitted square's side, by which it is cut while particles are still being looked for."""

BLOCK = 32
"""Frames that one thread takes at a time."""

_FRAMES_PER_SWEEP = 4  # of them, where every row is fitted several times
_TOLERANCE = 2e-4  # as in `Likelihood.maximize`
_PASSES = 40
_SLACK = np.array([0.1, 0.1, 0.01, 0.05])
"""How far particles may go from their rings: pixels, wavelengths, relative."""
_NO_LIMIT = 1e300
# Resolutions λ/NA outside the field, from where a particle is still seen
_VISIBLE_RESOLUTIONS = 1.0


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
        largest: float,
        pool: ThreadPoolExecutor,
        saturated: BoolArray | None = None,
    ) -> None:
        self.exposures, self.used = exposures, used
        self.saturated = np.zeros_like(used) if saturated is None else saturated
        self.read_e2 = np.ascontiguousarray(np.broadcast_to(read_e2, used.shape), dtype=float)
        self._pool = pool
        rows, columns = used.shape
        grid = PixelGrid.region((0, rows), (0, columns), pixel_nm)
        self.pixel_nm, self.roi_px = pixel_nm, roi_px
        pixels = near.pixels(grid)
        wavelength = near.optics.wavelength_nm
        slack = _SLACK * np.array([pixel_nm, pixel_nm, wavelength, 1.0])
        along_z = z_range_nm is not None
        drawn = DRAWN * roi_px
        if along_z:  # no farther than the tables reach, into the corners of the square
            drawn = min(drawn, 2 * int(far.reach_nm / (math.sqrt(2) * pixel_nm) - 1))
        self._whole = Field(pixels, pixel_nm, roi_px, drawn, slack, along_z)
        self._coarse = Field(pixels, pixel_nm, roi_px // COARSE, roi_px, slack, True)
        if along_z:  # the rings tell one fringe from the next, and reach far
            self._coarse = self._whole
        self._canvas: RenderPlan | None = None
        self._room_of_slopes = np.empty(0, dtype=np.int16)
        self.free = np.array([True, True, z_range_nm is not None, True, False])
        reach = window_nm(pixel_nm)
        half = pixel_nm / 2 + _VISIBLE_RESOLUTIONS * wavelength / near.optics.na
        if z_range_nm is not None:  # rings reach farther
            half = max(half, roi_px * pixel_nm / 4)
        low, high = z_range_nm or (near.height_nm, near.height_nm)
        sign_kept = z_range_nm is not None
        self._search = Search(
            self.free,
            np.array([reach, reach, _NO_LIMIT, _NO_LIMIT, 0.0]),
            np.array([-half, -half, low, 0.0 if sign_kept else -largest, 0.0]),
            np.array(
                [(columns - 1) * pixel_nm + half, (rows - 1) * pixel_nm + half, high, largest, 0.0]
            ),
            np.array([0.25 * wavelength, 0.25 * wavelength, 0.1 * wavelength, _NO_LIMIT, 1.0]),
            _TOLERANCE,
            _PASSES,
        )
        farthest = max(rows, columns) + _VISIBLE_RESOLUTIONS * wavelength / (
            near.optics.na * pixel_nm
        )
        self._book = PictureBook(
            near,
            far,
            pixel_nm=pixel_nm,
            near_px=(roi_px + 1) / 2 + _SLACK[0] + reach / pixel_nm,
            far_px=min((self._whole.drawn + 1) / 2, farthest) + 1,
            z_range_nm=z_range_nm,
        )
        self._pictures = self._book.of(np.zeros(1))

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
        unused = counts[:, ~self.used].sum(axis=1, dtype=np.float64)
        blocks = range(0, self.frames, BLOCK)
        parts = self._pool.map(
            lambda first: counts[first : first + BLOCK].sum(axis=(1, 2), dtype=np.float64), blocks
        )
        total = np.concatenate(list(parts)) - unused
        return self.exposures.in_electrons(total, int(self.used.sum()))

    @property
    def frames(self) -> int:
        """Frames in the movie."""
        return len(self.exposures.counts)

    def renew(self, block: Callable[[int, int], NDArray[Any]]) -> None:
        """Replace the frames."""

        def put(first: int) -> None:
            last = min(first + BLOCK, self.frames)
            self.exposures.counts[first:last] = block(first, last)

        list(self._pool.map(put, range(0, self.frames, BLOCK)))
        for told in ("total_e", "frame_totals"):
            self.__dict__.pop(told, None)
        self.draw_anew()

    def set_blurs(self, variances_nm2: FloatArray) -> None:
        """Make the pictures of blurs, which `Localizations.group` numbers.

        Shapes: `variances_nm2` (groups,).
        """
        self._pictures = self._book.of(variances_nm2)
        self._canvas = None

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
        all rows to a change of the background is kept for `where_turns_end`.

        Shapes: `converged` (n,).
        """
        light = self._light(ground)
        near, far = self._pictures_for(coarse=coarse)
        theta, n = rows.theta.copy(), len(rows.frame)
        particles = Rows(rows.starts(self.frames), theta, rows.group)
        fits = Fits(np.full(n, CONVERGED, np.int64), np.zeros((n, 4, 4)), np.empty(n))
        canvas = self._canvas_for(rows, coarse=coarse)
        field = self._coarse if coarse else self._whole
        # a tolerance of 0.02 where the next turn goes on with the fit
        search = self._search if sweeps > 1 else self._search._replace(tolerance=0.02)
        slopes = self._slopes_of(n, field.side if sweeps else 0)
        expected = np.zeros(self.frames)

        def block(first: int) -> NDArray[np.float32]:
            sums = np.zeros(self.used.shape, dtype=np.float32)
            last = min(first + BLOCK, self.frames)
            draw_rows(field, near, far, particles, first, last, canvas)
            fit_rows(
                light, field, near, search, particles, first, last, sweeps, canvas, slopes, fits,
                expected, sums,
            )  # fmt: skip
            return sums

        stretch = ground.power.sum() + self.sum_of(block)
        fitted = rows.fitted(theta, fits.information, fits.gain) if sweeps else rows
        self._canvas = RenderPlan(fitted, canvas, coarse)
        if sweeps:
            own = np.ascontiguousarray(fits.information[:, self.free[:4]][:, :, self.free[:4]])
            self._response = Response(
                slopes, particles.starts, light, canvas.total, own, self._pool, joint=not coarse
            )
        if sweeps and not coarse:  # among rows that are only tried some would be pushed away
            walls = search.lower, search.upper
            fitted = replace(fitted, theta=self._response.together(theta, self.free, walls))
        level = np.where(stretch > 0, self.total_e / np.where(stretch > 0, stretch, 1.0), 1.0)
        totals = self.frame_totals
        expected += light.background.sum()
        power = np.where(expected > 0, totals / np.where(expected > 0, expected, 1.0), 1.0)
        return (
            fitted,
            BackgroundEstimate(np.maximum(level, 1e-3), power / power.mean()),
            fits.outcome == CONVERGED,
        )

    def where_turns_end(self, move: FloatArray, damping: float) -> FloatArray:
        """Extrapolate all further turns from the first one, whose step of the background is `move`.

        Shapes: `move` (y, x), result (y, x).
        """
        return self._response.step(move, self.total_e, self.used, damping)

    def followed(self, rows: Localizations, step: FloatArray) -> Localizations:
        """Move the rows of the last fit with a step of the background, to first order.

        Shapes: `step` (y, x).
        """
        search = self._search
        walls = search.lower, search.upper
        theta = self._response.followed(rows.theta, step, self.free, walls)
        return replace(rows, theta=theta)

    def draw_anew(self) -> None:
        """Mark all pictures to be drawn again in the next pass."""
        self._canvas = None

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
        if self._canvas is not None and self._canvas.rows is rows and self._canvas.coarse:
            signal = self._canvas.canvas.total[first:last]
        else:
            signal = self._signal(rows, first, last)
        left = np.empty_like(signal)
        subtract_expected(self._light(ground), signal, first, left)
        return left

    def add_squares(
        self, ground: BackgroundEstimate, rows: Localizations,
        which: IntArray, corner: IntArray, owner: IntArray,
        out: FloatArray,
    ) -> None:  # fmt: skip
        """Superpose the squares around rows, after all rows are subtracted.

        Shapes: `which` (n,), `corner` (n, 2), `owner` (n,), `out` (m, 3, side, side).
        """
        total, light = self.draw(ground, rows), self._light(ground)

        def add(number: int) -> None:
            mine = np.flatnonzero(owner == number)
            add_squares(light, total, rows.frame[which[mine]], corner[mine], owner[mine], out)

        self.share(add, len(out))

    def _signal(self, rows: Localizations, first: int, last: int) -> NDArray[np.float32]:
        """Draw the rows of some frames alone."""
        within = rows.only((rows.frame >= first) & (rows.frame < last))
        canvas = blank(np.empty((last - first, *self.used.shape), dtype=np.float32), within)
        near, far = self._pictures_for(coarse=True)
        starts = np.searchsorted(within.frame, np.arange(first, last + 1)).astype(np.int64)
        particles = Rows(starts, within.theta, within.group)
        draw_rows(self._coarse, near, far, particles, 0, last - first, canvas)
        return canvas.total

    def judge(self, ground: BackgroundEstimate, rows: Localizations) -> Judged:
        """Compute the information on every row."""
        n = len(rows.frame)
        light = self._light(ground)
        near, far = self._pictures_for(coarse=False)
        particles = Rows(rows.starts(self.frames), rows.theta, rows.group)
        fisher, (turned, ways) = np.zeros((n, 4, 4)), np.full((2, n, 4, 4), np.nan)
        bias, numbers = np.zeros((n, 4)), np.zeros((n, 6))
        canvas = self._canvas_for(rows, coarse=False)
        slopes = self._slopes_of(n, self._whole.side)

        def block(first: int) -> FloatArray:
            last = min(first + BLOCK, self.frames)
            draw_rows(self._whole, near, far, particles, first, last, canvas)
            judge_frames(
                light, self._whole, near, self.free, particles, first, last, canvas, slopes,
                fisher, turned, ways, bias, numbers, room_for(self._whole, near, self.free),
            )  # fmt: skip
            return np.zeros(1)

        self.sum_of(block)
        return Judged.of(fisher, turned, ways, bias, numbers, slopes, free=self.free[:4])

    def sum_of(self, block: Callable[[int], NDArray[np.floating[Any]]]) -> FloatArray:
        """Run a function on blocks of frames and sum the results in order."""
        parts = list(self._pool.map(block, range(0, self.frames, BLOCK)))
        total = parts[0].astype(np.float64)
        for part in parts[1:]:
            total += part
        return total

    def share(self, task: Callable[[int], None], count: int) -> None:
        """Run numbered tasks in threads."""
        list(self._pool.map(task, range(count)))

    def holds(self, theta: FloatArray) -> BoolArray:
        """Tell which positions are in the field.

        Shapes: `theta` (..., 5), result (...).
        """
        rows, columns = self.used.shape
        places = theta[..., :2] / self.pixel_nm
        within = (places >= -0.5) & (places < np.array([columns, rows]) - 0.5)
        return np.asarray(within.all(axis=-1))

    def refit(
        self, ground: BackgroundEstimate, rows: Localizations, *, sweeps: int
    ) -> tuple[Localizations, BoolArray]:
        """Fit all particles of a few frames in the smaller square.

        Shapes: `converged` (n,).
        """
        light = self._light(ground)
        near, far = self._pictures_for(coarse=True)
        times, frame = np.unique(rows.frame, return_inverse=True)
        light = light._replace(counts=light.counts[times], power=light.power[times])
        starts = np.searchsorted(frame, np.arange(times.size + 1)).astype(np.int64)
        n, particles = len(frame), Rows(starts, rows.theta.copy(), rows.group)
        canvas = blank(np.empty(light.counts.shape, dtype=np.float32), rows)
        fits = Fits(np.zeros(n, dtype=np.int64), np.zeros((n, 4, 4)), np.empty(n))
        slopes, expected = self._slopes_of(n, 0), np.zeros(times.size)

        def block(part: int) -> None:
            first, last = part * _FRAMES_PER_SWEEP, min((part + 1) * _FRAMES_PER_SWEEP, times.size)
            draw_rows(self._coarse, near, far, particles, first, last, canvas)
            fit_rows(
                light, self._coarse, near, self._search, particles, first, last, sweeps, canvas,
                slopes, fits, expected, np.zeros(self.used.shape, dtype=np.float32),
            )  # fmt: skip

        self.share(block, -(-times.size // _FRAMES_PER_SWEEP))
        fitted = rows.fitted(particles.theta, fits.information, fits.gain)
        return fitted, fits.outcome == CONVERGED

    def on_wall(self, rows: Localizations) -> BoolArray:
        """Tell which rows ended at a limit of the search.

        Shapes: result (n,).
        """
        search = self._search
        near = (rows.theta <= search.lower + 1e-6) | (rows.theta >= search.upper - 1e-6)
        near[:, 3] &= rows.theta[:, 3] >= search.upper[3]  # no mass is the end of none
        return np.asarray((near & self.free).any(axis=1))

    def _pictures_for(self, *, coarse: bool) -> tuple[Pictures, Pictures]:
        """Give the pictures to fit and to draw; they are the same where little is drawn."""
        near, far = self._pictures
        return near, near if coarse and not self.free[2] else far

    def _light(self, ground: BackgroundEstimate) -> Light:
        level, read = (np.where(self.used, part, 0.0) for part in (ground.level, self.read_e2))
        shot = self.exposures
        return Light(shot.counts, shot.gain, shot.offset, ground.power, level, read)

    def _canvas_for(self, rows: Localizations, *, coarse: bool) -> Canvas:
        """Give the canvas, with the frames marked in which it holds other rows than these."""
        last = self._canvas
        if last is None or last.coarse != coarse:
            canvas = blank(self._room, rows)
        else:
            canvas = last.moved(rows, self.frames)
        self._canvas = RenderPlan(rows, canvas, coarse)
        return canvas

    def _slopes_of(self, rows: int, side: int) -> Slopes:
        """Allocate slopes, reusing the memory of the previous ones."""
        free = int(self.free[:4].sum())
        size = rows * free * side**2
        if self._room_of_slopes.size < size:
            # It is cleared where it is first used, as long as a fit takes: once, for all to come.
            # room for 2.0 times the rows of the first fit: memory that is not touched is free
            most = round(2.0 * rows) * free * self._whole.side**2
            self._room_of_slopes = np.empty(most, dtype=np.int16)
        values = self._room_of_slopes[:size].reshape(rows, free, side**2)
        squares, units, moves = np.zeros((rows, 4), dtype=np.int64), *np.zeros((2, rows, free))
        return Slopes(squares, values, units, moves)
