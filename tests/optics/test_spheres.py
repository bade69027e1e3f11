"""Spheres of any size: Mie's amplitudes, their pictures, and what they become where they are small.

The judges know nothing of the program: amplitudes of two libraries, and a sum over all rays of the
pupil that follows each electric field through space, glass and lens as a vector.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scipy.optimize
from numpy.typing import NDArray

import iscat_analysis as ia
from iscat_analysis.bounds import event_bounds, quantum_information
from iscat_analysis.bounds.experiment import bounds_report, plan
from iscat_analysis.config import Config, configure
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model
from iscat_analysis.optics.model import collected_area_nm2
from iscat_analysis.optics.scatterers import (
    Sphere,
    amplitudes,
    coefficients,
    material,
    scattering_length_nm,
)
from iscat_analysis.records import PARAMETERS, with_diameters
from iscat_analysis.report.answer import as_diameters
from iscat_analysis.trust.response import response_of
from iscat_analysis.trust.systematic import assumed_error
from iscat_analysis.units import sphere_mass_kda
from tests.rays import picture_of_rays

ComplexArray = NDArray[np.complex128]

GRID = PixelGrid.centred(15, 130.0)
SILICA, GOLD = 1.46, 0.5423 + 2.2667j

SCATTNLAY = {
    # size parameter, relative index: S1 and S2 at the cosines −1 and 0.9 (scattnlay 2.4)
    (0.4, 1.46 / 1.33 + 0j): (
        [1.0641004251655e-05 - 0.0038650017868708j, 1.0650019164541e-05 - 0.0041154525977057j],
        [-1.0641004251655e-05 + 0.0038650017868708j, 9.5853090192202e-06 - 0.0037049280940655j],
    ),
    (2.5, 1.1 + 0j): (
        [-0.024309217224205 + 0.11110828875271j, 0.14694749656427 - 0.94669625478217j],
        [0.024309217224205 - 0.11110828875271j, 0.139054671276 - 0.86292485150994j],
    ),
    (1.2, 0.4 + 1.7j): (
        [0.59395226234912 + 0.30980776312346j, 1.5569947014234 + 0.13472489262698j],
        [-0.59395226234912 - 0.30980776312346j, 1.3192005980913 + 0.20867019735797j],
    ),
}
COSINES = np.array([-1.0, 0.9])


def of(scheme: str, **changes: Any) -> Config:
    """Make a configuration of a sphere, changed by section."""
    sections: dict[str, dict[str, Any]] = {
        "optics": {"scheme": scheme, "attenuation": 0.7, "focus_nm": 150.0},
        "camera": {"pixel_size_nm": 90.0},
        "particle": {"kind": "silica", "model": "mie", "diameter_nm": 150.0, "height_nm": 130.0},
        "fit": {"mode": "size"},
        "bounds": {"pixels": 25, "n_before": 50, "n_after": 50},
    }
    for section, keys in changes.items():
        whole = sections.get(section, {}) | keys
        sections[section] = {k: v for k, v in whole.items() if v is not None}
    return configure(sections)


def model_of(config: Config) -> ForwardModel:
    """Make the model of a configuration, for the pixels of `GRID`."""
    return forward_model(config, 2200.0)


@pytest.mark.parametrize("case", SCATTNLAY)
def test_amplitudes_agree_with_a_second_library(case: tuple[float, complex]) -> None:
    found = amplitudes(coefficients(case[0], case[0], case[1], 0.0), COSINES.astype(complex))
    expected = np.array(SCATTNLAY[case])
    assert np.abs(np.array(found) - expected).max() < 1e-8 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("scheme", "index", "diameter", "na"),
    [("iscat", SILICA, 200.0, 1.42), ("cobri", GOLD, 100.0, 1.2)],
)
def test_the_picture_is_a_sum_over_rays(
    scheme: str, index: complex, diameter: float, na: float
) -> None:
    permittivity = [float((index**2).real), float(np.imag(index**2))]
    particle = {"kind": "custom", "permittivity": permittivity, "density_kg_m3": 2000.0,
                "diameter_nm": diameter}  # fmt: skip
    points = {"samples_per_pixel": 1}  # where the rays are summed
    config = of(scheme, optics={"na": na}, particle=particle, camera=points)
    model = model_of(config)
    signal = model.image(GRID, 40.0, -70.0, 130.0, model.material.mass_kda)
    height = config.particle.nominal_height_nm
    slow = picture_of_rays(config.optics, index, diameter, height, height, GRID, (40.0, -70.0))
    assert np.abs(signal - slow).max() < 1e-6 * np.abs(slow).max()


@pytest.mark.parametrize("scheme", ["iscat", "cobri"])
def test_a_small_sphere_is_a_dipole(scheme: str) -> None:
    """The difference falls with the square of the diameter; what is left without it is nothing."""
    dipole = model_of(of(scheme, particle={"model": "dipole"}, fit={"mode": "joint"}))
    sphere = model_of(of(scheme))
    differences = []
    for diameter in (1.0, 2.0):
        mass = sphere_mass_kda(diameter, 2200.0)
        as_dipole = dipole.image(GRID, 30.0, 20.0, 130.0, mass)
        difference = sphere.image(GRID, 30.0, 20.0, 130.0, mass) - as_dipole
        differences.append(difference / np.abs(as_dipole).max())
    one, two = differences
    assert 1e-7 < np.abs(one).max() < 1e-4  # the control: a sphere is no dipole
    assert np.abs(4 * one - two).max() / 3 < 1e-6


def test_derivatives_are_those_of_the_picture() -> None:
    model = model_of(of("iscat"))
    mass = model.material.mass_kda
    theta = np.array([35.0, -20.0, 130.0, mass])
    _, gradient, hessian = model.amplitude_hessian(GRID, *map(float, theta))
    _, first = model.signal(GRID, theta[:4])
    for k, step in enumerate((2.0, 2.0, 2.0, 0.01 * mass)):
        moved = []
        for times in (-2, -1, 1, 2):
            at = theta.copy()
            at[k] += times * step
            moved.append(model.amplitude_image(GRID, *map(float, at)))
        expected = (moved[0] - 8 * moved[1] + 8 * moved[2] - moved[3]) / (12 * step)
        for found in (gradient[k], first[k]):
            assert np.abs(found - expected).max() < 1e-5 * np.abs(expected).max()
        pairs = [(k, 0), (k, 3)]
        for i, j in pairs:
            below, above = theta.copy(), theta.copy()
            below[i] -= step / 2
            above[i] += step / 2
            slopes = [model.signal(GRID, at)[1][j] for at in (below, above)]
            bend = (slopes[1] - slopes[0]) / step
            assert np.abs(hessian[i, j] - bend).max() < 1e-3 * np.abs(bend).max()


def test_the_quantum_bound_is_of_the_same_light() -> None:
    """It is that of a dipole for a small sphere, and below the camera's bound for a large one."""
    dipole = model_of(of("iscat", particle={"model": "dipole"}, fit={"mode": "joint"}))
    sphere = model_of(of("iscat"))
    small = sphere_mass_kda(2.0, 2200.0)
    expected = quantum_information(dipole, 130.0)
    found = quantum_information(sphere, 130.0, amplitude=small)
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()
    large = quantum_information(sphere, 130.0)[3, 3].real
    mass = sphere.material.mass_kda
    photons = [collected_area_nm2(sphere, 130.0, m) for m in (0.999 * mass, 1.001 * mass)]
    assert large > (math.log(photons[1] / photons[0]) / 0.002) ** 2  # of their number alone
    assert large < 0.6 * expected[3, 3].real  # light that a dipole would scatter back is lost
    experiment = plan(of("iscat"))
    bounds = event_bounds(experiment.likelihood, experiment.theta, PARAMETERS, experiment.collected)
    assert np.all(bounds.crb_single > bounds.qcrb)
    assert bounds_report(of("iscat"))["at"]["mode"] == "size"


