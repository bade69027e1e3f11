"""What a report shows of a measured microscope: the average picture and the pupil."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from iscat_analysis._kernels.zernike import zernike
from iscat_analysis.instrument.learner.particle_images import Build, ParticleImage, Settings
from iscat_analysis.instrument.learner.settings import is_term
from iscat_analysis.instrument.learner.starts import contrast_of
from iscat_analysis.records import FloatArray

PUPIL_POINTS = 129
"""Points across the pupil's picture."""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Pictures of a calibration."""

    measured: FloatArray
    model: FloatArray
    residual: FloatArray
    pixel_nm: float
    radius_nm: FloatArray
    radial: FloatArray
    radial_se: FloatArray
    radial_model: FloatArray
    wavefront_nm: FloatArray
    transmission: FloatArray
    na: float


def make_pictures(sights: Sequence[ParticleImage], build: Build, settings: Settings) -> Pictures:
    """Average the pictures and what the microscope makes of them.

    Data and model are moved by the same interpolation, so that it shows in neither residual.
    """
    shape, pixel = sights[0].grid.shape, sights[0].grid.pixel_nm
    sums, weight, noise = np.zeros((2, *shape)), 0.0, np.zeros(shape)
    typical = float(np.median([abs(sight.mass_kda) for sight in sights]))
    for sight in sights:
        place = (sight.grid, sight.x_nm, sight.y_nm, sight.z_nm, sight.mass_kda)
        model, _ = build(sight.seen_with(settings)).gradient(*place)
        contrast, variance = contrast_of(sight)
        used = variance < 1e5
        contrast = np.where(used, contrast, model)
        model = model - float(np.average(model[used], weights=1 / variance[used]))
        offset = (
            (sight.y_nm - float(np.mean(sight.grid.y_nm))) / pixel,
            (sight.x_nm - float(np.mean(sight.grid.x_nm))) / pixel,
        )
        scale, level = sight.mass_kda / typical, float(np.median(variance))
        for total, image in zip(sums, (contrast, model), strict=True):
            moved = ndimage.shift(image, [-o for o in offset], order=3, mode="nearest")
            total += scale * moved / level
        weight += scale**2 / level
        noise += scale**2 / level
    measured, fitted = sums / weight
    sigma = 1 / np.sqrt(noise)
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    rings = np.rint(np.hypot(y[:, None], x)).astype(int)
    inside = rings <= min(shape) // 2
    count = np.bincount(rings[inside])
    first = int(np.argmax(count > 0))

    def ring_mean(image: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(rings[inside], image[inside])[first:] / count[first:])

    axis = np.linspace(-1, 1, PUPIL_POINTS)
    rho, phi = np.hypot(axis[:, None], axis), np.arctan2(axis[:, None], axis[None, :])
    disc = rho <= 1
    wavefront = np.zeros(rho.shape)
    for name, size in settings.items():
        if is_term(name) and size:
            wavefront += size * zernike(int(name[1:]), np.minimum(rho, 1.0), phi)[0]
    masked = rho * settings["na"] < settings["mask_na"]
    return Pictures(
        measured=measured,
        model=fitted,
        residual=(measured - fitted) / sigma,
        pixel_nm=pixel,
        radius_nm=pixel * np.arange(first, count.size, dtype=np.float64),
        radial=ring_mean(measured),
        radial_se=np.sqrt(ring_mean(sigma**2) / count[first:]),
        radial_model=ring_mean(fitted),
        wavefront_nm=np.where(disc, wavefront, np.nan),
        transmission=np.where(disc, np.where(masked, settings["attenuation"], 1.0), np.nan),
        na=float(settings["na"]),
    )
