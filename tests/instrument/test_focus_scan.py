"""A scan of the focus over gold, made by an independent quadrature, tells the microscope."""

from __future__ import annotations

import numpy as np
import pytest
from calibrations import configuration, make_particle_images
from instruments import Instrument, focus_scan, strength_of_sphere

import iscat_analysis as ia
from iscat_analysis.instrument.learning import calibrate_movie
from iscat_analysis.instrument.measure import OpticsSearch
from iscat_analysis.instrument.particle_image import best_amplitudes
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.optics.parameters import optics_limits, prior_of, settings_of

SIGMAS = 4.0
PIXEL_NM = 84.0
STEP_NM = 125.0
FOCI_NM = np.arange(-1000.0, 1001.0, STEP_NM)
ABERRATIONS = {7: 10.0, 11: 15.0}


def _scan(seed: int, attenuation: float) -> tuple[Instrument, OpticsCalibration]:
    """One particle of 20 nm, seen by an instrument that the configuration does not know.

    The configured focus is off by 150 nm, its step by 3 %, the aperture by 0.02.
    """
    random = np.random.default_rng(seed)
    instrument = Instrument(
        na=1.40, height_nm=10.0, emission="reciprocal", attenuation=attenuation,
        reference_phase_deg=15.0, aberrations_nm=ABERRATIONS,
    )  # fmt: skip
    frames = focus_scan(
        instrument,
        FOCI_NM,
        24 + random.uniform(-0.5, 0.5, (1, 2)),
        np.array([strength_of_sphere(instrument, 20.0, _index())]),
        (49, 49),
        level_e=2e4,
        pixel_nm=PIXEL_NM,
        seed=seed,
    )
    config = ia.configure(
        settings={
            "optics.wavelength_nm": 525.0, "optics.na": 1.42, "optics.attenuation": attenuation,
            "optics.focus_nm": FOCI_NM[0] + 150.0, "camera.pixel_size_nm": PIXEL_NM,
            "camera.gain_e_per_adu": 1.0,
            "fit.roi_nm": 2000.0, "compute.workers": 1,
            "particle.kind": "gold", "particle.diameter_nm": 20.0, "particle.height_nm": 10.0,
        }
    )  # fmt: skip
    found = calibrate_movie(
        ia.open_stack(frames), config, free="focus,na,phase,zernike", focus_step_nm=1.03 * STEP_NM
    )
    return instrument, found


def _index() -> complex:
    """Refractive index of gold at 525 nm, between the lines of Johnson and Christy (1972)."""
    wavelengths, n, k = (1239.842 / 2.38, 1239.842 / 2.26), (0.62, 0.43), (2.081, 2.455)
    return complex(np.interp(525.0, wavelengths, n), np.interp(525.0, wavelengths, k))


SCANS = [(1, 1.0), *((seed, dim) for seed in (2, 3, 4) for dim in (1.0, 0.2))]


@pytest.mark.large
@pytest.mark.parametrize(("seed", "attenuation"), SCANS)
def test_a_scan_of_gold_tells_steps_and_aberrations(seed: int, attenuation: float) -> None:
    instrument, found = _scan(seed, attenuation)
    assert found.accepted, found.measured.refusals
    assert found.measured.twin is None
    truth = {
        "focus_nm": FOCI_NM[0],
        "focus_step_nm": STEP_NM,
        "na": instrument.na,
        "reference_phase_deg": instrument.reference_phase_deg,
        **{f"z{j}": size for j, size in ABERRATIONS.items()},
    }
    assert set(truth) <= set(found.names)
    for name in found.names:
        pull = (found.value(name) - truth.get(name, 0.0)) / found.sigma(name)
        assert abs(pull) < SIGMAS, (name, pull)
    assert found.sigma("focus_step_nm") < 0.01 * STEP_NM
    # steps are told by the scan, and are no part of the optics that fits read
    assert "focus_step_nm" not in found.to_toml().partition("[provenance]")[0]
    assert "steps of" in found.headline()


def test_the_best_strength_of_a_strong_particle() -> None:
    """The root of the cubic against all amplitudes of a fine grid."""
    random = np.random.default_rng(5)
    data, one, two = random.standard_normal((3, 200))
    data += 0.8 * one + 0.64 * two
    tried = np.linspace(-4, 4, 80_001)
    explained = (
        2 * (tried * (data @ one) + tried**2 * (data @ two))
        - tried**2 * (one @ one) - 2 * tried**3 * (one @ two) - tried**4 * (two @ two)
    )  # fmt: skip
    amplitude, gain = best_amplitudes(data @ one, data @ two, one @ one, one @ two, two @ two)
    assert float(amplitude) == pytest.approx(tried[np.argmax(explained)], abs=1e-3)
    assert float(gain) == pytest.approx(explained.max(), rel=1e-6)
    # without the square it is a plain regression
    amplitude, gain = best_amplitudes(data @ one, 0.0, one @ one, 0.0, 0.0)
    assert float(amplitude) == pytest.approx((data @ one) / (one @ one))
    assert float(gain) == pytest.approx((data @ one) ** 2 / (one @ one))


@pytest.mark.parametrize(
    "direction", [35.0, *(pytest.param(d, marks=pytest.mark.large) for d in (80.0, 100.0, 150.0))]
)
def test_the_direction_of_linear_light_is_told(direction: float) -> None:
    config = configuration()
    changes = {"polarization_deg": direction, "focus_nm": -350.0}
    images, _, build = make_particle_images(changes, 15, seed=int(direction))
    found = OpticsSearch(
        settings_of(config),
        build,
        ("focus", "phase", "polarization"),
        optics_limits(1.515, 1.515),
        prior_of(config),
        side=-1,
    ).run(images)
    assert not found.refusals
    assert found.settings["polarization"] == "linear"
    sigma = dict(
        zip(found.estimate.names, np.sqrt(np.diag(found.estimate.covariance)), strict=True)
    )
    apart = (found.settings["polarization_deg"] - direction + 90) % 180 - 90
    assert abs(apart) < SIGMAS * sigma["polarization_deg"]
    assert sigma["polarization_deg"] < 3.0
    assert abs(found.settings["focus_nm"] + 350.0) < SIGMAS * sigma["focus_nm"]
