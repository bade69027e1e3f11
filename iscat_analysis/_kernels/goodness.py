"""Tests of a fit: residuals, the pixels that deviate most, and Rao's score test against modes.

A mode is a product H_i(x) H_j(y).  The information between two modes is therefore a sum over rows
of pixels of H_j H_l Σ_x ω H_i H_k, with ω the information of a pixel on the logarithm of its light.
This needs a few multiply-adds per pixel and pair of functions of y, and sums over x at the end.
Let G = L Lᵀ be the information of the fitted directions and the modes, in this order, and b the
residual along them.  The squares of those components of L⁻¹b that belong to the modes add up to χ².

Data are those of `iscat_analysis._kernels.noise`; `rows` are those of
`iscat_analysis._kernels.image` or `iscat_analysis._kernels.hessian`: s and its derivatives in
(x, y, z, a), each row of pixels; `terms` are those that `_residuals` fills.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis._kernels import FAST, BoolArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.loops import marked
from iscat_analysis._kernels.noise import residuals_of_row, tail_of_pixel, variance_of_pixel

_DEPENDENT = 1e-8  # share of a mode outside the fitted directions that counts as none
_NORMAL = 1e-4  # excess kurtosis that changes no p-value


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
def _residuals(
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
def _suspects(
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
def _products(functions: FloatArray) -> FloatArray:
    """Products of all pairs i ≤ k of functions (n, size), at k (k + 1)/2 + i."""
    count, size = functions.shape
    out = np.empty((count * (count + 1) // 2, size))
    for k in range(count):
        for i in range(k + 1):
            for j in range(size):
                out[k * (k + 1) // 2 + i, j] = functions[i, j] * functions[k, j]
    return out


@kernel(fastmath=FAST)
def _moments(lines: FloatArray, functions: FloatArray, out: FloatArray) -> None:
    """Fill `out` (m, n) with the scalar products of lines (m, size) and functions (n, size)."""
    for i in range(lines.shape[0]):
        for k in range(functions.shape[0]):
            total = 0.0
            for j in range(lines.shape[1]):
                total += lines[i, j] * functions[k, j]
            out[i, k] = total


@kernel(fastmath=FAST)
def _add_outer(factors: FloatArray, lines: FloatArray, out: FloatArray) -> None:
    """Add factors (n) times lines (m, size) to `out` (m, n, size)."""
    for i in range(lines.shape[0]):
        for k in range(factors.size):
            t = factors[k]
            for j in range(lines.shape[1]):
                out[i, k, j] += t * lines[i, j]


@kernel()
def _pair(i: int, k: int) -> int:
    """Place of a pair among `_products`."""
    low, high = min(i, k), max(i, k)
    return high * (high + 1) // 2 + low


@kernel(fastmath=FAST)
def _directions(
    rows: FloatArray, row: int, index: IntArray, relative: FloatArray, out: FloatArray
) -> None:
    """Fill the first rows of `out` (k or more, nx) with d ln(light) along the fitted parameters."""
    for k in range(index.size):
        if index[k] == 4:
            for j in range(relative.size):
                out[k, j] = 1.0
        else:
            for j in range(relative.size):
                out[k, j] = rows[row, 1 + index[k], j] * relative[j]


@kernel(fastmath=FAST)
def _add_fitted(
    directions: FloatArray,
    fitted: int,
    weight: FloatArray,
    pull: FloatArray,
    heavy: FloatArray,
    matrix: FloatArray,
    vector: FloatArray,
) -> None:
    """Add one row's share of the sums over fitted directions only; fill `heavy` (k + 1, nx)."""
    for j in range(weight.size):
        heavy[fitted, j] = pull[j]
    for f in range(fitted):
        total = 0.0
        for j in range(weight.size):
            heavy[f, j] = weight[j] * directions[f, j]
            total += pull[j] * directions[f, j]
        vector[f] += total
        for g in range(f + 1):
            total = 0.0
            for j in range(weight.size):
                total += heavy[f, j] * directions[g, j]
            matrix[f, g] += total


