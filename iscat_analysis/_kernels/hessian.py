"""Second derivatives of the signal, the observed information and the bias that follow from them.

With the field e and D = (1/r)∂/∂r, a radial function F has

    ∂u F = u DF,   ∂uu F = DF + (F″ − DF) u²/r²,   ∂uv F = (F″ − DF) uv/r²,

so that one loop over the pixels of a strip evaluates the quintics, their slopes and their second
derivatives, and another makes of them a component of the field with its derivatives in (u, v, z).
These are real and imaginary parts e of which each has, with ρ only in the first,

    s = 2aρ e + a² e²,   ∂i s = g ∂i e,   ∂ij s = g ∂ij e + 2a² ∂i e ∂j e,   g = 2aρ + 2a² e.

`rows` has shape (ny, `ROWS`, nx): s, its gradient in (x, y, z, a) and its second derivatives, as
`signal_hessian` fills it.  Data and parameters are those of `iscat_analysis._kernels.noise`.
"""

from __future__ import annotations

import numpy as np

from iscat_analysis._kernels import FAST, BoolArray, FloatArray, kernel
from iscat_analysis._kernels.lattice import BENT, lattice_waves
from iscat_analysis._kernels.lens import LATTICE, LatticeLens, Lens, Pixels, RoundLens
from iscat_analysis._kernels.loops import factorise, marked, solve
from iscat_analysis._kernels.noise import FLOOR, Measured, bias_of_pixel, curvature_of_row
from iscat_analysis._kernels.radial import AxialTable, profile_at
from iscat_analysis._kernels.radial_rows import DISTANCE, evaluate_bends, evaluate_last_slopes
from iscat_analysis._kernels.scoring import blank_profile, image_score, span

ROWS = 15
"""Numbers for each pixel: s, its derivatives in (x, y, z, a), and its second derivatives."""

PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))
"""Indices into (x, y, z, a) of the second derivatives, from row 5 on."""

_FIELDS = 12  # rows of scratch: four channels, their slopes and second derivatives
_DISTANCE = _FIELDS + DISTANCE  # after as many of ∂z, ∂zz and slopes of ∂z
_DX, _DY, _WAVES = _DISTANCE + 1, _DISTANCE + 2, _DISTANCE + 3
_SUMS = _WAVES + 2 * BENT
_STRIP = 64  # pixels; with a fixed number the compiler knows that lines of scratch do not overlap
_NEAR = 1e-6  # of a step: here DF is F″


