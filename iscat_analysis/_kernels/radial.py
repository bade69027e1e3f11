"""The radial functions of the field, as a quintic table that is exact along z.

The field in the frame of the polarisation is

    e_u = F0(r) + F2(r)·(u² − v²),      e_v = F2(r)·2uv,

with F0 = I0 and F2 = I2/r², both entire and even in r and band-limited at k·NA.  On a uniform
radial grid their values and first two radial derivatives are linear in the pupil's phase vector
at height z, so one pass over the precomputed Bessel matrices gives quintic Hermite coefficients at
any z, evanescent waves included; there is no interpolation along z.  With step h the quintic errs
by (h k NA)⁶/46080 of the peak.

A *profile* has shape (intervals, 6, channels): powers of t ∈ [0, 1) in each interval, then Re F0,
Im F0, Re F2, Im F2, followed by the same four for ∂/∂z, and for ∂²/∂z² where asked.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import j0, j1

FloatArray = NDArray[np.float64]

STEP = 0.3
"""Radial step times k·NA: 1.6e-8 of the peak in the field, 3e-7 in its gradient."""


def reduced_bessel(x: FloatArray) -> FloatArray:
    """J_ν(x)/x^ν for ν = 0…4.

    Upward recurrence from scipy's J0 and J1 where it is stable, the power series below.

    Parameters
    ----------
    x : ndarray
        Arguments ≥ 0, any shape.

    Returns
    -------
    ndarray, shape (5, *x.shape)
        The five functions.
    """
    out = np.empty((5, *x.shape))
    small = x < 5.0
    q = -((x[small] / 2) ** 2)
    for order in range(5):
        term = np.full(q.shape, 1.0)
        for m in range(1, order + 1):
            term /= 2 * m
        total = term.copy()
        for m in range(1, 26):
            term *= q / (m * (m + order))
            total += term
        out[order][small] = total
    large = x[~small]
    lower, upper = j0(large), j1(large)
    out[0][~small], out[1][~small] = lower, upper / large
    power = large.copy()
    for order in range(2, 5):
        lower, upper = upper, 2 * (order - 1) / large * upper - lower
        power *= large
        out[order][~small] = upper / power
    return out


def bessel_table(transverse: FloatArray, step_nm: float, intervals: int) -> FloatArray:
    """Bessel matrices of the radial grid.

    Parameters
    ----------
    transverse : ndarray, shape (n,)
        Transverse wavenumbers a [rad/nm].
    step_nm : float
        Radial step h [nm].
    intervals : int
        Number of intervals.

    Returns
    -------
    ndarray, shape (2, n, 3, intervals + 1)
        For F0 and F2: value, h·∂r and h²·∂r² at every node.
    """
    a = transverse[:, None]
    h = step_nm
    x = a * (h * np.arange(intervals + 1))
    f = reduced_bessel(x)
    ah = a * h
    table = np.empty((2, transverse.size, 3, intervals + 1))
    table[0, :, 0] = f[0]
    table[0, :, 1] = -ah * x * f[1]
    table[0, :, 2] = ah**2 * (x**2 * f[2] - f[1])
    table[1, :, 0] = a**2 * f[2]
    table[1, :, 1] = -(a**2) * ah * x * f[3]
    table[1, :, 2] = a**2 * ah**2 * (x**2 * f[4] - f[3])
    return table


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _add_four(w, a, b, c, d, n0, n1):
    """Add four rows of the Bessel matrix, with the complex weights w (2, 4), to two channels."""
    for j in range(a.size):
        n0[j] += w[0, 0] * a[j] + w[0, 1] * b[j] + w[0, 2] * c[j] + w[0, 3] * d[j]
        n1[j] += w[1, 0] * a[j] + w[1, 1] * b[j] + w[1, 2] * c[j] + w[1, 3] * d[j]


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def radial_profile(
    table: FloatArray,
    source: NDArray[np.complex128],
    axial: NDArray[np.complex128],
    z_nm: float,
    orders: int,
    nodes: FloatArray,
    profile: FloatArray,
) -> None:
    """Fill a profile at height z.

    Parameters
    ----------
    table : ndarray, shape (2, n, 3, intervals + 1)
        From `bessel_table`; n a multiple of 4.
    source : complex ndarray, shape (2, n)
        Pupil weights of F0 and F2 at z = 0.
    axial : complex ndarray, shape (n,)
        Phase per height [rad/nm]; the imaginary part is evanescent decay.
    z_nm : float
        Height [nm].
    orders : int
        1: fields only; 2: with ∂/∂z; 3: with ∂²/∂z².
    nodes : ndarray, shape (4·orders, 3·(intervals + 1))
        Scratch.
    profile : ndarray, shape (intervals, 6, 4·orders)
        Filled.
    """
    n = axial.size
    points = table.shape[3]
    width = 3 * points
    rows = table.reshape(2, n, width)
    weight = np.empty((2, orders, 2, n))
    for i in range(n):
        turn = np.exp(1j * axial[i] * z_nm)
        for which in range(2):
            value = source[which, i] * turn
            for order in range(orders):
                weight[which, order, 0, i] = value.real
                weight[which, order, 1, i] = value.imag
                value = value * 1j * axial[i]
    nodes[:] = 0.0
    for which in range(2):
        for i in range(0, n, 4):
            for order in range(orders):
                channel = 4 * order + 2 * which
                _add_four(
                    weight[which, order, :, i : i + 4], rows[which, i], rows[which, i + 1],
                    rows[which, i + 2], rows[which, i + 3], nodes[channel], nodes[channel + 1],
                )  # fmt: skip
    for channel in range(4 * orders):
        f = nodes[channel, :points]
        d = nodes[channel, points : 2 * points]
        s = nodes[channel, 2 * points :]
        for k in range(points - 1):
            rise = f[k + 1] - f[k]
            profile[k, 0, channel] = f[k]
            profile[k, 1, channel] = d[k]
            profile[k, 2, channel] = 0.5 * s[k]
            profile[k, 3, channel] = (
                10 * rise - 6 * d[k] - 4 * d[k + 1] - 1.5 * s[k] + 0.5 * s[k + 1]
            )
            profile[k, 4, channel] = -15 * rise + 8 * d[k] + 7 * d[k + 1] + 1.5 * s[k] - s[k + 1]
            profile[k, 5, channel] = (
                6 * rise - 3 * d[k] - 3 * d[k + 1] - 0.5 * s[k] + 0.5 * s[k + 1]
            )
