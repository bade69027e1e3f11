"""Light that a sphere scatters, in place of a dipole: Mie's amplitudes in the pupil.

A plane wave of unit amplitude, with the wavenumber k_s = n_s k of the sample, makes the far field

    E = e^{i k_s r}/(−i k_s r) · (S₂ E_∥ , S₁ E_⊥)

along and across the plane of the incident and the scattered ray (C. F. Bohren and D. R. Huffman,
*Absorption and Scattering of Light by Small Particles*, Wiley 1983, chapters 4 and 8), with

    S₁ = Σ (2n+1)/(n(n+1)) (a_n π_n + b_n τ_n),    S₂ = Σ (2n+1)/(n(n+1)) (a_n τ_n + b_n π_n).

π_n and τ_n are polynomials in μ = cos Θ, Θ the angle between the two rays: μ = −cos θ_s in iSCAT,
which collects what is scattered backwards, and μ = cos θ_s in COBRI and dark field.  Beyond the
critical angle cos θ_s is imaginary, and the polynomials continue the amplitudes to evanescent
waves.

A small sphere of radius a has S₁ = −i x³ (m² − 1)/(m² + 2), x = k_s a, and S₂ = μ S₁: a dipole of
polarisability 4π a³ (m² − 1)/(m² + 2).  The pattern here is i S/x³, which is the last factor for
small spheres, so that the field is 3V times this pattern.

The coefficients a_n and b_n come from libraries: `miepython` for a sphere, `scattnlay` for one with
a shell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Optics, Particle
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.memoize import memoize
from iscat_analysis.units import sphere_diameter_nm, sphere_mass_kda

ComplexArray = NDArray[np.complex128]
Coefficients = tuple[ComplexArray, ComplexArray]

SMALLEST_NM = 0.2
"""Diameter below which every sphere has the pattern of this one, a dipole to 1e-5 at most."""

_MORE_ORDERS = 4  # than the usual number: evanescent waves need some more
_KEPT = 512  # coefficients of spheres


@dataclass(frozen=True)
class Sphere:
    """A sphere of one density, perhaps with a shell of another index."""

    mass_kda: float
    density_kg_m3: float
    index: complex
    shell_nm: float = 0.0
    shell_index: float = 0.0

    @property
    def diameter_nm(self) -> float:
        """Outer diameter [nm]."""
        return sphere_diameter_nm(self.mass_kda, self.density_kg_m3)

    def of_mass(self, mass_kda: float) -> Sphere:
        """Give a sphere of the same matter and shell with another mass."""
        least = sphere_mass_kda(max(SMALLEST_NM, 2 * self.shell_nm), self.density_kg_m3)
        return replace(self, mass_kda=max(abs(mass_kda), least))

    def homogeneous(self) -> Sphere:
        """Give the sphere without a shell that scatters as much while both are small.

        A shell around a core with the share f of the volume makes their permittivities ε₁ (core)
        and ε₂ act as one (Bohren and Huffman, section 5.4)

            ε = ε₂ (ε₁ + 2 ε₂ + 2 f (ε₁ − ε₂))/(ε₁ + 2 ε₂ − f (ε₁ − ε₂)).
        """
        if not self.shell_nm:
            return self
        share = max(1 - 2 * self.shell_nm / self.diameter_nm, 0.0) ** 3
        core, shell = self.index**2, self.shell_index**2
        both, apart = core + 2 * shell, share * (core - shell)
        index = complex(np.sqrt(shell * (both + 2 * apart) / (both - apart)))
        return replace(self, index=index, shell_nm=0.0, shell_index=0.0)

    def pattern(
        self, cos_s: ComplexArray, direction: float, n_sample: float, wavenumber: float
    ) -> tuple[ComplexArray, ComplexArray]:
        """Amplitudes along and across the plane of scattering, a unit dipole's being cosθ_s and 1.

        `direction` is 1 for light that is scattered backwards, and −1 forwards.

        Shapes: `cos_s` (n,), results (n,).
        """
        k = n_sample * wavenumber
        x = k * self.diameter_nm / 2
        core = x - k * self.shell_nm
        s1, s2 = amplitudes(
            coefficients(
                x,
                core,
                self.index / n_sample,
                self.shell_index / n_sample if self.shell_nm else 0.0,
            ),
            -direction * cos_s,
        )
        unit = 1j / x**3
        return -direction * unit * s2, unit * s1


def scattering_length_nm(sphere: Sphere, optics: Optics) -> float:
    """Cube root of the light that a sphere scatters along the axis, d |pattern|^(1/3) [nm].

    Of a small sphere it is d ((m² − 1)/(m² + 2))^(1/3), in proportion to the diameter.
    """
    direction = 1.0 if optics.scheme == "iscat" else -1.0
    along = sphere.pattern(
        np.ones(1, dtype=complex), direction, optics.n_sample, 2 * np.pi / optics.wavelength_nm
    )[1]
    return float(sphere.diameter_nm * np.cbrt(abs(along[0])))


def sphere_of(particle: Particle, permittivity: complex, mass_kda: float) -> Sphere | None:
    """Make the sphere of a configuration; None where it is a dipole."""
    if not particle.is_sphere:
        return None
    return Sphere(
        mass_kda=mass_kda,
        density_kg_m3=particle.density,
        index=complex(np.sqrt(complex(permittivity))),
        shell_nm=particle.shell_nm or 0.0,
        shell_index=particle.shell_index or 0.0,
    )


def has_shells() -> bool:
    """Tell whether the library for spheres with a shell is installed."""
    return find_spec("scattnlay") is not None


def amplitudes(orders: Coefficients, mu: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Sum S₁ and S₂ at cosines of the angle of scattering, real or complex.

    Shapes: `mu` (n,), results (n,).
    """
    s1, s2 = np.zeros((2, *np.shape(mu)), dtype=np.complex128)
    before, here = np.zeros_like(s1), np.ones_like(s1)
    for n, (a, b) in enumerate(zip(*orders, strict=True), start=1):
        slope = n * mu * here - (n + 1) * before
        share = (2 * n + 1) / (n * (n + 1))
        s1 += share * (a * here + b * slope)
        s2 += share * (a * slope + b * here)
        before, here = here, ((2 * n + 1) * mu * here - (n + 1) * before) / n
    return s1, s2


def _coefficients(x: float, core: float, m: complex, shell: float) -> Coefficients:
    """Compute Mie's coefficients for the size x, that of the core, and the indices of both."""
    count = int(x + 4.05 * x ** (1 / 3) + 2) + _MORE_ORDERS
    if not shell:
        from miepython import an_bn

        # the library has the other sign of time in the index, and not in its coefficients
        a, b = an_bn(np.conj(np.complex128(m)), x, count)
        return np.asarray(a), np.asarray(b)
    try:
        from scattnlay import scattcoeffs
    except ImportError:
        raise ConfigError(
            'particle.model = "shell" needs scattnlay: pip install "iscat-analysis[shell]"'
        ) from None
    layers = [(core, m), (x, shell)] if core > 0 else [(x, shell)]
    sizes, indices = zip(*layers, strict=True)
    _, a, b, *_ = scattcoeffs(np.array(sizes), np.array(indices, dtype=complex), count)
    return np.ravel(a), np.ravel(b)


coefficients = memoize(_KEPT, _coefficients)
"""Mie's coefficients a_n and b_n; the last ones are kept."""