@kernel()
def signal_hessian(
    profile: FloatArray, lens: RoundLens | LatticeLens, pixels: Pixels, theta: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Signal, gradient and second derivatives on a pixel grid, averaged over the samples.

    Shapes: `out` (ny, ROWS, nx).
    """
    offsets, weights = pixels.offsets, pixels.weights
    flat = np.empty((_SUMS + ROWS) * _STRIP)
    f = flat.reshape(_SUMS + ROWS, _STRIP)
    cos, sin = (1.0, 0.0) if len(lens) == LATTICE else (lens.cos_psi, lens.sin_psi)
    for first in range(0, pixels.y.size * pixels.x.size, _STRIP):
        for j in range(_SUMS * _STRIP, flat.size):
            flat[j] = 0.0
        for i in range(offsets.size):
            for k in range(offsets.size):
                _place(pixels, first, theta[0] - offsets[k], theta[1] - offsets[i], f)
                _add_derivatives(profile, lens, theta[3], weights[i] * weights[k], f)
        _copy(f[_SUMS:], cos, sin, first, out)


@kernel()
def _place(pixels: Pixels, first: int, x_p: float, y_p: float, f: FloatArray) -> None:
    """Fill the positions of a strip from pixel `first` on; beyond the last with 0."""
    dx, dy, nx = f[_DX], f[_DY], pixels.x.size
    row, column = first // nx, first % nx
    for j in range(_STRIP):
        inside = row < pixels.y.size
        dx[j] = pixels.x[column] - x_p if inside else 0.0
        dy[j] = pixels.y[row] - y_p if inside else 0.0
        column += 1
        if column == nx:
            row, column = row + 1, 0


@kernel()
def _add_derivatives(
    profile: FloatArray, lens: RoundLens | LatticeLens, amplitude: float, weight: float,
    f: FloatArray,
) -> None:  # fmt: skip
    """Add weight × signal and derivatives of a strip, one component of the field after another."""
    if len(lens) == LATTICE:
        for c in range(lens.components):
            lattice_waves(profile, lens, c, f[_DX], f[_DY], f[_WAVES:])
            _contract(lens.rho if c == 0 else 0.0, amplitude, weight, f.reshape(f.size))
        return
    dx, dy = f[_DX], f[_DY]
    for j in range(_STRIP):
        f[_DISTANCE, j] = f[DISTANCE, j] = np.sqrt(dx[j] * dx[j] + dy[j] * dy[j]) * lens.inv_step
    evaluate_bends(profile, f)
    if profile.shape[2] > 4:  # channels of the first order
        evaluate_last_slopes(profile, f[_FIELDS:])
    else:
        f[_FIELDS:_DISTANCE] = 0.0
    flat = f.reshape(f.size)
    _divide(lens.inv_step, flat)
    _bend(lens, 1.0, lens.co, 0.0, 0.0, flat)
    _contract(lens.rho, amplitude, weight, flat)
    _bend(lens, 0.0, 0.0, lens.cross, lens.ring, flat)
    _contract(0.0, amplitude, weight, flat)


@kernel(fastmath=FAST)
def _divide(inv_step: float, f: FloatArray) -> None:
    """Make of slopes and second derivatives of a strip's radial functions DF and (F″ − DF)/r²."""
    square = inv_step * inv_step
    for j in range(_STRIP):
        t = f[_DISTANCE * _STRIP + j]
        near = t < _NEAR
        per = square / (t if t > _NEAR else 1.0)
        per_r2 = 0.0 if near else square / (t * t)
        for k in range(4):
            once = square * f[(8 + k) * _STRIP + j] if near else per * f[(4 + k) * _STRIP + j]
            f[(8 + k) * _STRIP + j] = (square * f[(8 + k) * _STRIP + j] - once) * per_r2
            f[(4 + k) * _STRIP + j] = once
            f[(20 + k) * _STRIP + j] *= square / (t + 1e-30)


@kernel(fastmath=FAST)
def _bend(
    lens: RoundLens, plain: float, co: float, cross: float, ring: float, f: FloatArray
) -> None:
    """Fill a component, plain F0 + F2 c, with c = co (u² − v²) + 2 cross uv + ring (u² + v²)."""
    cos, sin = lens.cos_psi, lens.sin_psi
    c_uu, c_vv, c_uv = 2 * (ring + co), 2 * (ring - co), 2 * cross
    for j in range(_STRIP):
        dx, dy = f[_DX * _STRIP + j], f[_DY * _STRIP + j]
        u, v = cos * dx + sin * dy, cos * dy - sin * dx
        c_u, c_v = c_uu * u + c_uv * v, c_vv * v + c_uv * u
        c = 0.5 * (c_u * u + c_v * v)
        for part in range(2):
            f0, f2 = f[part * _STRIP + j], f[(2 + part) * _STRIP + j]
            d0, d2 = f[(4 + part) * _STRIP + j], f[(6 + part) * _STRIP + j]
            b0, b2 = f[(8 + part) * _STRIP + j], f[(10 + part) * _STRIP + j]
            z0, z2 = f[(12 + part) * _STRIP + j], f[(14 + part) * _STRIP + j]
            y0, y2 = f[(20 + part) * _STRIP + j], f[(22 + part) * _STRIP + j]
            p, b, y = plain * d0 + d2 * c, plain * b0 + b2 * c, plain * y0 + y2 * c
            here = (_WAVES + BENT * part) * _STRIP + j
            f[here] = plain * f0 + f2 * c
            f[here + _STRIP] = p * u + f2 * c_u
            f[here + 2 * _STRIP] = p * v + f2 * c_v
            f[here + 3 * _STRIP] = plain * z0 + z2 * c
            f[here + 4 * _STRIP] = p + b * u * u + 2 * d2 * u * c_u + f2 * c_uu
            f[here + 5 * _STRIP] = b * u * v + d2 * (u * c_v + v * c_u) + f2 * c_uv
            f[here + 6 * _STRIP] = p + b * v * v + 2 * d2 * v * c_v + f2 * c_vv
            f[here + 7 * _STRIP] = y * u + z2 * c_u
            f[here + 8 * _STRIP] = y * v + z2 * c_v
            f[here + 9 * _STRIP] = (
                plain * f[(16 + part) * _STRIP + j] + f[(18 + part) * _STRIP + j] * c
            )


@kernel(fastmath=FAST)
def _contract(rho: float, a: float, weight: float, f: FloatArray) -> None:
    """Add weight × signal and derivatives of one component of the field to the sums of a strip."""
    square = 2 * a * a
    for j in range(_STRIP):
        for part in range(2):
            ref = 2 * rho if part == 0 else 0.0
            here, there = (_WAVES + BENT * part) * _STRIP + j, _SUMS * _STRIP + j
            e, u, v, z = f[here], f[here + _STRIP], f[here + 2 * _STRIP], f[here + 3 * _STRIP]
            g, h = weight * a * (ref + 2 * a * e), weight * (ref + 4 * a * e)
            q = weight * square
            f[there] += weight * a * e * (ref + a * e)
            f[there + _STRIP] += g * u
            f[there + 2 * _STRIP] += g * v
            f[there + 3 * _STRIP] += g * z
            f[there + 4 * _STRIP] += weight * e * (ref + 2 * a * e)
            f[there + 5 * _STRIP] += g * f[here + 4 * _STRIP] + q * u * u
            f[there + 6 * _STRIP] += g * f[here + 5 * _STRIP] + q * u * v
            f[there + 7 * _STRIP] += g * f[here + 6 * _STRIP] + q * v * v
            f[there + 8 * _STRIP] += g * f[here + 7 * _STRIP] + q * u * z
            f[there + 9 * _STRIP] += g * f[here + 8 * _STRIP] + q * v * z
            f[there + 10 * _STRIP] += g * f[here + 9 * _STRIP] + q * z * z
            f[there + 11 * _STRIP] += h * u
            f[there + 12 * _STRIP] += h * v
            f[there + 13 * _STRIP] += h * z
            f[there + 14 * _STRIP] += 2 * weight * e * e


@kernel()
def _copy(sums: FloatArray, cos: float, sin: float, first: int, out: FloatArray) -> None:
    """Fill the pixels of `out` (ny, ROWS, nx) from `first` on with a strip of sums.

    Derivatives along (u, v) become those along (x, y) of the particle, which moves against them.
    """
    ny, _, nx = out.shape
    for j in range(min(_STRIP, ny * nx - first)):
        here, s = out[(first + j) // nx, :, (first + j) % nx], sums[:, j]
        for k in range(ROWS):
            here[k] = s[k]
        for k in (1, 8, 11):
            here[k], here[k + 1] = sin * s[k + 1] - cos * s[k], -sin * s[k] - cos * s[k + 1]
        here[5] = cos * cos * s[5] - 2 * cos * sin * s[6] + sin * sin * s[7]
        here[6] = cos * sin * (s[5] - s[7]) + (cos * cos - sin * sin) * s[6]
        here[7] = sin * sin * s[5] + 2 * cos * sin * s[6] + cos * cos * s[7]


@kernel()
def derivatives_between(
    axial: AxialTable, lens: Lens, pixels: Pixels, theta: FloatArray, rows: FloatArray
) -> None:
    """Fill `rows` at a height between those of a table."""
    profile = blank_profile(axial, lens, 3)
    start, stop = span(lens, pixels, theta, axial.heights.shape[3])
    profile_at(axial, theta[2], start, stop, profile)
    signal_hessian(profile, lens, pixels, theta, rows)


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
    for k, value in enumerate((f00, f01, f11, f02, f12, f22, f03, f13, f23, f33)):
        sums[k] += value


@kernel()
def observed_information(measured: Measured, level: float, rows: FloatArray) -> FloatArray:
    """Give the negative Hessian (5, 5) of the log-likelihood in (x, y, z, a, g)."""
    kind, data = measured
    t, sums, out = np.empty((3, rows.shape[2])), np.zeros(14), np.zeros((5, 5))
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
    return out


@kernel()
def invert(matrix: FloatArray, like: FloatArray, active: BoolArray, out: FloatArray) -> bool:
    """Fill `out` (5, 5) with the inverse of a positive matrix on the active parameters, else 0.

    The diagonal of `like` (5, 5) is about that of the matrix.  False, and NaN, if it is not
    positive.
    """
    index = marked(active)
    n = index.size
    lower, column, scale = np.zeros((n, n)), np.empty(n), np.empty(5)
    for i in range(5):
        scale[i] = 1.0 / np.sqrt(max(like[i, i], FLOOR))
    out[:] = 0.0
    if not factorise(matrix, index, scale[index], 0.0, lower):
        out[:] = np.nan
        return False
    for j in range(n):
        for i in range(n):
            column[i] = scale[index[i]] if i == j else 0.0
        solve(lower, column)
        for i in range(n):
            out[index[i], index[j]] = column[i] * scale[index[i]]
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
    for k, value in enumerate((b0, b1, b2, b3, b4)):
        sums[k] += value


@kernel()
def first_order_bias(
    measured: Measured, level: float, rows: FloatArray, free: BoolArray, height_known: float = 0.0
) -> FloatArray:
    """Give the bias (5) of order 1/N, NaN where the free parameters are not known."""
    kind, data = measured
    fisher, inverse, out = np.empty((5, 5)), np.empty((5, 5)), np.empty(5)
    image_score(measured, level, rows, (out, fisher))
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
    return out


@kernel()
def errors_and_bias(
    measured: Measured, level: float, rows: FloatArray, like: FloatArray,
    free: tuple[BoolArray, BoolArray], units: tuple[float, float],
) -> tuple[bool, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Errors (4), covariance (n, n) and bias (5) of a fit, and whether they are known.

    `like` (5, 5) is about the information, `free` has the parameters that were fitted, and those of
    them that noise moves, `units` the unit of the fourth one and the information of a prior of z.
    """
    fitted, moving = free
    slope, height_known = units
    inverse, index = np.empty((5, 5)), marked(fitted[:4])
    information = observed_information(measured, level, rows)
    information[2, 2] += height_known
    known: bool = invert(information, like, fitted, inverse)
    sigma, covariance = np.full(4, np.nan), np.empty((index.size, index.size))
    for n in range(index.size):
        for m in range(index.size):
            i, j = index[n], index[m]
            unit = (slope if i == 3 else 1.0) * (slope if j == 3 else 1.0)
            covariance[n, m] = inverse[i, j] * unit
        sigma[index[n]] = np.sqrt(covariance[n, n])
    bias = np.full(5, np.nan)
    if known:
        bias = first_order_bias(measured, level, rows, moving, height_known)
    return known, sigma, covariance, bias
