"""Rows of pixels of a particle whose field is tabulated on a lattice; see `lattice`.

The work space of a row is an array (rows, nx): `FIELDS` rows hold the fields of the current row and
their slopes, the others the fields at the columns of pixels and the rows of nodes, which
`interpolate_columns` computes once for each image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import DEGREE, FAST, TAPS
from iscat_analysis._kernels.mixing import mix, mix_both
from iscat_analysis._kernels.whole import within

if TYPE_CHECKING:
    from iscat_analysis._kernels.image import Pixels
    from iscat_analysis._kernels.lens import LatticeLens

FloatArray = NDArray[np.float64]

MOST = 10
"""Real and imaginary parts of the most components of a field: see `LatticeLens`."""

FIELDS = 4 * MOST
"""Rows for a row of pixels: the fields, their ∂/∂z, slopes along x and slopes along y."""

STRIP = 8
"""Columns of pixels that are interpolated together: one cache line."""

BEFORE = TAPS // 2 - 1
"""Number of nodes before the one at the floor of a position."""


@kernel(fastmath=FAST)
def taps(weights: FloatArray, t: float, value: FloatArray, slope: FloatArray) -> None:
    """Fill the weights of the nodes at distance t ∈ [0, 1) and their derivative."""
    for k in range(TAPS):
        v, d = weights[DEGREE, k], 0.0
        for p in range(DEGREE):
            d = d * t + v
            v = v * t + weights[DEGREE - 1 - p, k]
        value[k] = v
        slope[k] = d


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
def node_rows(lens: LatticeLens, pixels: Pixels, y_p: float) -> tuple[int, int]:
    """First row of nodes that an image needs, and how many."""
    margin = abs(pixels.offsets[-1])
    low, high = _ends(pixels.y)
    first = int(_node(lens, low - margin - y_p)) - BEFORE
    last = int(_node(lens, high + margin - y_p)) - BEFORE
    return first, last + TAPS - first


@kernel()
def rows_needed(lens: LatticeLens, pixels: Pixels) -> int:
    """Rows of work space that an image needs, wherever the particle is."""
    low, high = _ends(pixels.y)
    span = high - low + 2 * abs(pixels.offsets[-1])
    rows = int(span * lens.inv_step) + TAPS + 2
    return FIELDS + pixels.offsets.size * 6 * lens.components * rows


@kernel(fastmath=FAST, _nrt=False)
def _blend(nodes: FloatArray, row: int, first: int, w: FloatArray, out: FloatArray) -> None:
    """Fill `out` (n) with the combination w of TAPS rows of `nodes`, n columns from the first."""
    last = first + out.size
    for k in range(0, TAPS, 4):
        a, b = nodes[row + k, first:last], nodes[row + k + 1, first:last]
        c, d = nodes[row + k + 2, first:last], nodes[row + k + 3, first:last]
        mix(a, b, c, d, w, k, out)


@kernel(fastmath=FAST, _nrt=False)
def _blend_both(
    nodes: FloatArray,
    row: int,
    first: int,
    w: FloatArray,
    v: FloatArray,
    out: FloatArray,
    other: FloatArray,
) -> None:
    """Fill `out` and `other` with two combinations of the same rows; see `_blend`."""
    last = first + out.size
    for k in range(0, TAPS, 4):
        a, b = nodes[row + k, first:last], nodes[row + k + 1, first:last]
        c, d = nodes[row + k + 2, first:last], nodes[row + k + 3, first:last]
        mix_both(a, b, c, d, w, v, k, out, other)


@kernel(fastmath=FAST)
def _columns(
    plane: FloatArray,
    left: NDArray[np.int64],
    weights: FloatArray,
    first: int,
    strip: FloatArray,
    out: FloatArray,
) -> None:
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
    profile: FloatArray,
    lens: LatticeLens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    with_gradient: bool,
    f: FloatArray,
) -> None:
    """Interpolate along x: fields and slopes at every column of pixels and row of nodes."""
    first, rows = node_rows(lens, pixels, y_p)
    columns = pixels.x.size
    value, slope = np.empty((columns, TAPS)), np.empty((columns, TAPS))
    left = np.empty(columns, dtype=np.int64)
    strip = np.empty((STRIP, rows))
    width = 2 * lens.components
    here = FIELDS
    for sample in range(pixels.offsets.size):
        for j in range(columns):
            place = _node(lens, pixels.x[j] + pixels.offsets[sample] - x_p)
            left[j] = int(place) - BEFORE
            taps(lens.window, place - int(place), value[j], slope[j])
        slope *= lens.inv_step
        for k in range(2 * width if with_gradient else width):
            _columns(profile[k], left, value, first, strip, f[here : here + rows])
            here += rows
        if with_gradient:
            for k in range(width):
                _columns(profile[k], left, slope, first, strip, f[here : here + rows])
                here += rows


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


@kernel(forceinline=True)
def lattice_gradient(
    lens: LatticeLens,
    pixels: Pixels,
    row: int,
    y_p: float,
    amplitude: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (5, nx) with signal and gradient of one row, averaged over the samples."""
    first, rows = node_rows(lens, pixels, y_p)
    value, slope = np.empty(TAPS), np.empty(TAPS)
    width = 2 * lens.components
    q = pixels.offsets.size
    out[:] = 0.0
    for i in range(q):
        place = _node(lens, pixels.y[row] + pixels.offsets[i] - y_p)
        top = int(place) - BEFORE - first
        taps(lens.window, place - int(place), value, slope)
        for k in range(TAPS):
            slope[k] *= lens.inv_step
        for sample in range(q):
            start = FIELDS + sample * 3 * width * rows + top
            for k in range(width):
                here = start + k * rows
                _blend_both(f, here, 0, value, slope, f[k], f[3 * MOST + k])
                here += width * rows
                _blend(f, here, 0, value, f[MOST + k])
                here += width * rows
                _blend(f, here, 0, value, f[2 * MOST + k])
            weight = pixels.weights[i] * pixels.weights[sample]
            _add_gradient(lens.rho, amplitude, weight, f, 0, out)
            for c in range(1, lens.components):
                _add_gradient(0.0, amplitude, weight, f, 2 * c, out)


