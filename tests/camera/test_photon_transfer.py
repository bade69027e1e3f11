"""Photon transfer recovers a known camera, says what it cannot know, and leaves bad pixels out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, gaussian_filter

from iscat_analysis.camera import CameraCalibration, Estimate, calibration, measure_camera
from iscat_analysis.errors import DataError

GAIN, OFFSET, READ_E = 4.0, 100.0, 20.0
READ_WITH_ROUNDING_E = math.hypot(READ_E, GAIN / math.sqrt(12))
SEEDS = 8
SHAPE = (48, 48)


@dataclass
class Movie:
    counts: NDArray[Any]
    name: str = "movie.tif"

    @property
    def shape(self) -> tuple[int, int, int]:
        t, y, x = self.counts.shape
        return t, y, x

    def read(self, start: int, stop: int) -> NDArray[Any]:
        return self.counts[start:stop].copy()


def context(rng: np.random.Generator, level: float = 1e4, contrast: float = 0.15) -> NDArray[Any]:
    speckle = gaussian_filter(rng.standard_normal(SHAPE), 2)
    return level * (1 + contrast * speckle / speckle.std())


def record(
    light: NDArray[Any],
    frames: int,
    rng: np.random.Generator,
    *,
    power: float = 0.01,
    read_e: float = READ_E,
) -> Movie:
    flicker = 1 + power * rng.standard_normal((frames, 1, 1))
    electrons = rng.poisson(light * flicker) + read_e * rng.standard_normal((frames, *light.shape))
    return Movie(np.clip(np.rint(electrons / GAIN + OFFSET), 0, 65535).astype(np.uint16))


def pull(estimate: Estimate | None, truth: float) -> float:
    assert estimate is not None
    return (estimate.value - truth) / estimate.se


def check_pulls(pulls: list[list[float]]) -> None:
    """Ask for a mean within 4 standard errors of zero and a spread of one (χ² at 1e-4)."""
    table = np.array(pulls)
    n = len(table)
    assert np.all(np.abs(table.mean(axis=0)) < 4 / math.sqrt(n)), table.mean(axis=0)
    assert np.all(table.std(axis=0, ddof=1) < 1.75), table.std(axis=0)
    assert np.all(table.std(axis=0, ddof=1) > 0.35), table.std(axis=0)


def _dark(rng: np.random.Generator) -> CameraCalibration:
    light = context(rng)
    return measure_camera([record(light, 120, rng)], dark=record(0 * light, 80, rng))


def _flicker(rng: np.random.Generator) -> CameraCalibration:
    return measure_camera([record(context(rng), 200, rng, power=0.05, read_e=60.0)])


def _levels(rng: np.random.Generator) -> CameraCalibration:
    light = context(rng)
    return measure_camera([record(f * light, 60, rng, power=0.0) for f in (0.2, 0.6, 1.0)])


def _steady(rng: np.random.Generator) -> CameraCalibration:
    found = measure_camera([record(context(rng), 200, rng, power=0.0)])
    assert found.read_noise_e is None
    assert any("cannot be told apart" in note for note in found.notes)
    return found


@pytest.mark.parametrize(
    ("recorded", "source", "offset", "read_e", "first"),
    [
        (_dark, "dark", OFFSET, READ_WITH_ROUNDING_E, 0),
        (_flicker, "flicker", OFFSET, math.hypot(60.0, GAIN / math.sqrt(12)), 100),
        (_levels, "flicker", OFFSET, None, 200),
        (_steady, "line", OFFSET - READ_WITH_ROUNDING_E**2 / GAIN, None, 300),
    ],
)
def test_recordings_give_the_camera_with_its_errors(
    recorded: Callable[[np.random.Generator], CameraCalibration], source: str, offset: float,
    read_e: float | None, first: int,
) -> None:  # fmt: skip
    """As far as they tell it: a steady laser leaves only where the line ends."""
    pulls = []
    for seed in range(first, first + SEEDS):
        found = recorded(np.random.default_rng(seed))
        assert found.offset_from == source
        pulls.append([pull(found.gain_e_per_adu, GAIN), pull(found.offset_adu, offset)])
        pulls[-1] += [] if read_e is None else [pull(found.read_noise_e, read_e)]
    check_pulls(pulls)


def test_control_without_power_normalisation_the_gain_is_wrong() -> None:
    rng = np.random.default_rng(1)
    movie = record(context(rng), 200, rng, power=0.05)
    counts = movie.counts.astype(float)
    mean, variance = counts.mean(axis=0).ravel(), counts.var(axis=0, ddof=1).ravel()
    naive = float(mean.mean() - OFFSET) / float(variance.mean())
    found = measure_camera([movie]).gain_e_per_adu
    assert found is not None
    assert naive < GAIN / 5
    assert abs(found.value - GAIN) < 4 * found.se


def test_small_read_noise_has_an_upper_limit() -> None:
    rng = np.random.default_rng(2)
    found = measure_camera([record(context(rng), 200, rng, power=0.05, read_e=1.0)])
    assert found.read_noise_e is None
    assert found.read_noise_below_e is not None
    assert math.hypot(1.0, GAIN / math.sqrt(12)) < found.read_noise_below_e < 50


def test_a_flat_needs_its_offset() -> None:
    rng = np.random.default_rng(3)
    flat = record(np.full(SHAPE, 2e4), 100, rng, power=0.0, read_e=0.0)
    with pytest.raises(DataError, match=r"give a dark \(`dark`\), the offset \(`offset_adu`\)"):
        measure_camera([flat])
    found = measure_camera([flat], offset_adu=OFFSET)
    assert abs(pull(found.gain_e_per_adu, GAIN)) < 4
    assert found.offset_from == "given"
    with pytest.raises(DataError, match=r"counts, no more than `offset_adu` = 60000: give"):
        measure_camera([flat], offset_adu=6e4)


def test_a_dark_alone_gives_counts_only() -> None:
    rng = np.random.default_rng(4)
    found = measure_camera([], dark=record(np.zeros(SHAPE), 100, rng), maps=True)
    assert found.gain_e_per_adu is None
    assert found.read_noise_e is None
    assert abs(pull(found.read_noise_adu, READ_WITH_ROUNDING_E / GAIN)) < 4
    assert "gain" not in found.to_toml()
    assert set(found.maps) == {"offset_adu"}


def with_noise(rng: np.random.Generator, kind: str, frames: int = 160) -> Movie:
    """Record with pixels that leak into their neighbours, or rows or columns that flicker."""
    light = np.broadcast_to(context(rng), (frames, *SHAPE))
    electrons = rng.poisson(light).astype(float)
    if kind == "leaky":
        kernel = (0.1, 0.8, 0.1)
        for axis in (1, 2):
            electrons = convolve1d(electrons, kernel, axis=axis)
    else:
        lines = (frames, SHAPE[0], 1) if kind == "rows" else (frames, 1, SHAPE[1])
        electrons *= 1 + 0.01 * rng.standard_normal(lines)
    return Movie(np.rint(electrons / GAIN + OFFSET).astype(np.uint16))


@pytest.mark.parametrize("kind", ["leaky", "rows", "columns"])
def test_noise_that_pixels_share_does_not_spoil_the_gain(kind: str) -> None:
    pulls = []
    for seed in range(SEEDS):
        found = measure_camera([with_noise(np.random.default_rng(seed), kind)], offset_adu=OFFSET)
        pulls.append([pull(found.gain_e_per_adu, GAIN)])
        assert any(("correlated" if kind == "leaky" else f"whole {kind}") in n for n in found.notes)
    check_pulls(pulls)


@pytest.mark.parametrize("kind", ["leaky", "rows", "columns"])
def test_control_taking_pixels_for_independent_spoils_it(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("iscat_analysis.camera.calibration.measure_spectrum", lambda *_, **__: None)
    found = measure_camera([with_noise(np.random.default_rng(1), kind)], offset_adu=OFFSET)
    assert abs(pull(found.gain_e_per_adu, GAIN)) > 20


def test_pixels_that_reach_zero_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """A third of the pixels are so dark that read noise is cut off at zero; and a control."""
    third = np.arange(SHAPE[1]) < SHAPE[1] // 3

    def pulls() -> list[list[float]]:
        found = []
        for seed in range(SEEDS):
            rng = np.random.default_rng(seed)
            light = context(rng, level=2e4) * np.where(third, 2e-4, 1.0)
            electrons = rng.poisson(light, (160, *SHAPE)) + 5 * rng.standard_normal((160, *SHAPE))
            counts = np.clip(np.rint(electrons / GAIN), 0, 65535).astype(np.uint16)
            camera = measure_camera([Movie(counts)])
            found.append([pull(camera.gain_e_per_adu, GAIN)])
            found[-1].append(pull(camera.offset_adu, 0.0))
        return found

    check_pulls(pulls())
    nothing = np.zeros(SHAPE, dtype=bool)
    monkeypatch.setattr("iscat_analysis.camera.calibration.clipped", lambda _: nothing)
    with pytest.raises(AssertionError):
        check_pulls(pulls())


def test_a_dark_that_reaches_zero_is_noticed() -> None:
    rng = np.random.default_rng(1)
    dark = Movie(np.clip(np.rint(3 * rng.standard_normal((60, *SHAPE))), 0, 9).astype(np.uint16))
    light = record(context(rng), 60, rng)
    notes = measure_camera([light], dark=dark).notes
    assert any("reach zero counts" in note for note in notes)


def test_bad_pixels_are_left_out_and_reported() -> None:
    rng = np.random.default_rng(5)
    movie = record(context(rng), 100, rng)
    movie.counts[50, 10, 11] = 65535
    movie.counts[:, 20, 21] = 100
    movie.counts[::4, 30, 31] += 4000
    movie.counts[:, 5, 6] = 40000 + movie.counts[:, 5, 6] % 16
    found = measure_camera([movie])
    assert np.argwhere(found.masked["saturated"]).tolist() == [[10, 11]]
    assert np.argwhere(found.masked["dead"]).tolist() == [[20, 21]]
    assert np.argwhere(found.masked["hot"]).tolist() == [[5, 6], [30, 31]]
    assert sum("left out" in note for note in found.notes) == 3
    assert abs(pull(found.gain_e_per_adu, GAIN)) < 4


def test_maps_show_pixels_that_differ() -> None:
    rng = np.random.default_rng(6)
    light = np.full(SHAPE, 2e4)
    gain = np.where(np.arange(SHAPE[1]) < SHAPE[1] // 2, 3.0, 5.0) * np.ones(SHAPE)
    frames = rng.poisson(light, (600, *SHAPE)) / gain + OFFSET
    dark = record(0 * light, 100, rng)
    movie = Movie(np.rint(frames).astype(np.uint16))
    found = measure_camera([movie], dark=dark, maps=True)
    values = found.maps["gain_e_per_adu"]
    left, right = np.split(values, 2, axis=1)
    # The dark here is another camera's, of 20 e read noise: 1 to 2 % of the variance.
    assert abs(np.median(left) / 3 - 1) < 0.05
    assert abs(np.median(right) / 5 - 1) < 0.05
    assert values.min() > 0
    assert set(found.maps) == {"gain_e_per_adu", "offset_adu", "read_noise_e"}
    with pytest.raises(DataError, match="`maps` needs 100 frames"):
        measure_camera([Movie(movie.counts[:50])], dark=dark, maps=True)


def test_noise_falls_as_shot_noise_does() -> None:
    rng = np.random.default_rng(7)
    found = measure_camera([record(context(rng), 512, rng, read_e=5.0)], offset_adu=OFFSET)
    noise = found.noise
    assert found.shot_limited_frames == noise["n_frames"].max() == 256
    assert np.all(np.abs(noise["excess"] - 1) < 5 * noise["excess_se"] + 0.01)
    expected = np.sqrt(2 / (1e4 * noise["n_frames"]))
    # The mean of 1/μ over the speckle, and the gain, are each off by a few per cent.
    assert np.allclose(noise["shot_noise"], expected, rtol=0.06)


def test_drift_ends_the_shot_noise_limit() -> None:
    rng = np.random.default_rng(8)
    light = context(rng)
    counts = np.concatenate(
        [record(np.roll(light, k // 64, axis=1), 1, rng, read_e=5.0).counts for k in range(512)]
    )
    # Every 64 frames the speckle moves by one pixel.
    found = measure_camera([Movie(counts)], offset_adu=OFFSET)
    assert found.shot_limited_frames is not None
    assert 2 <= found.shot_limited_frames <= 64
    assert "drift" in found.verdict


def test_read_noise_ends_it_at_once() -> None:
    rng = np.random.default_rng(9)
    light = context(rng, level=500.0)
    found = measure_camera(
        [record(light, 128, rng, read_e=30.0)], dark=record(0 * light, 64, rng, read_e=30.0)
    )
    assert found.shot_limited_frames == 0
    assert found.verdict.startswith("not shot-noise limited")


def test_a_curved_transfer_is_noticed() -> None:
    rng = np.random.default_rng(10)
    light = context(rng, contrast=0.3)
    movie = record(light, 300, rng, power=0.0)
    bent = movie.counts * (1 - movie.counts / 16000.0)
    found = measure_camera([Movie(bent.astype(np.float32))])
    assert any("does not follow a straight line" in note for note in found.notes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c[:4], "needs 8"),
        (lambda c: np.full_like(c, 65535), "are saturated"),
        (lambda c: np.broadcast_to(c[:1], c.shape), "successive frames are identical"),
        (lambda c: np.where(np.arange(c.size).reshape(c.shape) == 7, np.nan, c), "NaN"),
    ],
)
def test_what_is_no_raw_movie_is_refused(change: Any, message: str) -> None:
    rng = np.random.default_rng(11)
    movie = record(context(rng), 16, rng)
    with pytest.raises(DataError, match=message):
        measure_camera([Movie(change(movie.counts))])


def test_dropped_and_stuck_frames_are_left_out() -> None:
    rng = np.random.default_rng(13)
    good = record(context(rng), 200, rng).counts
    harmed = good.copy()
    harmed[50:52] = 0
    harmed[120:140] = harmed[119]
    lost = [50, 51, *range(120, 140)]
    found = measure_camera([Movie(harmed)])
    alone = measure_camera([Movie(np.delete(good, lost, axis=0))])
    assert found.gain_e_per_adu.value == alone.gain_e_per_adu.value
    assert found.verdict == alone.verdict
    assert found.frames == 178
    (note,) = [note for note in found.notes if "dropped or stuck" in note]
    assert "frames 50, 51, 120, 121 and 18 more" in note
    # Control: with them in, the differences of the frames are too small.
    harmed[50:52] = good[50:52]
    stuck = np.mean(np.var(np.diff(harmed.astype(float), axis=0), axis=0))
    assert stuck < 0.95 * np.mean(np.var(np.diff(good.astype(float), axis=0), axis=0))


def test_hardly_any_frame_differs() -> None:
    rng = np.random.default_rng(14)
    few = record(context(rng), 5, rng).counts
    with pytest.raises(DataError, match=r"movie.tif: only 5 of 20 frames are neither zero"):
        measure_camera([Movie(np.repeat(few, 4, axis=0))])


def test_stacks_must_agree_in_shape() -> None:
    rng = np.random.default_rng(12)
    movie = record(context(rng), 16, rng)
    other = Movie(movie.counts[:, :40], "dark.tif")
    with pytest.raises(DataError, match=r"dark.tif: is 40 x 48 pixels but movie.tif is 48 x 48"):
        measure_camera([movie], dark=other)
    with pytest.raises(DataError, match="no recording"):
        measure_camera([])


def reported_read_noise(truth_e: float, trials: int) -> NDArray[Any]:
    """Give the read noise of recordings without a dark, where any is reported."""
    found = []
    for seed in range(trials):
        rng = np.random.default_rng(7000 + seed)
        light = np.maximum(context(rng), 0.0)
        movie = record(light, 60, rng, power=0.0, read_e=truth_e)
        read = measure_camera([movie], offset_adu=OFFSET).read_noise_e
        if read is not None:
            found.append(read.value)
    return np.array(found)


def check_unselected(found: NDArray[Any], truth_e: float) -> None:
    assert found.size >= 100
    truth = math.hypot(truth_e, GAIN / math.sqrt(12))
    assert abs(found.mean() - truth) < 3 * found.std(ddof=1) / math.sqrt(found.size)


@pytest.mark.large
def test_read_noise_that_is_reported_is_not_selected(monkeypatch: pytest.MonkeyPatch) -> None:
    """Near where it is just seen; and the control, the rule that decides on what it reports."""
    truth_e = 42.0
    check_unselected(reported_read_noise(truth_e, 300), truth_e)

    def whole(found: Any, used: Any, given: float) -> Estimate:
        line = calibration.variance_line(*calibration._pooled(found, used))
        return calibration._read_variance((*line[0], line[1]), Estimate(given, 0.0)).adu2

    monkeypatch.setattr(calibration, "_half", whole)
    monkeypatch.setattr(calibration, "_READ_NOISE_SIGMAS", 5.0)
    monkeypatch.setattr(calibration, "_unselected", lambda read, *_: read.e2)
    with pytest.raises(AssertionError):
        check_unselected(reported_read_noise(truth_e, 300), truth_e)
