"""The radial functions of the field, as quintic tables along r and along z.

The field in the frame of the polarisation is

    e_u = F0(r) + F2(r)·(u² − v²),      e_v = F2(r)·2uv,

with F0 = I0 and F2 = I2/r², both entire and even in r and band-limited at k·NA.  On a uniform
radial grid their values and first two radial derivatives are linear in the pupil's phase vector
at height z, so one pass over the precomputed Bessel matrices (`radial_profile`) gives quintic
Hermite coefficients at any z, evanescent waves included.  With step h the quintic errs by
(h k NA)⁶/46080 of the peak.

A fit asks for hundreds of heights in one range.  There the mean phase exp(iκz) is divided out, the
profile and its first two derivatives along z are tabulated, and `profile_at` interpolates them by
the same quintic, at a tenth of the cost and with the same error.

A *profile* has shape (intervals, 6, channels), the middle axis the powers of t ∈ [0, 1) in each
interval; the channels are Re F0, Im F0, Re F2, Im F2, followed by the same four for ∂/∂z, and for
∂²/∂z² where asked.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import j0, j1

from iscat_analysis._kernels.vectors import LANES, together

FloatArray = NDArray[np.float64]

STEP = 0.3
"""Step times bandwidth, along r and z: 1.6e-8 of the peak in the field, 3e-7 in its gradient."""


POWERS = 6
"""Of a quintic."""


class AxialTable(NamedTuple):
    """Profiles along z, without their carrier exp(iκz).

    Attributes
    ----------
    heights : ndarray, shape (n, 3, channels, width)
        At each height: the flattened profile, step·∂z and step²·∂z² of it.
    first_nm, step_nm : float
        First height and step [nm].
    kappa : float
        Wavenumber of the carrier [rad/nm].
    """

    heights: FloatArray
    first_nm: float
    step_nm: float
    kappa: float


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
def _add_four(
    w: FloatArray,
    a: FloatArray,
    b: FloatArray,
    c: FloatArray,
    d: FloatArray,
    n0: FloatArray,
    n1: FloatArray,
) -> None:
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


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _mix(
    heights: FloatArray, i: int, channel: int, start: int, w: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (n) with the combination w (6) of a channel's rows at heights i and i + 1.

    The rows begin at `start`.  Three at a time: against more that might overlap, the compiler gives
    up on vectors, as it does where it does not know that a row's numbers follow one another.
    """
    span = slice(start, start + out.size)
    low, high = heights[i], heights[i + 1]
    t0, t1, t2 = low[0, channel, span], low[1, channel, span], low[2, channel, span]
    w0, w1, w2 = w[0], w[1], w[2]
    for j in range(out.size):
        out[j] = w0 * t0[j] + w1 * t1[j] + w2 * t2[j]
    t0, t1, t2 = high[0, channel, span], high[1, channel, span], high[2, channel, span]
    w0, w1, w2 = w[3], w[4], w[5]
    for j in range(out.size):
        out[j] += w0 * t0[j] + w1 * t1[j] + w2 * t2[j]


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _turn(
    re: FloatArray,
    im: FloatArray,
    cos: float,
    sin: float,
    out: FloatArray,
    first_re: int,
    first_im: int,
    stride: int,
) -> None:
    """Multiply re + i·im by cos + i·sin, into the numbers of `out` from two first ones on."""
    for j in range(re.size):
        a, b = re[j], im[j]
        out[first_re + j * stride] = a * cos - b * sin
        out[first_im + j * stride] = a * sin + b * cos


