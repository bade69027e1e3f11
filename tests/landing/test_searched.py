"""A bright landing costs only the places that its light reaches; what was not searched is said."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from landings import PIXEL_NM, Found, analysed, drawn, landing_config

import iscat_analysis as ia
from iscat_analysis.config import Config
from iscat_analysis.instrument.uneven import is_plausible
from iscat_analysis.landing import steps as steps_module
from iscat_analysis.landing.maps import LEVELS, Searched
from iscat_analysis.landing.steps import ring_average
from iscat_analysis.species import Efficiency

SIDE, FRAMES = 112, 240
VESICLE = (120, 55.3, 54.1, 8000.0)  # frame, x, y [px], mass [kDa]
RADIUS_NM, POINTS = 50.0, 14
AWAY_PX = 2000 / PIXEL_NM
PROTEINS = [
    (frame, *place, 146.0)
    for frame, place in zip(
        (90, 98, 106, 114, 122, 130, 138, 146),
        [(20.2, 21.1), (90.3, 23.4), (22.7, 88.2), (91.1, 89.6),
         (55.1, 20.4), (20.3, 55.2), (90.8, 56.4), (54.6, 91.3)],
        strict=True,
    )
]  # fmt: skip


def _vesicle(frame: int, x_px: float, y_px: float, mass_kda: float) -> list[dict[str, float]]:
    """Points all over a sphere that stands on the glass: no picture of a point."""
    turn = np.arange(POINTS) + 0.5
    polar, angle = np.arccos(1 - 2 * turn / POINTS), math.pi * (1 + math.sqrt(5)) * turn
    x, y = (RADIUS_NM / PIXEL_NM * np.sin(polar) * f(angle) for f in (np.cos, np.sin))
    z = RADIUS_NM * (1 + np.cos(polar)) + 5.0
    return [
        {
            "frame": frame, "x_px": x_px + dx, "y_px": y_px + dy, "z_nm": h,
            "mass_kda": mass_kda / POINTS,
        }
        for dx, dy, h in zip(x.tolist(), y.tolist(), z.tolist(), strict=True)
    ]  # fmt: skip


def _config(*, vesicle: bool) -> Config:
    names = ("frame", "x_px", "y_px", "mass_kda")
    events: list[dict[str, Any]] = [dict(zip(names, each, strict=True)) for each in PROTEINS]
    events += _vesicle(*VESICLE) if vesicle else []
    settings = "simulation.power_noise=0", "detection.false_alarms_per_movie=0.01"
    return landing_config(SIDE, FRAMES, *settings, events=events)


def _analysed(counts: np.ndarray) -> Found:
    return analysed(counts, _config(vesicle=True))


def _recovered(table: pd.DataFrame) -> int:
    """Count the proteins that have a row with the right mass."""
    return sum(
        bool(
            (
                (np.hypot(table["x_px"] - x, table["y_px"] - y) < 1.5)
                & ((table["frame"] - frame).abs() <= 6)
                & ((table["mass_kda"] - mass).abs() < 6 * table["sigma_mass_kda"])
            ).any()
        )
        for frame, x, y, mass in PROTEINS
    )


def _false(table: pd.DataFrame) -> int:
    """Count rows far from the vesicle that are no protein."""
    x, y = VESICLE[1:3]
    far = np.hypot(table["x_px"] - x, table["y_px"] - y) > AWAY_PX
    return int(far.sum()) - _recovered(table)


@pytest.fixture(scope="module")
def bright() -> np.ndarray:
    """Draw proteins that land with a vesicle among them."""
    return drawn(_config(vesicle=True), 1)


def test_proteins_that_land_with_a_vesicle_have_rows(bright: np.ndarray) -> None:
    result, told = _analysed(bright)
    assert _recovered(result.fits) == len(PROTEINS)
    assert _false(result.fits) == 0
    assert result.summary["searched_share"] > 0.95
    assert not any("were searched" in text for text in told)


def test_without_its_own_picture_it_hides_the_field_and_that_is_said(
    bright: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Control: what the model leaves over of the vesicle is a peak in every round."""
    monkeypatch.setattr(steps_module, "with_measured_images", lambda steps, *_: list(steps))
    result, told = _analysed(bright)
    assert _recovered(result.fits) < len(PROTEINS) / 2
    assert result.summary["searched_share"] < 0.95
    start, stop, share = min(result.summary["partly_searched"], key=lambda span: span[2])
    assert start < VESICLE[0] < stop
    assert share < 0.5
    assert any("of field and time were searched" in text for text in told)


