"""The radial functions of the field, as quintic tables along r and along z.

The field in the frame of the polarisation is

    e_u = F0(r) + F2(r)·(u² − v²),      e_v = F2(r)·2uv,

with F0 = I0 and F2 = I2/r², both entire and even in r and band-limited at k·NA.  On a uniform
radial grid their values and first two radial derivatives are linear in the pupil's phase vector
at height z, so one pass over the precomputed Bessel matrices (`radial_profile`) gives quintic
Hermite coefficients at any z, evanescent waves included.  With step h the quintic errs by
(h k NA)⁶/46080 of the peak.

A fit needs hundreds of heights in one range.  For these, the mean phase exp(iκz) is divided out and
the profile and its first two derivatives along z are tabulated.  `profile_at` interpolates them by
the same quintic, in a tenth of the time and with the same error.

A *profile* has shape (intervals, 6, channels), the middle axis the powers of t ∈ [0, 1) in each
interval; the channels are Re F0, Im F0, Re F2, Im F2, followed by the same four for ∂/∂z, and for
∂²/∂z² where asked.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.special import hyp0f1

from iscat_analysis._kernels import ComplexArray, FloatArray, kernel
from iscat_analysis._kernels.loops import whole
from iscat_analysis._kernels.vectors import LANES, Code, instructions

STEP = 0.3
"""Step times bandwidth, along r and z: 1.6e-8 of the peak in the field, 3e-7 in its gradient."""


POWERS = 6
"""Number of powers of a quintic."""

_ROWS = 6  # of a table, which are combined for a height between two nodes
_CHANNELS = 4  # channels of one order of a radial profile


class AxialTable(NamedTuple):
    """Profiles along z, without their carrier exp(iκz)."""

    heights: FloatArray
    first_nm: float
    step_nm: float
    kappa: float


def bessel_table(transverse: FloatArray, step_nm: float, intervals: int) -> FloatArray:
    """Bessel matrices of the radial grid.

    Shapes: `transverse` (n,), result (2, n, 3, intervals + 1).
    """
    a = transverse[:, None]
    h = step_nm
    x = a * (h * np.arange(intervals + 1))
    # J_ν(x)/x^ν
    f = [hyp0f1(nu + 1, -((x / 2) ** 2)) / (2**nu * math.factorial(nu)) for nu in range(5)]
    ah = a * h
    table = np.empty((2, transverse.size, 3, intervals + 1))
    table[0, :, 0] = f[0]
    table[0, :, 1] = -ah * x * f[1]
    table[0, :, 2] = ah**2 * (x**2 * f[2] - f[1])
    table[1, :, 0] = a**2 * f[2]
    table[1, :, 1] = -(a**2) * ah * x * f[3]
    table[1, :, 2] = a**2 * ah**2 * (x**2 * f[4] - f[3])
    return table


@kernel(fastmath={"contract", "reassoc", "nsz"})
def fill_quintics(nodes: FloatArray, powers: FloatArray) -> None:
    """Fill `powers` (n, 6, k) from value, slope and bend (3, n + 1, k) at the nodes."""
    for i in range(powers.shape[0]):
        for j in range(powers.shape[2]):
            f, d0, s0 = nodes[0, i, j], nodes[1, i, j], nodes[2, i, j]
            d1, s1 = nodes[1, i + 1, j], nodes[2, i + 1, j]
            rise = nodes[0, i + 1, j] - f
            powers[i, 0, j] = f
            powers[i, 1, j] = d0
            powers[i, 2, j] = 0.5 * s0
            powers[i, 3, j] = 10 * rise - 6 * d0 - 4 * d1 - 1.5 * s0 + 0.5 * s1
            powers[i, 4, j] = -15 * rise + 8 * d0 + 7 * d1 + 1.5 * s0 - s1
            powers[i, 5, j] = 6 * rise - 3 * d0 - 3 * d1 - 0.5 * s0 + 0.5 * s1


@kernel(fastmath={"contract", "reassoc", "nsz"})
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


@kernel(fastmath={"contract", "reassoc", "nsz"})
def radial_profile(
    table: FloatArray,
    source: ComplexArray,
    axial: ComplexArray,
    z_nm: float,
    orders: int,
    nodes: FloatArray,
    profile: FloatArray,
) -> None:
    """Fill a profile at height z.

    Shapes: `table` (2, n, 3, intervals + 1), `source` (2, n), `axial` (n,), `nodes` (4·orders,
    3·(intervals + 1), `profile` (intervals, 6, 4·orders).
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
    fill_quintics(nodes.reshape(4 * orders, 3, points).transpose(1, 2, 0), profile)


def _mixed(code: Code, place: Any, orders: int) -> list[tuple[Any, Any]]:
    """Write the combination of eight numbers of a channel and of the next, times the carrier.

    The result has one pair, real and imaginary part, for each order.
    """
    *weights, cos, sin, kappa = code.factors
    width = code.length(code.one, 3)
    line = code.times(code.length(code.one, 2), width)
    below = code.negative(kappa)

    def channel(begin: Any) -> list[Any]:
        places = (code.plus(begin, code.times(code.index(k), line)) for k in range(_ROWS))
        rows = [code.load(code.at(code.one, where)) for where in places]
        out = []
        for order in range(orders):
            first, *others = weights[_ROWS * order : _ROWS * (order + 1)]
            total = code.multiply(first, rows[0])
            for weight, row in zip(others, rows[1:], strict=True):
                total = code.multiply_add(weight, row, total)
            out.append(total)
        return out

    re, im = channel(place), channel(code.plus(place, width))
    if orders > 1:  # ∂z + iκ
        re[1] = code.multiply_add(below, im[0], re[1])
        im[1] = code.multiply_add(kappa, re[0], im[1])
    if orders > 2:  # ∂z² + 2iκ (∂z + iκ) + κ²
        turned_re, turned_im = code.negative(code.plus_itself(im[1])), code.plus_itself(re[1])
        re[2] = code.multiply_add(kappa, code.multiply_add(kappa, re[0], turned_re), re[2])
        im[2] = code.multiply_add(kappa, code.multiply_add(kappa, im[0], turned_im), im[2])
    back = code.negative(sin)
    return [
        (
            code.multiply_add(cos, a, code.multiply(back, b)),
            code.multiply_add(sin, a, code.multiply(cos, b)),
        )
        for a, b in zip(re, im, strict=True)
    ]


def _write_radial(code: Code, orders: int) -> None:
    """Fill eight places of a profile whose channels follow one another."""
    begin = code.times(code.first, code.index(_CHANNELS * orders))
    far = code.plus(code.first, code.times(code.index(2), code.length(code.one, 3)))
    both = zip(_mixed(code, code.first, orders), _mixed(code, far, orders), strict=True)
    for order, (one, other) in enumerate(both):
        pairs = (code.halves(row) for row in code.exchanged([*one, *other]))
        low, high = zip(*pairs, strict=True)
        for k, four in enumerate((*low, *high)):
            place = code.plus(begin, code.index(_CHANNELS * (k * orders + order)))
            code.store(four, code.at(code.other, place))


def _write_lattice(code: Code, orders: int) -> None:
    """Fill eight places of a channel of a lattice and of the next."""
    width = code.length(code.one, 3)
    for order, pair in enumerate(_mixed(code, code.first, orders)):
        line = code.times(code.times(code.index(order), code.length(code.one, 2)), width)
        place = code.plus(code.first, line)
        for row in pair:
            code.store(row, code.at(code.other, place))
            place = code.plus(place, width)


_radial_1, _radial_2, _radial_3, _lattice_1, _lattice_2, _lattice_3 = (
    instructions(partial(write, orders=orders), factors=True)
    for write in (_write_radial, _write_lattice)
    for orders in (1, 2, 3)
)


@kernel()
def profile_at(axial: AxialTable, z_nm: float, start: int, stop: int, profile: FloatArray) -> None:
    """Fill a range of a flattened profile by interpolation along z."""
    heights, first_nm, step_nm, kappa = axial
    place = (z_nm - first_nm) / step_nm
    i = whole(place, 0, heights.shape[0] - 2)
    t, per = place - i, 1.0 / step_nm
    t2, t3, t4, t5, per2 = t**2, t**3, t**4, t**5, per * per
    value = 10 * t3 - 15 * t4 + 6 * t5
    slope = per * (30 * t2 - 60 * t3 + 30 * t4)
    bend = per2 * (60 * t - 180 * t2 + 120 * t3)
    factors = (
        1 - value, t - 6 * t3 + 8 * t4 - 3 * t5, 0.5 * t2 - 1.5 * t3 + 1.5 * t4 - 0.5 * t5,
        value, -4 * t3 + 7 * t4 - 3 * t5, 0.5 * t3 - t4 + 0.5 * t5,
        -slope, per * (1 - 18 * t2 + 32 * t3 - 15 * t4), per * (t - 4.5 * t2 + 6 * t3 - 2.5 * t4),
        slope, per * (-12 * t2 + 28 * t3 - 15 * t4), per * (1.5 * t2 - 4 * t3 + 2.5 * t4),
        -bend, per2 * (-36 * t + 96 * t2 - 60 * t3), per2 * (1 - 9 * t + 18 * t2 - 10 * t3),
        bend, per2 * (-24 * t + 84 * t2 - 60 * t3), per2 * (3 * t - 12 * t2 + 10 * t3),
        np.cos(kappa * z_nm), np.sin(kappa * z_nm), kappa,
    )  # fmt: skip
    channels, width = heights.shape[2:]
    near, orders, last = heights[i : i + 2], profile.size // (channels * width), stop - LANES
    if profile.shape[1] == POWERS:
        for j in range(start, stop, LANES):  # the last eight again if fewer are left
            if orders == 1:
                _radial_1(near, profile, min(j, last), factors)
            elif orders == 2:
                _radial_2(near, profile, min(j, last), factors)
            else:
                _radial_3(near, profile, min(j, last), factors)
        return
    for begin in range(0, channels * width, 2 * width):
        for j in range(start, stop, LANES):
            if orders == 1:
                _lattice_1(near, profile, begin + min(j, last), factors)
            elif orders == 2:
                _lattice_2(near, profile, begin + min(j, last), factors)
            else:
                _lattice_3(near, profile, begin + min(j, last), factors)
