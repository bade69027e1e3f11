"""What must hold of bounds whatever the set-up: order, limits, invariances, conservation."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference
from golden_setups import GOLD, PAPER, reference_setup, small_config
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from iscat_analysis._kernels.pupil import gauss_legendre, make_pupil
from iscat_analysis.bounds import (
    bounds_from_matrices,
    bounds_report,
    incompatible_pairs,
    information_fraction,
    plan,
    quantum_bounds,
    quantum_information,
    z_nm_phase_free,
)
from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.records import PARAMETERS

INTEGRATION = 2e-3  # 4 × 4 samples in pixels of at most λ/(4 NA)


@st.composite
def set_ups(draw: st.DrawFn) -> Config:
    """Draw a microscope, a particle and a field that could be built."""
    f = st.floats
    n_glass = draw(f(1.46, 1.6))
    na = draw(f(0.4, n_glass - 0.03))
    wavelength = draw(f(400, 800))
    pixels = draw(st.integers(9, 25))
    side = pixels * wavelength / na * draw(f(0.05, 0.25))
    height = draw(f(0, 1500))
    scheme = draw(st.sampled_from(["iscat", "cobri", "darkfield"]))
    return small_config(
        optics={
            "wavelength_nm": wavelength, "na": na, "n_immersion": n_glass, "n_glass": n_glass,
            "n_sample": draw(f(1.3, 1.45)), "scheme": scheme,
            "attenuation": 10 ** draw(f(-3, 0)),
            "polarization_deg": draw(f(-180, 180)),
            "focus_nm": height + draw(f(-1500, 1500)),
            "emission": draw(st.sampled_from(["dong2021", "reciprocal"])),
        },
        camera={
            "pixel_size_nm": side / pixels,
            "samples_per_pixel": 4,
            "read_noise_e": draw(st.sampled_from([0.0, 2.0])),
        },
        particle={
            **GOLD, "height_nm": height, "diameter_nm": draw(f(5, 40)),
            "permittivity": (draw(f(-10, 6)), draw(f(0.05, 5))),
        },
        bounds={
            "pixels": pixels, "x_nm": side * draw(f(-0.4, 0.4)), "y_nm": side * draw(f(-0.4, 0.4)),
            "n_before": draw(st.sampled_from([0, 3])), "n_after": 3,
        },
    )  # fmt: skip


@settings(max_examples=120)
@given(config=set_ups())
def test_no_camera_beats_the_light(config: Config) -> None:
    _light_tells_more(config)


@pytest.mark.large
@settings(max_examples=2500)
@given(config=set_ups())
def test_no_camera_beats_the_light_anywhere(config: Config) -> None:
    _light_tells_more(config)


def _light_tells_more(config: Config) -> None:
    """N K − J is positive: in every direction, so for every parameter alone and for all jointly."""
    experiment = plan(config)
    found = experiment.bounds(PARAMETERS)
    limit = np.diag(found.quantum)
    scale = 1 / np.sqrt(np.outer(limit, limit))
    excess = np.linalg.eigvalsh((found.quantum - found.fisher) * scale)
    assert excess[0] > -INTEGRATION
    share = information_fraction(found)
    assert not np.any(share > 1 + INTEGRATION)
    # a joint bound is never below the single one, nor a finite one below the quantum bound
    finite = np.isfinite(found.crb_joint)
    assert np.all(found.crb_joint[finite] >= found.crb_single[finite] * (1 - 1e-9))
    assert np.all(found.crb_joint[finite] >= found.qcrb[finite] * (1 - INTEGRATION))
    assert experiment.on_camera <= experiment.collected * (1 + INTEGRATION)


@settings(max_examples=100)
@given(config=set_ups())
def test_quantum_matrix_is_hermitian_and_positive(config: Config) -> None:
    model = forward_model(config, 100.0)
    q = quantum_information(model, config.particle.height_nm)
    assert np.array_equal(q, q.conj().T)
    assert np.linalg.eigvalsh(q / np.sqrt(np.outer(np.diag(q), np.diag(q)).real))[0] > -1e-12
    single, joint = quantum_bounds(q)
    assert np.all(joint >= single * (1 - 1e-12))


def test_quantum_matrix_is_that_of_the_modes() -> None:
    """Brute force over θ and φ, with the phases written out, evanescent waves included."""
    config = small_config(
        optics={"na": 1.45, "n_immersion": 1.52, "n_glass": 1.52, "polarization_deg": 25.0}
    )
    model, z = forward_model(config, 100.0), 80.0
    k, ni, ns = model.wavenumber, 1.52, 1.33
    alpha, critical = math.asin(1.45 / ni), math.asin(ns / ni)
    theta, weight = gauss_legendre(alpha, critical, 60, 60)
    pupil = make_pupil(
        theta, weight, wavenumber=k, n_immersion=ni, n_glass=ni, n_sample=ns, direction=1.0,
        reciprocal=False,
    )  # fmt: skip
    phi = np.arange(64) * 2 * np.pi / 64
    psi = math.radians(25.0)
    p, s = pupil.t_p_cos[:, None], pupil.t_s[:, None]
    # the field of a dipole along ψ, in axes along and across it
    a = np.stack([
        p * np.cos(phi - psi) ** 2 + s * np.sin(phi - psi) ** 2,
        (p - s) * np.cos(phi - psi) * np.sin(phi - psi),
    ])  # fmt: skip
    mode = a * np.sqrt(np.sin(theta) * weight)[:, None] * np.exp(1j * pupil.axial * z)[:, None]
    slopes = (
        -1j * pupil.transverse[:, None] * np.cos(phi) * mode,
        -1j * pupil.transverse[:, None] * np.sin(phi) * mode,
        1j * pupil.axial[:, None] * mode,
        mode,
    )
    norm = float((np.abs(mode) ** 2).sum())
    wanted = np.array([[4 * (u.conj() * v).sum() / norm for v in slopes] for u in slopes])
    found = quantum_information(model, z)
    scale = np.sqrt(np.outer(np.diag(wanted), np.diag(wanted)).real)
    assert np.abs((found - wanted) / scale).max() < 1e-12


def test_z_and_mass_do_not_commute() -> None:
    model = forward_model(small_config(), 100.0)
    pairs = incompatible_pairs(quantum_information(model, 100.0))
    assert set(pairs) == {("z_nm", "mass_rel")}
    assert pairs["z_nm", "mass_rel"] == pytest.approx(0.99363, abs=1e-5)


def test_evanescent_light_ties_z_to_mass() -> None:
    inside = forward_model(small_config(), 100.0)
    assert quantum_information(inside, 50.0)[2, 3].real == 0
    config = small_config(optics={"na": 1.45, "n_immersion": 1.52, "n_glass": 1.52})
    beyond = quantum_information(forward_model(config, 100.0), 50.0)
    assert beyond[2, 3].real < 0  # moving away weakens the light, as less mass does


@pytest.mark.parametrize("measure", ["exact", "dong2021"])
@pytest.mark.parametrize("emission", ["dong2021", "reciprocal"])
def test_continuous_across_the_critical_angle(measure: Any, emission: str) -> None:
    found = []
    for na in (1.33 - 1e-10, 1.33 + 1e-10):
        config = small_config(optics={"na": na, "emission": emission})
        model = forward_model(config, 100.0)
        found.append(quantum_information(model, 60.0, measure=measure))
    scale = np.sqrt(np.outer(np.diag(found[0]), np.diag(found[0])).real)
    assert np.abs((found[1] - found[0]) / scale).max() < 1e-5
    images = []
    for na in (1.33 - 1e-10, 1.33 + 1e-10):
        model = forward_model(small_config(optics={"na": na, "emission": emission}), 1000.0)
        images.append(model.image(PixelGrid.centred(9, 80.0), 0, 0, 60.0, model.material.mass_kda))
    assert np.abs(images[1] - images[0]).max() < 1e-5 * np.abs(images[0]).max()


def test_weak_reference_is_dark_field() -> None:
    weak = bounds_report(small_config(optics={"scheme": "cobri", "attenuation": 1e-8}))
    dark = bounds_report(small_config(optics={"scheme": "darkfield"}))
    for kind in ("crb_single", "crb_joint"):
        for name, value in dark["per_photon"][kind].items():
            assert weak["per_photon"][kind][name] == pytest.approx(value, rel=1e-3)


@pytest.mark.parametrize("scheme", ["iscat", "cobri"])
def test_strong_reference_is_homodyne(scheme: str) -> None:
    """J per photon of the weak field equals 4 Σ (Re ∂E)², E over the reference."""
    config = small_config(
        optics={"scheme": scheme, "attenuation": 1.0}, particle={"diameter_nm": 0.3},
        bounds={"pixels": 21},
    )  # fmt: skip
    experiment = plan(config)
    grid, setup = experiment.grid, reference_setup(config)
    x, y = np.meshgrid(grid.x_nm, grid.y_nm)
    e, *slopes = reference.fields(setup, x, y, 100.0)
    photons = (np.abs(e) ** 2).sum()
    homodyne = [4 * (d[..., 0].real ** 2).sum() / photons for d in (*slopes, e)]
    per = np.array([1, 1, 1, 1 / experiment.mass_kda])
    single = experiment.bounds(PARAMETERS).crb_single * per * math.sqrt(experiment.on_camera)
    assert single == pytest.approx(1 / np.sqrt(homodyne), rel=2e-6)


def test_global_phase_of_the_light_means_nothing_without_a_reference() -> None:
    config = small_config(optics={"scheme": "darkfield"})
    experiment = plan(config)
    wave = experiment.model.wave
    turned = replace(experiment.model, wave=replace(wave, source=wave.source * np.exp(0.7j)))
    a, b = (plan(config, model=m).bounds(PARAMETERS) for m in (experiment.model, turned))
    assert b.fisher == pytest.approx(a.fisher, rel=1e-9, abs=1e-9 * np.abs(a.fisher).max())
    assert np.array_equal(a.quantum, b.quantum)


def test_units_scale_out() -> None:
    """All lengths twice as long, per photon: positions twice as uncertain, the mass as before."""
    one = small_config()
    two = small_config(
        optics={**PAPER, "wavelength_nm": 2 * 517.5, "focus_nm": 600.0},
        camera={"pixel_size_nm": 100.0},
        particle={"height_nm": 200.0, "diameter_nm": 60.0},
    )
    a, b = (bounds_report(c)["per_photon"] for c in (one, two))
    for kind in ("crb_single", "crb_joint", "qcrb", "qcrb_dong2021"):
        for name, value in a[kind].items():
            factor = 1 if name == "mass_rel" else 2
            assert b[kind][name] == pytest.approx(factor * value, rel=1e-6)


def test_pixels_refine_away() -> None:
    one = small_config(camera={"pixel_size_nm": 40.0}, bounds={"pixels": 51})
    two = small_config(
        camera={"pixel_size_nm": 20.0}, bounds={"pixels": 102, "photons_per_pixel": 2500.0}
    )
    a, b = (bounds_report(c)["actual"]["crb_joint"] for c in (one, two))
    for name, value in a.items():
        assert b[name] == pytest.approx(value, rel=2e-3)


def test_polarisation_exchanges_x_and_y() -> None:
    a = bounds_report(small_config())["per_photon"]
    b = bounds_report(small_config(optics={"polarization_deg": 90.0}))["per_photon"]
    for kind in ("crb_single", "crb_joint", "qcrb"):
        assert b[kind]["x_nm"] == pytest.approx(a[kind]["y_nm"], rel=1e-9)
        assert b[kind]["y_nm"] == pytest.approx(a[kind]["x_nm"], rel=1e-9)


def test_camera_plane_holds_the_exact_quantum_information() -> None:
    """4 Σ|∂E|²/Σ|E|² over a growing field tends to the exact K, not to D21's (section 7, 3)."""
    config = small_config()
    setup = reference_setup(config)
    model = forward_model(config, 100.0)
    exact = np.sqrt(1 / np.diag(quantum_information(model, 100.0).real)[:3])
    paper = np.sqrt(1 / np.diag(quantum_information(model, 100.0, measure="dong2021").real)[:3])
    found = []
    for half in (1500.0, 6000.0):
        pitch = 90.0  # below λ/(4 NA): the sums are exact integrals of band-limited functions
        axis = np.arange(pitch / 2, half, pitch)
        x, y = np.meshgrid(axis, axis)  # one quadrant: |e|² and |∂e|² are even in x and y
        e, *slopes = reference.fields(setup, x, y, 100.0)
        photons = (np.abs(e) ** 2).sum()
        found.append([1 / math.sqrt(4 * (np.abs(d) ** 2).sum() / photons) for d in slopes])
    near, far = np.abs(np.array(found) / exact - 1)
    assert np.all(far < 0.005)
    assert np.all(far <= near + 1e-4)
    assert abs(found[1][0] / paper[0] - 1) > 0.04


