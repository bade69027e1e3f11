"""How the rows of `iscat_analysis._kernels.moving` follow a change of their background.

Where the logarithm of the background changes by δ, the estimates of rows change by -F⁻¹ G δ.  F is
the information on all rows of a *cluster* together, those of a frame whose middles lie in one
another's squares: each of two takes up a part of what both see, and alone would take up all of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.canvas import Light
from iscat_analysis._kernels.dense import factorise
from iscat_analysis._kernels.lattice import FAST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_STIFFER, _STIFFEST = 1e-3, 1.0
"""What is added to F, relative to its diagonal, for rows that cannot be told from each other: the
least, and the most where rounding makes of F what no information is."""


class Slopes(NamedTuple):
    """What rows change of the light in their squares; without room, left alone.

    Attributes
    ----------
    squares : ndarray of int, shape (rows, 4)
        First and last row and column of each, half-open; all 0 where a row is not fitted.
    values : ndarray of float32, shape (rows, k, side²)
        G, w B ∂C for each free parameter [e per unit].
    """

    squares: IntArray
    values: NDArray[np.float32]


class Clusters(NamedTuple):
    """Rows of a frame that overlap one another, and the information on them.

    Attributes
    ----------
    rows : ndarray of int, shape (rows,)
        Numbers of the rows, cluster after cluster.
    edges : ndarray of int, shape (clusters + 1,)
        Where in `rows` each begins.
    frame : ndarray of int, shape (clusters,)
        Frame of each.
    corners : ndarray of int, shape (clusters + 1,)
        Where in `factors` each begins.
    factors : ndarray, shape (sum of (k rows of a cluster)²,)
        Cholesky's factors L of F = L Lᵀ.
    """

    rows: IntArray
    edges: IntArray
    frame: IntArray
    corners: IntArray
    factors: FloatArray


@kernel(fastmath=FAST, _nrt=False)
def keep_slopes(
    level: FloatArray, gradient: FloatArray, index: IntArray, out: NDArray[np.float32]
) -> None:
    """Fill `out` (k, pixels) with level × gradient of the free parameters."""
    ny, nx = level.shape
    for k in range(index.size):
        parameter = 1 + index[k]
        for i in range(ny):
            for j in range(nx):
                out[k, i * nx + j] = level[i, j] * gradient[i, parameter, j]


@kernel()
def find_clusters(squares: IntArray, starts: IntArray, owner: IntArray) -> None:
    """Say which rows overlap by half their squares, directly or through others.

    Parameters
    ----------
    squares : ndarray of int, shape (rows, 4)
        As in `Slopes`.
    starts : ndarray of int, shape (t + 1,)
        First row of each frame.
    owner : ndarray of int, shape (rows,)
        Filled with the first row of the cluster of each.
    """
    for t in range(starts.size - 1):
        for r in range(starts[t], starts[t + 1]):
            owner[r] = r
            r0, r1, c0, c1 = squares[r]
            for s in range(starts[t], r):
                s0, s1, d0, d1 = squares[s]
                far = abs(r0 + r1 - s0 - s1) >= max(r1 - r0, s1 - s0)
                if far or abs(c0 + c1 - d0 - d1) >= max(c1 - c0, d1 - d0):
                    continue
                mine, theirs = owner[r], owner[s]
                low, high = min(mine, theirs), max(mine, theirs)
                for q in range(starts[t], r + 1 if low < high else starts[t]):
                    if owner[q] == high:
                        owner[q] = low


@kernel()
def join_rows(
    slopes: Slopes, clusters: Clusters, light: Light, totals: NDArray[np.float32],
    information: FloatArray, first: int, last: int,
) -> None:  # fmt: skip
    """Factorise the information on the rows of some clusters.

    Parameters
    ----------
    slopes : Slopes
        Of all rows.
    clusters : Clusters
        Their factors are filled.
    light : Light
        The movie.
    totals : ndarray of float32, shape (t, y, x)
        Signal of all rows of each frame.
    information : ndarray, shape (rows, k, k)
        On each row alone.
    first, last : int
        Clusters first…last − 1.
    """
    k = slopes.values.shape[1]
    block = np.empty((k, k))
    for c in range(first, last):
        rows = clusters.rows[clusters.edges[c] : clusters.edges[c + 1]]
        n, t = k * rows.size, clusters.frame[c]
        joint, scale = np.zeros((n, n)), np.ones(n)
        for a in range(rows.size):
            joint[k * a : k * (a + 1), k * a : k * (a + 1)] = information[rows[a]]
            for b in range(a):
                if _overlap(slopes, light, t, totals[t], rows[a], rows[b], block):
                    joint[k * a : k * (a + 1), k * b : k * (b + 1)] = block
        for i in range(n):
            if joint[i, i] > 0.0:
                scale[i] = 1.0 / np.sqrt(joint[i, i])
            else:  # what it changes is not seen
                joint[i, i] = 1.0
        low = clusters.factors[clusters.corners[c] : clusters.corners[c + 1]].reshape(n, n)
        stiffer = _STIFFER
        while not factorise(joint, np.arange(n), scale, stiffer, low) and stiffer < _STIFFEST:
            stiffer *= 10.0
        for i in range(n):
            for j in range(i + 1):
                low[i, j] /= scale[i]


@kernel(fastmath=FAST)
def _overlap(
    slopes: Slopes, light: Light, t: int, total: NDArray[np.float32], r: int, s: int,
    out: FloatArray,
) -> bool:  # fmt: skip
    """Fill `out` (k, k) with the information that two rows share; tell whether they do."""
    r0, r1, c0, c1 = slopes.squares[r]
    s0, s1, d0, d1 = slopes.squares[s]
    top, bottom, left, right = max(r0, s0), min(r1, s1), max(c0, d0), min(c1, d1)
    if top >= bottom or left >= right:
        return False
    k, width = out.shape[0], right - left
    weight, weighted = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    out[:] = 0.0
    for i in range(top, bottom):
        for j in range(width):
            level = light.power[t] * light.background[i, left + j]
            variance = level * (1.0 + total[i, left + j]) + light.read[i, left + j]
            weight[j] = 1.0 / variance if variance > 0.0 else 0.0
        mine, theirs = (i - r0) * (c1 - c0) + left - c0, (i - s0) * (d1 - d0) + left - d0
        for a in range(k):
            for j in range(width):
                weighted[j] = weight[j] * slopes.values[r, a, mine + j]
            for b in range(k):
                felt = np.float32(0.0)
                for j in range(width):
                    felt += weighted[j] * slopes.values[s, b, theirs + j]
                out[a, b] += felt
    return True


@kernel(fastmath=FAST)
def _shift(slopes: Slopes, clusters: Clusters, c: int, move: FloatArray) -> FloatArray:
    """F⁻¹ G move of a cluster, shape (its rows × k,)."""
    rows = clusters.rows[clusters.edges[c] : clusters.edges[c + 1]]
    k = slopes.values.shape[1]
    n = k * rows.size
    step = np.empty(n)
    for q in range(rows.size):
        r0, r1, c0, c1 = slopes.squares[rows[q]]
        nx = c1 - c0
        for a in range(k):
            felt = np.float32(0.0)
            for i in range(r1 - r0):
                slope = slopes.values[rows[q], a, i * nx : (i + 1) * nx]
                here = move[r0 + i, c0:c1]
                for j in range(nx):
                    felt += slope[j] * np.float32(here[j])
            step[k * q + a] = felt
    low = clusters.factors[clusters.corners[c] : clusters.corners[c + 1]].reshape(n, n)
    for i in range(n):
        for j in range(i):
            step[i] -= low[i, j] * step[j]
        step[i] /= low[i, i]
    for i in range(n - 1, -1, -1):
        step[i] /= low[i, i]
        for j in range(i):
            step[j] -= low[i, j] * step[i]
    return step


@kernel(fastmath=FAST)
def follow_rows(
    slopes: Slopes, clusters: Clusters, first: int, last: int, move: FloatArray, out: FloatArray
) -> None:
    """Add what the rows of some clusters take up of a change of the logarithm of the background.

    Parameters
    ----------
    slopes, clusters
        As `join_rows` left them.
    first, last : int
        Clusters first…last − 1.
    move : ndarray, shape (y, x)
        Change.
    out : ndarray, shape (y, x)
        Σ Gᵀ F⁻¹ G move is added to it [e].
    """
    k = slopes.values.shape[1]
    for c in range(first, last):
        step = _shift(slopes, clusters, c, move)
        rows = clusters.rows[clusters.edges[c] : clusters.edges[c + 1]]
        for q in range(rows.size):
            r0, r1, c0, c1 = slopes.squares[rows[q]]
            nx = c1 - c0
            for a in range(k):
                by = step[k * q + a]
                for i in range(r1 - r0):
                    slope = slopes.values[rows[q], a, i * nx : (i + 1) * nx]
                    here = out[r0 + i, c0:c1]
                    for j in range(nx):
                        here[j] += by * slope[j]


@kernel()
def shift_rows(
    slopes: Slopes, clusters: Clusters, first: int, last: int, move: FloatArray, index: IntArray,
    lower: FloatArray, upper: FloatArray, theta: FloatArray,
) -> None:  # fmt: skip
    """Let the rows of some clusters follow a change of the logarithm of the background.

    Parameters
    ----------
    slopes, clusters
        As `join_rows` left them.
    first, last : int
        Clusters first…last − 1.
    move : ndarray, shape (y, x)
        Change.
    index : ndarray of int, shape (k,)
        Free parameters.
    lower, upper : ndarray, shape (5,)
        Bounds of the parameters.
    theta : ndarray, shape (rows, 5)
        Moved.
    """
    k = index.size
    for c in range(first, last):
        step = _shift(slopes, clusters, c, move)
        rows = clusters.rows[clusters.edges[c] : clusters.edges[c + 1]]
        for q in range(rows.size):
            for a in range(k):
                i = index[a]
                moved = theta[rows[q], i] - step[k * q + a]
                theta[rows[q], i] = min(max(moved, lower[i]), upper[i])
