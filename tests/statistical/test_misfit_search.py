"""A model that does not fit finds the particles, invents none, and says what is probably wrong."""

from __future__ import annotations

import numpy as np
import pytest
from instruments import Instrument, InstrumentMovie, draw_landings

from iscat_analysis.config import load_config
from iscat_analysis.errors import DataError
from iscat_analysis.movie.camera import camera_from_config
from iscat_analysis.pipeline.landing import LandingResult, analyse_landings
from iscat_analysis.search.residue import chi2_excess, size_on_ring

SHAPE = (500, 128, 128)
COUNT = 12
SEED = 11
LANDINGS = draw_landings(SHAPE, COUNT, seed=SEED, apart_px=22.0)


def _analysed(instrument: Instrument, gain: float = 4.0) -> tuple[LandingResult, list[str]]:
    movie = InstrumentMovie(instrument, SHAPE, LANDINGS, seed=SEED)
    config = load_config(
        None,
        [
            "camera.pixel_size_nm=84.0",
            f"camera.gain_e_per_adu={gain}",
            "optics.focus_nm=-300.0",
            "optics.emission=dong2021",
            "particle.mass_kda=205",
            "calibration.gradient_per_kda=-3.1e-5",
            "background.method=sliding",
            "detection.false_alarms_per_movie=1e-3",  # those of noise are tested elsewhere
        ],
    )
    said: list[str] = []
    camera = camera_from_config(config.camera, (SHAPE[1], SHAPE[2]), movie.dtype)
    result = analyse_landings(movie, config, camera, tell=said.append, progress=lambda *_: None)
    return result, said


@pytest.mark.parametrize(
    ("instrument", "cause"),
    [
        (Instrument(), None),
        (Instrument(focus_nm=-400.0), "focus"),
        (Instrument(aberrations_nm={11: 20.0}), "spherical"),
        (Instrument(circular=True, analyzer=True), "polarisation"),
    ],
    ids=["nominal", "focus", "spherical", "polarisation"],
)
def test_a_wrong_model_finds_what_is_there_and_no_more(
    instrument: Instrument, cause: str | None
) -> None:
    result, said = _analysed(instrument)
    table = result.table[result.table["status"] != "sidelobe"]
    for x, y, frame in zip(LANDINGS.x_px, LANDINGS.y_px, LANDINGS.frame, strict=True):
        near = np.hypot(table["x_px"] - x, table["y_px"] - y) < 3
        near &= np.abs(table["frame"] - frame) <= 8 + table["frame_ci95"]
        assert near.sum() == 1, (x, y, frame)
    assert len(table) == COUNT
    assert result.summary["landings"] + result.summary["leavings"] == COUNT
    lines = [text for text in said if "looks most like" in text]
    assert len(lines) == (cause is not None)
    assert cause is None or cause in lines[0]


def test_noise_that_passes_the_threshold_everywhere_stops_the_search() -> None:
    with pytest.raises(DataError, match=r"set camera\.gain_e_per_adu = [34]\."):
        _analysed(Instrument(), gain=28.0)


def test_a_second_particle_is_higher_than_its_ring_and_a_misfit_is_not() -> None:
    y, x = np.mgrid[:101, :101]
    r, phi = np.hypot(x - 50, y - 50), np.arctan2(y - 50, x - 50)
    lobes = 20 * np.exp(-(((r - 12) / 2) ** 2)) * np.cos(2 * phi)
    blob = 20 * np.exp(-((x - 62) ** 2 + (y - 50) ** 2) / 8)
    place = (50.0, 50.0), (62.0, 50.0)
    assert size_on_ring(lobes, *place) > 0.8 * 20
    assert size_on_ring(blob, *place) < 0.1 * 20
    assert size_on_ring(lobes, *place, [(50.0 + 12 * np.cos(a), 50.0 + 12 * np.sin(a))
                                        for a in np.arange(1, 12) * np.pi / 6]) < 20  # fmt: skip


def test_excess_is_none_in_noise() -> None:
    rng = np.random.default_rng(SEED)
    noise = rng.standard_normal((40, 40))
    assert chi2_excess(noise) == 0.0
    assert chi2_excess(2 * noise) == pytest.approx(3 * 1600, rel=0.1)
