"""The joint estimator against plain differences, plain inverses, and known shifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from calibrations import GRID, configuration, make_particle_images, microscope

from iscat_analysis.config import config_to_toml, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.laws import CONDITIONAL, POISSON, NoiseLaw
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.joint_fit import JointLikelihood, maximise
from iscat_analysis.instrument.measure import search_starts
from iscat_analysis.instrument.particle_image import PRIVATE, ParticleImage, average_particle_images
from iscat_analysis.optics.parameters import free_groups, optics_limits, settings_of, with_settings
from iscat_analysis.optics.pixels import PixelGrid

NAMES = ("focus_nm", "na", "reference_phase_deg", "z7", "z11")


@pytest.mark.parametrize("noise", [CONDITIONAL, POISSON])
def test_pixel_terms_are_derivatives(noise: NoiseLaw) -> None:
    random = np.random.default_rng(3)
    signal = random.normal(0, 0.05, (6, 7))
    data = np.ones((4, 6, 7))
    data[0] = random.poisson(900, (6, 7))
    if noise == CONDITIONAL:
        data[1], data[2], data[3] = data[0] + random.poisson(1000, (6, 7)), 0.9, 0.97
    else:
        data[1], data[2], data[3] = 880.0, 880.0, 4.0
    terms = noise.terms(data, signal, 0.02)

    def value(change: np.ndarray, level: float) -> float:  # type: ignore[type-arg]
        return noise.terms(data, signal + change, level)[0]

    step = 1e-5
    push = np.zeros(signal.shape)
    push[2, 3] = step
    slope = (value(push, 0.02) - value(-push, 0.02)) / (2 * step)
    assert slope == pytest.approx(float(terms.score[2, 3]), rel=1e-6)
    nothing = np.zeros(signal.shape)
    slope = (value(nothing, 0.02 + step) - value(nothing, 0.02 - step)) / (2 * step)
    assert slope == pytest.approx(float((terms.score * terms.by_level).sum()), rel=1e-5)


def test_value_is_that_of_the_likelihood_of_fits() -> None:
    images, _, build = make_particle_images({}, 2, seed=4)
    settings = settings_of(configuration())
    model = build(settings)
    for image in images:
        likelihood = Likelihood(model, image.grid, image.noise, image.data)
        theta = np.array([image.x_nm, image.y_nm, image.z_nm, 5000.0, 0.01])
        place = (image.grid, image.x_nm, image.y_nm, image.z_nm, 5000.0)
        mine = image.noise.terms(image.data, model.gradient(*place)[0], 0.01)[0]
        assert mine == pytest.approx(likelihood.values(theta[None])[0], rel=1e-9)


@pytest.mark.parametrize("heights_nm", [None, (0.0, 200.0)])
def test_private_unknowns_are_eliminated_exactly(heights_nm: tuple[float, float] | None) -> None:
    """The reduced information is the inverse of the shared block of the whole inverse."""
    images, _, build = make_particle_images({"z11": 8.0}, 3, seed=5)
    images = [replace(image, heights_nm=heights_nm) for image in images]
    settings = settings_of(configuration())
    private = np.array([image.private for image in images])
    private[:, 3] = 6000.0
    at = JointLikelihood(images, build, NAMES).at(settings, private)
    k, n = len(NAMES), len(images)
    whole = np.zeros((k + PRIVATE * n, k + PRIVATE * n))
    whole[:k, :k] = at.fisher[:, :k, :k].sum(axis=0)
    for e in range(n):
        own = slice(k + PRIVATE * e, k + PRIVATE * (e + 1))
        whole[:k, own] = at.fisher[e, :k, k:]
        whole[own, :k] = at.fisher[e, k:, :k]
        whole[own, own] = at.fisher[e, k:, k:]
    scale = 1 / np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole * np.outer(scale, scale)) * np.outer(scale, scale)
    reduced = np.linalg.inv(at.reduced(0.0)[0])
    np.testing.assert_allclose(reduced, inverse[:k, :k], rtol=1e-6)


def test_score_is_the_slope_of_the_joint_likelihood() -> None:
    images, _, build = make_particle_images({"z11": 8.0}, 2, seed=6)
    settings = {**settings_of(configuration()), "z7": 3.0}
    private = np.array([image.private for image in images])
    private[:, 3] = 6000.0

    joint = JointLikelihood(images, build, NAMES)
    middle = joint.at(settings, private)
    for index, name in enumerate(NAMES):
        step = {"na": 1e-5}.get(name, 1e-2)
        below, above = (
            joint.at({**settings, name: settings[name] + change}, private).value
            for change in (-step, step)
        )
        slope = (above - below) / (2 * step)
        assert slope == pytest.approx(middle.score[:, index].sum(), rel=2e-4), name


def test_a_particle_beyond_its_wall_does_not_keep_the_others_from_converging() -> None:
    """Held where its wall is, it counts as known; what it still wants is no gain to wait for."""
    _, truth, build = make_particle_images({"z11": 8.0}, 6, seed=10)
    lost = truth[0]
    cut = 12  # columns: the particle stands six pixels, 500 nm, left of the new centre
    grid = PixelGrid(lost.grid.x_nm[cut:], lost.grid.y_nm, lost.grid.pixel_nm)
    lost = replace(lost, grid=grid, data=np.ascontiguousarray(lost.data[:, :, cut:]))
    start = settings_of(configuration())
    found = maximise([lost, *truth[1:]], build, start, NAMES)
    wall = grid.x_nm.mean() - 300.0
    assert lost.x_nm < wall - 100.0  # the trap is set
    assert found.images[0].x_nm == pytest.approx(wall)
    assert found.converged
    assert found.values["z11"] == pytest.approx(8.0, abs=4 * found.bound[4, 4] ** 0.5)


def test_the_average_of_shifted_pictures() -> None:
    images, truth, _ = make_particle_images({}, 6, seed=7)
    jolted = [replace(s, x_nm=s.x_nm + 90.0, y_nm=s.y_nm - 60.0) for s in images]
    (average,), placed = average_particle_images(jolted)
    assert average.grid.shape == GRID.shape
    found = np.array([(s.x_nm, s.y_nm) for s in placed])
    true = np.array([(s.x_nm, s.y_nm) for s in truth])
    apart = found - true
    assert np.ptp(apart, axis=0).max() < 15.0  # one shift is common to all


def test_every_focus_is_tried() -> None:
    """A start 600 nm from the truth is not needed: the coarse search finds its neighbourhood."""
    images, _, build = make_particle_images(
        {"focus_nm": 310.0, "reference_phase_deg": 40.0}, 6, seed=8
    )
    averages, _ = average_particle_images(images)
    now = settings_of(configuration())
    candidates = [{**now, "focus_nm": f} for f in np.arange(-1000.0, 1000.0, 80.0)]
    best = search_starts(averages, build, candidates, most=2)[0]
    assert abs(best.values["focus_nm"] - 310.0) <= 80.0


def test_free_groups() -> None:
    assert free_groups("na, focus") == ("focus", "na")
    assert "zernike" in free_groups(None)
    with pytest.raises(ConfigError, match="phase, mask"):
        free_groups("focus,zernikes")


def test_settings_go_into_a_configuration_and_back() -> None:
    config = configuration(na=1.3, aberrations_nm={"z11": 4.0, "z14": 2.0})
    settings = settings_of(config)
    assert settings["z14"] == 2.0
    changed = with_settings(config, {**settings, "z11": 0.0, "z7": -5.0, "focus_nm": 12.0})
    assert changed.optics.aberrations_nm == {"z7": -5.0, "z14": 2.0}
    assert parse_config(_values(changed)).optics == changed.optics


def _values(config):  # type: ignore[no-untyped-def]
    import tomllib

    return tomllib.loads(config_to_toml(config))


def test_limits_hold() -> None:
    """Pictures of a wider aperture than the limit allows end at it, not beyond."""
    images, truth, build = make_particle_images({"na": 1.44}, 4, seed=9)
    limits = {**optics_limits(1.515, 1.515), "na": (1.3, 1.43)}
    found = maximise(truth, build, settings_of(configuration()), ("na",), limits=limits, passes=15)
    assert found.values["na"] == 1.43
    assert isinstance(images[0], ParticleImage)
    assert microscope(configuration(), {}) is not None
