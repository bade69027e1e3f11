"""Fits of contrast images, and regions in which there is no particle."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom, chi2, norm

import iscat_analysis as ia
from iscat_analysis.inference.counts import gaussian
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.pieces.counts import config_of, gather
from iscat_analysis.pieces.regions import FALSE_ALARMS_PER_REGION

OPTICS = ia.Optics(na=1.42, wavelength_nm=525, focus_nm=-500)
CAMERA = ia.Camera(pixel_size_nm=84.4)
PROTEIN = ia.Particle(mass_kda=480.0)
LINE = ia.Calibration(gradient_per_kda=-3.1e-5)
SETUP: dict[str, Any] = {
    "optics": OPTICS, "particle": PROTEIN, "camera": CAMERA, "calibration": LINE
}  # fmt: skip
PIXELS = 15
NOISE = 3e-3
SIGMAS = 5.0
LIGHT = 2e6
"""Photoelectrons in the frames before, as in those after."""


def _images(count: int, seed: int, mass_kda: float = 480.0, **at: float) -> np.ndarray:
    """Draw contrast images of equal particles, whose noise grows to one side."""
    rng = np.random.default_rng(seed)
    image = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, mass_kda=mass_kda,
                   **at)  # fmt: skip
    return np.asarray(image + _sigma() * rng.normal(size=(count, PIXELS, PIXELS)))


def _sigma() -> np.ndarray:
    return NOISE * np.linspace(0.7, 1.5, PIXELS) * np.ones((PIXELS, 1))


def _snr_of_one_kda(**light: Any) -> float:
    bound = ia.crb(**SETUP, mass_kda=1e-3, pixels=PIXELS, **light)["mass_kda"]
    return 1 / float(bound)


def test_the_likelihood_of_contrasts_is_normal() -> None:
    config = config_of(OPTICS, PROTEIN, CAMERA, mode="mass", calibration=LINE)
    seen = _images(1, 1)
    counts = gather(config, None, None, contrast=seen, sigma=_sigma())
    model, grid = counts.model, PixelGrid.region((0, PIXELS), (0, PIXELS), 84.4)
    likelihood = gaussian(model, grid, seen[0], _sigma())
    amplitude = model.scale.amplitude(480.0)
    for x, y, a, g in ((590.0, 600.0, amplitude, 0.0), (550.0, 640.0, -3 * amplitude, 2e-3)):
        theta = np.array([x, y, 5.0, a, g])
        signal = (1 + model.amplitude_image(grid, x, y, 5.0, a)) * math.exp(g) - 1
        expected = norm.logpdf(seen[0], signal, _sigma()).sum()
        expected -= norm.logpdf(seen[0], 0.0, _sigma()).sum()
        assert likelihood.values(theta[None])[0] == pytest.approx(expected, rel=1e-4, abs=1e-3)
        slow = likelihood.noise.terms(likelihood.data, likelihood.signal(theta), g).value
        assert slow == pytest.approx(expected, rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("wrong", [1.0, 1.3])
def test_fits_of_contrasts_reach_their_bound(wrong: float) -> None:
    """400 particles on a level of 0.2 %; with σ too large by 30 % the spread is too small."""
    count, at = 400, {"x_nm": 30.0, "y_nm": -20.0}
    seen = _images(count, 2, **at) + 2e-3
    table = ia.fit_rois(contrast=seen, sigma=wrong * _sigma(), **SETUP, workers=2)
    assert (table["status"] == "ok").mean() > (0.97 if wrong == 1 else -1)
    middle = (PIXELS - 1) / 2 * 84.4
    truth = {"x_nm": middle + 30, "y_nm": middle - 20, "mass_kda": 480.0}
    off = []
    for name, value in truth.items():
        bound = table[f"crb_{name}"].median()
        assert table[f"sigma_{name}"].median() == pytest.approx(bound, rel=0.02)
        off.append((table[name].std() / bound - 1) * math.sqrt(2 * count))
        assert abs(table[name].mean() - value) < SIGMAS * bound / math.sqrt(count)
    assert (max(map(abs, off)) < SIGMAS) == (wrong == 1)
    unknown = ["n_scattered", "qcrb_x_nm", "qcrb_mass_kda"]
    assert table[unknown].isna().all().all()


def test_contrasts_with_their_light_are_counts() -> None:
    rng = np.random.default_rng(3)
    image = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE)
    before = rng.poisson(LIGHT, (6, PIXELS, PIXELS))
    after = rng.poisson(1.5 * LIGHT * (1 + image), before.shape)
    frames = {"n_before": 200, "n_after": 300}
    counted = ia.fit_rois(before, after, **SETUP, **frames)
    seen = after / (1.5 * before) - 1
    pd.testing.assert_frame_equal(
        ia.fit_rois(before, contrast=seen, **SETUP, **frames), counted, rtol=1e-9
    )
    sigma = math.sqrt((1 + 1 / 1.5) / LIGHT)
    alone = ia.fit_rois(contrast=seen, sigma=sigma, **SETUP)
    off = (alone["mass_kda"] - counted["mass_kda"]).abs()
    assert (off < 0.1 * counted["sigma_mass_kda"]).all()
    np.testing.assert_allclose(alone["sigma_mass_kda"], counted["sigma_mass_kda"], rtol=0.02)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"before": np.ones((2, 15, 15)), "after": 1, "n_before": 1, "n_after": 1},
         r"after: half of its pixels .* no photoelectrons but ratios: .* minus 1 .*contrast="),
        ({"before": 1.0, "after": 0, "n_before": 0, "n_after": 1},
         r"after: half of its pixels .* no photoelectrons but contrasts: .*contrast="),
        ({"contrast": 1, "sigma": NOISE}, r"contrast: its median is 1.* \(subtract 1\)"),
        ({"contrast": 1e6, "sigma": NOISE}, "contrast: its median is 1e"),
        ({"contrast": 0}, "before, n_before, n_after: missing; .* contrast and sigma"),
        ({"after": 1e6, "sigma": NOISE}, "before, n_before, n_after: missing"),
        ({"contrast": 0, "sigma": NOISE, "n_after": 3}, "n_after: not needed"),
        ({"contrast": 0, "sigma": 0.0}, "sigma = 0: give the standard deviation"),
        ({"contrast": 0, "sigma": np.ones(3)}, r"sigma: has shape \(3,\)"),
        ({"contrast": np.nan, "sigma": NOISE}, "contrast: is not finite"),
    ],
)  # fmt: skip
def test_other_numbers_are_refused(given: dict[str, Any], said: str) -> None:
    """A ratio that was given as counts had errors of 400 000 kDa, without a word."""
    seen = _images(2, 4)
    full = {
        name: value + seen if name in ("after", "contrast") else value
        for name, value in given.items()
    }
    with pytest.raises((ia.DataError, ia.ConfigError), match=said):
        ia.fit_rois(**full, **SETUP)


def test_dark_field_has_no_contrast() -> None:
    dark = ia.Optics(na=1.42, wavelength_nm=525, scheme="darkfield")
    gold = ia.Particle(kind="gold", diameter_nm=20.0, photons_per_frame=3000.0)
    with pytest.raises(ia.ConfigError, match=r"contrast: .*no reference"):
        ia.fit_rois(contrast=_images(1, 1), sigma=NOISE, optics=dark, particle=gold, camera=CAMERA)


@pytest.mark.parametrize("light", ["contrast", "counts"])
def test_regions_of_noise_are_not_detected(light: str) -> None:
    """Noise is taken for a particle in at most 1 of 100 regions, whose light changed by 0.2 %.

    A threshold that knows of one place only, that of χ² for three parameters, is exceeded often.
    """
    count, rng = 1000, np.random.default_rng(5)
    if light == "contrast":
        table = ia.fit_rois(
            contrast=2e-3 + _images(count, 5, mass_kda=0.0), sigma=_sigma(), **SETUP, workers=2
        )
    else:
        before, after = (rng.poisson(f * LIGHT, (count, PIXELS, PIXELS)) for f in (1.0, 1.002))
        table = ia.fit_rois(before, after, **SETUP, n_before=200, n_after=200, workers=2)
    false = int((table["status"] != "not_detected").sum())
    assert 0 < false <= binom.ppf(norm.cdf(SIGMAS), count, FALSE_ALARMS_PER_REGION)
    naive = int((table["snr"] ** 2 > chi2.isf(FALSE_ALARMS_PER_REGION, 3)).sum())
    assert naive > binom.ppf(norm.cdf(SIGMAS), count, FALSE_ALARMS_PER_REGION)
    assert (table["mass_kda"].abs() > 2 * table["sigma_mass_kda"]).mean() > 0.5  # as peaks of noise


@pytest.mark.parametrize(
    ("snr", "least", "most"), [(2.7, 0.0, 0.2), (5.0, 0.6, 1.0), (8.0, 0.98, 1.0)]
)
def test_particles_above_the_noise_are_detected(snr: float, least: float, most: float) -> None:
    count, rng = 200, np.random.default_rng(6)
    mass = snr / _snr_of_one_kda(photons_per_pixel=LIGHT / 200, n_before=200, n_after=200)
    image = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, mass_kda=mass)
    before, after = (rng.poisson(LIGHT * (1 + s), (count, PIXELS, PIXELS)) for s in (0.0, image))
    table = ia.fit_rois(before, after, **SETUP, n_before=200, n_after=200, workers=2)
    found = (table["status"] != "not_detected").mean()
    assert least <= found <= most


def test_the_log_likelihood_says_from_where_on_a_particle_is_detected() -> None:
    rng = np.random.default_rng(7)
    masses = np.array([0.0, 10.0, 20.0, 25.0, 30.0, 100.0])
    images = ia.psf(OPTICS, PROTEIN, CAMERA, pixels=PIXELS, calibration=LINE, mass_kda=masses)
    before, after = rng.poisson(LIGHT, images.shape), rng.poisson(LIGHT * (1 + images))
    options = {"n_before": 200, "n_after": 200, "power_ratio": 1.0, "calibration": LINE}
    table = ia.fit_rois(before, after, OPTICS, PROTEIN, CAMERA, **options)
    seen = []
    for k, row in table.iterrows():
        logl = ia.log_likelihood(before[k], after[k], OPTICS, PROTEIN, CAMERA, **options)
        seen.append(bool(logl(row[list(logl.names)].to_numpy(float)) > logl.detected_above))
    assert seen == (table["status"] != "not_detected").tolist()
    assert seen[0] is False
    assert seen[-1] is True


def test_a_fitted_level_is_no_evidence_of_a_particle() -> None:
    rng = np.random.default_rng(8)
    before, after = (rng.poisson(f * LIGHT, (PIXELS, PIXELS)) for f in (1.0, 1.01))
    options = {"n_before": 200, "n_after": 200, "calibration": LINE}
    logl = ia.log_likelihood(before, after, OPTICS, PROTEIN, CAMERA, **options)
    held = ia.log_likelihood(before, after, OPTICS, PROTEIN, CAMERA, **options, power_ratio=1.01)
    brighter = np.array([600.0, 600.0, 0.0, math.log(1.01)])
    assert logl(brighter) > 1000
    assert logl.detected_above - logl(brighter) == pytest.approx(held.detected_above, abs=3)