def test_light_is_counted_where_it_falls() -> None:
    """What the pupil collects arrives on the camera, all but what falls beside the pixels."""
    experiment = plan(of("iscat", camera={"samples_per_pixel": 2}, bounds={"pixels": 81}))
    assert 0.97 < experiment.on_camera / experiment.collected < 1.0


def test_a_sphere_that_grows_is_no_longer_proportional_to_its_mass() -> None:
    sphere = Sphere(1.0, 2200.0, SILICA)
    cos_s, k = np.array([1.0 + 0j]), 2 * math.pi / 525.0
    small, large = (
        sphere.of_mass(sphere_mass_kda(d, 2200.0)).pattern(cos_s, 1.0, 1.33, k)[1][0]
        for d in (2.0, 250.0)
    )
    assert abs(large / small) < 0.5


BAD = [
    ({"particle": {"diameter_nm": 5000.0}}, "larger than the square"),
    ({"particle": {"height_nm": 20.0}}, "reach into the coverslip"),
    ({"particle": {"kind": "custom", "index": 1.33, "density_kg_m3": 1000.0}}, "scatters no light"),
    ({"particle": {"kind": "custom", "permittivity": [1.33**2, 0.0], "density_kg_m3": 1000.0}},
     "scatters no light"),
    ({"particle": {"model": "shell", "kind": "custom", "index": 1.33, "shell_nm": 5.0,
                   "shell_index": 1.33, "density_kg_m3": 1000.0}}, "scatters no light"),
    ({"particle": {"model": "shell", "shell_nm": 90.0, "shell_index": 1.48,
                   "density_kg_m3": 1000.0}}, "more than the radius"),
    ({"particle": {"model": "shell", "shell_nm": 5.0}}, "needs shell_index"),
    ({"particle": {"shell_nm": 5.0}}, 'needs model = "shell"'),
    ({"particle": {"model": "dipole"}}, "fits spheres"),
    ({"fit": {"mode": "mass"}}, "is for dipoles"),
    ({"fit": {"mode": "track"}}, "needs a background that is known"),
    ({"fit": {"mode": "track"}, "background": {"frames": "all"}}, "background that is known"),
    ({"fit": {"mode": "track"}, "track": {"free": "mass"}}, 'needs track.free = "joint"'),
    ({"fit": {"diameter_range_nm": [300.0, 200.0]}}, "is empty"),
    ({"optics": {"calibrate": "always"}}, "is for dipoles"),
    ({"optics": {"n_sample": [1.33, 0.01]}}, "n_sample"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), BAD)
