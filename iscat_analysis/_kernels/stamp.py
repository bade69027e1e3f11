"""The image of a particle at one height, interpolated between samples.

At one height the signal is a P(x, y) + a² Q(x, y), both averaged over a pixel and band-limited,
P at k·NA and Q at twice that.  With `fine` samples of P and Q per pixel, an image needs no pupil,
no fields and no samples inside the pixels.  The samples lie on the grid of the pixels, so that all
pixels of an image have the same `TAPS`² weights, those of `iscat_analysis.optics.stamp`.  They are
applied along y first and then along x.

A *profile* has shape (2, nodes along y, nodes along x): P and Q.  The nodes along x are ordered by
their position in a pixel: first the first node of every pixel, then the second, and so on.  The
nodes that one weight multiplies are then next to each other in memory.

All numbers have the precision of the profile.  Single precision takes half of the time; its error
is 1e-7 of the signal, while that of the weights is 4e-6.

`STRIP` rows of pixels are computed at once.  Their nodes are copied into lines of one length, so
that the nodes that one weight multiplies are contiguous for all of these pixels: every loop is then
long, uses vector registers, and reads from the first cache.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import FAST, TAPS
from iscat_analysis._kernels.lattice_rows import BEFORE, taps
from iscat_analysis._kernels.mixing import mix, mix_both
from iscat_analysis._kernels.whole import within

if TYPE_CHECKING:
    from iscat_analysis._kernels.image import Pixels
    from iscat_analysis._kernels.lens import StampLens

FloatArray = NDArray[np.float64]
AnyFloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.int64]

STRIP = 16
"""Rows of pixels that are computed at once."""

_WEIGHTS = 4 * TAPS + 3  # weights along x and y, their slopes, the first nodes, the amplitude


@kernel()
def sizes(lens: StampLens, columns: int) -> tuple[int, int, int, int]:
    """Length of a line, of a block of nodes, of their combinations, and of a strip's pixels."""
    more = (TAPS + lens.fine - 2) // lens.fine
    line = columns + more
    return line, (STRIP + more) * line, STRIP * line + more, STRIP * line


@kernel(_nrt=False)
def first_nodes(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, x_p: float, y_p: float
) -> tuple[float, float]:
    """Position of the first pixel on the nodes [nodes]; the nodes of all pixels exist."""
    room = TAPS - BEFORE
    last_x = profile.shape[2] - room - lens.fine * (pixels.x.size - 1)
    last_y = profile.shape[1] - room - lens.fine * (pixels.y.size - 1)
    x = (pixels.x[0] - x_p) * lens.inv_step + lens.half
    y = (pixels.y[0] - y_p) * lens.inv_step + lens.half
    least = float(BEFORE)
    return within(x, least, float(last_x)), within(y, least, float(last_y))


@kernel()
def begin_stamp(
    profile: AnyFloatArray,
    lens: StampLens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    amplitude: float,
) -> AnyFloatArray:
    """Work space of an image, the weights of all of its pixels at the beginning."""
    _, block, made, strip = sizes(lens, pixels.x.size)
    w = np.empty(_WEIGHTS + lens.fine * (2 * block + 3 * made) + 4 * strip, profile.dtype)
    x, y = first_nodes(profile, lens, pixels, x_p, y_p)
    i, j = int(x), int(y)
    taps(lens.window, x - i, w[:TAPS], w[TAPS : 2 * TAPS])
    taps(lens.window, y - j, w[2 * TAPS : 3 * TAPS], w[3 * TAPS : 4 * TAPS])
    for k in range(TAPS):
        w[TAPS + k] *= lens.inv_step
        w[3 * TAPS + k] *= lens.inv_step
    w[4 * TAPS], w[4 * TAPS + 1], w[4 * TAPS + 2] = i - BEFORE, j - BEFORE, amplitude
    return w


