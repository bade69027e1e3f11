"""Rods: their pictures, bounds and fits, and what they become where they are round.

The judge knows nothing of the program: a sum over all rays of the pupil that follows each electric
field as a vector, and depolarisation factors that are integrated numerically.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad

import iscat_analysis as ia
from iscat_analysis.bounds import quantum_information
from iscat_analysis.bounds.experiment import bounds_report
from iscat_analysis.config import Config, configure
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.model import collected_area_nm2
from iscat_analysis.optics.scatterers import ANGLES, depolarisation, material, rod_of
from tests.rays import picture_of_rays

FloatArray = NDArray[np.float64]

GRID = PixelGrid.centred(13, 130.0)
ROD = {"model": "rod", "aspect_ratio": 3.0, "azimuth_deg": 25.0, "tilt_deg": 50.0}
OPTICS, CIRCULAR = (
    ia.Optics(na=1.42, focus_nm=-300.0, polarization=kind) for kind in ("linear", "circular")
)
CAMERA = ia.Camera(pixel_size_nm=90.0, gain_e_per_adu=1.0, offset_adu=0.0, read_noise_e=0.0)


def of(**changes: Any) -> Config:
    """Make a configuration of a gold rod, changed by section."""
    sections: dict[str, dict[str, Any]] = {
        "optics": {"attenuation": 0.7, "focus_nm": 150.0, "na": 1.42},
        "camera": {"pixel_size_nm": 90.0},
        "particle": {"kind": "gold", "diameter_nm": 15.0, "height_nm": 30.0, **ROD},
        "fit": {"mode": "joint"},
        "bounds": {"pixels": 19, "n_before": 50, "n_after": 50},
    }
    for section, keys in changes.items():
        whole = sections.get(section, {}) | keys
        sections[section] = {k: v for k, v in whole.items() if v is not None}
    return configure(sections)


def round_one(**changes: Any) -> Config:
    """Make the same configuration of a point dipole."""
    return of(particle=dict.fromkeys(ROD) | {"model": "dipole"}, **changes)


def model_of(config: Config) -> ForwardModel:
    """Make the model of a configuration, for the pixels of `GRID`."""
    return forward_model(config, 2000.0)


def rod(azimuth_deg: float, tilt_deg: float, aspect_ratio: float = 3.0) -> ia.Particle:
    """Make a gold rod in some direction."""
    return ia.Particle(
        kind="gold", diameter_nm=15.0, model="rod", aspect_ratio=aspect_ratio,
        azimuth_deg=azimuth_deg, tilt_deg=tilt_deg,
    )  # fmt: skip


def axis(azimuth_deg: Any, tilt_deg: Any) -> FloatArray:
    """Give the unit vector along a rod."""
    a, t = np.radians(azimuth_deg), np.radians(tilt_deg)
    return np.array([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)])


def integrated_depolarisation(aspect_ratio: float) -> float:
    """Integrate the field inside an ellipsoid (Bohren and Huffman, equation 5.30)."""
    a2 = aspect_ratio**2

    def at(s: float) -> float:
        return 1 / ((s + a2) ** 1.5 * (s + 1))

    return aspect_ratio / 2 * float(quad(at, 0, np.inf, epsabs=1e-13, epsrel=1e-12)[0])


@pytest.mark.parametrize("aspect_ratio", [1.0, 1.00004, 1.0001, 1.37, 3.0, 20.0])
def test_the_field_inside_is_that_of_an_ellipsoid(aspect_ratio: float) -> None:
    expected = integrated_depolarisation(aspect_ratio)
    assert depolarisation(aspect_ratio) == pytest.approx(expected, rel=1e-9)


def test_two_touching_spheres_are_a_spheroid() -> None:
    """Two dipoles α one diameter apart: 2α/(1 − 2α/4πd³) along, 2α/(1 + α/4πd³) across."""
    dimer = ia.Particle(
        kind="silica", model="rod", aspect_ratio=1.392846575, azimuth_deg=0.0, tilt_deg=0.0
    )
    permittivity = material(dimer, 525.0).permittivity
    found = rod_of(dimer, permittivity, 1.33)
    beta = (permittivity - 1.33**2) / (permittivity + 2 * 1.33**2)  # α/4πd³ = β/8
    assert found is not None
    assert found.along == pytest.approx(1 / (1 - beta / 4), rel=1e-9)
    assert found.across == pytest.approx(1 / (1 + beta / 8), rel=1e-9)


@pytest.mark.parametrize("polarization", ["linear", "circular"])
def test_a_round_rod_is_a_dipole(polarization: str) -> None:
    """A weak astigmatism, in both, gives both the same table of the field."""
    light = {"optics": {"polarization": polarization, "aberrations_nm": {"z5": 5.0}}}
    point, ball = (
        model_of(round_one(**light)),
        model_of(of(particle={"aspect_ratio": 1.0}, **light)),
    )
    mass = point.material.mass_kda
    for (one, other) in zip(*(m.gradient(GRID, 40.0, -70.0, 60.0, mass) for m in (point, ball)),
                            strict=True):  # fmt: skip
        assert np.abs(one - other).max() < 1e-12 * np.abs(one).max()
    areas = [collected_area_nm2(model, 60.0, mass) for model in (point, ball)]
    assert areas[1] == pytest.approx(areas[0], rel=1e-12)
    one, other = (quantum_information(model, 60.0) for model in (point, ball))
    assert np.abs(one - other).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize(
    ("scheme", "polarization", "na"),
    [("iscat", "linear", 1.42), ("iscat", "circular", 1.42), ("cobri", "linear", 1.2)],
)
def test_the_picture_is_a_sum_over_rays(scheme: str, polarization: str, na: float) -> None:
    points = {"samples_per_pixel": 1}  # where the rays are summed
    optics = {"scheme": scheme, "polarization": polarization, "na": na}
    config = of(optics=optics, camera=points)
    model = model_of(config)
    height, ratio = config.particle.nominal_height_nm, config.particle.aspect_ratio or 1.0
    signal = model.image(GRID, 40.0, -70.0, 60.0, model.material.mass_kda)
    volume = math.pi / 6 * 15.0**3
    excess, medium = model.material.permittivity - 1.33**2, 1.33**2
    along = integrated_depolarisation(ratio)
    strong, weak = (volume * excess / (medium + x * excess) for x in (along, (1 - along) / 2))
    u = axis(25.0, 50.0)
    tensor = weak * np.eye(3) + (strong - weak) * np.outer(u, u)
    unit = (1.0, 0.0) if polarization == "linear" else (math.sqrt(0.5), 1j * math.sqrt(0.5))

    def summed(alpha: NDArray[np.complex128]) -> FloatArray:
        return picture_of_rays(
            config.optics, 1.5, 15.0, 60.0, height, GRID, (40.0, -70.0), alpha, unit
        )

    slow = summed(tensor)
    assert np.abs(signal - slow).max() < 1e-6 * np.abs(slow).max()
    flat = tensor.copy()
    flat[2] = 0.0  # the control: without the dipole along the optical axis it is another picture
    assert np.abs(signal - summed(flat)).max() > 1e-2 * np.abs(slow).max()


def test_derivatives_are_those_of_the_picture() -> None:
    """Along all six parameters, against differences of fourth order."""
    model = model_of(of())
    mass = model.material.mass_kda
    place = np.array([35.0, -20.0, 60.0, mass])
    slopes = model.gradient(GRID, *map(float, place), ANGLES)[1]
    own, angles = slopes[:4], slopes[4:]
    for k, name in enumerate(ANGLES):
        moved = [
            model_of(of(particle={name: float(ROD[name]) + times})).image(GRID, *map(float, place))
            for times in (-2.0, -1.0, 1.0, 2.0)
        ]
        expected = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / 12
        assert np.abs(angles[k] - expected).max() < 2e-6 * np.abs(expected).max()
    for k, step in enumerate((2.0, 2.0, 2.0, 0.01 * mass)):
        moved = []
        for times in (-2, -1, 1, 2):
            at = place.copy()
            at[k] += times * step
            moved.append(model.image(GRID, *map(float, at)))
        expected = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * step)
        assert np.abs(own[k] - expected).max() < 1e-5 * np.abs(expected).max()


def test_the_bound_is_that_of_the_pictures_derivatives() -> None:
    """Bright light before and after: each pixel has the variance 2/N of a contrast, nearly."""
    found = ia.crb(OPTICS, rod(25.0, 50.0), CAMERA, photons_per_pixel=1e4, n_after=100,
                   mode="mass", pixels=15)  # fmt: skip
    assert list(found) == ["x_nm", "y_nm", "mass_kda", *ANGLES]
    mass = rod(0.0, 0.0).nominal_mass_kda

    def picture(x: float, y: float, m: float, azimuth: float, tilt: float) -> FloatArray:
        return ia.psf(OPTICS, rod(azimuth, tilt), CAMERA, pixels=15, x_nm=x, y_nm=y, mass_kda=m)

    here = np.array([0.0, 0.0, mass, 25.0, 50.0])
    slopes = []
    for k, step in enumerate((1.0, 1.0, 0.01 * mass, 0.5, 0.5)):
        above, below = here.copy(), here.copy()
        above[k] += step
        below[k] -= step
        slopes.append((picture(*map(float, above)) - picture(*map(float, below))) / (2 * step))
    weight = 1e6 / (1 + picture(*map(float, here)))
    rows = np.array(slopes).reshape(5, -1)
    expected = np.sqrt(np.diag(np.linalg.inv((rows * weight.ravel()) @ rows.T)))
    assert np.array(list(found.values())) == pytest.approx(expected, rel=1e-3)


def test_what_is_not_seen_has_no_bound() -> None:
    upright = ia.crb(OPTICS, rod(25.0, 0.0), CAMERA, photons_per_pixel=1e4, n_after=100, pixels=15)
    assert math.isnan(upright["azimuth_deg"])
    assert math.isfinite(upright["mass_kda"])
    report = bounds_report(of(particle={"tilt_deg": 0.0}))
    assert report["rod"]["unidentifiable"] == ["azimuth_deg: the image does not change with it"]
    tilted = bounds_report(of(fit={"mode": "mass"}))
    known, unknown = tilted["actual"]["crb_joint"], tilted["rod"]["crb_joint"]
    for name in ("x_nm", "y_nm", "mass_kda"):
        assert tilted["actual"]["qcrb"][name] < known[name] < unknown[name]


def counts_of(
    optics: ia.Optics, azimuths: FloatArray, tilts: FloatArray, light_e: float, seed: int
) -> list[Any]:
    """Draw counts before and after rods that land, of as much light in all frames."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-45.0, 45.0, (len(tilts), 2))
    light = light_e * (1 + np.array([
        ia.psf(optics, rod(float(a), float(t)), CAMERA, pixels=15, x_nm=x, y_nm=y)
        for a, t, (x, y) in zip(azimuths, tilts, places, strict=True)
    ]))  # fmt: skip
    return [rng.poisson(np.full_like(light, light_e)), rng.poisson(light)]


