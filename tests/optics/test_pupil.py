"""Any pupil against golden numbers, a plain sum over its rays, and laws of physics."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import reference
from golden_setups import GOLDEN, reference_setup

from iscat_analysis.bounds import bounds_report, quantum_information
from iscat_analysis.config import Config, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.waves import LatticeField, RadialField

MICROSCOPES: list[dict[str, Any]] = json.loads(
    (GOLDEN / "microscopes.json").read_text(encoding="utf-8")
)
GOLDEN_FIELD = 1e-6  # precision promised by the golden files
GOLDEN_CRB = 1e-5
TABLE = 1e-7  # error of the tables, relative to the peak
TABLE_SLOPE = 3e-6  # error of their slopes
TABLE_BEND = 2e-4  # error of their second derivatives
OPTICS = (
    "wavelength_nm", "na", "n_immersion", "n_glass", "n_sample", "emission", "focus_nm", "scheme",
    "attenuation", "polarization", "polarization_deg", "analyzer", "mask_na",
    "reference_phase_deg", "aberrations_nm",
)  # fmt: skip
GRID = PixelGrid.centred(12, 90.0)
AT = (31.0, -57.0, 140.0)

PUPILS: dict[str, dict[str, Any]] = {
    "circular": {"polarization": "circular"},
    "circular, analysed": {"polarization": "circular", "analyzer": True},
    "linear, analysed": {"polarization_deg": 25.0, "analyzer": True},
    "mask": {"mask_na": 0.7, "attenuation": 0.2, "reference_phase_deg": -40.0},
    "mask beyond the critical angle": {"na": 1.45, "mask_na": 1.38, "attenuation": 0.4},
    "spherical": {"aberrations_nm": {"z11": 20.0, "z22": -8.0, "z37": 5.0}},
    "coma": {"aberrations_nm": {"z7": 15.0, "z8": -20.0}, "polarization_deg": 40.0},
    "everything": {
        "polarization": "circular", "analyzer": True, "mask_na": 0.5, "attenuation": 0.1,
        "na": 1.47, "reference_phase_deg": 130.0,
        "aberrations_nm": {"z5": 12.0, "z6": -9.0, "z9": 6.0, "z11": 8.0, "z14": -5.0},
    },
    "cobri": {"scheme": "cobri", "attenuation": 0.1, "aberrations_nm": {"z5": 20.0, "z8": 10.0}},
    "dark field": {"scheme": "darkfield", "mask_na": 0.4, "attenuation": 0.3,
                   "aberrations_nm": {"z6": 25.0}},
}  # fmt: skip


def microscope(optics: dict[str, Any], **camera: Any) -> Config:
    base = {"na": 1.42, "wavelength_nm": 525.0, "focus_nm": 200.0}
    return parse_config(
        {
            "optics": {**base, **optics},
            "camera": {"pixel_size_nm": 90.0, **camera},
            "particle": {
                "kind": "gold", "permittivity": (-3.7, 2.8), "diameter_nm": 30.0,
                "height_nm": 60.0,
            },
            "bounds": {"pixels": 25, "n_before": 0, "n_after": 1, "x_nm": 13.0, "y_nm": -27.0},
            "fit": {"mode": "joint"},
        }
    )  # fmt: skip


def build(optics: dict[str, Any], **camera: Any) -> ForwardModel:
    return forward_model(microscope(optics, **camera), 2500.0)


def instrument(config: Config) -> reference.Instrument:
    o = config.optics
    return reference.Instrument(
        polarization=o.polarization,
        psi=np.radians(o.polarization_deg),
        analyzer=o.analyzer,
        mask_na=o.mask_na,
        reference_phase=np.radians(o.reference_phase_deg),
        aberrations_nm=tuple((int(k[1:]), v) for k, v in o.aberrations_nm.items()),
    )


def golden(case: dict[str, Any]) -> Config:
    return parse_config(
        {
            "optics": {key: case[key] for key in OPTICS},
            "camera": {"pixel_size_nm": case["pixel_nm"], "samples_per_pixel": 1},
            "particle": {
                "kind": "gold", "permittivity": tuple(case["permittivity"]),
                "diameter_nm": 2 * case["radius_nm"], "height_nm": case["z_nm"],
            },
            "bounds": {
                "pixels": case["pixels"], "x_nm": case["x_nm"], "y_nm": case["y_nm"], "n_before": 0,
            },
            "fit": {"mode": "joint"},
        }
    )  # fmt: skip


@pytest.mark.parametrize("case", MICROSCOPES, ids=lambda case: case["name"])
def test_field_and_image_agree_with_golden(case: dict[str, Any]) -> None:
    config = golden(case)
    model = forward_model(config, 2600.0)
    points = case["field_over_reference"]
    dx, dy = (np.array([p[key] for p in points]) for key in ("x_nm", "y_nm"))
    wanted = np.array([np.array(p["components"]) @ [1, 1j] for p in points]).T
    mass = model.material.mass_kda
    found = model.field(dx, dy, case["z_nm"], mass)
    found = found * np.exp(1j * np.radians(case["reference_phase_deg"]))  # over |E_ref| there
    if not case["analyzer"]:  # from the polarisation's own components to those along x and y
        psi = np.radians(case["polarization_deg"])
        p = np.array([np.cos(psi), np.sin(psi)]), np.array([-np.sin(psi), np.cos(psi)])
        if case["polarization"] == "circular":
            p = np.array([1, 1j]) / np.sqrt(2), np.array([1, -1j]) / np.sqrt(2)
        found = np.stack(p, axis=1) @ found
    assert found.shape == wanted.shape
    assert np.abs(found - wanted).max() < GOLDEN_FIELD * np.abs(wanted).max()
    grid = PixelGrid.centred(case["pixels"], case["pixel_nm"])
    image = model.image(grid, case["x_nm"], case["y_nm"], case["z_nm"], mass)
    size = max(abs(case["contrast_min"]), abs(case["contrast_max"]))
    assert abs(image.min() - case["contrast_min"]) < GOLDEN_FIELD * size
    assert abs(image.max() - case["contrast_max"]) < GOLDEN_FIELD * size
    assert abs(image[0, 0] - case["contrast_corner"]) < GOLDEN_FIELD * size


@pytest.mark.parametrize("case", MICROSCOPES, ids=lambda case: case["name"])
def test_bounds_agree_with_golden(case: dict[str, Any]) -> None:
    report = bounds_report(golden(case))
    found = report["per_photon"]

    def worst(mine: str, theirs: str) -> float:
        return max(
            abs(found[mine]["mass_rel" if key == "m_rel" else key] / value - 1)
            for key, value in case[theirs].items()
        )

    assert worst("crb_single", "crb_single_per_photon") < GOLDEN_CRB
    assert worst("crb_joint", "crb_joint_xyzm_per_photon") < GOLDEN_CRB
    assert worst("qcrb", "qcrb_collected_per_photon") < GOLDEN_FIELD
    lossy = case["analyzer"] or case["mask_na"] > 0
    assert ("qcrb_transmitted" in found) == lossy
    if lossy:
        assert worst("qcrb_transmitted", "qcrb_transmitted_per_photon") < GOLDEN_FIELD
        share = report["transmitted_over_collected"]
        assert share == pytest.approx(case["transmitted_over_collected"], rel=GOLDEN_FIELD)
        for name, value in report["actual"]["qcrb_transmitted"].items():
            assert value >= report["actual"]["qcrb"][name] * (1 - 1e-12)
    per_reference = report["n_scattered"]["camera"] / (1e4 * report["at"]["n_after"])
    assert per_reference == pytest.approx(case["photons_on_camera_per_reference"], rel=GOLDEN_FIELD)


def test_random_pupils_agree_with_a_sum_over_rays() -> None:
    random = np.random.default_rng(11)
    kinds = set()
    for trial in range(10):
        some = random.choice(np.arange(5, 38), size=random.integers(1, 8), replace=False)
        terms = some if trial else [11, 37]
        config = microscope(
            {
                "na": random.uniform(1.2, 1.49),
                "polarization": random.choice(["linear", "circular"]).item(),
                "polarization_deg": random.uniform(-90, 90),
                "analyzer": bool(random.integers(2)),
                "mask_na": random.choice([0.0, random.uniform(0.2, 1.15)]).item(),
                "attenuation": random.uniform(0.05, 0.9),
                "reference_phase_deg": random.uniform(-180, 180),
                "scheme": random.choice(["iscat", "cobri"]).item(),
                "emission": random.choice(["reciprocal", "dong2021"]).item(),
                "focus_nm": random.uniform(-600, 600),
                "aberrations_nm": {f"z{j}": random.uniform(-30, 30) for j in terms}
                if trial
                else {},
            }
        )
        model = forward_model(config, 2200.0)
        kinds.add(type(model.wave))
        r, phi = random.uniform(0, 1500, 8), random.uniform(0, 2 * np.pi, 8)
        dx, dy = r * np.cos(phi), r * np.sin(phi)
        z_nm = random.uniform(0, 400)
        setup = reference_setup(config)
        over = reference.reference_amplitude(setup) * np.exp(
            1j * instrument(config).reference_phase
        )
        wanted = reference.pupil_fields(setup, instrument(config), dx, dy, z_nm).T / over
        mass = model.material.mass_kda
        found = model.field(dx, dy, z_nm, mass)
        wanted = wanted[: len(found)]
        size = np.abs(model.field(np.zeros(1), np.zeros(1), z_nm, mass)).max()
        assert np.abs(found - wanted).max() < TABLE * max(size, np.abs(wanted).max())
        signal = (np.abs(wanted) ** 2).sum(0) + 2 * wanted[0].real
        for x, y, s in zip(dx, dy, signal, strict=True):
            one = PixelGrid(np.array([x]), np.array([y]), 1.0)
            image = model.image(one, 0.0, 0.0, z_nm, mass)[0, 0]
            assert abs(image - s) < 4 * TABLE * max(np.abs(signal).max(), 2 * size + size**2)
    assert kinds == {RadialField, LatticeField}


@pytest.mark.parametrize("samples", [1, 2])
@pytest.mark.parametrize("optics", PUPILS.values(), ids=PUPILS)
def test_derivatives_are_slopes(optics: dict[str, Any], samples: int) -> None:
    model = build(optics, samples_per_pixel=samples)
    mass = model.material.mass_kda
    at = np.array([*AT, mass])
    signal, gradient = model.gradient(GRID, *at)
    image, first, second = model.amplitude_hessian(GRID, *at)
    assert np.abs(signal - model.image(GRID, *at)).max() < 1e-12 * np.abs(signal).max()
    assert np.abs(image - signal).max() < 1e-12 * np.abs(signal).max()
    for k, step in enumerate((2.0, 2.0, 2.0, 1e-3 * mass)):
        shift = np.eye(4)[k] * step
        # a fourth-order difference: (k·2 nm)⁴/30 of the fifth derivative
        up, down, far_up, far_down = (
            model.gradient(GRID, *(at + n * shift)) for n in (1, -1, 2, -2)
        )
        slope = (8 * (up[0] - down[0]) - (far_up[0] - far_down[0])) / (12 * step)
        bend = (8 * (up[1] - down[1]) - (far_up[1] - far_down[1])) / (12 * step)
        size = np.abs(gradient[k]).max()
        assert np.abs(gradient[k] - slope).max() < TABLE_SLOPE * size
        assert np.abs(first[k] - gradient[k]).max() < 1e-9 * size
        for i in range(4):
            natural = np.abs(gradient[i]).max() / (mass if k == 3 else 100.0)
            size = max(np.abs(second[k, i]).max(), natural)
            assert np.abs(second[k, i] - bend[i]).max() < TABLE_BEND * size


@pytest.mark.parametrize(
    "optics", [*list(PUPILS.values())[:6], {"na": 1.25, "polarization_deg": -30.0}]
)
def test_the_lattice_reproduces_the_radial_tables(optics: dict[str, Any]) -> None:
    """A term of no size makes a round pupil general: the two kernels must agree."""
    terms = optics.get("aberrations_nm", {})
    model, other = build(optics), build({**optics, "aberrations_nm": {**terms, "z5": 1e-12}})
    assert isinstance(model.wave, RadialField)
    assert isinstance(other.wave, LatticeField)
    mass = model.material.mass_kda
    signal, gradient = model.gradient(GRID, *AT, mass)
    signal_2, gradient_2 = other.gradient(GRID, *AT, mass)
    assert np.abs(signal - signal_2).max() < TABLE * np.abs(signal).max()
    for a, b in zip(gradient, gradient_2, strict=True):
        assert np.abs(a - b).max() < TABLE_SLOPE * np.abs(a).max()
    peak = model.peak_contrast(AT[2], mass)
    assert other.peak_contrast(AT[2], mass) == pytest.approx(peak, rel=1e-6)


@pytest.mark.parametrize("optics", PUPILS.values(), ids=PUPILS)
def test_peak_contrast_is_the_largest_signal(optics: dict[str, Any]) -> None:
    model = build(optics)
    mass = model.material.mass_kda
    axis = np.arange(-1200.0, 1200.0, 8.0)
    image = model.image(PixelGrid(axis, axis, 8.0), 0.0, 0.0, 30.0, mass)
    largest = image.ravel()[np.argmax(np.abs(image))]
    peak = model.peak_contrast(30.0, mass)
    assert np.sign(peak) == np.sign(largest)
    # pixels of 8 nm miss the top
    assert -TABLE < abs(peak) / abs(largest) - 1 < 2e-3


ROUNDING = 20  # of a sum over 11 200 rays, in units of its last digit: errors add as their root

NAMES = (
    "focus_nm", "na", "reference_phase_deg", "mask_na", "attenuation", "z5", "z6", "z7", "z8",
    "z9", "z10", "z11", "z14", "z22", "z28", "z37",
)  # fmt: skip


@pytest.mark.parametrize(
    "optics",
    [
        PUPILS["everything"],
        PUPILS["cobri"],
        PUPILS["dark field"],
        PUPILS["mask beyond the critical angle"],
        {"na": 1.25, "emission": "dong2021", "mask_na": 0.6, "polarization_deg": 50.0},
    ],
)  # fmt: skip
def test_joint_gradient_agrees_with_a_sum_over_rays(optics: dict[str, Any]) -> None:
    dx, dy = np.array([40.0, -130.0, 260.0, -390.0]), np.array([-75.0, 150.0, 330.0, -20.0])

    def rays(change: dict[str, Any]) -> np.ndarray:
        config = microscope(change)
        setup, pupil = reference_setup(config), instrument(config)
        field = reference.pupil_fields(setup, pupil, dx, dy, AT[2], nodes=70, azimuths=160).T
        field = field[: 1 if config.optics.analyzer else 2]
        if config.optics.scheme == "darkfield":
            return (np.abs(field) ** 2).sum(0)
        field = field / reference.reference_amplitude(setup) * np.exp(-1j * pupil.reference_phase)
        return (np.abs(field) ** 2).sum(0) + 2 * field[0].real

    model = build(optics)
    linear = model.optics.polarization == "linear"
    names = [*NAMES, "polarization_deg"] if linear else [*NAMES]
    found = [
        model.gradient(
            PixelGrid(np.array([x]), np.array([y]), 1.0), 0.0, 0.0, AT[2],
            model.material.mass_kda, names,
        )
        for x, y in zip(dx, dy, strict=True)
    ]  # fmt: skip
    signal = np.array([s[0, 0] for s, _ in found])
    assert np.abs(signal - rays(optics)).max() < 4 * TABLE * np.abs(signal).max()
    steps = {"focus_nm": 1.0, "na": 1e-4, "mask_na": 1e-4, "attenuation": 1e-4}
    base = microscope(optics).optics
    for k, name in enumerate(names):
        if name == "mask_na" and not base.mask_na:
            continue
        step = steps.get(name, 0.5)

        def shifted(by: float, name: str = name) -> np.ndarray:
            if name.startswith("z"):
                terms = dict(base.aberrations_nm)
                terms[name] = terms.get(name, 0.0) + by
                return rays({**optics, "aberrations_nm": terms})
            return rays({**optics, name: getattr(base, name) + by})

        slope = (
            8 * (shifted(step) - shifted(-step)) - (shifted(2 * step) - shifted(-2 * step))
        ) / (12 * step)
        mine = np.array([d[4 + k, 0, 0] for _, d in found])
        rounding = ROUNDING * np.finfo(float).eps * np.abs(signal).max() / step
        assert np.abs(mine - slope).max() < 1e-5 * np.abs(slope).max() + rounding


def test_joint_gradient_over_pixels_is_the_slope_of_the_image() -> None:
    optics = PUPILS["everything"]
    model = build(optics, samples_per_pixel=2)
    mass = model.material.mass_kda
    signal, slopes = model.gradient(GRID, *AT, mass, ["z8", "focus_nm"])
    exact, gradient = model.gradient(GRID, *AT, mass)
    assert np.abs(signal - exact).max() < TABLE * np.abs(exact).max()
    for mine, other in zip(slopes[:4], gradient, strict=True):
        assert np.abs(mine - other).max() < TABLE_SLOPE * np.abs(other).max()
    step = 0.2
    terms = {**optics["aberrations_nm"]}
    above, below = (
        build({**optics, "aberrations_nm": {**terms, "z8": s}}, samples_per_pixel=2).image(
            GRID, *AT, mass
        )
        for s in (step, -step)
    )
    numeric = (above - below) / (2 * step)
    assert np.abs(slopes[4] - numeric).max() < 1e-5 * np.abs(numeric).max()
    with pytest.raises(ConfigError, match='"circular" has no direction'):
        build({"polarization": "circular"}).gradient(GRID, *AT, mass, ["polarization_deg"])
    with pytest.raises(ConfigError, match="z4"):
        model.gradient(GRID, *AT, mass, ["z4"])


@pytest.mark.parametrize("scheme", ["iscat", "cobri"])
def test_the_quantum_bound_does_not_know_aberrations(scheme: str) -> None:
    plain = build({"scheme": scheme})
    bent = build({"scheme": scheme, "aberrations_nm": {"z5": 40.0, "z8": -30.0, "z11": 50.0}})
    assert np.array_equal(quantum_information(plain, 20.0), quantum_information(bent, 20.0))
    reports = [
        bounds_report(microscope({"scheme": scheme, "aberrations_nm": terms}))["per_photon"]
        for terms in ({}, {"z5": 40.0})
    ]
    # The same sums; processors round the last digit of their parts differently.
    assert reports[0]["qcrb"] == pytest.approx(reports[1]["qcrb"], rel=1e-14)
    assert abs(reports[1]["crb_single"]["z_nm"] / reports[0]["crb_single"]["z_nm"] - 1) > 0.01


def test_a_quarter_turn_of_light_and_coma_turns_the_picture() -> None:
    """Cosine coma (z8) and x-polarisation turned by 90° are sine coma (z7) and y-polarisation."""
    first = build({"aberrations_nm": {"z8": 25.0, "z6": 10.0}})
    turned = build({"polarization_deg": 90.0, "aberrations_nm": {"z7": 25.0, "z6": -10.0}})
    mass = first.material.mass_kda
    image = first.image(GRID, 20.0, -35.0, 120.0, mass)
    # (x, y) → (−y, x): the rows of the turned picture are the columns, mirrored
    other = turned.image(GRID, 35.0, 20.0, 120.0, mass)
    assert np.abs(np.rot90(image, -1) - other).max() < TABLE * np.abs(image).max()
    assert np.abs(image - other).max() > 0.1 * np.abs(image).max()


def test_circular_light_gives_a_round_picture() -> None:
    for optics in (PUPILS["circular"], PUPILS["circular, analysed"]):
        image = build(optics).image(PixelGrid.centred(13, 90.0), 0.0, 0.0, 60.0, 1e4)
        assert np.abs(image - image.T).max() < 1e-12 * np.abs(image).max()
        assert np.abs(image - np.rot90(image)).max() < 1e-12 * np.abs(image).max()


@pytest.mark.parametrize(
    ("optics", "complaint"),
    [
        ({"aberrations_nm": {"z4": 3.0}}, "defocus"),
        ({"aberrations_nm": {"coma": 3.0}}, "z5 to z37"),
        ({"aberrations_nm": {"z8": 400.0}}, "wavelengths rms"),
        ({"aberrations_nm": {"z8": float("nan")}}, "z8"),
        ({"mask_na": 1.5}, "below na"),
        ({"polarization": "elliptical"}, "polarization"),
    ],
)
def test_impossible_pupils_are_refused(optics: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        microscope(optics)


def test_the_paper_keeps_its_emission() -> None:
    assert parse_config({}).optics.emission == "reciprocal"
    assert parse_config({"optics": {"convention": "dong2021"}}).optics.emission == "dong2021"
    both = {"convention": "dong2021", "emission": "reciprocal"}
    assert parse_config({"optics": both}).optics.emission == "reciprocal"