def test_power_into_glass_and_water_is_that_of_the_green_function() -> None:
    """Section 8: an in-plane dipole on the interface, n_s 1.33, n_g 1.515: 1.0829949695."""
    ns, ng = 1.33, 1.515
    theta, weight = gauss_legendre(np.pi / 2, math.asin(ns / ng), 200, 200)
    pupil = make_pupil(
        theta, weight, wavenumber=1.0, n_immersion=ng, n_glass=ng, n_sample=ns, direction=1.0,
        reciprocal=True,
    )  # fmt: skip
    density = np.abs(pupil.t_p_cos) ** 2 + np.abs(pupil.t_s) ** 2
    free = ns * 8 / 3  # of the dipole in water, in the same unit: n_s ∫ sin²Θ dΩ / π
    glass = ng * float(np.sum(weight * np.sin(theta) * density)) / free
    x, w = np.polynomial.legendre.leggauss(200)
    cos = (x + 1) / 2
    cos_g = np.sqrt(1 - (ns / ng) ** 2 * (1 - cos**2))
    r_s = (ns * cos - ng * cos_g) / (ns * cos + ng * cos_g)
    r_p = (ng * cos - ns * cos_g) / (ng * cos + ns * cos_g)
    upward = (1 + r_s) ** 2 + (cos * (1 - r_p)) ** 2
    water = ns * float(np.sum(w / 2 * upward)) / free

    def green(u: float, above: bool) -> float:
        # s = sin or cosh removes the root at s = 1
        s_z = math.cos(u) if not above else 1j * math.sinh(u)
        s = math.sin(u) if not above else math.cosh(u)
        k_g = np.sqrt((ng / ns) ** 2 - s**2 + 0j)
        rs = (s_z - k_g) / (s_z + k_g)
        rp = ((ng / ns) ** 2 * s_z - k_g) / ((ng / ns) ** 2 * s_z + k_g)
        measure = 1.0 if not above else -1j  # ds/s_z
        return float(np.real(measure * s * (rs - s_z**2 * rp)))

    inside = quad(green, 0, np.pi / 2, args=(False,), epsabs=1e-12)[0]
    outside = quad(green, 0, math.acosh(ng / ns), args=(True,), epsabs=1e-12, limit=200)[0]
    total = 1 + 0.75 * (inside + outside)
    assert glass == pytest.approx(0.748604, abs=5e-7)
    assert water == pytest.approx(0.334391, abs=5e-7)
    assert glass + water == pytest.approx(total, abs=1e-8)
    assert total == pytest.approx(1.0829949695, abs=1e-8)


