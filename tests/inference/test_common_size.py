"""One sphere in many frames: its diameter and index, and their errors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.inference.common_size import SphereFrames
from iscat_analysis.inference.counts import KNOWN, counts_likelihood
from iscat_analysis.inference.fit import fit_particle
from iscat_analysis.inference.laws import Poisson
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.optics.model import wiggled
from iscat_analysis.optics.sized import SizedModel
from iscat_analysis.records import Candidate, Status
from iscat_analysis.tracking.sizes import SphereTrack, explained, table_of_sizes

FloatArray = NDArray[np.float64]

GRID = PixelGrid.centred(19, 100.0)
Z_RANGE_NM = (0.0, 900.0)


def model_of(diameter_nm: float, **particle: object) -> SizedModel:
    config = Config.model_validate(
        {
            "optics": {"wavelength_nm": 525.0, "na": 1.42, "focus_nm": 0.0},
            "camera": {"pixel_size_nm": 100.0},
            "particle": {"kind": "silica", "model": "mie", "diameter_nm": diameter_nm, **particle},
            "fit": {"mode": "size", "roi_nm": 1900.0, "z_range_nm": Z_RANGE_NM,
                    "diameter_range_nm": (40.0, 250.0)},
        }
    )  # fmt: skip
    model = forward_model(config, 2200.0)
    assert isinstance(model, SizedModel)
    return model


def frames_of(
    model: SizedModel, count: int, light_e: float, rng: np.random.Generator
) -> tuple[list[Likelihood], FloatArray]:
    """Draw counts of a sphere that is somewhere else in every frame; the light is known."""
    radius = model.sphere.diameter_nm / 2
    places = rng.uniform([-60, -60, radius], [60, 60, 800], (count, 3))
    flat, nothing = np.full(GRID.shape, light_e), np.zeros(GRID.shape)
    likelihoods = []
    for x, y, z in places.tolist():
        signal = model.amplitude_image(GRID, x, y, z, model.material.mass_kda)
        counts = rng.poisson(light_e * (1 + signal)).astype(float)
        likelihoods.append(
            counts_likelihood(
                model, GRID, flat, counts, 1.0, background=KNOWN, noise=Poisson(), scale_e=None,
                others=None, read_variances_e2=(nothing, nothing),
                masked=np.zeros(GRID.shape, dtype=bool),
            )
        )  # fmt: skip
    return likelihoods, places


def near(places: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Where single frames found the particle."""
    return places + rng.normal(0, 4.0, places.shape)


def test_frames_have_one_diameter_and_places_of_their_own() -> None:
    """The score is zero in all parameters, and the error that of the whole information."""
    rng = np.random.default_rng(1)
    model = model_of(120.0)
    likelihoods, places = frames_of(model, 4, 3000.0, rng)
    found = SphereFrames(likelihoods, model, Z_RANGE_NM).common_sizes(near(places, rng))
    best = found[0]
    assert best.converged
    whole = np.zeros((13, 13))
    score = np.zeros(13)
    for f, likelihood in enumerate(likelihoods):
        _, own, fisher = likelihood.score_fisher(np.array([*best.places[f], best.mass_kda, 0.0]))
        here = [3 * f, 3 * f + 1, 3 * f + 2, 12]
        whole[np.ix_(here, here)] += fisher[:4, :4]
        score[here] += own[:4]
    covariance = np.linalg.inv(whole)
    assert best.covariance()[0, 0] == pytest.approx(covariance[12, 12], rel=1e-6)
    assert score @ covariance @ score < 1e-2  # of the squared standard errors
    off = best.mass_kda - best.bias[0] - model.material.mass_kda
    assert abs(off) < 4 * math.sqrt(covariance[12, 12])
    alike = best.covariance(np.ones((4, 4)))[0, 0]  # frames that all have the same noise
    assert alike > 2 * best.covariance()[0, 0]


