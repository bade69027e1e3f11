"""Large particles among proteins, in pictures that are sums over rays and not the program's own."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import tifffile
from numpy.typing import NDArray

from iscat_analysis.config import Config, configure
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.recognition import may_be_large, recognised
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.sized import SeatedModel, seated_models
from iscat_analysis.records import Candidate, FitResult, Status
from iscat_analysis.units import sphere_mass_kda
from iscat_cli import main
from tests.rays import picture_of_rays

FloatArray = NDArray[np.float64]

OPTICS = {"na": 1.42, "focus_nm": -300.0, "attenuation": 0.5, "calibrate": "never"}
# Rays are summed at the centres of pixels.
CONFIG = configure({"optics": OPTICS, "camera": {"pixel_size_nm": 90.0, "samples_per_pixel": 1}})
GRID = PixelGrid.centred(23, 90.0)
GOLD = 0.5921258 + 2.1358682j
MODEL = forward_model(CONFIG, 2200.0)


def counts_of(signal: FloatArray, light_e: float, seed: int) -> Likelihood:
    rng = np.random.default_rng(seed)
    before, after = rng.poisson(light_e, signal.shape), rng.poisson(light_e * (1 + signal))
    return conditional(MODEL, GRID, before, after, 1.0)


def as_dipole(likelihood: Likelihood, mass_kda: float = 1000.0) -> FitResult:
    start = Candidate(0.2, -0.1, 5.0, mass_kda, 10.0)
    return fit_particle(likelihood, start, "mass", (0.0, 1000.0), level=False)


def fitted(likelihood: Likelihood, config: Config = CONFIG) -> tuple[SeatedModel, FitResult] | None:
    fit = as_dipole(likelihood)
    if not may_be_large(likelihood, fit):
        return None
    spheres = seated_models(MODEL, config.fit.spheres, config.fit.diameter_range_nm)
    found = recognised(likelihood, fit, spheres, (0.0, 1000.0), level=False)
    if found is None:
        return None
    assert isinstance(found[0].model, SeatedModel)
    return found[0].model, found[1]


@pytest.mark.parametrize(
    ("name", "index", "diameter"), [("gold", GOLD, 40.0), ("sphere", 1.40 + 0j, 120.0)]
)
def test_a_sphere_is_told_from_a_protein(name: str, index: complex, diameter: float) -> None:
    """Its picture is a sum over rays, with the focus that a protein has."""
    signal = picture_of_rays(CONFIG.optics, index, diameter, diameter / 2, 5.0, GRID, (18.0, -9.0))
    found = fitted(counts_of(signal, 1e6, seed=3))
    assert found is not None
    model, fit = found
    assert model.name == name
    assert set(fit.flags) == {Status.LARGE}
    size = model.sphere.of_mass(fit.mass_kda).diameter_nm
    sigma = size / 3 * fit.sigma[3] / fit.mass_kda
    assert abs(size - diameter) < 4 * sigma
    assert sigma < 0.01 * diameter
    if name == "sphere":
        assert abs(model.sphere.index.real - index.real) < 4 * fit.sigma_index < 0.01


@pytest.mark.large
def test_errors_are_as_large_as_said(share: float) -> None:
    """Pulls of size and index over n seeds: the mean is 0 ± 1/√n, the spread 1 ± 1/√(2n)."""
    n = max(6, round(40 * share))
    signal = picture_of_rays(CONFIG.optics, 1.38 + 0j, 90.0, 45.0, 5.0, GRID, (18.0, -9.0))
    spheres = seated_models(MODEL, ("sphere",), (30.0, 150.0))
    pulls = []
    for seed in range(n):
        likelihood = counts_of(signal, 1e6, seed)
        found = recognised(likelihood, as_dipole(likelihood), spheres, (0.0, 500.0), level=False)
        assert found is not None
        model, fit = found[0].model, found[1]
        assert isinstance(model, SeatedModel)
        truth = sphere_mass_kda(90.0, MODEL.material.density_kg_m3)
        pulls.append(
            ((fit.mass_kda - truth) / fit.sigma[3],
             (model.sphere.index.real - 1.38) / fit.sigma_index)
        )  # fmt: skip
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4 / math.sqrt(n))
    assert np.all(np.abs(np.std(pulls, axis=0) - 1) < 4 / math.sqrt(2 * n))


@pytest.mark.parametrize("mass", [205.0, 3000.0])
def test_a_protein_stays_one(mass: float) -> None:
    """A compact protein of 3 MDa is 19 nm large, at the height that is configured."""
    likelihood = counts_of(MODEL.image(GRID, 18.0, -9.0, 5.0, mass), 1e9, seed=2)
    fit = as_dipole(likelihood)
    assert not may_be_large(likelihood, fit)
    assert abs(fit.mass_kda - mass) < 4 * fit.sigma[3]


@pytest.mark.parametrize("change", [{"focus_nm": -340.0}, {"reference_phase_deg": 25.0}])
def test_a_wrong_microscope_makes_no_spheres(change: dict[str, float]) -> None:
    """Fits of proteins are poor, and no sphere on the coverslip describes them."""
    there = forward_model(configure({"optics": OPTICS | change, "camera": {"pixel_size_nm": 90.0}}),
                          2200.0)  # fmt: skip
    for mass in (430.0, 2000.0):
        likelihood = counts_of(there.image(GRID, 18.0, -9.0, 5.0, mass), 1e10, seed=4)
        fit = as_dipole(likelihood)
        assert Status.POOR_FIT in fit.flags
        assert fitted(likelihood) is None


def test_a_calibration_scales_spheres_too() -> None:
    """Proteins with twice the contrast that the optics say mean half as much reference."""
    line = {"gradient_per_kda": 2 * MODEL.peak_contrast(5.0, 1.0)}
    config = configure({"optics": OPTICS, "camera": {"pixel_size_nm": 90.0}, "calibration": line})
    (calibrated,) = seated_models(forward_model(config, 2200.0), ("silica",), (20.0, 200.0))
    (plain,) = seated_models(MODEL, ("silica",), (20.0, 200.0))
    assert calibrated.factor / plain.factor == pytest.approx(2.0, rel=1e-3)


def movie(path: Path, large: bool) -> list[tuple[float, float]]:
    """Write a stack of four proteins, and of two spheres if they are wanted, on a background."""
    places = [(16.0, 17.0), (46.3, 16.4), (16.8, 47.1), (46.0, 46.0)]
    n, grid = 64, PixelGrid.region((0, 64), (0, 64), 90.0)
    wide = forward_model(CONFIG, 9000.0)
    total = np.zeros((n, n))
    for mass, (x, y) in zip((2000.0, 3000.0, 4000.0, 2000.0), places, strict=True):
        total += wide.image(grid, 90 * x, 90 * y, 5.0, mass)
    if large:
        total += picture_of_rays(CONFIG.optics, 1.40 + 0j, 100.0, 50.0, 5.0, grid, (2790.0, 2880.0))
    rng = np.random.default_rng(9)
    light = np.concatenate([np.full((20, n, n), 1e6), np.full((20, n, n), 1e6) * (1 + total)])
    noise = rng.standard_normal(light.shape)
    tifffile.imwrite(path, np.round(light + np.sqrt(light) * noise).astype(np.uint32))
    return places


@pytest.mark.large
def test_proteins_beside_a_large_particle_are_as_without_it(tmp_path: Path) -> None:
    tables = []
    for large in (True, False):
        path = tmp_path / f"{large}.tif"
        places = movie(path, large)
        keys = [f"optics.{name}={value}" for name, value in OPTICS.items()]
        keys += ["camera.pixel_size_nm=90", "camera.gain_e_per_adu=1", "camera.offset_adu=0",
                 "camera.read_noise_e=0", "background.frames=[0, 20]", "fit.roi_nm=2200",
                 "posterior.enabled=false"]  # fmt: skip
        status = main(["fit", str(path), "--quiet", *(f"--set={key}" for key in keys)])
        assert status == 0
        folder = path.with_suffix(".iscat")
        tables.append(pd.read_csv(folder / "fits.csv"))
        warnings = json.loads((folder / "summary.json").read_text())["warnings"]
        assert any("no dipole" in text for text in warnings) == large
    beside, alone = (
        pd.DataFrame([t.loc[np.hypot(t.x_px - x, t.y_px - y).idxmin()] for x, y in places])
        for t in tables
    )
    assert set(beside["model"]) == set(alone["model"]) == {"dipole"}
    assert "large" not in set(alone["status"])
    masses = [t["mass_kda"].to_numpy() for t in (beside, alone)]
    assert np.abs(masses[0] / masses[1] - 1).max() < 3e-3
    (sphere,) = tables[0][tables[0]["status"] == "large"].to_dict("records")
    assert sphere["model"] == "sphere"
    assert math.isnan(sphere["mass_kda"])
    assert abs(sphere["diameter_nm"] - 100.0) < 4 * sphere["sigma_diameter_nm"]


BAD: list[tuple[Any, str]] = [
    (["lead"], "spheres"), ([0.5], "refractive index"), ([1.33], "index of the sample"),
]  # fmt: skip


@pytest.mark.parametrize(("spheres", "message"), BAD)
def test_what_cannot_be_is_said(spheres: list[Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        configure({"fit": {"spheres": spheres}})


def test_materials_that_are_not_known_at_a_wavelength_are_left_out() -> None:
    infrared = replace(MODEL, optics=MODEL.optics.model_copy(update={"wavelength_nm": 1200.0}))
    names = {m.name for m in seated_models(infrared, CONFIG.fit.spheres, (10.0, 400.0))}
    assert "polystyrene" not in names
    assert {"gold", "silica", "sphere"} <= names
