"""The pupil of the microscope and its effect on the scattered light (microscope.md, section 2).

Polarisation, analyser, mask, aberrations and the phase of the reference are evaluated on a
quadrature of polar angles θ and azimuths φ; the field is computed from a Fourier series along φ.

Light that is not one plane wave of one wavelength: a cone of illumination, and a spectrum.

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
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import j1

from iscat_analysis._kernels.pupil import Pupil, gauss_legendre, make_pupil, orders, zernike
from iscat_analysis.config import Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.scatterers import Rod, Sphere
from iscat_analysis.records import ComplexArray, FloatArray

NEAR_CRITICAL = 0.98
"""NA over n_sample above which the quadrature treats the critical angle."""

NEGLIGIBLE = 1e-8
"""Share of the pupil's light amplitude below which azimuthal harmonics are left out."""

_FEWEST_AZIMUTHS, _MOST_AZIMUTHS = 64, 1024


@dataclass(frozen=True)
class Aperture:
    """A pupil on a quadrature; build it with `aperture`."""

    optics: Optics
    pupil: Pupil
    scatterer: Sphere | Rod | None = None

    @property
    def wavenumber(self) -> float:
        """2π over the vacuum wavelength [rad/nm]."""
        return 2 * math.pi / self.optics.wavelength_nm

    @property
    def rho(self) -> FloatArray:
        """Radius in the pupil, 1 at its edge, shape (n,)."""
        return self.optics.n_immersion * np.sin(self.pupil.theta) / self.optics.na

    @property
    def is_round(self) -> bool:
        """Whether neither an aberration nor the particle depends on the azimuth."""
        return not isinstance(self.scatterer, Rod) and all(orders(j)[1] == 0 for j, _ in self.terms)

    @property
    def terms(self) -> tuple[tuple[int, float], ...]:
        """Noll's index and size [nm] of every aberration."""
        return tuple((int(k[1:]), v) for k, v in self.optics.aberrations_nm.items() if v)

    @property
    def transmission(self) -> FloatArray:
        """Amplitude that the mask lets through, shape (n,)."""
        inside = self.optics.n_immersion * np.sin(self.pupil.theta) < self.optics.mask_na
        return np.where(inside, self.optics.attenuation, 1.0)

    def paths_nm(self, phi: FloatArray) -> FloatArray:
        """Aberration W and ∂W/∂ρ [nm], shape (2, n, phi.size)."""
        total = np.zeros((2, self.pupil.theta.size, phi.size))
        for j, size in self.terms:
            total += size * np.array(zernike(j, self.rho[:, None], phi))
        return total

    def polarised(self, phi: FloatArray) -> ComplexArray:
        """Wave without aberrations: components along the reference's polarisation and across it.

        Shapes: `phi` (m,), result (2, n, m).
        """
        if isinstance(self.scatterer, Rod):
            return self._of_dipole(phi, self.scatterer.dipole(self.optics))
        p, s = self.pupil.t_p_cos[:, None], self.pupil.t_s[:, None]
        if self.optics.polarization == "circular":
            return np.stack([(p + s) / 2 * np.ones(phi.size), (p - s) / 2 * np.exp(2j * phi)])
        turned = phi - math.radians(self.optics.polarization_deg)
        c, d = np.cos(turned), np.sin(turned)
        return np.stack([p * c**2 + s * d**2, (p - s) * (c * d)])

    def _of_dipole(self, phi: FloatArray, dipole: ComplexArray) -> ComplexArray:
        """Wave of a dipole along the polarisation, across it and along the optical axis.

        Shapes: `phi` (m,), `dipole` (3,), result (2, n, m).
        """
        if self.optics.polarization == "circular":
            meridian = np.exp(np.multiply.outer([-1j, 1j], phi)) / math.sqrt(2)
        else:
            turned = phi - math.radians(self.optics.polarization_deg)
            meridian = np.stack([np.cos(turned), np.sin(turned)]).astype(complex)
        p, s, q = (
            part[:, None] for part in (self.pupil.t_p_cos, self.pupil.t_s, self.pupil.t_p_sin)
        )
        radial = meridian.conj().T @ dipole[:2]
        across = s[None] * (dipole[:2, None, None] - meridian[:, None] * radial)
        return np.asarray(across + meridian[:, None] * (p * radial + q * dipole[2]))

    def turning(self, phi: FloatArray, name: str) -> ComplexArray:
        """Slope of `polarised` along an angle [1/degree], shape (2, n, m).

        It is the angle of linear polarisation, for round particles, or one of a rod.
        """
        if isinstance(self.scatterer, Rod):
            return self._of_dipole(phi, self.scatterer.dipole_slope(self.optics, name))
        difference = (self.pupil.t_p_cos - self.pupil.t_s)[:, None]
        turned = 2 * (phi - math.radians(self.optics.polarization_deg))
        slope = np.stack([difference * np.sin(turned), -difference * np.cos(turned)])
        return np.asarray(slope * math.radians(1.0))

    def seen(self, phi: FloatArray, *, masked: bool = True, along: str = "") -> ComplexArray:
        """Components that reach the camera, with mask and aberrations, or their slopes `along`.

        Shapes: result (1 or 2, n, m).
        """
        whole = self.turning(phi, along) if along else self.polarised(phi)
        components = whole[: 1 if self.optics.analyzer else 2]
        wave: ComplexArray = components * np.exp(1j * self.wavenumber * self.paths_nm(phi)[0])
        return wave * self.transmission[:, None] if masked else wave

    def azimuths(self) -> FloatArray:
        """Azimuths that resolve the pupil's finest harmonic, equally spaced from 0 [rad]."""
        count = _FEWEST_AZIMUTHS
        while True:
            phi: FloatArray = np.arange(count, dtype=np.float64) * (2 * math.pi / count)
            size = np.abs(np.fft.fft(self.seen(phi), axis=2)).sum((0, 1))
            fine = size[count // 4 : -(count // 4)]
            if fine.max() < NEGLIGIBLE * size.sum():
                return phi
            count *= 2
            if count > _MOST_AZIMUTHS:
                raise ConfigError(
                    "optics.aberrations_nm: these terms turn the phase too fast across the pupil "
                    "to be computed; lower them"
                )


def harmonics(
    waves: ComplexArray, weight: FloatArray, negligible: float = NEGLIGIBLE
) -> ComplexArray:
    """Fourier series along the azimuth, as far as it is not negligible.

    Shapes: `waves` (k, n, m), `weight` (n,), result (k, 2·M + 1, n).
    """
    series = np.fft.fft(waves, axis=2) / waves.shape[2]
    size = (np.abs(series) * weight[:, None]).sum(1)
    half = waves.shape[2] // 2 - 1
    both = np.maximum(size[:, 1 : half + 1], size[:, : -half - 1 : -1])
    kept = np.nonzero((both > negligible * size.sum(1, keepdims=True)).any(0))[0]
    largest = int(kept[-1]) + 1 if kept.size else 0
    order = np.arange(-largest, largest + 1)
    return np.ascontiguousarray(np.moveaxis(series[:, :, order], 2, 1))


def critical_angle(optics: Optics) -> float | None:
    """Return the angle in the oil at which light grazes the sample."""
    near = NEAR_CRITICAL * optics.n_sample < optics.na and optics.n_sample < optics.n_immersion
    return math.asin(optics.n_sample / optics.n_immersion) if near else None


def aperture_on(
    optics: Optics, theta: FloatArray, weight: FloatArray, scatterer: Sphere | Rod | None = None
) -> Aperture:
    """Make the pupil on given angles, with the light of a dipole, a sphere or a rod.

    Shapes: `theta, weight` (n,).
    """
    wavenumber, direction = 2 * math.pi / optics.wavelength_nm, optics.direction
    pupil = make_pupil(
        theta,
        weight,
        wavenumber=wavenumber,
        n_immersion=optics.n_immersion,
        n_glass=optics.n_glass,
        n_sample=optics.n_sample,
        direction=direction,
        reciprocal=optics.emission == "reciprocal",
    )
    if isinstance(scatterer, Sphere):
        cos_s = pupil.axial / (wavenumber * optics.n_sample) - direction
        along, across = scatterer.pattern(cos_s, direction, optics.n_sample, wavenumber)
        pupil = replace(pupil, t_p_cos=pupil.t_p_cos / cos_s * along, t_s=pupil.t_s * across)
    return Aperture(optics, pupil, scatterer)


def aperture(
    optics: Optics, nodes: int, nodes_above: int, scatterer: Sphere | Rod | None = None
) -> Aperture:
    """Make the pupil on panels that end at the mask's edge and at the critical angle."""
    alpha = math.asin(optics.na / optics.n_immersion)
    edge = math.asin(optics.mask_na / optics.n_immersion)
    theta, weight = gauss_legendre(alpha, critical_angle(optics), nodes, nodes_above, edge)
    return aperture_on(optics, theta, weight, scatterer)


def weight_on(
    opening: Aperture, factor: complex, oil_nm: float
) -> tuple[ComplexArray, ComplexArray]:
    """Weigh the components in the field's integral at z = 0, and give the phase per height.

    Shapes: `weight, axial` (n,).
    """
    optics, pupil = opening.optics, opening.pupil
    axial = pupil.axial
    if optics.axial == "refocus":
        axial = axial + (1 - optics.n_immersion / optics.n_sample) * pupil.oil
    weight = pupil.weight * pupil.apodization * np.exp(1j * pupil.oil * oil_nm) * factor
    return weight, axial


FWHM = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a normal distribution over its standard deviation."""

_NODES = math.sqrt(3.0)  # places of the outer nodes, in standard deviations
_SHARES = (1 / 6, 2 / 3, 1 / 6)
_DIFFERENCE = 1 / (2 * _NODES)  # weight of the outer nodes in σ ∂e/∂λ
_SMALL = 1e-3  # of κΔ, below which the first terms of series are exact


def in_cone(fields: FloatArray, kappa: float, x_nm: FloatArray, y_nm: FloatArray) -> FloatArray:
    """Give the components of fields whose light is a cone, κ its largest wavenumber [rad/nm].

    Shapes: `fields` (n, components, 2, *points), `x_nm, y_nm` broadcast to points.
    """
    if not kappa:
        return fields
    turn = kappa * np.hypot(x_nm, y_nm)
    far = np.maximum(turn, _SMALL)
    coherence = np.where(turn > _SMALL, 2 * j1(far) / far, 1 - turn**2 / 8)
    lost = np.sqrt(np.maximum(1 - (2 * j1(far) / far) ** 2, 0.0)) / far
    across = np.stack([coherence, *(kappa * lost * axis for axis in (x_nm, y_nm))])
    along = fields[:, :1] * across[None, :, None]
    return np.concatenate([along[:, :1], fields[:, 1:], along[:, 1:]], axis=1)


class Ray(NamedTuple):
    """Light of one wavelength in the pupil: components by angle and azimuth, and their weights."""

    waves: ComplexArray
    weight: ComplexArray
    axial: ComplexArray
    transverse: FloatArray


def cone_of(optics: Optics) -> float:
    """Give the largest wavenumber across the axis of the illumination [rad/nm]."""
    return 2 * math.pi / optics.wavelength_nm * optics.illumination_na


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
