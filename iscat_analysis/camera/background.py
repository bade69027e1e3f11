"""The image without particles: counts summed before and after landing, and the laser power.

Raw photoelectrons are summed, never rescaled frames, so the sums stay Poisson and the conditional
likelihood stays exact; the power enters only through ρ, total power after over before.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from iscat_analysis.camera.counts import Camera
from iscat_analysis.errors import DataError
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Progress, Windows, silent
from iscat_analysis.units import count

DEAD, HOT = 0.2, 5.0
"""A pixel below or above these multiples of its neighbourhood's median is masked."""

DEFECT_SIGMAS = 6.0
"""Unless noise alone could have put it there: dark backgrounds scatter by more than their mean."""

_BLOCK_BYTES = 16 * 2**20
_NEIGHBOURS = 5  # pixels along each side, whose median tells what a pixel should hold
_NEIGHBOURHOOD = 7  # pixels, on which a faint background is averaged for the weights
_LEAST_TOTAL_E = 1e6  # fewer background photoelectrons leave the power uncertain by over 0.1 %

Check = Callable[[NDArray[Any], int], None]


def _unchecked(counts: NDArray[Any], first: int) -> None:
    """Accept any counts."""


@dataclass(frozen=True)
class _Sum:
    total_e: FloatArray
    frame_totals_e: FloatArray
    saturated: BoolArray


def measure_windows(
    stack: FrameSource,
    camera: Camera,
    before: tuple[int, int] | None,
    after: tuple[int, int],
    *,
    median: bool = False,
    level_e: float | None = None,
    power_normalization: bool = True,
    overlap: bool = False,
    check: Check = _unchecked,
    progress: Progress = silent,
) -> Windows:
    """Sum the frames before and after landing; `overlap` lets them be the same."""
    _check_ranges(stack, before, after, overlap=overlap)
    n_after = after[1] - after[0]
    total = n_after + (before[1] - before[0] if before else 0)
    shape = stack.shape[1:]
    variance = camera.read_variance_e2(shape)
    if before is None:
        first = _Sum(
            np.full(shape, float(level_e or 0.0)), np.empty(0), np.zeros(shape, dtype=bool)
        )
        n_before, start = 0, 0
    else:
        n_before = start = before[1] - before[0]
        first = _sum_frames(stack, camera, before, check, progress, 0, total)
        if median:
            totals = first.frame_totals_e
            level = totals / totals.mean() if power_normalization and totals.min() > 0 else None
            first = replace(first, total_e=n_before * _median(stack, camera, before, level))
    second = _sum_frames(stack, camera, after, check, progress, start, total)
    saturated = first.saturated | second.saturated
    masked = saturated | find_defects(first.total_e, n_before * variance)
    windows = Windows(
        before_e=first.total_e,
        after_e=second.total_e,
        n_before=n_before,
        n_after=n_after,
        power_ratio=n_after / max(n_before, 1),
        read_variance_before_e2=n_before * variance,
        read_variance_after_e2=n_after * variance,
        masked=masked,
        saturated=saturated,
        frames_before=before or (0, 0),
        frames_after=after,
        power=_frame_power(first.frame_totals_e, second.frame_totals_e),
    )
    return start_power(windows) if power_normalization else windows


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
    return replace(windows, power_ratio=_robust_ratio(windows))


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


def _sum_frames(
    stack: FrameSource,
    camera: Camera,
    span: tuple[int, int],
    check: Check,
    progress: Progress,
    done: int,
    total: int,
) -> _Sum:
    sum_e = np.zeros(stack.shape[1:])
    saturated = np.zeros(stack.shape[1:], dtype=bool)
    totals = []
    for start, stop in _blocks(stack.shape, span):
        counts = stack.read(start, stop)
        check(counts, start)
        saturated |= camera.saturated(counts).any(axis=0)
        electrons = camera.to_electrons(counts)
        sum_e += electrons.sum(axis=0)
        totals.append(electrons.sum(axis=(1, 2)))
        progress("background", done + stop - span[0], total)
    return _Sum(sum_e, np.concatenate(totals), saturated)


def _median(
    stack: FrameSource, camera: Camera, span: tuple[int, int], power: FloatArray | None
) -> FloatArray:
    """Per-pixel median over the frames, a band of rows at a time, each frame over its power."""
    _, rows, columns = stack.shape
    frames = span[1] - span[0]
    band = max(1, _BLOCK_BYTES // (8 * frames * columns))
    level = (np.ones(frames) if power is None else power)[:, None, None]
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
    # a median lies between the lowest and the highest of its neighbours, which are found sooner
    lowest, highest = (
        np.maximum(extreme(before_e, size=_NEIGHBOURS, mode="nearest"), 0.0)
        for extreme in (minimum_filter, maximum_filter)
    )
    doubtful = np.nonzero((before_e < DEAD * highest) | (before_e > HOT * lowest))
    padded = np.pad(before_e, _NEIGHBOURS // 2, mode="edge")
    around = sliding_window_view(padded, (_NEIGHBOURS, _NEIGHBOURS))[doubtful]
    median = np.median(around.reshape(len(around), _NEIGHBOURS**2), axis=1)
    own, local = before_e[doubtful], np.maximum(median, 0.0)
    off = (own < DEAD * local) | (own > HOT * local)
    # Anscombe's transform makes the noise 1 at every level, a few counts included.
    read = np.broadcast_to(read_variance_e2, before_e.shape)[doubtful]
    steady, expected = (
        2 * np.sqrt(np.maximum(counts + 0.375 + read, 0.0)) for counts in (own, local)
    )
    defects = np.zeros(before_e.shape, dtype=np.bool_)
    defects[doubtful] = off & (np.abs(steady - expected) > DEFECT_SIGMAS)
    return defects


def _frame_power(before_e: FloatArray, after_e: FloatArray) -> FloatArray:
    everything = np.concatenate([before_e, after_e])
    level = before_e.mean() if before_e.size else after_e.mean()
    return everything / level if level > 0 else np.ones(everything.size)


def _robust_ratio(windows: Windows) -> float:
    """ρ from the pixels that no particle has changed noticeably."""
    used = ~windows.masked
    after, before = windows.after_e[used], windows.before_e[used]
    if before.sum() < _LEAST_TOTAL_E or after.sum() <= 0:
        return windows.power_ratio
    known = windows.n_before == 0
    kept = np.ones(after.shape, dtype=bool)
    ratio = after.sum() / before.sum()
    for _ in range(20):
        variance = ratio * before * (1 + (0 if known else ratio))
        variance = variance + windows.read_variance_after_e2[used]
        off = np.abs(after - ratio * before) / np.sqrt(np.maximum(variance, 1.0))
        clip = 3.0 * max(1.0, robust_sigma(off[kept]))  # robust standard deviations
        kept_now = off < clip
        if np.array_equal(kept_now, kept) or kept_now.sum() < 0.1 * kept.size:
            break
        kept = kept_now
        ratio = after[kept].sum() / before[kept].sum()
    return float(ratio) if math.isfinite(ratio) else windows.power_ratio
