"""The refractive index of a particle whose light and whose size are both measured.

A small sphere of volume V scatters light in proportion to its polarisability (Bohren & Huffman,
Absorption and Scattering of Light by Small Particles, 1983, section 5.2)

    α = 3 V (n² − n_s²)/(n² + 2 n_s²) = 3 V L.

What light tells is α, here as a mass m of a known material: the contrast is that of V_m = m/ρ with
its L_m, or, with a calibration, that of a particle like the standards.  What motion tells is the
diameter d.  So L = L_m V_m/V_d, and

    n² = n_s² (1 + 2 L)/(1 − L),      dn/n = 3 dL/[2 (1 − L)(1 + 2 L)],
    (dL/L)² = (σ_m/m)² + (3 σ_d/d)²,

for the errors of the mass and of the diameter are independent: noise moves a fitted place as often
to either side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import LARGEST, number_in, real_array
from iscat_analysis.records import FloatArray
from iscat_analysis.units import KILODALTON_KG, NM

_LARGEST_INDEX = 10.0


def refractive_index(
    mass_kda: ArrayLike,
    diameter_nm: ArrayLike,
    *,
    sigma_mass_kda: ArrayLike = 0.0,
    sigma_diameter_nm: ArrayLike = 0.0,
    index: float = 1.46,
    density_kg_m3: float = 1350.0,
    n_medium: float = 1.33,
) -> tuple[FloatArray, FloatArray]:
    """Refractive index of spheres that scatter like a known mass and have a known diameter.

    Parameters
    ----------
    mass_kda : array_like
        Masses that the contrasts are, of the material below [kDa].
    diameter_nm : array_like
        Diameters, as of `hydrodynamic_diameter` [nm].
    sigma_mass_kda, sigma_diameter_nm : array_like
        Their standard errors [kDa, nm].
    index : float
        Refractive index of the material that the masses are of; default protein.
    density_kg_m3 : float
        Its density [kg/m³].
    n_medium : float
        Refractive index of the liquid.

    Returns
    -------
    index : ndarray
        NaN where no sphere of that diameter scatters as much, or the diameter is not finite.
    sigma : ndarray
        Its standard error, to first order.

    Raises
    ------
    ConfigError
        A refractive index or the density is not above zero, or the material scatters like the
        liquid.
    DataError
        A number is not real, or shapes do not go together.

    References
    ----------
    Bohren & Huffman, Absorption and Scattering of Light by Small Particles (1983), section 5.2.

    Examples
    --------
    >>> import iscat_analysis as ia
    >>> n, error = ia.refractive_index(150.0, 7.05, sigma_mass_kda=5.0, sigma_diameter_nm=0.2)
    >>> print(f"{n:.3f} ± {error:.3f}")
    1.460 ± 0.012
    """
    for name, value, most in (
        ("index", index, _LARGEST_INDEX),
        ("density_kg_m3", density_kg_m3, LARGEST),
        ("n_medium", n_medium, _LARGEST_INDEX),
    ):
        number_in(name, value, above=0.0, most=most)
    if index == n_medium:
        raise ConfigError(f"index = {index:g} is that of the medium: such particles are not seen")
    named = {
        "mass_kda": mass_kda,
        "diameter_nm": diameter_nm,
        "sigma_mass_kda": sigma_mass_kda,
        "sigma_diameter_nm": sigma_diameter_nm,
    }
    arrays = [real_array(name, value) for name, value in named.items()]
    for name, array in zip(named, arrays, strict=True):
        far = np.isfinite(array) & (np.abs(array) > LARGEST)  # D of 0 makes a diameter infinite
        wrong = array < 0 if name.startswith("sigma") else far
        if wrong.any():
            raise DataError(f"{name} = {array[wrong].flat[0]:g}: no particle has that; check it")
    try:
        mass, diameter, sigma_mass, sigma_diameter = np.broadcast_arrays(*arrays)
    except ValueError:
        raise DataError(f"{', '.join(named)}: have shapes that do not go together") from None
    contrast = (index**2 - n_medium**2) / (index**2 + 2 * n_medium**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        volume_nm3 = mass * (KILODALTON_KG / density_kg_m3 / NM**3)
        part = contrast * volume_nm3 / (np.pi / 6 * diameter**3)
        sized = (diameter > 0) & np.isfinite(diameter)
        usable = sized & np.isfinite(part) & (part < 1) & (part > -0.5)
        part = np.where(usable, part, np.nan)
        found = n_medium * np.sqrt((1 + 2 * part) / (1 - part))
        relative = np.hypot(sigma_mass / mass, 3 * sigma_diameter / diameter)
        sigma = found * 1.5 * np.abs(part) * relative / ((1 - part) * (1 + 2 * part))
    return np.asarray(found), np.asarray(sigma)
