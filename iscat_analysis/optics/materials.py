"""Refractive indices of the particles, with their sources.

Gold: P. B. Johnson and R. W. Christy, Phys. Rev. B 6, 4370 (1972), n and k against photon energy,
interpolated linearly in vacuum wavelength.  Silica: I. H. Malitson, J. Opt. Soc. Am. 55, 1205
(1965).  Polystyrene: N. Sultanova, S. Kasarova and I. Nikolov, Acta Phys. Pol. A 116, 585 (2009).
Protein: index 1.46, the usual value in mass photometry.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iscat_analysis.config import Particle
from iscat_analysis.errors import ConfigError

_GOLD = np.array([
    [0.64, 0.92, 13.78], [0.77, 0.56, 11.21], [0.89, 0.43, 9.519], [1.02, 0.35, 8.145],
    [1.14, 0.27, 7.150], [1.26, 0.22, 6.350], [1.39, 0.17, 5.663], [1.51, 0.16, 5.083],
    [1.64, 0.14, 4.542], [1.76, 0.13, 4.103], [1.88, 0.14, 3.697], [2.01, 0.21, 3.272],
    [2.14, 0.29, 2.863], [2.26, 0.43, 2.455], [2.38, 0.62, 2.081], [2.50, 1.04, 1.833],
    [2.63, 1.31, 1.849], [2.75, 1.38, 1.914], [2.88, 1.45, 1.948], [3.00, 1.46, 1.958],
    [3.12, 1.47, 1.952], [3.25, 1.46, 1.933], [3.37, 1.48, 1.895], [3.50, 1.50, 1.866],
    [3.62, 1.48, 1.871], [3.74, 1.48, 1.883], [3.87, 1.54, 1.898], [3.99, 1.53, 1.893],
    [4.12, 1.53, 1.889], [4.24, 1.49, 1.878], [4.36, 1.47, 1.869], [4.49, 1.43, 1.847],
    [4.61, 1.38, 1.803], [4.74, 1.35, 1.749], [4.86, 1.33, 1.688], [4.98, 1.33, 1.631],
    [5.11, 1.32, 1.577], [5.23, 1.32, 1.536], [5.36, 1.30, 1.497], [5.48, 1.31, 1.460],
    [5.60, 1.30, 1.427], [5.73, 1.30, 1.387], [5.85, 1.30, 1.350], [5.98, 1.30, 1.304],
    [6.10, 1.33, 1.277], [6.22, 1.33, 1.251], [6.35, 1.34, 1.226], [6.47, 1.32, 1.203],
    [6.60, 1.28, 1.188],
])  # fmt: skip
"""Photon energy [eV], n, k."""

_EV_NM = 1239.841984


def _gold(wavelength_nm: float) -> complex:
    table = _GOLD[::-1]
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
