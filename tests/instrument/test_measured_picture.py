"""A measured picture in the place of the model: exact where it is known, honest where it is not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iscat_analysis.bounds import event_bounds
from iscat_analysis.config import Config, config_to_toml, configure, load_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.counts import conditional
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.particle_image import ParticleImage, goodness, place_particle_images
from iscat_analysis.instrument.template import PictureFitter, fit_own
from iscat_analysis.optics.forward import (
    ForwardModel,
    PixelGrid,
    forward_model,
    peak_per_amplitude,
    with_template,
)
from iscat_analysis.optics.waves import Template, lattice_step_nm, sha256_of

PIXEL, ROI = 100.0, 1500.0
LIGHT = 2e7
STRANGE = {"z8": 20.0, "z9": 15.0, "z11": 25.0, "z16": 20.0}


def _config(**settings: Any) -> Config:
    base = {
        "optics.focus_nm": -300.0,
        "camera.pixel_size_nm": PIXEL,
        "fit.roi_nm": ROI,
        "particle.mass_kda": 200.0,
        "background.frames": (0, 100),
    }
    return configure(settings=base | settings)


def _step() -> float:
    return lattice_step_nm(525.0, 1.515)


def _sampled(model: ForwardModel, half_nm: float) -> Template:
    """Template of a computed picture, without noise."""
    count, step = int(half_nm / _step()), _step()
    axis = step * np.arange(-count, count + 1)
    point = PixelGrid(axis, axis, 1e-3)
    weak = 1e-6 / peak_per_amplitude(model)
    image = model.amplitude_image(point, 0.0, 0.0, model.height_nm, weak) / 1e-6
    return Template(image, np.zeros(image.shape), step, PIXEL, ROI, 0.0, 1)


def test_a_sampled_picture_is_the_model_between_the_samples() -> None:
    truth = forward_model(_config(**{"optics.aberrations_nm": STRANGE}), 6000.0)
    measured = with_template(truth, _sampled(truth, 4000.0))
    grid = PixelGrid.centred(15, PIXEL)
    place = (31.7, -12.3, truth.height_nm, 1e-3)
    true, rate = truth.signal(grid, place)
    found, slope = measured.signal(grid, place)
    top = np.abs(true).max()
    np.testing.assert_allclose(found, true, atol=2e-5 * top)
    np.testing.assert_allclose(slope[[0, 1, 3]], rate[[0, 1, 3]], atol=1e-3 * np.abs(rate[3]).max())
    assert np.all(slope[2] == 0)
    far = PixelGrid(np.array([4500.0]), np.array([0.0]), PIXEL)
    assert abs(measured.image(far, 0.0, 0.0, 5.0, 200.0)[0, 0]) < 1e-9


def test_the_scattered_light_is_the_least_that_the_interference_allows() -> None:
    truth = forward_model(_config(), 4000.0)
    measured = with_template(truth, _sampled(truth, 2500.0))
    grid = PixelGrid.centred(15, PIXEL)
    strong = 0.3 / peak_per_amplitude(truth)
    both = [measured.amplitude_image(grid, 0, 0, 5.0, a) for a in (strong, -strong)]
    linear, light = (both[0] - both[1]) / 2, (both[0] + both[1]) / 2
    samples = np.max(np.abs(light - linear**2 / 4)) / light.max()
    assert samples < 0.05  # up to the average over a pixel
    exact = [truth.amplitude_image(grid, 0, 0, 5.0, a) for a in (strong, -strong)]
    assert np.all((exact[0] + exact[1]) / 2 >= light - 1e-6)


def _particle_images(
    truth: ForwardModel, masses: np.ndarray[Any, Any], seed: int
) -> list[ParticleImage]:
    rng = np.random.default_rng(seed)
    images = []
    for mass in masses:
        grid = PixelGrid.centred(19, PIXEL)
        x, y = rng.uniform(-50, 50, 2)
        signal = truth.amplitude_image(grid, x, y, truth.height_nm, float(mass))
        before, after = rng.poisson(LIGHT, grid.shape), rng.poisson(LIGHT * (1 + signal))
        data = conditional(truth, grid, before.astype(float), after.astype(float), 1.0)
        images.append(
            ParticleImage(
                grid=grid, noise=data.noise, data=data.data,
                x_nm=float(x + rng.normal(0, 20)), y_nm=float(y + rng.normal(0, 20)),
                z_nm=truth.height_nm, snr=20.0,
            )
        )  # fmt: skip
    return images


def test_a_template_describes_what_the_model_does_not() -> None:
    nominal = forward_model(_config(), 2500.0)
    truth = forward_model(_config(**{"optics.aberrations_nm": STRANGE}), 2500.0)
    rng = np.random.default_rng(5)
    size = 8e-3 / peak_per_amplitude(truth)
    masses = size * rng.choice([0.5, 1.0, 1.5], 44)
    images = place_particle_images(_particle_images(truth, masses, 6), nominal)
    made, held = images[:30], images[30:]
    fitter = PictureFitter(nominal, roi_nm=ROI, step_nm=_step(), level=False)
    found = fitter.fit(made)
    assert found.template.sights == 30
    assert np.abs(found.template.contrast).max() == pytest.approx(1.0, abs=0.05)
    model = with_template(nominal, found.template)
    judged = [fit_own(image, model, level=False) for image in held]
    p_values = [goodness(image, model)[1] for image in judged]
    assert np.sum(np.array(p_values) < 1e-2) <= 2
    assert np.median(p_values) > 0.1
    wrong = [goodness(fit_own(image, nominal, level=False), nominal)[1] for image in held]
    assert np.median(wrong) < 1e-3
    # the strengths are right in proportion, with the error that the bound of the template says
    ratio, error = [], []
    for image, mass in zip(judged, masses[30:], strict=True):
        theta = np.array([image.x_nm, image.y_nm, image.z_nm, image.mass_kda, image.level])
        likelihood = Likelihood(model, image.grid, image.noise, image.data)
        bounds = event_bounds(likelihood, theta, ("x_nm", "y_nm", "mass_kda"), float("nan"))
        assert np.all(np.isnan(bounds.qcrb))
        ratio.append(image.mass_kda / mass)
        error.append(bounds.crb_joint[3] / mass)
    weight = 1 / np.square(error)
    scale = np.average(ratio, weights=weight)
    pulls = (np.array(ratio) - scale) / error
    assert 0.5 < np.std(pulls) < 1.6  # 14 pictures
    # peak contrasts, up to the common error of the template's peak
    contrast = scale * peak_per_amplitude(nominal) / peak_per_amplitude(truth)
    assert abs(abs(contrast) - 1) < 4 * found.template.peak_se + 0.01


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("template")
    content = _sampled(forward_model(_config(), 3000.0), 1500.0).to_bytes()
    (where / "template.npz").write_bytes(content)
    lines = ["[optics]", 'psf = "measured"', 'template = "template.npz"', "[template]"]
    lines.append(f'sha256 = "{sha256_of(content)}"')
    (where / "optics.toml").write_text("\n".join(lines))
    return where


def test_an_optics_file_brings_its_template(folder: Path) -> None:
    config = _config(**{"optics.file": str(folder / "optics.toml")})
    assert config.optics.psf == "measured"
    model = forward_model(config, 2000.0)
    assert model.is_measured
    assert model.peak_contrast(5.0, 200.0) == pytest.approx(
        forward_model(_config(), 2000.0).peak_contrast(5.0, 200.0), rel=0.02
    )
    again = folder / "config.toml"
    again.write_text(config_to_toml(config))
    assert load_config(again) == config
    line = _config(**{"optics.file": config.optics.file, "calibration.gradient_per_kda": 3e-5})
    with pytest.raises(ConfigError, match=r"with optics\.template the model's particles are dark"):
        forward_model(line, 2000.0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"fit.mode": "joint"}, r'"joint" needs the image at every height'),
        ({"optics.scheme": "darkfield"}, "needs an interferometric scheme"),
        ({"camera.pixel_size_nm": 84.0}, "measured with pixels of 100 nm"),
        ({"fit.roi_nm": 2500.0}, "known in a square of 1500 nm"),
        ({"optics.template": "missing.npz"}, "missing.npz: cannot be read"),
        ({"optics.template": __file__}, "is no template of"),
    ],
)
def test_what_a_template_does_not_know_is_refused(
    settings: dict[str, Any], message: str, folder: Path
) -> None:
    given = {"optics.psf": "measured", "optics.template": str(folder / "template.npz")}
    with pytest.raises(ConfigError, match=message):
        forward_model(_config(**given | settings), 2000.0)


def test_a_template_must_be_there_and_the_one_that_was_measured(
    folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="needs a template: run `iscat calibrate optics"):
        _config(**{"optics.psf": "measured"})
    copied = tmp_path / "optics.toml"
    copied.write_text((folder / "optics.toml").read_text())
    with pytest.raises(ConfigError, match="which cannot be read"):
        _config(**{"optics.file": str(copied)})
    (tmp_path / "template.npz").write_bytes(b"another")
    with pytest.raises(ConfigError, match="its SHA-256 differs"):
        _config(**{"optics.file": str(copied)})
