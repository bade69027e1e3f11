"""Scattered light that the pupil collects, as an area and in photons (physics.md, section 1)."""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis.optics.model import ForwardModel

_AZIMUTHS = 8  # the light of a dipole is a trigonometric polynomial of order 4


def collected_area_nm2(model: ForwardModel, z_nm: float, mass_kda: float) -> float:
    """Scattered light that the pupil collects, as an equivalent area of reference.

    It is counted before mask and analyser; aberrations do not change it.  Multiplied by the
    background per area it gives the collected scattered photons.
    """
    if model.is_measured:
        return math.nan
    amplitude = model.scale.amplitude(mass_kda)
    opening = model.at(amplitude).aperture
    p, phi = opening.pupil, np.linspace(0.0, 2 * math.pi, _AZIMUTHS, endpoint=False)
    decay = np.exp(-2 * p.axial.imag * model.centre_nm(z_nm, amplitude))
    density = (np.abs(opening.polarised(phi)) ** 2).sum(0).mean(1) * np.sin(p.theta) * decay
    pupil_integral = 2 * math.pi * float(np.sum(p.weight * density))
    medium = 1.0 if model.optics.emission == "reciprocal" else 1 / model.optics.n_immersion**2
    over = model.reference**2 if model.rho else 1.0
    e1 = abs(model.strength) * amplitude
    return e1**2 * medium * pupil_integral / over


def photons_per_intensity(model: ForwardModel, photons_per_frame: float, pixel_nm: float) -> float:
    """Dark field's scale s: photoelectrons per pixel and frame for unit |E_sca|²."""
    area = collected_area_nm2(model, model.height_nm, model.material.mass_kda)
    return photons_per_frame * pixel_nm**2 / area