@kernel(fastmath=FAST, _nrt=False)
def copy_nodes(
    profile: AnyFloatArray, row: int, step: int, first: int, last: int, line: int,
    a: np.floating[Any], signal: AnyFloatArray, slope: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill lines of `signal` with P + a Q, of `slope` with P + 2a Q, from every `step`-th row.

    An empty `slope` is not filled.  Numba counts no references here and below (`_nrt`), since no
    array is allocated or returned: counting took as long as a line of twenty nodes.
    """
    for m in range(signal.size // line):
        p, q = profile[0, row + step * m, first:last], profile[1, row + step * m, first:last]
        s = signal[m * line : (m + 1) * line]
        if slope.size:
            d = slope[m * line : (m + 1) * line]
            for j in range(p.size):
                once = a * q[j]
                s[j] = p[j] + once
                d[j] = p[j] + once + once
        else:
            for j in range(p.size):
                s[j] = p[j] + a * q[j]


@kernel(fastmath=FAST, _nrt=False)
def mix_nodes(nodes: AnyFloatArray, at: IntArray, w: AnyFloatArray, out: AnyFloatArray) -> None:
    """Fill `out` with the combination w of the lines that begin at TAPS places of `nodes`."""
    n = out.size
    for k in range(0, TAPS, 4):
        a, b = nodes[at[k] : at[k] + n], nodes[at[k + 1] : at[k + 1] + n]
        c, d = nodes[at[k + 2] : at[k + 2] + n], nodes[at[k + 3] : at[k + 3] + n]
        mix(a, b, c, d, w, k, out)


@kernel(fastmath=FAST, _nrt=False)
def mix_nodes_both(
    nodes: AnyFloatArray, at: IntArray, w: AnyFloatArray, v: AnyFloatArray,
    out: AnyFloatArray, other: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill `out` and `other` with two combinations of the same nodes; see `mix_nodes`."""
    n = out.size
    for k in range(0, TAPS, 4):
        a, b = nodes[at[k] : at[k] + n], nodes[at[k + 1] : at[k + 1] + n]
        c, d = nodes[at[k + 2] : at[k + 2] + n], nodes[at[k + 3] : at[k + 3] + n]
        mix_both(a, b, c, d, w, v, k, out, other)


@kernel(_nrt=False)
def _make_strip(
    profile: AnyFloatArray, lens: StampLens, row: int, rows: int, columns: int,
    images: int, at: IntArray, w: AnyFloatArray,
) -> int:  # fmt: skip
    """Compute a strip: P + a Q of its pixels, and for 4 images also ∂/∂x, ∂/∂y and P + 2a Q.

    `at` (TAPS) is work space too.  Returns where the strip begins in the other work space; each of
    its images is `STRIP` lines long.
    """
    fine = lens.fine
    line, block, made, strip = sizes(lens, columns)
    wx, vx, wy, vy = w[:TAPS], w[TAPS : 2 * TAPS], w[2 * TAPS : 3 * TAPS], w[3 * TAPS : 4 * TAPS]
    left, top, a = int(w[4 * TAPS]), int(w[4 * TAPS + 1]) + fine * row, w[4 * TAPS + 2]
    per_phase = profile.shape[2] // fine
    nodes = w[_WEIGHTS : _WEIGHTS + 2 * fine * block]
    sums = w[_WEIGHTS + 2 * fine * block :]
    for k in range(TAPS):
        at[k] = k % fine * block + k // fine * line
    more, used = line - columns, rows * line
    kept, gradient = fine * block, images > 1
    first, size = left // fine, fine * made
    last = min(first + line, per_phase)
    for phase in range(fine):
        for k in range(fine):
            start = k * block
            stop = start + (rows + (TAPS - 1 - k) // fine) * line
            end = kept + stop if gradient else kept + start
            copy_nodes(
                profile, top + k, fine, phase * per_phase + first, phase * per_phase + last, line,
                a, nodes[start:stop], nodes[kept + start : end],
            )  # fmt: skip
        start = phase * made
        here = sums[start : start + used]
        if not gradient:
            mix_nodes(nodes[:kept], at, wy, here)
            continue
        mix_nodes_both(nodes[:kept], at, wy, vy, here, sums[start + size : start + size + used])
        mix_nodes(nodes[kept:], at, wy, sums[start + 2 * size : start + 2 * size + used])
    phase = left % fine
    for k in range(TAPS):
        at[k] = (phase + k) % fine * made + (phase + k) // fine
    out: int = _WEIGHTS + 2 * fine * block + 3 * fine * made
    used -= more
    if not gradient:
        mix_nodes(sums, at, wx, w[out : out + used])
        return out
    mix_nodes_both(sums, at, wx, vx, w[out : out + used], w[out + strip : out + strip + used])
    mix_nodes(sums[size:], at, wx, w[out + 2 * strip : out + 2 * strip + used])
    mix_nodes(sums[2 * size :], at, wx, w[out + 3 * strip : out + 3 * strip + used])
    return out


@kernel()
def stamp_gradient(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, x_p: float, y_p: float,
    amplitude: float, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill `out` (ny, 5, nx) with signal and gradient of an image; ∂s/∂z is 0."""
    f = begin_stamp(profile, lens, pixels, x_p, y_p, amplitude)
    _fill_gradient(profile, lens, amplitude, np.empty(TAPS, dtype=np.int64), f, out)


@kernel(fastmath=FAST, _nrt=False)
def _fill_gradient(
    profile: AnyFloatArray, lens: StampLens, amplitude: float, at: IntArray, f: AnyFloatArray,
    out: AnyFloatArray,
) -> None:  # fmt: skip
    rows, n = out.shape[0], out.shape[2]
    line, _, _, strip = sizes(lens, n)
    for row in range(rows):
        if row % STRIP == 0:
            begin = _make_strip(profile, lens, row, min(STRIP, rows - row), n, np.int64(4), at, f)
        here = out[row]
        for k in range(3):  # one after the other: with ten arrays the compiler uses no vectors
            made, image = f[begin + k * strip : begin + k * strip + n], here[k]
            factor = out.dtype.type(-amplitude if k else amplitude)
            for j in range(n):
                image[j] = factor * made[j]
        made, image = f[begin + 3 * strip : begin + 3 * strip + n], here[4]
        for j in range(n):
            image[j] = made[j]
        here[3] = 0.0
        begin += line


@kernel(fastmath=FAST, _nrt=False)
def stamp_strip(
    profile: AnyFloatArray, lens: StampLens, amplitude: float, row: int, rows: int, columns: int,
    at: IntArray, f: AnyFloatArray, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill `out` (5, rows·columns or more) with signal and gradient of a strip of rows.

    All of its pixels follow one another; ∂s/∂z is 0 and not written.  `f` comes from
    `begin_stamp`, `at` (TAPS) is work space.
    """
    line, _, _, strip = sizes(lens, columns)
    begin = _make_strip(profile, lens, row, rows, columns, np.int64(4), at, f)
    for k in range(4):
        there = out[4 if k == 3 else k]
        factor = out.dtype.type(amplitude if k == 0 else 1.0 if k == 3 else -amplitude)
        for i in range(rows):
            made = f[begin + i * line : begin + i * line + columns]
            image = there[i * columns : (i + 1) * columns]
            for j in range(columns):
                image[j] = factor * made[j]
        begin += strip


@kernel()
def stamp_signal(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, x_p: float, y_p: float,
    amplitude: float, out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` (ny, nx) with the signal of an image."""
    f = begin_stamp(profile, lens, pixels, x_p, y_p, amplitude)
    _put_signal(profile, lens, amplitude, False, np.empty(TAPS, dtype=np.int64), f, out)


@kernel()
def add_stamp(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, x_p: float, y_p: float,
    amplitude: float, sign: float, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Add the signal of an image, times a sign, to `out` (ny, nx), in the latter's precision."""
    f = begin_stamp(profile, lens, pixels, x_p, y_p, amplitude)
    _put_signal(profile, lens, sign * amplitude, True, np.empty(TAPS, dtype=np.int64), f, out)


@kernel(fastmath=FAST, _nrt=False)
def _put_signal(
    profile: AnyFloatArray, lens: StampLens, factor: float, adds: bool, at: IntArray,
    f: AnyFloatArray, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Write the signal into `out`, or add it."""
    rows, n = out.shape
    line, by = sizes(lens, n)[0], out.dtype.type(factor)
    for row in range(rows):
        if row % STRIP == 0:
            begin = _make_strip(profile, lens, row, min(STRIP, rows - row), n, np.int64(1), at, f)
        s, here = f[begin : begin + n], out[row]
        begin += line
        if adds:
            for j in range(n):
                here[j] += by * s[j]
        else:
            for j in range(n):
                here[j] = by * s[j]
