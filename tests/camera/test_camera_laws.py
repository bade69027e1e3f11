"""The law that counts follow is told from the pixels of a movie, and by how much masses are wrong.

Predicted are, for light N and counts c = f(N), the contrast κ = d ln f/d ln N at the mean light.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recorded_light import LEVEL_E, SHAPE, gamma, linear, record, saturation

import iscat_analysis as ia
from iscat_analysis.camera import Camera, Law, LearnedCamera
from iscat_analysis.camera.learned import learn_camera
from iscat_analysis.camera.transfer import find_law, measure_transfer, read_response
from iscat_analysis.config import CameraConfig
from iscat_analysis.diagnosis.noise import law_finding
from iscat_analysis.movie import open_stack
from iscat_analysis.records import StackMetadata

SEEDS = 2


def _learned(counts: np.ndarray, **settings: float) -> LearnedCamera:
    config = CameraConfig(**settings)
    return learn_camera(open_stack(counts), config, (0, len(counts)))


def _law(counts: np.ndarray, gain: float = 4.0) -> Law:
    found = measure_transfer(counts, Camera(gain_e_per_adu=gain))
    assert found is not None
    return find_law(found, most_read=0.01, least_offset=0.0)


@pytest.mark.parametrize(
    ("kind", "number"),
    [*(("gamma", g) for g in (0.95, 0.9, 0.8)), *(("saturation", f) for f in (10.0, 5.0, 3.0))],
)
def test_a_law_that_bends_is_found_with_what_it_does(kind: str, number: float) -> None:
    """Gamma has its exponent as contrast; saturation at F times the light x/(eˣ − 1), x = 1/F."""
    bend, true = gamma(number), number
    if kind == "saturation":
        bend, true = saturation(number), 1 / number / math.expm1(1 / number)
    frames = {"frames": 1024} if kind == "gamma" else {}
    laws = [_law(record(seed, bend, **frames)) for seed in range(SEEDS)]
    assert {law.kind for law in laws} == {kind}
    assert max(abs(law.contrast - true) / law.contrast_se for law in laws) < 4
    assert all(law.bent and (law.certain or kind == "saturation") for law in laws)


def test_an_offset_and_light_of_the_room_are_told_apart() -> None:
    for seed in range(SEEDS):
        offset = _law(record(seed, linear(4.0, 2000)))
        room = _law(record(seed, linear(4.0), room_e=0.1 * LEVEL_E))
        assert (offset.kind, room.kind) == ("offset", "other light")
        assert abs(offset.value - 2000 / 27000) < 4 * offset.se
        assert abs(room.value - 0.1 / 1.1) < 4 * room.se


def test_linear_cameras_are_linear(repetitions: Callable[[int, int], int]) -> None:
    """Of movies of 8 bits as well, whose rounding is most of the dark noise."""
    for gain in (4.0, 700.0):
        laws = [
            _law(record(seed, linear(gain), frames=192), gain) for seed in range(repetitions(8, 20))
        ]
        assert {law.kind for law in laws} == {"linear"}


def test_control_rounding_that_is_not_taken_off_is_no_line() -> None:
    """As real numbers, the counts of eight bits have noise where there is no light."""
    counts = record(1, linear(700.0), flicker=0.001)
    found = measure_transfer(counts.astype(float), Camera(gain_e_per_adu=700.0))
    assert found is not None
    assert found.noise is not None
    assert found.noise.value / found.level < -0.3  # 700 · 700 / 12 / 1e5 = 0.41 of the light
    assert _law(counts, 700.0).kind == "linear"


def test_eight_bits_have_no_offset_under_a_steady_laser() -> None:
    for seed in range(SEEDS):
        known = _learned(record(seed, linear(700.0), flicker=0.001))
        offset, gain = known.numbers["offset_adu"], known.numbers["gain_e_per_adu"]
        assert offset.value == 0.0
        assert offset.source == "assumed"
        assert abs(gain.value - 700) < 5 * gain.se
        read = known.numbers["read_noise_e"]
        assert read.source == "rounding"
        assert read.value == pytest.approx(700 / 12**0.5, rel=0.02)
        assert law_finding(known, "") is None


def test_gain_and_offset_are_learned_with_their_errors() -> None:
    pulls = []
    for seed in range(8):
        known = _learned(record(seed, linear(4.0, 2000)))
        gain, offset = known.numbers["gain_e_per_adu"], known.numbers["offset_adu"]
        assert gain.source == offset.source == "measured"
        assert abs(gain.value / 4 - 1) < 0.02
        assert abs(offset.value - 2000) < 400
        pulls.append([(gain.value - 4.0) / gain.se, (offset.value - 2000) / offset.se])
    assert np.all(np.abs(np.mean(pulls, axis=0)) < 4 / math.sqrt(8))
    assert np.all(np.std(pulls, axis=0) < 2.0)


def test_dark_frames_tell_offset_and_read_noise() -> None:
    known = _learned(record(1, linear(0.5, 100.0), level_e=2000.0, read_e=8.0, dark=20))
    numbers = known.numbers
    assert numbers["offset_adu"].source == numbers["read_noise_e"].source == "dark frames"
    assert numbers["offset_adu"].value == pytest.approx(100, abs=0.5)
    assert numbers["read_noise_e"].value == pytest.approx(8, rel=0.03)
    assert numbers["gain_e_per_adu"].value == pytest.approx(0.5, rel=0.01)


def test_a_number_that_was_given_is_used() -> None:
    known = _learned(record(1, linear(4.0)), gain_e_per_adu=1.5, read_noise_e=3.0)
    assert known.config.gain_e_per_adu == 1.5
    assert known.config.read_noise_e == 3.0
    assert known.numbers["gain_e_per_adu"].source == "configured"


def test_what_the_driver_wrote_stands_where_it_is_not_measured() -> None:
    wrote = StackMetadata(gain_e_per_adu=0.46, offset_adu=2000.0, source="micromanager")
    counts = record(1, linear(4.0, 2000.0))
    known = learn_camera(open_stack(counts), CameraConfig(), (0, len(counts)), metadata=wrote)
    gain, offset = known.numbers["gain_e_per_adu"], known.numbers["offset_adu"]
    assert (gain.source, offset.source, offset.value) == ("measured", "metadata", 2000.0)
    assert gain.value == pytest.approx(4.0, rel=0.01)
    same = open_stack(np.repeat(counts[:1], 3, axis=0))
    one = learn_camera(same, CameraConfig(), (0, 3), metadata=wrote)
    assert one.numbers["gain_e_per_adu"].value == 0.46
    assert not one.findings


def test_particles_that_move_do_not_change_the_gain() -> None:
    """Their light has no detail as fine as a pixel; without looking there, the gain is far off."""
    rng = np.random.default_rng(4)
    y, x = np.indices(SHAPE)
    places, counts = rng.uniform(0, 64, (15, 2)), record(4, linear(4.0), frames=128)
    moved = counts.astype(float)
    for frame in moved:
        places = (places + rng.normal(0, 1.5, places.shape)) % 64
        for row, column in places:
            square = (y - row) ** 2 + (x - column) ** 2
            frame *= 1 - 0.02 * np.exp(-square / 9.7) * np.cos(0.9 * np.sqrt(square))
    movie = open_stack(np.rint(moved).astype(np.uint16))
    kept, lost = (
        learn_camera(movie, CameraConfig(), (0, 128), moving=way) for way in (True, False)
    )
    assert kept.numbers["gain_e_per_adu"].value == pytest.approx(4.0, rel=0.02)
    assert lost.numbers["gain_e_per_adu"].value < 3.5  # a control


def test_twelve_bits_stored_as_sixteen_are_rounded_to_sixteens() -> None:
    counts = (16 * (record(1, linear(60.0)).astype(int))).astype(np.uint16)
    known = _learned(counts)
    assert known.numbers["gain_e_per_adu"].value == pytest.approx(60 / 16, rel=0.01)


def test_averaged_frames_have_the_gain_of_their_averages() -> None:
    """Pairs of frames of which each is in two: averages of many have the noise of raw ones."""
    counts = record(1, linear(4.0)).astype(float)
    known = _learned((counts[1:] + counts[:-1]) / 2)
    assert known.numbers["gain_e_per_adu"].source == "effective"
    assert known.numbers["gain_e_per_adu"].value == pytest.approx(4.0, rel=0.03)


def test_a_steady_laser_does_not_tell_gamma_from_saturation() -> None:
    known = _learned(record(1, gamma(0.8), flicker=0.0))
    assert known.response is None
    found = law_finding(known, "")
    assert found is not None
    assert found.code == "counts-bent-or"
    assert "camera.response" not in found.text


def test_the_curve_of_a_law_gives_back_the_light(tmp_path: Path) -> None:
    for response in (gamma(0.8), saturation(4.0)):
        counts = record(2, response)
        known = _learned(counts)
        assert known.response is not None
        known.response.table.to_csv(tmp_path / "response.csv", index=False)
        curve = read_response(tmp_path / "response.csv")
        electrons = LEVEL_E * np.array([0.8, 1.0, 1.2])
        light = curve.of(response(electrons))
        np.testing.assert_allclose(light / electrons, light[1] / LEVEL_E, rtol=0.01)
        assert light[1] == pytest.approx(LEVEL_E, rel=0.05)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("counts,light\n1,2\n2,3\n", "has no photoelectrons"),
        ("counts,photoelectrons\n1,2\n1,3\n", "both columns rise"),
        ("counts,photoelectrons\n1,2\nx,3\n", "give numbers"),
    ],
)
def test_a_curve_that_is_none_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "curve.csv").write_text(text)
    with pytest.raises(ia.DataError, match=message):
        read_response(tmp_path / "curve.csv")
    with pytest.raises(ia.DataError, match="does not exist"):
        read_response(tmp_path / "none.csv")
