"""The maximum of one likelihood for all particles that move over an unknown, constant background.

The counts n of pixel p in frame t are Poisson with w_t B_p (1 + C_tp), C the sum of the signals of
all particles.  Given their sum over the frames the counts of a pixel are multinomial with
p_t ∝ w_t (1 + C_tp), from which B has dropped out.  The score of that likelihood is the Poisson
score with the background that is most likely given the particles,

    B̂_p = Σ_t n_tp / Σ_t w_t (1 + C_tp),

put in (envelope theorem), so that fitting the particles over B̂ and B̂ under the particles in turn
ends at its maximum, and nothing is left of the particles in their background.  The turns converge
as slowly as the particles move; `_Mixer` sees them through (Anderson's mixing).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.moving import (
    Field,
    Light,
    Pictures,
    Search,
    common_modes,
    fit_frames,
    judge_frames,
    residual_frames,
)
from iscat_analysis._kernels.scoring import CONVERGED
from iscat_analysis.inference.fit import window_nm
from iscat_analysis.optics.blur import blurred
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.waves import axial_table
from iscat_analysis.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]

DRAWN = 4
"""Side of the square in which a particle is drawn, over that in which it is fitted."""

COARSE = 2
"""Of the fitted square's side, by which it is cut while particles are still being looked for."""

SETTLED = 0.02
"""Change of the background from turn to turn, in its own standard deviations, that ends them."""

MOST_TURNS = 60
"""Turns at most."""

_BLOCK = 32  # frames that one thread takes at a time
_TOLERANCE = 2e-4  # as in `Likelihood.maximize`
_PASSES = 40
_SWEEPS = 2  # fits of the particles of a frame in each turn
_MEMORY = 8  # earlier turns that the mixing remembers
_ANY = 1e300
_BEYOND = 0.5  # resolutions λ/NA outside the field, from where a particle is still seen


@dataclass(frozen=True)
class Rows:
    """Particles in frames, in the order of the frames.

    Attributes
    ----------
    frame : ndarray of int, shape (n,)
        Frame, not decreasing.
    track : ndarray of int, shape (n,)
        Whose it is; -1 where that is not known yet.
    theta : ndarray, shape (n, 5)
        x, y, z [nm], amplitude, 0.
    group : ndarray of int, shape (n,)
        Number of the blur.
    """

    frame: IntArray
    track: IntArray
    theta: FloatArray
    group: IntArray

    @classmethod
    def of(
        cls, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray | None = None
    ) -> Rows:
        """Put rows into the order of their frames."""
        order = np.lexsort((track, frame))
        blur = np.zeros(len(frame), dtype=np.int64) if group is None else group
        return cls(frame[order], track[order], np.ascontiguousarray(theta[order]), blur[order])

    def starts(self, frames: int) -> IntArray:
        """First row of each frame, and the number of rows."""
        first: IntArray = np.searchsorted(self.frame, np.arange(frames + 1)).astype(np.int64)
        return first

    def only(self, kept: BoolArray) -> Rows:
        """Take some of the rows."""
        return Rows(self.frame[kept], self.track[kept], self.theta[kept], self.group[kept])


@dataclass(frozen=True)
class Ground:
    """The light without the particles.

    Attributes
    ----------
    level : ndarray, shape (y, x)
        Photoelectrons in a frame of power 1 [e].
    power : ndarray, shape (t,)
        Power of each frame, 1 on average.
    """

    level: FloatArray
    power: FloatArray


