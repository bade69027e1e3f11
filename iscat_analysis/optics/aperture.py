"""The pupil of the microscope and its effect on the scattered light (microscope.md, section 2).

Polarisation, analyser, mask, aberrations and the phase of the reference are evaluated on a
quadrature of polar angles θ and azimuths φ; the field is computed from a Fourier series along φ.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.pupil import Pupil, gauss_legendre, make_pupil
from iscat_analysis._kernels.zernike import orders, zernike
from iscat_analysis.config import Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.rods import Rod
from iscat_analysis.optics.spheres import Sphere

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

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

    def path_nm(self, phi: FloatArray) -> FloatArray:
        """Aberration W [nm], shape (n, phi.size)."""
        total = np.zeros((self.pupil.theta.size, phi.size))
        for j, size in self.terms:
            total += size * zernike(j, self.rho[:, None], phi)[0]
        return total

    def path_slope_nm(self, phi: FloatArray) -> FloatArray:
        """∂W/∂ρ [nm], shape (n, phi.size)."""
        total = np.zeros((self.pupil.theta.size, phi.size))
        for j, size in self.terms:
            total += size * zernike(j, self.rho[:, None], phi)[1]
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
        wave: ComplexArray = components * np.exp(1j * self.wavenumber * self.path_nm(phi))
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
    wavenumber, direction = 2 * math.pi / optics.wavelength_nm, _direction(optics)
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


def _direction(optics: Optics) -> float:
    """1 where the light that is scattered backwards is collected, −1 forwards."""
    return 1.0 if optics.scheme == "iscat" else -1.0


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