def test_what_cannot_be_is_said(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(Exception, match=message) as caught:
        of("iscat", **changes)
    assert type(caught.value).__name__ == "ConfigError"


def test_a_part_that_is_seen_is_enough() -> None:
    """A shell of the sample's index around silica, and a vesicle full of the sample, are seen."""
    shell = {"model": "shell", "shell_nm": 5.0, "density_kg_m3": 1500.0}
    for more in (
        {"kind": "silica", "shell_index": 1.33},
        {"kind": "custom", "index": 1.33, "shell_index": 1.46},
        {"kind": "custom", "permittivity": [1.33**2, 0.1], "shell_index": 1.33},
    ):
        assert of("iscat", particle=shell | more).particle.is_sphere


def test_a_bubble_has_the_other_sign() -> None:
    """An index below that of the sample is no error: such particles exist."""
    bubble = {"kind": "custom", "density_kg_m3": 1000.0, "diameter_nm": 40.0}
    peaks = [
        model.peak_contrast(130.0, model.material.mass_kda)
        for index in (1.30, 1.36)
        for model in [model_of(of("iscat", particle=bubble | {"index": index}))]
    ]
    assert peaks[0] * peaks[1] < 0


OPTICS = ia.Optics(na=1.42, focus_nm=0.0)
CAMERA = ia.Camera(pixel_size_nm=90.0, gain_e_per_adu=1.0, offset_adu=0.0, read_noise_e=0.0)


def counts_of(particle: ia.Particle, count: int, light_e: float, seed: int) -> list[Any]:
    """Draw counts before and after particles that land, of as much light in all frames."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-45.0, 45.0, (2, count))
    heights = particle.nominal_height_nm + rng.uniform(0.0, 30.0, count)
    pictures = ia.psf(
        OPTICS, particle, CAMERA, pixels=23, x_nm=places[0], y_nm=places[1], z_nm=heights
    )
    return [rng.poisson(light_e * light) for light in (np.ones_like(pictures), 1 + pictures)]


def fitted(particle: ia.Particle, counts: list[Any], mode: str = "size") -> pd.DataFrame:
    """Fit particles in regions."""
    return ia.fit_rois(
        *counts, OPTICS, particle, CAMERA, n_before=100, n_after=100, mode=mode, power_ratio=1.0,
        z_range_nm=(0.0, 250.0),
    )  # fmt: skip


def test_the_diameter_is_found_and_a_dipole_does_not_fit() -> None:
    sphere = ia.Particle(kind="silica", model="mie", diameter_nm=150.0)
    counts = counts_of(sphere, 2, 1e6, seed=4)
    table = fitted(sphere, counts)
    assert set(table["status"]) == {"ok"}
    assert np.all(np.abs(table["diameter_nm"] - 150.0) < 4 * table["sigma_diameter_nm"])
    assert np.allclose(table["sigma_diameter_nm"], table["crb_diameter_nm"], rtol=0.05)
    assert np.all(table["qcrb_diameter_nm"] < table["crb_diameter_nm"])
    expected = sphere_mass_kda(1.0, 2200.0) * table["diameter_nm"] ** 3
    assert np.allclose(table["mass_kda"], expected)
    dipole = ia.Particle(kind="silica", diameter_nm=150.0, height_nm="contact")
    assert set(fitted(dipole, counts, "joint")["status"]) == {"poor_fit"}


def test_a_vesicle_among_proteins_is_no_heavy_protein() -> None:
    """The focus is where 5 nm above the glass is imaged at 0; the vesicle's centre is higher."""
    vesicle = ia.Particle(
        kind="custom", model="mie", index=1.40, density_kg_m3=1100, diameter_nm=60.0
    )
    focus = (30.0 - 5.0) * (1 - OPTICS.n_immersion / OPTICS.n_sample)
    lifted = OPTICS.model_copy(update={"focus_nm": focus})
    rng = np.random.default_rng(3)
    light = 1e6 * (1 + np.array([ia.psf(lifted, vesicle, CAMERA, pixels=23)] * 3))
    counts = [rng.poisson(1e6, light.shape), rng.poisson(light)]
    protein = ia.Particle(mass_kda=3000.0)
    assert set(fitted(protein, counts, "mass")["status"]) == {"poor_fit"}


@pytest.mark.large
@pytest.mark.parametrize(
    ("kind", "diameter"),
    [("gold", 20.0), ("gold", 80.0), ("gold", 150.0), ("silica", 50.0), ("silica", 150.0),
     ("silica", 300.0)],
)  # fmt: skip
def test_errors_of_the_diameter_are_as_large_as_said(
    kind: str, diameter: float, share: float
) -> None:
    """Pulls of n fits have the mean 0 ± 1/√n and the spread 1 ± 1/√(2n)."""
    sphere = ia.Particle(kind=kind, model="mie", diameter_nm=diameter)
    n = max(4, round(40 * share))
    table = fitted(sphere, counts_of(sphere, n, 1e6, seed=8))
    pulls = (table["diameter_nm"] - diameter) / table["sigma_diameter_nm"]
    assert abs(pulls.mean()) < 4 / math.sqrt(n)
    assert abs(pulls.std() - 1) < 4 / math.sqrt(2 * n)
    assert (table["status"] == "ok").mean() > 0.8


@pytest.mark.large
def test_two_diameters_that_faint_light_does_not_tell_apart_are_said() -> None:
    """Of forty photoelectrons per pixel most diameters have another; of a million none has."""
    sphere = ia.Particle(kind="silica", model="mie", diameter_nm=100.0)
    few, many = (fitted(sphere, counts_of(sphere, 8, light, seed=2)) for light in (40.0, 1e6))
    ambiguous = ["ambiguous_size" in flags for flags in few["flags"]]
    assert sum(ambiguous) >= 2
    assert np.all(few["other_odds"][ambiguous] > 1e-3)
    assert not any("ambiguous_size" in flags for flags in many["flags"])


@pytest.mark.large
def test_a_shell_of_the_same_index_is_none() -> None:
    """And a vesicle is none: water in a shell scatters less than a sphere of the shell's matter."""
    pytest.importorskip("scattnlay")
    keys = {"density_kg_m3": 1000.0, "diameter_nm": 120.0}
    solid = ia.psf(OPTICS, ia.Particle(kind="custom", model="mie", index=1.46, **keys), CAMERA)
    shell, vesicle = (
        ia.psf(
            OPTICS,
            ia.Particle(kind="custom", model="shell", index=core, shell_nm=5, shell_index=1.46,
                        **keys),
            CAMERA,
        )
        for core in (1.46, 1.335)
    )  # fmt: skip
    assert np.abs(shell - solid).max() < 1e-8 * np.abs(solid).max()
    assert np.abs(vesicle).max() < 0.7 * np.abs(solid).max()


def test_a_small_sphere_with_a_shell_scatters_like_one_without() -> None:
    """Of the index that Bohren and Huffman give, to the second order in its size."""
    pytest.importorskip("scattnlay")
    mu = np.array([-1.0, -0.5, 0.3], dtype=complex)
    for core in (1.33, 1.38, 1.6, 0.5 + 2.2j):
        shelled = Sphere(1.0, 1350.0, complex(core), shell_nm=0.5, shell_index=1.46)
        alike = shelled.homogeneous()
        assert alike.shell_nm == 0
        own, other = (one.pattern(mu, 1.0, 1.33, 2 * np.pi / 525)[1] for one in (shelled, alike))
        assert np.allclose(own, other, rtol=1e-3)
    plain = Sphere(1.0, 1350.0, 1.46 + 0j)
    assert plain.homogeneous() == plain


def test_contrasts_that_are_all_wrong_make_masses_of_spheres_wrong_by_more() -> None:
    """Against a least-squares fit of a picture that is one per cent stronger."""
    config = of("iscat", particle={"diameter_nm": 180.0, "height_nm": "contact"})
    respond = response_of(config, pd.DataFrame({"n_before": [1000], "n_after": [1000]}), ())
    truth = respond.theta(90.0, sphere_mass_kda(180.0, config.particle.density))
    scale = np.array([1.0, 1.0, 1.0, truth[3] / 100, 0.01])

    def picture(steps: np.ndarray) -> np.ndarray:
        x, y, z, mass, level = truth + steps * scale
        return respond.model.amplitude_image(respond.grid, x, y, z, mass) + level

    signal = picture(np.zeros(5))
    weight = 1 / np.sqrt((1 + signal) * (2 + signal))  # noise of both windows
    free = np.array([True, True, True, True, respond.level])

    def left(some: np.ndarray) -> np.ndarray:
        steps = np.zeros(5)
        steps[free] = some
        return ((picture(steps) - 1.01 * signal) * weight).ravel()

    found = scipy.optimize.least_squares(left, np.zeros(free.sum()), x_scale=1.0).x[3]
    told = respond.to_contrast(90.0, float(truth[3]))
    assert told == pytest.approx(found, rel=0.02)
    assert found > 1.2  # that of a dipole is 1


def test_the_error_of_an_assumed_index_is_in_the_diameter() -> None:
    """A small sphere scatters like V (m² − 1)/(m² + 2), and the picture holds V L."""
    config = of("iscat", particle={"diameter_nm": 40.0, "height_nm": "contact"})
    mass = config.particle.nominal_mass_kda
    rows = {"n_before": [1000], "n_after": [1000], "z_nm": [20.0], "mass_kda": [mass],
            "status": ["ok"]}  # fmt: skip
    share = assumed_error("index", config, pd.DataFrame(rows))["mass_kda"][0] / mass

    def strength(n: float) -> float:
        return math.log((n**2 - 1.33**2) / (n**2 + 2 * 1.33**2))

    n = index_of(config)
    expected = strength(n + config.uncertainty.index) - strength(n)
    assert share == pytest.approx(expected, rel=0.06)
    assert assumed_error("wavelength_nm", config, pd.DataFrame(rows))["mass_kda"][0] > 0


def test_an_index_that_was_fitted_is_not_assumed() -> None:
    """It takes its part of what a wrong wavelength does: as in a fit of the picture."""
    config = of("iscat", particle={"diameter_nm": 200.0, "height_nm": 100.0})
    mass, n = config.particle.nominal_mass_kda, index_of(config)
    rows = {"n_before": [1000], "n_after": [1000], "z_nm": [100.0], "mass_kda": [mass],
            "status": ["ok"], "refractive_index": [n]}  # fmt: skip
    assert assumed_error("index", config, pd.DataFrame(rows))["mass_kda"][0] == 0.0
    told = assumed_error("wavelength_nm", config, pd.DataFrame(rows))["mass_kda"][0] / mass
    respond = response_of(config, pd.DataFrame(rows), ())
    sigma = config.uncertainty.wavelength_nm
    optics = config.optics.model_copy(update={"wavelength_nm": config.optics.wavelength_nm + sigma})
    other = forward_model(config.model_copy(update={"optics": optics}), respond.model.reach_nm)
    theta = respond.theta(100.0, mass)
    seen = other.amplitude_image(respond.grid, *theta[:4].tolist())
    likelihood = respond.expected(theta)
    weight = np.sqrt(likelihood.signal_information(likelihood.signal(theta)))

    def left(some: np.ndarray) -> np.ndarray:
        x, y, z, part, index = some.tolist()
        model = respond.model.of_index(n + index)  # type: ignore[attr-defined]
        here = (theta[:3] + np.array([x, y, z])).tolist()
        picture = model.amplitude_image(respond.grid, *here, mass * (1 + part))
        return np.asarray((picture - seen) * weight).ravel()

    scale = [1.0, 1.0, 1.0, 0.01, 0.001]
    found = scipy.optimize.least_squares(left, np.zeros(5), x_scale=scale).x[3]
    assert told == pytest.approx(abs(found), rel=0.05)


def index_of(config: Config) -> float:
    """Give the index of the sphere of a configuration."""
    return float(material(config.particle, config.optics.wavelength_nm).permittivity.real ** 0.5)


def test_the_scattering_length_of_a_small_sphere_is_that_of_its_polarisability() -> None:
    optics = ia.Optics()
    m2 = (1.46 / optics.n_sample) ** 2
    expected = 10.0 * ((m2 - 1) / (m2 + 2)) ** (1 / 3)
    small = Sphere(sphere_mass_kda(10.0, 2200.0), 2200.0, SILICA)
    assert scattering_length_nm(small, optics) == pytest.approx(expected, rel=1e-2)
    large = small.of_mass(sphere_mass_kda(250.0, 2200.0))
    assert scattering_length_nm(large, optics) < 20 * expected  # 25 times if it were small


def test_no_error_of_a_mass_is_shown_as_that_of_a_diameter() -> None:
    kinds = ("sigma", "crb", "qcrb", "systematic")
    columns = {f"{kind}_mass_kda": [3e3] for kind in kinds} | {"mass_kda": [1e5]}
    counted = {"frame": [0], "n_before": [9], "n_after": [9], "repeat_mass_kda": [3e3]}
    table = with_diameters(pd.DataFrame(columns | counted), 2200.0)
    shown = as_diameters(table)
    for kind in kinds:  # 3 % of a mass is 1 % of a diameter
        assert shown[f"{kind}_mass_kda"][0] == pytest.approx(0.01 * shown["mass_kda"][0])
