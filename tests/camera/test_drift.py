"""A moving pattern: how far it went, what it looks like there, and what it leaves in a movie."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as image_shift

from iscat_analysis.camera import (
    Camera,
    Mover,
    Trajectory,
    derivatives,
    follow_pattern,
    measure_drift,
    trusted,
)
from iscat_analysis.config import Config, load_config
from iscat_analysis.fitting.events import Region
from iscat_analysis.fitting.pattern import MovingPattern, follow
from iscat_analysis.search.frames import Chunk, make_chunk, measure_frames
from iscat_analysis.study import Movie

SIGMAS = 4.0
STRIDE, WINDOW = 10, 40


def _config(drift: tuple[float, float], *settings: str, frames: int = 240) -> Config:
    return load_config(
        None,
        [
            "camera.pixel_size_nm=84.0",
            "particle.mass_kda=480.0",
            "calibration.gradient_per_kda=-3.1e-5",
            "simulation.shape=[64, 64]",
            f"simulation.frames={frames}",
            "simulation.photons_per_pixel=4e4",
            "simulation.background=speckle",
            "simulation.power_noise=0.01",
            f"simulation.drift_px_per_frame={list(drift)}",
            *settings,
        ],
    )


def _chunk(config: Config, seed: int, jump: int = 0) -> Chunk:
    counts = np.array(list(Movie(config, seed).frames()))
    if jump:
        counts[len(counts) // 2 :] = np.roll(counts[len(counts) // 2 :], jump, axis=2)
    light, repeats = measure_frames(counts, Camera())
    return make_chunk(0, counts, ~repeats, light, Camera(), stride=STRIDE)


# ---- registration ----------------------------------------------------------------------------


def test_a_pattern_of_which_hardly_a_pixel_is_usable_is_not_followed() -> None:
    """None of those whose scatter is looked at is: no warning of an empty median either."""
    shape = 64, 64
    blocks = np.random.default_rng(5).poisson(1e6, (2, *shape)).astype(float)
    usable = np.zeros(shape, dtype=bool)
    usable[33, 10:12] = True
    two = np.array([1.0, 1.0])
    assert follow_pattern(blocks, two, np.array([10.0, 30.0]), usable, np.zeros(shape)) is None


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.15), (2.4, 1.1)])
def test_drift_of_a_pattern(shift: tuple[float, float]) -> None:
    n = 64
    rng = np.random.default_rng(3)
    f = np.fft.fftfreq(n)
    envelope = np.exp(-((f[:, None] ** 2 + f**2) / (2 * 0.08**2)))
    spectrum = np.fft.fft2(rng.standard_normal((n, n))) * envelope
    moved = spectrum * np.exp(-2j * np.pi * (f[:, None] * shift[0] + f * shift[1]))
    one, two = (np.fft.ifft2(s).real for s in (spectrum, moved))
    scale = 0.1 / one.std()
    found = measure_drift(1 + scale * one, 1 + scale * two)
    assert found == pytest.approx(shift, rel=0.05, abs=0.03)  # the taper costs a few per cent


def test_pixels_that_blink_are_no_pattern_that_moves() -> None:
    rng = np.random.default_rng(7)
    rough = gaussian_filter(rng.standard_normal((128, 128)), 3.0, mode="wrap")
    light = 1 + 0.05 * rough / rough.std()
    images = [light + 3e-4 * rng.standard_normal(light.shape) for _ in range(2)]
    images[0][40, 50] *= 1.1
    images[1][54, 40] *= 1.1
    assert np.hypot(*measure_drift(images[0], images[1])) < 0.02


def _window_pulls(way: Trajectory, rate: tuple[float, float]) -> np.ndarray:
    """Errors of the shift between neighbouring windows over that of a block against the next."""
    truth = way.frames[:, None] * np.array(rate)[::-1]
    error = way.shift_px - truth
    strides = WINDOW // STRIDE
    means = np.array([error[k : k + strides].mean(0) for k in range(0, len(error), strides)])
    return np.diff(means, axis=0) / way.typical_error_px


@pytest.mark.parametrize("rate", [(0.0, 0.0), (0.003, -0.002), (0.01, 0.004)])
@pytest.mark.parametrize("particles", [0, 12])
def test_the_way_is_known_to_within_its_error(rate: tuple[float, float], particles: int) -> None:
    settings = [f"simulation.count={particles}"] if particles else []
    pulls = np.concatenate(
        [
            _window_pulls(way, rate)
            for seed in range(4)
            if (way := follow(_chunk(_config(rate, *settings), seed))) is not None
        ]
    )
    assert pulls.size == 4 * 5 * 2
    # means of four blocks: their difference is half as uncertain as that of two single blocks
    assert np.sqrt(np.mean(pulls**2)) < 1 + SIGMAS / np.sqrt(2 * pulls.size)


def test_a_way_that_is_wrong_misses_its_error() -> None:
    """Control: the test above can fail."""
    way = _way(_chunk(_config((0.003, -0.002)), 1))
    assert np.sqrt(np.mean(_window_pulls(way, (0.003, -0.0015)) ** 2)) > 5


def _way(chunk: Chunk) -> Trajectory:
    way = follow(chunk)
    assert way is not None
    return way


def test_a_jump_of_the_stage_is_followed() -> None:
    way = _way(_chunk(_config((0.0, 0.0)), 2, jump=3))
    found = way.shift_px[-1] - way.shift_px[0]
    np.testing.assert_allclose(found, [0.0, 3.0], atol=SIGMAS * way.typical_error_px)


def test_without_a_pattern_nothing_is_followed() -> None:
    assert follow(_chunk(_config((0.005, 0.0), "simulation.background=flat"), 1)) is None


# ---- moving ----------------------------------------------------------------------------------


def test_a_pattern_is_moved_exactly_but_for_the_edges() -> None:
    movie = Movie(_config((0.13, -0.07), frames=12), 4)
    images = [image / power for image, power in zip(movie.expected_frames(), movie.power)]  # noqa: B905
    mover = Mover((64, 64))
    shift = movie.drift_px[[10]]
    moved = mover.image(mover.spectrum(images[0]) * mover.transfer(shift, np.ones(1)))
    error = (moved / images[10] - 1)[8:-8, 8:-8]
    assert np.abs(shift).min() > 0.6
    assert error.std() < 2e-3 * np.std(images[0]) / np.mean(images[0]) * 10
    assert (images[0] / images[10] - 1).std() > 20 * error.std()


def test_derivatives_are_the_analytic_ones() -> None:
    y, x = np.indices((41, 43)) - 20.3
    image = np.exp(-(x**2 + 2 * y**2) / 20)
    expected = [-y / 5, -x / 10, y * y / 25 - 0.2, x * y / 50, x * x / 100 - 0.1]
    for found, factor in zip(derivatives(image), expected, strict=True):
        inner = np.s_[4:-4, 4:-4]
        np.testing.assert_allclose(found[inner], (factor * image)[inner], atol=1e-4)


def test_pixels_near_a_dead_one_are_not_trusted() -> None:
    usable = np.ones((40, 40), dtype=bool)
    usable[20, 21] = False
    kept = trusted(usable, 0.3)
    assert kept.sum() == 30 * 30 - 13
    assert not kept[20, 23]
    assert kept[21, 23]


# ---- what it leaves ---------------------------------------------------------------------------


def _left(chunk: Chunk, pattern: MovingPattern) -> np.ndarray:
    """Contrast of a middle boundary in standard deviations, with the pattern divided out."""
    j = len(chunk.blocks_e) // 2
    before = chunk.blocks_e[j - 3 : j + 1].sum(axis=0)
    after = chunk.blocks_e[j + 1 : j + 5].sum(axis=0)
    used = pattern.chunk.usable
    ratio = after[used].sum() / before[used].sum()
    contrast = after / (ratio * before) / (1 + pattern.contrast[j]) - 1
    return (contrast / np.sqrt(1 / after + 1 / before))[used]


@pytest.mark.parametrize("rate", [(0.0, 0.0), (0.003, -0.002), (0.005, -0.002)])
def test_shot_noise_is_left(rate: tuple[float, float]) -> None:
    chunk = _chunk(_config(rate), 5)
    left = _left(chunk, MovingPattern(chunk, _way(chunk)))
    assert left.var() == pytest.approx(1, abs=SIGMAS * np.sqrt(2 / left.size))


def test_without_correction_more_than_shot_noise_is_left() -> None:
    """Control: the test above can fail."""
    chunk = _chunk(_config((0.003, -0.002)), 5)
    pattern = MovingPattern(chunk, _way(chunk))
    pattern.contrast = np.zeros_like(pattern.contrast)
    assert _left(chunk, pattern).var() > 10


def _two_patterns(moved_px: float, seed: int, frames: int = 440, level_e: float = 4e4) -> Chunk:
    """Record two patterns, the second of which moves, and nothing else."""
    rng = np.random.default_rng(seed)
    rough = [gaussian_filter(rng.standard_normal((80, 80)), 3.0, mode="wrap") for _ in range(2)]
    first, second = (level_e**0.5 * (1 + 0.05 * one / one.std()) for one in rough)
    counts = np.array(
        [
            rng.poisson((first * image_shift(second, (0.0, moved_px * t / frames)))[8:-8, 8:-8])
            for t in range(frames)
        ]
    )
    light, repeats = measure_frames(counts, Camera())
    return make_chunk(0, counts, ~repeats, light, Camera(), stride=STRIDE)


@pytest.mark.parametrize("moved_px", [0.0, 2.0])
def test_of_two_patterns_that_move_against_each_other_shot_noise_is_left(moved_px: float) -> None:
    """By the common motion alone a variance of 2.5 is left."""
    chunk = _two_patterns(moved_px, 8)
    pattern = MovingPattern(chunk, _way(chunk))
    left = _left(chunk, pattern)
    own = 1.04 if moved_px else 1.0  # slopes have noise of their own, that of as many windows
    assert left.var() == pytest.approx(own, abs=SIGMAS * np.sqrt(2 / left.size))
    edge = int(chunk.edges[len(chunk.blocks_e) // 2])
    windows = slice(edge - WINDOW, edge), slice(edge, edge + WINDOW)
    weights = [pattern.weights(*windows, window) for window in windows]
    assert [each.sum() for each in weights] == pytest.approx([1, 1])
    assert np.allclose(*weights) == (moved_px == 0)


def test_a_region_sees_what_the_field_sees() -> None:
    chunk = _chunk(_config((0.003, -0.002)), 5)
    pattern = MovingPattern(chunk, _way(chunk))
    j = 11
    edge = int(chunk.edges[j + 1])
    region = Region((16, 48), (14, 46))
    local = pattern.local(region, edge)
    windows = slice(edge - WINDOW, edge), slice(edge, edge + WINDOW)
    before, after = (local.seen(window) for window in windows)
    field = 1 + pattern.contrast[j][region.slices]
    ratio = after / before / field
    noise = np.sqrt(2 / (WINDOW * 4e4))
    assert (ratio / ratio.mean() - 1).std() < 0.1 * noise