def test_a_movie_without_bright_things_is_searched_as_a_whole() -> None:
    result, told = _analysed(drawn(_config(vesicle=False), 2))
    assert _recovered(result.fits) == len(PROTEINS)
    assert result.summary["searched_share"] == 1.0
    assert result.summary["partly_searched"] == []
    assert told == []


def test_an_average_along_rings_keeps_what_is_no_ring() -> None:
    y, x = np.mgrid[:81, :91]
    centre = 39.3, 44.6
    radius, angle = np.hypot(y - centre[0], x - centre[1]), np.arctan2(y - centre[0], x - centre[1])
    rings = 0.3 * np.cos(radius / 0.9) * (1 + 0.4 * np.cos(2 * angle)) / (1 + radius / 4)
    spot = 0.02 * np.exp(-((y - 60) ** 2 + (x - 66) ** 2) / (2 * 1.5**2))
    noise = 1e-3 * np.random.default_rng(1).standard_normal(rings.shape)
    left = (
        rings + spot + noise - ring_average(rings + spot + noise, np.full(rings.shape, 1e3), centre)
    )
    assert left[60, 66] > 0.8 * spot.max()
    away = (np.hypot(y - 60, x - 66) > 8) & (radius > 5)
    assert np.std(left[away]) < 3e-3  # of rings of 0.1: linear between knots


def test_shares_are_read_at_the_size_of_the_particles() -> None:
    shares = np.ones((4, LEVELS.size))
    shares[1:3, LEVELS < 8] = 0.5  # below eight thresholds, half of the field is hidden
    searched = Searched(np.array([10, 20, 30, 40]), shares)
    small, large = (searched.summary(snr, 5.0, 10) for snr in (10.0, 60.0))
    assert small["searched_share"] == pytest.approx(0.75)
    assert small["partly_searched"] == [[15, 35, 0.5]]
    assert large["searched_share"] == pytest.approx(1.0)


def test_numbers_and_rates_are_for_all_of_field_and_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    mass = rng.normal(100.0, 5.0, 300)
    frame = np.sort(rng.integers(0, 6000, 300))
    table = pd.DataFrame(
        {"mass_kda": mass, "sigma_mass_kda": 5.0, "snr": mass / 5.0, "frame": frame, "status": "ok"}
    )
    found = []
    for number, share in enumerate((1.0, 0.8)):
        folder = tmp_path / str(number)
        folder.mkdir()
        table.to_csv(folder / "fits.csv", index=False)
        summary = {"detection_threshold_snr": 5.0, "landing": {"searched_share": share}}
        (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
        species = ia.find_species(folder, draws=0).species.iloc[0]
        rates = ia.fit_kinetics(folder, frame_rate_hz=100.0, frames=(0, 6000))
        found.append((species["count_corrected"], rates.landing.per_second, rates.notes))
    assert found[1][0] == pytest.approx(found[0][0] / 0.8, rel=1e-6)
    assert found[1][1] == pytest.approx(found[0][1] / 0.8, rel=1e-6)
    assert any("80% of field and time" in note for note in found[1][2])
    assert Efficiency(5.0, 10.0, 0.8)(1e4) == pytest.approx(0.8)


def test_a_focus_does_not_move_by_micrometres() -> None:
    assert is_plausible({"focus_drift_nm": -100.0}, (0, 1000))
    assert not is_plausible({"focus_drift_nm": -6705.0}, (0, 1000))
    assert not is_plausible({"focus_drift_nm": -500.0}, (0, 8000))
    assert is_plausible({"focus_bend_nm": 1500.0}, (0, 400))  # 60 nm
    assert not is_plausible({"focus_bend_nm": 500.0}, (0, 4000))
    assert not is_plausible({"focus_jump_1_nm": 1200.0}, (0, 400))
