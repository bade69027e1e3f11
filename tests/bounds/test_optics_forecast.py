"""What particles would tell of the microscope: published numbers, laws, and fits that follow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calibrations import GRID, PHOTONS, PIXEL_NM, configuration, make_particle_images

import iscat_analysis as ia
from iscat_analysis.bounds.shared import forecast_optics
from iscat_analysis.instrument.joint_fit import maximise
from iscat_analysis.optics.parameters import FREE, is_term, settings_of
from iscat_analysis.records import Box

REALISTIC: dict[str, Any] = {
    "optics.na": 1.40, "optics.focus_nm": -370.0, "optics.reference_phase_deg": 20.0,
    "optics.polarization": "circular", "optics.analyzer": True, "optics.mask_na": 0.6,
    "optics.attenuation": 0.1, "optics.aberrations_nm": {"z7": 8.0, "z11": 18.0},
    "optics.wavelength_nm": 525.0, "camera.pixel_size_nm": 84.0, "fit.roi_nm": 4000.0,
    "particle.mass_kda": 200.0, "calibration.gradient_per_kda": -3.1e-5,
    "bounds.photons_per_pixel": 1e5, "bounds.n_before": 50, "bounds.n_after": 50,
}  # fmt: skip
"""A realistic sum of small departures, in a mass photometer."""

PUBLISHED = {
    "focus_nm": 1.4, "na": 0.0002, "reference_phase_deg": 1.4, "mask_na": 0.0006,
    "attenuation": 0.005, "z11": 0.4, **{f"z{j}": 0.1 for j in range(5, 11)},
}  # fmt: skip
"""100 steps of 200 kDa, the second spherical aberration known; microscope.md, section 1."""


def test_numbers_of_the_specification() -> None:
    """Rounded there, and for a sum of departures whose sizes are not all told: ±35 %."""
    found = ia.forecast_optics(settings=REALISTIC, events=100)
    names = list(found.values)
    known = [names.index(n) for n in names if n != "z22"]
    information = np.linalg.inv(found.covariance)[np.ix_(known, known)]
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    for k, error in zip(known, sigma, strict=True):
        assert error == pytest.approx(PUBLISHED[names[k]], rel=0.35), names[k]
    assert found.parameters["determined"].all()


def test_errors_fall_with_the_root_of_the_events_beside_the_prior() -> None:
    config = ia.configure(settings=REALISTIC)
    one, many = (forecast_optics(config, events=n) for n in (50, 200))
    known = np.diag(one.usual**-2.0)  # without any picture
    first, more = (np.linalg.inv(found.covariance) - known for found in (one, many))
    np.testing.assert_allclose(4 * first, more, rtol=1e-6, atol=1e-6 * np.abs(more).max())
    for mode, common in one.common.items():
        for name, sigma in common.items():
            assert sigma == pytest.approx(2 * many.common[mode][name], rel=0.1)
    # so many reach the goals
    row = many.needed.set_index("mass_kda").loc[200.0]
    count = int(row["focus_nm"])
    there = forecast_optics(config, events=count)
    sigma = there.parameters.set_index("parameter")["sigma"]["focus_nm"]
    assert sigma <= 5.0
    assert sigma * np.sqrt(count / (count - 1)) > 5.0  # one event fewer


def test_what_is_not_told_is_named() -> None:
    """Light too faint for an aperture, and more of it for everything."""
    faint = REALISTIC | {"particle.mass_kda": 4.0}
    found = ia.forecast_optics(settings=faint, events=12)
    rows = found.parameters.set_index("parameter")
    assert (rows["sigma"] < rows["usual_error"] * (1 + 1e-9)).all()
    assert not rows["determined"].all()
    for name, row in rows.iterrows():
        assert row["determined"] == (row["sigma"] < 0.5 * row["usual_error"])
        assert row["determined"] != any(line.startswith(name) for line in found.unidentifiable)
    assert [each.code for each in found.findings] == ["faint-pictures"]


def test_a_fit_of_pictures_has_the_errors_that_were_foreseen() -> None:
    mass, count = 6000.0, 24
    changes = {"z11": 12.0, "z7": 9.0, "focus_nm": -340.0}
    names = ("focus_nm", "na", "reference_phase_deg", *filter(is_term, FREE["zernike"]))
    _, truth, build = make_particle_images(changes, count, seed=31, masses_kda=(mass,), leaving=0.0)
    config = configuration()
    fit = maximise(truth, build, {**settings_of(config), **changes}, names)
    true = ia.configure(
        config,
        settings={
            "optics.focus_nm": -340.0,
            "optics.aberrations_nm": {"z7": 9.0, "z11": 12.0},
            "particle.mass_kda": mass,
            "bounds.photons_per_pixel": PHOTONS,
            "bounds.n_before": 1,
            "bounds.n_after": 1,
            "fit.roi_nm": GRID.shape[0] * PIXEL_NM,
        },
    )
    foreseen = forecast_optics(true, events=count, free="focus,na,phase,zernike")
    assert tuple(foreseen.values) == names
    sigma = np.sqrt(np.diag(foreseen.covariance))
    np.testing.assert_allclose(np.sqrt(np.diag(fit.bound)), sigma, rtol=0.03)
    # and with the errors from the residuals: 24 pictures know them to some per cent
    np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), sigma, rtol=0.25)


def test_masses_of_other_particles_err_by_what_was_foreseen() -> None:
    """Microscopes drawn from the forecast's covariance, and one particle fitted in each."""
    from iscat_analysis.inference.counts import asimov_conditional
    from iscat_analysis.inference.likelihood import Likelihood
    from iscat_analysis.optics.forward import forward_model
    from iscat_analysis.optics.parameters import with_settings

    config = ia.configure(settings=REALISTIC | {"fit.roi_nm": 2700.0})
    found = forecast_optics(config, events=60)
    model = forward_model(config, 2500.0, z_max_nm=5.0)
    theta = np.array([11.0, -7.0, 5.0, model.scale.amplitude(200.0), 0.0])
    truth = asimov_conditional(model, GRID, theta, 1e5, 50, 50)
    random = np.random.default_rng(41)
    draws = random.multivariate_normal(np.zeros(len(found.values)), found.covariance, 40)
    masses = []
    for draw in draws:
        moved = {n: v + d for (n, v), d in zip(found.values.items(), draw, strict=True)}
        wrong = forward_model(
            with_settings(config, {**settings_of(config), **moved}), 2500.0, z_max_nm=5.0
        )
        likelihood = Likelihood(wrong, GRID, truth.noise, truth.data)
        start = theta.copy()
        start[3] = wrong.scale.amplitude(200.0)
        width = np.array([80.0, 80.0, 0.0, abs(start[3]), 0.5])
        free = np.array([True, True, False, True, True])
        best = likelihood.maximize(start, Box(free, start - width, start + width), tolerance=1e-9)
        masses.append(float(wrong.scale.mass(np.array(best.theta[3]))))
    spread = float(np.std(masses, ddof=1))
    # the spread of 40 draws is known to 11 %
    assert abs(spread / found.common["mass"]["mass_kda"] - 1) < 4 * 0.115


@pytest.mark.parametrize(
    ("settings", "free", "said"),
    [
        ({"optics.scheme": "darkfield"}, None, "interference with a reference"),
        ({"camera.pixel_size_nm": None}, None, "pixel_size_nm is missing"),
        ({"optics.mask_na": 0.0}, "mask", "no such continuous parameter"),
        ({}, "focus,fokus", "cannot be set free"),
    ],
)
def test_what_cannot_be_foreseen_is_refused(
    settings: dict[str, Any], free: str | None, said: str
) -> None:
    given = REALISTIC | settings
    if settings.get("optics.scheme"):
        given.pop("calibration.gradient_per_kda")
    with pytest.raises(ia.ConfigError, match=said):
        ia.forecast_optics(settings=given, free=free)
