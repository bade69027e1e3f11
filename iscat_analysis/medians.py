"""Medians of many numbers that are known to be finite, several times as fast as in libraries."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SIGMA_PER_MAD = 1.482602218505602
"""Standard deviation of normal numbers over the median of their absolute deviations."""


def robust_sigma(deviations: NDArray[np.floating]) -> float:
    """Estimate the standard deviation of normal deviations from zero by their median size."""
    return SIGMA_PER_MAD * float(np.median(np.abs(deviations)))


def middle(values: NDArray[np.floating]) -> Any:
    """Give medians along the last axis, several times as fast as NumPy, which looks for NaN.

    Shapes: `values` (..., n), result (...).
    """
    half = values.shape[-1] // 2
    values.partition(half, axis=-1)
    upper = values[..., half]
    return upper if values.shape[-1] % 2 else (values[..., :half].max(axis=-1) + upper) / 2


def median_3x3(image: NDArray[np.floating]) -> NDArray[np.floating]:
    """Give each pixel the median of the nine around it; beyond an edge the image is mirrored.

    Of three sorted columns it is the median of three numbers: the largest of the least, the median
    of the medians, the least of the largest (J. L. Smith, "Implementing median filters in XC4000E
    FPGAs", XCell 23, 16, 1996).

    Shapes: `image` (y, x), result (y, x).
    """
    padded = np.pad(image, 1, mode="symmetric")
    low, middle, high = _sorted(padded[:-2], padded[1:-1], padded[2:])

    def beside(part: NDArray[np.floating]) -> tuple[NDArray[np.floating], ...]:
        return part[:, :-2], part[:, 1:-1], part[:, 2:]

    return _sorted(
        np.maximum.reduce(beside(low)), _sorted(*beside(middle))[1], np.minimum.reduce(beside(high))
    )[1]


def _sorted(
    a: NDArray[np.floating], b: NDArray[np.floating], c: NDArray[np.floating]
) -> tuple[NDArray[np.floating], ...]:
    """Sort the three numbers of each pixel."""
    a, b = np.minimum(a, b), np.maximum(a, b)
    b, c = np.minimum(b, c), np.maximum(b, c)
    return np.minimum(a, b), np.maximum(a, b), c
