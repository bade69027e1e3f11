"""Rods: spheroids whose dipole does not point along the light that hits them.

A prolate spheroid of the volume V, far smaller than the wavelength, has the polarisabilities

    α = V (ε − n_s²) / (n_s² + L (ε − n_s²))

along its axis, with L = (1 − e²)/e² (artanh(e)/e − 1), and across it, with (1 − L)/2, where
e² = 1 − 1/a² for the aspect ratio a (C. F. Bohren and D. R. Huffman, *Absorption and Scattering of
Light by Small Particles*, Wiley 1983, section 5.3).  With its axis u, the incident light E makes
the dipole

    p = α_across E + (α_along − α_across) u (u·E),    u = (sinθ cosφ, sinθ sinφ, cosθ),

θ the tilt from the optical axis and φ the azimuth from x towards y.  A tilted rod has a dipole
along the optical axis too, which the light does not have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Optics, Particle

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

ANGLES = ("azimuth_deg", "tilt_deg")
"""Names of the angles of a rod."""

_NEARLY_ROUND = 1e-4  # e² below which the series of L is exact to rounding


@dataclass(frozen=True)
class Rod:
    """A spheroid; its polarisabilities are over that of a sphere of the same volume."""

    along: complex
    across: complex
    azimuth_deg: float
    tilt_deg: float

    def turned(self, azimuth_deg: float, tilt_deg: float) -> Rod:
        """Give the same rod in another direction."""
        return replace(self, azimuth_deg=azimuth_deg, tilt_deg=tilt_deg)

    def dipole(self, optics: Optics) -> ComplexArray:
        """Give its dipole along the polarisation, across it and along the optical axis, (3,)."""
        basis, axis = _basis(optics), self._axis()
        excess = (self.along - self.across) * axis * (axis @ basis[0])
        return np.asarray(basis.conj() @ (self.across * basis[0] + excess))

    def dipole_slope(self, optics: Optics, name: str) -> ComplexArray:
        """Give the slope of `dipole` along one of `ANGLES` [1/degree], shape (3,)."""
        basis, axis, slope = _basis(optics), self._axis(), self._axis_slope(name)
        excess = slope * (axis @ basis[0]) + axis * (slope @ basis[0])
        return np.asarray(basis.conj() @ ((self.along - self.across) * excess))

    def _axis(self) -> FloatArray:
        azimuth, tilt = math.radians(self.azimuth_deg), math.radians(self.tilt_deg)
        flat = math.sin(tilt)
        return np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.cos(tilt)])

    def _axis_slope(self, name: str) -> FloatArray:
        x, y, z = self._axis()
        if name == "azimuth_deg":
            return math.radians(1.0) * np.array([-y, x, 0.0])
        azimuth, flat = math.radians(self.azimuth_deg), math.sin(math.radians(self.tilt_deg))
        return math.radians(1.0) * np.array([z * math.cos(azimuth), z * math.sin(azimuth), -flat])


def rod_of(particle: Particle, permittivity: complex, n_sample: float) -> Rod | None:
    """Make the rod of a configuration; None where it is none."""
    if particle.aspect_ratio is None:
        return None
    excess = permittivity / n_sample**2 - 1
    factor = depolarisation(particle.aspect_ratio)
    return Rod(
        along=(1 + excess / 3) / (1 + factor * excess),
        across=(1 + excess / 3) / (1 + (1 - factor) / 2 * excess),
        azimuth_deg=particle.azimuth_deg or 0.0,
        tilt_deg=particle.tilt_deg or 0.0,
    )


def depolarisation(aspect_ratio: float) -> float:
    """Give the depolarisation factor along the axis of a prolate spheroid."""
    square = 1 - aspect_ratio**-2
    if square < _NEARLY_ROUND:
        return (1 - square) * (1 / 3 + square / 5 + square**2 / 7 + square**3 / 9)
    eccentricity = math.sqrt(square)
    return (1 - square) / square * (math.atanh(eccentricity) / eccentricity - 1)


def _basis(optics: Optics) -> ComplexArray:
    """Give unit vectors along the polarisation, across it and along the axis of light, as rows."""
    if optics.polarization == "circular":
        return np.array(
            [[1, 1j, 0], [1, -1j, 0], [0, 0, math.sqrt(2)]], dtype=np.complex128
        ) * math.sqrt(0.5)
    c, s = (f(math.radians(optics.polarization_deg)) for f in (math.cos, math.sin))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=np.complex128)
