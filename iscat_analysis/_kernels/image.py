"""From a radial profile to the image of a particle and its gradient, a row of pixels at a time.

The *signal* is the detected intensity above the reference's, over the reference's (contrast), or in
dark field, where `rho` = 0 instead of 1, the intensity itself:

    s = 2ρ a Re e_u + a² (|e_u|² + |e_v|²),

with a the amplitude and e the field per unit amplitude.  Positions are nm; (x, y) camera axes,
(u, v) the frame of the polarisation, rotated by ψ.  Derivatives are with respect to the particle's
(x, y, z, a).

`radial_rows`, `lattice_rows` and `stamp` compute an image from a profile.
"""

from __future__ import annotations

import numpy as np

from iscat_analysis._kernels import FloatArray, kernel
from iscat_analysis._kernels.lattice import interpolate_columns, lattice_row, rows_needed
from iscat_analysis._kernels.lens import LATTICE, ROUND, STAMP, LatticeLens, Lens, Pixels
from iscat_analysis._kernels.radial_rows import radial_gradient, radial_parts, radial_signal
from iscat_analysis._kernels.stamp import stamp_gradient, stamp_signal


@kernel()
def _begin_lattice(
    profile: FloatArray, lens: LatticeLens, pixels: Pixels, x_p: float, y_p: float,
    with_gradient: bool,
) -> FloatArray:  # fmt: skip
    """Interpolate the columns of an image on a lattice."""
    f = np.empty((rows_needed(lens, pixels), pixels.x.size))
    interpolate_columns(profile, lens, pixels, x_p, y_p, with_gradient, f)
    return f


@kernel()
def signal_parts(
    profile: FloatArray, lens: Lens, pixels: Pixels, x_p: float, y_p: float, unit: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` (2, ny·nx) with P and Q of the signal a P + a² Q.

    At the amplitude `unit` neither is lost in the rounding of the other.  Not for samples at one
    height, which are P and Q themselves.
    """
    if len(lens) == ROUND:
        radial_parts(profile, lens, pixels, x_p, y_p, out)
        return
    f, nx = _begin_lattice(profile, lens, pixels, x_p, y_p, False), pixels.x.size
    for row in range(pixels.y.size):
        p, q = out[0, row * nx : (row + 1) * nx], out[1, row * nx : (row + 1) * nx]
        lattice_row(lens, pixels, row, y_p, unit, f, p.reshape(1, nx))
        lattice_row(lens, pixels, row, y_p, -unit, f, q.reshape(1, nx))
        for j in range(p.size):
            up, down = p[j], q[j]
            p[j], q[j] = (up - down) / (2 * unit), (up + down) / (2 * unit * unit)


@kernel()
def signal_image(
    profile: FloatArray, lens: Lens, pixels: Pixels, x_p: float, y_p: float, amplitude: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """Fill `out` (ny, nx) with the signal on a pixel grid; the rest as in `signal_gradient`."""
    if len(lens) == STAMP:
        stamp_signal(profile, lens, pixels, x_p, y_p, amplitude, out)
    elif len(lens) == LATTICE:
        f = _begin_lattice(profile, lens, pixels, x_p, y_p, False)
        for row in range(pixels.y.size):
            lattice_row(lens, pixels, row, y_p, amplitude, f, out[row : row + 1])
    else:
        radial_signal(profile, lens, pixels, x_p, y_p, amplitude, out)


@kernel()
def signal_gradient(
    profile: FloatArray, lens: Lens, pixels: Pixels, x_p: float, y_p: float, amplitude: float,
    out: FloatArray,
) -> None:  # fmt: skip
    """Signal and gradient on a pixel grid.

    Shapes: `out` (ny, 5, nx).
    """
    if len(lens) == STAMP:
        stamp_gradient(profile, lens, pixels, x_p, y_p, amplitude, out)
    elif len(lens) == LATTICE:
        f = _begin_lattice(profile, lens, pixels, x_p, y_p, True)
        for row in range(pixels.y.size):
            lattice_row(lens, pixels, row, y_p, amplitude, f, out[row])
    else:
        radial_gradient(profile, lens, pixels, x_p, y_p, amplitude, out)
