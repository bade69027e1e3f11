"""Rows of pixels of a particle at one height, from samples of its picture.

At one height the signal is a P(x, y) + a² Q(x, y), both averaged over a pixel and band-limited,
P at k·NA and Q at twice that.  Sampled `fine` times per pixel they need no pupil, no fields and no
samples inside the pixels any more.  As the samples lie on the pixels' own grid, all pixels of an
image take the same `TAPS`² weights, those of `iscat_analysis.optics.stamp`, along y first and then
along x.

A *profile* has shape (2, nodes along y, nodes along x): P and Q.  The nodes along x are in the
order of their place in a pixel: all that are the first in theirs, all that are the second, …, so
that what one weight multiplies for all columns of pixels follows one another in memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.lattice import FAST, TAPS
from iscat_analysis._kernels.lattice_rows import BEFORE, taps

if TYPE_CHECKING:
    from iscat_analysis._kernels.image import Lens, Pixels

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

ROWS = 5
"""Rows of work space: the weights, then P and Q of a row of pixels, and their slopes along y."""

_WEIGHTS = 4 * TAPS + 2  # of x and y, their slopes, and the first nodes


@njit(cache=True, nogil=True, error_model="numpy")
def stamp_width(lens: Lens, columns: int) -> int:
    """Columns of work space that a row of pixels needs."""
    return max(lens.fine * (columns + TAPS + 1), _WEIGHTS)


@njit(cache=True, nogil=True, error_model="numpy")
def begin_stamp(lens: Lens, pixels: Pixels, x_p: float, y_p: float, f: FloatArray) -> None:
    """Put the weights of all pixels into the first row of the work space."""
    w = f[0]
    x = (pixels.x[0] - x_p) * lens.inv_step + lens.half
    y = (pixels.y[0] - y_p) * lens.inv_step + lens.half
    i, j = int(x), int(y)
    taps(lens.window, x - i, w[:TAPS], w[TAPS : 2 * TAPS])
    taps(lens.window, y - j, w[2 * TAPS : 3 * TAPS], w[3 * TAPS : 4 * TAPS])
    for k in range(TAPS):
        w[TAPS + k] *= lens.inv_step
        w[3 * TAPS + k] *= lens.inv_step
    w[4 * TAPS], w[4 * TAPS + 1] = i - BEFORE, j - BEFORE


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _down(
    nodes: FloatArray, row: int, first: int, w: FloatArray, v: FloatArray,
    out: FloatArray, other: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` and `other` with the combinations w and v of TAPS rows of nodes."""
    last = first + out.size
    for part in range(0, TAPS, 4):
        a, b = nodes[row + part, first:last], nodes[row + part + 1, first:last]
        c, d = nodes[row + part + 2, first:last], nodes[row + part + 3, first:last]
        wa, wb, wc, wd = w[part], w[part + 1], w[part + 2], w[part + 3]
        va, vb, vc, vd = v[part], v[part + 1], v[part + 2], v[part + 3]
        if part == 0:
            for j in range(out.size):
                out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
                other[j] = va * a[j] + vb * b[j] + vc * c[j] + vd * d[j]
        else:
            for j in range(out.size):
                out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
                other[j] += va * a[j] + vb * b[j] + vc * c[j] + vd * d[j]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _down_once(nodes: FloatArray, row: int, first: int, w: FloatArray, out: FloatArray) -> None:
    """Fill `out` with the combination w of TAPS rows of nodes."""
    last = first + out.size
    for part in range(0, TAPS, 4):
        a, b = nodes[row + part, first:last], nodes[row + part + 1, first:last]
        c, d = nodes[row + part + 2, first:last], nodes[row + part + 3, first:last]
        wa, wb, wc, wd = w[part], w[part + 1], w[part + 2], w[part + 3]
        if part == 0:
            for j in range(out.size):
                out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
        else:
            for j in range(out.size):
                out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _across(
    nodes: FloatArray, length: int, phase: int, fine: int, w: FloatArray, out: FloatArray
) -> None:
    """Fill `out` with the combination w of nodes, those of each place in a pixel `length` apart."""
    n = out.size
    for part in range(0, TAPS, 4):
        i = phase + part
        a0 = i % fine * length + i // fine
        b0 = (i + 1) % fine * length + (i + 1) // fine
        c0 = (i + 2) % fine * length + (i + 2) // fine
        d0 = (i + 3) % fine * length + (i + 3) // fine
        a, b, c, d = nodes[a0 : a0 + n], nodes[b0 : b0 + n], nodes[c0 : c0 + n], nodes[d0 : d0 + n]
        wa, wb, wc, wd = w[part], w[part + 1], w[part + 2], w[part + 3]
        if part == 0:
            for j in range(n):
                out[j] = wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]
        else:
            for j in range(n):
                out[j] += wa * a[j] + wb * b[j] + wc * c[j] + wd * d[j]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def stamp_gradient(
    profile: FloatArray, lens: Lens, row: int, amplitude: float, f: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (5, nx) with signal and gradient of one row of pixels; ∂s/∂z is left 0."""
    fine, n, a = lens.fine, out.shape[1], amplitude
    w = f[0]
    left, top = int(w[4 * TAPS]), int(w[4 * TAPS + 1]) + fine * row
    wy, vy = w[2 * TAPS : 3 * TAPS], w[3 * TAPS : 4 * TAPS]
    per_phase = profile.shape[2] // fine
    length = n + TAPS // fine + 1
    for k in range(fine):
        here, first = k * length, k * per_phase + left // fine
        last = here + min(length, per_phase - left // fine)
        _down(profile[0], top, first, wy, vy, f[1, here:last], f[2, here:last])
        _down(profile[1], top, first, wy, vy, f[3, here:last], f[4, here:last])
    p, p_y, q, q_y = f[1], f[2], f[3], f[4]
    for j in range(fine * length):
        s = a * (p[j] + a * q[j])
        p_y[j] = a * (p_y[j] + a * q_y[j])
        q[j] = p[j] + 2.0 * a * q[j]
        p[j] = s
    phase = left % fine
    wx, vx = w[:TAPS], w[TAPS : 2 * TAPS]
    _across(p, length, phase, fine, wx, out[0])
    _across(p, length, phase, fine, vx, out[1])
    _across(p_y, length, phase, fine, wx, out[2])
    _across(q, length, phase, fine, wx, out[4])
    for j in range(n):
        out[1, j] = -out[1, j]
        out[2, j] = -out[2, j]
        out[3, j] = 0.0


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def stamp_signal(
    profile: FloatArray, lens: Lens, row: int, amplitude: float, f: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (nx,) with the signal of one row of pixels."""
    fine, a = lens.fine, amplitude
    w = f[0]
    left, top = int(w[4 * TAPS]), int(w[4 * TAPS + 1]) + fine * row
    wy = w[2 * TAPS : 3 * TAPS]
    per_phase = profile.shape[2] // fine
    length = out.size + TAPS // fine + 1
    for k in range(fine):
        here, first = k * length, k * per_phase + left // fine
        last = here + min(length, per_phase - left // fine)
        _down_once(profile[0], top, first, wy, f[1, here:last])
        _down_once(profile[1], top, first, wy, f[3, here:last])
    p, q = f[1], f[3]
    for j in range(fine * length):
        p[j] = a * (p[j] + a * q[j])
    _across(p, length, left % fine, fine, w[:TAPS], out)
