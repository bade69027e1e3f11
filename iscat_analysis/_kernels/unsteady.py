"""How the counts of pixels scatter, and those beside them along: frames as they are stored."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@kernel()
def block_extremes(
    counts: NDArray[Any], summed: FloatArray, highest: NDArray[Any], still: BoolArray
) -> None:
    """Sum frames, and see which pixels change.

    Shapes: `counts` (t, y, x), `summed` (y, x), `highest` (y, x), `still` (y, x).
    """
    frames, rows, columns = counts.shape
    for t in range(frames):
        for i in range(rows):
            for j in range(columns):
                c = counts[t, i, j]
                summed[i, j] += c
                highest[i, j] = max(highest[i, j], c)
                still[i, j] &= c == counts[0, i, j]


@kernel()
def block_powers(
    counts: NDArray[Any], gain: FloatArray, offset: FloatArray, lit: BoolArray
) -> FloatArray:
    """Mean photoelectrons of every frame.

    Shapes: `counts` (t, y, x), `gain, offset` (y, x), `lit` (y, x), result (t,).
    """
    frames, rows, columns = counts.shape
    powers = np.zeros(frames)
    for t in range(frames):
        number = 0
        for i in range(rows):
            line = 0.0
            for j in range(columns):
                if lit[i, j]:
                    line += gain[i, j] * (counts[t, i, j] - offset[i, j])
                    number += 1
            powers[t] += line
        powers[t] /= number
    return powers


@kernel()
def add_scatter(
    counts: NDArray[Any],
    gain: FloatArray,
    offset: FloatArray,
    powers: FloatArray,
    mean: FloatArray,
    change: FloatArray,
    squares: FloatArray,
    products: FloatArray,
) -> None:
    """Add what frames have beyond their mean, squared, and times what those beside have.

    Shapes: `counts` (t, y, x), `gain, offset` (y, x), `powers` (t,), `mean` (y, x), `change` (y,
    x), `squares, products` (y, x) and (2, y, x).
    """
    frames, rows, columns = counts.shape
    mean[:] = 0.0
    for t in range(frames):
        for i in range(rows):
            for j in range(columns):
                mean[i, j] += gain[i, j] * (counts[t, i, j] - offset[i, j]) / powers[t]
    for i in range(rows):
        for j in range(columns):
            mean[i, j] /= frames
    for t in range(frames):
        for i in range(rows):
            for j in range(columns):
                electrons = gain[i, j] * (counts[t, i, j] - offset[i, j])
                change[i, j] = electrons / powers[t] - mean[i, j]
        add_image(change, squares, products)


@kernel()
def add_image(image: FloatArray, squares: FloatArray, products: FloatArray) -> None:
    """Add an image squared, and times the mean of the pixels on both sides.

    Shapes: `image` (y, x), `squares` (y, x), `products` (2, y, x).
    """
    rows, columns = image.shape
    for i in range(rows):
        above, below = _neighbour_range(i, rows)
        for j in range(columns):
            left, right = _neighbour_range(j, columns)
            own = image[i, j]
            squares[i, j] += own**2
            products[0, i, j] += own * (image[above, j] + image[below, j]) / 2
            products[1, i, j] += own * (image[i, left] + image[i, right]) / 2


@kernel()
def _neighbour_range(index: int, size: int) -> tuple[int, int]:
    """Give the places on both sides, at the border twice the one inside, alone twice itself."""
    last = size - 1
    return min(abs(index - 1), last), max(last - abs(last - 1 - index), 0)
