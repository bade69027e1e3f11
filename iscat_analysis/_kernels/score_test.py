"""Rao's score test against modes, with the fitted directions projected out.

Everything is a vector over the pixels, in units of their standard deviation.  Modified
Gram–Schmidt, fitted directions first, makes every mode orthogonal to what precedes it; the squares
of the residual's components along the modes then add up to a χ².  Written out because a threaded
BLAS is slower than this by far on matrices so small.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.lattice import FAST

FloatArray = NDArray[np.float64]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _dot(a: FloatArray, b: FloatArray) -> float:
    """Scalar product, shape (n,) each."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _subtract(a: FloatArray, b: FloatArray, factor: float) -> None:
    """Take factor·b off a, shape (n,) each."""
    for i in range(a.size):
        a[i] -= factor * b[i]


@njit(cache=True, nogil=True, error_model="numpy")
def score_statistic(
    vectors: FloatArray, fitted: int, residual: FloatArray, dependent: float, leverage: FloatArray
) -> tuple[float, int]:
    """Sum of squares of the residual along the modes.

    Parameters
    ----------
    vectors : ndarray, shape (m, n)
        Fitted directions, then modes; overwritten with the orthonormal ones.
    fitted : int
        How many of them are fitted directions.
    residual : ndarray, shape (n,)
        Data minus model.
    dependent : float
        Squared share of a vector outside the preceding ones that counts as none; such a vector is
        left out.
    leverage : ndarray, shape (n,)
        Filled with each pixel's part in the statistic: the sum of its squared mode components.

    Returns
    -------
    chi2 : float
        The statistic.
    freedom : int
        Modes that took part.
    """
    used = np.zeros(vectors.shape[0], dtype=np.bool_)
    leverage[:] = 0.0
    chi2 = 0.0
    freedom = 0
    for k in range(vectors.shape[0]):
        v = vectors[k]
        size = _dot(v, v)
        if not size > 0.0:
            continue
        for j in range(k):
            if used[j]:
                _subtract(v, vectors[j], _dot(v, vectors[j]))
        left = _dot(v, v)
        if not left > dependent * size:
            continue
        used[k] = True
        length = np.sqrt(left)
        for i in range(v.size):
            v[i] /= length
        if k >= fitted:
            chi2 += _dot(v, residual) ** 2
            freedom += 1
            for i in range(v.size):
                leverage[i] += v[i] * v[i]
    return chi2, freedom
