"""A model that does not fit finds the particles, invents none, and says what is probably wrong."""

from __future__ import annotations

import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from instruments import Instrument, InstrumentMovie, draw_landings

from iscat_analysis.camera import camera_from_config, measure_windows
from iscat_analysis.config import Config, load_config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import make_context
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.landing.find import analyse_landings
from iscat_analysis.search.peaks import EXCEEDS, Described, chi2_excess, size_on_ring

pytestmark = pytest.mark.large

SHAPE = (500, 128, 128)
COUNT = 12
SEED = 11
LANDINGS = draw_landings(SHAPE, COUNT, seed=SEED, apart_px=22.0)


WRONG = Instrument(
    emission="reciprocal", circular=True, analyzer=True, focus_nm=-370.0, na=1.40, mask_na=0.6,
    attenuation=0.3, reference_phase_deg=12.0,
    aberrations_nm={5: 6.0, 6: -5.0, 7: 8.0, 8: -9.0, 11: 18.0},
)  # fmt: skip
"""What real microscopes have of everything; coma moves its pictures by more than a pixel."""


def _configured(*settings: str, gain: float = 4.0) -> Config:
    return load_config(
        None,
        [
            "camera.pixel_size_nm=84.0",
            f"camera.gain_e_per_adu={gain}",
            "optics.focus_nm=-300.0",
            "optics.emission=dong2021",
            "particle.mass_kda=205",
            "calibration.gradient_per_kda=-3.1e-5",
            "detection.false_alarms_per_movie=1e-3",  # those of noise are tested elsewhere
            *settings,
        ],
    )


def _analysed(instrument: Instrument, gain: float = 4.0) -> tuple[DetectionResult, list[str]]:
    movie = InstrumentMovie(instrument, SHAPE, LANDINGS, seed=SEED)
    config = _configured("background.method=sliding", gain=gain)
    said: list[str] = []
    camera = camera_from_config(config.camera, (SHAPE[1], SHAPE[2]), movie.dtype)
    result = analyse_landings(movie, config, camera, Run(notify=said.append))
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
    table = result.fits[result.fits["status"] != "sidelobe"]
    for x, y, frame in zip(LANDINGS.x_px, LANDINGS.y_px, LANDINGS.frame, strict=True):
        near = np.hypot(table["x_px"] - x, table["y_px"] - y) < 3
        near &= np.abs(table["frame"] - frame) <= 8 + table["frame_ci95"]
        assert near.sum() == 1, (x, y, frame)
    assert len(table) == COUNT
    assert result.summary["landings"] + result.summary["leavings"] == COUNT
    lines = [text for text in said if "looks most like" in text]
    assert len(lines) == (cause is not None)
    assert cause is None or cause in lines[0]


@pytest.mark.parametrize("instrument", [Instrument(), WRONG], ids=["nominal", "wrong"])
def test_rings_as_high_as_their_particle_are_none(instrument: Instrument) -> None:
    shape, bound, count = (80, 140, 140), 40, 8
    landings = draw_landings(
        shape, count, seed=SEED, masses=(430.0,), frame=bound, apart_px=24.0, margin_px=16.0
    )
    movie = InstrumentMovie(instrument, shape, landings, seed=SEED)
    config = _configured("background.method=fixed", f"background.frames=[0,{bound}]")
    context = make_context(config, shape[1:])
    camera = camera_from_config(config.camera, shape[1:], movie.dtype)
    windows = measure_windows(movie, camera, (0, bound), (bound, shape[0]))
    with ThreadPoolExecutor(1) as pool:
        events, _ = fit_field(context, windows, pool=pool)
    kept = [e.candidate for e in events if "sidelobe" not in e.flags]
    for x, y in zip(landings.x_px, landings.y_px, strict=True):
        assert sum(np.hypot(k.x_px - x, k.y_px - y) < 3 for k in kept) == 1, (x, y)
    assert len(kept) == count


def test_a_faint_particle_is_as_badly_described_as_a_bright_one() -> None:
    bright = Described.of(snr=60.0, chi2_reduced=17.0, n_pixels=576)
    faint = Described.of(snr=12.0, chi2_reduced=1 + 16 / 25, n_pixels=576)
    ring = Described.of(snr=12.0, chi2_reduced=4.0, n_pixels=576)
    good = Described.of(snr=60.0, chi2_reduced=1.05, n_pixels=576)
    assert good.excess == 0  # as noise may have it
    assert not faint.is_dwarfed([bright, faint])
    assert ring.is_dwarfed([bright, ring])
    assert faint.is_dwarfed([good, faint])  # what it leaves is not the model's
    assert not ring.is_dwarfed([ring, Described(30.0, 0.0)])  # no brighter one explains it


def test_a_wrong_gain_is_said_and_invents_nothing() -> None:
    """Seven times the noise that the camera's gain predicts: the threshold knows what it is."""
    result, said = _analysed(Instrument(), gain=28.0)
    assert any(re.search(r"set camera\.gain_e_per_adu = [34]\.", text) for text in said)
    assert 0.9 * COUNT <= len(result.fits) <= COUNT


def test_noise_that_passes_the_threshold_everywhere_stops_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same where the noise between neighbouring frames does not tell it."""
    monkeypatch.setattr("iscat_analysis.diagnosis.noise.measure_spectrum", lambda *_, **__: None)
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


@pytest.mark.parametrize(("known", "is_ring"), [((), False), ((-1.0, 2.6, 4.0), False),
                                                ((-1.0, 2.6, 4.0), True)])  # fmt: skip
def test_two_equal_particles_are_not_each_others_ring(known, is_ring) -> None:
    """24 pixels from a third, whose ring known ones hide but for a quarter; the control is one."""
    y, x = np.mgrid[:101, :101]

    def at(angle: float) -> tuple[float, float]:
        return 50 + 24 * np.cos(angle), 50 + 24 * np.sin(angle)

    place, other = at(0.3), at(1.2)
    snr = sum(20 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 12) for a, b in (place, other))
    if is_ring:
        snr = 20 * np.exp(-((np.hypot(x - 50, y - 50) - 24) ** 2) / 12)
    size = size_on_ring(np.asarray(snr), (50.0, 50.0), place, [at(angle) for angle in known])
    assert (EXCEEDS * size > 20) == is_ring


def test_excess_is_none_in_noise() -> None:
    rng = np.random.default_rng(SEED)
    noise = rng.standard_normal((40, 40))
    assert chi2_excess(noise) == 0.0
    assert chi2_excess(2 * noise) == pytest.approx(3 * 1600, rel=0.1)
