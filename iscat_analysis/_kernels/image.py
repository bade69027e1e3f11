"""From a radial profile to the image of a particle, its gradient and its Hessian.

The *signal* is the detected intensity above the reference's, over the reference's (contrast), or in
dark field, where `rho` = 0 instead of 1, the intensity itself:

    s = 2ρ a Re e_u + a² (|e_u|² + |e_v|²),

with a the amplitude and e the field per unit amplitude.  Positions are nm; (x, y) camera axes,
(u, v) the frame of the polarisation, rotated by ψ.  Derivatives are with respect to the particle's
(x, y, z, a).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

FAST = {"contract", "reassoc", "nsz", "arcp"}


@njit(inline="always")
def point_gradient(profile, inv_step, rho, u, v, amplitude, with_z, val, der):
    """Signal at (u, v) from the particle and its derivatives (s, ∂s/∂u, ∂s/∂v, ∂s/∂z, ∂s/∂a).

    ∂/∂u and ∂/∂v are with respect to the camera point; `val` (8) and `der` (4) are scratch.
    """
    r2 = u * u + v * v
    r = np.sqrt(r2)
    t = r * inv_step
    i = int(t)
    t -= i
    channels = 8 if with_z else 4
    c = profile[i]
    for k in range(channels):
        val[k] = ((((c[5, k] * t + c[4, k]) * t + c[3, k]) * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
    for k in range(4):
        der[k] = (
            (((5 * c[5, k] * t + 4 * c[4, k]) * t + 3 * c[3, k]) * t + 2 * c[2, k]) * t + c[1, k]
        )
    per_r = inv_step / (r + 1e-30)
    c2 = u * u - v * v
    s2 = 2 * u * v
    eu_r, eu_i = val[0] + val[2] * c2, val[1] + val[3] * c2
    ev_r, ev_i = val[2] * s2, val[3] * s2
    # (1/r) d/dr of the fields at fixed (u² − v²), (2uv); then the explicit dependence on u and v
    p_r, p_i = (der[0] + der[2] * c2) * per_r, (der[1] + der[3] * c2) * per_r
    q_r, q_i = der[2] * s2 * per_r, der[3] * s2 * per_r
    # ∂u e_u = p u + 2u F2,  ∂v e_u = p v − 2v F2,  ∂u e_v = q u + 2v F2,  ∂v e_v = q v + 2u F2
    f_r, f_i = 2 * val[2], 2 * val[3]
    a = amplitude
    g_r = 2 * a * rho + 2 * a * a * eu_r
    g_i = 2 * a * a * eu_i
    h_r, h_i = 2 * a * a * ev_r, 2 * a * a * ev_i
    power = eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i
    along_p = g_r * p_r + g_i * p_i + h_r * q_r + h_i * q_i
    along_eu = g_r * f_r + g_i * f_i
    along_ev = h_r * f_r + h_i * f_i
    s = 2 * rho * a * eu_r + a * a * power
    s_u = along_p * u + along_eu * u + along_ev * v
    s_v = along_p * v - along_eu * v + along_ev * u
    s_a = 2 * rho * eu_r + 2 * a * power
    s_z = 0.0
    if with_z:
        s_z = (
            g_r * (val[4] + val[6] * c2)
            + g_i * (val[5] + val[7] * c2)
            + (h_r * val[6] + h_i * val[7]) * s2
        )
    return s, s_u, s_v, s_z, s_a


@njit(inline="always")
def point_signal(profile, inv_step, rho, u, v, amplitude, val):
    """Signal alone at (u, v) from the particle; `val` (4 or more) is scratch."""
    t = np.sqrt(u * u + v * v) * inv_step
    i = int(t)
    t -= i
    c = profile[i]
    for k in range(4):
        val[k] = ((((c[5, k] * t + c[4, k]) * t + c[3, k]) * t + c[2, k]) * t + c[1, k]) * t + c[0, k]
    c2 = u * u - v * v
    s2 = 2 * u * v
    eu_r, eu_i = val[0] + val[2] * c2, val[1] + val[3] * c2
    ev_r, ev_i = val[2] * s2, val[3] * s2
    power = eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i
    return amplitude * (2 * rho * eu_r + amplitude * power)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def signal_gradient(
    profile: FloatArray,
    inv_step: float,
    rho: float,
    x: FloatArray,
    y: FloatArray,
    x_p: float,
    y_p: float,
    amplitude: float,
    cos_psi: float,
    sin_psi: float,
    offsets: FloatArray,
    weights: FloatArray,
    out: FloatArray,
) -> None:
    """Signal and gradient on a pixel grid, averaged over q × q samples in each pixel.

    Parameters
    ----------
    profile : ndarray, shape (intervals, 6, 4 or more)
        From `radial_profile`; with 4 channels ∂/∂z is left zero.
    inv_step : float
        One over the radial step [1/nm].
    rho : float
        1 with a reference, 0 in dark field.
    x, y : ndarray, shape (nx,), (ny,)
        Pixel centres [nm].
    x_p, y_p : float
        Particle [nm].
    amplitude : float
        a.
    cos_psi, sin_psi : float
        Polarisation angle.
    offsets, weights : ndarray, shape (q,)
        Samples inside a pixel [nm] and their weights, summing to 1.
    out : ndarray, shape (5, ny, nx)
        Filled with s, ∂s/∂x_p, ∂s/∂y_p, ∂s/∂z, ∂s/∂a.
    """
    val, der = np.empty(8), np.empty(4)
    with_z = profile.shape[2] >= 8
    q = offsets.size
    for row in range(y.size):
        for column in range(x.size):
            t0 = t1 = t2 = t3 = t4 = 0.0
            for i in range(q):
                dy = y[row] + offsets[i] - y_p
                for j in range(q):
                    dx = x[column] + offsets[j] - x_p
                    w = weights[i] * weights[j]
                    s, s_u, s_v, s_z, s_a = point_gradient(
                        profile, inv_step, rho, cos_psi * dx + sin_psi * dy,
                        cos_psi * dy - sin_psi * dx, amplitude, with_z, val, der,
                    )  # fmt: skip
                    t0 += w * s
                    t1 -= w * (cos_psi * s_u - sin_psi * s_v)
                    t2 -= w * (sin_psi * s_u + cos_psi * s_v)
                    t3 += w * s_z
                    t4 += w * s_a
            out[0, row, column] = t0
            out[1, row, column] = t1
            out[2, row, column] = t2
            out[3, row, column] = t3
            out[4, row, column] = t4
