"""How far one image has moved against another, and how much the light of pixels varies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import BoolArray, FloatArray, kernel


@kernel()
def _fade(share: float) -> float:
    """From 0 to 1, with two derivatives that vanish at either end."""
    return share**3 * (10 + share * (6 * share - 15))


@kernel()
def extend(image: FloatArray, out: FloatArray) -> None:
    """Continue an image beyond its edges so that opposite ends meet.

    Shapes: `image` (y, x), `out` (y + m, x + n).
    """
    rows, columns = image.shape
    more_rows, more_columns = out.shape[0] - rows, out.shape[1] - columns
    for i in range(rows):
        for j in range(columns):
            out[i, j] = image[i, j]
        for k in range(more_columns):
            share = _fade((k + 1) / (more_columns + 1))
            near = image[i, max(columns - 1 - k, 0)]
            far = image[i, min(more_columns - 1 - k, columns - 1)]
            out[i, columns + k] = (1 - share) * near + share * far
    for k in range(more_rows):
        share = _fade((k + 1) / (more_rows + 1))
        near_row, far_row = max(rows - 1 - k, 0), min(more_rows - 1 - k, rows - 1)
        for j in range(out.shape[1]):
            out[rows + k, j] = (1 - share) * out[near_row, j] + share * out[far_row, j]


@kernel()
def mismatch(
    pattern: FloatArray,
    image: FloatArray,
    used: BoolArray,
    pattern_read: FloatArray,
    image_read: FloatArray,
    ratio: float,
    out: FloatArray,
) -> None:
    """Contrast of an image against a pattern in standard deviations.

    Shapes: `pattern, image` (y, x), `used` (y, x), `pattern_read, image_read` (y, x), `out` (y,
    x).
    """
    rows, columns = pattern.shape
    for i in range(rows):
        for j in range(columns):
            expected = ratio * pattern[i, j]
            if used[i, j] and expected > 0:
                variance = (1 + ratio) * expected
                variance += image_read[i, j] + ratio * ratio * pattern_read[i, j]
                out[i, j] = (image[i, j] - expected) / np.sqrt(variance)
            else:
                out[i, j] = np.nan


@kernel()
def shift_equations(
    pattern: FloatArray,
    pattern_read: FloatArray,
    image_read: FloatArray,
    ratio: float,
    deviation: FloatArray,
    limit: float,
    normal: FloatArray,
    right: FloatArray,
) -> float:
    """Weighted least squares of the shift and level that explain a mismatch.

    Shapes: `pattern, pattern_read, image_read` (y, x), `deviation` (y, x), `normal` (3, 3),
    `right` (3,).
    """
    rows, columns = pattern.shape
    normal[:] = 0.0
    right[:] = 0.0
    spurious = 0.0
    g = np.empty(3)
    for i in range(2, rows - 2):
        for j in range(2, columns - 2):
            z = deviation[i, j]
            if not abs(z) <= limit:
                continue
            expected = ratio * pattern[i, j]
            variance = (1 + ratio) * expected
            variance += image_read[i, j] + ratio * ratio * pattern_read[i, j]
            scale = ratio / np.sqrt(variance)
            up = pattern[i - 2, j] - 8 * pattern[i - 1, j]
            left = pattern[i, j - 2] - 8 * pattern[i, j - 1]
            g[0] = -scale * (up + 8 * pattern[i + 1, j] - pattern[i + 2, j]) / 12
            g[1] = -scale * (left + 8 * pattern[i, j + 1] - pattern[i, j + 2]) / 12
            g[2] = scale * pattern[i, j]
            spurious += scale * scale * (pattern[i, j] + pattern_read[i, j]) * (130 / 144)
            for m in range(3):
                right[m] += g[m] * z
                for n in range(3):
                    normal[m, n] += g[m] * g[n]
    normal[0, 0] -= spurious
    normal[1, 1] -= spurious
    return spurious


@kernel()
def block_extremes(
    counts: NDArray[Any], summed: FloatArray, highest: NDArray[Any], still: BoolArray
) -> None:
    """Sum frames, and tell which pixels change.

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
    """Add squared deviations of frames from their mean, and products with those of neighbours.

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
    """Add the square of an image, and its product with the mean of both neighbours.

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
    """Give both neighbours of an index; at the border twice the inner one, alone twice itself."""
    last = size - 1
    return min(abs(index - 1), last), max(last - abs(last - 1 - index), 0)
