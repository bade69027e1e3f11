"""Newton's step of a background that the particles over it follow."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
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

_PARTS = 8  # of the clusters, that threads take in turn
_STEP_RESIDUE = 0.02  # of a step that is left to the next
_MOST_STEPS = 40  # of the conjugate gradients
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
        edges = np.linspace(0, len(self._clusters.frame), _PARTS + 1).astype(int).tolist()
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
            rtol=_STEP_RESIDUE,
            maxiter=_MOST_STEPS,
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
