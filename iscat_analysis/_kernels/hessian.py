"""Second derivatives of the signal, for the observed information.

The fields and their derivatives up to second order are assembled in the frame of the polarisation
and contracted as ∂i∂j s = 2ρa Re ∂ij e_u + 2a² Re Σ (∂i e*·∂j e + e*·∂ij e); the amplitude enters
by hand because e does not depend on it.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.image import Lens, Pixels
from iscat_analysis._kernels.lattice_rows import lattice_fields

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@njit(cache=True, nogil=True, error_model="numpy")
def signal_hessian(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    amplitude: float,
    first: FloatArray,
    second: FloatArray,
) -> None:
    """Signal, gradient and Hessian on a pixel grid, averaged over the samples in each pixel.

    Parameters
    ----------
    profile : ndarray
        Three orders: radial, shape (12, intervals, 6), or on a lattice.
    lens, pixels, x_p, y_p, amplitude
        As in `iscat_analysis._kernels.image.signal_gradient`.
    first : ndarray, shape (5, ny, nx)
        Filled with s and its derivatives in (x_p, y_p, z, a).
    second : ndarray, shape (4, 4, ny, nx)
        Filled with the second derivatives.
    """
    rho = lens.rho
    cos_psi, sin_psi = (1.0, 0.0) if lens.half else (lens.cos_psi, lens.sin_psi)
    x, y, offsets, weights = pixels
    first[:] = 0.0
    second[:] = 0.0
    q = offsets.size
    a = amplitude
    radial = np.empty((3, 6), dtype=np.complex128)  # d^n/dt^n of (F0, F2) × (1, ∂z, ∂zz)
    e = np.empty(2, dtype=np.complex128)
    de = np.empty((3, 2), dtype=np.complex128)  # u, v, z
    dde = np.empty((3, 3, 2), dtype=np.complex128)
    turn = np.zeros((4, 4))  # from (u, v, z, a) to (x_p, y_p, z, a)
    turn[0, 0], turn[0, 1] = -cos_psi, sin_psi
    turn[1, 0], turn[1, 1] = -sin_psi, -cos_psi
    turn[2, 2] = turn[3, 3] = 1.0
    g, h = np.empty(4), np.empty((4, 4))
    for row in range(y.size):
        for column in range(x.size):
            for iy in range(q):
                for ix in range(q):
                    dx = x[column] + offsets[ix] - x_p
                    dy = y[row] + offsets[iy] - y_p
                    u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
                    if lens.half:
                        lattice_fields(profile, lens, u, v, e, de, dde)
                    else:
                        _fields(profile, lens, u, v, radial, e, de, dde)
                    s = 2 * rho * a * e[0].real
                    g[:], h[:] = 0.0, 0.0
                    for c in range(2):
                        ref = 2 * rho if c == 0 else 0.0
                        power = e[c].real ** 2 + e[c].imag ** 2
                        s += a * a * power
                        g[3] += ref * e[c].real + 2 * a * power
                        h[3, 3] += 2 * power
                        for i in range(3):
                            cross = (np.conj(e[c]) * de[i, c]).real
                            g[i] += a * ref * de[i, c].real + 2 * a * a * cross
                            h[i, 3] += ref * de[i, c].real + 4 * a * cross
                            for j in range(3):
                                both = np.conj(de[i, c]) * de[j, c] + np.conj(e[c]) * dde[i, j, c]
                                h[i, j] += a * ref * dde[i, j, c].real + 2 * a * a * both.real
                    for i in range(3):
                        h[3, i] = h[i, 3]
                    w = weights[ix] * weights[iy]
                    first[0, row, column] += w * s
                    for i in range(4):
                        for k in range(4):
                            first[1 + i, row, column] += w * turn[i, k] * g[k]
                            for j in range(4):
                                for m in range(4):
                                    second[i, j, row, column] += (
                                        w * turn[i, k] * h[k, m] * turn[j, m]
                                    )


@njit(cache=True, nogil=True, error_model="numpy")
def _fields(
    profile: FloatArray,
    lens: Lens,
    u: float,
    v: float,
    radial: ComplexArray,
    e: ComplexArray,
    de: ComplexArray,
    dde: ComplexArray,
) -> None:
    """Fill e, its first derivatives and its second in (u, v, z)."""
    inv_step, co, cross, ring = lens.inv_step, lens.co, lens.cross, lens.ring
    r = np.sqrt(u * u + v * v)
    t = r * inv_step
    i = int(t)
    t -= i
    c = profile[:, i]
    for k in range(6):
        for n in range(3):
            total = 0j
            for p in range(5, n - 1, -1):
                factor = 1.0
                for m in range(n):
                    factor *= p - m
                total = total * t + factor * (c[2 * k, p] + 1j * c[2 * k + 1, p])
            radial[n, k] = total * inv_step**n
    f0, f2 = radial[:, 0], radial[:, 1]
    safe = r if r > 1e-6 else 1e-6
    along_u, along_v = u / safe, v / safe
    if r <= 1e-6:
        along_u, along_v = 1.0, 0.0
    quad = (co * (u * u - v * v), cross * 2 * u * v + ring * (u * u + v * v))
    quad_u = (co * 2 * u, cross * 2 * v + ring * 2 * u)
    quad_v = (-co * 2 * v, cross * 2 * u + ring * 2 * v)
    for comp in range(2):
        base = 1.0 if comp == 0 else 0.0
        w, wu, wv = quad[comp], quad_u[comp], quad_v[comp]
        w_uu = 2 * co if comp == 0 else 2 * ring
        w_vv = -2 * co if comp == 0 else 2 * ring
        w_uv = 0.0 if comp == 0 else 2 * cross
        p1 = base * f0[1] + w * f2[1]
        p2 = base * f0[2] + w * f2[2]
        bend = p1 / safe if r > 1e-6 else p2
        e[comp] = base * f0[0] + w * f2[0]
        de[0, comp] = p1 * along_u + wu * f2[0]
        de[1, comp] = p1 * along_v + wv * f2[0]
        de[2, comp] = base * radial[0, 2] + w * radial[0, 3]
        dde[0, 0, comp] = (
            p2 * along_u**2 + bend * along_v**2 + 2 * wu * f2[1] * along_u + w_uu * f2[0]
        )
        dde[1, 1, comp] = (
            p2 * along_v**2 + bend * along_u**2 + 2 * wv * f2[1] * along_v + w_vv * f2[0]
        )
        dde[0, 1, comp] = (
            (p2 - bend) * along_u * along_v + f2[1] * (wu * along_v + wv * along_u) + w_uv * f2[0]
        )
        dde[1, 0, comp] = dde[0, 1, comp]
        z1 = base * radial[1, 2] + w * radial[1, 3]
        dde[0, 2, comp] = z1 * along_u + wu * radial[0, 3]
        dde[1, 2, comp] = z1 * along_v + wv * radial[0, 3]
        dde[2, 0, comp], dde[2, 1, comp] = dde[0, 2, comp], dde[1, 2, comp]
        dde[2, 2, comp] = base * radial[0, 4] + w * radial[0, 5]
