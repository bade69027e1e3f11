"""Diameter and refractive index of a sphere from one picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import iscat_analysis as ia
from iscat_analysis.inference.common_size import IndexFit, fit_index
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.optics.scatterers import material
from iscat_analysis.pieces.counts import config_of, gather
from iscat_analysis.records import Candidate, FitResult, Status
from iscat_analysis.units import sphere_mass_kda

OPTICS = ia.Optics(wavelength_nm=525.0, na=1.42, focus_nm=0.0)
CAMERA = ia.Camera(pixel_size_nm=90.0)
Z_RANGE_NM = (0.0, 250.0)
DENSITY = 2200.0


def silica(diameter_nm: float) -> ia.Particle:
    """Make a silica sphere."""
    return ia.Particle(kind="silica", model="mie", diameter_nm=diameter_nm)


INDEX = float(np.sqrt(material(silica(100.0), 525.0).permittivity).real)


def fits_of(
    diameter_nm: float, light_e: float, index: float, n: int, seed: int
) -> list[tuple[FitResult, IndexFit]]:
    """Fit silica spheres on the coverslip that are taken for ones of another index."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-40.0, 40.0, (2, n))
    pictures = ia.psf(
        OPTICS, silica(diameter_nm), CAMERA, pixels=23, x_nm=places[0], y_nm=places[1],
        z_nm=np.full(n, diameter_nm / 2),
    )  # fmt: skip
    before = rng.poisson(np.full(pictures.shape, light_e))
    after = rng.poisson(light_e * (1 + pictures))
    taken_for = ia.Particle(
        kind="custom", index=index, density_kg_m3=DENSITY, model="mie", diameter_nm=diameter_nm
    )
    config = config_of(OPTICS, taken_for, CAMERA, mode="size", z_range_nm=Z_RANGE_NM)
    counts = gather(config, before, after, n_before=100, n_after=100, power_ratio=1.0)
    found = []
    for number in range(n):
        likelihood = counts.likelihood(number)
        start = Candidate(
            11 + places[0, number] / 90, 11 + places[1, number] / 90, diameter_nm / 2,
            sphere_mass_kda(diameter_nm, DENSITY), 100.0,
        )  # fmt: skip
        fit = fit_particle(likelihood, start, "size", Z_RANGE_NM, level=False)
        found.append((fit, fit_index(likelihood, fit, Z_RANGE_NM)))
    return found


def pulls(found: IndexFit, diameter_nm: float) -> tuple[float, float]:
    """Give the errors of diameter and index over their standard deviations."""
    fit, model = found.fit, found.likelihood.model
    diameter = np.cbrt(fit.mass_kda / sphere_mass_kda(1.0, DENSITY))
    sigma = diameter * fit.sigma[3] / (3 * fit.mass_kda)
    index = model.sphere.index.real  # type: ignore[attr-defined]
    return (diameter - diameter_nm) / sigma, (index - INDEX) / fit.sigma_index


def test_a_large_sphere_tells_both_where_the_wrong_index_does_not_fit() -> None:
    ((fixed, found),) = fits_of(200.0, 1e5, 1.49, 1, seed=8)
    assert Status.POOR_FIT in fixed.flags
    assert found.is_told
    assert not found.fit.flags
    assert np.all(np.abs(pulls(found, 200.0)) < 4)


@pytest.mark.large
def test_a_small_sphere_tells_its_light_alone() -> None:
    """Light goes with d³ (n − n_s), and where the centre is goes with d."""
    for fixed, found in fits_of(60.0, 1e5, INDEX, 4, seed=8):
        assert not found.is_told
        assert found.fit is fixed
        assert 2.7 < found.power < 3.1
        assert found.sigma < 0.15


@pytest.mark.large
@pytest.mark.parametrize(("diameter", "index"), [(150.0, 1.44), (200.0, 1.49)])
def test_errors_of_both_are_as_large_as_said(diameter: float, index: float, share: float) -> None:
    n = max(4, round(30 * share))
    found = [one for _, one in fits_of(diameter, 1e5, index, n, seed=8)]
    assert all(one.is_told for one in found)
    off = np.array([pulls(one, diameter) for one in found])
    assert (np.abs(off.mean(axis=0)) < 4 / np.sqrt(n)).all()
    assert (off.std(axis=0, ddof=1) < 1 + 4 / np.sqrt(2 * n)).all()


@pytest.mark.parametrize(
    ("section", "keys", "message"),
    [("fit", {"mode": "localize"}, 'use "size"'), ("particle", {"kind": "gold"}, "absorbs")],
)
def test_where_no_index_can_be_fitted_it_is_refused(
    section: str, keys: dict[str, Any], message: str
) -> None:
    sections: dict[str, dict[str, Any]] = {
        "camera": {"pixel_size_nm": 90.0},
        "fit": {"mode": "size", "index": True},
        "particle": {"kind": "silica", "model": "mie", "diameter_nm": 100.0},
        "background": {"frames": [0, 10]},
    }
    ia.configure(sections)
    sections[section] = {k: v for k, v in (sections[section] | keys).items() if v is not None}
    with pytest.raises(ia.ConfigError, match=message):
        ia.configure(sections)
