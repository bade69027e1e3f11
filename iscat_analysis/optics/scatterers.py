"""What particles are: their refractive indices, spheres and shells, and rods.

Gold: P. B. Johnson and R. W. Christy, Phys. Rev. B 6, 4370 (1972), n and k against photon energy,
interpolated linearly in vacuum wavelength.  Silica: I. H. Malitson, J. Opt. Soc. Am. 55, 1205
(1965).  Polystyrene: N. Sultanova, S. Kasarova and I. Nikolov, Acta Phys. Pol. A 116, 585 (2009).
Protein: index 1.46, the usual value in mass photometry.

Light that a sphere scatters, in place of a dipole: Mie's amplitudes in the pupil.

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

Rods: spheroids whose dipole does not point along the light that hits them.

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
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np

from iscat_analysis.config import Optics, Particle
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import memoize
from iscat_analysis.records import ComplexArray, FloatArray
from iscat_analysis.units import sphere_diameter_nm, sphere_mass_kda

_GOLD = """
0.64 0.92 13.78   0.77 0.56 11.21   0.89 0.43 9.519   1.02 0.35 8.145   1.14 0.27 7.150
1.26 0.22 6.350   1.39 0.17 5.663   1.51 0.16 5.083   1.64 0.14 4.542   1.76 0.13 4.103
1.88 0.14 3.697   2.01 0.21 3.272   2.14 0.29 2.863   2.26 0.43 2.455   2.38 0.62 2.081
2.50 1.04 1.833   2.63 1.31 1.849   2.75 1.38 1.914   2.88 1.45 1.948   3.00 1.46 1.958
3.12 1.47 1.952   3.25 1.46 1.933   3.37 1.48 1.895   3.50 1.50 1.866   3.62 1.48 1.871
3.74 1.48 1.883   3.87 1.54 1.898   3.99 1.53 1.893   4.12 1.53 1.889   4.24 1.49 1.878
4.36 1.47 1.869   4.49 1.43 1.847   4.61 1.38 1.803   4.74 1.35 1.749   4.86 1.33 1.688
4.98 1.33 1.631   5.11 1.32 1.577   5.23 1.32 1.536   5.36 1.30 1.497   5.48 1.31 1.460
5.60 1.30 1.427   5.73 1.30 1.387   5.85 1.30 1.350   5.98 1.30 1.304   6.10 1.33 1.277
6.22 1.33 1.251   6.35 1.34 1.226   6.47 1.32 1.203   6.60 1.28 1.188
"""
"""Photon energy [eV], n, k."""

_EV_NM = 1239.841984


def _gold(wavelength_nm: float) -> complex:
    table = np.array(_GOLD.split(), dtype=float).reshape(-1, 3)[::-1]
    wavelengths = _EV_NM / table[:, 0]
    _inside("gold", wavelength_nm, wavelengths[0], wavelengths[-1])
    n = np.interp(wavelength_nm, wavelengths, table[:, 1])
    k = np.interp(wavelength_nm, wavelengths, table[:, 2])
    return complex(n, k)


def _silica(wavelength_nm: float) -> complex:
    _inside("silica", wavelength_nm, 210, 3700)
    l2 = (wavelength_nm / 1000) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return complex(math.sqrt(1 + sum(b * l2 / (l2 - c**2) for b, c in terms)))


def _polystyrene(wavelength_nm: float) -> complex:
    _inside("polystyrene", wavelength_nm, 350, 1100)
    l2 = (wavelength_nm / 1000) ** 2
    return complex(math.sqrt(1 + 1.4435 * l2 / (l2 - 0.020216)))


def _inside(kind: str, wavelength_nm: float, low: float, high: float) -> None:
    if not low <= wavelength_nm <= high:
        raise ConfigError(
            f"optics.wavelength_nm = {wavelength_nm:g} lies outside the {kind} table "
            f"({low:.0f}–{high:.0f} nm): give particle.permittivity"
        )


_INDICES: dict[str, Callable[[float], complex]] = {
    "gold": _gold,
    "silica": _silica,
    "polystyrene": _polystyrene,
    "protein": lambda _: 1.46 + 0j,
}


@dataclass(frozen=True)
class Material:
    """Properties of a particle that determine its scattering."""

    permittivity: complex
    density_kg_m3: float
    mass_kda: float


def material(particle: Particle, wavelength_nm: float) -> Material:
    """Resolve a particle of the configuration at a wavelength."""
    index = _INDICES.get(particle.kind)
    if particle.permittivity is not None:
        permittivity = complex(*particle.permittivity)
    elif particle.index is not None:
        permittivity = complex(particle.index**2)
    elif index is not None:
        permittivity = index(wavelength_nm) ** 2
    else:
        raise ConfigError('particle.kind = "custom" needs permittivity or index')
    return Material(permittivity, particle.density, particle.nominal_mass_kda)


Coefficients = tuple[ComplexArray, ComplexArray]

SMALLEST_NM = 0.2
"""Diameter below which every sphere has the pattern of this one, a dipole to 1e-5 at most."""


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
    along = sphere.pattern(
        np.ones(1, dtype=complex),
        optics.direction,
        optics.n_sample,
        2 * np.pi / optics.wavelength_nm,
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
    # four more than the usual number, for evanescent waves
    count = int(x + 4.05 * x ** (1 / 3) + 2) + 4
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


coefficients = memoize(512, _coefficients)
"""Mie's coefficients a_n and b_n; the last ones are kept."""


ANGLES = ("azimuth_deg", "tilt_deg")
"""Names of the angles of a rod."""


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
    # the series is exact to rounding
    if square < 1e-4:
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
