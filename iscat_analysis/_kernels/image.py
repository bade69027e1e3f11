"""From a profile to the image of a particle and its gradient, a strip of rows at a time.

The *signal* is the detected intensity above the reference's, over the reference's (contrast), or in
dark field, where `rho` = 0 instead of 1, the intensity itself:

    s = 2ρ a Re e_u + a² (|e_u|² + |e_v|²),

with a the amplitude and e the field per unit amplitude.  Positions are nm; (x, y) camera axes,
(u, v) the frame of the polarisation, rotated by ψ.  θ = (x, y, z, a, …) are the parameters of a
particle, and derivatives are with respect to its (x, y, z, a).

`radial_rows`, `lattice` and `stamp` compute the strips of the three kinds of lenses.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from iscat_analysis._kernels import FloatArray, kernel
from iscat_analysis._kernels.lattice import TAPS, interpolate_columns, lattice_row
from iscat_analysis._kernels.lens import LATTICE, ROUND, STAMP, LatticeLens, Lens, Pixels, RoundLens
from iscat_analysis._kernels.loops import copy_line
from iscat_analysis._kernels.radial_rows import (
    SUMS,
    radial_parts,
    radial_signal,
    radial_strip,
    strip_scratch,
)
from iscat_analysis._kernels.stamp import STRIP, add_stamp, begin_stamp, stamp_strip


@kernel()
def begin_strips(
    profile: FloatArray, lens: Lens, pixels: Pixels, theta: FloatArray
) -> tuple[int, Any, FloatArray]:
    """Rows of pixels in a strip, work space, and the lines (5, pixels) that a strip fills."""
    columns = pixels.x.size
    if len(lens) == ROUND:
        together, f = strip_scratch(pixels)
        return together, f, f[SUMS : SUMS + 5]
    if len(lens) == STAMP:
        at, lines = np.empty(TAPS, dtype=np.int64), np.zeros((5, STRIP * columns))
        return int(np.int64(STRIP)), (begin_stamp(profile, lens, pixels, theta), at), lines
    width = 2 * lens.components
    work = interpolate_columns(profile, lens, pixels, theta, 2 * width, width)
    return int(np.int64(1)), work, np.empty((5, columns))


@kernel()
def fill_strip(
    profile: FloatArray, lens: Lens, pixels: Pixels, theta: FloatArray, first: int, last: int,
    begun: tuple[int, Any, FloatArray],
) -> None:  # fmt: skip
    """Fill the lines from `begin_strips` with signal and gradient of rows `first` to `last`.

    All pixels of the rows follow one another.
    """
    _, work, lines = begun
    if len(lens) == ROUND:
        radial_strip(profile, lens, pixels, theta, first, last, 5, work)
    elif len(lens) == STAMP:
        stamp_strip(profile, lens, first, last - first, pixels.x.size, work, lines)
    else:
        lattice_row(lens, pixels, first, theta, work, lines)


@kernel()
def signal_gradient(
    profile: FloatArray, lens: Lens, pixels: Pixels, theta: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (ny, 5, nx) with signal and gradient on a pixel grid."""
    begun = begin_strips(profile, lens, pixels, theta)
    together, _, lines = begun
    rows, columns = pixels.y.size, pixels.x.size
    for first in range(0, rows, together):
        last = min(first + together, rows)
        fill_strip(profile, lens, pixels, theta, first, last, begun)
        for row in range(first, last):
            start = (row - first) * columns
            for k in range(5):
                copy_line(lines[k, start : start + columns], out[row, k])


@kernel()
def signal_image(
    profile: FloatArray, lens: Lens, pixels: Pixels, theta: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (ny, nx) with the signal on a pixel grid; the rest as in `signal_gradient`."""
    if len(lens) == STAMP:
        out[:] = 0.0
        add_stamp(profile, lens, pixels, theta, 1.0, out)
    elif len(lens) == LATTICE:
        f = interpolate_columns(profile, lens, pixels, theta, 2 * lens.components, 0)
        for row in range(pixels.y.size):
            lattice_row(lens, pixels, row, theta, f, out[row : row + 1])
    else:
        radial_signal(profile, lens, pixels, theta, out)


@kernel()
def signal_parts(
    profile: FloatArray, lens: RoundLens | LatticeLens, pixels: Pixels, theta: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` (2, ny·nx) with P and Q of the signal a P + a² Q.

    At the amplitude of θ neither is lost in the rounding of the other.  Not for samples at one
    height, which are P and Q themselves.
    """
    if len(lens) == ROUND:
        radial_parts(profile, lens, pixels, theta, out)
        return
    against, unit, columns = theta.copy(), theta[3], pixels.x.size
    against[3] = -unit
    f = interpolate_columns(profile, lens, pixels, theta, 2 * lens.components, 0)
    for row in range(pixels.y.size):
        p, q = out[0, row * columns :][:columns], out[1, row * columns :][:columns]
        lattice_row(lens, pixels, row, theta, f, p.reshape(1, columns))
        lattice_row(lens, pixels, row, against, f, q.reshape(1, columns))
        for j in range(columns):
            up, down = p[j], q[j]
            p[j], q[j] = (up - down) / (2 * unit), (up + down) / (2 * unit * unit)