@kernel(fastmath=FAST)
def _add_signal(
    rho: float, a: float, weight: float, e_r: FloatArray, e_i: FloatArray, out: FloatArray
) -> None:
    """Add one component's share of the signal to `out` (nx)."""
    for j in range(out.size):
        out[j] += weight * a * (2 * rho * e_r[j] + a * (e_r[j] * e_r[j] + e_i[j] * e_i[j]))


@kernel(forceinline=True)
def lattice_signal(
    lens: LatticeLens,
    pixels: Pixels,
    row: int,
    y_p: float,
    amplitude: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (nx) with the signal of one row, averaged over the samples in each pixel."""
    first, rows = node_rows(lens, pixels, y_p)
    value, slope = np.empty(TAPS), np.empty(TAPS)
    width = 2 * lens.components
    q = pixels.offsets.size
    out[:] = 0.0
    for i in range(q):
        place = _node(lens, pixels.y[row] + pixels.offsets[i] - y_p)
        top = int(place) - BEFORE - first
        taps(lens.window, place - int(place), value, slope)
        for sample in range(q):
            start = FIELDS + sample * width * rows + top
            for k in range(width):
                here = start + k * rows
                _blend(f, here, 0, value, f[k])
            weight = pixels.weights[i] * pixels.weights[sample]
            _add_signal(lens.rho, amplitude, weight, f[0], f[1], out)
            for c in range(1, lens.components):
                _add_signal(0.0, amplitude, weight, f[2 * c], f[2 * c + 1], out)


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
    stack: FloatArray,
    lens: LatticeLens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    amplitude: float,
    components: int,
    out: FloatArray,
) -> None:
    """Signal of a field and its derivatives along changes of that field.

    Shapes: `stack` (k·components·2, nodes, nodes), `out` (k, ny, nx).
    """
    first, rows = node_rows(lens, pixels, y_p)
    columns = pixels.x.size
    value, slope = np.empty((columns, TAPS)), np.empty((columns, TAPS))
    left = np.empty(columns, dtype=np.int64)
    strip = np.empty((STRIP, rows))
    channels, a = stack.shape[0], amplitude
    across = np.empty((channels, rows, pixels.x.size))
    f = np.empty((channels, pixels.x.size))
    out[:] = 0.0
    for sample in range(pixels.offsets.size):
        for j in range(columns):
            place = _node(lens, pixels.x[j] + pixels.offsets[sample] - x_p)
            left[j] = int(place) - BEFORE
            taps(lens.window, place - int(place), value[j], slope[j])
        for k in range(channels):
            _columns(stack[k], left, value, first, strip, across[k])
        for row in range(pixels.y.size):
            for i in range(pixels.offsets.size):
                place = _node(lens, pixels.y[row] + pixels.offsets[i] - y_p)
                top = int(place) - BEFORE - first
                taps(lens.window, place - int(place), value[0], slope[0])
                for k in range(channels):
                    _blend(across[k], top, 0, value[0], f[k])
                weight = pixels.weights[i] * pixels.weights[sample]
                for c in range(components):
                    rho = lens.rho if c == 0 else 0.0
                    _add_signal(rho, a, weight, f[2 * c], f[2 * c + 1], out[0, row])
                    for j in range(f.shape[1]):
                        f[2 * c, j] *= a
                        f[2 * c + 1, j] *= a
                    for k in range(1, out.shape[0]):
                        change = 2 * (k * components + c)
                        _add_product(rho, 2 * a * weight, f, 2 * c, change, out[k, row])


@kernel()
def lattice_span(lens: LatticeLens, x: FloatArray, margin: float, x_p: float) -> tuple[int, int]:
    """Range of the flattened lattice that an image needs."""
    side = 2 * lens.half + 1
    low, high = _ends(x)
    first = int(_node(lens, low - margin - x_p)) - BEFORE
    last = int(_node(lens, high + margin - x_p)) - BEFORE + TAPS
    return first * side, last * side


@kernel()
def lattice_fields(
    profile: FloatArray,
    lens: LatticeLens,
    dx: float,
    dy: float,
    e: NDArray[np.complex128],
    de: NDArray[np.complex128],
    dde: NDArray[np.complex128],
) -> None:
    """Fill the fields at one point, their first derivatives and their second in (x, y, z)."""
    h = lens.inv_step
    px, py = _node(lens, dx), _node(lens, dy)
    i, j = int(px), int(py)
    wx, wy = np.zeros((3, TAPS)), np.zeros((3, TAPS))
    _bent_taps(lens.window, px - i, h, wx)
    _bent_taps(lens.window, py - j, h, wy)
    i -= BEFORE
    j -= BEFORE
    width = 2 * lens.components
    e[:], de[:], dde[:] = 0j, 0j, 0j
    for c in range(lens.components):
        for k in range(TAPS):
            for m in range(TAPS):
                here = profile[2 * c :, i + k, j + m]
                v = here[0] + 1j * here[1]
                z = here[width] + 1j * here[width + 1]
                zz = here[2 * width] + 1j * here[2 * width + 1]
                plain, along_x, along_y = (
                    wx[0, k] * wy[0, m],
                    wx[1, k] * wy[0, m],
                    wx[0, k] * wy[1, m],
                )
                e[c] += plain * v
                de[0, c] += along_x * v
                de[1, c] += along_y * v
                de[2, c] += plain * z
                dde[0, 0, c] += wx[2, k] * wy[0, m] * v
                dde[0, 1, c] += wx[1, k] * wy[1, m] * v
                dde[1, 1, c] += wx[0, k] * wy[2, m] * v
                dde[0, 2, c] += along_x * z
                dde[1, 2, c] += along_y * z
                dde[2, 2, c] += plain * zz
        dde[1, 0, c], dde[2, 0, c], dde[2, 1, c] = dde[0, 1, c], dde[0, 2, c], dde[1, 2, c]


@kernel()
def _bent_taps(weights: FloatArray, t: float, h: float, out: FloatArray) -> None:
    """Fill the weights (3, TAPS) of the nodes for value, slope and second derivative."""
    for k in range(TAPS):
        v, d, s = 0.0, 0.0, 0.0
        for p in range(DEGREE, -1, -1):
            s = s * t + 2 * d
            d = d * t + v
            v = v * t + weights[p, k]
        out[0, k], out[1, k], out[2, k] = v, d * h, s * h * h
