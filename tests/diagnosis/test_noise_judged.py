"""Saturated pixels and a wrong gain are remarked on, whichever frames make the background."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pandas as pd
import pytest
from numpy.typing import NDArray
from scenes import PIXEL_NM, make_config
from wanderers import wander

from iscat_analysis.camera import camera_from_config
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import Noise, judge_beside
from iscat_analysis.findings.camera import GAIN_OFF
from iscat_analysis.fitting.context import make_context
from iscat_analysis.movie import open_stack
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.pieces.regions import SATURATION_NM
from iscat_analysis.pipeline import analyse, moving
from iscat_analysis.records import Analysis
from iscat_analysis.search.templates import ExcessNoise
from iscat_analysis.tracking import blocks as block_store

GAIN, TOO_LARGE = 20.0, 1.6
SHAPE, FRAMES, LEVEL_E = (40, 44), 26, 2e5
FIT = {"roi_nm": 1800.0, "frames": None}
TOLERANCE = 0.1  # of a gain, from which on it is said to be off

Counts = NDArray[np.uint16]


def _config(mode: str, gain: float, **background: Any) -> Config:
    return make_config(
        background={"frames": None, "power_normalization": False, **background},
        camera={"pixel_size_nm": PIXEL_NM, "frame_rate_hz": 331.0, "gain_e_per_adu": gain},
        optics={"calibrate": "never"},
        particle={"mass_kda": 2000.0},
        fit={"mode": mode, **FIT},
        track={"free": "mass"},
        simulation={"shape": list(SHAPE)},
    )


def _known(mode: str, gain: float) -> Config:
    return _config(mode, gain, method="known", level_e=LEVEL_E * gain / GAIN)


def _learnt(gain: float) -> Config:
    return _config("track", gain, power_normalization=True)


def _movie(*, moves: bool) -> Counts:
    """Make counts of one particle over a flat background."""
    rng = np.random.default_rng(6)
    config = _known("mass", GAIN)
    model, grid = forward_model(config, 1e4), PixelGrid.region((0, 40), (0, 44), PIXEL_NM)
    steps = rng.normal(0, 60.0 if moves else 0.0, (FRAMES, 2))
    places = np.array([1600.0, 1700.0]) + np.cumsum(steps, axis=0)
    signal = np.array([model.image(grid, x, y, model.height_nm, 2000.0) for x, y in places])
    electrons = rng.poisson(LEVEL_E * (1 + signal))
    return np.floor(electrons / GAIN + rng.random(electrons.shape)).astype(np.uint16)


@pytest.fixture(scope="module")
def wandering() -> Counts:
    species = ((400.0, 0.15, 1), (300.0, 0.4, 1))
    return wander((60, *SHAPE), seed=4, species=species, gain_e_per_adu=GAIN).counts


def _analysed(counts: Counts, config: Config) -> Analysis:
    with open_stack(counts) as movie:
        return analyse(movie, config)


def _gains(found: Analysis) -> list[float]:
    """Gains that are advised."""
    words = " ".join(found.warnings)
    return [float(gain) for gain in re.findall(r"set camera\.gain_e_per_adu = ([\d.]+)", words)]


@pytest.fixture(scope="module")
def plain(wandering: Counts) -> Analysis:
    """Analyse particles that wander with the right gain."""
    return _analysed(wandering, _learnt(GAIN))


@pytest.mark.parametrize("way", ["track", "known track", "known mass"])
def test_a_wrong_gain_is_named(way: str, wandering: Counts, plain: Analysis) -> None:
    mode = way.split()[-1]
    if way == "track":
        right, found = plain, _analysed(wandering, _learnt(TOO_LARGE * GAIN))
    else:
        counts = _movie(moves=mode == "track")
        right, found = (_analysed(counts, _known(mode, g)) for g in (GAIN, TOO_LARGE * GAIN))
    assert not _gains(right)
    (advised,) = _gains(found)
    assert advised == pytest.approx(GAIN, rel=TOLERANCE)
    assert len(found.table)


def test_particles_that_go_everywhere_leave_nothing_to_judge(wandering: Counts) -> None:
    """Their motion alone would be taken for noise; where none comes near, it is judged."""
    config = _config("track", TOO_LARGE * GAIN)
    context, used = make_context(config, SHAPE), np.ones(SHAPE, dtype=bool)
    camera = camera_from_config(config.camera, SHAPE, np.uint16)
    frame = np.repeat(np.arange(60), 20)
    everywhere = np.random.default_rng(1).uniform(0, 40 * PIXEL_NM, (frame.size, 2))
    with open_stack(wandering) as movie:
        said = [
            judge_beside(
                context, movie, camera, (0, 60), (frame, places), used,
                lambda count: camera.to_electrons(wandering[:count]),
            ).findings
            for places in (everywhere, everywhere + 1e5)
        ]  # fmt: skip
    assert not said[0]
    assert said[1]


OFF = GAIN_OFF({"ratio": 1.55, "ratio_se": 0.01, "gain": GAIN, "unless": "", "measured": 12.9})


@pytest.mark.parametrize("way", ["track", "known track"])
def test_noise_that_fits_do_not_have_is_not_blamed_on_the_gain(
    way: str, wandering: Counts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As rings seem to be, of which a wrong microscope leaves over something everywhere."""
    rings = Noise((OFF,), True, ExcessNoise(1.55, OFF.text))
    learnt = way == "track"
    module = block_store if learnt else moving
    monkeypatch.setattr(module, "judge_beside", lambda *_: rings)
    counts = wandering if learnt else _movie(moves=True)
    assert not _gains(_analysed(counts, _learnt(GAIN) if learnt else _known("track", GAIN)))


def test_noise_that_all_fits_have_is_told() -> None:
    noise = Noise((OFF,), True, ExcessNoise(1.55, ""))
    spread = np.linspace(-0.1, 0.1, 50)
    assert noise.compared_with_fits(1.55 + spread) is noise
    assert noise.compared_with_fits(3.0 + spread) is noise  # of a wrong microscope as well
    assert not noise.compared_with_fits(np.append(3.0 + spread, [1.1] * 10)).findings
    assert noise.compared_with_fits(np.full(5, 1.0)) is noise  # too few to tell
    less = Noise((OFF,), True)
    assert less.compared_with_fits(1.0 + spread) is less


def test_tracks_near_saturated_pixels_are_flagged() -> None:
    counts, y, x = _movie(moves=True), 17, 19
    counts[20, y, x] = np.iinfo(np.uint16).max
    found = _analysed(counts, _config("track", GAIN))
    table = found.table
    near = np.hypot(table["x_px"] - x, table["y_px"] - y) * PIXEL_NM < SATURATION_NM
    assert 0 < near.sum() < len(table)
    assert (table["flags"].str.contains("saturated") == near).all()
    assert table["frame"].tolist() == list(range(FRAMES))  # one track, of what hardly moves
    assert any("1 pixel is saturated" in text for text in found.warnings)
    assert found.summary["masked_pixels"] == 1


def test_errors_that_stay_as_they_are_are_said_to(wandering: Counts, plain: Analysis) -> None:
    config = _learnt(GAIN)
    measured = config.fit.model_copy(update={"sigma": "measured"})
    asked = _analysed(wandering, config.model_copy(update={"fit": measured}))
    pd.testing.assert_frame_equal(asked.table, plain.table)
    said = [text for text in asked.warnings if "fit.sigma" in text]
    assert said == [
        'fit.sigma = "measured" has no effect: the spread is not measured where the background is '
        "learnt with the tracks, and σ is that of the likelihood"
    ]
    assert not any("fit.sigma" in text for text in plain.warnings)
