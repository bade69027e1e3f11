"""Heights are a nuisance with a normal prior: masses stay right where no two are equally high."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import iscat_analysis as ia
from iscat_analysis.config import load_config
from iscat_analysis.errors import ConfigError

OPTICS = ia.Optics(na=1.42, focus_nm=-300.0, attenuation=1.0)
CAMERA = ia.Camera(pixel_size_nm=84.0)
LINE = ia.Calibration(gradient_per_kda=-3.1e-5)
MASS_KDA, MEAN_NM, SD_NM, TRIALS = 205.0, 11.0, 6.0, 60
FRAMES, LIGHT_E = 200, 1e5


@pytest.fixture(scope="module")
def heights() -> np.ndarray:
    return np.abs(np.random.default_rng(5).normal(MEAN_NM, SD_NM, TRIALS))


@pytest.fixture(scope="module")
def counts(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Draw counts before and after particles landed at these heights."""
    rng = np.random.default_rng(6)
    signal = ia.psf(
        OPTICS, ia.Particle(mass_kda=MASS_KDA), CAMERA, calibration=LINE, z_nm=heights,
        x_nm=rng.uniform(-40, 40, TRIALS), y_nm=rng.uniform(-40, 40, TRIALS),
    )  # fmt: skip
    before = rng.poisson(np.full(signal.shape, FRAMES * LIGHT_E))
    return before, rng.poisson(FRAMES * LIGHT_E * (1 + signal))


def fitted(counts: tuple[np.ndarray, np.ndarray], **particle: object) -> pd.DataFrame:
    """Fit all counts with what is known of the heights."""
    return ia.fit_rois(
        *counts, OPTICS, ia.Particle(mass_kda=MASS_KDA, **particle), CAMERA, calibration=LINE,
        n_before=FRAMES, n_after=FRAMES,
    )  # fmt: skip


def test_masses_and_heights_are_right_within_their_errors(counts, heights) -> None:
    rows = fitted(counts, height_nm="auto", learned_height_nm=MEAN_NM, height_sd_nm=SD_NM)
    assert (rows.status == "ok").all()
    pulls = (rows.mass_kda - MASS_KDA) / rows.sigma_mass_kda
    assert abs(pulls.mean()) < 3 / TRIALS**0.5
    assert abs(pulls.std() - 1) < 3 / (2 * TRIALS) ** 0.5
    lifted = (rows.z_nm - heights) / rows.sigma_z_nm
    assert abs(lifted.std() - 1) < 3 / (2 * TRIALS) ** 0.5
    assert np.allclose(rows.sigma_mass_kda, rows.crb_mass_kda, rtol=0.05)
    held = fitted(counts)  # the control: one height for all describes half of them
    assert (held.status == "ok").mean() < 0.5


def test_a_narrow_prior_is_a_height_that_is_held(counts) -> None:
    held = fitted(counts, height_nm=9.0)
    known = fitted(counts, height_nm=9.0, height_sd_nm=1e-4)
    assert np.allclose(known.mass_kda, held.mass_kda, rtol=1e-3)
    assert np.allclose(known.sigma_mass_kda, held.sigma_mass_kda, rtol=1e-3)
    assert np.allclose(known.z_nm, 9.0, atol=1e-3)
    assert np.allclose(known.crb_z_nm, 1e-4, rtol=1e-3)  # of van Trees: what is known beforehand
    assert held.sigma_z_nm.isna().all()


def test_the_bound_joins_what_light_and_prior_know(counts) -> None:
    """1/σ_z² of a prior is that of the data, by mode joint, and 1/s²."""
    start = ia.Particle(mass_kda=MASS_KDA)
    free = ia.fit_rois(
        *counts, OPTICS, start, CAMERA, calibration=LINE, n_before=FRAMES, n_after=FRAMES,
        mode="joint",
    )  # fmt: skip
    known = fitted(counts, height_nm=MEAN_NM - 6.0, height_sd_nm=SD_NM)
    same = (free.z_nm - known.z_nm).abs() < 1
    assert same.sum() > TRIALS / 2
    expected = (free.crb_z_nm**-2 + SD_NM**-2) ** -0.5
    assert np.allclose(known.crb_z_nm[same], expected[same], rtol=0.05)


def test_a_sphere_in_contact_is_as_high_as_its_radius() -> None:
    particle = ia.Particle(mass_kda=480.0, height_nm="contact", linker_nm=4.0)
    radius = (3 * 480e3 * 1.66053906892e-27 / (4 * np.pi * 1350.0)) ** (1 / 3) * 1e9
    assert particle.mean_height_nm(480.0) == pytest.approx(radius + 4.0, rel=1e-6)
    assert particle.mean_height_nm(60.0) == pytest.approx(radius / 2 + 4.0, rel=1e-6)


@pytest.mark.parametrize(
    "setting",
    ["particle.linker_nm=4", "particle.learned_height_nm=11", "particle.height_sd_nm=500"],
)
def test_what_contradicts_itself_is_refused(setting: str) -> None:
    with pytest.raises(ConfigError, match=setting.split("=")[0].split(".")[1]):
        load_config(None, ["particle.height_nm=5", setting])


def test_simulated_heights_are_those_of_the_prior() -> None:
    from iscat_analysis.study.simulate import place_particles

    config = load_config(
        None,
        ["camera.pixel_size_nm=84", "particle.height_nm=20", "particle.height_sd_nm=4",
         "simulation.count=400"],
    )  # fmt: skip
    heights = [p.z_nm for p in place_particles(config, np.random.default_rng(2))]
    assert abs(np.mean(heights) - 20) < 3 * 4 / 20
    assert abs(np.std(heights) - 4) < 3 * 4 / 800**0.5
