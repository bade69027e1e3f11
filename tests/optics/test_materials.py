"""Refractive indices, densities and masses against published numbers."""

from __future__ import annotations

import cmath

import pytest

from iscat_analysis.config import Particle
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.scatterers import material
from iscat_analysis.units import sphere_mass_kda

_EV_NM = 1239.841984


def _index(wavelength_nm: float, **particle: object) -> complex:
    return cmath.sqrt(material(Particle(**particle), wavelength_nm).permittivity)


@pytest.mark.parametrize(
    ("energy_ev", "index"),
    [(1.88, 0.14 + 3.697j), (2.14, 0.29 + 2.863j), (2.26, 0.43 + 2.455j), (2.38, 0.62 + 2.081j),
     (3.00, 1.46 + 1.958j)],
)  # fmt: skip
def test_gold_is_johnson_and_christys(energy_ev: float, index: complex) -> None:
    assert _index(_EV_NM / energy_ev, kind="gold") == pytest.approx(index, abs=1e-9)


def test_gold_is_interpolated_in_wavelength() -> None:
    blue, red = _EV_NM / 2.38, _EV_NM / 2.26
    middle = _index((blue + red) / 2, kind="gold")
    assert middle == pytest.approx(((0.62 + 0.43) + (2.081 + 2.455) * 1j) / 2, abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "wavelength_nm", "index", "tolerance"),
    [
        ("silica", 587.6, 1.45846, 1e-5),  # Malitson's table, sodium and helium lines
        ("silica", 486.1, 1.46313, 1e-5),
        ("polystyrene", 587.6, 1.5917, 2e-3),  # Sultanova's own measurement beside the fit
        ("protein", 525.0, 1.46, 1e-12),
    ],
)
def test_dielectrics(kind: str, wavelength_nm: float, index: float, tolerance: float) -> None:
    found = _index(wavelength_nm, kind=kind)
    assert found.imag == pytest.approx(0, abs=1e-12)
    assert found.real == pytest.approx(index, abs=tolerance)


@pytest.mark.parametrize("kind", ["gold", "silica", "polystyrene"])
def test_outside_the_table_is_refused(kind: str) -> None:
    with pytest.raises(ConfigError, match=r"5000 lies outside.*particle\.permittivity"):
        material(Particle(kind=kind), 5000.0)
    own = material(Particle(kind=kind, permittivity=(2.0, 0.5)), 5000.0)
    assert own.permittivity == 2 + 0.5j


@pytest.mark.parametrize(
    ("kind", "density"),
    [("gold", 19300.0), ("silica", 2200.0), ("polystyrene", 1050.0), ("protein", 1350.0)],
)
def test_densities(kind: str, density: float) -> None:
    assert material(Particle(kind=kind), 525.0).density_kg_m3 == density
    assert material(Particle(kind=kind, density_kg_m3=999.0), 525.0).density_kg_m3 == 999.0


def test_the_mass_of_a_sphere() -> None:
    # 20 nm gold: 4/3·π·10³ nm³ × 19.3 g/cm³ = 8.0844e-17 g = 48 685 kDa.
    assert material(Particle(kind="gold", diameter_nm=20.0), 525.0).mass_kda == pytest.approx(
        8.08436e-17 / 1.66053907e-21, rel=1e-5
    )
    # Serum albumin: 66.5 kDa at 1350 kg/m³ fills 81.8 nm³.
    assert sphere_mass_kda(5.386, 1350.0) == pytest.approx(66.5, abs=0.05)


def test_custom_particles_give_everything() -> None:
    found = material(Particle(kind="custom", index=1.5, density_kg_m3=1200.0, mass_kda=70.0), 525.0)
    assert found.permittivity == pytest.approx(2.25)
    assert (found.density_kg_m3, found.mass_kda) == (1200.0, 70.0)
