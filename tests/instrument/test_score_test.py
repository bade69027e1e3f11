"""All pictures together tell optics that are off, which none of them tells alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calibrations import configuration, make_particle_images

from iscat_analysis.instrument.joint_fit import maximise
from iscat_analysis.instrument.learning import REJECTED_P, ScoreTest, median_p, score_test
from iscat_analysis.instrument.particle_image import goodness, microscopes
from iscat_analysis.optics.parameters import Prior, prior_of, settings_of

COUNT = 8
PHOTONS = 1.5e5  # so few that single pictures of optics that are a little off are described


def _tested(changes: dict[str, Any], seed: int, count: int = COUNT) -> tuple[ScoreTest, float]:
    """Test pictures as configured; besides, the median of their p-values."""
    settings = settings_of(configuration())
    _, images, build = make_particle_images(
        changes, count, seed=seed, photons=PHOTONS, masses_kda=(2000.0,)
    )
    if not images:
        return score_test((), build, settings, Prior(settings)), np.nan
    fitted = maximise(images, build, settings, ()).images
    median = float(np.median([goodness(image, build(settings))[1] for image in fitted]))
    return score_test(fitted, build, settings, Prior(settings)), median


@pytest.mark.parametrize("changes", [{"focus_nm": -330.0}, {"z11": 10.0}])
def test_pictures_that_pass_alone_reject_the_optics_together(changes: dict[str, float]) -> None:
    found, median = _tested(changes, 1)
    assert median > REJECTED_P
    assert found.rejected
    ((name, value),) = changes.items()
    index = list(found.values).index(name)
    sigma = np.sqrt(found.covariance[index, index])
    assert abs(found.change[index] - (value - settings_of(configuration())[name])) < 4 * sigma


def test_right_optics_are_confirmed_and_what_is_not_told_keeps_its_usual_error() -> None:
    prior = np.diag(_tested({}, 0, 0)[0].posterior)
    for seed in range(4):
        found, _ = _tested({}, seed)
        assert not found.rejected
        assert found.log_bayes_factor < 0
        left = dict(zip(found.values, np.diag(found.posterior) / prior, strict=True))
        assert 0.3 < left.pop("na") < 1.0
        assert max(left.values()) < 0.25


def test_without_pictures_optics_have_their_usual_errors() -> None:
    found, _ = _tested({}, 0, 0)
    assert not found.rejected
    assert found.log_bayes_factor == 0
    focus = list(found.values).index("focus_nm")
    assert np.sqrt(found.posterior[focus, focus]) == pytest.approx(150.0)


@pytest.mark.parametrize(("height", "is_right"), [("auto", True), (5.0, False)])
def test_a_common_height_is_no_other_optics_if_heights_are_open(
    height: str | float, is_right: bool
) -> None:
    config = configuration()
    particle = config.particle.model_copy(update={"height_nm": height})
    config = config.model_copy(update={"particle": particle})
    assert config.fit.mode == "mass"
    images, *_ = make_particle_images(
        {}, COUNT, seed=5, photons=10 * PHOTONS, masses_kda=(2000.0,), height_nm=17.0
    )
    median, fitted = median_p(images, config)
    found = score_test(fitted, microscopes(config, 2600.0), settings_of(config), prior_of(config))
    assert (median > REJECTED_P and not found.rejected) == is_right
    assert (abs(fitted[0].z_nm - 17.0) < 1.0) == is_right


@pytest.mark.parametrize(
    ("mask_na", "attenuation", "own", "error"),
    [(0.6, 0.03, {}, 0.006), (0.6, 0.4, {}, 0.05), (0.0, 1.0, {}, 0.3),
     (0.6, 0.03, {"attenuation": 0.01}, 0.01)],
)  # fmt: skip
def test_the_transmission_of_a_dim_mask_is_known_to_a_share_of_it(
    mask_na: float, attenuation: float, own: dict[str, float], error: float
) -> None:
    """Masses are as its inverse: ±0.05 of 0.03 moved those of a mass photometer by a third."""
    prior = Prior({"mask_na": mask_na, "attenuation": attenuation}, own)
    np.testing.assert_allclose(prior.errors(["attenuation"]), [error])
