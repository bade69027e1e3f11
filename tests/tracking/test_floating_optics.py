"""The optics of movies in which particles move in all directions, tested on single frames."""

from __future__ import annotations

from typing import Any

import pytest
from floaters import Floaters, Sphere, Volume
from instruments import Instrument

import iscat_analysis as ia
from iscat_analysis.tracking.optics import REJECTED_SHARE

FRAMES, SIDE_PX, CEILING_NM = 30, 56, 600.0
SPHERICAL_NM = 20.0
SETTINGS: dict[str, Any] = {
    "camera.pixel_size_nm": 84.0,
    "camera.gain_e_per_adu": 2.0,
    "camera.frame_rate_hz": 1000.0,
    "camera.exposure_ms": 0.05,
    "particle.kind": "gold",
    "particle.diameter_nm": 30.0,
    "fit.mode": "track",
    "fit.z_range_nm": [0.0, 700.0],
    "track.free": "joint",
    "track.max_step_nm": 1000.0,
    "compute.workers": 1,
}


def _volume(instrument: Instrument) -> Volume:
    return Volume((SIDE_PX, SIDE_PX), ceiling_nm=CEILING_NM, instrument=instrument)


def _movie(volume: Volume, exposure_ms: float = 0.05) -> Floaters:
    return volume.record(FRAMES, (Sphere(),), seed=3, exposure_ms=exposure_ms)


@pytest.fixture(scope="module")
def right() -> Volume:
    return _volume(Instrument(emission="reciprocal"))


@pytest.fixture(scope="module")
def aberrated() -> Floaters:
    return _movie(_volume(Instrument(emission="reciprocal", aberrations_nm={11: SPHERICAL_NM})))


def test_right_optics_are_not_doubted_where_heights_are_fitted(right: Volume) -> None:
    movie = _movie(right)
    result = ia.fit_movie(movie.counts, settings=SETTINGS)
    told = result.summary["optics"]
    assert told["tested"] == 1
    assert not told["calibrated"]
    assert "reason" not in told
    assert not result.warnings


def test_what_is_wrong_is_named_where_heights_are_fitted(aberrated: Floaters) -> None:
    """It was said that the gain is wrong."""
    result = ia.fit_movie(aberrated.counts, settings={**SETTINGS, "optics.calibrate": "never"})
    (said,) = [line for line in result.warnings if "optics" in line]
    assert "spherical aberration, off by about +" in said
    assert result.summary["optics"]["left_over"] > 2 * REJECTED_SHARE


def test_a_path_that_is_smeared_is_named_and_tells_nothing_else(right: Volume) -> None:
    """It was said that the gain is wrong."""
    movie = _movie(right, exposure_ms=0.3)
    result = ia.fit_movie(movie.counts, settings={**SETTINGS, "camera.exposure_ms": 0.3})
    (said,) = result.warnings
    assert "within an exposure" in said
    assert "expose for less than 0.3 ms, about 0.0" in said


@pytest.mark.large
def test_an_aberration_is_learned_from_single_frames(aberrated: Floaters) -> None:
    result = ia.fit_movie(aberrated.counts, settings=SETTINGS)
    assert result.summary["optics"]["calibrated"]
    found = {row["parameter"]: row for row in result.summary["optics"]["parameters"]}
    assert found["z11"]["value"] == pytest.approx(SPHERICAL_NM, abs=4 * found["z11"]["sigma"])
    rows = result.table.merge(aberrated.truth, on="frame", suffixes=("", "_true"))
    rows = rows[rows["inside"]]
    good = rows[rows["status"] == "ok"]
    assert len(good) > 0.8 * len(rows)
    off = good["z_nm"] - good["z_nm_true"]
    assert abs(off.median()) < 4 * good["systematic_z_nm"].median()
    assert (off - off.median()).abs().median() < 2 * good["sigma_z_nm"].median()