@njit(cache=True, nogil=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")
def _turn_here(re: FloatArray, im: FloatArray, cos: float, sin: float) -> None:
    """Multiply re + i·im by cos + i·sin where it stands."""
    for j in range(re.size):
        a, b = re[j], im[j]
        re[j] = a * cos - b * sin
        im[j] = a * sin + b * cos


@njit(cache=True, nogil=True, error_model="numpy")
def _add_carrier(
    kappa: float,
    re: FloatArray,
    im: FloatArray,
    slope_re: FloatArray,
    slope_im: FloatArray,
    bend_re: FloatArray,
    bend_im: FloatArray,
) -> None:
    """Add to ∂²/∂z² what the carrier gives, 2iκ (∂z + iκ) + κ², the slopes having theirs."""
    for j in range(re.size):
        bend_re[j] += kappa * (kappa * re[j] - 2 * slope_im[j])
        bend_im[j] += kappa * (kappa * im[j] + 2 * slope_re[j])


@njit(cache=True, nogil=True, error_model="numpy")
def profile_at(
    axial: AxialTable,
    z_nm: float,
    start: int,
    stop: int,
    work: FloatArray,
    profile: FloatArray,
) -> None:
    """Fill a range of a flattened profile by interpolation along z.

    Parameters
    ----------
    axial : AxialTable
        Profiles along z.
    z_nm : float
        Height [nm], inside the table.
    start, stop : int
        Range of the flattened profile.
    work : ndarray, shape (orders, channels, width)
        Scratch.
    profile : ndarray
        Filled; with twice the channels of the table ∂/∂z too, with three times ∂²/∂z² as well.
        The channels of a radial profile are its last axis, those of a lattice its first; a lattice
        has an odd number of nodes and a quintic six powers, which tells them apart.
    """
    heights, first_nm, step_nm, kappa = axial
    place = (z_nm - first_nm) / step_nm
    i = min(max(int(place), 0), heights.shape[0] - 2)
    t = place - i
    t2, t3, t4, t5 = t**2, t**3, t**4, t**5
    v, d, b = np.empty(6), np.empty(6), np.empty(6)
    v[3] = 10 * t3 - 15 * t4 + 6 * t5
    v[0] = 1 - v[3]
    v[1] = t - 6 * t3 + 8 * t4 - 3 * t5
    v[2] = 0.5 * t2 - 1.5 * t3 + 1.5 * t4 - 0.5 * t5
    v[4] = -4 * t3 + 7 * t4 - 3 * t5
    v[5] = 0.5 * t3 - t4 + 0.5 * t5
    d[3] = 30 * t2 - 60 * t3 + 30 * t4
    d[0] = -d[3]
    d[1] = 1 - 18 * t2 + 32 * t3 - 15 * t4
    d[2] = t - 4.5 * t2 + 6 * t3 - 2.5 * t4
    d[4] = -12 * t2 + 28 * t3 - 15 * t4
    d[5] = 1.5 * t2 - 4 * t3 + 2.5 * t4
    d /= step_nm
    b[3] = 60 * t - 180 * t2 + 120 * t3
    b[0] = -b[3]
    b[1] = -36 * t + 96 * t2 - 60 * t3
    b[2] = 1 - 9 * t + 18 * t2 - 10 * t3
    b[4] = -24 * t + 84 * t2 - 60 * t3
    b[5] = 3 * t - 12 * t2 + 10 * t3
    b /= step_nm * step_nm
    channels, width = heights.shape[2:]
    every = profile.size // width
    with_slope, with_bend = every > channels, every > 2 * channels
    cos, sin = np.cos(kappa * z_nm), np.sin(kappa * z_nm)
    radial = profile.shape[1] == POWERS
    in_registers = radial and every == LANES
    flat = profile.reshape(profile.size)
    apart, stride = (1, every) if radial else (width, 1)
    begin = start * stride
    for channel in range(channels):
        _mix(heights, i, channel, start, v, work[0, channel, start:stop])
        if with_slope:
            _mix(heights, i, channel, start, d, work[1, channel, start:stop])
        if with_bend:
            _mix(heights, i, channel, start, b, work[2, channel, start:stop])
    for c in range(0, channels, 2):
        re, im = work[0, c, start:stop], work[0, c + 1, start:stop]
        if with_slope:
            slope_re, slope_im = work[1, c, start:stop], work[1, c + 1, start:stop]
            for j in range(re.size):
                slope_re[j] -= kappa * im[j]
                slope_im[j] += kappa * re[j]
            if in_registers:
                _turn_here(re, im, cos, sin)
                _turn_here(slope_re, slope_im, cos, sin)
                continue
            there = begin + (c + channels) * apart
            _turn(slope_re, slope_im, cos, sin, flat, there, there + apart, stride)
        if with_bend:
            bend_re, bend_im = work[2, c, start:stop], work[2, c + 1, start:stop]
            _add_carrier(
                kappa, re, im, work[1, c, start:stop], work[1, c + 1, start:stop], bend_re, bend_im
            )
            there = begin + (c + 2 * channels) * apart
            _turn(bend_re, bend_im, cos, sin, flat, there, there + apart, stride)
        _turn(re, im, cos, sin, flat, begin + c * apart, begin + (c + 1) * apart, stride)
    if in_registers:
        together(work.reshape(every, width), start, stop, profile.reshape(width, every))


@njit(cache=True, nogil=True, error_model="numpy")
def profile_between(axial: AxialTable, z_nm: float, profile: FloatArray) -> None:
    """Fill a whole profile of one order or more by interpolation along z."""
    channels, width = axial.heights.shape[2:]
    work = np.empty((profile.size // (width * channels), channels, width))
    profile_at(axial, z_nm, 0, width, work, profile)