def test_no_phase_no_common_path() -> None:
    """Without a phase only the spread of the axial wavenumber counts, the same for both schemes."""
    light = [forward_model(small_config(optics={"scheme": s}), 100.0) for s in ("iscat", "cobri")]
    a, b = (z_nm_phase_free(model, 0.0) for model in light)
    assert a == pytest.approx(b, rel=1e-9)
    assert a > math.sqrt(1 / quantum_information(light[1], 0.0)[2, 2].real)


def test_two_by_two_pixels_cannot_tell_height_from_mass() -> None:
    config = small_config(camera={"pixel_size_nm": 150.0}, bounds={"pixels": 2})
    found = plan(config).bounds(PARAMETERS)
    assert np.isnan(found.crb_joint[2:]).all()
    assert np.isfinite(found.crb_joint[:2]).all()
    assert np.isfinite(found.crb_single).all()
    assert len(found.unidentifiable) == 1
    assert found.unidentifiable[0].names == ("z_nm", "mass_kda")
    # along the direction nothing changes: the two derivatives cancel
    along = np.array([0, 0, *found.unidentifiable[0].direction])
    size = found.fisher[2, 2]
    assert abs(along @ found.fisher @ along) < 1e-12 * size
    assert str(found.unidentifiable[0]).startswith("z_nm–mass_kda: the image does not change")


