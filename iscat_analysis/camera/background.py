"""The image without particles: counts summed before and after landing, and the laser power.

Raw photoelectrons are summed, never rescaled frames, so the sums stay Poisson and the conditional
likelihood stays exact; the power enters only through ρ, total power after over before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from iscat_analysis.camera.counts import Camera
from iscat_analysis.config import BackgroundConfig
from iscat_analysis.errors import DataError
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress, Windows, silent
from iscat_analysis.units import count

DEAD, HOT = 0.2, 5.0
"""A pixel below or above these multiples of the median of its neighbours is left out."""

DEFECT_SIGMAS = 6.0
"""Unless noise alone could have put it there: dark backgrounds scatter by more than their mean."""

_NEIGHBOURS = 5  # pixels along each side, whose median tells what a pixel should hold
_BLOCK_BYTES = 16 * 2**20
_NEIGHBOURHOOD = 7  # pixels, on which a faint background is averaged for the weights
_MEAN = BackgroundConfig(method="fixed")
_LEAST_TOTAL_E = 1e6  # fewer background photoelectrons leave the power uncertain by over 0.1 %

Check = Callable[[NDArray[Any], int], None]


def _unchecked(counts: NDArray[Any], first: int) -> None:
    """Accept any counts."""


def measure_windows(
    stack: FrameSource,
    camera: Camera,
    before: tuple[int, int] | None,
    after: tuple[int, int],
    background: BackgroundConfig = _MEAN,
    *,
    check: Check = _unchecked,
    progress: Progress = silent,
) -> Windows:
    """Sum the frames before and after landing, as the section of the background says."""
    _check_ranges(stack, before, after, overlap=background.learnt_with_tracks)
    n_before, n_after = (span[1] - span[0] if span else 0 for span in (before, after))
    shape = stack.shape[1:]
    saturated = np.zeros(shape, dtype=np.bool_)
    totals: list[float] = []

    def summed(span: tuple[int, int]) -> FloatArray:
        sum_e = np.zeros(shape)
        for start, stop in _blocks(stack.shape, span):
            counts = stack.read(start, stop)
            check(counts, start)
            saturated[...] |= camera.saturated(counts).any(axis=0)
            electrons = camera.to_electrons(counts)
            sum_e += electrons.sum(axis=0)
            totals.extend(electrons.sum(axis=(1, 2)))
            progress("background", len(totals), n_before + n_after)
        return sum_e

    before_e = np.full(shape, background.level_e or 0.0) if before is None else summed(before)
    if before is not None and not (background.is_counted or background.is_known):
        power = np.array(totals)
        even = not background.power_normalization or power.min() <= 0
        before_e = n_before * _median(stack, camera, before, 1 + 0 * power if even else power)
    after_e = summed(after)
    power, variance = np.array(totals), camera.read_variance_e2(shape)
    level = power[: n_before or None].mean()
    windows = Windows(
        before_e=before_e,
        after_e=after_e,
        n_before=n_before,
        n_after=n_after,
        power_ratio=n_after / max(n_before, 1),
        read_variance_before_e2=n_before * variance,
        read_variance_after_e2=n_after * variance,
        masked=saturated | find_defects(before_e, n_before * variance),
        saturated=saturated,
        frames_before=before or (0, 0),
        frames_after=after,
        power=power / level if level > 0 else np.ones(power.size),
    )
    return start_power(windows) if background.power_normalization else windows


def add_frames(windows: Windows, camera: Camera, counts: NDArray[Any], first: int) -> Windows:
    """Replace the frames after landing.

    Shapes: `counts` (t, y, x).
    """
    n = len(counts)
    electrons = camera.to_electrons(counts)
    saturated: BoolArray = np.any(camera.saturated(counts), axis=0)
    variance = camera.read_variance_e2((counts.shape[1], counts.shape[2]))
    return replace(
        windows,
        after_e=electrons.sum(axis=0),
        n_after=n,
        power_ratio=n / max(windows.n_before, 1),
        read_variance_after_e2=n * variance,
        masked=(windows.masked & ~windows.saturated) | saturated,
        saturated=saturated,
        frames_after=(first, first + n),
    )


def start_power(windows: Windows) -> Windows:
    """Estimate ρ from pixels that no particle has changed noticeably."""
    used = ~windows.masked
    after, before = windows.after_e[used], windows.before_e[used]
    if before.sum() < _LEAST_TOTAL_E or after.sum() <= 0:
        return windows
    counted = windows.n_before > 0
    kept = np.ones(after.shape, dtype=np.bool_)
    ratio = after.sum() / before.sum()
    for _ in range(20):
        variance = ratio * before * (1 + counted * ratio) + windows.read_variance_after_e2[used]
        off = np.abs(after - ratio * before) / np.sqrt(np.maximum(variance, 1.0))
        kept_now = off < 3.0 * max(1.0, robust_sigma(off[kept]))  # robust standard deviations
        if np.array_equal(kept_now, kept) or kept_now.sum() < 0.1 * kept.size:
            break
        kept = kept_now
        ratio = after[kept].sum() / before[kept].sum()
    return replace(windows, power_ratio=float(ratio)) if math.isfinite(ratio) else windows


def refine_power(windows: Windows, explained: FloatArray, *, additive: bool) -> Windows:
    """Estimate ρ again, over the fitted particles.

    Shapes: `explained` (y, x).
    """
    used = ~windows.masked
    if additive:
        # a tenth of the light or more is a particle
        used &= explained < 0.1 * windows.power_ratio * windows.before_e
    if windows.before_e[used].sum() < _LEAST_TOTAL_E:
        return windows
    after, before = windows.after_e[used], windows.before_e[used]
    if additive:
        ratio = (after.sum() - explained[used].sum()) / before.sum()
    else:
        ratio = after.sum() / (before * (1 + explained[used])).sum()
    return replace(windows, power_ratio=float(ratio))


def smooth_background(
    before_e: FloatArray, variance_e2: FloatArray, masked: BoolArray
) -> FloatArray:
    """Smooth a background whose counts per pixel are too few.

    With weights from a pixel's own fluctuating background, pixels that happened to be dark before
    get too much weight, and seem to have brightened.

    Notes
    -----
    The adaptive filter of J. S. Lee, IEEE Trans. Pattern Anal. 2, 165 (1980).

    Shapes: `before_e` (y, x), `variance_e2` (y, x), `masked` (y, x), result (y, x).
    """
    used = (~masked).astype(np.float64)
    share = np.maximum(uniform_filter(used, _NEIGHBOURHOOD, mode="nearest"), 1e-3)
    mean = uniform_filter(before_e * used, _NEIGHBOURHOOD, mode="nearest") / share
    apart = (before_e - mean) * used
    spread = uniform_filter(apart**2, _NEIGHBOURHOOD, mode="nearest") / share
    noise = np.maximum(mean, 0.0) + variance_e2
    structure = np.clip(1 - 2 * noise / np.maximum(spread, 1e-300), 0.0, 1.0)
    smooth: FloatArray = np.maximum(mean + structure * apart, 0.0)
    return smooth


def _check_ranges(
    stack: FrameSource, before: tuple[int, int] | None, after: tuple[int, int], *, overlap: bool
) -> None:
    frames = stack.shape[0]
    for name, key, span in (
        ("background", "background.frames", before),
        ("fitted", "fit.frames", after),
    ):
        if span is not None and span[1] > frames:
            raise DataError(
                f"{stack.name}: has {count(frames, 'frame')}, but the {name} range asks for "
                f"{span[0]}:{span[1]}; change {key}"
            )
    if after[1] <= after[0]:
        raise DataError(
            f"{stack.name}: no frame is left after the background; they end "
            f"at {frames}; set background.frames or fit.frames"
        )
    if not overlap and before is not None and before[0] < after[1] and after[0] < before[1]:
        raise DataError(
            f"{stack.name}: background frames {before[0]}:{before[1]} overlap the fitted frames "
            f"{after[0]}:{after[1]}; change background.frames or fit.frames"
        )


def _blocks(shape: tuple[int, int, int], span: tuple[int, int]) -> list[tuple[int, int]]:
    size = max(1, _BLOCK_BYTES // (8 * shape[1] * shape[2]))
    return [(a, min(a + size, span[1])) for a in range(span[0], span[1], size)]


def _median(
    stack: FrameSource, camera: Camera, span: tuple[int, int], power: FloatArray
) -> FloatArray:
    """Per-pixel median over the frames, a band of rows at a time, each frame over its power."""
    _, rows, columns = stack.shape
    band = max(1, _BLOCK_BYTES // (8 * power.size * columns))
    level = (power / power.mean())[:, None, None]
    out = np.empty((rows, columns))
    for top in range(0, rows, band):
        electrons = [
            camera.to_electrons(stack.read(start, stop))[:, top : top + band]
            for start, stop in _blocks(stack.shape, span)
        ]
        out[top : top + band] = np.median(np.concatenate(electrons) / level, axis=0)
    return out


def find_defects(before_e: FloatArray, read_variance_e2: FloatArray) -> BoolArray:
    """Find dead and hot pixels: far from the median of their neighbours, beyond noise.

    Shapes: `before_e` (y, x), `read_variance_e2` (y, x), result (y, x).
    """
    local = _usual(before_e)
    off = (before_e < DEAD * local) | (before_e > HOT * local)
    # Anscombe's transform makes the noise 1 at every level, a few counts included.
    steady, expected = (
        2 * np.sqrt(np.maximum(counts + 0.375 + read_variance_e2, 0.0))
        for counts in (before_e, local)
    )
    return np.asarray(off & (np.abs(steady - expected) > DEFECT_SIGMAS))


def unlike_neighbours(light: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Find pixels that are far darker, and such that are far brighter, than their neighbours.

    Shapes: `light` (y, x), results (y, x).
    """
    local = _usual(light)
    return (light < DEAD * local) & (local > 0), (light > HOT * local) & (local > 0)


def _usual(light: FloatArray) -> FloatArray:
    """Median of the neighbours of pixels that may be far from it; the others as they are.

    A median lies between the lowest and the highest of its neighbours, which are found sooner.
    """
    lowest, highest = (
        np.maximum(extreme(light, size=_NEIGHBOURS, mode="nearest"), 0.0)
        for extreme in (minimum_filter, maximum_filter)
    )
    doubtful = (light < DEAD * highest) | (light > HOT * lowest)
    padded = np.pad(light, _NEIGHBOURS // 2, mode="edge")
    around = sliding_window_view(padded, (_NEIGHBOURS, _NEIGHBOURS))[doubtful]
    usual = light.copy()
    usual[doubtful] = np.maximum(np.median(around.reshape(-1, _NEIGHBOURS**2), axis=1), 0.0)
    return usual
