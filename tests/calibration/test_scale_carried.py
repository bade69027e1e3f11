"""Movies at another focus than the standards: masses within their stated errors, or flagged."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from instruments import PEAK_PER_KDA, Instrument, InstrumentMovie, Landings, Pictures, draw_landings

import iscat_analysis as ia
from iscat_analysis.records import Status

pytestmark = pytest.mark.large

SHAPE = (900, 160, 160)
STANDARDS = Instrument(emission="reciprocal")
LINE_SE = 0.01
SIGMAS = 4.0


def _recorded(focus_nm: float) -> dict[str, Any]:
    return {
        "calibration.optics": {"focus_nm": focus_nm},
        "calibration.height_nm": STANDARDS.height_nm,
        "calibration.camera": {"pixel_size_nm": 84.0, "samples_per_pixel": "auto"},
    }


def _movie(away_nm: float, seed: int) -> tuple[np.ndarray, Landings]:
    """Record so far below the focus of the standards particles that scatter as these did."""
    seen = replace(STANDARDS, focus_nm=STANDARDS.focus_nm - away_nm)
    landings = draw_landings(SHAPE, 36, seed=seed, apart_px=14.0, masses=(205.0, 430.0))
    strength = Pictures(STANDARDS).per_kda / Pictures(seen).per_kda
    scattered = replace(landings, mass_kda=landings.mass_kda * strength)
    return InstrumentMovie(seen, SHAPE, scattered, seed=seed + 1).counts, landings


def _analysed(counts: np.ndarray, record: dict[str, Any]) -> ia.Result:
    settings = {
        "camera.pixel_size_nm": 84.0,
        "camera.gain_e_per_adu": 4.0,
        "optics.focus_nm": -300.0,
        "background.method": "sliding",
        "particle.mass_kda": 205.0,
        "calibration.gradient_per_kda": Pictures(STANDARDS).sign * PEAK_PER_KDA,
        "calibration.gradient_se_per_kda": LINE_SE * PEAK_PER_KDA,
        "compute.workers": 1,
    }
    return ia.fit_movie(counts, settings=settings | record)


def _relative(result: ia.Result, landings: Landings) -> tuple[np.ndarray, float]:
    """Masses over the truth of the rows of one particle each, and the error that they share."""
    table = result.table
    apart = np.hypot(
        table["x_px"].to_numpy()[:, None] - landings.x_px,
        table["y_px"].to_numpy()[:, None] - landings.y_px,
    )
    near = (apart < 3) & (np.abs(table["frame"].to_numpy()[:, None] - landings.frame) < 8)
    rows = near.any(axis=1)
    truth = landings.mass_kda[near.argmax(axis=1)][rows]
    used = table[rows]
    shared = used["systematic_mass_kda"] / used["mass_kda"]
    return used["mass_kda"].to_numpy() / truth, float(shared.median())


def test_masses_at_another_focus_are_within_their_stated_errors() -> None:
    counts, landings = _movie(60.0, seed=31)
    result = _analysed(counts, _recorded(-300.0))
    assert result.summary["optics"]["calibrated"]
    assert (result.table["status"] == "ok").mean() > 0.9
    assert result.summary["scale"]["carried"] == pytest.approx(0.7465, abs=0.03)
    relative, shared = _relative(result, landings)
    error = math.hypot(relative.std() / math.sqrt(relative.size), shared)
    assert LINE_SE < shared < 0.05
    assert abs(relative.mean() - 1) < SIGMAS * error
    names = set(result.budget["name"])
    assert {"photon noise", "line of the standards", "optics of the movie"} <= names
    # control: a line that is said to be of standards at the focus of the movie
    wrong, shared = _relative(_analysed(counts, _recorded(-360.0)), landings)
    error = math.hypot(wrong.std() / math.sqrt(wrong.size), shared)
    assert wrong.mean() < 0.8
    assert abs(wrong.mean() - 1) > SIGMAS * error


def test_a_focus_too_far_from_that_of_the_standards_is_flagged() -> None:
    counts, _ = _movie(120.0, seed=51)
    result = _analysed(counts, _recorded(-300.0))
    assert "more than a third" in result.summary["scale"]["refusal"]
    flags = result.table["flags"].str.contains(Status.UNCALIBRATED_OPTICS.value)
    assert flags.all()
    assert not (result.table["status"] == "ok").any()
    assert any("measure standards as this movie is recorded" in text for text in result.warnings)
