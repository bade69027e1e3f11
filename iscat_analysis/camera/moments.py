"""Mean and variance of every pixel of a stack, and pixels that are left out of them.

Mean and variance of every pixel of a stack, and its response to the laser.

Pixels that cannot be used: saturated, dead, hot, blinking.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera, full_scale_of
from iscat_analysis.errors import DataError
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import BoolArray, FloatArray, FrameSource

_TOGETHER = {"frames": (1, 2), "rows": (2,), "columns": (1,)}  # axes of (t, y, x)


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of one stack, per pixel [counts]."""

    mean: FloatArray
    variance: FloatArray
    slope: FloatArray
    slope_variance: FloatArray
    highest: NDArray[Any]
    lowest: NDArray[Any]
    n_frames: int

    @property
    def relative_se(self) -> float:
        """Standard error of one pixel's variance, relative (von Neumann et al., 1941)."""
        return math.sqrt(3 * self.n_frames - 4) / (self.n_frames - 1)


def blocks(stack: FrameSource) -> Iterator[tuple[int, int]]:
    """Divide a stack into ranges of frames that fit into memory."""
    frames, rows, columns = stack.shape
    # in doubles: what lies in a processor's cache takes no fresh memory
    size = max(2, (4 * 2**20) // (8 * rows * columns))
    for start in range(0, frames, size):
        yield start, min(start + size, frames)


def brightness_bins(mean: FloatArray) -> list[NDArray[np.intp]]:
    """Group pixels by brightness, equally many in each group.

    Shapes: `mean` (n,).
    """
    return np.array_split(np.argsort(mean), max(1, min(32, mean.size // 32)))


def moments_of(
    stack: FrameSource,
    used: BoolArray | None,
    advance: Callable[[int], None],
    *,
    flickering: str = "frames",
    jumps: BoolArray | None = None,
) -> Moments:
    """Measure mean and variance of every pixel; with `used`, the light's flicker is taken out.

    Differences of successive frames at `jumps` are left out.

    Notes
    -----
    Differences d_k of successive frames have the covariance v·(2, −1 beside the diagonal).  Their
    regression on the differences D_k of the mean over `used` takes away DᵀMD/DᵀD of the 2(K − 1)
    squares that are expected, with M that matrix; the mean carries 1/P of each pixel's noise, of
    which a pixel that follows it s times as strongly loses s/P.
    Where rows or columns flicker, the mean is that of each.

    Shapes: `used` (y, x), `jumps` (frames − 1,).
    """
    together = _TOGETHER[flickering]
    frames, rows, columns = stack.shape
    total = np.zeros((rows, columns))
    squares = np.zeros((rows, columns))
    product = np.zeros((rows, columns))
    highest = lowest = stack.read(0, 1)[0]
    flicker = []
    last: FloatArray | None = None
    for start, stop in blocks(stack):
        counts = stack.read(start, stop)
        if not np.isfinite(counts).all():
            raise DataError(
                f"{stack.name}: frames {start} to {stop - 1} hold NaN or infinity; give raw counts"
            )
        highest = np.maximum(highest, counts.max(axis=0))
        lowest = np.minimum(lowest, counts.min(axis=0))
        block = counts.astype(np.float64, copy=False)
        total += block.sum(axis=0)
        if last is not None:
            block = np.concatenate([last[np.newaxis], block])
        steps = np.diff(block, axis=0)
        if jumps is not None:
            first = max(start - 1, 0)
            steps[jumps[first : first + len(steps)]] = 0.0
        squares += np.einsum("kyx,kyx->yx", steps, steps)
        if used is not None:
            common = np.mean(steps, axis=together, keepdims=True, where=used)
            product += np.einsum("kyx,kyx->yx", np.broadcast_to(common, steps.shape), steps)
            flicker.append(common)
        last = block[-1]
        advance(stop - start)
    n = frames - 1 - (0 if jumps is None else int(np.count_nonzero(jumps)))
    mean = total / frames
    if used is None:
        still, certain = np.ones_like(mean), np.zeros_like(mean)
        return Moments(mean, squares / (2 * n), still, certain, highest, lowest, frames)
    common = np.concatenate(flicker)
    power = np.sum(common**2, axis=0)
    spread = 2 * power - 2 * np.sum(common[:-1] * common[1:], axis=0)
    if not power.any():
        raise DataError(
            f"{stack.name}: successive frames are identical: this is not raw camera data"
        )
    in_frame = tuple(axis - 1 for axis in together)
    pixels = np.sum(used, axis=in_frame, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):  # lines in which no pixel is used
        variance = (squares - product**2 / power) / (2 * n - spread / power)
        variance /= 1 - product / power / pixels
        own = 2 * n * variance / pixels
    slope_power = power - np.mean(own, axis=in_frame, keepdims=True, where=used)
    usable = bool(np.all(slope_power > 0.1 * power))  # else the flicker is the frames' own noise
    slope = (product - own) / slope_power if usable else np.full_like(mean, np.nan)
    slope_variance = variance * spread / slope_power**2 if usable else np.full_like(mean, np.nan)
    return Moments(mean, variance, slope, slope_variance, highest, lowest, frames)


KINDS = ("saturated", "clipped", "dead", "hot")
"""What may be wrong with a pixel."""

_OUTLIER_SIGMAS = 8.0


def saturated(highest: NDArray[Any], name: str) -> BoolArray:
    """Find saturated pixels: at the largest number of their type, or of an ADC of 8 to 16 bits.

    Shapes: `highest` (y, x), result (y, x).
    """
    top = float(highest.max())
    full = Camera(full_scale_adu=full_scale_of(highest.dtype)).saturated(highest)
    if full.mean() > 0.5:
        raise DataError(
            f"{name}: {100 * full.mean():.0f} % of the pixels are saturated (count {top:g}); "
            "lower the exposure or the laser power"
        )
    return full


def clipped(lowest: NDArray[Any]) -> BoolArray:
    """Find pixels that reached zero counts, below which nothing is stored.

    Shapes: `lowest` (y, x), result (y, x).
    """
    unsigned = np.issubdtype(lowest.dtype, np.unsignedinteger)
    return np.asarray((lowest == 0) & unsigned, dtype=np.bool_)


def stand_out(values: FloatArray) -> BoolArray:
    """Find pixels far above the others, in robust standard deviations.

    Shapes: `values` (y, x), result (y, x).
    """
    centre = float(np.median(values))
    spread = robust_sigma(values - centre)
    return np.asarray(values > centre + _OUTLIER_SIGMAS * max(spread, 1e-3), dtype=np.bool_)


def unsteady(found: Sequence[Moments], used: BoolArray) -> BoolArray:
    """Find pixels that blink, or over which a particle moved.

    Shapes: `used` (y, x), result (y, x).
    """
    out = np.zeros(used.shape, dtype=np.bool_)
    for item in found:
        variance, smooth = item.variance[used], np.empty(np.count_nonzero(used))
        for part in brightness_bins(item.mean[used]):
            smooth[part] = np.median(variance[part])
        out[used] |= variance > (1 + _OUTLIER_SIGMAS * item.relative_se) * smooth
    return out


def mask_notes(masked: Mapping[str, BoolArray]) -> list[str]:
    """Say how many pixels are left out, and where.

    Shapes: `masked` (y, x).
    """
    notes = []
    for name, mask in masked.items():
        count = int(mask.sum())
        if count:
            place = np.argwhere(mask)[0]
            notes.append(
                f"{count} of {mask.size} pixels {'is' if count == 1 else 'are'} {name} and left "
                f"out, the first at y = {place[0]}, x = {place[1]}"
            )
    return notes
