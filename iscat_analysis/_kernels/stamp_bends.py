"""Second derivatives of the image of a particle at one height, interpolated between samples.

As in `iscat_analysis._kernels.stamp`, with the first and second derivatives of the weights.  Along
y, the nodes of S = P + a Q are combined to S, ∂yS and ∂yyS, and those of D = P + 2a Q to D and ∂yD.
Along x, these are combined to all derivatives: s = a S, ∂s/∂a = D, ∂²s/∂a² = 2Q = 2 (D − S)/a.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from iscat_analysis._kernels import kernel
from iscat_analysis._kernels.lattice import DEGREE, FAST, TAPS
from iscat_analysis._kernels.lattice_rows import BEFORE, taps
from iscat_analysis._kernels.stamp import (
    STRIP,
    AnyFloatArray,
    FloatArray,
    IntArray,
    copy_nodes,
    first_nodes,
    mix_nodes,
    mix_nodes_both,
    sizes,
)

if TYPE_CHECKING:
    from iscat_analysis._kernels.image import Pixels
    from iscat_analysis._kernels.lens import StampLens

BENDS = 10
"""Numbers for each pixel: s and its derivatives ∂x, ∂y, ∂xx, ∂a, ∂xy, ∂yy, ∂xa, ∂ya, ∂aa.