@dataclass(frozen=True)
class Judged:
    """What the likelihood says of each row.

    Attributes
    ----------
    fisher : ndarray, shape (n, 4, 4)
        Expected information in (x, y, z, a).
    observed : ndarray, shape (n, 4, 4)
        Observed information of the free parameters, NaN elsewhere.
    bias : ndarray, shape (n, 4)
        Bias of order 1/N of θ, 0 where not free.
    score : ndarray, shape (n, 4)
        Gradient of the log-likelihood at θ.
    gain : ndarray, shape (n,)
        Log-likelihood over that without the particle.
    chi2 : ndarray, shape (n,)
        Pearson's.
    pixels : ndarray, shape (n,)
        How many.
    worst : ndarray, shape (n,)
        Largest residual [standard deviations].
    level : ndarray, shape (n,)
        Mean light of the square [e].
    """

    fisher: FloatArray
    observed: FloatArray
    bias: FloatArray
    score: FloatArray
    gain: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    worst: FloatArray
    level: FloatArray


class MovingField:
    """A movie in memory, and the pictures of what moves in it.

    Parameters
    ----------
    counts_e : ndarray of float32, shape (t, y, x)
        Photoelectrons [e].
    read_e2 : ndarray, shape (y, x)
        Variance of the read noise of a frame [e²].
    used : ndarray of bool, shape (y, x)
        Pixels that may be used.
    near, far : ForwardModel
        Models of a sharp picture, for the fitted square and for that which is drawn.
    pixel_nm : float
        Side of a pixel [nm].
    roi_px : int
        Side of the fitted square [pixels].
    z_range_nm : tuple of float or None
        Where z is searched; None where it is fixed at the model's height [nm].
    largest : float
        Largest amplitude that is searched.
    pool : ThreadPoolExecutor
        Runs blocks of frames; the result does not depend on its size.
    """

    def __init__(
        self,
        counts_e: NDArray[np.float32],
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
    ) -> None:
        self.counts_e, self.used = counts_e, used
        self.read_e2 = np.ascontiguousarray(np.broadcast_to(read_e2, used.shape), dtype=float)
        self._models = near, far
        self._pool = pool
        rows, columns = used.shape
        grid = PixelGrid.region((0, rows), (0, columns), pixel_nm)
        self.pixel_nm, self.roi_px = pixel_nm, roi_px
        pixels = near.pixels(grid)
        self._whole = Field(pixels, pixel_nm, roi_px, DRAWN * roi_px)
        self._coarse = Field(pixels, pixel_nm, roi_px // COARSE, roi_px)
        self.free = np.array([True, True, z_range_nm is not None, True, False])
        reach = window_nm(pixel_nm)
        half = pixel_nm / 2 + _BEYOND * near.optics.wavelength_nm / near.optics.na
        low, high = z_range_nm or (near.height_nm, near.height_nm)
        sign_kept = z_range_nm is not None
        wavelength = near.optics.wavelength_nm
        self._search = Search(
            self.free,
            np.array([reach, reach, _ANY, _ANY, 0.0]),
            np.array([-half, -half, low, 0.0 if sign_kept else -largest, 0.0]),
            np.array(
                [(columns - 1) * pixel_nm + half, (rows - 1) * pixel_nm + half, high, largest, 0.0]
            ),
            np.array([0.25 * wavelength, 0.25 * wavelength, 0.1 * wavelength, _ANY, 1.0]),
            _TOLERANCE,
            _PASSES,
        )
        self._z_range = z_range_nm
        self._pictures = self._pictures_of(np.zeros(1))

    @property
    def frames(self) -> int:
        """Frames in the movie."""
        return len(self.counts_e)

    def set_blurs(self, variances_nm2: FloatArray) -> None:
        """Make the pictures that `Rows.group` numbers.

        Parameters
        ----------
        variances_nm2 : ndarray, shape (groups,)
            Variance of a path about its mean [nm²].
        """
        self._pictures = self._pictures_of(variances_nm2)

    def first_ground(self, *, follow_power: bool) -> Ground:
        """Median of the frames, each over its power.

        Parameters
        ----------
        follow_power : bool
            Whether the power changes from frame to frame.

        Returns
        -------
        Ground
            Wrong where a particle was in more than a fraction of the frames.
        """
        power = np.ones(self.frames)
        if follow_power:
            power = self._frame_totals / self._frame_totals.mean()
        level = np.empty((self.used.shape[0], self.used.shape[1]))
        scale = (1 / power).astype(np.float32)
        for row in range(len(level)):
            level[row] = np.median(self.counts_e[:, row] * scale[:, None], axis=0)
        return Ground(np.maximum(level, 1e-3), power)

    @cached_property
    def _total(self) -> FloatArray:
        """Photoelectrons of all frames."""
        return np.asarray(self.counts_e.sum(axis=0, dtype=np.float64))

    def fit(
        self, ground: Ground, rows: Rows, *, sweeps: int = _SWEEPS, coarse: bool = False
    ) -> tuple[Rows, Ground, BoolArray]:
        """Fit every row over a background, and give the background under the rows.

        Parameters
        ----------
        ground : Ground
            The light to fit over.
        rows : Rows
            Starts.
        sweeps : int
            Fits of each row, with the others of its frame in place; 0 leaves them as they are.
        coarse : bool
            Fit a smaller square and draw less of the rings.

        Returns
        -------
        rows : Rows
            Estimates.
        ground : Ground
            The most likely one under them.
        converged : ndarray of bool, shape (n,)
            Which fits did.
        """
        light = self._light(ground)
        near, far = self._pictures
        theta = rows.theta.copy()
        starts = rows.starts(self.frames)
        outcome = np.full(len(theta), CONVERGED, dtype=np.int64)
        passes = np.zeros(len(theta), dtype=np.int64)
        expected = np.zeros(self.frames)
        field = self._coarse if coarse else self._whole

        def block(first: int) -> FloatArray:
            stretch = np.zeros(self.used.shape)
            fit_frames(
                light, field, near, far, self._search, starts, first,
                min(first + _BLOCK, self.frames), sweeps, theta, rows.group, outcome, passes,
                expected, stretch,
            )  # fmt: skip
            return stretch

        stretch = self._sum_of(block)
        level = np.where(stretch > 0, self._total / np.where(stretch > 0, stretch, 1.0), 1.0)
        totals = self._frame_totals
        power = np.where(expected > 0, totals / np.where(expected > 0, expected, 1.0), 1.0)
        fitted = replace(rows, theta=theta)
        return fitted, Ground(np.maximum(level, 1e-3), power / power.mean()), outcome == CONVERGED

    def settle(
        self,
        ground: Ground,
        rows: Rows,
        *,
        follow_power: bool,
        follow_level: bool = True,
        turns: int = MOST_TURNS,
        coarse: bool = False,
        tell: Callable[[int, float], None] | None = None,
    ) -> tuple[Rows, Ground, BoolArray, float]:
        """Fit rows and background in turn.

        Parameters
        ----------
        ground : Ground
            To begin with.
        rows : Rows
            Starts.
        follow_power, follow_level : bool
            Whether the power and the level are fitted, or stay.
        turns : int
            At most.
        coarse : bool
            As in `fit`.
        tell : callable, optional
            Told each turn and the change that it made.

        Returns
        -------
        rows : Rows
            Estimates.
        ground : Ground
            Under them.
        converged : ndarray of bool
            Which fits did.
        change : float
            Largest change of the background in the last turn [its standard deviations].
        """
        mixer = _Mixer()
        sigma = 1 / np.sqrt(np.maximum(self._total, 1.0))
        change = np.inf
        done = np.ones(len(rows.frame), dtype=bool)
        sweeps = 1 if coarse else _SWEEPS
        for turn in range(turns):
            rows, found, done = self.fit(ground, rows, sweeps=sweeps, coarse=coarse)
            power = found.power if follow_power else ground.power
            if not follow_level:
                settled = bool(np.abs(power - ground.power).max() < 1e-7)
                ground = replace(ground, power=power)
                change = 0.0
                if settled or turn >= 2:
                    break
                continue
            moved = np.where(self.used, np.log(found.level / ground.level), 0.0)
            change = float(np.abs(moved / sigma).max())
            if tell is not None:
                tell(turn, change)
            if change < SETTLED:
                ground = Ground(found.level, power)
                break
            mixed = mixer.next(np.log(ground.level[self.used]), moved[self.used])
            level = found.level.copy()
            level[self.used] = np.exp(mixed)
            ground = Ground(level, power)
        return rows, ground, done, change

    def residual(self, ground: Ground, rows: Rows, first: int, last: int) -> NDArray[np.float32]:
        """Give the counts of some frames minus what is expected.

        Parameters
        ----------
        ground : Ground
            Background.
        rows : Rows
            Particles.
        first, last : int
            Frames.

        Returns
        -------
        ndarray of float32, shape (last - first, y, x)
            Photoelectrons [e]; 0 in pixels that are not used.
        """
        out = np.empty((last - first, *self.used.shape), dtype=np.float32)
        residual_frames(
            self._light(ground), self._coarse, self._pictures[1], rows.starts(self.frames),
            first, last, rows.theta, rows.group, out,
        )  # fmt: skip
        return out

    def judge(
        self, ground: Ground, rows: Rows, *, brief: bool = False, coarse: bool = False
    ) -> Judged:
        """Say what the likelihood knows of every row.

        Parameters
        ----------
        ground : Ground
            Background.
        rows : Rows
            Particles, at their estimates.
        brief : bool
            Leave out observed information and bias, which take most of the time.
        coarse : bool
            As in `fit`.

        Returns
        -------
        Judged
            Information, bias, goodness of fit.
        """
        n = len(rows.frame)
        light = self._light(ground)
        near, far = self._pictures
        starts = rows.starts(self.frames)
        fisher, turned, ways = np.empty((3, n, 4, 4))
        field = self._coarse if coarse else self._whole
        bias, score = np.empty((2, n, 4))
        numbers = np.empty((n, 5))

        def block(first: int) -> FloatArray:
            judge_frames(
                light, field, near, far, self.free, starts, first,
                min(first + _BLOCK, self.frames), rows.theta, rows.group, fisher, turned, ways,
                bias, score, numbers, brief,
            )  # fmt: skip
            return np.zeros(1)

        self._sum_of(block)
        index = np.flatnonzero(self.free[:4])
        part = np.ix_(np.arange(n), index, np.arange(index.size))
        observed = np.full((n, 4, 4), np.nan)
        inverse = np.full((n, index.size, index.size), np.nan)
        good = np.isfinite(turned[part]).all(axis=(1, 2)) if n else np.zeros(0, dtype=bool)
        if good.any():
            v, ov = ways[part][good], turned[part][good]
            inverse[good] = v @ np.swapaxes(v, 1, 2)
            o = ov @ np.linalg.inv(v)
            square = np.ix_(good, index, index)
            observed[square] = (o + np.swapaxes(o, 1, 2)) / 2
        shift = np.zeros((n, 4))
        shift[:, index] = np.einsum("nij,nj->ni", inverse, bias[:, index])
        gain, chi2, pixels, worst, level = numbers.T
        return Judged(
            fisher, observed, np.nan_to_num(shift), score, gain, chi2, pixels, worst, level
        )

    def holds(self, theta: FloatArray) -> bool:
        """Tell whether a particle is in the field.

        Parameters
        ----------
        theta : ndarray, shape (5,)
            Of a row.

        Returns
        -------
        bool
            Whether its centre lies on a pixel.
        """
        rows, columns = self.used.shape
        x, y = theta[:2] / self.pixel_nm
        return bool(-0.5 <= x < columns - 0.5 and -0.5 <= y < rows - 0.5)

    def refit(
        self, ground: Ground, rows: Rows, *, sweeps: int
    ) -> tuple[Rows, BoolArray, FloatArray]:
        """Fit all particles of a few frames, the smaller square of each.

        Parameters
        ----------
        ground : Ground
            Background.
        rows : Rows
            All particles of these frames.
        sweeps : int
            How often each, with the others in place.

        Returns
        -------
        rows : Rows
            Estimates.
        converged : ndarray of bool, shape (n,)
            Which fits did.
        snr : ndarray, shape (n,)
            √(2 Δℓ) of each, the others in place.
        """
        light = self._light(ground)
        near, far = self._pictures
        theta, starts, n = rows.theta.copy(), rows.starts(self.frames), len(rows.frame)
        outcome, passes = np.zeros((2, n), dtype=np.int64)
        expected, stretch = np.zeros(self.frames), np.zeros(self.used.shape)
        fisher, turned, ways = np.zeros((3, n, 4, 4))
        bias, score = np.zeros((2, n, 4))
        numbers = np.zeros((n, 5))
        for t in np.unique(rows.frame).tolist():
            fit_frames(
                light, self._coarse, near, far, self._search, starts, t, t + 1, sweeps, theta,
                rows.group, outcome, passes, expected, stretch,
            )  # fmt: skip
            judge_frames(
                light, self._coarse, near, far, self.free, starts, t, t + 1, theta, rows.group,
                fisher, turned, ways, bias, score, numbers, True,
            )  # fmt: skip
        snr = np.sqrt(2 * np.maximum(numbers[:, 0], 0.0))
        return replace(rows, theta=theta), outcome == CONVERGED, snr

    def lost(self, ground: Ground, rows: Rows) -> FloatArray:
        """Information on what the rows of one track have in common that their background takes.

        Parameters
        ----------
        ground : Ground
            Background.
        rows : Rows
            All of one track.

        Returns
        -------
        ndarray, shape (4, 4)
            Σ over pixels of (Σ_t w B ∂C)(Σ_t w B ∂C)ᵀ / Σ_t w B (1 + C), in (x, y, z, a).
        """
        cut = self.box(rows)
        modes = np.empty((4, *ground.level[cut].shape))
        self._modes(ground, rows, cut, modes)
        return np.asarray(np.einsum("ayx,byx,yx->ab", modes, modes, self._weight(ground, cut)))

    def pixels_of(self, rows: Rows) -> int:
        """Count the pixels of the box in which all rows are fitted."""
        rows_, columns = self.box(rows)
        return int((rows_.stop - rows_.start) * (columns.stop - columns.start))

    def patterns(self, ground: Ground, rows: Rows) -> tuple[FloatArray, FloatArray]:
        """Give what each row changes of the light of every pixel of its track.

        Parameters
        ----------
        ground : Ground
            Background.
        rows : Rows
            All of one track.

        Returns
        -------
        patterns : ndarray, shape (n, 4, y, x)
            w B ∂C of each row, in (x, y, z, a) [e per unit].
        weight : ndarray, shape (y, x)
            One over the counts of all frames; less where there is read noise, 0 where not used.
        """
        cut = self.box(rows)
        out = np.empty((len(rows.frame), 4, *ground.level[cut].shape))
        for i in range(len(out)):
            self._modes(ground, rows.only(np.arange(len(out)) == i), cut, out[i])
        return out, self._weight(ground, cut)

    def box(self, rows: Rows) -> tuple[slice, slice]:
        """Give the pixels that the squares of rows cover."""
        spans = []
        for axis, size in ((1, self.used.shape[0]), (0, self.used.shape[1])):
            first = np.rint(rows.theta[:, axis] / self.pixel_nm - (self.roi_px - 1) / 2)
            low = int(np.clip(first.min(), 0, size - 1))
            spans.append(slice(low, int(np.clip(first.max() + self.roi_px, low + 1, size))))
        return spans[0], spans[1]

    def _modes(self, ground: Ground, rows: Rows, cut: tuple[slice, slice], out: FloatArray) -> None:
        """Fill `out` with the sum over rows of what they change of the light."""
        common_modes(
            self._light(ground), self._whole, self._pictures[0], rows.frame, rows.theta, rows.group,
            cut[0].start, cut[1].start, out,
        )  # fmt: skip

    def _weight(self, ground: Ground, cut: tuple[slice, slice]) -> FloatArray:
        """One over the information of the pixels on the logarithm of their light."""
        level = ground.level[cut]
        share = np.where(self.used[cut], level / (level + self.read_e2[cut]), 0.0)
        return np.asarray(share / np.maximum(self._total[cut], 1.0))

    def on_wall(self, rows: Rows) -> BoolArray:
        """Tell which rows ended on a wall of the search.

        Parameters
        ----------
        rows : Rows
            Particles, at their estimates.

        Returns
        -------
        ndarray of bool, shape (n,)
            Whether a free parameter lies on one.
        """
        search = self._search
        near = (rows.theta <= search.lower + 1e-6) | (rows.theta >= search.upper - 1e-6)
        near[:, 3] &= rows.theta[:, 3] >= search.upper[3]  # no mass is the end of none
        return np.asarray((near & self.free).any(axis=1))

    def snr_of(self, ground: Ground, rows: Rows) -> FloatArray:
        """Give the signal-to-noise ratio of every row, √(2 Δℓ).

        Parameters
        ----------
        ground : Ground
            Background.
        rows : Rows
            Particles, at their estimates.

        Returns
        -------
        ndarray, shape (n,)
            At least 0.
        """
        return np.asarray(
            np.sqrt(2 * np.maximum(self.judge(ground, rows, brief=True, coarse=True).gain, 0.0))
        )

    @cached_property
    def _frame_totals(self) -> FloatArray:
        """Photoelectrons in the used pixels of each frame."""
        return np.asarray(self.counts_e[:, self.used].sum(axis=1, dtype=np.float64))

    def _light(self, ground: Ground) -> Light:
        return Light(self.counts_e, ground.power, ground.level, self.read_e2, self.used)

    def _sum_of(self, block: Callable[[int], FloatArray]) -> FloatArray:
        """Run blocks of frames and add what they give, in their order."""
        parts: Sequence[FloatArray] = list(self._pool.map(block, range(0, self.frames, _BLOCK)))
        total = parts[0].copy()
        for part in parts[1:]:
            total += part
        return total

    def _pictures_of(self, variances_nm2: FloatArray) -> tuple[Pictures, Pictures]:
        near, far = (_stacked(model, variances_nm2, self._z_range) for model in self._models)
        return near, far


def _stacked(
    model: ForwardModel, variances_nm2: FloatArray, z_range_nm: tuple[float, float] | None
) -> Pictures:
    """Tables of a model for every blur."""
    span = z_range_nm or (model.height_nm, model.height_nm)
    tables = [
        axial_table(blurred(model, float(q), upwards=z_range_nm is not None).wave, span)
        for q in variances_nm2
    ]
    heights = np.stack([table.heights for table in tables])
    one = tables[0]
    return Pictures(heights, one.first_nm, one.step_nm, one.kappa, model.lens)


class _Mixer:
    """Anderson's mixing for a fixed point x = g(x), of which g(x) − x is seen.

    D. G. Anderson, J. ACM 12, 547 (1965); H. F. Walker & P. Ni, SIAM J. Numer. Anal. 49, 1715
    (2011).
    """

    def __init__(self) -> None:
        self._places: list[FloatArray] = []
        self._moves: list[FloatArray] = []

    def next(self, place: FloatArray, move: FloatArray) -> FloatArray:
        """Where to go from `place`, from which the plain turn goes on by `move`."""
        places, moves = self._places, self._moves
        places.append(place)
        moves.append(move)
        del places[: -(_MEMORY + 1)], moves[: -(_MEMORY + 1)]
        if len(moves) == 1:
            return place + move
        dx = np.stack([b - a for a, b in pairwise(places)])
        df = np.stack([b - a for a, b in pairwise(moves)])
        weights, *_ = np.linalg.lstsq(df @ df.T, df @ move, rcond=1e-10)
        return np.asarray(place + move - weights @ (dx + df))
