"""What the rows of one track send to the pixels of their background, and feel of it.

A row knows its pixels by its slopes G = w B ∂C (see `iscat_analysis._kernels.following`).  All is
done row by row, for several images at once, so that the slopes are read from memory once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.following import Slopes
from iscat_analysis._kernels.lattice import FAST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel(fastmath=FAST, _nrt=False)
def _look(image: FloatArray, corner: tuple[int, int], square: IntArray, out: FloatArray) -> int:
    """Fill `out` with the pixels of a square, row after row, and tell how many they are."""
    r0, r1, c0, c1 = square
    top, left = r0 - corner[0], c0 - corner[1]
    nx = c1 - c0
    for i in range(r1 - r0):
        for j in range(nx):
            out[i * nx + j] = image[top + i, left + j]
    size: int = (r1 - r0) * nx
    return size


@kernel(fastmath=FAST, _nrt=False)
def _send(
    slopes: NDArray[np.float32], by: FloatArray, corner: tuple[int, int], square: IntArray,
    work: FloatArray, image: FloatArray,
) -> None:  # fmt: skip
    """Add slopes (k, side²) times numbers (k) to the pixels of a square."""
    r0, r1, c0, c1 = square
    top, left = r0 - corner[0], c0 - corner[1]
    nx = c1 - c0
    size = (r1 - r0) * nx
    for j in range(size):
        work[j] = by[0] * slopes[0, j]
    for a in range(1, by.size):
        factor, slope = by[a], slopes[a]
        for j in range(size):
            work[j] += factor * slope[j]
    for i in range(r1 - r0):
        for j in range(nx):
            image[top + i, left + j] += work[i * nx + j]


@kernel(fastmath=FAST, _nrt=False)
def _product(slope: NDArray[np.float32], values: FloatArray, size: int) -> float:
    """Sum the products of the first pixels."""
    total = 0.0
    for j in range(size):
        total += slope[j] * values[j]
    return total


@kernel(fastmath=FAST)
def own_shares(
    slopes: Slopes, rows: IntArray, corner: tuple[int, int], weight: FloatArray, out: FloatArray
) -> None:
    """Give what the background takes from each row alone.

    Parameters
    ----------
    slopes : Slopes
        Of all rows.
    rows : ndarray of int, shape (n,)
        Those of the track.
    corner : (int, int)
        Row and column of the first pixel of the images in the field.
    weight : ndarray, shape (y, x)
        Of the pixels.
    out : ndarray, shape (n, k, k)
        Filled with Σ weight G Gᵀ.
    """
    k = slopes.values.shape[1]
    work = np.empty(slopes.values.shape[2])
    weighted = np.empty(slopes.values.shape[2])
    for q in range(rows.size):
        values = slopes.values[rows[q]]
        size = _look(weight, corner, slopes.squares[rows[q]], work)
        for a in range(k):
            for j in range(size):
                weighted[j] = work[j] * values[a, j]
            for b in range(a + 1):
                out[q, a, b] = out[q, b, a] = _product(values[b], weighted, size)


@kernel(fastmath=FAST)
def send(
    slopes: Slopes, rows: IntArray, corner: tuple[int, int], by: FloatArray, out: FloatArray
) -> None:
    """Add to images what rows send to them.

    Parameters
    ----------
    slopes, rows, corner
        As in `own_shares`.
    by : ndarray, shape (n, b, k)
        Numbers.
    out : ndarray, shape (b, y, x)
        Σ Gᵀ by is added to it.
    """
    work = np.empty(slopes.values.shape[2])
    for q in range(rows.size):
        values, square = slopes.values[rows[q]], slopes.squares[rows[q]]
        for v in range(by.shape[1]):
            _send(values, by[q, v], corner, square, work, out[v])


@kernel(fastmath=FAST)
def follow(
    slopes: Slopes, rows: IntArray, corner: tuple[int, int], covariance: FloatArray,
    images: FloatArray, felt: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Give what rows feel of images, and what they send back as they follow.

    Parameters
    ----------
    slopes, rows, corner
        As in `own_shares`.
    covariance : ndarray, shape (n, k, k)
        Of each row, by which it follows.
    images : ndarray, shape (b, y, x)
        Of the pixels.
    felt : ndarray, shape (n, b, k)
        Filled with G image.
    out : ndarray, shape (b, y, x)
        Σ Gᵀ covariance G image is added to it.
    """
    k = slopes.values.shape[1]
    work, by = np.empty(slopes.values.shape[2]), np.empty(k)
    for q in range(rows.size):
        values, square = slopes.values[rows[q]], slopes.squares[rows[q]]
        for v in range(images.shape[0]):
            size = _look(images[v], corner, square, work)
            for a in range(k):
                felt[q, v, a] = _product(values[a], work, size)
            for a in range(k):
                by[a] = 0.0
                for b in range(k):
                    by[a] += covariance[q, a, b] * felt[q, v, b]
            _send(values, by, corner, square, work, out[v])
