"""The microscope is learned within its stated errors, or refused with the reason."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from calibrations import GRID, PHOTONS, configuration, make_particle_images, microscope

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.findings.optics import ODD_APERTURE
from iscat_analysis.instrument.joint_fit import maximise
from iscat_analysis.instrument.loop import fit_optics
from iscat_analysis.instrument.measure import HELD_OUT_P, Measured, OpticsSearch
from iscat_analysis.instrument.particle_image import (
    Collected,
    average_particle_images,
    build_microscope,
)
from iscat_analysis.optics.forward import ForwardModel
from iscat_analysis.optics.parameters import (
    PARAMETERS,
    are_told,
    optics_limits,
    prior_of,
    settings_of,
)
from iscat_analysis.optics.pixels import PixelGrid

SIGMAS = 4.0
"""A parameter farther from the truth than this many standard errors is wrong: 6e-5 by chance."""

ROUND = ("focus", "na", "phase", "zernike")


def _measure(
    changes: dict[str, Any],
    count: int,
    seed: int,
    *,
    free: tuple[str, ...] = ROUND,
    config: Config | None = None,
    **light: Any,
) -> Measured:
    config = configuration() if config is None else config
    images, _, build = make_particle_images(changes, count, seed=seed, config=config, **light)
    return _search(config, build, free).run(images)


def _search(config: Config, build: Any, free: tuple[str, ...]) -> OpticsSearch:
    limits = optics_limits(1.515, 1.515)
    return OpticsSearch(settings_of(config), build, free, limits, prior_of(config), side=-1)


def test_a_picture_that_is_registered_far_off_does_not_leave_the_model() -> None:
    """Its particle lies 750 nm from the centre, and models reach as far as particles may roam."""
    config = configuration()
    images, _, _ = make_particle_images({}, 8, seed=12)
    signal = microscope(config, {}).image(GRID, 540.0, -520.0, 5.0, 6000.0)
    before, after = np.random.default_rng(13).poisson(
        [np.full(GRID.shape, PHOTONS), PHOTONS * (1 + signal)]
    )
    data = images[-1].data.copy()
    data[0], data[1] = after, before + after
    images[-1] = replace(images[-1], data=data, x_nm=540.0, y_nm=-520.0, snr=1.0)
    images.sort(key=lambda image: -image.snr)
    reach = GRID.diagonal_nm / 2 + 450.0

    def build(settings: Mapping[str, Any]) -> ForwardModel:
        return build_microscope(config, reach, settings)

    _, placed = average_particle_images(images)
    assert math.hypot(placed[-1].x_nm, placed[-1].y_nm) > 500.0  # the trap is set
    found = _search(config, build, ROUND).run(images)
    assert len(found.estimate.images) >= 6


def _pulls(found: Measured, changes: dict[str, Any], config: Config | None = None) -> np.ndarray:  # type: ignore[type-arg]
    truth = {**settings_of(configuration() if config is None else config), **changes}
    sigma = np.sqrt(np.diag(found.estimate.covariance))
    names = found.estimate.names
    return np.array([(found.settings[n] - truth[n]) / s for n, s in zip(names, sigma, strict=True)])


MICROSCOPES = {
    "spherical aberration": {"z11": 20.0},
    "coma, another focus and phase": {"z7": 25.0, "focus_nm": -400.0, "reference_phase_deg": 15.0},
}


@pytest.mark.parametrize("name", MICROSCOPES)
def test_parameters_lie_within_their_errors(name: str) -> None:
    changes = MICROSCOPES[name]
    found = _measure(changes, 16, seed=11)
    assert not found.refusals
    assert found.configured.uniform_p < HELD_OUT_P
    assert np.abs(_pulls(found, changes)).max() < SIGMAS
    assert {n for n in changes if n[0] != "z"} <= set(found.estimate.names)


def test_circular_light_and_a_mask_are_recognised() -> None:
    changes = {"polarization": "circular", "mask_na": 0.6}
    found = _measure(changes, 18, seed=12, free=("focus", "phase", "mask", "polarization"))
    assert not found.refusals
    assert found.settings["polarization"] == "circular"
    assert np.abs(_pulls(found, changes)).max() < SIGMAS


def test_a_good_configuration_stays() -> None:
    found = _measure({}, 16, seed=13)
    assert found.configured.good
    assert not found.refusals
    assert np.abs(_pulls(found, {})).max() < SIGMAS


def test_what_may_not_change_is_missed() -> None:
    """Control: without the aberration that the pictures have, they are not described."""
    found = _measure({"z11": 20.0}, 16, seed=14, free=("focus", "phase"))
    assert found.refusals
    assert "not fitted" in found.refusals[0]


def test_optics_that_make_other_pictures_worse_are_refused() -> None:
    """Two thirds of the pictures are of another focus; control: they all are of that."""
    images, _, build = make_particle_images({"focus_nm": -340.0}, 18, seed=21)
    of_configured, _, _ = make_particle_images({}, 18, seed=21)
    order = sorted(range(18), key=lambda k: -images[k].snr)
    mixed = [
        replace((of_configured if rank % 3 == 1 else images)[k], snr=100.0 - rank)
        for rank, k in enumerate(order)
    ]
    for pictures, refused in ((mixed, True), (images, False)):
        found = _search(configuration(), build, ("focus",)).run(pictures)
        worse = "the configured optics describe pictures that were not fitted better"
        assert (worse in found.refusals) == refused


def test_weak_particles_below_the_critical_angle_have_a_twin() -> None:
    config = configuration(na=1.2)
    changes = {"z5": 8.0, "focus_nm": -350.0, "reference_phase_deg": 20.0}
    weak = {"photons": 4e7, "masses_kda": (300.0, 600.0)}
    found = _measure(changes, 18, 15, config=config, free=("focus", "phase", "zernike"), **weak)
    assert found.twin is not None
    assert found.settings["focus_nm"] < 0 < found.twin.settings["focus_nm"]
    assert np.abs(_pulls(found, changes, config)).max() < SIGMAS


def test_light_beyond_the_critical_angle_rules_the_twin_out() -> None:
    found = _measure({"focus_nm": -350.0}, 18, seed=16, free=("focus", "phase", "zernike"))
    assert found.twin is None


def test_no_particle_is_refused_with_what_to_record() -> None:
    with pytest.raises(DataError, match=r"faint.tif: shows no bright particle.*record brighter"):
        fit_optics(Collected(configuration(), []), ROUND, {"movie": "faint.tif"})


@pytest.mark.parametrize("focus_nm", [-400.0, -200.0])
@pytest.mark.parametrize("count", [1, 5])
def test_few_particles_tell_what_they_tell(count: int, focus_nm: float) -> None:
    """One is enough for the focus; of what it does not tell the usual error is left."""
    changes = {"focus_nm": focus_nm}
    found = _measure(changes, count, seed=30 + count, photons=3e6, masses_kda=(2000.0,))
    assert not found.refusals
    assert found.judgement.fitted
    sigma = dict(
        zip(found.estimate.names, np.sqrt(np.diag(found.estimate.covariance)), strict=True)
    )
    assert set(ROUND) <= {PARAMETERS[name].group for name in sigma}
    assert sigma["focus_nm"] < 15.0
    assert np.abs(_pulls(found, changes)).max() < SIGMAS
    assert all(error <= 1.01 * PARAMETERS[name].usual_error for name, error in sigma.items())


def test_a_parameter_at_its_limit_is_refused() -> None:
    config = configuration()
    images, _, build = make_particle_images({"na": 1.33}, 10, seed=19)
    search = _search(config, build, ("focus", "na", "phase"))
    found = replace(search, limits={**search.limits, "na": (1.36, 1.5)}).run(images)
    assert any(line.startswith("na = 1.36 lies at its limit") for line in found.refusals)


def test_a_wrong_pixel_size_is_suspected() -> None:
    """Pixels that are said to be 6 % larger than they are look like a smaller aperture."""
    from iscat_analysis.instrument.result import OpticsCalibration

    said, factor = configuration(), 1.06
    pixel = said.camera.pixel_size_nm
    assert pixel is not None
    images, _, _ = make_particle_images({}, 12, seed=20)
    larger = said.model_copy(
        update={"camera": said.camera.model_copy(update={"pixel_size_nm": factor * pixel})}
    )
    stretched = [
        replace(
            s,
            grid=PixelGrid.centred(s.grid.shape[0], factor * pixel),
            x_nm=factor * s.x_nm,
            y_nm=factor * s.y_nm,
        )
        for s in images
    ]
    found = fit_optics(Collected(larger, stretched), ROUND, {"movie": "m.tif"})
    assert isinstance(found, OpticsCalibration)
    (note,) = [one for one in found.notes if one.kind is ODD_APERTURE]
    assert note.values["pixel_nm"] == pytest.approx(pixel, rel=0.005)
    fine = fit_optics(Collected(said, images), ROUND, {"movie": "m.tif"})
    assert not any(one.kind is ODD_APERTURE for one in fine.notes)
    # where it is the aperture that is wrong, light beyond the critical angle says so
    engraved = fit_optics(Collected(configuration(na=1.38), images), ROUND, {"movie": "m.tif"})
    assert isinstance(engraved, OpticsCalibration)
    assert engraved.value("na") == pytest.approx(1.42, abs=SIGMAS * engraved.sigma("na"))
    assert not any(one.kind is ODD_APERTURE for one in engraved.notes)


def test_what_the_pictures_do_not_tell_stays_as_configured_with_its_usual_error() -> None:
    """Particles far below the noise tell nothing; control: bright ones do."""
    names = ("focus_nm", "na", "reference_phase_deg", "z11")
    usual = np.array([PARAMETERS[name].usual_error for name in names])
    configured = settings_of(configuration())
    for photons, told in ((15.0, False), (PHOTONS, True)):
        _, truth, build = make_particle_images({}, 14, seed=18, photons=photons)
        found = maximise(truth, build, configured, names)
        sigma = np.sqrt(np.diag(found.covariance))
        assert are_told(sigma, usual).all() == told
        if not told:
            assert sigma[1] == pytest.approx(usual[1], rel=0.02)
            assert found.values["na"] == pytest.approx(configured["na"], abs=0.2 * usual[1])


def test_the_evidence_is_the_likelihood_averaged_over_the_prior() -> None:
    """Against a plain sum over the focus, at a prior that the pictures narrow."""
    _, truth, build = make_particle_images({"focus_nm": -310.0}, 2, seed=22, photons=2e4)
    configured = settings_of(configuration())
    found = maximise(truth, build, configured, ("focus_nm",), tolerance=1e-6)
    foci = np.linspace(-750.0, 150.0, 181)
    plain = [maximise(found.images, build, {**configured, "focus_nm": f}, ()) for f in foci]
    usual = PARAMETERS["focus_nm"].usual_error
    prior = np.exp(-0.5 * ((foci - configured["focus_nm"]) / usual) ** 2)
    values = np.array([fit.log_likelihood for fit in plain])
    top = values.max()
    mean = top + math.log(float(np.sum(np.exp(values - top) * prior) / prior.sum()))
    assert found.log_evidence == pytest.approx(mean, abs=0.3)
    assert math.sqrt(found.bound[0, 0]) < 0.5 * usual