def fitted(optics: ia.Optics, counts: list[Any]) -> pd.DataFrame:
    """Fit rods whose direction is unknown."""
    return ia.fit_rods(
        *counts, optics, rod(0.0, 45.0), CAMERA, n_before=100, n_after=100, power_ratio=1.0
    )


def test_the_direction_is_found() -> None:
    counts = counts_of(CIRCULAR, np.array([35.0]), np.array([60.0]), 1e6, seed=2)
    row = fitted(CIRCULAR, counts).iloc[0]
    assert row["status"] == "ok"
    truth = {"azimuth_deg": 35.0, "tilt_deg": 60.0, "mass_kda": rod(0.0, 0.0).nominal_mass_kda}
    for name, value in truth.items():
        assert abs(row[name] - value) < 4 * row[f"sigma_{name}"]
    assert row["sigma_azimuth_deg"] < 4.0


@pytest.mark.large
@pytest.mark.parametrize("optics", [OPTICS, CIRCULAR], ids=["linear", "circular"])
def test_errors_are_as_large_as_said(optics: ia.Optics, share: float) -> None:
    """Pulls of n fits in random directions have the mean 0 ± 1/√n and the spread 1 ± 1/√(2n)."""
    n = max(6, round(40 * share))
    rng = np.random.default_rng(11)
    azimuths, tilts = rng.uniform(0.0, 360.0, n), np.degrees(np.arccos(rng.uniform(0.0, 1.0, n)))
    table = fitted(optics, counts_of(optics, azimuths, tilts, 4e6, seed=12))
    good = (table["status"] == "ok").to_numpy()
    assert good.mean() > 0.6
    turn = (table["azimuth_deg"] - azimuths + 90) % 180 - 90
    flip = np.einsum("ki,ki->i", axis(azimuths, tilts),
                     axis(table["azimuth_deg"], table["tilt_deg"])) < 0  # fmt: skip
    lean = np.where(flip, 180 - table["tilt_deg"], table["tilt_deg"]) - tilts
    errors = {"mass_kda": table["mass_kda"] - rod(0.0, 0.0).nominal_mass_kda,
              "azimuth_deg": turn, "tilt_deg": lean}  # fmt: skip
    for name, error in errors.items():
        pulls = (error / table[f"sigma_{name}"])[good]
        assert abs(pulls.mean()) < 4 / math.sqrt(len(pulls))
        assert abs(pulls.std() - 1) < 4 / math.sqrt(2 * len(pulls))


