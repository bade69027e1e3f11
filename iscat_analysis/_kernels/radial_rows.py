"""From a radial profile to the image of a particle and its gradient, a strip of rows at a time.

A strip needs two loops over all of its pixels: the first evaluates the quintics, eight pixels
at a time (`iscat_analysis._kernels.quintics`); the second combines them.  Both use vector
registers, and their rows of scratch fit into the first cache.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.quintics import DISTANCE, evaluate, evaluate_slopes, padded
from iscat_analysis._kernels.whole import whole

if TYPE_CHECKING:
    from iscat_analysis._kernels.image import Pixels
    from iscat_analysis._kernels.lens import RoundLens

FloatArray = NDArray[np.float64]

_DX, _DY, _SUMS = DISTANCE + 1, DISTANCE + 2, DISTANCE + 3
"""Rows of scratch after those of the quintics: dx, dy, and the sums over the samples."""

_SCRATCH = _SUMS + 5
_STRIP = 256  # pixels, or one row if it has more


@kernel()
def intervals_needed(lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, most: int) -> int:
    """Count the intervals of a radial profile that an image needs, of `most`, and one to round."""
    x, y, margin = pixels.x, pixels.y, abs(pixels.offsets[-1])
    dx = max(abs(x[0] - x_p), abs(x[-1] - x_p)) + margin
    dy = max(abs(y[0] - y_p), abs(y[-1] - y_p)) + margin
    distance = np.sqrt(dx * dx + dy * dy) * lens.inv_step
    needed: int = min(whole(distance, 0, most) + 2, most)
    return needed


@kernel(fastmath=FAST)
def _place(
    inv_step: float, x: FloatArray, y: FloatArray, x_p: float, y_p: float, f: FloatArray
) -> None:
    """Fill rows `_DX`, `_DY` and `DISTANCE` of f; with zeros if there are no pixels."""
    for i in range(y.size):
        for j in range(x.size):
            f[_DX, i * x.size + j] = x[j] - x_p
            f[_DY, i * x.size + j] = y[i] - y_p
    for j in range(x.size * y.size, f.shape[1]):
        f[_DX, j] = f[_DY, j] = 0.0
    for j in range(f.shape[1]):
        f[DISTANCE, j] = np.sqrt(f[_DX, j] * f[_DX, j] + f[_DY, j] * f[_DY, j]) * inv_step


@kernel(fastmath=FAST)
def _add_gradient(
    inv_step: float, rho: float, cos_psi: float, sin_psi: float, co: float, cross: float,
    ring: float, amplitude: float, weight: float, f: FloatArray,
) -> None:  # fmt: skip
    """Add weight × (s, ∂s/∂x_p, ∂s/∂y_p, ∂s/∂z, ∂s/∂a) of a strip to its sums."""
    a = amplitude
    for j in range(f.shape[1]):
        dx, dy = f[_DX, j], f[_DY, j]
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        per_r = inv_step * inv_step / (f[DISTANCE, j] + 1e-30)
        c2, s2 = co * (u * u - v * v), cross * (2 * u * v) + ring * (u * u + v * v)
        eu_r, eu_i = f[0, j] + f[2, j] * c2, f[1, j] + f[3, j] * c2
        ev_r, ev_i = f[2, j] * s2, f[3, j] * s2
        # (1/r) d/dr of the fields at fixed u² − v² and 2uv
        p_r, p_i = (f[8, j] + f[10, j] * c2) * per_r, (f[9, j] + f[11, j] * c2) * per_r
        q_r, q_i = f[10, j] * s2 * per_r, f[11, j] * s2 * per_r
        # ∂s = Re(g* ∂e_u + h* ∂e_v), with ∂u e_u = p u + 2u F2 co, ∂v e_u = p v − 2v F2 co,
        # ∂u e_v = q u + 2 F2 (v cross + u ring), ∂v e_v = q v + 2 F2 (u cross + v ring)
        g_r, g_i = 2 * a * rho + 2 * a * a * eu_r, 2 * a * a * eu_i
        h_r, h_i = 2 * a * a * ev_r, 2 * a * a * ev_i
        along_r = g_r * p_r + g_i * p_i + h_r * q_r + h_i * q_i
        along_u = 2 * co * (g_r * f[2, j] + g_i * f[3, j])
        both = 2 * (h_r * f[2, j] + h_i * f[3, j])
        along_r += ring * both
        along_v = cross * both
        s_u = along_r * u + along_u * u + along_v * v
        s_v = along_r * v - along_u * v + along_v * u
        power = eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i
        f[_SUMS, j] += weight * (2 * rho * a * eu_r + a * a * power)
        f[_SUMS + 1, j] -= weight * (cos_psi * s_u - sin_psi * s_v)
        f[_SUMS + 2, j] -= weight * (sin_psi * s_u + cos_psi * s_v)
        f[_SUMS + 3, j] += weight * (
            g_r * (f[4, j] + f[6, j] * c2)
            + g_i * (f[5, j] + f[7, j] * c2)
            + (h_r * f[6, j] + h_i * f[7, j]) * s2
        )
        f[_SUMS + 4, j] += weight * (2 * rho * eu_r + 2 * a * power)


@kernel(fastmath=FAST)
def _add_parts(
    rho: float, cos_psi: float, sin_psi: float, co: float, cross: float, ring: float,
    weight: float, f: FloatArray,
) -> None:  # fmt: skip
    """Add weight × the factors of a and a² in a strip of signals to its sums."""
    for j in range(f.shape[1]):
        dx, dy = f[_DX, j], f[_DY, j]
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        c2, s2 = co * (u * u - v * v), cross * (2 * u * v) + ring * (u * u + v * v)
        eu_r, eu_i = f[0, j] + f[2, j] * c2, f[1, j] + f[3, j] * c2
        ev_r, ev_i = f[2, j] * s2, f[3, j] * s2
        f[_SUMS, j] += weight * 2 * rho * eu_r
        f[_SUMS + 1, j] += weight * (eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i)


@kernel()
def strip_scratch(pixels: Pixels) -> tuple[int, FloatArray]:
    """Rows of pixels in a strip, and its scratch."""
    together = min(max(_STRIP // pixels.x.size, 1), pixels.y.size)
    return together, np.empty((_SCRATCH, padded(together * pixels.x.size)))


@kernel()
def radial_strip(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, first: int, last: int, x_p: float,
    y_p: float, amplitude: float, count: int, f: FloatArray,
) -> FloatArray:  # fmt: skip
    """Compute rows `first` to `last` of signal and gradient (`count` 5) or of the parts (2).

    Returns the lines of `f` that hold them, with all pixels one after the other; the parts do not
    depend on the amplitude.
    """
    x, y, offsets, weights = pixels.x, pixels.y[first:last], pixels.offsets, pixels.weights
    sums = f[_SUMS : _SUMS + count]
    for k in range(count):
        for j in range(sums.shape[1]):
            sums[k, j] = 0.0
    for i in range(offsets.size):
        for j in range(offsets.size):
            _place(lens.inv_step, x, y, x_p - offsets[j], y_p - offsets[i], f)
            weight = weights[i] * weights[j]
            if count == 5:
                evaluate_slopes(profile, f)
                _add_gradient(
                    lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi, lens.co, lens.cross,
                    lens.ring, amplitude, weight, f,
                )  # fmt: skip
            else:
                evaluate(profile, f)
                _add_parts(
                    lens.rho, lens.cos_psi, lens.sin_psi, lens.co, lens.cross, lens.ring, weight, f
                )
    return sums


@kernel()
def radial_gradient(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, amplitude: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """As `iscat_analysis._kernels.image.signal_gradient`."""
    rows, columns = pixels.y.size, pixels.x.size
    together, f = strip_scratch(pixels)
    for first in range(0, rows, together):
        last = min(first + together, rows)
        sums = radial_strip(profile, lens, pixels, first, last, x_p, y_p, amplitude, 5, f)
        for row in range(first, last):
            begin = (row - first) * columns
            for k in range(5):
                here, there = sums[k, begin : begin + columns], out[row, k]
                for j in range(columns):
                    there[j] = here[j]


@kernel()
def radial_parts(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, out: FloatArray
) -> None:
    """As `iscat_analysis._kernels.image.signal_parts`."""
    rows, columns = pixels.y.size, pixels.x.size
    together, f = strip_scratch(pixels)
    for first in range(0, rows, together):
        last = min(first + together, rows)
        sums = radial_strip(profile, lens, pixels, first, last, x_p, y_p, 1.0, 2, f)
        for k in range(2):
            here, there = sums[k], out[k, first * columns : last * columns]
            for j in range(there.size):
                there[j] = here[j]


@kernel(fastmath=FAST)
def radial_signal(
    profile: FloatArray, lens: RoundLens, pixels: Pixels, x_p: float, y_p: float, amplitude: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """As `iscat_analysis._kernels.image.signal_image`."""
    rows, columns = pixels.y.size, pixels.x.size
    together, f = strip_scratch(pixels)
    for first in range(0, rows, together):
        last = min(first + together, rows)
        sums = radial_strip(profile, lens, pixels, first, last, x_p, y_p, 1.0, 2, f)
        for row in range(first, last):
            begin, there = (row - first) * columns, out[row]
            p, q = sums[0, begin : begin + columns], sums[1, begin : begin + columns]
            for j in range(columns):
                there[j] = amplitude * (p[j] + amplitude * q[j])
