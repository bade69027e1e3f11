"""Sliding sums against plain ones, the step's frame, the noise curve."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from iscat_analysis.camera import Camera
from iscat_analysis.search.dating import crosstalk, locate_step
from iscat_analysis.search.frames import Chunk, Patch, StoredFrames, make_chunk, measure_frames
from iscat_analysis.search.noise import NoiseCurve, choose_window, longest_window, measure_noise
from iscat_analysis.search.sliding import find_steps, make_filter, sliding_maps
from iscat_analysis.threads import threads

SHAPE = (40, 44)
SIGMAS = 4.0


def _spot(y: float, x: float, depth: float = 1.0, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    rows, columns = np.indices(shape)
    r = np.hypot(rows - y, columns - x)
    return depth * np.cos(r / 1.5) * np.exp(-((r / 3) ** 2))


TEMPLATE = _spot(6, 6, shape=(13, 13))


def _movie(
    frames: int, seed: int, *, contrast: Any = 0.0, at: int = 10**6, level: float = 1e4
) -> np.ndarray:
    """Speckle, 1 % power noise, and a contrast from one frame on."""
    rng = np.random.default_rng(seed)
    power = 1 + 0.01 * rng.standard_normal(frames)
    light = level * np.random.default_rng(2).uniform(0.8, 1.2, SHAPE)
    return np.array(
        [rng.poisson(p * light * (1 + (contrast if t >= at else 0))) for t, p in enumerate(power)],
        dtype="u2",
    )


def _chunk(
    counts: np.ndarray, camera: Camera | None = None, *, stride: int = 5, **bad: int
) -> Chunk:
    camera = camera or Camera()
    light, repeats = measure_frames(counts, camera)
    good = np.isfinite(light) & ~repeats
    return make_chunk(bad.get("first", 0), counts, good, light, camera, stride=stride)


# ---- sums ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["u1", "u2", "i4", "f4", "f8"])
def test_blocks_are_plain_sums(kind: str) -> None:
    counts = np.random.default_rng(1).integers(50, 200, (23, *SHAPE)).astype(kind)
    camera = Camera(gain_e_per_adu=2.0, offset_adu=7.0)
    chunk = _chunk(counts, camera)
    electrons = 2.0 * (counts.astype(float) - 7)
    for k, (start, stop) in enumerate(zip(chunk.edges[:-1], chunk.edges[1:], strict=True)):
        np.testing.assert_allclose(chunk.blocks_e[k], electrons[start:stop].sum(axis=0))
    assert chunk.edges.tolist() == [0, 5, 10, 15, 20, 23]
    np.testing.assert_allclose(chunk.power.mean(), 1.0)
    np.testing.assert_allclose(
        chunk.power / chunk.power[0], electrons.sum((1, 2)) / electrons[0].sum()
    )


def test_maps_of_the_camera_enter_pixel_by_pixel() -> None:
    rng = np.random.default_rng(1)
    counts = rng.integers(50, 200, (20, *SHAPE)).astype("u2")
    gain, offset = rng.uniform(1, 3, SHAPE), rng.uniform(0, 9, SHAPE)
    chunk = _chunk(counts, Camera(gain_e_per_adu=gain, offset_adu=offset))
    electrons = gain * (counts - offset)
    np.testing.assert_allclose(chunk.blocks_e[1], electrons[5:10].sum(axis=0))
    np.testing.assert_allclose(
        chunk.power, electrons.sum((1, 2)) / electrons.sum((1, 2)).mean(), rtol=1e-12
    )
    summed, frames, power = chunk.patch(3, 9, (5, 15), (7, 20)).window(4, 8)
    np.testing.assert_allclose(summed, electrons[4:8, 5:15, 7:20].sum(axis=0))
    assert frames == 4
    assert power == pytest.approx(chunk.power[4:8].sum())
    here = slice(5, 15), slice(7, None)
    np.testing.assert_allclose(
        chunk.electrons(slice(4, 8), here), electrons[(slice(4, 8), *here)].sum(axis=0)
    )


def test_frames_of_a_region_are_copied_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is asked for between, before and behind them, and of places that are long ago."""
    chunk, copied, copy = _chunk(_movie(300, 2)), [], Chunk._copied
    counts = chunk.counts.array(0, 300)

    def noted(self: Chunk, frames: slice, *region: tuple[int, int]) -> NDArray[Any]:
        copied.append(frames.stop - frames.start)
        return copy(self, frames, *region)

    monkeypatch.setattr(Chunk, "_copied", noted)
    for start, stop in ((50, 80), (60, 70), (40, 60), (75, 100), (45, 95), (280, 300), (90, 90)):
        found = chunk.patch(start, stop, (2, 6), (1, 9)).counts
        np.testing.assert_array_equal(found, counts[start:stop, 2:6, 1:9])
    assert copied == [30, 10, 20, 20]


