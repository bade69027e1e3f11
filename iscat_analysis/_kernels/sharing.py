"""What the rows of one track send to the pixels of their background, and feel of it.

A row knows its pixels by its slopes G = w B ∂C (see `iscat_analysis._kernels.following`).  All is
done row by row, for several images at once, so that the slopes are read from memory once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.following import Slopes, look, mix, product, put
from iscat_analysis._kernels.lattice import FAST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel(fastmath=FAST, _nrt=False)
def own_shares(
    slopes: Slopes, rows: IntArray, squares: IntArray, weight: FloatArray, out: FloatArray,
    work: FloatArray, weighted: FloatArray,
) -> None:  # fmt: skip
    """Give what the background takes from each row alone.

    Parameters
    ----------
    slopes : Slopes
        Of all rows.
    rows : ndarray of int, shape (n,)
        Those of the track.
    squares : ndarray of int, shape (n, 4)
        Of these, in the images.
    weight : ndarray, shape (y, x)
        Of the pixels.
    out : ndarray, shape (n, k, k)
        Filled with Σ weight G Gᵀ.
    work, weighted : ndarray, shape (side²,)
        Room for squares.
    """
    k = slopes.values.shape[1]
    for q in range(rows.size):
        values, units = slopes.values[rows[q]], slopes.units[rows[q]]
        size = look(weight, squares[q], work)
        for a in range(k):
            slope, unit = values[a], units[a]
            for j in range(size):
                weighted[j] = unit * work[j] * slope[j]
            for b in range(a + 1):
                out[q, a, b] = out[q, b, a] = units[b] * product(values[b], weighted, size)


@kernel(fastmath=FAST, _nrt=False)
def send(
    slopes: Slopes, rows: IntArray, squares: IntArray, by: FloatArray, out: FloatArray,
    work: FloatArray,
) -> None:  # fmt: skip
    """Add to images what rows send to them.

    Parameters
    ----------
    slopes, rows, squares
        As in `own_shares`.
    by : ndarray, shape (n, b, k)
        Numbers.
    out : ndarray, shape (b, y, x)
        Σ Gᵀ by is added to it.
    work : ndarray, shape (side²,)
        Room for a square.
    """
    for q in range(rows.size):
        values, units, square = slopes.values[rows[q]], slopes.units[rows[q]], squares[q]
        size = (square[1] - square[0]) * (square[3] - square[2])
        for v in range(by.shape[1]):
            mix(values, units, by[q, v], size, work)
            put(work, square, out[v])


@kernel(fastmath=FAST, _nrt=False)
def follow(
    slopes: Slopes, rows: IntArray, squares: IntArray, covariance: FloatArray,
    images: FloatArray, felt: FloatArray, out: FloatArray, work: FloatArray, by: FloatArray,
) -> None:  # fmt: skip
    """Give what rows feel of images, and what they send back as they follow.

    Parameters
    ----------
    slopes, rows, squares
        As in `own_shares`.
    covariance : ndarray, shape (n, k, k)
        Of each row, by which it follows.
    images : ndarray, shape (b, y, x)
        Of the pixels.
    felt : ndarray, shape (n, b, k)
        Filled with G image.
    out : ndarray, shape (b, y, x)
        Σ Gᵀ covariance G image is added to it.
    work : ndarray, shape (side²,)
        Room for a square.
    by : ndarray, shape (k,)
        Room for a change.
    """
    k = slopes.values.shape[1]
    for q in range(rows.size):
        values, units, square = slopes.values[rows[q]], slopes.units[rows[q]], squares[q]
        for v in range(images.shape[0]):
            size = look(images[v], square, work)
            for a in range(k):
                felt[q, v, a] = units[a] * product(values[a], work, size)
            for a in range(k):
                by[a] = 0.0
                for b in range(k):
                    by[a] += covariance[q, a, b] * felt[q, v, b]
            mix(values, units, by, size, work)
            put(work, square, out[v])
