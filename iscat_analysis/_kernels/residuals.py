"""Residuals of a fit: what every pixel expects, how far its count is from it, and the farthest.

Data are those of `iscat_analysis._kernels.scoring`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.scoring import CONDITIONAL, FLOOR

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_DARK = 1e-100  # expected light below which a pixel knows nothing of relative changes
_LEAST_COUNT = 1e-9  # of a tail
_WHOLE = 1e-9  # rounding of whole counts


@kernel(fastmath=FAST)
def _row_residuals(
    kind: int,
    data: FloatArray,
    row: int,
    level: float,
    s: FloatArray,
    rate: FloatArray,
    residual: FloatArray,
    t: FloatArray,
) -> None:
    """Fill expectation and residual, and t (4, nx); see `residuals`."""
    c0, c1, c2, c3 = data[0, row], data[1, row], data[2, row], data[3, row]
    for j in range(s.size):
        if kind == CONDITIONAL:
            bright = max(1.0 + s[j], FLOOR)
            part = 1.0 / (1.0 + c2[j] * level * bright)
            rate[j] = c1[j] * (1.0 - part)
            t[0, j] = c3[j] * rate[j] * part
            t[1, j] = (c0[j] - rate[j]) * c3[j]
            t[2, j] = 1.0 / bright
            total = c1[j] if c1[j] > 0 else 1.0
            t[3, j] = c3[j] * (1.0 / max(rate[j] * part, 1.0) - 6.0 / total)
        else:
            # A background of read noise alone may be measured below zero.
            raw = level * (c1[j] + c2[j] * s[j])
            used = c2[j] > 0
            light = max(raw, FLOOR) if used else 0.0
            rate[j] = max(raw + c3[j], FLOOR)
            t[0, j] = light * light / rate[j]
            t[1, j] = light * (c0[j] - rate[j]) / rate[j]
            t[2, j] = c2[j] * level / light if light > _DARK else 0.0
            t[3, j] = 1.0 / rate[j] if used else 0.0
    if kind == CONDITIONAL:
        for j in range(s.size):
            residual[j] = t[1, j] / max(np.sqrt(t[0, j]), FLOOR)
    else:
        for j in range(s.size):
            residual[j] = (c0[j] - rate[j]) / np.sqrt(rate[j]) if c2[j] > 0 else 0.0


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
    """Fill what every pixel expects and how far its count is from it.

    Shapes: `rows` (ny, 5 or more, nx), `rate` (ny, nx), `residual` (ny, nx), `terms` (ny, 4, nx).
    """
    chi2 = excess = largest = 0.0
    pixels, least = 0, np.inf
    weight = data[3] if kind == CONDITIONAL else data[2]
    for i in range(rows.shape[0]):
        _row_residuals(kind, data, i, level, rows[i, 0], rate[i], residual[i], terms[i])
        square, used, sum_, most, low = _row_totals(weight[i], rate[i], residual[i], terms[i, 3])
        chi2 += square
        pixels += int(used)
        excess += sum_
        largest, least = max(largest, most), min(least, low)
    return chi2, pixels, excess, largest, least


@kernel()
def _farthest(residual: FloatArray, index: IntArray) -> None:
    """Fill `index` (k) with the places of the residuals of largest size, largest first."""
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
    """Fill what the exact tails of the pixels farthest out are functions of.

    Shapes: `rate, residual` (ny, nx), `tails` (3, k).
    """
    flat, rates, left = data.reshape(4, rate.size), rate.reshape(-1), residual.reshape(-1)
    index = np.empty(min(tails.shape[1], rate.size), dtype=np.int64)
    _farthest(left, index)
    least, count = 1.0, 0
    for i in index:
        observed, total, mean, share = flat[0, i], flat[1, i], rates[i], flat[3, i]
        above = left[i] > 0.0
        if not (share if kind == CONDITIONAL else flat[2, i]) > 0.0:
            continue
        variance = share * mean * (1.0 - mean / total) if kind == CONDITIONAL else mean
        if variance > many:
            least = min(least, math.erfc(abs(left[i]) * math.sqrt(0.5)))
        elif kind == CONDITIONAL:
            # read noise takes its share of the variance, as if that share of the counts were lost
            n, k, p = share * total, share * (observed if above else total - observed), mean / total
            if k > 0.0:
                a = min(max(k, _LEAST_COUNT), n)
                tails[0, count], tails[1, count] = a, n - a + 1.0
                tails[2, count] = p if above else 1.0 - p
                count += 1
        else:
            k = max(np.floor(observed + _WHOLE), 0.0)
            if k > 0.0 or not above:
                tails[0, count], tails[1, count] = k if above else k + 1.0, mean
                tails[2, count] = 1.0 if above else 0.0
                count += 1
    return least, count
