"""Sums before and after landing, and the laser power that the particles must not disturb."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import Stack
from scipy.ndimage import median_filter

from iscat_analysis.camera import (
    Camera,
    find_defects,
    measure_windows,
    refine_power,
    smooth_background,
)
from iscat_analysis.camera.background import DEAD, DEFECT_SIGMAS, HOT
from iscat_analysis.config import BackgroundConfig
from iscat_analysis.errors import DataError

SHAPE = (48, 56)
SIGMAS = 4.0


def _spots(depth: float, count: int = 8) -> np.ndarray:
    """Dark spots with rings, as strong as `depth`."""
    y, x = np.indices(SHAPE)
    rng = np.random.default_rng(1)
    contrast = np.zeros(SHAPE)
    for cy, cx in rng.uniform(8, 40, (count, 2)):
        r = np.hypot(y - cy, x - cx)
        contrast -= depth * np.cos(r / 1.5) * np.exp(-((r / 4) ** 2))
    return contrast


def _movie(
    seed: int, *, contrast: np.ndarray | float = 0.0, power_noise: float = 0.01, level: float = 2e3
) -> tuple[Stack, np.ndarray]:
    """Make 30 + 20 frames with speckle and their laser power."""
    rng = np.random.default_rng(seed)
    power = 1 + power_noise * rng.standard_normal(50)
    light = level * np.random.default_rng(2).uniform(0.7, 1.3, SHAPE)
    frames = [
        rng.poisson(p * light * (1 + (contrast if t >= 30 else 0.0))) for t, p in enumerate(power)
    ]
    return Stack(np.array(frames, dtype="u2")), power


BEFORE, AFTER = (0, 30), (30, 50)
AS_IT_IS = {"power_normalization": False}
MEAN = BackgroundConfig(method="fixed")
MEDIAN = BackgroundConfig(method="median")
KNOWN = BackgroundConfig(method="known", level_e=2e3)


def test_sums_are_plain_sums() -> None:
    stack, _ = _movie(0)
    camera = Camera(gain_e_per_adu=2.0, offset_adu=10.0, read_noise_e=3.0)
    windows = measure_windows(stack, camera, (2, 12), (15, 40))
    electrons = 2.0 * (stack.counts.astype(float) - 10)
    np.testing.assert_allclose(windows.before_e, electrons[2:12].sum(axis=0))
    np.testing.assert_allclose(windows.after_e, electrons[15:40].sum(axis=0))
    assert (windows.n_before, windows.n_after) == (10, 25)
    assert (windows.frames_before, windows.frames_after) == ((2, 12), (15, 40))
    np.testing.assert_allclose(windows.read_variance_before_e2, 90.0)
    np.testing.assert_allclose(windows.read_variance_after_e2, 225.0)
    assert not windows.masked.any()


def test_background_frames_may_follow_the_fitted_ones() -> None:
    stack, _ = _movie(0)
    windows = measure_windows(stack, Camera(), (30, 50), (0, 30))
    np.testing.assert_allclose(windows.before_e, stack.counts[30:].sum(axis=0))


@pytest.mark.parametrize("known", [0.0, 0.05])
def test_frame_power_is_the_lasers(known: float) -> None:
    stack, power = _movie(3, power_noise=known)
    measured = measure_windows(stack, Camera(), BEFORE, AFTER).power
    expected = power / power[:30].mean()
    spread = np.sqrt(2 / (2e3 * np.prod(SHAPE)))
    assert np.abs(measured - expected).max() < 5 * spread


# ---- the ratio -------------------------------------------------------------------------------


def _ratio_pulls(
    seeds: range, *, contrast: np.ndarray, robust: bool, refine: bool = False
) -> np.ndarray:
    """Error of ρ in standard errors of counting."""
    pulls = []
    for seed in seeds:
        stack, power = _movie(seed, contrast=contrast)
        truth = power[30:].sum() / power[:30].sum()
        windows = measure_windows(stack, Camera(), BEFORE, AFTER)
        if refine:
            windows = refine_power(windows, contrast, additive=False)
        before, after = windows.before_e.sum(), windows.after_e.sum()
        ratio = windows.power_ratio if robust else after / before
        pulls.append((ratio / truth - 1) / np.sqrt(1 / before + 1 / after))
    return np.array(pulls)


def _assert_unbiased(pulls: np.ndarray, spread: float) -> None:
    assert abs(pulls.mean()) < SIGMAS * spread / np.sqrt(len(pulls))
    assert pulls.std() < spread * (1 + SIGMAS / np.sqrt(2 * len(pulls)))


def test_the_ratio_is_right_on_blank_frames() -> None:
    _assert_unbiased(_ratio_pulls(range(40), contrast=np.zeros(SHAPE), robust=True), 1.1)


def test_strong_particles_hardly_disturb_the_ratio() -> None:
    """Before anything is fitted: clipping takes off what is seen in single pixels."""
    contrast = _spots(0.4)
    pulls = _ratio_pulls(range(12), contrast=contrast, robust=True)
    naive = _ratio_pulls(range(12), contrast=contrast, robust=False)
    assert abs(naive.mean()) > 100
    assert abs(pulls.mean()) < 0.2 * abs(naive.mean())


def test_the_plain_ratio_of_totals_is_biased() -> None:
    """Control: the test below can fail."""
    with pytest.raises(AssertionError):
        _assert_unbiased(_ratio_pulls(range(40), contrast=_spots(0.05), robust=False), 1.1)


@pytest.mark.parametrize("depth", [0.05, 0.4])
def test_with_the_particles_explained_the_ratio_is_unbiased(depth: float) -> None:
    contrast = _spots(depth)
    pulls = _ratio_pulls(range(40), contrast=contrast, robust=True, refine=True)
    _assert_unbiased(pulls, 1.1)


def test_without_normalisation_the_frames_are_counted() -> None:
    stack, _ = _movie(0)
    windows = measure_windows(stack, Camera(), BEFORE, AFTER, MEAN.model_copy(update=AS_IT_IS))
    assert windows.power_ratio == 20 / 30


# ---- other backgrounds -------------------------------------------------------------------------


def test_the_median_forgets_a_visitor() -> None:
    stack, _ = _movie(4, power_noise=0.0)
    stack.counts[5:11, 20:24, 20:24] *= 3
    camera = Camera(offset_adu=7.0)
    windows = measure_windows(
        stack, camera, BEFORE, AFTER, MEDIAN.model_copy(update={"power_normalization": False})
    )
    expected = 30 * (np.median(stack.counts[:30], axis=0) - 7.0)
    np.testing.assert_allclose(windows.before_e, expected)
    mean = measure_windows(stack, camera, BEFORE, AFTER)
    assert mean.before_e[22, 22] > 1.2 * windows.before_e[22, 22]


@pytest.mark.parametrize("power_noise", [0.0, 0.05])
def test_the_median_scatters_as_a_median_of_shot_noise(power_noise: float) -> None:
    """Whatever the laser does: variance π/2 times that of the mean, and no bias."""
    stack, power = _movie(5, power_noise=power_noise)
    windows = measure_windows(stack, Camera(), BEFORE, AFTER, MEDIAN)
    light = 2e3 * np.random.default_rng(2).uniform(0.7, 1.3, SHAPE) * power[:30].sum()
    pulls = (windows.before_e - light) / np.sqrt(light * np.pi / 2)
    # The median of 30 is not yet that of infinitely many: 2 % less.
    assert pulls.std() == pytest.approx(1, abs=0.02 + SIGMAS / np.sqrt(2 * pulls.size))
    assert abs(pulls.mean()) < SIGMAS / np.sqrt(pulls.size) + 0.03


def test_a_known_background_needs_no_frames() -> None:
    stack, _ = _movie(5, power_noise=0.02)
    windows = measure_windows(stack, Camera(), None, AFTER, KNOWN)
    assert windows.n_before == 0
    assert windows.frames_before == (0, 0)
    np.testing.assert_array_equal(windows.before_e, 2e3)
    total = windows.after_e.sum()
    expected = total / (2e3 * np.prod(SHAPE))
    assert windows.power_ratio == pytest.approx(expected, rel=0.02)
    fixed = measure_windows(
        stack, Camera(), None, AFTER, KNOWN.model_copy(update={"power_normalization": False})
    )
    assert fixed.power_ratio == 20
    assert windows.power.size == 20


# ---- defects ---------------------------------------------------------------------------------


def test_dead_and_hot_pixels_are_masked() -> None:
    stack, _ = _movie(6)
    bad = np.zeros(SHAPE, dtype=bool)
    bad[0, 0] = bad[10, 20] = bad[47, 55] = True
    stack.counts[:, 10, 20] = 0
    stack.counts[:, 0, 0] = 20000
    stack.counts[:, 47, 55] = 3
    windows = measure_windows(stack, Camera(), BEFORE, AFTER)
    np.testing.assert_array_equal(windows.masked, bad)
    assert not windows.saturated.any()


def test_saturated_pixels_are_masked_even_for_one_frame() -> None:
    stack, _ = _movie(6)
    stack.counts[3, 4, 5] = 65535
    stack.counts[44, 6, 7] = 40000
    camera = Camera(full_scale_adu=65535.0, well_depth_e=39000.0)
    windows = measure_windows(stack, camera, BEFORE, AFTER)
    assert np.argwhere(windows.saturated).tolist() == [[4, 5], [6, 7]]
    assert windows.masked[4, 5]
    assert windows.masked[6, 7]


@pytest.mark.parametrize("level", [0.0, 0.02, 0.5])
@pytest.mark.parametrize("read_noise_e", [0.0, 2.0])
def test_the_noise_of_a_dark_background_is_no_defect(level: float, read_noise_e: float) -> None:
    """In dark field the background may be nothing but read noise and a few photons."""
    rng = np.random.default_rng(7)
    frames = rng.poisson(level, (50, *SHAPE)) + read_noise_e * rng.standard_normal((50, *SHAPE))
    frames[:, 30, 31] += 20.0  # a hot pixel
    camera = Camera(read_noise_e=read_noise_e)
    windows = measure_windows(Stack(frames), camera, BEFORE, AFTER)
    assert np.argwhere(windows.masked).tolist() == [[30, 31]]


def test_a_faint_background_is_averaged_and_a_bright_one_kept() -> None:
    rng = np.random.default_rng(8)
    nothing = np.zeros(SHAPE)
    masked = np.zeros(SHAPE, dtype=bool)
    masked[10, 20] = True
    faint = rng.poisson(3.0, SHAPE).astype(float)
    faint[10, 20] = 1e6
    smooth = smooth_background(faint, nothing, masked)
    assert np.abs(smooth - 3).max() < 2.5
    assert smooth.std() < 0.25 * np.sqrt(3)
    read = 5.0 * rng.standard_normal(SHAPE)
    assert (smooth_background(read, np.full(SHAPE, 25.0), ~masked) >= 0).all()
    bright = rng.poisson(1e6 * rng.uniform(0.7, 1.3, SHAPE)).astype(float)
    kept = smooth_background(bright, nothing, masked)
    np.testing.assert_allclose(kept[~masked], bright[~masked], rtol=1e-3)


# ---- ranges ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ((0, 60), (60, 70), "has 50 frames, but the background range asks for 0:60"),
        ((0, 30), (30, 51), "has 50 frames, but the fitted range asks for 30:51"),
        ((0, 30), (29, 50), "overlap"),
        ((10, 30), (0, 11), "overlap"),
        ((0, 50), (50, 50), "no frame is left"),
    ],
)
def test_impossible_ranges_are_refused(
    before: tuple[int, int], after: tuple[int, int], message: str
) -> None:
    stack, _ = _movie(0)
    with pytest.raises(DataError, match=message):
        measure_windows(stack, Camera(), before, after)


def test_every_frame_is_checked_and_counted_once() -> None:
    stack, _ = _movie(0)
    seen: list[int] = []
    steps: list[tuple[int, int]] = []
    measure_windows(
        stack, Camera(), BEFORE, AFTER,
        check=lambda counts, first: seen.extend(range(first, first + len(counts))),
        progress=lambda _, done, total: steps.append((done, total)),
    )  # fmt: skip
    assert seen == list(range(50))
    assert steps[-1] == (50, 50)


def test_the_full_scale_of_a_converter_is_saturation() -> None:
    """Twelve bits stored as sixteen."""
    stack, _ = _movie(6)
    clipped = Stack(np.minimum(stack.counts, np.quantile(stack.counts, 0.7)).astype(np.uint16))
    top = int(clipped.counts.max())
    shift = 4095 - top
    low = Stack((clipped.counts.astype(int) + shift).astype(np.uint16))
    camera = Camera(offset_adu=float(shift), full_scale_adu=65535.0)
    windows = measure_windows(low, camera, BEFORE, AFTER)
    frames = np.r_[slice(*BEFORE), slice(*AFTER)]
    np.testing.assert_array_equal(windows.saturated, (low.counts[frames] == 4095).any(axis=0))
    # Controls: another largest count, and one that a single pixel has by chance.
    other = measure_windows(Stack(low.counts - 1), camera, BEFORE, AFTER)
    assert not other.saturated.any()
    stack.counts[3, 4, 5] = 2 ** int(np.log2(stack.counts.max()) + 1) - 1
    assert not measure_windows(stack, Camera(full_scale_adu=65535.0), BEFORE, AFTER).saturated.any()


def test_defects_are_told_by_the_median_of_their_neighbours_everywhere() -> None:
    rng = np.random.default_rng(8)
    read = 4.0 * np.ones(SHAPE)
    bright = rng.poisson(2e3 * np.random.default_rng(2).uniform(0.7, 1.3, SHAPE)).astype(float)
    spoilt = bright.copy()
    for _ in range(40):  # singly and in groups, at edges and in corners too
        y, x = rng.integers(0, SHAPE[0]), rng.integers(0, SHAPE[1])
        spoilt[y : y + 2, x : x + 3] = rng.choice([0.0, -30.0, 1e5, 350.0, 11_000.0])
    spoilt[0, 0], spoilt[-1, -1] = 0.0, 1e6
    steep = 10 ** rng.uniform(0, 6, SHAPE)
    few = rng.poisson(1.0, SHAPE) + rng.normal(0, 2, SHAPE)
    for image in (bright, spoilt, steep, few, np.zeros(SHAPE)):
        local = np.maximum(median_filter(image, size=5, mode="nearest"), 0.0)
        steady, expected = (
            2 * np.sqrt(np.maximum(part + 0.375 + read, 0)) for part in (image, local)
        )
        off = (image < DEAD * local) | (image > HOT * local)
        wanted = off & (np.abs(steady - expected) > DEFECT_SIGMAS)
        np.testing.assert_array_equal(find_defects(image, read), wanted)
    assert find_defects(spoilt, read).sum() > 40
    assert not find_defects(bright, read).any()
