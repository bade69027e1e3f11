"""The image of a particle at one height, interpolated between samples.

At one height the signal is a P(x, y) + a² Q(x, y), both averaged over a pixel and band-limited,
P at k·NA and Q at twice that.  With `fine` samples of P and Q per pixel, an image needs no pupil,
no fields and no samples inside the pixels.  The samples lie on the grid of the pixels, so that all
pixels of an image have the same `TAPS`² weights, those of `iscat_analysis.optics.pixels`.  They are
applied along y first and then along x, with the derivatives of the weights for those of the image:
s = a S with S = P + a Q, ∂s/∂a = D = P + 2a Q, ∂²s/∂a² = 2Q = 2 (D − S)/a.

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

import numpy as np

from iscat_analysis._kernels import FAST, AnyFloatArray, FloatArray, IntArray, kernel
from iscat_analysis._kernels.lattice import BEFORE, TAPS, taps
from iscat_analysis._kernels.lens import Pixels, StampLens
from iscat_analysis._kernels.loops import mix, mix_both, within

STRIP = 16
"""Rows of pixels that are computed at once."""

BENDS = 10
"""Numbers for each pixel: s and its derivatives ∂x, ∂y, ∂xx, ∂a, ∂xy, ∂yy, ∂xa, ∂ya, ∂aa.

The first five are those of `signal_gradient`, with ∂xx in place of ∂z, which does not exist.
"""

_WEIGHTS = 6 * TAPS + 3  # weights along x and y, two derivatives, the first nodes, the amplitude
_SIGNAL, _GRADIENT, _BENT = 1, 4, 9  # images: S; ∂xS, ∂yS and D; ∂xxS, ∂xyS, ∂yyS, ∂xD and ∂yD
_PLACES = (0, 1, 2, 4, 3, 5, 6, 7, 8)  # of the images in a row of pixels
# S, ∂yS, D, ∂yyS and ∂yD along y: the order of their weights, and whether they are made of D
_ALONG_Y = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1))
# of each image the one along y that it is made of, and the order of its weights along x
_ALONG_X = ((0, 0), (0, 1), (1, 0), (2, 0), (0, 2), (1, 1), (3, 0), (2, 1), (4, 0))


@kernel()
def _sizes(lens: StampLens, columns: int) -> tuple[int, int, int, int]:
    """Length of a line, of a block of nodes, of their combinations, and of a strip's pixels."""
    more = (TAPS + lens.fine - 2) // lens.fine
    line = columns + more
    return line, (STRIP + more) * line, STRIP * line + more, STRIP * line


@kernel(_nrt=False)
def _first_nodes(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, theta: FloatArray
) -> tuple[float, float]:
    """Position of the first pixel on the nodes [nodes]; the nodes of all pixels exist."""
    room = TAPS - BEFORE
    last_x = profile.shape[2] - room - lens.fine * (pixels.x.size - 1)
    last_y = profile.shape[1] - room - lens.fine * (pixels.y.size - 1)
    x = (pixels.x[0] - theta[0]) * lens.inv_step + lens.half
    y = (pixels.y[0] - theta[1]) * lens.inv_step + lens.half
    least = float(BEFORE)
    return within(x, least, float(last_x)), within(y, least, float(last_y))


