"""The field of any pupil, tabulated on a square lattice around the particle.

An aberrated pupil has an azimuthal Fourier series at every polar angle, and so has its field:

    E_c(r, φ) = Σ_m e^{imφ} i^m ∫ a_{c,m}(θ) J_m(n_i k r sinθ) dθ.

`radial_waves` sums it along r, `sampled` carries it to the nodes of a lattice.  Between the nodes a
particle's image is a sum of `TAPS`² coefficients with the weights of a Kaiser–Bessel window,
written as polynomials in the distance to the node, so that value and derivatives come from the same
expression.  The field is band-limited at k·NA, and the coefficients are its samples after the
filter that undoes the window (Fessler and Sutton, IEEE Trans. Signal Process. 51, 560, 2003).

The weights factor into x and y, and pixels stand in rows and columns: first the columns of pixels
are interpolated along x for all rows of nodes, then each row of pixels along y.  Both run in vector
registers; the cost does not depend on how many harmonics the pupil has.

A *profile* on a lattice has shape (channels, nodes along x, nodes along y): real and imaginary part
of each component, followed by the same for ∂/∂z, and for ∂²/∂z² where asked.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import i0, j0, j1

from iscat_analysis._kernels import kernel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FAST = {"contract", "reassoc", "nsz", "arcp"}

LATTICE_STEP = 1.2
"""Step of the lattice times bandwidth: 4e-8 of the peak in the field, 1e-6 in its gradient."""

TAPS = 8
"""Number of nodes that contribute to a value, along each axis."""

DEGREE = 10
"""Degree of the polynomials that approximate the window between two nodes."""

_SHARPNESS = 20.0  # of the window, best for TAPS and LATTICE_STEP
FILTER = 10
"""Half length of the filter that undoes the window."""
_BLOCK = 128  # radial nodes whose Bessel functions are in memory at once


@cache
def window() -> tuple[FloatArray, FloatArray]:
    """Weights of the nodes, and the filter that undoes their smoothing.

    Shapes: `weights` (degree + 1, TAPS), `undo` (2·half + 1,).
    """
    half = TAPS / 2
    count = DEGREE + 1
    t = (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2
    powers = np.vander(t, count, increasing=True)
    x = t + half - 1 - np.arange(TAPS)[:, None]
    bell = i0(_SHARPNESS * np.sqrt(np.maximum(1 - (x / half) ** 2, 0))) / i0(_SHARPNESS)
    weights = np.linalg.solve(powers, bell.T).T
    nodes, quadrature = np.polynomial.legendre.leggauss(40)
    t, quadrature = (nodes + 1) / 2, quadrature / 2
    x = t + half - 1 - np.arange(TAPS)[:, None]
    bell = weights @ np.vander(t, count, increasing=True).T
    band = np.linspace(0, LATTICE_STEP, 400)
    smoothing = np.einsum("lt,ltw,t->w", bell, np.cos(x[..., None] * band), quadrature)
    waves = np.cos(np.outer(band, np.arange(FILTER + 1)))
    waves[:, 1:] *= 2
    undo = np.linalg.lstsq(smoothing[:, None] * waves, np.ones(band.size), rcond=1e-14)[0]
    return np.ascontiguousarray(weights.T), np.concatenate([undo[:0:-1], undo])


def lattice_half(reach_nm: float, step_nm: float) -> int:
    """Nodes on either side of the particle that images out to a distance need."""
    return math.ceil(reach_nm / step_nm) + TAPS // 2 + 1


def radial_waves(
    harmonics: ComplexArray, transverse: FloatArray, step_nm: float, intervals: int
) -> FloatArray:
    """Radial functions i^m ∫ a_m J_m of every harmonic, as quintics.

    Shapes: `harmonics` (k, 2·M + 1, n), `transverse` (n,), result (intervals, 6, M + 1, 4, k).
    """
    fields, count, _ = harmonics.shape
    largest = count // 2
    series = np.ascontiguousarray(np.moveaxis(harmonics, 0, 2))
    plus, minus = series[largest:], series[largest::-1]
    turn = (1j ** np.arange(largest + 1))[:, None, None]
    even, odd = turn * (plus + minus), 1j * turn * (plus - minus)
    even[0] = plus[0]
    columns = np.concatenate([even.real, even.imag, odd.real, odd.imag], axis=2)
    nodes = np.empty((3, intervals + 1, largest + 1, 4 * fields))
    once = transverse * step_nm
    for start in range(0, intervals + 1, _BLOCK):
        r = step_nm * np.arange(start, min(start + _BLOCK, intervals + 1))
        bessel = np.empty((largest + 5, r.size, transverse.size))  # from order −2 on
        x = np.multiply.outer(r, transverse)
        bessel_ladder(x.ravel(), bessel[2:].reshape(largest + 3, -1))
        bessel[1], bessel[0] = -bessel[3], bessel[4]
        value = bessel[2:-2]
        slope = (bessel[1:-3] - bessel[3:-1]) * (once / 2)
        bend = (bessel[:-4] - 2 * value + bessel[4:]) * (once**2 / 4)
        for order, part in enumerate((value, slope, bend)):
            found = nodes[order, start : start + r.size].transpose(1, 0, 2)
            np.matmul(part, columns, out=found)
    powers = np.empty((intervals, 6, largest + 1, 4, fields))
    _fill_quintics(nodes.reshape(3, intervals + 1, -1), powers.reshape(intervals, 6, -1))
    return powers


@kernel(fastmath=FAST)
def _fill_quintics(nodes: FloatArray, powers: FloatArray) -> None:
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


def bessel_ladder(x: FloatArray, out: FloatArray) -> None:
    """Fill `out` (orders, n) with J_0, J_1, … of x ≥ 0."""
    j0(x, out=out[0])
    j1(x, out=out[1])
    _climb(x, out)


@kernel()
def _climb(x: FloatArray, out: FloatArray) -> None:
    """Fill rows 2, 3, … of `out` from rows 0 and 1; if that is unstable, all by `_descend`."""
    orders = out.shape[0]
    for k in range(x.size):
        if x[k] < orders:
            _descend(x[k], out[:, k])
            continue
        twice = 2 / x[k]
        below, here = out[0, k], out[1, k]
        for m in range(1, orders - 1):
            below, here = here, m * twice * here - below
            out[m + 1, k] = here


@kernel()
def _descend(x: float, out: FloatArray) -> None:
    """Fill `out` (orders) with J_0, J_1, … of x ≥ 0 by Miller's downward recurrence."""
    orders = out.size
    if x < 1e-8:
        out[:] = 0.0
        out[0] = 1.0
        out[1] = x / 2
        return
    top = orders + 14 + int(3 * np.sqrt(float(orders)))
    above, here, total = 0.0, 1e-280, 0.0
    for m in range(top, 0, -1):
        if m < orders:
            out[m] = here
        if m % 2 == 0:
            total += 2 * here
        above, here = here, 2 * m / x * here - above
        if abs(here) > 1e200:
            here *= 1e-200
            above *= 1e-200
            total *= 1e-200
            for j in range(m, orders):
                out[j] *= 1e-200
    out[0] = here
    total += here
    for m in range(orders):
        out[m] /= total


