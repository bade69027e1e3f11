"""A focus that moves or jumps during a landing movie is noticed, learned, and fitted with.

The movies know nothing of the model that is fitted; of the heaviest particles the pictures change
by many times their noise.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from instruments import Instrument, InstrumentMovie, draw_landings
from shared_errors import systematic

from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Config, load_config
from iscat_analysis.diagnosis import Stretches
from iscat_analysis.errors import ConfigError
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.instrument.learning import learn_optics
from iscat_analysis.landing.find import analyse_landings

pytestmark = pytest.mark.large

SHAPE = (1400, 176, 160)
LANDINGS = draw_landings(SHAPE, 36, seed=21, masses=(480.0, 480.0, 146.0), apart_px=20.0)
FOCUS_NM = -300.0
SIGMAS = 4.0


@cache
def _movie(rise_nm: float) -> InstrumentMovie:
    return _moving(np.linspace(-0.5, 0.5, SHAPE[0]) * rise_nm if rise_nm else None)


def _moving(course_nm: np.ndarray | None) -> InstrumentMovie:
    microscope = Instrument(emission="reciprocal", focus_nm=FOCUS_NM)
    return InstrumentMovie(microscope, SHAPE, LANDINGS, seed=22, focus_nm=course_nm)


def _config(*settings: str) -> Config:
    return load_config(
        None,
        [
            "camera.pixel_size_nm=84.0", "camera.gain_e_per_adu=4.0", f"optics.focus_nm={FOCUS_NM}",
            "particle.mass_kda=146", "calibration.gradient_per_kda=-3.1e-5",
            "background.method=sliding", "compute.workers=1", *settings,
        ],
    )  # fmt: skip


def _learned(movie: InstrumentMovie, config: Config) -> tuple[Config, list[str]]:
    camera = camera_from_config(config.camera, SHAPE[1:], movie.dtype)
    learned, _, findings = learn_optics(movie, config, camera)
    return learned, [finding.text for finding in findings]


def _analysed(movie: InstrumentMovie, config: Config) -> DetectionResult:
    camera = camera_from_config(config.camera, SHAPE[1:], movie.dtype)
    jumps = [frame for frame, _ in config.optics.focus_jumps]
    return analyse_landings(
        movie, config, camera, Run(),
        stretches=Stretches(((0, SHAPE[0]),)).with_jumps(jumps).kept,
    )  # fmt: skip


def _poor(found: DetectionResult) -> int:
    heavy = found.fits["mass_kda"].abs() > 300
    return int((heavy & (found.fits["status"] == "poor_fit")).sum())


@pytest.mark.parametrize("rise_nm", [90.0, pytest.param(-120.0, marks=pytest.mark.large)])
def test_a_focus_that_moves_is_learned_and_fitted_with(rise_nm: float) -> None:
    movie = _movie(rise_nm)
    assert _poor(_analysed(movie, _config())) >= 6  # as configured it describes few of them
    learned, said = _learned(movie, _config())
    assert learned.optics.calibrate == "never", said
    line = next(text for text in said if "rising by" in text)
    optics = learned.optics
    sigma = float(line.split("rising by ")[1].split("± ")[1].split()[0])
    assert abs(optics.focus_drift_nm - rise_nm * 1000 / SHAPE[0]) < SIGMAS * sigma
    assert optics.covariance is not None
    k = optics.covariance.names.index("focus_nm")
    assert abs(optics.focus_nm - FOCUS_NM) < SIGMAS * np.sqrt(optics.covariance.matrix[k][k])
    found = _analysed(movie, learned)
    assert _poor(found) <= 1
    pulls = _pulls(found, learned)
    assert len(pulls) >= len(LANDINGS.frame) - 3
    assert np.sqrt(np.mean(np.square(pulls))) < 1 + SIGMAS / np.sqrt(2 * len(pulls))


def _pulls(found: DetectionResult, config: Config) -> list[float]:
    good = found.fits[found.fits["status"] == "ok"].reset_index(drop=True)
    shared = systematic(config, good)["mass_kda"]
    pulls = []
    for x, y, frame, mass in zip(
        LANDINGS.x_px, LANDINGS.y_px, LANDINGS.frame, LANDINGS.mass_kda, strict=True
    ):
        here = np.hypot(good["x_px"] - x, good["y_px"] - y) < 1
        row = good[here & (np.abs(good["frame"] - frame) < 20)]
        if len(row) == 1:
            error = np.hypot(row["sigma_mass_kda"].item(), shared[row.index[0]])
            pulls.append((row["mass_kda"].item() - mass) / error)
    return pulls


@pytest.mark.parametrize(
    "jumps",
    [((700, 60.0),), ((700, 30.0),), ((560, -120.0),), ((480, 60.0), (740, -60.0))],
    ids=lambda jumps: " and ".join(f"{rise:g} nm" for _, rise in jumps),
)
def test_a_focus_that_jumps_is_learned_with_its_frame(jumps: tuple[tuple[int, float], ...]) -> None:
    frames = np.arange(SHAPE[0])
    course = sum((rise * (frames >= frame) for frame, rise in jumps), start=np.zeros(SHAPE[0]))
    learned, said = _learned(_moving(course), _config())
    found = sorted(learned.optics.focus_jumps)
    assert len(found) == len(jumps), said
    assert learned.optics.focus_drift_nm == learned.optics.focus_bend_nm == 0
    for (frame, rise), (at, by) in zip(found, jumps, strict=True):
        assert abs(frame - at) <= 8  # a tenth of a window
        assert abs(rise - by) < 5.0  # errors of 1 to 1.5 nm
    fitted = _analysed(_moving(course), learned)
    pulls = _pulls(fitted, learned)
    assert _poor(fitted) <= 2  # which land within some frames of a jump
    assert len(pulls) >= len(LANDINGS.frame) - 4
    assert np.sqrt(np.mean(np.square(pulls))) < 1 + SIGMAS / np.sqrt(2 * len(pulls))


def test_a_focus_that_bends_is_learned() -> None:
    half = np.linspace(-1, 1, SHAPE[0])
    learned, said = _learned(_moving(60.0 * half**2), _config())
    assert learned.optics.focus_jumps == (), said
    bend = 60.0 / (SHAPE[0] / 2000) ** 2
    assert abs(learned.optics.focus_bend_nm - bend) < 0.2 * bend


def test_a_focus_that_wanders_is_learned_or_refused() -> None:
    """No term describes it: where the optics are used, particles at all times agree with them."""
    course = 40 * np.sin(2 * np.pi * 2.5 * np.arange(SHAPE[0]) / SHAPE[0])
    movie = _moving(course)
    learned, said = _learned(movie, _config())
    if learned.optics.calibrate == "auto":
        assert any("the focus moves in a way that is not learned" in text for text in said)
        return
    good = _analysed(movie, learned).fits.query("status == 'ok'")
    heavy = good[good["mass_kda"] > 300]
    assert (np.abs(heavy["mass_kda"] / 480 - 1) < 5 * heavy["sigma_mass_kda"] / 480).all()


def test_a_focus_that_moves_is_named_where_the_optics_cannot_be_learned() -> None:
    """In a part of the movie there are too few bright particles to learn from."""
    learned, said = _learned(_movie(90.0), _config("fit.frames=[0, 420]"))
    assert learned.optics.focus_drift_nm == 0
    (rise,) = (float(text.split("moves by about ")[1].split()[0]) for text in said)
    assert 0.5 < rise / (90.0 * 420 / SHAPE[0]) < 2  # from a third of the movie, to first order


def test_a_focus_that_rests_is_not_said_to_move() -> None:
    learned, said = _learned(_movie(0.0), _config())
    assert not any("focus moves" in text or "rising" in text for text in said)
    assert learned.optics.focus_drift_nm == 0


def test_a_moving_focus_is_refused_where_pictures_are_of_one() -> None:
    config = _config("optics.focus_drift_nm=50", "background.method=fixed",
                     "background.frames=[0,10]")  # fmt: skip
    with pytest.raises(ConfigError, match="focus_drift_nm"):
        make_context(config, (64, 64))
