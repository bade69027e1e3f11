"""The field of any pupil, tabulated on a square lattice around the particle, and its images.

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

The work space of a row of pixels is an array (rows, nx): `FIELDS` rows hold the fields of the
current row and their slopes, the others the fields at the columns of pixels and the rows of nodes,
which `interpolate_columns` computes once for each image.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy.special import i0, j0, j1

from iscat_analysis._kernels import FAST, AnyFloatArray, ComplexArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.lens import LatticeLens, Pixels
from iscat_analysis._kernels.loops import mix, mix_both, within
from iscat_analysis._kernels.radial import fill_quintics

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
    fill_quintics(nodes.reshape(3, intervals + 1, -1), powers.reshape(intervals, 6, -1))
    return powers


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


MOST = 10
"""Real and imaginary parts of the most components of a field: see `LatticeLens`."""

FIELDS = 4 * MOST
"""Rows for a row of pixels: the fields, their ∂/∂z, slopes along x and slopes along y."""

STRIP = 8
"""Columns of pixels that are interpolated together: one cache line."""

BEFORE = TAPS // 2 - 1
"""Number of nodes before the one at the floor of a position."""

BENT = 10
"""Numbers for each part of a field: e and its derivatives x, y, z, xx, xy, yy, xz, yz, zz."""


@kernel(fastmath=FAST)
def taps(weights: FloatArray, t: float, per_nm: float, out: AnyFloatArray) -> None:
    """Fill the weights of the nodes at distance t ∈ [0, 1) and their derivatives.

    Shapes: `out` (1, 2 or 3 orders, TAPS).
    """
    for k in range(TAPS):
        v, d, s = weights[DEGREE, k], 0.0, 0.0
        for p in range(DEGREE):
            s = s * t + d
            d = d * t + v
            v = v * t + weights[DEGREE - 1 - p, k]
        out[0, k] = v
        if len(out) > 1:
            out[1, k] = d * per_nm
        if len(out) > 2:
            out[2, k] = 2 * s * per_nm * per_nm


@kernel()
def _ends(values: FloatArray) -> tuple[float, float]:
    """Smallest and largest value; the methods of arrays take Numba 30 ms to load."""
    low = high = values[0]
    for value in values:
        low, high = min(low, value), max(high, value)
    return low, high


@kernel(_nrt=False)
def _node(lens: LatticeLens, away: float) -> float:
    """Position on the lattice at a distance from the particle [nodes], inside by all its taps."""
    last = 2 * lens.half + 1 - TAPS + BEFORE
    place: float = within(away * lens.inv_step + lens.half, float(BEFORE), float(last))
    return place


@kernel()
def nodes_needed(
    lens: LatticeLens, pixels: Pixels, axis: FloatArray, place: float
) -> tuple[int, int]:
    """First node along an axis of pixels that an image needs, and how many."""
    margin = abs(pixels.offsets[-1])
    low, high = _ends(axis)
    first = int(_node(lens, low - margin - place)) - BEFORE
    last = int(_node(lens, high + margin - place)) - BEFORE
    return first, last + TAPS - first


@kernel(fastmath=FAST, _nrt=False)
def _blend(nodes: FloatArray, row: int, first: int, w: FloatArray, out: FloatArray) -> None:
    """Fill `out` (n) with the combination w of TAPS rows of `nodes`, from a column on."""
    for k in range(0, TAPS, 4):
        a, b = nodes[row + k, first:], nodes[row + k + 1, first:]
        c, d = nodes[row + k + 2, first:], nodes[row + k + 3, first:]
        mix(a, b, c, d, w, k, out)


@kernel(fastmath=FAST, _nrt=False)
def _blend_both(
    nodes: FloatArray, row: int, w: FloatArray, out: FloatArray, other: FloatArray
) -> None:
    """Fill `out` and `other` with two combinations w (2, TAPS) of the same rows."""
    for k in range(0, TAPS, 4):
        a, b, c, d = nodes[row + k], nodes[row + k + 1], nodes[row + k + 2], nodes[row + k + 3]
        mix_both(a, b, c, d, w, k, out, other)


@kernel()
def _locate(lens: LatticeLens, away: float, w: FloatArray) -> int:
    """Fill the weights of the nodes at a distance from the particle; give the first of them."""
    place = _node(lens, away)
    taps(lens.window, place - int(place), lens.inv_step, w)
    return int(place) - BEFORE


@kernel(fastmath=FAST)
def _columns(
    plane: FloatArray, left: IntArray, weights: FloatArray, first: int, strip: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Interpolate one channel along x, `STRIP` columns of pixels at a time.

    The strip is transposed into rows of `out` (rows, nx) at once, so that each cache line is
    written once.
    """
    rows, columns = out.shape
    for start in range(0, columns, STRIP):
        count = min(STRIP, columns - start)
        for j in range(count):
            _blend(plane, left[start + j], first, weights[start + j], strip[j])
        for r in range(rows):
            for j in range(count):
                out[r, start + j] = strip[j, r]


