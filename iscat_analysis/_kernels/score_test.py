"""Rao's score test against modes, with the fitted directions projected out.

Everything is a vector over the pixels, in units of their standard deviation.  A Cholesky
factorisation of the vectors' Gram matrix, fitted directions first, makes every mode orthogonal to
what precedes it; the squares of the residual's components along the modes then add up to a χ².
Written out because a threaded BLAS is slower than this by far on matrices so small.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.image import FAST

FloatArray = NDArray[np.float64]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _dot(a: FloatArray, b: FloatArray) -> float:
    """Scalar product, shape (n,) each."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def score_statistic(
    vectors: FloatArray, fitted: int, residual: FloatArray, dependent: float
) -> tuple[float, int]:
    """Sum of squares of the residual along the modes.

    Parameters
    ----------
    vectors : ndarray, shape (m, n)
        Fitted directions, then modes; overwritten with unit vectors.
    fitted : int
        How many of them are fitted directions.
    residual : ndarray, shape (n,)
        Data minus model.
    dependent : float
        Share of a vector outside the preceding ones that counts as none; such a vector is left out.

    Returns
    -------
    chi2 : float
        The statistic.
    freedom : int
        Modes that took part.
    """
    m = vectors.shape[0]
    lower = np.zeros((m, m))
    along = np.zeros(m)
    chi2 = 0.0
    freedom = 0
    for k in range(m):
        size = np.sqrt(_dot(vectors[k], vectors[k]))
        if not size > 0.0:
            continue
        for i in range(vectors.shape[1]):
            vectors[k, i] /= size
        left = 1.0
        for j in range(k):
            if lower[j, j] > 0.0:
                total = _dot(vectors[k], vectors[j])
                for i in range(j):
                    total -= lower[k, i] * lower[j, i]
                lower[k, j] = total / lower[j, j]
                left -= lower[k, j] ** 2
        if not left > dependent:
            continue
        lower[k, k] = np.sqrt(left)
        total = _dot(vectors[k], residual)
        for i in range(k):
            total -= lower[k, i] * along[i]
        along[k] = total / lower[k, k]
        if k >= fitted:
            chi2 += along[k] ** 2
            freedom += 1
    return chi2, freedom