@pytest.mark.large
def test_a_direction_that_is_not_told_is_flagged() -> None:
    """A rod across the polarisation shows nothing of its length, and faint light tells little.

    Where the likelihood is flat along a line, a fit may not come to an end, and says that.
    """
    across = counts_of(OPTICS, np.full(2, 90.0), np.array([30.0, 60.0]), 1e6, seed=3)
    faint = counts_of(CIRCULAR, np.full(2, 20.0), np.array([20.0, 80.0]), 1e4, seed=4)
    for optics, counts in ((OPTICS, across), (CIRCULAR, faint)):
        assert set(fitted(optics, counts)["status"]) <= {"ambiguous_direction", "not_converged"}


def test_a_lying_rod_along_or_across_the_light_has_the_picture_of_a_sphere() -> None:
    """Its dipole points along the light, so that the mass is wrong by α over that of the sphere."""
    keys = {"kind": "silica", "diameter_nm": 20.0}
    point = ia.Particle(**keys)
    excess = material(point, OPTICS.wavelength_nm).permittivity.real / OPTICS.n_sample**2 - 1
    along = integrated_depolarisation(3.0)
    for azimuth, factor in ((0.0, along), (90.0, (1 - along) / 2)):
        lying = ia.Particle(**keys, **(ROD | {"azimuth_deg": azimuth, "tilt_deg": 90.0}))
        light = 1e10 * (1 + ia.psf(OPTICS, lying, CAMERA, pixels=15)[None])
        table = ia.fit_rois(np.full_like(light, 1e10), light, OPTICS, point, CAMERA, n_before=100,
                            n_after=100, power_ratio=1.0)  # fmt: skip
        expected = (1 + excess / 3) / (1 + factor * excess) * point.nominal_mass_kda
        assert table["mass_kda"][0] == pytest.approx(expected, rel=3e-4)  # the square of its light


