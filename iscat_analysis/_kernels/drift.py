"""How far one image has moved against another, and images continued beyond their edges."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


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
