"""Observed information and first-order bias, from the signal's derivatives.

`rows` has shape (ny, `iscat_analysis._kernels.hessian.ROWS`, nx): s, its gradient in (x, y, z, a)
and its second derivatives, as `signal_hessian` fills it.  Data and parameters are those of
`iscat_analysis._kernels.noise`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.dense import factorise
from iscat_analysis._kernels.hessian import signal_hessian
from iscat_analysis._kernels.image import Pixels
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lens import Lens
from iscat_analysis._kernels.lines import marked
from iscat_analysis._kernels.noise import FLOOR, bias_of_pixel, curvature_of_row
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.scoring import blank_profile, image_score, span

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


@kernel()
def derivatives_between(
    axial: AxialTable, lens: Lens, pixels: Pixels, theta: FloatArray, rows: FloatArray
) -> None:
    """Fill `rows` at a height between those of a table."""
    profile = blank_profile(axial, lens, 3)
    start, stop = span(lens, pixels, theta, axial.heights.shape[3])
    profile_at(axial, theta[2], start, stop, profile)
    signal_hessian(profile, lens, pixels, theta[0], theta[1], theta[3], rows)


@kernel(fastmath=FAST)
def _weighted(t: FloatArray, a: FloatArray) -> float:
    """Scalar product, shape (nx,) each."""
    total = 0.0
    for j in range(t.size):
        total += t[j] * a[j]
    return total


@kernel(fastmath=FAST)
def _products(t: FloatArray, g: FloatArray, sums: FloatArray) -> None:
    """Add Σ t g_i g_j to `sums` (10) in the order of `PAIRS`; g holds s and its gradient."""
    f00 = f01 = f11 = f02 = f12 = f22 = f03 = f13 = f23 = f33 = 0.0
    for j in range(t.size):
        g0, g1, g2, g3 = g[1, j], g[2, j], g[3, j], g[4, j]
        h0, h1, h2, h3 = t[j] * g0, t[j] * g1, t[j] * g2, t[j] * g3
        f00 += h0 * g0
        f01 += h0 * g1
        f11 += h1 * g1
        f02 += h0 * g2
        f12 += h1 * g2
        f22 += h2 * g2
        f03 += h0 * g3
        f13 += h1 * g3
        f23 += h2 * g3
        f33 += h3 * g3
    sums[0] += f00
    sums[1] += f01
    sums[2] += f11
    sums[3] += f02
    sums[4] += f12
    sums[5] += f22
    sums[6] += f03
    sums[7] += f13
    sums[8] += f23
    sums[9] += f33


@kernel()
def observed_information(
    kind: int, data: FloatArray, level: float, rows: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (5, 5) with the negative Hessian of the log-likelihood in (x, y, z, a, g)."""
    t = np.empty((3, rows.shape[2]))
    sums = np.zeros(14)
    out[4, 4] = 0.0
    for row in range(rows.shape[0]):
        here = rows[row]
        out[4, 4] -= curvature_of_row(kind, data, row, level, here[0], t)
        _products(t[1], here, sums)
        for k in range(10):
            sums[k] += _weighted(t[0], here[5 + k])
        for i in range(4):
            sums[10 + i] += _weighted(t[2], here[1 + i])
    k = 0
    for j in range(4):
        for i in range(j + 1):
            out[i, j] = out[j, i] = -sums[k]
            k += 1
        out[4, j] = out[j, 4] = -sums[10 + j]


