"""Rows of moving particles, the background under them, and how both follow each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from iscat_analysis._kernels.background_response import (
    Clusters,
    Slopes,
    find_clusters,
    follow_rows,
    join_rows,
)
from iscat_analysis._kernels.canvas import Light
from iscat_analysis.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Localizations:
    """Particles in frames, sorted by frame."""

    frame: IntArray
    track: IntArray
    theta: FloatArray
    group: IntArray
    fisher: FloatArray
    snr: FloatArray

    @classmethod
    def of(
        cls, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray | None = None
    ) -> Localizations:
        """Sort rows that are not fitted yet by frame."""
        n = len(frame)
        blur = np.zeros(n, dtype=np.int64) if group is None else group
        unknown = np.full((n, 4, 4), np.nan), np.full(n, np.nan)
        return cls(frame, track, theta, blur, *unknown).in_order()

    @classmethod
    def together(cls, parts: Sequence[Localizations]) -> Localizations:
        """Concatenate several sets of rows."""
        every = ([getattr(rows, part.name) for rows in parts] for part in fields(cls))
        return cls(*map(np.concatenate, every))

    def in_order(self) -> Localizations:
        """Sort rows by frame and track."""
        return self.only(np.lexsort((self.track, self.frame)))

    def joined(
        self, frame: IntArray, track: IntArray, theta: FloatArray, group: IntArray
    ) -> Localizations:
        """Append rows that are not fitted yet."""
        return Localizations.together(
            [self, Localizations.of(frame, track, theta, group)]
        ).in_order()

    def fitted(self, theta: FloatArray, fisher: FloatArray, gain: FloatArray) -> Localizations:
        """Set estimates, informations and gains in log-likelihood."""
        return replace(self, theta=theta, fisher=fisher, snr=np.sqrt(2 * np.maximum(gain, 0.0)))

    def recalling(self, old: Localizations) -> Localizations:
        """Copy the fits of rows that are the same in others."""
        many = int(max(self.track.max(initial=0), old.track.max(initial=0))) + 1
        keys, sought = old.frame * many + old.track, self.frame * many + self.track
        where = np.minimum(np.searchsorted(keys, sought), len(keys) - 1)
        same = (keys[where] == sought) & (old.theta[where] == self.theta).all(axis=1)
        fisher, snr = self.fisher.copy(), self.snr.copy()
        fisher[same], snr[same] = old.fisher[where[same]], old.snr[where[same]]
        return replace(self, fisher=fisher, snr=snr)

    def starts(self, frames: int) -> IntArray:
        """Index of the first row of each frame, and the number of rows."""
        first: IntArray = np.searchsorted(self.frame, np.arange(frames + 1)).astype(np.int64)
        return first

    def only(self, kept: BoolArray | IntArray) -> Localizations:
        """Select some rows."""
        return Localizations(*(getattr(self, part.name)[kept] for part in fields(self)))

    def pairs_within(self, limit_nm: float) -> IntArray:
        """Find pairs of rows of one frame within a distance.

        Shapes: result (pairs, 2).
        """
        apart = (2 * limit_nm + 1) * self.frame  # no two frames lie within the limit of each other
        places = np.column_stack([self.theta[:, :2], apart])
        tree = scipy.spatial.cKDTree(places, balanced_tree=False, compact_nodes=False)
        return np.asarray(tree.query_pairs(limit_nm, output_type="ndarray"), dtype=np.int64)


@dataclass(frozen=True)
class BackgroundEstimate:
    """The background, and the laser power of each frame."""

    level: FloatArray
    power: FloatArray


@dataclass(frozen=True)
class Judged:
    """What the likelihood says of each row."""

    fisher: FloatArray
    observed: FloatArray
    bias: FloatArray
    gain: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    worst: FloatArray
    level: FloatArray
    growth: FloatArray
    slopes: Slopes

    @classmethod
    def of(
        cls,
        fisher: FloatArray,
        turned: FloatArray,
        ways: FloatArray,
        bias: FloatArray,
        numbers: FloatArray,
        slopes: Slopes,
        *,
        free: BoolArray,
    ) -> Judged:
        """Make it of the arrays that `iscat_analysis._kernels.track_precision.judge_frames` fills.

        Shapes: `free` (4,).
        """
        n, index = len(fisher), np.flatnonzero(free)
        part = np.ix_(np.arange(n), index, np.arange(index.size))
        observed = np.full((n, 4, 4), np.nan)
        inverse = np.full((n, index.size, index.size), np.nan)
        good = np.isfinite(turned[part]).all(axis=(1, 2))
        if good.any():
            v, ov = ways[part][good], turned[part][good]
            inverse[good] = v @ np.swapaxes(v, 1, 2)
            o = ov @ np.linalg.inv(v)
            observed[np.ix_(good, index, index)] = (o + np.swapaxes(o, 1, 2)) / 2
        shift = np.zeros((n, 4))
        shift[:, index] = np.einsum("nij,nj->ni", inverse, bias[:, index])
        gain, chi2, pixels, worst, level, growth = numbers.T
        return cls(
            fisher, observed, np.nan_to_num(shift), gain, chi2, pixels, worst, level, growth, slopes
        )


_FARTHEST = 0.05  # step of the logarithm of the background
_LONGEST = np.array([50.0, 50.0, 20.0, 0.3, 0.0])
"""Step of rows that overlap [nm], relative; longer ones are shortened with their cluster."""

T = TypeVar("T")


class Response:
    """How rows follow the background, those that overlap together."""

    def __init__(
        self,
        slopes: Slopes,
        starts: NDArray[np.int64],
        light: Light,
        totals: NDArray[np.float32],
        information: FloatArray,
        pool: ThreadPoolExecutor,
        *,
        joint: bool = False,
    ) -> None:
        self._slopes, self._pool = slopes, pool
        owner = np.empty(starts[-1], dtype=np.int64)
        find_clusters(slopes.squares, starts, owner)
        rows = np.argsort(owner, kind="stable")
        firsts, count = np.unique(owner, return_counts=True)
        edges = np.append(0, np.cumsum(count))
        corners = np.append(0, np.cumsum((slopes.values.shape[1] * count) ** 2))
        frame = np.searchsorted(starts, firsts, side="right") - 1
        factors, steps = np.empty(corners[-1]), np.zeros(slopes.moves.shape if joint else (0, 0))
        self._clusters = Clusters(rows, edges, frame, corners, factors, steps)
        k, area = slopes.values.shape[1:]
        self._largest = n = k * int(count.max(initial=0))

        def join(a: int, b: int) -> None:
            join_rows(
                slopes, self._clusters, light, totals, information, a, b,
                np.empty(2 * n * n + 2 * n + k * k), np.empty(n, dtype=np.int64),
                np.empty((1 + 2 * k, area), dtype=np.float32),
            )  # fmt: skip

        self._share(join)

    def _share(self, task: Callable[[int, int], T]) -> list[T]:
        """Run a task for parts of the clusters, half-open ranges, several at a time."""
        edges = np.linspace(0, len(self._clusters.frame), 8 + 1).astype(int).tolist()
        return list(self._pool.map(lambda part: task(*part), pairwise(edges)))

    def _room(self) -> tuple[NDArray[np.float32], FloatArray]:
        """Room for a square and for the steps of a cluster."""
        return np.empty(self._slopes.values.shape[2], dtype=np.float32), np.empty(self._largest)

    def step(
        self, move: FloatArray, total: FloatArray, used: BoolArray, damping: float
    ) -> FloatArray:
        """Tell where turns of background and rows would end.

        The rows follow the background and the background them: what a step δ leaves over is
        move − δ + N⁻¹ Σ Gᵀ F⁻¹ G δ.  It vanishes where M δ = N move; the conjugate gradients that
        solve it see M only by what it does to an image.

        Shapes: `move` (y, x), `total` (y, x), `used` (y, x), result (y, x).
        """
        counts, room = np.where(used, total, 0.0), np.empty_like(self._slopes.units)

        def undetermined(step: FloatArray) -> FloatArray:
            image = step.reshape(used.shape)

            def taken(first: int, last: int) -> FloatArray:
                out = np.zeros(used.shape)
                follow_rows(
                    self._slopes, self._clusters, first, last, image, room, out, *self._room()
                )
                return out

            out = (1 + damping) * counts * image
            for part in self._share(taken):
                out -= part
            return np.where(used, out, image).ravel()

        weight = np.where(used, np.maximum(counts, 1.0), 1.0).ravel()
        square = (move.size, move.size)
        of = scipy.sparse.linalg
        step, _ = of.cg(
            of.LinearOperator(square, undetermined, dtype=np.float64),
            (counts * move).ravel(),
            rtol=0.02,  # of a step that is left to the next
            maxiter=40,  # of the conjugate gradients
            M=of.LinearOperator(square, lambda v: v.ravel() / weight, dtype=np.float64),
        )
        return np.asarray(np.clip(step.reshape(move.shape), -_FARTHEST, _FARTHEST))

    def followed(
        self,
        theta: FloatArray,
        step: FloatArray,
        free: BoolArray,
        walls: tuple[FloatArray, FloatArray],
    ) -> FloatArray:
        """Let rows follow a step of the background, to first order.

        Shapes: `theta` (rows, 5), `step` (y, x), `free` (5,), result (rows, 5).
        """
        steps, nowhere = np.empty_like(self._slopes.units), np.empty((0, 0))
        self._share(
            lambda a, b: follow_rows(
                self._slopes, self._clusters, a, b, step, steps, nowhere, *self._room()
            )
        )
        out, index = theta.copy(), np.flatnonzero(free[:4])
        low, high = (wall[index] for wall in walls)
        out[:, index] = np.clip(theta[:, index] - steps, low, high)
        return out

    def together(
        self, theta: FloatArray, free: BoolArray, walls: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """Let rows that overlap follow one another, to first order.

        Each was fitted with the others as they were then; those that came after it have moved.

        Shapes: result (rows, 5).
        """
        out, index = theta.copy(), np.flatnonzero(free[:4])
        count = np.diff(self._clusters.edges)
        rows = self._clusters.rows[np.repeat(count > 1, count)]
        if rows.size:
            count = count[count > 1]
            here, steps = theta[np.ix_(rows, index)], self._clusters.steps[rows]
            most = np.broadcast_to(_LONGEST[index], here.shape).copy()
            most[:, index == 3] *= np.abs(here[:, index == 3])
            length = np.abs(steps)
            share = np.divide(most, length, out=np.ones_like(most), where=length > most)
            share = np.minimum.reduceat(share.min(axis=1), np.cumsum(count) - count)
            low, high = (wall[index] for wall in walls)
            here = here + np.repeat(share, count)[:, None] * steps
            out[np.ix_(rows, index)] = np.clip(here, low, high)
        return out