@kernel()
def _mode_information(
    rows: FloatArray,
    terms: FloatArray,
    free: BoolArray,
    along: FloatArray,
    across: FloatArray,
    matrix: FloatArray,
    vector: FloatArray,
) -> None:
    """Fill the information on the fitted directions and the modes, and the residual along them."""
    index = marked(free)
    fitted, count, nx = index.size, along.shape[0], along.shape[1]
    products, lines = _products(along), np.ascontiguousarray(_products(across).T)
    turned, pairs = np.ascontiguousarray(across.T), products.shape[0]
    directions, heavy = np.empty((fitted, nx)), np.empty((fitted + 1, nx))
    summed, crossed = np.zeros((1, pairs, nx)), np.zeros((fitted + 1, count, nx))
    tensor, cross = np.empty((pairs, pairs)), np.empty((fitted + 1, count, count))
    matrix[:] = 0.0
    vector[:] = 0.0
    for row in range(rows.shape[0]):
        _directions(rows, row, index, terms[row, 2], directions)
        _add_fitted(directions, fitted, terms[row, 0], terms[row, 1], heavy, matrix, vector)
        _add_outer(lines[row], terms[row, :1], summed)
        _add_outer(turned[row], heavy, crossed)
    _moments(summed[0], products, tensor)
    for f in range(fitted + 1):
        _moments(crossed[f], along, cross[f])
    m = fitted
    for i in range(count):
        for j in range(count - i):
            vector[m] = cross[fitted, j, i]
            for f in range(fitted):
                matrix[m, f] = cross[f, j, i]
            n = fitted
            for k in range(i + 1):
                for other in range(count - k):
                    if n <= m:
                        matrix[m, n] = tensor[_pair(j, other), _pair(i, k)]
                    n += 1
            m += 1


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
        if not (size > 0.0 and left > _DEPENDENT * size):
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
def _leverages(
    rows: FloatArray,
    terms: FloatArray,
    free: BoolArray,
    along: FloatArray,
    across: FloatArray,
    factor: FloatArray,
    used: BoolArray,
    out: FloatArray,
) -> None:
    """Fill `out` (ny, nx) with each pixel's share of the statistic, after `_score_statistic`.

    The share is the sum of the squares of the pixel's components of the orthonormal modes.
    """
    index = marked(free)
    fitted, count = index.size, along.shape[0]
    w = np.empty((used.size, along.shape[1]))
    for row in range(rows.shape[0]):
        _directions(rows, row, index, terms[row, 2], w)
        for p in range(along.shape[1]):
            root = np.sqrt(terms[row, 0, p])
            out[row, p] = 0.0
            for k in range(fitted):
                w[k, p] *= root
            k = fitted
            for i in range(count):
                for j in range(count - i):
                    w[k, p] = root * along[i, p] * across[j, row]
                    k += 1
        _orthonormal(w, factor, used)
        for k in range(fitted, used.size):
            if used[k]:
                for p in range(along.shape[1]):
                    out[row, p] += w[k, p] * w[k, p]


@kernel()
def count_and_test(
    kind: int, data: FloatArray, level: float, rows: FloatArray, x: FloatArray, y: FloatArray,
    theta: FloatArray, waist: float, order: int, free: BoolArray, many: float, rate: FloatArray,
    tails: FloatArray,
) -> tuple[float, int, float, float, float, int, float, float, int]:  # fmt: skip
    """Test one fit: its residuals, the modes H_i(x) H_j(y), i + j ≤ `order`, and its outliers.

    Shapes: `x, y` (nx,), `theta` (2 or more,), `free` (5,); `rate` and `tails` are filled, see
    `_residuals` and `_suspects`.
    """
    residual, terms = np.empty(rate.shape), np.empty((rate.shape[0], 4, rate.shape[1]))
    chi2, pixels, excess, largest, least = _residuals(
        kind, data, level, rows, rate, residual, terms
    )
    along, across = _hermite(x, theta[0], waist, order), _hermite(y, theta[1], waist, order)
    fitted = int(np.int64(0))  # a literal 0 has its own type, for which more is compiled
    for i in range(free.size):
        fitted += free[i]
    size = fitted + (order + 1) * (order + 2) // 2
    matrix, vector = np.empty((size, size)), np.empty(size)
    used = np.empty(size, dtype=np.bool_)
    _mode_information(rows, terms, free, along, across, matrix, vector)
    mode_chi2, freedom = _score_statistic(matrix, vector, fitted, used)
    # the leverages are at most 1 and their sum is `freedom`, which limits their effect
    mode_excess = largest
    if largest > _NORMAL and freedom > 0:
        leverage = np.empty((y.size, x.size))
        _leverages(rows, terms, free, along, across, matrix, used, leverage)
        mode_excess = 0.0
        for i in range(y.size):
            for j in range(x.size):
                mode_excess += terms[i, 3, j] * leverage[i, j] ** 2
        mode_excess /= freedom
    least_tail, count = _suspects(kind, data, rate, residual, many, tails)
    return chi2, pixels, excess, least, mode_chi2, freedom, mode_excess, least_tail, count