def test_index_and_diameter_need_the_motion_of_a_small_sphere() -> None:
    """A small one scatters like d³ (n − n_s), to which pictures of 80 nm add little."""
    rng = np.random.default_rng(2)
    model = model_of(80.0)
    likelihoods, places = frames_of(model, 5, 5000.0, rng)
    motion = 1 / 80.0, 0.02 / 80.0
    start = {"mass_kda": 1.1 * model.material.mass_kda, "index": 1.44}
    joint = SphereFrames(likelihoods, model, Z_RANGE_NM).fit(places, **start, motion=motion)
    assert joint is not None
    assert joint.converged
    sigma = math.sqrt(joint.covariance()[1, 1])
    assert abs(joint.index - 1.46) < 4 * sigma
    assert sigma < 0.015
    scale = np.diag([3 * joint.mass_kda, joint.index - 1.33])  # ln d and ln (n − n_s)
    sizes, axes = np.linalg.eigh(scale @ joint.information.sum(axis=0) @ scale)
    assert sizes[1] > 1e3 * sizes[0]
    assert abs(axes[:, 1] @ [3, 1]) / math.sqrt(10) == pytest.approx(1, abs=0.02)


def log_odds(model: SizedModel, true: SizedModel, light_e: float, seed: int) -> float:
    """Log-odds of the particle of a model in ten frames of another, whose D is known to 15 %."""
    rng = np.random.default_rng(seed)
    likelihoods, places = frames_of(true, 10, light_e, rng)
    diameter = true.sphere.diameter_nm
    motion = rng.normal(1.0, 0.15) / diameter, 0.15 / diameter
    likelihoods = [replace(one, model=model) for one in likelihoods]
    frames = SphereFrames(likelihoods, model, Z_RANGE_NM)
    sizes = frames.common_sizes(near(places, rng))
    both = [explained(frames, sizes, motion, free) for free in (False, True)]
    track = SphereTrack(model, [], sizes, np.zeros((10, 10)), *both)
    return float(table_of_sizes({0: track}, None)["log_odds_particle"].iloc[0])


def test_tracks_of_another_material_are_told() -> None:
    """Ten images of 150 nm know n − n_s to a few per cent, whatever the motion says."""
    silica = model_of(150.0)
    other = model_of(150.0, kind="custom", index=1.43, density_kg_m3=2200.0)
    assert log_odds(silica, silica, 3000.0, seed=3) > 0
    assert log_odds(other, silica, 3000.0, seed=3) < -math.log(1000)


@pytest.mark.large
def test_vesicles_are_told_from_solid_spheres() -> None:
    """Those of 200 nm in ten frames are; those of 60 nm look like a solid sphere of n = 1.384."""
    pytest.importorskip("scattnlay")
    matter = {"kind": "custom", "density_kg_m3": 1010.0}
    shell = {**matter, "model": "shell", "index": 1.33, "shell_nm": 5.0, "shell_index": 1.46}
    large, small = model_of(200.0, **shell), model_of(60.0, **shell)
    assert log_odds(large, large, 1e5, seed=4) > math.log(1000)
    assert 0 < log_odds(small, small, 1e5, seed=4) < math.log(1000)
    solid = model_of(150.0, index=1.36, **matter)
    assert log_odds(large, solid, 1e5, seed=4) < -math.log(1000)


def test_a_sphere_that_wiggles_is_averaged_at_every_diameter() -> None:
    """Against the mean of the fields at places that are normal, by Gauss and Hermite."""
    model, sd_nm = model_of(60.0), 40.0
    moving = wiggled(model, sd_nm)
    points, weights = np.polynomial.hermite_e.hermegauss(9)
    x, mass = np.linspace(-400, 400, 9), 8 * model.material.mass_kda
    mean = (
        sum(
            wx * wy * model.field(x - sd_nm * px, np.full(9, 50.0 - sd_nm * py), 90.0, mass)
            for px, wx in zip(points, weights, strict=True)
            for py, wy in zip(points, weights, strict=True)
        )
        / weights.sum() ** 2
    )
    averaged = moving.field(x, np.full(9, 50.0), 90.0, mass)
    assert np.abs(averaged - mean).max() < 1e-5 * np.abs(mean).max()
    sharp = model.field(x, np.full(9, 50.0), 90.0, mass)
    assert np.abs(sharp - mean).max() > 0.01 * np.abs(mean).max()  # the control


