"""What an uncertain microscope leaves in all particles alike, against fits with a wrong one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from calibrations import PIXEL_NM

from iscat_analysis.bounds import displacement, joint_information, mass_drift, shared_sigma
from iscat_analysis.config import Config, parse_config
from iscat_analysis.inference.counts import asimov_conditional
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.maximiser import eliminated, imitation
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.records import Box

GRID = PixelGrid.centred(23, PIXEL_NM)
SHIFTS = {
    "focus_nm": 1.0,
    "na": 1e-4,
    "reference_phase_deg": 0.5,
    "mask_na": 2e-4,
    "attenuation": 5e-4,
    "z6": 0.1,
    "z7": 0.1,
    "z11": 0.1,
}
LINE = {"gradient_per_kda": -3.1e-5}


def _config(calibration: dict[str, float] | None, **optics: Any) -> Config:
    values: dict[str, Any] = {
        "optics": {
            "wavelength_nm": 525.0,
            "na": 1.42,
            "attenuation": 0.2,
            "mask_na": 0.6,
            "focus_nm": -300.0,
            "aberrations_nm": {"z6": 4.0, "z7": 6.0, "z11": 8.0},
        }
        | optics,
        "camera": {"pixel_size_nm": PIXEL_NM},
        "particle": {"kind": "protein", "mass_kda": 300.0, "height_nm": 5.0},
    }
    return parse_config(values | ({"calibration": calibration} if calibration else {}))


def _moved(config: Config, name: str, by: float) -> Config:
    optics = config.optics
    if name in optics.aberrations_nm:
        terms = dict(optics.aberrations_nm)
        change: dict[str, Any] = {"aberrations_nm": terms | {name: terms[name] + by}}
    else:
        change = {name: getattr(optics, name) + by}
    return config.model_copy(update={"optics": optics.model_copy(update=change)})


def _model(config: Config) -> ForwardModel:
    return forward_model(config, 1800.0, z_max_nm=100.0)


def _theta(model: ForwardModel, z_nm: float = 5.0) -> Any:
    return np.array([17.0, -29.0, z_nm, model.scale.amplitude(300.0), 0.0])


CASES = [*((name, None) for name in SHIFTS), *((name, LINE) for name in ("focus_nm", "z7"))]


@pytest.mark.parametrize(("name", "line"), CASES)
def test_a_fit_with_the_wrong_microscope_moves_as_foreseen(
    name: str, line: dict[str, float] | None
) -> None:
    """The counts of one microscope, without noise, fitted with another on either side of it."""
    config = _config(line)
    model = _model(config)
    z_nm = 60.0  # away from the coverslip, so that the height may move both ways
    theta = _theta(model, z_nm)
    truth = asimov_conditional(model, GRID, theta, 4e4, 100, 100)
    free = ("x_nm", "y_nm", "z_nm", "mass_kda")
    foreseen = displacement(truth, theta, (name,), free)[:, 0]
    step = 0.2 * SHIFTS[name]
    found = []
    for sign in (1, -1):
        wrong = _model(_moved(config, name, sign * step))
        likelihood = Likelihood(wrong, GRID, truth.noise, truth.data)
        start = theta.copy()
        start[3] = wrong.scale.amplitude(300.0)
        width = np.array([100.0, 100.0, 40.0, abs(start[3]), 0.5])
        box = Box(np.ones(5, bool), start - width, start + width)
        best = likelihood.maximize(start, box, tolerance=1e-12, passes=200)
        fitted = best.theta
        found.append([*fitted[:3], float(wrong.scale.mass(fitted[3]))])
    slope = (np.array(found[0]) - found[1]) / (2 * step)
    size = np.array([1.0, 1.0, 1.0, 300.0 / 100])  # nm, and 1 % of the mass
    worst = np.abs(slope - foreseen) / (np.abs(foreseen) + 1e-2 * size / SHIFTS[name])
    assert worst.max() < 0.03, (slope, foreseen)


def test_own_unknowns_are_eliminated_as_by_the_whole_inverse() -> None:
    model = _model(_config(None))
    theta = _theta(model)
    likelihood = asimov_conditional(model, GRID, theta, 4e4, 100, 100)
    names = ("focus_nm", "na", "z7")
    whole = joint_information(likelihood, theta, names)
    # the block of the particle is that of its fits
    np.testing.assert_allclose(whole[3:, 3:], likelihood.score_fisher(theta)[2], rtol=1e-6)
    scale = 1 / np.sqrt(np.diag(whole))
    inverse = np.linalg.inv(whole * np.outer(scale, scale)) * np.outer(scale, scale)
    np.testing.assert_allclose(np.linalg.inv(eliminated(whole, 3)), inverse[:3, :3], rtol=1e-6)
    # in a joint fit, what is common to all moves the particle by D, to the last digit
    np.testing.assert_allclose(
        inverse[3:, :3], imitation(whole, 3) @ inverse[:3, :3], rtol=1e-5, atol=1e-12
    )


def test_a_calibration_ties_mass_to_contrast() -> None:
    """The mass of an amplitude follows the peak, found here by building the neighbours."""
    config = _config(LINE)
    model = _model(config)
    amplitude = model.scale.amplitude(300.0)
    drift = mass_drift(model, amplitude, tuple(SHIFTS))
    for k, (name, step) in enumerate(SHIFTS.items()):
        masses = [
            float(_model(_moved(config, name, sign * step)).scale.mass(np.array(amplitude)))
            for sign in (1, -1)
        ]
        slope = (masses[0] - masses[1]) / (2 * step)
        assert drift[k] == pytest.approx(slope, rel=0.01, abs=1e-3 / step), name
    assert not mass_drift(_model(_config(None)), 300.0, tuple(SHIFTS)).any()


def test_covariances_become_standard_deviations() -> None:
    moves = np.array([[1.0, 2.0], [0.0, 3.0]])
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_allclose(shared_sigma(moves, covariance), [np.sqrt(44.0), 9.0])
