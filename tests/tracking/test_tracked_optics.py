"""The optics of movies in which particles move, tested on their tracks and learned from them."""

from __future__ import annotations

import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from instruments import Instrument
from wanderers import SETTINGS, Wanderers, wander

import iscat_analysis as ia
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Findings, warnings_in
from iscat_analysis.instrument import loop
from iscat_analysis.instrument.joint_fit import excess
from iscat_analysis.instrument.loop import Round, Rounds
from iscat_analysis.instrument.particle_image import Collected
from iscat_analysis.instrument.result import OpticsCalibration
from iscat_analysis.optics.parameters import settings_of, with_settings
from iscat_analysis.tracking.blocks import NO_PICTURES
from iscat_analysis.tracking.optics import (
    MASS_SHARE,
    REJECTED_SHARE,
    Misfit,
    _message,
    learn_from_tracks,
    mass_error,
)

SHAPE = (120, 80, 80)
MASS_KDA = 400.0


def _movie(instrument: Instrument | None = None) -> Wanderers:
    return wander(SHAPE, seed=4, instrument=instrument, species=((MASS_KDA, 0.4, 4),))


@pytest.fixture(scope="module")
def movie() -> Wanderers:
    return _movie()


def _about_optics(result: ia.Result) -> list[str]:
    return [line for line in result.warnings if "optics" in line]


def test_right_optics_are_not_doubted(movie: Wanderers) -> None:
    result = ia.fit_movie(movie.counts, settings={**SETTINGS, "optics.calibrate": "auto"})
    assert not _about_optics(result)
    told = result.summary["optics"]
    assert told["tested"] >= 2
    assert told["left_over"] < REJECTED_SHARE / 2
    assert not told["calibrated"]
    sources = {one["name"] for one in result.summary["budget"]}
    assert "optics that do not describe the pictures" not in sources


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"optics.na": 1.30}, "wrong numerical aperture, off by about +0.1"),
        ({"camera.pixel_size_nm": 92.4}, "wrong camera.pixel_size_nm, off by about -"),
    ],
)
def test_what_is_wrong_is_named(movie: Wanderers, wrong: dict[str, Any], named: str) -> None:
    """Single frames hide it: an NA of 1.30 for 1.42 makes masses 3 % wrong, and all rows ok."""
    result = ia.fit_movie(movie.counts, settings={**SETTINGS, **wrong})
    (said,) = _about_optics(result)
    assert named in said
    assert ("optics.calibrate" in said) == ("optics.na" in wrong)  # which learns no pixel size
    assert result.summary["optics"]["left_over"] > 2 * REJECTED_SHARE
    tracks = result.tracks[result.tracks["status"] == "ok"]
    error = tracks["mass_kda"] - MASS_KDA
    assert (error.abs() < 2 * tracks["systematic_mass_kda"]).all()


def test_what_no_part_of_the_microscope_explains_is_not_called_wrong_optics() -> None:
    """As where the light under the particles changes slowly: learning optics would not help."""
    said = _message(Misfit(0.15, True, 10), None, learns=False)
    assert "15%" in said
    assert "no part of the microscope" in said
    assert "optics.calibrate" not in said


@pytest.mark.large
def test_an_aberration_is_learned_from_tracks() -> None:
    aberrated = replace(Instrument(emission="reciprocal"), aberrations_nm={11: 20.0})
    movie = _movie(aberrated)
    result = ia.fit_movie(movie.counts, settings={**SETTINGS, "optics.calibrate": "auto"})
    assert result.summary["optics"]["calibrated"]
    assert any("optics learned from the movie" in line for line in result.warnings)
    learned = tomllib.loads(result.config_toml)["optics"]["aberrations_nm"]
    assert learned["z11"] == pytest.approx(20.0, abs=2.0)
    tracks = result.tracks[result.tracks["status"] == "ok"]
    error = (tracks["mass_kda"] - MASS_KDA) / np.hypot(
        tracks["sigma_mass_kda"], tracks["systematic_mass_kda"]
    )
    assert len(tracks) >= 2
    assert np.abs(error).max() < 4.0


@pytest.fixture(scope="module")
def ringed() -> Wanderers:
    """Rings as bright as half of the particle, which the configured optics leave over."""
    return _movie(replace(Instrument(emission="reciprocal"), aberrations_nm={11: -20.0}))


@pytest.mark.large
def test_rings_that_are_left_over_do_not_hide_an_aberration(ringed: Wanderers) -> None:
    """Taken for particles, they would be more than can be linked."""
    rings = {"calibration.optics": {"na": 1.42, "aberrations_nm": {"z11": -20.0}}}
    result = ia.fit_movie(ringed.counts, settings={**SETTINGS, **rings, "optics.calibrate": "auto"})
    assert result.summary["optics"]["left_over"] > 0.4
    assert result.summary["optics"]["calibrated"]
    learned = tomllib.loads(result.config_toml)["optics"]["aberrations_nm"]
    assert learned["z11"] == pytest.approx(-20.0, abs=2.0)
    # what is left over has gone into the light in part: the first phase that fits is 4° off
    assert abs(tomllib.loads(result.config_toml)["optics"]["reference_phase_deg"]) < 1.5
    tracks = result.tracks[result.tracks["status"] == "ok"]
    assert len(tracks) >= 2
    assert tracks["mass_kda"].to_numpy() == pytest.approx(MASS_KDA, rel=0.05)
    error = np.hypot(tracks["sigma_mass_kda"], tracks["systematic_mass_kda"])
    assert np.abs((tracks["mass_kda"] - MASS_KDA) / error).max() < 4.0


