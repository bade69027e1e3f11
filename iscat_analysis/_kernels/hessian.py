"""Second derivatives of the signal, for the observed information, some rows of pixels at a time.

With the field e and D = (1/r)∂/∂r, a radial function F has

    ∂u F = u DF,   ∂uu F = DF + (F″ − DF) u²/r²,   ∂uv F = (F″ − DF) uv/r²,

so that one loop over the pixels of a few rows evaluates the quintics, their slopes and their second
derivatives (`iscat_analysis._kernels.quintics`), and another contracts them to

    ∂i∂j s = Re[g* ∂ij e_u + h* ∂ij e_v] + 2a² Re Σ ∂i e* ∂j e,   g = 2aρ + 2a² e_u,   h = 2a² e_v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.image import Pixels
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lattice_rows import lattice_fields
from iscat_analysis._kernels.lens import LATTICE, LatticeLens, Lens, RoundLens
from iscat_analysis._kernels.quintics import DISTANCE, evaluate_bends, evaluate_last_slopes

FloatArray = NDArray[np.float64]

ROWS = 15
"""Numbers for each pixel: s, its derivatives in (x, y, z, a), and its second derivatives."""

PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))
"""Indices into (x, y, z, a) of the second derivatives, from row 5 on."""

_CHANNELS = 4  # of the first order of a radial profile
_FIELDS = 12  # rows of scratch: four channels, their slopes and second derivatives
_DISTANCE = _FIELDS + DISTANCE  # after as many of ∂z, ∂zz and slopes of ∂z
_DX, _DY, _SUMS = _DISTANCE + 1, _DISTANCE + 2, _DISTANCE + 3
_STRIP = 64  # pixels; with a fixed number the compiler knows that lines of scratch do not overlap
_NEAR = 1e-6  # of a step: here DF is F″


@kernel()
def signal_hessian(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    amplitude: float,
    out: FloatArray,
) -> None:
    """Signal, gradient and second derivatives on a pixel grid, averaged over the samples.

    Shapes: `out` (ny, ROWS, nx).
    """
    if len(lens) == LATTICE:
        _lattice_hessian(profile, lens, pixels, x_p, y_p, amplitude, out)
        return
    nx, offsets, weights = pixels.x.size, pixels.offsets, pixels.weights
    flat = np.empty((_SUMS + ROWS) * _STRIP)
    f = flat.reshape(_SUMS + ROWS, _STRIP)
    fields, sums = f[_FIELDS:], f[_SUMS:]
    for first in range(0, pixels.y.size * nx, _STRIP):
        for j in range(_SUMS * _STRIP, flat.size):
            flat[j] = 0.0
        for i in range(offsets.size):
            for k in range(offsets.size):
                _place(lens.inv_step, pixels, first, x_p - offsets[k], y_p - offsets[i], f)
                evaluate_bends(profile, f)
                _bend(lens, amplitude, weights[i] * weights[k], flat)
                if profile.shape[2] > _CHANNELS:
                    evaluate_last_slopes(profile, fields)
                    _bend_z(lens, amplitude, weights[i] * weights[k], flat)
        _copy(sums, first, out)


@kernel()
def _place(
    inv_step: float, pixels: Pixels, first: int, x_p: float, y_p: float, f: FloatArray
) -> None:
    """Fill distances and positions of a strip from pixel `first` on; beyond the last with 0."""
    dx, dy, nx = f[_DX], f[_DY], pixels.x.size
    row, column = first // nx, first % nx
    for j in range(_STRIP):
        inside = row < pixels.y.size
        dx[j] = pixels.x[column] - x_p if inside else 0.0
        dy[j] = pixels.y[row] - y_p if inside else 0.0
        column += 1
        if column == nx:
            row, column = row + 1, 0
    for j in range(_STRIP):
        f[_DISTANCE, j] = f[DISTANCE, j] = np.sqrt(dx[j] * dx[j] + dy[j] * dy[j]) * inv_step


@kernel()
def _copy(sums: FloatArray, first: int, out: FloatArray) -> None:
    """Fill the pixels of `out` (ny, ROWS, nx) from `first` on with a strip of sums."""
    ny, _, nx = out.shape
    row, column, begin = first // nx, first % nx, 0
    while begin < _STRIP and row < ny:
        end = begin + min(nx - column, _STRIP - begin)
        for k in range(ROWS):
            here, there = sums[k, begin:end], out[row, k, column : column + end - begin]
            for j in range(here.size):
                there[j] = here[j]
        row, column, begin = row + 1, 0, end


@kernel()
def _lattice_hessian(
    profile: FloatArray, lens: LatticeLens, pixels: Pixels, x_p: float, y_p: float,
    amplitude: float, out: FloatArray,
) -> None:  # fmt: skip
    """Do the same as `signal_hessian` with a lattice."""
    out[:] = 0.0
    offsets, weights = pixels.offsets, pixels.weights
    count = lens.components
    e = np.empty(count, dtype=np.complex128)
    de = np.empty((3, count), dtype=np.complex128)
    dde = np.empty((3, 3, count), dtype=np.complex128)
    for row in range(pixels.y.size):
        for i in range(offsets.size):
            dy = pixels.y[row] + offsets[i] - y_p
            for k in range(offsets.size):
                x, weight = x_p - offsets[k], weights[i] * weights[k]
                for j in range(pixels.x.size):
                    lattice_fields(profile, lens, pixels.x[j] - x, dy, e, de, dde)
                    _contract(lens.rho, amplitude, weight, e, de, dde, out[row], j)


@kernel(fastmath=FAST)
def _bend(lens: RoundLens, amplitude: float, weight: float, f: FloatArray) -> None:
    """Add weight × all terms without a derivative in z; keep DF (4 to 7 in f) and (F″ − DF)/r²."""
    inv_step, rho, cos, sin = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring, a = lens.co, lens.cross, lens.ring, amplitude
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
    for j in range(_STRIP):
        dx, dy = f[_DX * _STRIP + j], f[_DY * _STRIP + j]
        u, v = cos * dx + sin * dy, cos * dy - sin * dx
        uu, vv, uv = u * u, v * v, u * v
        c2, s2 = co * (uu - vv), cross * 2 * uv + ring * (uu + vv)
        s2_u, s2_v = 2 * (cross * v + ring * u), 2 * (cross * u + ring * v)
        n_r, n_i = f[2 * _STRIP + j], f[3 * _STRIP + j]
        m_r, m_i = f[6 * _STRIP + j], f[7 * _STRIP + j]
        e_r, e_i = f[0 * _STRIP + j] + n_r * c2, f[1 * _STRIP + j] + n_i * c2
        h_r, h_i = n_r * s2, n_i * s2
        p_r, p_i = f[4 * _STRIP + j] + m_r * c2, f[5 * _STRIP + j] + m_i * c2
        b_r, b_i = (
            f[8 * _STRIP + j] + f[10 * _STRIP + j] * c2,
            f[9 * _STRIP + j] + f[11 * _STRIP + j] * c2,
        )
        d_r, d_i = f[10 * _STRIP + j] * s2, f[11 * _STRIP + j] * s2
        # first derivatives of e_u and e_v along u and v
        eu_r, eu_i = p_r * u + 2 * co * u * n_r, p_i * u + 2 * co * u * n_i
        ev_r, ev_i = p_r * v - 2 * co * v * n_r, p_i * v - 2 * co * v * n_i
        hu_r, hu_i = m_r * s2 * u + n_r * s2_u, m_i * s2 * u + n_i * s2_u
        hv_r, hv_i = m_r * s2 * v + n_r * s2_v, m_i * s2 * v + n_i * s2_v
        # second derivatives
        euu_r = p_r + b_r * uu + 4 * co * uu * m_r + 2 * co * n_r
        euu_i = p_i + b_i * uu + 4 * co * uu * m_i + 2 * co * n_i
        evv_r = p_r + b_r * vv - 4 * co * vv * m_r - 2 * co * n_r
        evv_i = p_i + b_i * vv - 4 * co * vv * m_i - 2 * co * n_i
        euv_r, euv_i = b_r * uv, b_i * uv
        common = s2 + 2 * u * s2_u
        huu_r = m_r * common + d_r * uu + 2 * ring * n_r
        huu_i = m_i * common + d_i * uu + 2 * ring * n_i
        common = s2 + 2 * v * s2_v
        hvv_r = m_r * common + d_r * vv + 2 * ring * n_r
        hvv_i = m_i * common + d_i * vv + 2 * ring * n_i
        common = u * s2_v + v * s2_u
        huv_r = m_r * common + d_r * uv + 2 * cross * n_r
        huv_i = m_i * common + d_i * uv + 2 * cross * n_i
        k_r, k_i, q = 2 * a * (rho + a * e_r), 2 * a * a * e_i, 2 * a * a
        l_r, l_i = q * h_r, q * h_i
        s_u = k_r * eu_r + k_i * eu_i + l_r * hu_r + l_i * hu_i
        s_v = k_r * ev_r + k_i * ev_i + l_r * hv_r + l_i * hv_i
        s_uu = k_r * euu_r + k_i * euu_i + l_r * huu_r + l_i * huu_i
        s_uu += q * (eu_r * eu_r + eu_i * eu_i + hu_r * hu_r + hu_i * hu_i)
        s_vv = k_r * evv_r + k_i * evv_i + l_r * hvv_r + l_i * hvv_i
        s_vv += q * (ev_r * ev_r + ev_i * ev_i + hv_r * hv_r + hv_i * hv_i)
        s_uv = k_r * euv_r + k_i * euv_i + l_r * huv_r + l_i * huv_i
        s_uv += q * (eu_r * ev_r + eu_i * ev_i + hu_r * hv_r + hu_i * hv_i)
        g_r, g_i, w = 2 * rho + 4 * a * e_r, 4 * a * e_i, 4 * a
        a_u = g_r * eu_r + g_i * eu_i + w * (h_r * hu_r + h_i * hu_i)
        a_v = g_r * ev_r + g_i * ev_i + w * (h_r * hv_r + h_i * hv_i)
        power = e_r * e_r + e_i * e_i + h_r * h_r + h_i * h_i
        f[(_SUMS + 0) * _STRIP + j] += weight * a * (2 * rho * e_r + a * power)
        f[(_SUMS + 1) * _STRIP + j] += weight * (sin * s_v - cos * s_u)
        f[(_SUMS + 2) * _STRIP + j] -= weight * (sin * s_u + cos * s_v)
        f[(_SUMS + 4) * _STRIP + j] += weight * (2 * rho * e_r + 2 * a * power)
        f[(_SUMS + 5) * _STRIP + j] += weight * (
            cos * cos * s_uu - 2 * cos * sin * s_uv + sin * sin * s_vv
        )
        f[(_SUMS + 6) * _STRIP + j] += weight * (
            cos * sin * (s_uu - s_vv) + (cos * cos - sin * sin) * s_uv
        )
        f[(_SUMS + 7) * _STRIP + j] += weight * (
            sin * sin * s_uu + 2 * cos * sin * s_uv + cos * cos * s_vv
        )
        f[(_SUMS + 11) * _STRIP + j] += weight * (sin * a_v - cos * a_u)
        f[(_SUMS + 12) * _STRIP + j] -= weight * (sin * a_u + cos * a_v)
        f[(_SUMS + 14) * _STRIP + j] += weight * 2 * power


@kernel(fastmath=FAST)
def _bend_z(lens: RoundLens, amplitude: float, weight: float, f: FloatArray) -> None:
    """Add weight × the derivatives in z, after `_bend`."""
    inv_step, rho, cos, sin = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring, a = lens.co, lens.cross, lens.ring, amplitude
    square = inv_step * inv_step
    for j in range(_STRIP):
        dx, dy = f[_DX * _STRIP + j], f[_DY * _STRIP + j]
        u, v = cos * dx + sin * dy, cos * dy - sin * dx
        uu, vv = u * u, v * v
        c2, s2 = co * (uu - vv), cross * 2 * u * v + ring * (uu + vv)
        s2_u, s2_v = 2 * (cross * v + ring * u), 2 * (cross * u + ring * v)
        n_r, n_i = f[2 * _STRIP + j], f[3 * _STRIP + j]
        e_r, e_i = f[0 * _STRIP + j] + n_r * c2, f[1 * _STRIP + j] + n_i * c2
        h_r, h_i = n_r * s2, n_i * s2
        p_r, p_i = (
            f[4 * _STRIP + j] + f[6 * _STRIP + j] * c2,
            f[5 * _STRIP + j] + f[7 * _STRIP + j] * c2,
        )
        eu_r, eu_i = p_r * u + 2 * co * u * n_r, p_i * u + 2 * co * u * n_i
        ev_r, ev_i = p_r * v - 2 * co * v * n_r, p_i * v - 2 * co * v * n_i
        hu_r = f[6 * _STRIP + j] * s2 * u + n_r * s2_u
        hu_i = f[7 * _STRIP + j] * s2 * u + n_i * s2_u
        hv_r = f[6 * _STRIP + j] * s2 * v + n_r * s2_v
        hv_i = f[7 * _STRIP + j] * s2 * v + n_i * s2_v
        per = square / (f[_DISTANCE * _STRIP + j] + 1e-30)
        n_r, n_i = f[14 * _STRIP + j], f[15 * _STRIP + j]
        m_r, m_i = per * f[22 * _STRIP + j], per * f[23 * _STRIP + j]
        z_r, z_i = f[12 * _STRIP + j] + n_r * c2, f[13 * _STRIP + j] + n_i * c2
        y_r, y_i = n_r * s2, n_i * s2
        p_r, p_i = per * f[20 * _STRIP + j] + m_r * c2, per * f[21 * _STRIP + j] + m_i * c2
        zu_r, zu_i = p_r * u + 2 * co * u * n_r, p_i * u + 2 * co * u * n_i
        zv_r, zv_i = p_r * v - 2 * co * v * n_r, p_i * v - 2 * co * v * n_i
        yu_r, yu_i = m_r * s2 * u + n_r * s2_u, m_i * s2 * u + n_i * s2_u
        yv_r, yv_i = m_r * s2 * v + n_r * s2_v, m_i * s2 * v + n_i * s2_v
        k_r, k_i, q = 2 * a * (rho + a * e_r), 2 * a * a * e_i, 2 * a * a
        l_r, l_i = q * h_r, q * h_i
        s_uz = k_r * zu_r + k_i * zu_i + l_r * yu_r + l_i * yu_i
        s_uz += q * (eu_r * z_r + eu_i * z_i + hu_r * y_r + hu_i * y_i)
        s_vz = k_r * zv_r + k_i * zv_i + l_r * yv_r + l_i * yv_i
        s_vz += q * (ev_r * z_r + ev_i * z_i + hv_r * y_r + hv_i * y_i)
        s_zz = k_r * (f[16 * _STRIP + j] + f[18 * _STRIP + j] * c2) + k_i * (
            f[17 * _STRIP + j] + f[19 * _STRIP + j] * c2
        )
        s_zz += (l_r * f[18 * _STRIP + j] + l_i * f[19 * _STRIP + j]) * s2
        s_zz += q * (z_r * z_r + z_i * z_i + y_r * y_r + y_i * y_i)
        g_r, g_i, w = 2 * rho + 4 * a * e_r, 4 * a * e_i, 4 * a
        f[(_SUMS + 3) * _STRIP + j] += weight * (k_r * z_r + k_i * z_i + l_r * y_r + l_i * y_i)
        f[(_SUMS + 8) * _STRIP + j] += weight * (sin * s_vz - cos * s_uz)
        f[(_SUMS + 9) * _STRIP + j] -= weight * (sin * s_uz + cos * s_vz)
        f[(_SUMS + 10) * _STRIP + j] += weight * s_zz
        f[(_SUMS + 13) * _STRIP + j] += weight * (
            g_r * z_r + g_i * z_i + w * (h_r * y_r + h_i * y_i)
        )


@kernel()
def _contract(
    rho: float,
    a: float,
    weight: float,
    e: NDArray[np.complex128],
    de: NDArray[np.complex128],
    dde: NDArray[np.complex128],
    out: FloatArray,
    column: int,
) -> None:
    """Add weight × signal and derivatives of one point, whose field is known along x and y."""
    for c in range(e.size):
        ref = 2 * rho if c == 0 else 0.0
        power = e[c].real ** 2 + e[c].imag ** 2
        out[0, column] += weight * a * (ref * e[c].real + a * power)
        out[4, column] += weight * (ref * e[c].real + 2 * a * power)
        out[14, column] += weight * 2 * power
        k = 5
        for j in range(3):
            sign = weight if j == 2 else -weight  # the particle moves, not the camera
            cross = (np.conj(e[c]) * de[j, c]).real
            out[1 + j, column] += sign * a * (ref * de[j, c].real + 2 * a * cross)
            out[11 + j, column] += sign * (ref * de[j, c].real + 4 * a * cross)
            for i in range(j + 1):
                both = (np.conj(de[i, c]) * de[j, c] + np.conj(e[c]) * dde[i, j, c]).real
                second = a * ref * dde[i, j, c].real + 2 * a * a * both
                out[k, column] += (-weight if j == 2 and i < 2 else weight) * second
                k += 1
