"""A stage that drifts and shakes under light that stays, on a microscope that is not configured.

Of a speckled background 2 nm of vibration are more than the noise of the light, where pixels are
taken together.  With the motion divided out the optics are learned as on a stage that rests.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from instruments import Instrument, InstrumentMovie, Landings, draw_landings

from iscat_analysis.camera import camera_from_config, follow_pattern
from iscat_analysis.config import Config, load_config
from iscat_analysis.fitting.run import Run
from iscat_analysis.instrument.learning import learn_optics
from iscat_analysis.landing.find import analyse_landings

pytestmark = pytest.mark.large

SHAPE = (900, 144, 136)
LANDINGS = draw_landings(SHAPE, 30, seed=31, masses=(480.0,), apart_px=16.0, margin_px=20.0)
NA = 1.38
Y, X = np.mgrid[: SHAPE[1], : SHAPE[2]]
BEAM = 0.3 + np.exp(-((X - 50) ** 2 + (Y - 80) ** 2) / (2 * 55.0**2))
SIGMAS = 4.0


@cache
def _movie() -> InstrumentMovie:
    jitter = 0.02 * np.random.default_rng(32).standard_normal((SHAPE[0], 2))
    drift = np.linspace(0, 1, SHAPE[0])[:, None] * [-0.2, 0.4]
    microscope = Instrument(
        emission="reciprocal", focus_nm=-340.0, na=NA, aberrations_nm={11: 12.0}
    )
    return InstrumentMovie(
        microscope, SHAPE, LANDINGS, seed=33, speckle=0.1, beam=BEAM, stage_px=jitter + drift
    )


def _config(*, follows: bool) -> Config:
    return load_config(
        None,
        [
            "camera.pixel_size_nm=84.0", "camera.gain_e_per_adu=4.0", "optics.focus_nm=-300",
            "particle.mass_kda=146", "calibration.gradient_per_kda=-3.1e-5",
            "background.method=sliding", f"background.drift_correction={str(follows).lower()}",
            "compute.workers=1",
        ],
    )  # fmt: skip


def _learned(*, follows: bool) -> tuple[Config, list[str]]:
    movie, config = _movie(), _config(follows=follows)
    camera = camera_from_config(config.camera, SHAPE[1:], movie.dtype)
    learned, _, findings = learn_optics(movie, config, camera)
    return learned, [finding.text for finding in findings]


def test_optics_are_learned_with_the_motion_divided_out() -> None:
    learned, said = _learned(follows=True)
    assert learned.optics.calibrate == "never", said
    assert learned.optics.covariance is not None
    k = learned.optics.covariance.names.index("na")
    assert abs(learned.optics.na - NA) < SIGMAS * np.sqrt(learned.optics.covariance.matrix[k][k])
    camera = camera_from_config(learned.camera, SHAPE[1:], _movie().dtype)
    found = analyse_landings(_movie(), learned, camera, Run(notify=said.append))
    good = found.fits["status"] == "ok"
    assert good.sum() >= len(LANDINGS.frame) - 3
    assert good.sum() >= len(found.fits) - 4


def test_a_stage_that_shakes_is_named_with_what_to_do() -> None:
    learned, _ = _learned(follows=False)
    assert learned.optics.calibrate == "auto"
    camera = camera_from_config(learned.camera, SHAPE[1:], _movie().dtype)
    said: list[str] = []
    analyse_landings(_movie(), learned, camera, Run(notify=said.append))
    (line,) = (text for text in said if "shakes" in text)
    assert "the gain is not the cause" in line
    assert "set background.drift_correction = true" in line
    assert not any("set camera.gain_e_per_adu" in text for text in said)


@pytest.mark.parametrize("beam", [1.0, BEAM], ids=["even", "uneven"])
def test_light_that_stays_does_not_hold_the_pattern_back(beam: float | np.ndarray) -> None:
    """It would be followed by 4 % too little if the light were taken to move with the sample."""
    blocks, way = 40, 0.02
    stage = np.outer(np.arange(blocks), [0.0, way])
    nothing = Landings(np.array([1]), np.array([64.0]), np.array([64.0]), np.array([1e-6]))
    movie = InstrumentMovie(
        Instrument(), (blocks, 128, 128), nothing, seed=35, level_e=4e6, gain_e_per_adu=100.0,
        speckle=0.1, beam=beam if isinstance(beam, float) else beam[:128, :128], stage_px=stage,
    )  # fmt: skip
    counts = movie.counts.astype(float) * 100.0
    found = follow_pattern(
        counts, counts.mean(axis=(1, 2)) / counts.mean(), np.arange(float(blocks)),
        np.ones((128, 128), dtype=bool), np.zeros((128, 128)),
    )  # fmt: skip
    assert found is not None
    moved = found.shift_px[-1] / (way * (blocks - 1))
    assert abs(moved[1] - 1) < 0.01
    assert abs(moved[0]) < 0.01