The first five are those of `signal_gradient`, with ∂xx in place of ∂z, which does not exist.
"""

_SUMS = 5  # of nodes, mixed along y
_IMAGES = 9  # mixed along x as well


@kernel()
def _bending_taps(window: FloatArray, t: float, scale: float, out: AnyFloatArray) -> None:
    """Fill `out` (3 TAPS) with the weights of the nodes and their two derivatives."""
    taps(window, t, out[:TAPS], out[TAPS : 2 * TAPS])
    for k in range(TAPS):
        bend = 0.0
        for p in range(DEGREE, 1, -1):
            bend = bend * t + p * (p - 1) * window[p, k]
        out[TAPS + k] *= scale
        out[2 * TAPS + k] = bend * scale * scale


@kernel()
def stamp_bends(
    profile: AnyFloatArray, lens: StampLens, pixels: Pixels, x_p: float, y_p: float,
    amplitude: float, out: AnyFloatArray,
) -> None:  # fmt: skip
    """Fill `out` (ny, BENDS, nx) with signal, gradient and second derivatives of an image."""
    _, block, made, strip = sizes(lens, pixels.x.size)
    weights = np.empty(6 * TAPS + 1, profile.dtype)
    x, y = first_nodes(profile, lens, pixels, x_p, y_p)
    i, j = int(x), int(y)
    _bending_taps(lens.window, x - i, lens.inv_step, weights[: 3 * TAPS])
    _bending_taps(lens.window, y - j, lens.inv_step, weights[3 * TAPS : 6 * TAPS])
    weights[6 * TAPS] = amplitude
    nodes = np.empty(2 * lens.fine * block, profile.dtype)
    sums = np.empty(_SUMS * lens.fine * made, profile.dtype)
    images = np.empty(_IMAGES * strip, profile.dtype)
    at = np.empty(TAPS, dtype=np.int64)
    rows, n = out.shape[0], out.shape[2]
    for first in range(0, rows, STRIP):
        high = min(STRIP, rows - first)
        left, top = i - BEFORE, j - BEFORE + lens.fine * first
        _mix_down(profile, lens, left, top, high, n, weights[3 * TAPS :], at, nodes, sums)
        _mix_along(lens, left, high, n, weights[: 3 * TAPS], at, sums, images)
        _put(lens, amplitude, images, out[first : first + high])


@kernel(_nrt=False)
def _mix_down(
    profile: AnyFloatArray, lens: StampLens, left: int, top: int, rows: int, columns: int,
    w: AnyFloatArray, at: IntArray, nodes: AnyFloatArray, sums: AnyFloatArray,
) -> None:  # fmt: skip
    """Combine the nodes of a strip along y: S, ∂yS, ∂yyS, D and ∂yD, one after the other."""
    fine = lens.fine
    line, block, made, _ = sizes(lens, columns)
    per_phase = profile.shape[2] // fine
    kept, size, used = fine * block, fine * made, rows * line
    first = left // fine
    last = min(first + line, per_phase)
    value, slope, bend = w[:TAPS], w[TAPS : 2 * TAPS], w[2 * TAPS : 3 * TAPS]
    for k in range(TAPS):
        at[k] = k % fine * block + k // fine * line
    for phase in range(fine):
        for k in range(fine):
            start = k * block
            stop = start + (rows + (TAPS - 1 - k) // fine) * line
            copy_nodes(
                profile, top + k, fine, phase * per_phase + first, phase * per_phase + last, line,
                w[3 * TAPS], nodes[start:stop], nodes[kept + start : kept + stop],
            )  # fmt: skip
        a = phase * made
        b, c, d, e = a + size, a + 2 * size, a + 3 * size, a + 4 * size
        mix_nodes_both(nodes[:kept], at, value, slope, sums[a : a + used], sums[b : b + used])
        mix_nodes(nodes[:kept], at, bend, sums[c : c + used])
        mix_nodes_both(nodes[kept:], at, value, slope, sums[d : d + used], sums[e : e + used])


@kernel(_nrt=False)
def _mix_along(
    lens: StampLens, left: int, rows: int, columns: int, w: AnyFloatArray, at: IntArray,
    sums: AnyFloatArray, images: AnyFloatArray,
) -> None:  # fmt: skip
    """Combine the results of `_mix_down` along x: S, its ∂x, ∂xx, ∂y, ∂xy, ∂yy, D, ∂xD, ∂yD."""
    fine = lens.fine
    line, _, made, strip = sizes(lens, columns)
    size, used = fine * made, rows * line - (line - columns)
    value, slope, bend = w[:TAPS], w[TAPS : 2 * TAPS], w[2 * TAPS :]
    phase = left % fine
    for k in range(TAPS):
        at[k] = (phase + k) % fine * made + (phase + k) // fine
    s, sy, syy = sums[:size], sums[size : 2 * size], sums[2 * size : 3 * size]
    d, dy = sums[3 * size : 4 * size], sums[4 * size :]
    mix_nodes_both(s, at, value, slope, images[:used], images[strip : strip + used])
    mix_nodes(s, at, bend, images[2 * strip : 2 * strip + used])
    mix_nodes_both(
        sy, at, value, slope, images[3 * strip : 3 * strip + used],
        images[4 * strip : 4 * strip + used],
    )  # fmt: skip
    mix_nodes(syy, at, value, images[5 * strip : 5 * strip + used])
    mix_nodes_both(
        d, at, value, slope, images[6 * strip : 6 * strip + used],
        images[7 * strip : 7 * strip + used],
    )  # fmt: skip
    mix_nodes(dy, at, value, images[8 * strip : 8 * strip + used])


@kernel(fastmath=FAST, _nrt=False)
def _put(lens: StampLens, amplitude: float, images: AnyFloatArray, out: AnyFloatArray) -> None:
    """Write a strip's images; a derivative along the particle is minus that along the nodes."""
    rows, n = out.shape[0], out.shape[2]
    line, _, _, strip = sizes(lens, n)
    one, a = out.dtype.type(1.0), out.dtype.type(amplitude)
    for row in range(rows):
        here = out[row]
        for k in range(_IMAGES):
            made = images[k * strip + row * line : k * strip + row * line + n]
            if k < 6:
                image, factor = here[_PLACES[k]], -a if k in (1, 3) else a
            else:
                image, factor = here[_PLACES[k]], one if k == 6 else -one
            for j in range(n):
                image[j] = factor * made[j]
        twice = out.dtype.type(2.0 / (amplitude * amplitude) if amplitude else 0.0)
        signal, slope, bend = here[0], here[4], here[9]
        for j in range(n):
            bend[j] = twice * (a * slope[j] - signal[j])


_PLACES = (0, 1, 3, 2, 5, 6, 4, 7, 8)  # of the images in a row of pixels
