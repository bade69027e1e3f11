"""Blocks of frames: how long a movie of moving particles may have one background.

The background of a block of T frames is known to its counting noise, of every pixel the variance
1/(B T) of its relative light.  Where the stage drifts, the light is that of no frame: the pattern's
shift s(t) leaves in a frame the relative change ∇B·(s(t) − s̄)/B, on average over the block the
variance ∇Bᵀ V(T) ∇B/B², V the covariance of s within a block.  Of these two the second is

    C(T) = T Σ_ij K_ij V_ij(T),   K_ij = ⟨∂_i B ∂_j B/B⟩ over the pixels,

times the first.  A steady velocity v has V = v² T²/12, so that both are equal, C = 1, where
T³ = 12/(K v²); blocks are longer by a factor of 1.7, `MOST_DRIFT_OVER_COUNTING`.

In the noise curve of landing movies, the variance between neighbouring averages of n frames over
that of the light, the same drift is 1 + K v² n³/2.  But the curve is no measure of it here: where
particles cover the field all the time, averages differ by the particles in them.  The shift is that
of all pixels together, and particles hardly pull at it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import Camera, Trajectory, find_defects, follow_pattern, trusted
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.records import BoolArray, FloatArray, FrameSource, Mapper
from iscat_analysis.tracking.moving_field import LEAST_FRAMES

BYTES = 16
"""Of memory for each pixel and frame of a block: counts, picture, slopes of the particles."""

SHORTEST = 25
"""Frames of a block at least, where drift makes it short: in fewer, particles hardly leave where
they are, and are taken for background."""

MOST_DRIFT_OVER_COUNTING = 5.0
"""Drift over counting noise, C, that a block may have.  A particle pays more for counting noise
than a pixel does: it stays at a place for many frames and makes the same error in all of them,
while the errors that a steady drift makes before and after the middle of a block cancel."""

_SUMS = 64  # of frames, at most, between which the pattern is followed
_LEAST_SUM = 20  # frames in each: particles in them pull at the pattern less, the more there are
_SUMS_SHARE = 0.25  # of compute.memory_limit_mb, for these sums
_READ = 64  # frames read at a time
_SMALLEST_PX = 32  # side of a field in which a pattern is followed


@dataclass(frozen=True)
class Plan:
    """How a movie is divided."""

    spans: tuple[tuple[int, int], ...]
    moved_px: tuple[float, float] | None = None
    drift_over_counting: float | None = None
    drifts: bool = False

    @property
    def frames(self) -> int:
        """Frames of the longest block."""
        return max(last - first for first, last in self.spans)

    @property
    def summary(self) -> dict[str, Any]:
        """What ``summary.json`` says of them, under ``"blocks"``."""
        return {
            "number": len(self.spans),
            "frames": self.frames,
            "drift_px": None if self.moved_px is None else list(self.moved_px),
            "drift_over_counting": self.drift_over_counting,
        }

    def message(self, name: str) -> str:
        """Say why there are several blocks; empty where that needs no message."""
        if not self.drifts or self.moved_px is None or self.drift_over_counting is None:
            return ""
        y, x = self.moved_px
        text = (
            f"{name}: the fixed pattern moves, by {x:+.3f} pixels in x and {y:+.3f} in y in all; "
            f"{len(self.spans)} blocks of {self.frames} frames have backgrounds of their own"
        )
        if self.drift_over_counting > MOST_DRIFT_OVER_COUNTING:
            text += (
                f", which still change by {self.drift_over_counting:.2g} times their counting "
                "noise: masses scatter more than their errors say; let the stage settle, or record "
                "faster"
            )
        return text


def plan_blocks(
    movie: FrameSource,
    config: Config,
    camera: Camera,
    *,
    check: Callable[[NDArray[Any], int], None],
    span: tuple[int, int] | None = None,
    mapper: Mapper = map,
) -> Plan:
    """Divide a movie into blocks of frames that have a background each."""
    first, last = span or fitted_frames(movie, config)
    frames, pixels = last - first, movie.shape[1] * movie.shape[2]
    room = int(config.compute.memory_limit_mb * 1e6) // (BYTES * pixels)
    given = None if config.track.block_frames == "auto" else config.track.block_frames
    longest = given or max(room, LEAST_FRAMES)
    count = max(1, min(math.ceil(frames / longest), frames // LEAST_FRAMES))
    needed = math.ceil(frames / count)
    if needed > room and frames >= LEAST_FRAMES:
        advice = "raise it" if given is None else "raise it, or lower track.block_frames"
        raise DataError(
            f"{movie.name}: a block of {needed} frames takes {BYTES * needed * pixels / 1e6:.0f} "
            "MB of memory, more than compute.memory_limit_mb = "
            f"{config.compute.memory_limit_mb}: {advice}"
        )
    if given is not None or frames < 2 * SHORTEST or min(movie.shape[1:]) < _SMALLEST_PX:
        return Plan(_spans(first, last, count))
    motion, stiffness = follow_light(
        movie, camera, (first, last), config, check=check, mapper=mapper
    )
    if motion is None:
        return Plan(_spans(first, last, count))
    shift = motion.at(np.arange(first, last, dtype=float))
    moved = (float(shift[-1, 0] - shift[0, 0]), float(shift[-1, 1] - shift[0, 1]))
    unrest = float(np.sum(stiffness * jitter_covariance(motion.shift_px)))

    def cost_of(count: int) -> float:
        whole = drift_over_counting(shift, stiffness, _spans(0, frames, count))
        return max(whole - unrest * frames / count, 0.0)

    least, most, cost = count, max(count, frames // SHORTEST), cost_of(count)
    while cost > MOST_DRIFT_OVER_COUNTING and count < most:
        count += 1
        cost = cost_of(count)
    return Plan(_spans(first, last, count), moved, cost, count > least)


def drift_over_counting(
    shift_px: FloatArray, stiffness: FloatArray, spans: tuple[tuple[int, int], ...]
) -> float:
    """Compare what drift makes of backgrounds with their counting noise.

    Shapes: `shift_px` (t, 2), `stiffness` (2, 2).
    """
    total = sum(
        (b - a) ** 2 * float(np.sum(stiffness * np.cov(shift_px[a:b].T, bias=True)))
        for a, b in spans
    )
    return total / sum(b - a for a, b in spans)


def follow_light(
    movie: FrameSource,
    camera: Camera,
    span: tuple[int, int],
    config: Config,
    *,
    check: Callable[[NDArray[Any], int], None],
    mapper: Mapper = map,
) -> tuple[Trajectory | None, FloatArray]:
    """Measure how the fixed pattern moves through a movie, and its stiffness per squared pixel.

    Shapes: `stiffness` (2, 2).
    """
    first, last = span
    shape = (movie.shape[1], movie.shape[2])
    most = int(_SUMS_SHARE * config.compute.memory_limit_mb * 1e6 / (8 * math.prod(shape)))
    count = max(2, min(_SUMS, most, (last - first) // _LEAST_SUM))
    spans = _spans(first, last, count)
    sums, saturated = np.zeros((count, *shape)), np.zeros(shape, dtype=bool)

    def add_up(part: int) -> BoolArray:
        full = np.zeros(shape, dtype=np.bool_)
        for start in range(*spans[part], _READ):
            raw = movie.read(start, min(start + _READ, spans[part][1]))
            check(raw, start)
            full |= camera.saturated(raw).any(axis=0)
            sums[part] += len(raw) * camera.to_electrons(raw.mean(axis=0))
        return full

    for full in mapper(add_up, range(count)):
        saturated |= full
    read = np.broadcast_to(camera.read_variance_e2(shape), shape)
    usable = ~(saturated | find_defects(sums.sum(axis=0), (last - first) * read))
    light = sums[:, usable].mean(axis=1) if usable.any() else np.zeros(count)
    lengths = np.array([high - low for low, high in spans])
    if not light.sum() > 0:
        return None, np.zeros((2, 2))
    power = light * lengths.sum() / light.sum()
    middle = np.array([(low + high - 1) / 2 for low, high in spans])
    motion = follow_pattern(sums, power, middle, usable, read, mapper=mapper)
    inside = trusted(usable)
    if motion is None or not inside.any() or not np.isfinite(motion.shift_px).all():
        return None, np.zeros((2, 2))
    return motion, _stiffness(sums / lengths[:, None, None], read, inside, lengths)


def _stiffness(
    means_e: FloatArray, read_e2: FloatArray, used: NDArray[np.bool_], frames: NDArray[np.int64]
) -> FloatArray:
    """Mean of ∂_i B ∂_j B/(B + read noise) over pixels and averages, without that of noise."""
    total = np.zeros((2, 2))
    for mean, n in zip(means_e, frames, strict=True):
        slopes = np.reshape(np.gradient(mean), (2, -1))
        weight = (used / np.maximum(mean + read_e2, 1.0)).ravel()
        total += (slopes * weight) @ slopes.T / used.sum()
        total -= np.eye(2) / (2 * n)  # half the difference of two pixels has half their variance
    return total / len(means_e)


def jitter_covariance(shift_px: FloatArray) -> FloatArray:
    """Covariance (2, 2) of errors of single shifts, such as bright particles make.

    It is that of second differences over 6, in which a steady drift does not show.
    """
    second_difference = np.diff(shift_px, n=2, axis=0)
    return second_difference.T @ second_difference / (6 * max(len(second_difference), 1))


def _spans(first: int, last: int, count: int) -> tuple[tuple[int, int], ...]:
    """Divide a range of frames into parts of equal length."""
    edges = [first + (last - first) * k // count for k in range(count + 1)]
    return tuple(pairwise(edges))
