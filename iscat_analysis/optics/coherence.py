"""Light that is not one plane wave of one wavelength: a cone of illumination, and a spectrum.

A cone.  Every point of the lamp in the illumination's aperture makes a plane wave exp(iq·r) of its
own, and waves of different points do not interfere.  The reference carries exp(iq·r) to the camera;
the particle is driven with exp(iq·r_p), and its light is the field of physics.md.  With Δ the place
on the camera relative to the particle, the interference has the factor exp(−iq·Δ).  Its average
over a disc of illumination that is filled evenly, |q| ≤ κ = k·illumination_na, is

    C(Δ) = 2 J_1(κΔ)/(κΔ),        s = 2ρ a Re [C e_u] + a² (|e_u|² + |e_v|²):

the interference fades away from the particle, the scattered light itself does not.  Neglected, all
of second order in the angle: the phase k·d·(1 − cos) of the reference over the defocus d (1 % of a
turn at NA 0.1 and 1 µm), the same over the height, and how reflection and polarisation change.

The kernels take a field e and give 2ρ a Re e_0 + a² Σ|e_c|².  With e_0 = C e_u this lacks
(1 − C²)|e_u|², which two more components give, h_x e_u and h_y e_u, h = (Δ/|Δ|)·√(1 − C²): smooth,
because 1 − C² begins with (κΔ/2)².

A spectrum.  Waves of different wavelength do not interfere either: fields and their squares are
averaged over a normal spectrum of the full width at half maximum `bandwidth_nm`, by three nodes of
Gauss and Hermite.  The average of the square exceeds the square of the average by the variance of
the field, (σ ∂e/∂λ)², another component.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from iscat_analysis.config import Optics

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FWHM = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a normal distribution over its standard deviation."""

_NODES = math.sqrt(3.0)  # places of the outer nodes, in standard deviations
_SHARES = (1 / 6, 2 / 3, 1 / 6)
_DIFFERENCE = 1 / (2 * _NODES)  # weight of the outer nodes in σ ∂e/∂λ
_SMALL = 1e-3  # of κΔ, below which the first terms of series are exact


@dataclass(frozen=True)
class Cone:
    """A cone of illumination, κ its largest wavenumber across the axis [rad/nm]."""

    kappa: float = 0.0

    def added(self, fields: FloatArray, x_nm: FloatArray, y_nm: FloatArray) -> FloatArray:
        """Give the components of fields behind such illumination.

        Shapes: `fields` (n, components, 2, *points), `x_nm, y_nm` broadcast to points.
        """
        if not self.kappa:
            return fields
        turn = self.kappa * np.hypot(x_nm, y_nm)
        far = np.maximum(turn, _SMALL)
        coherence = np.where(turn > _SMALL, 2 * j1(far) / far, 1 - turn**2 / 8)
        lost = np.sqrt(np.maximum(1 - (2 * j1(far) / far) ** 2, 0.0)) / far
        across = np.stack([coherence, *(self.kappa * lost * axis for axis in (x_nm, y_nm))])
        along = fields[:, :1] * across[None, :, None]
        return np.concatenate([along[:, :1], fields[:, 1:], along[:, 1:]], axis=1)

    @property
    def components(self) -> int:
        """How many components it adds to a field."""
        return 2 if self.kappa else 0


class Ray(NamedTuple):
    """Light of one wavelength in the pupil: components by angle and azimuth, and their weights."""

    waves: ComplexArray
    weight: ComplexArray
    axial: ComplexArray
    transverse: FloatArray


def cone_of(optics: Optics) -> Cone:
    """Give the cone of illumination of optics."""
    return Cone(2 * math.pi / optics.wavelength_nm * optics.illumination_na)


def is_coherent(optics: Optics) -> bool:
    """Whether the light is one plane wave of one wavelength."""
    return not optics.illumination_na and not optics.bandwidth_nm


def band_of(optics: Optics) -> float:
    """Largest wavenumber across the axis of what interferes [rad/nm]."""
    shortest = min(each.wavelength_nm for each in spectrum(optics))
    return 2 * math.pi / shortest * (optics.na + optics.illumination_na)


def spectrum(optics: Optics) -> list[Optics]:
    """Give optics at the wavelengths of their spectrum, the middle one first."""
    far = _NODES * optics.bandwidth_nm / FWHM
    places = (0.0, -far, far) if far else (0.0,)
    return [
        optics.model_copy(update={"wavelength_nm": optics.wavelength_nm + place})
        for place in places
    ]


def factor_at(factor: complex, optics: Optics, middle: Optics) -> complex:
    """Factor of the field at a wavelength: a dipole radiates k², and its far field has another k.

    The material is that of the wavelength in the middle.
    """
    return factor * (middle.wavelength_nm / optics.wavelength_nm) ** 3


def over_spectrum(rays: Sequence[Ray]) -> Ray:
    """Put the light of all wavelengths of `spectrum` together, with the component it adds.

    Shapes: `waves` of a ray (n, components, angles, azimuths).
    """
    if len(rays) == 1:
        return rays[0]
    shares = (_SHARES[1], _SHARES[0], _SHARES[2])
    signs = (0.0, -_DIFFERENCE, _DIFFERENCE)
    waves = [
        np.concatenate([ray.waves, sign / share * ray.waves[:, :1]], axis=1)
        for ray, share, sign in zip(rays, shares, signs, strict=True)
    ]
    weight = [share * ray.weight for ray, share in zip(rays, shares, strict=True)]
    return Ray(
        np.concatenate(waves, axis=2),
        np.concatenate(weight),
        np.concatenate([ray.axial for ray in rays]),
        np.concatenate([ray.transverse for ray in rays]),
    )
