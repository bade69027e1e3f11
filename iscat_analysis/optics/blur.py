"""Images of particles that move during the exposure.

An image is the average along the path.  During the exposure E, free diffusion has the variance
D E/3 along each axis about the mean position: the variance 2Dt about the start averages to D E, and
that of the mean is 2D E/3.  At time t of the exposure the position is normal about the mean, with
the variance v(t) = 2D E (1/3 − t/E + t²/E²), which averages to q = D E/3.  Each plane wave of the
field, with wave vector k along the axis, is multiplied by the average of exp(−k²v(t)/2) over the
exposure.  The interference is linear in the field, so that this average is exact and takes no
additional time: the pupil becomes darker towards its edge.  A normal distribution of variance q
would make it too dark, by 0.05 % of the mass at 0.8 µm²/s and 1.5 % at 5 µm²/s in 3 ms.  The
variance of a single path differs from frame to frame by 63 % of its mean (standard deviation of
both axes together, from the eigenvalues (2/π²n²) D E of Brownian motion about its mean,
Σ n⁻⁴ / (Σ n⁻²)² = 2/5); this scatters masses, `PATH_SPREAD`.

For the scattered light |e|² the square of the averaged field is used, which is too small by
q |∇e|².  This is a small part of |e|², which is itself a small part of the contrast of a protein.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.model import ForwardModel
from iscat_analysis.optics.waves import LatticeField, RadialField

Model = TypeVar("Model", bound=ForwardModel)

PATH_SPREAD = math.sqrt(2 / 5)
"""Standard deviation of a path's variance in one exposure over its mean, both axes together."""

_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(3)
_TIMES = (_POINTS + 1) / 4  # of the first half of the exposure, which the second mirrors
_SHARES: list[float] = (_WEIGHTS / 2).tolist()
_SPREADS: list[float] = (2 - 6 * _TIMES + 6 * _TIMES**2).tolist()
"""v(t)/q: exact to 1e-6 of the image for blurs up to half the resolution."""


def spreads(variance_nm2: float, *, each_axis: bool = False) -> list[tuple[float, float]]:
    """Give the weights and variances of the normal distributions that make up a blur."""
    wider = math.sqrt(4 / 3) if each_axis else 1.0
    ratios = [1 + wider * (v - 1) for v in _SPREADS]
    return [(share, variance_nm2 * v) for share, v in zip(_SHARES, ratios, strict=True)]


def path_variance_nm2(d_um2_s: float, exposure_s: float) -> float:
    """Variance of a path about its mean position during an exposure."""
    return d_um2_s * 1e6 * exposure_s / 3


def blurred(model: Model, variance_nm2: float, *, upwards: bool) -> Model:
    """Average a model over the path of a particle that diffuses."""
    if variance_nm2 == 0:
        return model
    wave = model.wave
    if not isinstance(wave, RadialField | LatticeField):
        raise ConfigError('optics.psf = "measured" cannot be averaged along a path')
    exponent = np.asarray(wave.transverse**2, dtype=complex)
    if upwards:
        exponent = exponent + wave.axial**2
    dimmed = sum(share * np.exp(-exponent * v / 2) for share, v in spreads(variance_nm2))
    return model.dimmed(np.asarray(dimmed))


def wiggled(model: Model, sd_nm: float) -> Model:
    """Average a model over the positions of a wiggling particle, normal about their mean."""
    if sd_nm == 0:
        return model
    wave = model.wave
    if not isinstance(wave, RadialField | LatticeField):
        raise ConfigError('optics.psf = "measured" has the wiggle of the particles it shows')
    return model.dimmed(np.exp(-0.5 * (wave.transverse * sd_nm) ** 2))