@kernel()
def interpolate_columns(
    profile: FloatArray, lens: LatticeLens, pixels: Pixels, theta: FloatArray, values: int,
    slopes: int,
) -> FloatArray:  # fmt: skip
    """Interpolate the first channels along x, and slopes of the first ones along it.

    Shapes: result (rows, nx): after `FIELDS` rows, for each sample along x, each channel at each
    row of nodes.
    """
    first, rows = nodes_needed(lens, pixels, pixels.y, theta[1])
    columns, samples, here = pixels.x.size, pixels.offsets.size, FIELDS
    f = np.empty((FIELDS + samples * (values + slopes) * rows, columns))
    w, left = np.empty((2, columns, TAPS)), np.empty(columns, dtype=np.int64)
    strip = np.empty((STRIP, rows))
    for sample in range(samples):
        for j in range(columns):
            left[j] = _locate(lens, pixels.x[j] + pixels.offsets[sample] - theta[0], w[:, j])
        for k in range(values + slopes):
            channel, order = (k, 0) if k < values else (k - values, 1)
            _columns(profile[channel], left, w[order], first, strip, f[here : here + rows])
            here += rows
    return f


@kernel(fastmath=FAST)
def _add_gradient(
    rho: float, amplitude: float, weight: float, f: FloatArray, part: int, out: FloatArray
) -> None:
    """Add one component's share of signal and gradient to `out` (5, nx)."""
    a = amplitude
    e_r, e_i = f[part], f[part + 1]
    z_r, z_i = f[MOST + part], f[MOST + 1 + part]
    x_r, x_i = f[2 * MOST + part], f[2 * MOST + 1 + part]
    y_r, y_i = f[3 * MOST + part], f[3 * MOST + 1 + part]
    for j in range(e_r.size):
        g_r, g_i = 2 * weight * a * (rho + a * e_r[j]), 2 * weight * a * a * e_i[j]
        out[1, j] -= g_r * x_r[j] + g_i * x_i[j]
        out[2, j] -= g_r * y_r[j] + g_i * y_i[j]
    for j in range(e_r.size):
        g_r, g_i = 2 * weight * a * (rho + a * e_r[j]), 2 * weight * a * a * e_i[j]
        power = e_r[j] * e_r[j] + e_i[j] * e_i[j]
        out[3, j] += g_r * z_r[j] + g_i * z_i[j]
        out[0, j] += weight * a * (2 * rho * e_r[j] + a * power)
        out[4, j] += weight * (2 * rho * e_r[j] + 2 * a * power)


@kernel(fastmath=FAST)
def _add_signal(
    rho: float, a: float, weight: float, e_r: FloatArray, e_i: FloatArray, out: FloatArray
) -> None:
    """Add one component's share of the signal to `out` (nx)."""
    for j in range(out.size):
        out[j] += weight * a * (2 * rho * e_r[j] + a * (e_r[j] * e_r[j] + e_i[j] * e_i[j]))


@kernel(forceinline=True)
def lattice_row(
    lens: LatticeLens, pixels: Pixels, row: int, theta: FloatArray, f: FloatArray, out: FloatArray
) -> None:
    """Fill `out` with signal and gradient (5, nx) of one row, or its signal alone (1, nx)."""
    first, rows = nodes_needed(lens, pixels, pixels.y, theta[1])
    gradient, w = len(out) > 1, np.empty((2, TAPS))
    width, q = 2 * lens.components, pixels.offsets.size
    apart = width * rows
    out[:] = 0.0
    for i in range(q):
        top = _locate(lens, pixels.y[row] + pixels.offsets[i] - theta[1], w) - first
        for sample in range(q):
            start = FIELDS + sample * (3 if gradient else 1) * apart + top
            for k in range(width):
                here = start + k * rows
                if not gradient:
                    _blend(f, here, 0, w[0], f[k])
                    continue
                _blend_both(f, here, w, f[k], f[3 * MOST + k])
                _blend(f, here + apart, 0, w[0], f[MOST + k])
                _blend(f, here + 2 * apart, 0, w[0], f[2 * MOST + k])
            weight = pixels.weights[i] * pixels.weights[sample]
            for c in range(lens.components):
                rho = lens.rho if c == 0 else 0.0
                if gradient:
                    _add_gradient(rho, theta[3], weight, f, 2 * c, out)
                else:
                    _add_signal(rho, theta[3], weight, f[2 * c], f[2 * c + 1], out[0])


