"""Pictures of particles that move while the camera is exposed.

A picture is the average along the path.  About its mean place the path of free diffusion spreads by
the variance D E/3 along each axis during the exposure E: the variance 2Dt about its start averages
to D E, and that of the mean is 2D E/3.  Averaging over a normal spread of variance q multiplies
each plane wave of the field by exp(−k²q/2), k its wave vector along the axis, so that the
interference, which is linear in the field, is averaged exactly at no cost: the pupil is dimmed
towards its edge.  The path itself is not normal, and its spread differs from frame to frame by 63 %
of its mean (standard deviation of the two axes together, from the eigenvalues (2/π²n²) D E of
Brownian motion about its mean, Σ n⁻⁴ / (Σ n⁻²)² = 2/5); that scatters masses, `PATH_SPREAD`.
Of the scattered light |e|² the square of the averaged field is taken, which is too little by
q |∇e|²: a small part of what is itself a small part of the contrast of a protein.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.model import ForwardModel
from iscat_analysis.optics.waves import LatticeField, RadialField

PATH_SPREAD = math.sqrt(2 / 5)
"""Standard deviation of a path's spread in one exposure over its mean, of both axes together."""


def path_variance_nm2(d_um2_s: float, exposure_s: float) -> float:
    """Variance of a path about its mean place during an exposure.

    Parameters
    ----------
    d_um2_s : float
        Diffusion coefficient along each axis [µm²/s].
    exposure_s : float
        Exposure [s].

    Returns
    -------
    float
        D E/3 along each axis [nm²].
    """
    return d_um2_s * 1e6 * exposure_s / 3


def blurred(model: ForwardModel, variance_nm2: float, *, upwards: bool) -> ForwardModel:
    """Average a model over a normal spread of the particle's place.

    Parameters
    ----------
    model : ForwardModel
        Of a particle that stands still.
    variance_nm2 : float
        Variance of the place along each axis [nm²].
    upwards : bool
        Whether the particle moves along z as well.

    Returns
    -------
    ForwardModel
        The same mass scale: amplitudes are those of a particle that stands still.

    Raises
    ------
    ConfigError
        The picture was measured, so that its waves are not known.
    """
    if variance_nm2 == 0:
        return model
    wave = model.wave
    if not isinstance(wave, RadialField | LatticeField):
        raise ConfigError('optics.psf = "measured" cannot be averaged along a path')
    exponent = np.asarray(wave.transverse**2, dtype=complex)
    if upwards:
        exponent = exponent + wave.axial**2
    dimmed = np.exp(-exponent * variance_nm2 / 2)
    if isinstance(wave, RadialField):
        return replace(model, wave=replace(wave, source=wave.source * dimmed))
    return replace(model, wave=replace(wave, harmonics=wave.harmonics * dimmed))