@pytest.mark.large
@pytest.mark.parametrize(("kind", "diameter", "light_e"), [("gold", 40.0, 40.0),
                                                           ("silica", 100.0, 150.0)])  # fmt: skip
def test_pulls_of_faint_tracks(kind: str, diameter: float, light_e: float, share: float) -> None:
    """Without the bias that is taken off, the mean of the pulls would be 0.7 to 0.9."""
    rng = np.random.default_rng(5)
    model = model_of(diameter, kind=kind)
    trials = max(8, round(40 * share))
    raw, pulls = np.empty((2, trials))
    for k in range(trials):
        likelihoods, places = frames_of(model, 20, light_e, rng)
        frames = SphereFrames(likelihoods, model, Z_RANGE_NM)
        best = frames.common_sizes(near(places, rng))[0]
        sigma = math.sqrt(best.covariance()[0, 0])
        raw[k] = (best.mass_kda - model.material.mass_kda) / sigma
        pulls[k] = raw[k] - best.bias[0] / sigma
    assert abs(pulls.mean()) < 4 / math.sqrt(trials)
    assert abs(pulls.std(ddof=1) - 1) < 4 / math.sqrt(2 * trials)
    if trials >= 40:
        assert raw.mean() > 0.3


@pytest.mark.large
def test_frames_that_leave_several_heights_do_not_choose_another_diameter(share: float) -> None:
    """The likeliest height of each frame alone gave one such track in six 76 or 410 nm."""
    pytest.importorskip("scattnlay")
    rng = np.random.default_rng(6)
    model = model_of(
        200.0, kind="custom", model="shell", index=1.33, shell_nm=5.0, shell_index=1.46,
        density_kg_m3=1010.0,
    )  # fmt: skip
    model = replace(model, mass_range_kda=(model.sphere.mass_kda / 8, model.sphere.mass_kda * 8))
    for _ in range(max(4, round(16 * share))):
        likelihoods, places = frames_of(model, 12, 2000.0, rng)
        best = SphereFrames(likelihoods, model, Z_RANGE_NM).common_sizes(near(places, rng))[0]
        assert len(best.frames) > 12
        diameter = model.sphere.of_mass(best.mass_kda).diameter_nm
        assert abs(diameter - 200.0) < 15.0


@pytest.mark.large
def test_the_posterior_visits_every_diameter() -> None:
    """With 15 photoelectrons per pixel 273 nm is the best fit, and 145 nm is as probable.

    The weight of a diameter is that of a normal distribution, which is good to a factor of two
    where errors are as large as here; chains know the shape of the likelihood.
    """
    rng = np.random.default_rng(7)
    model = model_of(100.0)
    model = replace(model, mass_range_kda=(model.sphere.mass_kda / 125, model.sphere.mass_kda * 27))
    grid = PixelGrid.centred(23, 90.0)
    signal = model.amplitude_image(grid, 10.0, -20.0, 60.0, model.material.mass_kda)
    flat, nothing = np.full(grid.shape, 15.0), np.zeros(grid.shape)
    likelihood = counts_likelihood(
        model, grid, flat, rng.poisson(15.0 * (1 + signal)).astype(float), 1.0, background=KNOWN,
        noise=Poisson(), scale_e=None, others=None, read_variances_e2=(nothing, nothing),
        masked=np.zeros(grid.shape, dtype=bool),
    )  # fmt: skip
    start = Candidate(0.1, -0.2, 60.0, model.material.mass_kda, 10.0)
    fit = fit_particle(likelihood, start, "size", (0.0, 250.0), level=False)
    assert Status.AMBIGUOUS_SIZE in fit.flags
    masses = sample_posterior(likelihood, fit, steps=300, seed=1).samples[..., 3].ravel()
    weights = masses ** (-2 / 3)  # from flat in the mass to flat in the diameter
    near_best = masses > math.sqrt(fit.theta[3] * fit.alternatives[0].mass_kda)
    share = weights[near_best].sum() / weights.sum()
    assert 0.5 < fit.size_probability / share < 2
