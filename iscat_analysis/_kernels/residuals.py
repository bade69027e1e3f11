"""Residuals of a fit: expected counts, deviations from them, and the pixels that deviate most.

Data are those of `iscat_analysis._kernels.noise`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.noise import residuals_of_row, tail_of_pixel, variance_of_pixel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel(fastmath=FAST)
def _row_totals(
    weight: FloatArray, rate: FloatArray, residual: FloatArray, kurtosis: FloatArray
) -> tuple[float, float, float, float, float]:
    """χ² of a row, its pixels, sum and largest size of their kurtosis, and the least rate."""
    chi2 = pixels = excess = largest = 0.0
    least = np.inf
    for j in range(rate.size):
        used = weight[j] > 0
        chi2 += residual[j] * residual[j]
        pixels += 1.0 if used else 0.0
        excess += kurtosis[j]
        largest = max(largest, abs(kurtosis[j]))
        least = min(least, rate[j] if used else np.inf)
    return chi2, pixels, excess, largest, least


@kernel()
def residuals(
    kind: int,
    data: FloatArray,
    level: float,
    rows: FloatArray,
    rate: FloatArray,
    residual: FloatArray,
    terms: FloatArray,
) -> tuple[float, int, float, float, float]:
    """Fill the expected counts of all pixels and the deviations from them.

    Shapes: `rows` (ny, 5 or more, nx), `rate` (ny, nx), `residual` (ny, nx), `terms` (ny, 4, nx).
    """
    chi2 = excess = largest = 0.0
    pixels, least = 0, np.inf
    for i in range(rows.shape[0]):
        residuals_of_row(kind, data, i, level, rows[i, 0], rate[i], residual[i], terms[i])
        square, used, sum_, most, low = _row_totals(data[2, i], rate[i], residual[i], terms[i, 3])
        chi2 += square
        pixels += int(used)
        excess += sum_
        largest, least = max(largest, most), min(least, low)
    return chi2, pixels, excess, largest, least


@kernel()
def _farthest(residual: FloatArray, index: IntArray) -> None:
    """Fill `index` (k) with the indices of the residuals of largest size, largest first."""
    index[:] = 0
    size = np.full(index.size, -1.0)
    last = index.size - 1
    for i in range(residual.size):
        here = abs(residual[i])
        if here > size[last]:
            k = last
            while k > 0 and here > size[k - 1]:
                size[k], index[k] = size[k - 1], index[k - 1]
                k -= 1
            size[k], index[k] = here, i


@kernel()
def suspects(
    kind: int, data: FloatArray, rate: FloatArray, residual: FloatArray, many: float,
    tails: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """Fill the arguments of the exact tail probabilities of the pixels that deviate most.

    Shapes: `rate, residual` (ny, nx), `tails` (3, k).
    """
    flat, rates, left = data.reshape(4, rate.size), rate.reshape(-1), residual.reshape(-1)
    index = np.empty(min(tails.shape[1], rate.size), dtype=np.int64)
    _farthest(left, index)
    least, count = 1.0, 0
    for i in index:
        observed, total, mean, share = flat[0, i], flat[1, i], rates[i], flat[3, i]
        if not flat[2, i] > 0.0:
            continue
        if variance_of_pixel(kind, total, share, mean) > many:
            least = min(least, math.erfc(abs(left[i]) * math.sqrt(0.5)))
            continue
        known, a, b, x = tail_of_pixel(kind, observed, total, share, mean, left[i] > 0.0)
        if known:
            tails[0, count], tails[1, count], tails[2, count] = a, b, x
            count += 1
    return least, count
