"""Tests of a fit: residuals, the pixels that deviate most, and Rao's score test against modes.

A mode is a product H_i(x) H_j(y) of Hermite functions.  Let U be the changes of the logarithm of
the light along the fitted parameters and the modes, in this order, each pixel times the root of its
information; G = U Uᵀ = L Lᵀ their information, and b the residuals along them.  The squares of
those components of L⁻¹b that belong to the modes add up to χ².  A pixel's share of it is the sum of
the squares of its components of the same rows of L⁻¹U.

Data are those of `iscat_analysis._kernels.noise`; `rows` are those of
`iscat_analysis._kernels.image` or `iscat_analysis._kernels.hessian`: s and its derivatives in
(x, y, z, a), each row of pixels; `terms` are those that `_residuals` fills.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis._kernels import FAST, BoolArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.loops import marked
from iscat_analysis._kernels.noise import (
    Measured,
    residuals_of_row,
    tail_of_pixel,
    variance_of_pixel,
)

_TAILS = 8  # pixels whose exact tail probabilities are computed


@kernel(fastmath=FAST)
def _residuals(
    measured: Measured, level: float, rows: FloatArray, rate: FloatArray, residual: FloatArray,
    terms: FloatArray,
) -> tuple[float, int, float, float, float]:  # fmt: skip
    """Fill the expected counts of all pixels and the deviations from them.

    Gives χ², the number of pixels, sum and largest size of their kurtosis, and the least rate.

    Shapes: `rows` (ny, 5 or more, nx), `rate` (ny, nx), `residual` (ny, nx), `terms` (ny, 4, nx).
    """
    kind, data = measured
    chi2 = excess = largest = 0.0
    pixels, least = 0, np.inf
    for i in range(rows.shape[0]):
        residuals_of_row(kind, data, i, level, rows[i, 0], rate[i], residual[i], terms[i])
        for j in range(rate.shape[1]):
            used, kurtosis = data[2, i, j] > 0, terms[i, 3, j]
            chi2 += residual[i, j] ** 2
            pixels += used
            excess += kurtosis
            largest = max(largest, abs(kurtosis))
            least = min(least, rate[i, j] if used else np.inf)
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
def _suspects(
    measured: Measured, rate: FloatArray, residual: FloatArray, many: float
) -> tuple[float, FloatArray]:
    """Least tail probability of pixels with many counts, and for others the arguments of theirs.

    Shapes: `rate, residual` (ny, nx), result (3, k), of the pixels that deviate most.
    """
    kind, data = measured
    flat, rates, left = data.reshape(4, rate.size), rate.reshape(-1), residual.reshape(-1)
    index, tails = np.empty(min(_TAILS, rate.size), dtype=np.int64), np.empty((3, _TAILS))
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
    return least, tails[:, :count]


@kernel(fastmath=FAST)
def _hermite(axis: FloatArray, centre: float, waist: float, order: int) -> FloatArray:
    """Hermite functions of order 0 to `order`, shape (order + 1, n), by their recurrence."""
    out = np.empty((order + 1, axis.size))
    for j in range(axis.size):
        t = (axis[j] - centre) / waist
        out[0, j] = np.exp(-t * t / 2)
        if order:
            out[1, j] = np.sqrt(2.0) * t * out[0, j]
        for n in range(2, order + 1):
            out[n, j] = np.sqrt(2.0 / n) * t * out[n - 1, j] - np.sqrt((n - 1) / n) * out[n - 2, j]
    return out


@kernel(fastmath=FAST)
def _directions(
    rows: FloatArray, terms: FloatArray, index: IntArray, along: FloatArray, across: FloatArray
) -> FloatArray:
    """Give changes U of the light along the parameters `index` and the modes.

    Shapes: `along` (count, nx), `across` (count, ny), result (n, ny, nx).
    """
    fitted, count, (ny, _, nx) = index.size, along.shape[0], rows.shape
    out, root = np.empty((fitted + count * (count + 1) // 2, ny, nx)), np.empty(nx)
    for row in range(ny):
        for j in range(nx):
            root[j] = np.sqrt(terms[row, 0, j])
        for m in range(fitted):
            line, slope = out[m, row], rows[row, (1 + index[m]) % 5]  # of the level, any
            for j in range(nx):
                line[j] = root[j] * (1.0 if index[m] == 4 else slope[j] * terms[row, 2, j])
        m = fitted
        for i in range(count):
            for k in range(count - i):
                line = out[m, row]
                for j in range(nx):
                    line[j] = root[j] * along[i, j] * across[k, row]
                m += 1
    return out


@kernel(fastmath=FAST)
def _score_statistic(
    matrix: FloatArray, vector: FloatArray, fitted: int, used: BoolArray
) -> tuple[float, int]:
    """Sum of squares of the residual along the modes."""
    chi2, freedom = 0.0, 0
    used[:] = False
    for k in range(vector.size):
        size = left = matrix[k, k]
        for j in range(k):
            total = 0.0
            for i in range(j):
                total += matrix[k, i] * matrix[j, i]
            # zero along directions that are left out
            matrix[k, j] = (matrix[k, j] - total) / matrix[j, j] if used[j] else 0.0
            left -= matrix[k, j] ** 2
        # share of a mode outside the fitted directions that counts as none
        if not (size > 0.0 and left > 1e-8 * size):
            continue
        used[k] = True
        matrix[k, k] = np.sqrt(left)
        for j in range(k):
            vector[k] -= matrix[k, j] * (vector[j] if used[j] else 0.0)
        vector[k] /= matrix[k, k]
        if k >= fitted:
            chi2 += vector[k] ** 2
            freedom += 1
    return chi2, freedom


@kernel(fastmath=FAST)
def _orthonormal(w: FloatArray, factor: FloatArray, used: BoolArray) -> None:
    """Turn directions (n, nx) into orthonormal ones, by their Cholesky factor."""
    for k in range(used.size):
        if not used[k]:
            continue
        for i in range(k):
            if used[i]:
                t = factor[k, i]
                for j in range(w.shape[1]):
                    w[k, j] -= t * w[i, j]
        t = 1.0 / factor[k, k]
        for j in range(w.shape[1]):
            w[k, j] *= t


@kernel()
def count_and_test(
    measured: Measured, level: float, rows: FloatArray,
    place: tuple[FloatArray, FloatArray, FloatArray], free: BoolArray,
    settings: tuple[float, int, float],
) -> tuple[float, int, float, float, float, int, float, float, FloatArray, FloatArray]:  # fmt: skip
    """Test one fit: its residuals, the modes H_i(x) H_j(y), i + j ≤ `order`, and its outliers.

    `place` has the axes of the pixels and θ, `settings` the waist of the modes, the order, and from
    how many counts on they are normal.  Gives χ² with the pixels, the sum of their kurtosis and the
    least rate, χ² of the modes with their number and kurtosis, and what `_suspects` gives; at last
    the rates (ny, nx).
    """
    (x, y, theta), (waist, order, many) = place, settings
    shape = y.size, x.size
    rate, residual, terms = np.empty(shape), np.empty(shape), np.empty((y.size, 4, x.size))
    chi2, pixels, excess, largest, least = _residuals(measured, level, rows, rate, residual, terms)
    along, across = _hermite(x, theta[0], waist, order), _hermite(y, theta[1], waist, order)
    index = marked(free)
    directions = _directions(rows, terms, index, along, across)
    size, flat = directions.shape[0], directions.reshape(directions.shape[0], rate.size)
    matrix, vector = np.dot(flat, flat.T), np.dot(flat, residual.reshape(rate.size))
    used = np.empty(size, dtype=np.bool_)
    mode_chi2, freedom = _score_statistic(matrix, vector, index.size, used)
    # the leverages are at most 1 and their sum is `freedom`, which limits their effect
    mode_excess = largest
    # a smaller excess kurtosis changes no p-value
    if largest > 1e-4 and freedom > 0:
        _orthonormal(flat, matrix, used)
        mode_excess = 0.0
        for i in range(y.size):
            for j in range(x.size):
                leverage = 0.0
                for m in range(index.size, size):
                    leverage += directions[m, i, j] ** 2 if used[m] else 0.0
                mode_excess += terms[i, 3, j] * leverage**2 / freedom
    least_tail, tails = _suspects(measured, rate, residual, many)
    return (
        chi2, pixels, excess, least, mode_chi2, freedom, mode_excess, least_tail, tails, rate
    )  # fmt: skip
