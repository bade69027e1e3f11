"""The image of a particle at one height, sampled on the grid of the pixels, sharp or blurred.

The signal of a pixel is band-limited, the interference at k·NA and the scattered light at twice
that.  Its value at any position follows from `TAPS` samples along each axis.  Their weights have
the smallest mean-square error over the band, against a wave that is shifted to this position and
dimmed by the blur,

    w(t) = argmin ∫ |Σ_l w_l e^{iu(l − 3)} − e^{iut} e^{−q u²/2}|² du,

with u the wavenumber times the distance of the samples, t the position between two samples and q
the variance of the blur in units of that distance squared.  One set of samples is therefore enough
for every blur, of the interference and of the scattered light.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from iscat_analysis._kernels.image import signal_image
from iscat_analysis._kernels.lattice import DEGREE, TAPS
from iscat_analysis._kernels.lens import Pixels, StampLens
from iscat_analysis.optics.pixels import bandwidth
from iscat_analysis.records import FloatArray

if TYPE_CHECKING:
    from iscat_analysis.config import Optics
    from iscat_analysis.optics.model import ForwardModel

BAND = 0.8
"""Largest u of the interference: the error of the sharp image is 4e-6, of its gradient 1e-5."""

RINGS = 1.6
"""The same, far from the particle: the relative error of the rings of the interference is 1e-3, and
the square of the scattered field is negligible."""


def samples_per_pixel(optics: Optics, pixel_nm: float, band: float = BAND) -> int:
    """Give how many samples per pixel the image needs along each axis."""
    return max(1, math.ceil(bandwidth(optics) * pixel_nm / band))


def margin_nm(optics: Optics, pixel_nm: float) -> float:
    """Give how far beyond the pixels a model must be sampled."""
    return pixel_nm + TAPS / 2 * pixel_nm / samples_per_pixel(optics, pixel_nm)


def sample_picture(
    model: ForwardModel, pixel_nm: float, half_px: float, band: float = BAND
) -> tuple[StampLens, FloatArray]:
    """Sample the image of a particle at the model's height.

    Shapes: `samples` (2, nodes, nodes).
    """
    fine = samples_per_pixel(model.optics, pixel_nm, band)
    step = pixel_nm / fine
    half = math.ceil(half_px * fine) + TAPS
    nodes = np.asarray(step * np.arange(-half, half + 1), dtype=np.float64)
    offsets, weights = model.area.points(pixel_nm)
    profile = model.profile(model.height_nm, 1)
    # as strong as the reference, so that neither P nor Q is lost in the rounding of the other
    z = 1 / math.sqrt(model.wave.peak(model.height_nm, 1.0, model.rho)[1])
    reach = model.reach_nm - math.sqrt(2) * pixel_nm
    both = np.zeros((2, nodes.size, nodes.size))
    for row, y in enumerate(nodes):
        inside = np.flatnonzero(nodes**2 + y**2 < reach**2)
        if not inside.size:
            continue
        pixels = Pixels(nodes[inside], np.array([y]), offsets, weights)
        for k, sign in enumerate((1.0, -1.0)):
            out = np.empty((1, inside.size))
            signal_image(profile, model.lens, pixels, np.array([0.0, 0.0, 0.0, sign * z]), out)
            both[k, row, inside] = out[0]
    up, down = both
    samples = np.stack([(up - down) / (2 * z), (up + down) / (2 * z**2)])
    per_phase = math.ceil(nodes.size / fine)
    padded = np.pad(samples, ((0, 0), (0, 0), (0, per_phase * fine - nodes.size)))
    phased = padded.reshape(2, nodes.size, per_phase, fine).swapaxes(2, 3)
    lens = StampLens(1 / step, half, weights_between(0.0, band), fine)
    return lens, np.ascontiguousarray(phased.reshape(2, nodes.size, -1))


@lru_cache(256)
def weights_between(variance: float, band: float = BAND) -> FloatArray:
    """Weights of the samples around a position, for a blur.

    Shapes: result (degree + 1, TAPS).
    """
    # of the quadrature over each band
    points, quadrature = np.polynomial.legendre.leggauss(24)
    u = band * np.concatenate([(points + 1) / 2, (points + 3) / 2])
    # beyond the band, to twice its end, there is little light
    root = np.sqrt(np.concatenate([quadrature, 1e-3**2 * quadrature]))
    waves = np.exp(1j * np.outer(u, np.arange(TAPS) - (TAPS // 2 - 1))) * root[:, None]
    t = (1 - np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))) / 2
    wanted = np.exp(1j * np.outer(u, t) - variance * u[:, None] ** 2 / 2) * root[:, None]
    left, right = (np.concatenate([part.real, part.imag]) for part in (waves, wanted))
    weights = np.linalg.lstsq(left, right, rcond=1e-15)[0]  # (TAPS, places)
    return np.linalg.solve(np.vander(t, DEGREE + 1, increasing=True), weights.T)
