"""Small dense linear systems with a symmetric positive matrix, for some of its parameters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST = 1e-13
"""Smallest pivot of a matrix with ones on its diagonal that counts as information."""


@kernel(forceinline=True, _nrt=False)
def factorise(
    matrix: FloatArray, index: IntArray, scale: FloatArray, damping: float, lower: FloatArray
) -> bool:
    """Fill `lower` (n, n) with Cholesky's factor of the parameters `index` (n); False if singular.

    `scale` (n) makes a diagonal near one, to which `damping` is added.
    """
    for i in range(index.size):
        for j in range(i + 1):
            total = matrix[index[i], index[j]] * scale[i] * scale[j]
            if i == j:
                total += damping
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if j < i:
                lower[i, j] = total / lower[j, j]
            elif total > LEAST:
                lower[i, i] = np.sqrt(total)
            else:
                return False
    return True


@kernel(forceinline=True, _nrt=False)
def solve(lower: FloatArray, values: FloatArray) -> None:
    """Solve L Lᵀ x = values (n) with a factor L (n, n) from `factorise`, in place."""
    n = values.size
    for i in range(n):
        total = values[i]
        for k in range(i):
            total -= lower[i, k] * values[k]
        values[i] = total / lower[i, i]
    for i in range(n - 1, -1, -1):
        total = values[i]
        for k in range(i + 1, n):
            total -= lower[k, i] * values[k]
        values[i] = total / lower[i, i]