def test_dark_field_in_focus_does_not_see_the_height() -> None:
    """Matched indices, z = z_f: |E|² is even in the defocus, so that J_zz vanishes."""
    config = small_config(
        optics={
            "scheme": "darkfield", "n_immersion": 1.5, "n_glass": 1.5, "n_sample": 1.5,
            "focus_nm": 100.0,
        }
    )  # fmt: skip
    found = plan(config).bounds(PARAMETERS)
    assert math.isnan(found.crb_single[2])
    assert math.isnan(found.crb_joint[2])
    assert np.isfinite(found.crb_joint[[0, 1, 3]]).all()
    assert [u.names for u in found.unidentifiable] == [("z_nm",)]


def test_nothing_seen_is_said_of_every_parameter() -> None:
    found = bounds_from_matrices(np.zeros((4, 4)), np.eye(4), PARAMETERS)
    assert np.isnan(found.crb_joint).all()
    assert [u.names[0] for u in found.unidentifiable] == list(PARAMETERS)
    assert math.isnan(found.inflation)


def test_only_free_parameters_are_bounded() -> None:
    found = plan(small_config()).bounds(("x_nm", "mass_kda"))
    assert np.isnan(found.crb_joint[[1, 2]]).all()
    assert np.isnan(found.qcrb[[1, 2]]).all()
    assert np.isfinite(found.crb_joint[[0, 3]]).all()


@pytest.mark.parametrize("free", [(), ("w_nm",)])
def test_unknown_parameters_are_refused(free: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match="choose one or more of x_nm"):
        plan(small_config()).bounds(free)


def test_quantum_height_below_the_coverslip_is_refused() -> None:
    with pytest.raises(ConfigError, match="inside the coverslip"):
        quantum_information(forward_model(small_config(), 100.0), -1.0)


def test_finite_background_costs_root_two_and_then_nothing() -> None:
    known, equal, long = (
        bounds_report(small_config(bounds={"n_before": n, "n_after": 100}, particle={
            "diameter_nm": 2.0}))["actual"]["crb_joint"]["mass_kda"]
        for n in (0, 100, 10**9)
    )  # fmt: skip
    assert equal / known == pytest.approx(math.sqrt(2), rel=1e-4)
    assert long / known == pytest.approx(1, rel=1e-6)
