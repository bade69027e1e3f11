"""From a radial profile to the image of a particle and its gradient, a row of pixels at a time.

The *signal* is the detected intensity above the reference's, over the reference's (contrast), or in
dark field, where `rho` = 0 instead of 1, the intensity itself:

    s = 2ρ a Re e_u + a² (|e_u|² + |e_v|²),

with a the amplitude and e the field per unit amplitude.  Positions are nm; (x, y) camera axes,
(u, v) the frame of the polarisation, rotated by ψ.  Derivatives are with respect to the particle's
(x, y, z, a).

A row is done in two loops: the first evaluates the quintics, whose interval differs from pixel to
pixel and so runs scalar (76 multiply-adds); the second combines them and runs in vector registers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from iscat_analysis._kernels.lattice import FAST
from iscat_analysis._kernels.lattice_rows import (
    interpolate_columns,
    lattice_gradient,
    lattice_signal,
    rows_needed,
)
from iscat_analysis._kernels.stamp import stamp_gradient, stamp_signal

FloatArray = NDArray[np.float64]

SCRATCH = 13
"""Rows of scratch a row of pixels needs: 8 fields, 4 slopes, the distance in steps."""


class Lens(NamedTuple):
    """What turns a profile into a signal.

    Attributes
    ----------
    inv_step : float
        One over the step of the radial profile or of the lattice [1/nm].
    rho : float
        1 with a reference, 0 in dark field.
    cos_psi, sin_psi : float
        Polarisation angle of a radial profile.
    co, cross, ring : float
        How a radial profile makes the components; see the module's docstring.
    half : int
        Nodes of the lattice on either side of the particle; 0 for a radial profile.
    components : int
        Components of the field on the lattice.
    window : ndarray, shape (degree + 1, TAPS)
        Weights of the lattice's nodes.
    fine : int
        Samples per pixel of a picture at one height; 0 for profiles of the field.
    """

    inv_step: float
    rho: float
    cos_psi: float
    sin_psi: float
    co: float
    cross: float
    ring: float
    half: int
    components: int
    window: FloatArray
    fine: int = 0


class Pixels(NamedTuple):
    """A grid of pixels and the samples inside each.

    Attributes
    ----------
    x, y : ndarray, shape (nx,), (ny,)
        Pixel centres [nm].
    offsets, weights : ndarray, shape (q,)
        Samples inside a pixel [nm] and their weights, summing to 1.
    """

    x: FloatArray
    y: FloatArray
    offsets: FloatArray
    weights: FloatArray


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _row_fields(
    profile: FloatArray,
    inv_step: float,
    x: FloatArray,
    x_p: float,
    dy: float,
    with_gradient: bool,
    f: FloatArray,
) -> None:
    """Fill f with the profile's channels, and the slopes d/dt of the first four."""
    for j in range(x.size):
        dx = x[j] - x_p
        f[12, j] = np.sqrt(dx * dx + dy * dy) * inv_step
    if with_gradient:
        for j in range(x.size):
            t = f[12, j]
            n = int(t)
            t -= n
            i = np.uintp(n)
            for k in range(4):
                d = profile[k, i, 5]
                v = d * t + profile[k, i, 4]
                d = d * t + v
                v = v * t + profile[k, i, 3]
                d = d * t + v
                v = v * t + profile[k, i, 2]
                d = d * t + v
                v = v * t + profile[k, i, 1]
                f[8 + k, j] = d * t + v
                f[k, j] = v * t + profile[k, i, 0]
            for k in range(4, 8):
                v = profile[k, i, 5]
                v = v * t + profile[k, i, 4]
                v = v * t + profile[k, i, 3]
                v = v * t + profile[k, i, 2]
                v = v * t + profile[k, i, 1]
                f[k, j] = v * t + profile[k, i, 0]
    else:
        for j in range(x.size):
            t = f[12, j]
            n = int(t)
            t -= n
            i = np.uintp(n)
            for k in range(4):
                v = profile[k, i, 5]
                v = v * t + profile[k, i, 4]
                v = v * t + profile[k, i, 3]
                v = v * t + profile[k, i, 2]
                v = v * t + profile[k, i, 1]
                f[k, j] = v * t + profile[k, i, 0]


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _row_gradient(
    profile: FloatArray,
    lens: Lens,
    x: FloatArray,
    x_p: float,
    dy: float,
    amplitude: float,
    weight: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Add weight × (s, ∂s/∂x_p, ∂s/∂y_p, ∂s/∂z, ∂s/∂a) of one row to `out` (5, nx).

    `dy` is the row's y minus the particle's; the profile has 8 channels or more.
    """
    inv_step, rho, cos_psi, sin_psi = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring = lens.co, lens.cross, lens.ring
    _row_fields(profile, inv_step, x, x_p, dy, True, f)
    a = amplitude
    for j in range(x.size):
        dx = x[j] - x_p
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        per_r = inv_step * inv_step / (f[12, j] + 1e-30)
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
        out[0, j] += weight * (2 * rho * a * eu_r + a * a * power)
        out[1, j] -= weight * (cos_psi * s_u - sin_psi * s_v)
        out[2, j] -= weight * (sin_psi * s_u + cos_psi * s_v)
        out[3, j] += weight * (
            g_r * (f[4, j] + f[6, j] * c2)
            + g_i * (f[5, j] + f[7, j] * c2)
            + (h_r * f[6, j] + h_i * f[7, j]) * s2
        )
        out[4, j] += weight * (2 * rho * eu_r + 2 * a * power)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _row_signal(
    profile: FloatArray,
    lens: Lens,
    x: FloatArray,
    x_p: float,
    dy: float,
    amplitude: float,
    weight: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Add weight × s of one row to `out`, shape (nx,); the profile has 4 channels or more."""
    inv_step, rho, cos_psi, sin_psi = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring = lens.co, lens.cross, lens.ring
    _row_fields(profile, inv_step, x, x_p, dy, False, f)
    a = amplitude
    for j in range(x.size):
        dx = x[j] - x_p
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        c2, s2 = co * (u * u - v * v), cross * (2 * u * v) + ring * (u * u + v * v)
        eu_r, eu_i = f[0, j] + f[2, j] * c2, f[1, j] + f[3, j] * c2
        ev_r, ev_i = f[2, j] * s2, f[3, j] * s2
        power = eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i
        out[j] += weight * a * (2 * rho * eu_r + a * power)


@njit(cache=True, nogil=True, fastmath=FAST, error_model="numpy")
def _row_parts(
    profile: FloatArray,
    lens: Lens,
    x: FloatArray,
    x_p: float,
    dy: float,
    weight: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Add weight × what multiplies a and a² in one row of signals to `out` (2, nx)."""
    inv_step, rho, cos_psi, sin_psi = lens.inv_step, lens.rho, lens.cos_psi, lens.sin_psi
    co, cross, ring = lens.co, lens.cross, lens.ring
    _row_fields(profile, inv_step, x, x_p, dy, False, f)
    for j in range(x.size):
        dx = x[j] - x_p
        u, v = cos_psi * dx + sin_psi * dy, cos_psi * dy - sin_psi * dx
        c2, s2 = co * (u * u - v * v), cross * (2 * u * v) + ring * (u * u + v * v)
        eu_r, eu_i = f[0, j] + f[2, j] * c2, f[1, j] + f[3, j] * c2
        ev_r, ev_i = f[2, j] * s2, f[3, j] * s2
        out[0, j] += weight * 2 * rho * eu_r
        out[1, j] += weight * (eu_r * eu_r + eu_i * eu_i + ev_r * ev_r + ev_i * ev_i)


@njit(cache=True, nogil=True, error_model="numpy")
def workspace(lens: Lens, pixels: Pixels) -> FloatArray:
    """Scratch for the rows of an image, wherever the particle is."""
    rows = rows_needed(lens, pixels) if lens.half else SCRATCH
    return np.empty((rows, pixels.x.size))


@njit(cache=True, nogil=True, error_model="numpy")
def begin_image(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    with_gradient: bool,
    f: FloatArray,
) -> None:
    """Prepare the scratch for the rows of one image."""
    if lens.half:
        interpolate_columns(profile, lens, pixels, x_p, y_p, with_gradient, f)


@njit(cache=True, nogil=True, error_model="numpy")
def row_gradient(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    row: int,
    x_p: float,
    y_p: float,
    amplitude: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (5, nx) with signal and gradient of one row, averaged over the samples."""
    if lens.half:
        lattice_gradient(lens, pixels, row, y_p, amplitude, f, out)
        return
    out[:] = 0.0
    for i in range(pixels.offsets.size):
        dy = pixels.y[row] + pixels.offsets[i] - y_p
        for j in range(pixels.offsets.size):
            _row_gradient(
                profile, lens, pixels.x, x_p - pixels.offsets[j], dy, amplitude,
                pixels.weights[i] * pixels.weights[j], f, out,
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def row_signal(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    row: int,
    x_p: float,
    y_p: float,
    amplitude: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (nx,) with the signal of one row, averaged over the samples in each pixel."""
    if lens.half:
        lattice_signal(lens, pixels, row, y_p, amplitude, f, out)
        return
    out[:] = 0.0
    for i in range(pixels.offsets.size):
        dy = pixels.y[row] + pixels.offsets[i] - y_p
        for j in range(pixels.offsets.size):
            _row_signal(
                profile, lens, pixels.x, x_p - pixels.offsets[j], dy, amplitude,
                pixels.weights[i] * pixels.weights[j], f, out,
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def signal_parts(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    unit: float,
    f: FloatArray,
    out: FloatArray,
) -> None:
    """Fill `out` (ny, 2, nx) with P and Q of the signal a P + a² Q.

    `unit` is an amplitude at which neither drowns in the other, `f` the work space.  Not for
    samples at one height, which are P and Q themselves.
    """
    begin_image(profile, lens, pixels, x_p, y_p, False, f)
    for row in range(pixels.y.size):
        p, q = out[row, 0], out[row, 1]
        if lens.half:
            row_signal(profile, lens, pixels, row, x_p, y_p, unit, f, p)
            row_signal(profile, lens, pixels, row, x_p, y_p, -unit, f, q)
            for j in range(p.size):
                up, down = p[j], q[j]
                p[j], q[j] = (up - down) / (2 * unit), (up + down) / (2 * unit * unit)
            continue
        out[row] = 0.0
        for i in range(pixels.offsets.size):
            dy = pixels.y[row] + pixels.offsets[i] - y_p
            for j in range(pixels.offsets.size):
                _row_parts(
                    profile, lens, pixels.x, x_p - pixels.offsets[j], dy,
                    pixels.weights[i] * pixels.weights[j], f, out[row],
                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def signal_image(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    amplitude: float,
    out: FloatArray,
) -> None:
    """Fill `out` (ny, nx) with the signal on a pixel grid; the rest as in `signal_gradient`."""
    if lens.fine:
        stamp_signal(profile, lens, pixels, x_p, y_p, amplitude, out)
        return
    f = workspace(lens, pixels)
    begin_image(profile, lens, pixels, x_p, y_p, False, f)
    for row in range(pixels.y.size):
        row_signal(profile, lens, pixels, row, x_p, y_p, amplitude, f, out[row])


@njit(cache=True, nogil=True, error_model="numpy")
def signal_gradient(
    profile: FloatArray,
    lens: Lens,
    pixels: Pixels,
    x_p: float,
    y_p: float,
    amplitude: float,
    out: FloatArray,
) -> None:
    """Signal and gradient on a pixel grid.

    Parameters
    ----------
    profile : ndarray
        Radial, shape (8 or more, intervals, 6), or on a lattice, shape (channels, nodes, nodes).
    lens : Lens
        Step, reference, polarisation.
    pixels : Pixels
        Grid and samples.
    x_p, y_p : float
        Particle [nm].
    amplitude : float
        a.
    out : ndarray, shape (ny, 5, nx)
        Filled with s, ∂s/∂x_p, ∂s/∂y_p, ∂s/∂z, ∂s/∂a.
    """
    if lens.fine:
        stamp_gradient(profile, lens, pixels, x_p, y_p, amplitude, out)
        return
    f = workspace(lens, pixels)
    begin_image(profile, lens, pixels, x_p, y_p, True, f)
    for row in range(pixels.y.size):
        row_gradient(profile, lens, pixels, row, x_p, y_p, amplitude, f, out[row])
