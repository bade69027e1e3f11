"""Medians of many numbers that are known to be finite."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def middle(values: NDArray[np.floating]) -> Any:
    """Give medians along the last axis, several times as fast as NumPy, which looks for NaN.

    Parameters
    ----------
    values : ndarray, shape (..., n)
        Finite; sorted by halves afterwards.

    Returns
    -------
    ndarray, shape (...)
        Of the same type; of an even number, the mean of the two in the middle.
    """
    half = values.shape[-1] // 2
    values.partition(half, axis=-1)
    upper = values[..., half]
    return upper if values.shape[-1] % 2 else (values[..., :half].max(axis=-1) + upper) / 2