@kernel()
def begin_stamp(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, theta: FloatArray,
    images: int = _GRADIENT,
) -> AnyFloatArray:  # fmt: skip
    """Work space of an image, the weights of all of its pixels at the beginning."""
    _, block, made, strip = _sizes(lens, pixels.x.size)
    size = lens.fine * (2 * block + (1 + images // 2) * made) + images * strip
    w = np.empty(_WEIGHTS + size, profile.dtype)
    x, y = _first_nodes(profile, lens, pixels, theta)
    i, j, orders = int(x), int(y), 3 if images == _BENT else 2
    weights = w[: 6 * TAPS].reshape(2, 3, TAPS)
    taps(lens.window, x - i, lens.inv_step, weights[0, :orders])
    taps(lens.window, y - j, lens.inv_step, weights[1, :orders])
    w[6 * TAPS], w[6 * TAPS + 1], w[6 * TAPS + 2] = i - BEFORE, j - BEFORE, theta[3]
    return w


@kernel(fastmath=FAST, _nrt=False)
def _copy_nodes(
    profile: AnyFloatArray, row: int, step: int, first: int, last: int, line: int,
    a: float, signal: AnyFloatArray, slope: AnyFloatArray,
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
def _mix(nodes: AnyFloatArray, at: IntArray, w: AnyFloatArray, out: AnyFloatArray) -> None:
    """Fill `out` with the combination w of the lines that begin at TAPS places of `nodes`."""
    for k in range(0, TAPS, 4):
        a, b, c, d = nodes[at[k] :], nodes[at[k + 1] :], nodes[at[k + 2] :], nodes[at[k + 3] :]
        mix(a, b, c, d, w, k, out)


@kernel(fastmath=FAST, _nrt=False)
def _mix_both(
    nodes: AnyFloatArray, at: IntArray, w: AnyFloatArray, out: AnyFloatArray, other: AnyFloatArray
) -> None:
    """Fill `out` and `other` with two combinations of the same nodes; see `_mix`."""
    for k in range(0, TAPS, 4):
        a, b, c, d = nodes[at[k] :], nodes[at[k + 1] :], nodes[at[k + 2] :], nodes[at[k + 3] :]
        mix_both(a, b, c, d, w, k, out, other)


@kernel(_nrt=False)
def _make_strip(
    profile: AnyFloatArray, lens: StampLens, row: int, rows: int, columns: int,
    images: int, at: IntArray, w: AnyFloatArray,
) -> int:  # fmt: skip
    """Compute the first `images` of a strip, see `_BENT`.

    `at` (TAPS) is work space too.  Returns where the strip begins in the other work space; each of
    its images is `STRIP` lines long.
    """
    fine = lens.fine
    line, block, made, strip = _sizes(lens, columns)
    weights = w[: 6 * TAPS].reshape(2, 3, TAPS)
    left, top, a = int(w[6 * TAPS]), int(w[6 * TAPS + 1]) + fine * row, w[6 * TAPS + 2]
    per_phase = profile.shape[2] // fine
    nodes = w[_WEIGHTS : _WEIGHTS + 2 * fine * block]
    sums = w[_WEIGHTS + 2 * fine * block :]
    for k in range(TAPS):
        at[k] = k % fine * block + k // fine * line
    used, kept, size, first = rows * line, fine * block, fine * made, left // fine
    last = min(first + line, per_phase)
    for phase in range(fine):
        for k in range(fine):
            start = k * block
            stop = start + (rows + (TAPS - 1 - k) // fine) * line
            end = kept + stop if images > _SIGNAL else kept + start
            _copy_nodes(
                profile, top + k, fine, phase * per_phase + first, phase * per_phase + last, line,
                a, nodes[start:stop], nodes[kept + start : end],
            )  # fmt: skip
        here = sums[phase * made :]
        if images == _SIGNAL:
            _mix(nodes, at, weights[1, 0], here[:used])
            continue
        _mix_both(nodes, at, weights[1], here[:used], here[size : size + used])
        for k in range(2, 1 + images // 2):
            order, doubled = _ALONG_Y[k]
            made_y = here[k * size : k * size + used]
            _mix(nodes[kept * doubled :], at, weights[1, order], made_y)
    phase = left % fine
    for k in range(TAPS):
        at[k] = (phase + k) % fine * made + (phase + k) // fine
    out: int = _WEIGHTS + 2 * fine * block + (1 + images // 2) * size
    made_images, used = w[out:], used - (line - columns)
    if images == _SIGNAL:
        _mix(sums, at, weights[0, 0], made_images[:used])
        return out
    _mix_both(sums, at, weights[0], made_images[:used], made_images[strip : strip + used])
    for k in range(2, images):
        source, order = _ALONG_X[k]
        made_x = made_images[k * strip : k * strip + used]
        _mix(sums[source * size :], at, weights[0, order], made_x)
    return out


@kernel()
def stamp_gradient(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, theta: FloatArray, out: AnyFloatArray
) -> None:
    """Fill `out` with signal and gradient (ny, 5, nx), ∂s/∂z 0, or second derivatives too.

    These have shape (ny, BENDS, nx).
    """
    images = _BENT if out.shape[1] == BENDS else _GRADIENT
    f = begin_stamp(profile, lens, pixels, theta, images)
    _fill_rows(profile, lens, theta[3], images, np.empty(TAPS, dtype=np.int64), f, out)


@kernel(fastmath=FAST, _nrt=False)
def _fill_rows(
    profile: AnyFloatArray, lens: StampLens, amplitude: float, images: int, at: IntArray,
    f: AnyFloatArray, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Write all images; a derivative along the particle is minus that along the nodes."""
    rows, n = out.shape[0], out.shape[2]
    line, _, _, strip = _sizes(lens, n)
    one, a = out.dtype.type(1.0), out.dtype.type(amplitude)
    twice = out.dtype.type(2.0 / (amplitude * amplitude) if amplitude else 0.0)
    for row in range(rows):
        if row % STRIP == 0:
            begin = _make_strip(profile, lens, row, min(STRIP, rows - row), n, images, at, f)
        here = out[row]
        for k in range(images):  # one after the other: with more arrays there would be no vectors
            made, image = f[begin + k * strip : begin + k * strip + n], here[_PLACES[k]]
            factor = one if k == 3 else -one if k > 6 else -a if k in (1, 2) else a
            for j in range(n):
                image[j] = factor * made[j]
        if images == _BENT:
            signal, slope, bend = here[0], here[4], here[9]
            for j in range(n):
                bend[j] = twice * (a * slope[j] - signal[j])
        else:
            here[3] = 0.0
        begin += line


@kernel(fastmath=FAST, _nrt=False)
def stamp_strip(
    profile: AnyFloatArray, lens: StampLens, row: int, rows: int, columns: int,
    work: tuple[AnyFloatArray, IntArray], out: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill `out` (5, rows·columns or more) with signal and gradient of a strip of rows.

    All of its pixels follow one another; ∂s/∂z is 0 and not written.  `work` is what comes from
    `begin_stamp`, and TAPS numbers.
    """
    line, _, _, strip = _sizes(lens, columns)
    f, at = work
    amplitude = f[6 * TAPS + 2]
    begin = _make_strip(profile, lens, row, rows, columns, np.int64(_GRADIENT), at, f)
    for k in range(_GRADIENT):
        there = out[_PLACES[k]]
        factor = out.dtype.type(amplitude if k == 0 else 1.0 if k == 3 else -amplitude)
        for i in range(rows):
            made = f[begin + i * line : begin + i * line + columns]
            image = there[i * columns : (i + 1) * columns]
            for j in range(columns):
                image[j] = factor * made[j]
        begin += strip


@kernel()
def add_stamp(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, theta: FloatArray, sign: float,
    out: AnyFloatArray,
) -> None:  # fmt: skip
    """Add the signal of an image, times a sign, to `out` (ny, nx), in the latter's precision."""
    f = begin_stamp(profile, lens, pixels, theta)
    _add_signal(profile, lens, sign * theta[3], np.empty(TAPS, dtype=np.int64), f, out)


@kernel(fastmath=FAST, _nrt=False)
def _add_signal(
    profile: AnyFloatArray, lens: StampLens, factor: float, at: IntArray, f: AnyFloatArray,
    out: AnyFloatArray,
) -> None:  # fmt: skip
    """Add the signal row by row."""
    rows, n = out.shape
    line, by = _sizes(lens, n)[0], out.dtype.type(factor)
    for row in range(rows):
        if row % STRIP == 0:
            high = min(STRIP, rows - row)
            begin = _make_strip(profile, lens, row, high, n, np.int64(_SIGNAL), at, f)
        s, here = f[begin : begin + n], out[row]
        begin += line
        for j in range(n):
            here[j] += by * s[j]