@kernel()
def invert(matrix: FloatArray, like: FloatArray, active: BoolArray, out: FloatArray) -> bool:
    """Fill `out` (5, 5) with the inverse of a positive matrix on the active parameters, else 0.

    The diagonal of `like` (5, 5) is about that of the matrix.  False, and NaN, if it is not
    positive.
    """
    index = marked(active)
    n = index.size
    lower, inverse, scale = np.zeros((n, n)), np.zeros((n, n)), np.empty(5)
    for i in range(5):
        scale[i] = 1.0 / np.sqrt(max(like[i, i], FLOOR))
    out[:] = 0.0
    if not factorise(matrix, index, scale[index], 0.0, lower):
        out[:] = np.nan
        return False
    for j in range(n):
        inverse[j, j] = 1.0 / lower[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= lower[i, k] * inverse[k, j]
            inverse[i, j] = total / lower[i, i]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(max(i, j), n):
                total += inverse[k, i] * inverse[k, j]
            out[index[i], index[j]] = total * scale[index[i]] * scale[index[j]]
    return True


@kernel(fastmath=FAST)
def _row_bias(
    kind: int,
    data: FloatArray,
    row: int,
    level: float,
    inverse: FloatArray,
    g: FloatArray,
    t: FloatArray,
    sums: FloatArray,
) -> None:
    """Add one row's Σ ∂η [V′ tr(F⁻¹ ∂η ∂ηᵀ) + V tr(F⁻¹ ∂²η)] to `sums` (5)."""
    c1, c2, c3 = data[1, row], data[2, row], data[3, row]
    i00, i01, i11, i02 = inverse[0, 0], 2 * inverse[0, 1], inverse[1, 1], 2 * inverse[0, 2]
    i12, i22, i03, i13 = 2 * inverse[1, 2], inverse[2, 2], 2 * inverse[0, 3], 2 * inverse[1, 3]
    i23, i33 = 2 * inverse[2, 3], inverse[3, 3]
    l0, l1, l2, l3 = 2 * inverse[0, 4], 2 * inverse[1, 4], 2 * inverse[2, 4], 2 * inverse[3, 4]
    l4 = inverse[4, 4]
    for j in range(c1.size):  # tr(F⁻¹ ∂s ∂sᵀ), tr(F⁻¹ ∂²s) and twice the level's row times ∂s
        g0, g1, g2, g3 = g[1, j], g[2, j], g[3, j], g[4, j]
        t[0, j] = g0 * (i00 * g0 + i01 * g1 + i02 * g2 + i03 * g3) + g1 * (
            i11 * g1 + i12 * g2 + i13 * g3
        ) + g2 * (i22 * g2 + i23 * g3) + i33 * g3 * g3  # fmt: skip
        t[1, j] = (
            i00 * g[5, j] + i01 * g[6, j] + i11 * g[7, j] + i02 * g[8, j] + i12 * g[9, j]
            + i22 * g[10, j] + i03 * g[11, j] + i13 * g[12, j] + i23 * g[13, j] + i33 * g[14, j]
        )  # fmt: skip
        t[2, j] = l0 * g0 + l1 * g1 + l2 * g2 + l3 * g3
    b0 = b1 = b2 = b3 = b4 = 0.0
    for j in range(c1.size):
        both, per, by_level = bias_of_pixel(
            kind, c1[j], c2[j], c3[j], level, g[0, j], t[0, j], t[1, j], t[2, j], l4
        )
        b0 += both * per * g[1, j]
        b1 += both * per * g[2, j]
        b2 += both * per * g[3, j]
        b3 += both * per * g[4, j]
        b4 += both * by_level
    sums[0] += b0
    sums[1] += b1
    sums[2] += b2
    sums[3] += b3
    sums[4] += b4


@kernel()
def first_order_bias(
    kind: int,
    data: FloatArray,
    level: float,
    rows: FloatArray,
    free: BoolArray,
    out: FloatArray,
    height_known: float = 0.0,
) -> None:
    """Fill `out` (5) with the bias of order 1/N, NaN where the free parameters are not known."""
    fisher, inverse, score = np.empty((5, 5)), np.empty((5, 5)), np.empty(5)
    image_score(kind, data, level, rows, score, fisher)
    fisher[2, 2] += height_known
    invert(fisher, fisher, free, inverse)
    t = np.empty((3, rows.shape[2]))
    sums = np.zeros(5)
    for row in range(rows.shape[0]):
        _row_bias(kind, data, row, level, inverse, rows[row], t, sums)
    for i in range(5):
        out[i] = 0.0
        for j in range(5):
            out[i] -= 0.5 * inverse[i, j] * sums[j]


@kernel()
def errors_and_bias(
    kind: int,
    data: FloatArray,
    level: float,
    rows: FloatArray,
    like: FloatArray,
    free: BoolArray,
    moving: BoolArray,
    slope: float,
    height_known: float,
    sigma: FloatArray,
    covariance: FloatArray,
    bias: FloatArray,
) -> bool:
    """Fill errors, covariance and bias of a fit, from the likelihood and a prior of z.

    Shapes: `like` (5, 5), `free, moving` (5,), `sigma` (4,), `covariance` (n, n), `bias` (5,).
    """
    information, inverse = np.empty((5, 5)), np.empty((5, 5))
    observed_information(kind, data, level, rows, information)
    information[2, 2] += height_known
    known: bool = invert(information, like, free, inverse)
    n = 0
    for i in range(4):
        sigma[i] = np.nan
        if free[i]:
            m = 0
            for j in range(4):
                if free[j]:
                    unit = (slope if i == 3 else 1.0) * (slope if j == 3 else 1.0)
                    covariance[n, m] = inverse[i, j] * unit
                    m += 1
            sigma[i] = np.sqrt(covariance[n, n])
            n += 1
    if known:
        first_order_bias(kind, data, level, rows, moving, bias, height_known)
    else:
        bias[:] = np.nan
    return known
