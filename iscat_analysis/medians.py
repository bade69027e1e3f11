"""Medians of many numbers that are known to be finite."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def middle(values: NDArray[np.floating]) -> Any:
    """Give medians along the last axis, several times as fast as NumPy, which looks for NaN.

    Shapes: `values` (..., n), result (...).
    """
    half = values.shape[-1] // 2
    values.partition(half, axis=-1)
    upper = values[..., half]
    return upper if values.shape[-1] % 2 else (values[..., :half].max(axis=-1) + upper) / 2