BAD = [
    ({"particle": {"aspect_ratio": 0.5}}, "aspect_ratio"),
    ({"particle": {"aspect_ratio": 300.0}}, "aspect_ratio"),
    ({"particle": {"aspect_ratio": None}}, "needs aspect_ratio"),
    ({"particle": {"azimuth_deg": None}}, "needs azimuth_deg"),
    ({"particle": {"tilt_deg": -5.0}}, "tilt_deg"),
    ({"particle": {"model": "dipole"}}, 'needs model = "rod"'),
    ({"particle": {"diameter_nm": 60.0}}, "an eighth of the wavelength"),
    ({"particle": {"kind": "custom", "index": 1.33, "density_kg_m3": 1e3}}, "scatters no light"),
    ({"particle": {"height_nm": "contact"}}, "is for round particles"),
    ({"particle": {"wiggle_nm": 5.0}}, "is for round particles"),
    ({"optics": {"emission": "dong2021"}}, "is for round particles"),
    ({"optics": {"calibrate": "always"}}, "is for round particles"),
    ({"fit": {"mode": "size"}}, "fits spheres"),
]


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_what_cannot_be_is_said(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(Exception, match=message) as caught:
        of(**changes)
    assert type(caught.value).__name__ == "ConfigError"


def test_what_does_not_fit_directions_says_so(tmp_path: Any) -> None:
    image = np.full((1, 15, 15), 1e6)
    frames = {"n_before": 10, "n_after": 10}
    with pytest.raises(ia.ConfigError, match="fit_rods"):
        ia.fit_rois(image, image, OPTICS, rod(0.0, 0.0), CAMERA, **frames)
    with pytest.raises(ia.ConfigError, match="fit_rods"):
        ia.log_likelihood(image[0], image[0], OPTICS, rod(0.0, 0.0), CAMERA, **frames)
    with pytest.raises(ia.ConfigError, match="fits rods"):
        ia.fit_rods(image, image, OPTICS, ia.Particle(mass_kda=90.0), CAMERA, **frames)
    np.save(tmp_path / "movie.npy", np.full((20, 32, 32), 1000, dtype=np.uint16))
    with pytest.raises(ia.ConfigError, match="fit_rods"):
        ia.fit_stack(tmp_path / "movie.npy", of(fit={"mode": "mass"}))