@pytest.mark.parametrize("stored", ["u1", ">u2", "u2", "i4", "f4", "f8"])
@pytest.mark.parametrize(
    ("rows", "columns"),
    [((5, 15), (7, 20)), ((0, 40), (0, 44)), ((39, 40), (43, 44)), ((3, 3), (0, 9))],
)
def test_a_patch_holds_the_counts_of_its_region(
    stored: str, rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    counts = np.random.default_rng(8).integers(0, 200, (20, *SHAPE)).astype(stored)
    chunk = replace(_chunk(_movie(20, 3)), counts=StoredFrames([counts]))
    for start, stop in ((0, 20), (3, 5), (4, 4), (19, 30), (-7, 2), (30, 40)):
        patch = chunk.patch(start, stop, rows, columns)
        held = slice(max(start, 0), max(stop, 0))
        wanted = counts[held, slice(*rows), slice(*columns)]
        assert patch.counts.dtype == counts.dtype
        np.testing.assert_array_equal(patch.counts, wanted)
        some = patch.frames(start + 1, stop)
        np.testing.assert_array_equal(some.counts, wanted[some.first - patch.first :])
        assert some.first == max(start + 1, patch.first)


def test_a_patch_of_frames_that_are_a_part_of_others() -> None:
    """Their rows do not follow each other in memory."""
    counts = (
        np.random.default_rng(8).integers(0, 200, (20, 2 * SHAPE[0], 3 * SHAPE[1])).astype("u2")
    )
    part = counts[::2, 1::2, 2::3]
    chunk = replace(_chunk(_movie(10, 3)), counts=StoredFrames([part]))
    patch = chunk.patch(2, 9, (5, 15), (7, 20))
    np.testing.assert_array_equal(patch.counts, part[2:9, 5:15, 7:20])


@pytest.mark.parametrize(
    ("rows", "columns"),
    [((-1, 4), (0, 4)), ((0, 41), (0, 4)), ((0, 4), (40, 45)), ((5, 4), (0, 4))],
)
def test_a_patch_beyond_the_frames_is_refused(
    rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    with pytest.raises(IndexError, match="frames of shape"):
        _chunk(_movie(20, 3)).patch(0, 20, rows, columns)


def test_stuck_and_dark_frames_do_not_exist() -> None:
    counts = _movie(40, 3)
    counts[7] = counts[6]
    counts[20] = 0
    light, repeats = measure_frames(counts, Camera())
    assert np.flatnonzero(repeats).tolist() == [7]
    assert np.flatnonzero(~np.isfinite(light)).tolist() == [20]
    chunk = _chunk(counts)
    assert chunk.power[7] == chunk.power[20] == 0
    np.testing.assert_allclose(chunk.blocks_e[1], counts[[5, 6, 8, 9]].sum(axis=0))
    assert chunk.patch(0, 40, (0, 4), (0, 4)).window(18, 22)[1] == 3


def test_a_saturated_pixel_is_not_usable() -> None:
    counts = _movie(20, 3)
    counts[4, 5, 6] = 65535
    chunk = _chunk(counts, Camera(full_scale_adu=65535.0))
    assert np.argwhere(chunk.saturated).tolist() == [[5, 6]]
    assert not chunk.usable[5, 6]


# ---- the statistic ---------------------------------------------------------------------------


def test_the_map_is_the_matched_filter_written_out() -> None:
    chunk = _chunk(_movie(40, 5, contrast=_spot(18, 20, 0.05), at=20))
    snr, effective = sliding_maps(chunk, make_filter(chunk, TEMPLATE), 4)
    before, after = chunk.blocks_e[:4].sum(0), chunk.blocks_e[4:].sum(0)
    contrast = after / before * before.sum() / after.sum() - 1
    p = chunk.power
    h = p[:20].sum() * p[20:].sum() / p.sum()
    for y, x in ((18, 20), (10, 30)):
        here = (slice(y - 6, y + 7), slice(x - 6, x + 7))
        weight = chunk.mean_e[here] * h
        expected = np.sum(weight * TEMPLATE * contrast[here]) / np.sqrt(
            np.sum(weight * TEMPLATE**2)
        )
        assert snr[3, y, x] == pytest.approx(expected, rel=1e-3, abs=0.02)
    assert effective[3] == pytest.approx(h)


@pytest.mark.parametrize("workers", [1, 3])
@pytest.mark.parametrize("frames", [30, 80, 135])
def test_maps_that_take_the_place_of_blocks_are_those_beside_them(
    frames: int, workers: int
) -> None:
    chunk = _chunk(_movie(frames, 11, contrast=_spot(18, 20, 0.05), at=frames // 2))
    matched = make_filter(chunk, TEMPLATE)
    expected, shares = sliding_maps(chunk, matched, 4)
    blocks = chunk.blocks_e.copy()
    with threads(workers) as pool:
        found, effective = sliding_maps(chunk, matched, 4, in_place=True, mapper=pool.map)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(effective, shares)
    assert np.shares_memory(found, chunk.blocks_e)
    assert not np.array_equal(chunk.blocks_e[:-1], blocks[:-1])  # control


def test_noise_has_unit_variance_at_every_boundary() -> None:
    chunk = _chunk(_movie(80, 6))
    snr, _ = sliding_maps(chunk, make_filter(chunk, TEMPLATE), 4)
    independent = snr[:, ::6, ::6]
    spread = independent.std(axis=(1, 2))
    assert np.abs(spread - 1).max() < 5 / np.sqrt(2 * independent[0].size)


def test_a_step_is_found_where_and_when_it_is_and_vanishes_once_explained() -> None:
    image = _spot(18.3, 20.6, -0.05)
    chunk = _chunk(_movie(80, 7, contrast=image, at=40), first=1000)
    matched = make_filter(chunk, TEMPLATE)
    snr, effective = sliding_maps(chunk, matched, 4)
    best = find_steps(chunk, matched, snr, effective, 6.0)[0]
    assert best.frame == 1040
    assert (best.x_px, best.y_px) == pytest.approx((20.6, 18.3), abs=0.15)
    assert best.amplitude == pytest.approx(-0.05, rel=0.1)

    def explained(_: int, before: slice, after: slice) -> np.ndarray:
        share = [np.mean(np.arange(s.start, s.stop) >= 40) for s in (before, after)]
        return (1 + share[1] * image) / (1 + share[0] * image) - 1

    left, _ = sliding_maps(chunk, matched, 4, explained=explained)
    assert np.abs(left).max() < 5.5


# ---- the frame -------------------------------------------------------------------------------


def _dated(seed: int, depth: float, at: int, *, shift: int = 0) -> Any:
    image = _spot(18, 20, depth)
    chunk = _chunk(_movie(60, seed, contrast=image, at=at), first=100)
    rows, columns = (12, 25), (14, 27)
    patch = chunk.patch(100, 160, rows, columns)
    return locate_step(patch, image[12:25, 14:27], (115 + shift, 146 + shift))


def test_a_strong_step_is_dated_to_the_frame() -> None:
    found = _dated(1, -0.1, 31)
    assert (found.frame, found.half_width, found.gap) == (131, 0, 0)
    assert found.height == pytest.approx(1.0, abs=0.05)


def _inside(depth: float, wrong: int = 0) -> int:
    """Of 60 faint steps, those inside their 95 % interval."""
    found = [(25 + s % 9, _dated(s, depth, 25 + s % 9)) for s in range(60)]
    return sum(abs(f.frame - 100 - at - wrong) <= f.half_width for at, f in found)


def test_the_interval_of_a_faint_step_holds_it() -> None:
    """95 % of 60 are 57; the binomial gives fewer than 51 once in 200."""
    assert _inside(-0.008) >= 51


def test_the_interval_misses_another_frame() -> None:
    """Control: the test above can fail."""
    assert _inside(-0.02, wrong=3) < 51


def test_a_neighbour_that_is_known_does_not_pull_the_frame() -> None:
    image, other = _spot(18, 20, -0.05), _spot(18, 24, -0.1)
    counts = _movie(60, 9, contrast=image, at=30)
    late = np.random.default_rng(1).poisson(np.maximum(-other, 0) * counts[38:])
    early = np.random.default_rng(2).poisson(np.maximum(other, 0) * counts[38:])
    counts[38:] = counts[38:] - late + early
    patch = _chunk(counts).patch(0, 60, (12, 25), (14, 27))
    (height,) = crosstalk(patch, image[12:25, 14:27], [other[12:25, 14:27]])
    known = height * (np.arange(60) >= 38)
    assert locate_step(patch, image[12:25, 14:27], (15, 50), known=known).frame == 30
    assert height == pytest.approx(np.sum(image * other) / np.sum(image**2), abs=0.15)


def _inconstant(again: float, count: int = 400, level: float = 0.01) -> int:
    """Of `count` steps, those that seem to change again, where a second lands on top at 42."""
    image = _spot(18, 20, -0.1)[12:25, 14:27]
    background = 1e4 * np.random.default_rng(2).uniform(0.8, 1.2, image.shape)
    height = np.where(np.arange(60) >= 30, 1.0, 0.0) + np.where(np.arange(60) >= 42, again, 0.0)
    rng = np.random.default_rng(6)
    few = 0
    for _ in range(count):
        counts = rng.poisson(background * (1 + height[:, None, None] * image)).astype("u2")
        nothing = np.ones(image.shape, dtype=bool)
        patch = Patch(
            0, counts, np.ones(60, bool), np.ones(60), 1.0, 0.0, 0.0, background, nothing, ~nothing
        )
        few += locate_step(patch, image, (15, 46)).p_constant < level
    return few


def test_a_constant_height_seldom_seems_to_change() -> None:
    """The chance is a bound: 1 % of 400 are 4, more than 12 come once in 10 000."""
    assert _inconstant(0.0) <= 12


def test_a_second_step_on_top_is_noticed() -> None:
    """Control: the chance falls where the height does change, by 6 standard deviations here."""
    assert _inconstant(0.1) > 360


# ---- noise and windows -----------------------------------------------------------------------


def test_shot_noise_averages_down() -> None:
    curve = measure_noise(_movie(200, 4), Camera(), 50)
    assert curve.shot_limited == 50
    assert np.abs(np.array(curve.variance_over_shot) - 1).max() < 0.2
    assert choose_window(curve, 2000) == 50
    assert choose_window(curve, 200) == 20


def test_a_pattern_that_wanders_sets_the_window() -> None:
    counts = _movie(400, 4).astype(float)
    walk = np.cumsum(np.random.default_rng(5).standard_normal((400, *SHAPE)) * 2e-3, axis=0)
    curve = measure_noise(counts * (1 + walk), Camera(), 100)
    assert curve.shot_limited < 20
    assert choose_window(curve, 4000) < 40


@pytest.mark.parametrize(("frames", "expected"), [(40, 10), (500, 50), (10**6, 100)])
def test_windows_are_a_small_part_of_the_movie(frames: int, expected: int) -> None:
    assert longest_window(frames) == expected
    assert choose_window(NoiseCurve((1, 100), (1.0, 1.0)), frames) == expected
