"""What the rows of one track send to the pixels of their background, and feel of it.

A row knows its pixels by its slopes G = w B ∂C (see `background_response`).  All is
done row by row, for several images at once, so that the slopes are read from memory once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.background_response import Slopes, gather, mix, product, put
from iscat_analysis._kernels.lattice import FAST

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel(fastmath=FAST, _nrt=False)
def own_shares(
    slopes: Slopes, rows: IntArray, squares: IntArray, weight: FloatArray, out: FloatArray,
    work: FloatArray, weighted: FloatArray,
) -> None:  # fmt: skip
    """Give what the background takes from each row alone.

    Shapes: `rows` (n,), `squares` (n, 4), `weight` (y, x), `out` (n, k, k), `work, weighted`
    (side²,).
    """
    k = slopes.values.shape[1]
    for q in range(rows.size):
        values, units = slopes.values[rows[q]], slopes.units[rows[q]]
        size = gather(weight, squares[q], work)
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

    Shapes: `by` (n, b, k), `out` (b, y, x), `work` (side²,).
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

    Shapes: `covariance` (n, k, k), `images` (b, y, x), `felt` (n, b, k), `out` (b, y, x), `work`
    (side²,), `by` (k,).
    """
    k = slopes.values.shape[1]
    for q in range(rows.size):
        values, units, square = slopes.values[rows[q]], slopes.units[rows[q]], squares[q]
        for v in range(images.shape[0]):
            size = gather(images[v], square, work)
            for a in range(k):
                felt[q, v, a] = units[a] * product(values[a], work, size)
            for a in range(k):
                by[a] = 0.0
                for b in range(k):
                    by[a] += covariance[q, a, b] * felt[q, v, b]
            mix(values, units, by, size, work)
            put(work, square, out[v])
