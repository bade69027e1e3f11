"""The forward model against independent numbers, numerical derivatives and laws of physics."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import reference
from golden_setups import CASES, GOLD, NAMES, PAPER, golden_config, reference_setup, small_config

from iscat_analysis.bounds import plan
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.model import collected_area_nm2, signals_within

GOLDEN_FIELD = 1e-6  # precision promised by the golden files
TABLE = 1e-7  # error of the radial quintic, relative to the peak
TABLE_SLOPE = 1e-6  # error of its slope
DIFFERENCE = 2e-6  # central differences with steps of 1e-3 of a wavelength

SETUPS: dict[str, dict[str, Any]] = {
    "iscat": {},
    "cobri": {"scheme": "cobri", "attenuation": 0.06},
    "darkfield": {"scheme": "darkfield"},
    "oil": {"na": 1.42, "n_immersion": 1.515, "n_glass": 1.515, "wavelength_nm": 525.0},
    "oil reciprocal": {
        "na": 1.45, "n_immersion": 1.518, "n_glass": 1.518, "emission": "reciprocal",
        "polarization_deg": 33.0,
    },
    "refocus": {"axial": "refocus", "polarization_deg": -70.0},
    "cobri reciprocal": {"scheme": "cobri", "attenuation": 0.3, "emission": "reciprocal"},
}  # fmt: skip


def build(optics: dict[str, Any], **camera: Any) -> tuple[Config, ForwardModel]:
    config = small_config(optics=optics, camera=camera)
    return config, forward_model(config, 2500.0)


GRID = PixelGrid.centred(12, 90.0)
AT = (31.0, -57.0, 140.0)


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_field_agrees_with_golden(case: dict[str, Any]) -> None:
    config = golden_config(case)
    model = forward_model(config, 1500.0)
    r = np.array(case["field_over_reference"]["r_nm"])
    zero = np.zeros_like(r)
    mass = model.material.mass_kda
    for key, dx, dy in (("along_x", r, zero), ("along_y", zero, r)):
        wanted = np.array(case["field_over_reference"][key]) @ [1, 1j]
        found = model.field(dx, dy, case["z_nm"], mass)[0]
        assert np.abs(found - wanted).max() < GOLDEN_FIELD * np.abs(wanted).max()
    assert model.reference == pytest.approx(case["reference_amplitude"], rel=1e-12)


@pytest.mark.parametrize("case", CASES, ids=NAMES)
def test_image_and_photons_agree_with_golden(case: dict[str, Any]) -> None:
    experiment = plan(golden_config(case))
    model, grid = experiment.model, experiment.grid
    image = model.image(grid, case["x_nm"], case["y_nm"], case["z_nm"], experiment.mass_kda)
    if model.rho:
        low, high, corner = (case[f"contrast_{k}"] for k in ("min", "max", "corner"))
        size = max(abs(low), abs(high))
        assert abs(image.min() - low) < GOLDEN_FIELD * size
        assert abs(image.max() - high) < GOLDEN_FIELD * size
        assert abs(image[0, 0] - corner) < GOLDEN_FIELD * size
        scale = experiment.config.bounds.photons_per_pixel * experiment.config.bounds.n_after
        found = experiment.on_camera / scale
    else:
        found = image.sum()
    assert found == pytest.approx(case["photons_on_camera_per_reference"], rel=GOLDEN_FIELD)


@pytest.mark.parametrize("optics", SETUPS.values(), ids=SETUPS)
def test_signal_and_gradient_agree_with_the_reference(optics: dict[str, Any]) -> None:
    config, model = build(optics)
    psi = np.radians(config.optics.polarization_deg)
    c, s = np.cos(psi), np.sin(psi)
    x, y = np.meshgrid(GRID.x_nm - AT[0], GRID.y_nm - AT[1])
    setup = reference_setup(config, z_nm=AT[2])
    e, e_u, e_v, e_z = reference.fields(setup, c * x + s * y, c * y - s * x, AT[2])
    if model.rho:
        over = reference.reference_amplitude(setup)
        e, e_u, e_v, e_z = e / over, e_u / over, e_v / over, e_z / over
    rho = np.array([model.rho, 0.0])
    mass = model.material.mass_kda
    signal, gradient = model.gradient(GRID, *AT, mass)
    total = e + rho
    wanted = (np.abs(total) ** 2).sum(-1) - model.rho
    slopes = [
        2 * (total.conj() * d).real.sum(-1)
        for d in (c * e_u - s * e_v, s * e_u + c * e_v, e_z, e / mass)
    ]
    assert np.abs(signal - wanted).max() < TABLE * np.abs(wanted).max()
    for found, slope in zip(gradient, slopes, strict=True):
        assert np.abs(found - slope).max() < TABLE_SLOPE * np.abs(slope).max()


def test_random_set_ups_agree_with_the_reference() -> None:
    random = np.random.default_rng(7)
    for _ in range(12):
        n_glass = random.uniform(1.48, 1.6)
        n_sample = random.uniform(1.3, 1.45)
        na = random.uniform(0.5, n_glass - 0.03)
        z_nm = random.uniform(0, 2000)
        config = small_config(
            optics={
                "wavelength_nm": random.uniform(400, 700), "na": na, "n_immersion": n_glass,
                "n_glass": n_glass, "n_sample": n_sample,
                "scheme": random.choice(["iscat", "cobri"]).item(),
                "emission": random.choice(["dong2021", "reciprocal"]).item(),
                "focus_nm": random.uniform(-2000, 2000),
            },
            particle={"height_nm": random.uniform(0, 2000)},
        )  # fmt: skip
        model = forward_model(config, 3000.0, z_max_nm=2000.0)
        r = random.uniform(0, 3000, 20)
        phi = random.uniform(0, 2 * np.pi, 20)
        dx, dy = r * np.cos(phi), r * np.sin(phi)
        setup = reference_setup(config)
        wanted = reference.fields(setup, dx, dy, z_nm)[0] / reference.reference_amplitude(setup)
        peak = np.abs(reference.fields(setup, np.zeros(1), np.zeros(1), z_nm)[0]).max()
        found = np.moveaxis(model.field(dx, dy, z_nm, model.material.mass_kda), 0, -1)
        largest = max(np.abs(wanted).max(), peak / reference.reference_amplitude(setup))
        assert np.abs(found - wanted).max() < 3 * TABLE * largest


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("optics", SETUPS.values(), ids=SETUPS)
def test_gradient_is_the_slope_of_the_image(optics: dict[str, Any], samples: int) -> None:
    _, model = build(optics, samples_per_pixel=samples)
    at = np.array([*AT, model.material.mass_kda])
    _, gradient = model.gradient(GRID, *at)
    for k, step in enumerate((0.5, 0.5, 0.5, 1e-4 * at[3])):
        shift = np.eye(4)[k] * step
        numeric = (model.image(GRID, *(at + shift)) - model.image(GRID, *(at - shift))) / (2 * step)
        curvature = 40 * DIFFERENCE  # (k·0.5 nm)²/6 of the third derivative, and the table's steps
        assert np.abs(gradient[k] - numeric).max() < curvature * np.abs(gradient[k]).max()


@pytest.mark.parametrize("optics", SETUPS.values(), ids=SETUPS)
def test_hessian_is_the_slope_of_the_gradient(optics: dict[str, Any]) -> None:
    _, model = build(optics)
    mass = model.material.mass_kda
    _, first, second = model.amplitude_hessian(GRID, *AT, mass)
    at = np.array([*AT, mass])
    for k, step in enumerate((0.5, 0.5, 0.5, 1e-4 * mass)):
        shift = np.eye(4)[k] * step
        _, above = model.gradient(GRID, *(at + shift))
        _, below = model.gradient(GRID, *(at - shift))
        numeric = (above - below) / (2 * step)
        for i in range(4):
            size = np.abs(second[k, i]).max()
            natural = np.abs(first[i]).max() / (mass if k == 3 else 100.0)
            assert np.abs(second[k, i] - numeric[i]).max() < 2e-4 * max(size, natural)
    assert np.allclose(
        second, np.swapaxes(second, 0, 1), rtol=1e-9, atol=1e-12 * np.abs(second).max()
    )


@pytest.mark.parametrize(
    ("name", "share"),
    [("iscat", 0.9992), ("darkfield", 0.9992), ("oil", 0.9927), ("oil reciprocal", 0.9970)],
)
def test_parseval(name: str, share: float) -> None:
    """Light on a disc over the light that the pupil collects: the sharp rim leaves 1/R outside."""
    config = small_config(optics=SETUPS[name], particle={"height_nm": 5.0})
    model = forward_model(config, 20100.0)
    r = (np.arange(4000) + 0.5) * 5.0
    mass = model.material.mass_kda
    along = np.abs(model.field(r, np.zeros_like(r), 5.0, mass)) ** 2
    across = np.abs(model.field(np.zeros_like(r), r, 5.0, mass)) ** 2
    mean = (along + across).sum(0) / 2  # |e|² turns with cos 2φ only
    disc = np.cumsum(mean * 2 * np.pi * r * 5.0) / collected_area_nm2(model, 5.0, mass)
    assert disc[-1] == pytest.approx(share, abs=3e-4)
    assert 2 * disc[-1] - disc[1999] == pytest.approx(1.0, abs=2e-3)  # R → ∞


def test_contrast_is_proportional_to_mass_when_weak() -> None:
    _, model = build({})
    image = [model.image(GRID, *AT, m) / m for m in (1e-3, 2e-3)]
    assert np.abs(image[1] / image[0] - 1).max() < 1e-4
    square = [model.image(GRID, *AT, s * 1e4) for s in (1.0, -1.0)]
    bright = (square[0] + square[1]) / 2  # |E_sca|² alone
    twice = model.image(GRID, *AT, 2e4) + model.image(GRID, *AT, -2e4)
    assert np.allclose(twice / 2, 4 * bright, rtol=1e-9)


def test_light_polarised_along_y_gives_the_transposed_image() -> None:
    _, along_x = build({})
    _, along_y = build({"polarization_deg": 90.0})
    mass = along_x.material.mass_kda
    image = along_x.image(GRID, 20.0, -35.0, 120.0, mass)
    turned = along_y.image(GRID, -35.0, 20.0, 120.0, mass)
    assert np.abs(turned - image.T).max() < 1e-12


def test_polarisation_turns_the_image() -> None:
    psi = np.radians(37.0)
    _, straight = build({})
    _, turned = build({"polarization_deg": 37.0})
    mass = straight.material.mass_kda
    for x, y in ((80.0, 0.0), (-130.0, 260.0)):
        one = PixelGrid(np.array([x]), np.array([y]), 1.0)
        u, v = np.cos(psi) * x - np.sin(psi) * y, np.sin(psi) * x + np.cos(psi) * y
        other = PixelGrid(np.array([u]), np.array([v]), 1.0)
        a = straight.image(one, 0.0, 0.0, 120.0, mass)
        b = turned.image(other, 0.0, 0.0, 120.0, mass)
        assert abs(a - b).max() < 1e-12


def test_pixels_integrate() -> None:
    grid = PixelGrid.centred(5, 110.0)
    _, point = build({})
    _, pixel = build({}, samples_per_pixel=5)
    fine = 40
    inside = (np.arange(fine) + 0.5) / fine * 110.0 - 55.0
    axis = (grid.x_nm[:, None] + inside).ravel()
    brute = point.image(PixelGrid(axis, axis, 110.0 / fine), *AT, point.material.mass_kda)
    brute = brute.reshape(5, fine, 5, fine).mean((1, 3))
    found = pixel.image(grid, *AT, point.material.mass_kda)
    midpoint = 2e-4  # (π NA h/λ)²/6 of the 40 × 40 midpoint rule
    assert np.abs(found - brute).max() < midpoint * np.abs(brute).max()


@pytest.mark.parametrize("optics", SETUPS.values(), ids=SETUPS)
def test_quadrature_has_converged(optics: dict[str, Any]) -> None:
    config = small_config(optics=optics)
    usual = forward_model(config, 2500.0)
    fine = forward_model(config, 2500.0, nodes=200)
    mass = usual.material.mass_kda
    a, b = (m.image(GRID, *AT, mass) for m in (usual, fine))
    assert np.abs(a - b).max() < 1e-9 * np.abs(a).max()


def test_paper_scale_is_the_authors() -> None:
    """Prefactor n_s k, η with NA/n_i, √(1−r²): the program's photons at z = focus = 0."""
    config = small_config(
        optics={**PAPER, "convention": "dong2021", "axial": "refocus", "focus_nm": 0.0},
        camera={"pixel_size_nm": 4000 / 150},
        particle={**GOLD, "height_nm": 0.0},
        bounds={"pixels": 151, "photons_per_pixel": 1.0},
    )
    experiment = plan(config)
    photons = experiment.on_camera * experiment.model.reference**2
    assert photons == pytest.approx(0.0037588628833613463, rel=1e-8)


def test_of_particles_drawn_together_those_out_of_reach_are_left_out() -> None:
    _, model = build({})
    side = GRID.shape[0] / 2 * GRID.pixel_nm
    edge = math.sqrt(model.reach_nm**2 - side**2) - side  # along x, of what the model reaches
    theta = np.array([[0, 0, 100, 60], [edge - 1, 0, 50, 40], [edge + 1, 0, 50, 40.0]])
    drawn = signals_within(model, GRID, theta)
    for image, place in zip(drawn[:2], theta[:2], strict=True):
        assert np.array_equal(image, model.amplitude_image(GRID, *place))
        assert np.abs(image).max() > 0
    assert not drawn[2].any()
    with pytest.raises(ConfigError, match="reach_nm"):
        model.amplitude_image(GRID, *theta[2])
