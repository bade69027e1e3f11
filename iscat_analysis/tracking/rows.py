"""Rows of moving particles, the background under them, and how both follow each other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np
import pandas as pd
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
from iscat_analysis._kernels.moving import Search
from iscat_analysis.records import BoolArray, FloatArray, IntArray


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


NO_ROWS = Localizations.of(np.arange(0), np.arange(0), np.zeros((0, 5)))
"""None at all, as before the first search."""


def medians_of_tracks(track: IntArray, values: FloatArray) -> FloatArray:
    """Give every row the median of the values of its track.

    Shapes: `track` (n,), `values` (n,), result (n,).
    """
    return np.asarray(pd.Series(values).groupby(track).transform("median"), dtype=np.float64)


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
    slopes: Slopes
    gain: FloatArray
    chi2: FloatArray
    pixels: FloatArray
    worst: FloatArray
    level: FloatArray
    growth: FloatArray


_FARTHEST = 0.05  # step of the logarithm of the background
_LONGEST = np.array([50.0, 50.0, 20.0, 0.3, 0.0])
"""Step of rows that overlap [nm], relative; longer ones are shortened with their cluster."""

T = TypeVar("T")


class Response:
    """How rows follow the background, those that overlap together.

    The expected information on the rows, and the counts of all their pixels, are those of the last
    fit, whose box no row leaves.

    Shapes: `starts` (t + 1,), `totals` (t, y, x), `information` (rows, free, free).
    """

    def __init__(
        self,
        slopes: Slopes,
        starts: IntArray,
        light: Light,
        totals: NDArray[np.float32],
        information: FloatArray,
        search: Search,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._slopes, self._pool = slopes, pool
        self._index = np.flatnonzero(search.free[:4])
        self._walls = search.lower[self._index], search.upper[self._index]
        owner = np.empty(starts[-1], dtype=np.int64)
        find_clusters(slopes.squares, starts, owner)
        rows = np.argsort(owner, kind="stable")
        firsts, count = np.unique(owner, return_counts=True)
        edges = np.append(0, np.cumsum(count))
        corners = np.append(0, np.cumsum((self._index.size * count) ** 2))
        frame = np.searchsorted(starts, firsts, side="right") - 1
        factors, steps = np.empty(corners[-1]), np.zeros(slopes.moves.shape)
        self._clusters = Clusters(rows, edges, frame, corners, factors, steps)
        known = slopes, self._clusters, light, totals, information
        self._share(lambda a, b: join_rows(*known, a, b))

    def _share(self, task: Callable[[int, int], T]) -> list[T]:
        """Run a task for parts of the clusters, half-open ranges, several at a time."""
        edges = np.linspace(0, len(self._clusters.frame), 8 + 1).astype(int).tolist()
        return list(self._pool.map(lambda part: task(*part), pairwise(edges)))

    def step(
        self, move: FloatArray, total: FloatArray, used: BoolArray, damping: float
    ) -> FloatArray:
        """Extrapolate all further turns of background and rows from the first one, `move`.

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
                follow_rows(self._slopes, self._clusters, first, last, image, room, out)
                return out

            out = (1 + damping) * counts * image
            for part in self._share(taken):
                out -= part
            return np.where(used, out, image).ravel()

        weight = np.where(used, np.maximum(counts, 1.0), 1.0).ravel()
        operator, square = scipy.sparse.linalg.LinearOperator, (move.size, move.size)
        lost = operator(square, undetermined, dtype=np.float64)
        guess = operator(square, lambda v: v.ravel() / weight, dtype=np.float64)
        # 0.02 of a step is left to the next
        step, _ = scipy.sparse.linalg.cg(
            lost, (counts * move).ravel(), rtol=0.02, maxiter=40, M=guess
        )
        return np.asarray(np.clip(step.reshape(move.shape), -_FARTHEST, _FARTHEST))

    def followed(self, rows: Localizations, step: FloatArray) -> Localizations:
        """Let rows follow a step of the background, to first order.

        Shapes: `step` (y, x).
        """
        steps, nowhere = np.empty_like(self._slopes.units), np.empty((0, 0))
        known = self._slopes, self._clusters
        self._share(lambda a, b: follow_rows(*known, a, b, step, steps, nowhere))
        theta, index = rows.theta.copy(), self._index
        theta[:, index] = np.clip(theta[:, index] - steps, *self._walls)
        return replace(rows, theta=theta)

    def together(self, rows: Localizations) -> Localizations:
        """Let rows that overlap follow one another, to first order.

        Each was fitted with the others as they were then; those that came after it have moved.
        """
        count, index = np.diff(self._clusters.edges), self._index
        several = self._clusters.rows[np.repeat(count > 1, count)]
        if not several.size:
            return rows
        count, theta = count[count > 1], rows.theta.copy()
        here, steps = theta[np.ix_(several, index)], self._clusters.steps[several]
        most = np.broadcast_to(_LONGEST[index], here.shape).copy()
        most[:, index == 3] *= np.abs(here[:, index == 3])
        length = np.abs(steps)
        share = np.divide(most, length, out=np.ones_like(most), where=length > most)
        share = np.minimum.reduceat(share.min(axis=1), np.cumsum(count) - count)
        here = here + np.repeat(share, count)[:, None] * steps
        theta[np.ix_(several, index)] = np.clip(here, *self._walls)
        return replace(rows, theta=theta)
