"""Second derivatives of the signal, for the observed information, a row of pixels at a time.

With the field e and D = (1/r)∂/∂r, a radial function F has

    ∂u F = u DF,   ∂uu F = DF + (F″ − DF) u²/r²,   ∂uv F = (F″ − DF) uv/r²,

so that one loop evaluates the quintics, their slopes and their second derivatives, and another,
which runs in vector registers, contracts them to

    ∂i∂j s = Re[g* ∂ij e_u + h* ∂ij e_v] + 2a² Re Σ ∂i e* ∂j e,   g = 2aρ + 2a² e_u,   h = 2a² e_v.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.image import Lens, Pixels
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lattice_rows import lattice_fields

FloatArray = NDArray[np.float64]

ROWS = 15
"""Rows that a row of pixels fills: s, its derivatives in (x, y, z, a), and the second ones."""

PAIRS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2), (0, 3), (1, 3), (2, 3), (3, 3))
"""Which of (x, y, z, a) the second derivatives from row 5 on are in."""

_CHANNELS = 4  # of the first order of a radial profile
_SCRATCH = 29  # 12 of the fields, 8 of ∂z, 4 of ∂zz, then DF and cosines
_NEAR = 1e-6  # of a step: here DF is F″


@njit(cache=True, nogil=True, error_model="numpy")
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

    Parameters
    ----------
    profile : ndarray
        Three orders; of a radial one, shape (intervals, 6, 4·orders), the first alone leaves out
        derivatives in z, which then are 0.
    lens, pixels, x_p, y_p, amplitude
        As in `iscat_analysis._kernels.image.signal_gradient`.
    out : ndarray, shape (ny, ROWS, nx)
        Filled with s, its derivatives in (x_p, y_p, z, a), and those of `PAIRS`.
    """
    out[:] = 0.0
    with_z = profile.shape[2] > _CHANNELS
    offsets, weights = pixels.offsets, pixels.weights
    f = np.empty((_SCRATCH, pixels.x.size))
    e = np.empty(2, dtype=np.complex128)
    de = np.empty((3, 2), dtype=np.complex128)
    dde = np.empty((3, 3, 2), dtype=np.complex128)
    for row in range(pixels.y.size):
        for i in range(offsets.size):
            dy = pixels.y[row] + offsets[i] - y_p
            for k in range(offsets.size):
                x, weight = x_p - offsets[k], weights[i] * weights[k]
                if lens.half:
                    for j in range(pixels.x.size):
                        lattice_fields(profile, lens, pixels.x[j] - x, dy, e, de, dde)
                        _contract(lens.rho, amplitude, weight, e, de, dde, out[row], j)
                else:
                    _quintics(profile, lens.inv_step, pixels.x, x, dy, with_z, f)
                    _bend(lens, pixels.x, x, dy, amplitude, weight, f, out[row])
                    if with_z:
                        _bend_z(lens, pixels.x, x, dy, amplitude, weight, f, out[row])


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _quintics(
    profile: FloatArray,
    inv_step: float,
    x: FloatArray,
    x_p: float,
    dy: float,
    with_z: bool,
    f: FloatArray,
) -> None:
    """Fill f: values, slopes and second derivatives of the fields by t, then those of ∂z, ∂zz."""
    for j in range(x.size):
        dx = x[j] - x_p
        f[24, j] = np.sqrt(dx * dx + dy * dy) * inv_step
    for j in range(x.size):
        t = f[24, j]
        n = int(t)
        t -= n
        i = np.uintp(n)
        for k in range(4):
            b = d = profile[i, 5, k]
            v = d * t + profile[i, 4, k]
            d = d * t + v
            v = v * t + profile[i, 3, k]
            b = b * t + d
            d = d * t + v
            v = v * t + profile[i, 2, k]
            b = b * t + d
            d = d * t + v
            v = v * t + profile[i, 1, k]
            f[8 + k, j] = 2 * (b * t + d)
            f[4 + k, j] = d * t + v
            f[k, j] = v * t + profile[i, 0, k]
        if with_z:
            for k in range(4, 8):
                d = profile[i, 5, k]
                v = d * t + profile[i, 4, k]
                d = d * t + v
                v = v * t + profile[i, 3, k]
                d = d * t + v
                v = v * t + profile[i, 2, k]
                d = d * t + v
                v = v * t + profile[i, 1, k]
                f[12 + k, j] = d * t + v
                f[8 + k, j] = v * t + profile[i, 0, k]
            for k in range(8, 12):
                v = profile[i, 5, k]
                v = v * t + profile[i, 4, k]
                v = v * t + profile[i, 3, k]
                v = v * t + profile[i, 2, k]
                v = v * t + profile[i, 1, k]
                f[12 + k, j] = v * t + profile[i, 0, k]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _bend(
    lens: Lens,
    x: FloatArray,
    x_p: float,
    dy: float,
    amplitude: float,
    weight: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Add weight × all that needs no derivative in z; leave DF (8 to 11 in f) and (F″ − DF)/r²."""
    inv_step, rho, cos, sin = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring, a = lens.co, lens.cross, lens.ring, amplitude
    square = inv_step * inv_step
    for j in range(x.size):
        t = f[24, j]
        near = t < _NEAR
        per = square / (t if t > _NEAR else 1.0)
        per_r2 = 0.0 if near else square / (t * t)
        for k in range(4):
            once = square * f[8 + k, j] if near else per * f[4 + k, j]
            f[8 + k, j] = (square * f[8 + k, j] - once) * per_r2
            f[4 + k, j] = once
    for j in range(x.size):
        dx = x[j] - x_p
        u, v = cos * dx + sin * dy, cos * dy - sin * dx
        uu, vv, uv = u * u, v * v, u * v
        c2, s2 = co * (uu - vv), cross * 2 * uv + ring * (uu + vv)
        s2_u, s2_v = 2 * (cross * v + ring * u), 2 * (cross * u + ring * v)
        n_r, n_i = f[2, j], f[3, j]
        m_r, m_i = f[6, j], f[7, j]
        e_r, e_i = f[0, j] + n_r * c2, f[1, j] + n_i * c2
        h_r, h_i = n_r * s2, n_i * s2
        p_r, p_i = f[4, j] + m_r * c2, f[5, j] + m_i * c2
        b_r, b_i = f[8, j] + f[10, j] * c2, f[9, j] + f[11, j] * c2
        d_r, d_i = f[10, j] * s2, f[11, j] * s2
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
        out[0, j] += weight * a * (2 * rho * e_r + a * power)
        out[1, j] += weight * (sin * s_v - cos * s_u)
        out[2, j] -= weight * (sin * s_u + cos * s_v)
        out[4, j] += weight * (2 * rho * e_r + 2 * a * power)
        out[5, j] += weight * (cos * cos * s_uu - 2 * cos * sin * s_uv + sin * sin * s_vv)
        out[6, j] += weight * (cos * sin * (s_uu - s_vv) + (cos * cos - sin * sin) * s_uv)
        out[7, j] += weight * (sin * sin * s_uu + 2 * cos * sin * s_uv + cos * cos * s_vv)
        out[11, j] += weight * (sin * a_v - cos * a_u)
        out[12, j] -= weight * (sin * a_u + cos * a_v)
        out[14, j] += weight * 2 * power


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _bend_z(
    lens: Lens,
    x: FloatArray,
    x_p: float,
    dy: float,
    amplitude: float,
    weight: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Add weight × the derivatives in z, after `_bend`."""
    inv_step, rho, cos, sin = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring, a = lens.co, lens.cross, lens.ring, amplitude
    square = inv_step * inv_step
    for j in range(x.size):
        dx = x[j] - x_p
        u, v = cos * dx + sin * dy, cos * dy - sin * dx
        uu, vv = u * u, v * v
        c2, s2 = co * (uu - vv), cross * 2 * u * v + ring * (uu + vv)
        s2_u, s2_v = 2 * (cross * v + ring * u), 2 * (cross * u + ring * v)
        n_r, n_i = f[2, j], f[3, j]
        e_r, e_i = f[0, j] + n_r * c2, f[1, j] + n_i * c2
        h_r, h_i = n_r * s2, n_i * s2
        p_r, p_i = f[4, j] + f[6, j] * c2, f[5, j] + f[7, j] * c2
        eu_r, eu_i = p_r * u + 2 * co * u * n_r, p_i * u + 2 * co * u * n_i
        ev_r, ev_i = p_r * v - 2 * co * v * n_r, p_i * v - 2 * co * v * n_i
        hu_r = f[6, j] * s2 * u + n_r * s2_u
        hu_i = f[7, j] * s2 * u + n_i * s2_u
        hv_r = f[6, j] * s2 * v + n_r * s2_v
        hv_i = f[7, j] * s2 * v + n_i * s2_v
        per = square / (f[24, j] + 1e-30)
        n_r, n_i = f[14, j], f[15, j]
        m_r, m_i = per * f[18, j], per * f[19, j]
        z_r, z_i = f[12, j] + n_r * c2, f[13, j] + n_i * c2
        y_r, y_i = n_r * s2, n_i * s2
        p_r, p_i = per * f[16, j] + m_r * c2, per * f[17, j] + m_i * c2
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
        s_zz = k_r * (f[20, j] + f[22, j] * c2) + k_i * (f[21, j] + f[23, j] * c2)
        s_zz += (l_r * f[22, j] + l_i * f[23, j]) * s2
        s_zz += q * (z_r * z_r + z_i * z_i + y_r * y_r + y_i * y_i)
        g_r, g_i, w = 2 * rho + 4 * a * e_r, 4 * a * e_i, 4 * a
        out[3, j] += weight * (k_r * z_r + k_i * z_i + l_r * y_r + l_i * y_i)
        out[8, j] += weight * (sin * s_vz - cos * s_uz)
        out[9, j] -= weight * (sin * s_uz + cos * s_vz)
        out[10, j] += weight * s_zz
        out[13, j] += weight * (g_r * z_r + g_i * z_i + w * (h_r * y_r + h_i * y_i))


@njit(cache=True, nogil=True, error_model="numpy")
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
    for c in range(2):
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