def test_optics_that_are_used_though_rejected_have_an_error() -> None:
    used = {"calibrated": True, "reason": "not uniform", "left_over": 0.6, "left_over_then": 0.03}
    assert mass_error(used) == pytest.approx(MASS_SHARE * 0.03)


def test_what_pictures_of_one_owner_share_counts() -> None:
    """Half of the variance of a score is its owner's."""
    rng = np.random.default_rng(5)
    owners = np.repeat(np.arange(400), 4)
    scores = rng.normal(size=(1600, 3)) + rng.normal(size=(400, 3))[owners]
    scatter = 2.0 * len(scores) * np.eye(3)
    scores -= scores.mean(axis=0)
    room = 5 * np.sqrt(2 / (3 * 400))
    assert excess(scatter, scores, np.arange(1600)) == pytest.approx(1.0, abs=room)
    assert excess(scatter, scores, owners) == pytest.approx((4 + 16) / 8, abs=2.5 * room)


def _learned(names: tuple[str, ...], covariance: np.ndarray) -> OpticsCalibration:
    """Give as much of a calibration as rounds look at."""
    found: Any = SimpleNamespace(names=names, covariance=covariance)
    return cast(OpticsCalibration, found)


def _rounds(shares: tuple[float, float], count: int) -> Rounds:
    """Give rounds that leave known shares of errors of focus and phase, first 30 nm and 9°."""
    names = ("focus_nm", "reference_phase_deg")
    error, rounds = np.array([30.0, 9.0]), Rounds()
    wrong = {"focus_nm": -300.0 + error[0], "reference_phase_deg": error[1]}
    config: Config | None = Config.model_validate({"optics": wrong})
    for _ in range(count):
        assert config is not None
        values = settings_of(config)
        error = np.array(shares) * np.array(
            [values["focus_nm"] + 300.0, values["reference_phase_deg"]]
        )
        values["focus_nm"], values["reference_phase_deg"] = -300.0 + error[0], error[1]
        after = with_settings(config, values)
        found = _learned(names, np.diag([0.4, 0.2]) ** 2)
        rounds = Rounds((*rounds.all, Round(Collected(config, ()), True, found, after, after, "")))
        config = rounds.next
    return rounds


def test_rounds_go_on_until_little_is_to_come() -> None:
    shares = (0.3, 0.65)
    counts = [n for n in range(1, 12) if _rounds(shares, n).settled]
    assert 3 <= counts[0] <= 8
    rounds = _rounds(shares, counts[0])
    last = rounds.all[-1]
    wrong = np.array([last.after["focus_nm"] + 300, last.after["reference_phase_deg"]])
    assert np.abs(wrong / [0.4, 0.2]).max() < 1.5
    # of an early round the error is what came after it
    early = rounds.all[0]
    was = np.array([early.after["focus_nm"] + 300, early.after["reference_phase_deg"]])
    assert rounds.error_of(early) == pytest.approx(-was, abs=0.6)


def test_why_nothing_can_be_followed_is_named(ringed: Wanderers) -> None:
    with pytest.raises(DataError, match=r"wrong spherical aberration.*nothing can be followed"):
        ia.fit_movie(ringed.counts, settings=SETTINGS)


def test_a_flood_of_places_is_refused_before_all_are_fitted() -> None:
    """The pattern moves by 7 pixels in all, and each of its features looks like a particle."""
    species = ((MASS_KDA, 0.4, 4),)
    movie = wander((60, 80, 80), seed=3, species=species, drift_nm_per_frame=(10.0, 0.0))
    with pytest.raises(DataError, match=r"places in every frame of 45 um2 .* the light changes"):
        ia.fit_movie(movie.counts, settings=SETTINGS)


@pytest.mark.parametrize(("described_from", "rounds"), [(None, 4), (3, 8)])
def test_rounds_end_where_the_first_four_describe_nothing(
    described_from: int | None, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tracks followed with optics of every round are described from one of them on, or never."""
    seen: list[float] = []
    told = Findings()
    run = SimpleNamespace(report=told.add, warn=None, notify=lambda _: None)

    def begin(config: Config, **_: bool) -> Any:
        described = described_from is not None and len(seen) % rounds >= described_from
        left = Misfit(share=0.0 if described else 0.2, clear=True, tracks=3)
        block = SimpleNamespace(noise_differs=False, aligned=NO_PICTURES)
        own = {"context": SimpleNamespace(config=config), "described": described}
        return SimpleNamespace(config=config, block=block, left=left, **own)

    def fit(*_: Any, **__: Any) -> Any:
        seen.append(-300.0 + 50 * len(seen))
        measured = SimpleNamespace(settings={"focus_nm": seen[-1]}, refusals=["not yet"])
        return SimpleNamespace(
            names=("focus_nm",), covariance=np.eye(1), measured=measured, accepted=False
        )

    monkeypatch.setattr(loop, "fit_optics", fit)
    with ThreadPoolExecutor(1) as pool:
        config = Config.model_validate({"optics": {"calibrate": "auto"}})
        _, summary = learn_from_tracks(config, begin, name="m", pool=pool, run=run)
    assert len(seen) == 2 * rounds  # of all particles, and of those that stand alone
    assert not summary["calibrated"]
    assert "other optics were not learned: not yet" in warnings_in(told.made)[0]