@kernel(fastmath=FAST)
def _add_product(
    rho: float, weight: float, f: FloatArray, field: int, change: int, out: FloatArray
) -> None:
    """Add weight × Re (ρ + e)* d to `out`; e and d are pairs of rows of f."""
    e_r, e_i, d_r, d_i = f[field], f[field + 1], f[change], f[change + 1]
    for j in range(out.size):
        out[j] += weight * ((rho + e_r[j]) * d_r[j] + e_i[j] * d_i[j])


@kernel()
def lattice_values(
    stack: FloatArray, lens: LatticeLens, pixels: Pixels, theta: FloatArray, components: int,
    out: FloatArray,
) -> None:  # fmt: skip
    """Signal of a field and its derivatives along changes of that field.

    Shapes: `stack` (k·components·2, nodes, nodes), `out` (k, ny, nx).
    """
    first, rows = nodes_needed(lens, pixels, pixels.y, theta[1])
    columns, channels, a = pixels.x.size, stack.shape[0], theta[3]
    across = interpolate_columns(stack, lens, pixels, theta, channels, 0)
    w, f = np.empty((1, TAPS)), np.empty((channels, columns))
    out[:] = 0.0
    for row in range(pixels.y.size):
        for i in range(pixels.offsets.size):
            top = _locate(lens, pixels.y[row] + pixels.offsets[i] - theta[1], w) - first
            for sample in range(pixels.offsets.size):
                for k in range(channels):
                    start = FIELDS + (sample * channels + k) * rows + top
                    _blend(across, start, 0, w[0], f[k])
                weight = pixels.weights[i] * pixels.weights[sample]
                for c in range(components):
                    rho = lens.rho if c == 0 else 0.0
                    _add_signal(rho, a, weight, f[2 * c], f[2 * c + 1], out[0, row])
                    for j in range(columns):
                        f[2 * c, j] *= a
                        f[2 * c + 1, j] *= a
                    for k in range(1, out.shape[0]):
                        change = 2 * (k * components + c)
                        _add_product(rho, 2 * a * weight, f, 2 * c, change, out[k, row])


@kernel()
def lattice_waves(
    profile: FloatArray, lens: LatticeLens, component: int, dx: FloatArray, dy: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` (2 BENT or more, n) with a component of the field at n points, see `BENT`."""
    wx, wy, width = np.empty((3, TAPS)), np.empty((3, TAPS)), 2 * lens.components
    for point in range(dx.size):
        px, py = _node(lens, dx[point]), _node(lens, dy[point])
        taps(lens.window, px - int(px), lens.inv_step, wx)
        taps(lens.window, py - int(py), lens.inv_step, wy)
        left, top = int(px) - BEFORE, int(py) - BEFORE
        for part in range(2):
            e, here = out[BENT * part : BENT * (part + 1), point], 2 * component + part
            e[:] = 0.0
            for k in range(TAPS):
                value, along_z = profile[here, left + k], profile[width + here, left + k]
                bent = profile[2 * width + here, left + k]
                v = v_y = v_yy = z = z_y = zz = 0.0
                for m in range(TAPS):
                    v += wy[0, m] * value[top + m]
                    v_y += wy[1, m] * value[top + m]
                    v_yy += wy[2, m] * value[top + m]
                    z += wy[0, m] * along_z[top + m]
                    z_y += wy[1, m] * along_z[top + m]
                    zz += wy[0, m] * bent[top + m]
                e[0] += wx[0, k] * v
                e[1] += wx[1, k] * v
                e[2] += wx[0, k] * v_y
                e[3] += wx[0, k] * z
                e[4] += wx[2, k] * v
                e[5] += wx[1, k] * v_y
                e[6] += wx[0, k] * v_yy
                e[7] += wx[1, k] * z
                e[8] += wx[0, k] * z_y
                e[9] += wx[0, k] * zz