@kernel(fastmath=FAST)
def _quintic(powers: FloatArray, t: float, out: FloatArray) -> None:
    """Fill `out` (n) with the polynomials of `powers` (6, n) at t.

    Three rows at a time: with more arrays that might overlap, the compiler uses no vectors.
    """
    a, b, c = powers[3], powers[4], powers[5]
    for j in range(out.size):
        out[j] = a[j] + t * (b[j] + t * c[j])
    a, b, c = powers[0], powers[1], powers[2]
    cube = t * t * t
    for j in range(out.size):
        out[j] = a[j] + t * (b[j] + t * c[j]) + cube * out[j]


@kernel(fastmath=FAST)
def _sum_azimuths(value: FloatArray, cos: float, sin: float, sums: FloatArray) -> None:
    """Fill `sums` (2, 2, 2, k): cosine and sine terms, even and odd orders, real and imaginary."""
    sums[:] = 0.0
    c, s = 1.0, 0.0
    for m in range(value.shape[0]):
        for part in range(2):
            even, odd = sums[0, m % 2, part], sums[1, m % 2, part]
            v, w = value[m, part], value[m, 2 + part]
            for k in range(even.size):
                even[k] += c * v[k]
                odd[k] += s * w[k]
        c, s = c * cos - s * sin, s * cos + c * sin


@kernel()
def sum_waves(
    waves: FloatArray, inv_step: float, dx: FloatArray, dy: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (n, 2, k) with real and imaginary part of k fields at n positions.

    Shapes: `waves` (intervals, 6, M + 1, 4, k), `dx, dy` (n,), `out` (n, 2, k).
    """
    intervals, _, count, _, fields = waves.shape
    flat = waves.reshape(intervals, 6, -1)
    value = np.empty((count, 4, fields))
    line = value.reshape(-1)
    sums = np.empty((2, 2, 2, fields))
    for j in range(dx.size):
        r = np.sqrt(dx[j] * dx[j] + dy[j] * dy[j])
        cos, sin = (dx[j] / r, dy[j] / r) if r > 0 else (1.0, 0.0)
        place = r * inv_step
        out[j] = 0.0
        if place < intervals:
            i = int(place)
            _quintic(flat[i], place - i, line)
            _sum_azimuths(value, cos, sin, sums)
            out[j] = sums[0, 0] + sums[0, 1] + sums[1, 0] + sums[1, 1]


@kernel()
def _sample(waves: FloatArray, inv_step: float, step: float, out: FloatArray) -> None:
    """Fill `out` (k, 2, side, side) with the fields at the nodes, eight mirror images at a time."""
    intervals, _, count, _, fields = waves.shape
    flat = waves.reshape(intervals, 6, -1)
    value = np.empty((count, 4, fields))
    line = value.reshape(-1)
    sums = np.empty((2, 2, 2, fields))
    half = out.shape[2] // 2
    out[:] = 0.0
    for far in range(half + 1):
        for near in range(far + 1):
            r = step * np.sqrt(float(far * far + near * near))
            place = r * inv_step
            if not place < intervals:
                continue
            i = int(place)
            _quintic(flat[i], place - i, line)
            for ix, iy in ((far, near), (near, far)):
                cos, sin = (ix * step / r, iy * step / r) if r > 0 else (1.0, 0.0)
                _sum_azimuths(value, cos, sin, sums)
                right, left, low, high = half + ix, half - ix, half - iy, half + iy
                for k in range(fields):
                    for part in range(2):
                        ce, co = sums[0, 0, part, k], sums[0, 1, part, k]
                        se, so = sums[1, 0, part, k], sums[1, 1, part, k]
                        out[k, part, right, high] = ce + co + se + so
                        out[k, part, left, high] = ce - co - se + so
                        out[k, part, right, low] = ce + co - se - so
                        out[k, part, left, low] = ce - co + se - so


def sampled(waves: FloatArray, radial_step_nm: float, step_nm: float, half: int) -> FloatArray:
    """Values of k fields at the nodes of a lattice, and beyond it as far as the filter needs them.

    Shapes: `waves` (intervals, 6, M + 1, 4, k), result (k, 2, side, side), along x and along y.
    """
    side = 2 * (half + FILTER) + 1
    fields = np.empty((waves.shape[4], 2, side, side))
    _sample(waves, 1 / radial_step_nm, step_nm, fields)
    return fields


def undo_window(samples: FloatArray) -> FloatArray:
    """Turn samples of fields into coefficients.

    Shapes: `samples` (k, n, n), result (k, n − 2·FILTER, n − 2·FILTER).
    """
    side = samples.shape[1] - 2 * FILTER
    out = np.empty((len(samples), side, side))
    _filter(samples, window()[1][FILTER:], out)
    return out


@kernel(fastmath=FAST)
def _filter(samples: FloatArray, undo: FloatArray, out: FloatArray) -> None:
    """Fill `out` with `samples`, filtered along both axes by a symmetric filter."""
    half, side = undo.size - 1, out.shape[1]
    line = np.empty(side + 2 * half)
    for k in range(len(out)):
        for i in range(side):
            middle = samples[k, half + i]
            for j in range(line.size):
                line[j] = undo[0] * middle[j]
            for t in range(1, half + 1):
                low, high, weight = samples[k, half + i - t], samples[k, half + i + t], undo[t]
                for j in range(line.size):
                    line[j] += weight * (low[j] + high[j])
            row = out[k, i]
            for j in range(side):
                row[j] = undo[0] * line[half + j]
            for t in range(1, half + 1):
                low, high, weight = line[half - t :], line[half + t :], undo[t]
                for j in range(side):
                    row[j] += weight * (low[j] + high[j])


def reach_of_samples(reach_nm: float, step_nm: float) -> float:
    """Distance of the farthest sample that an image out to a distance needs [nm]."""
    return reach_nm + math.sqrt(2) * (TAPS / 2 + 1 + FILTER) * step_nm
