"""Noise of averages, and the window that follows from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import Camera
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import FloatArray

SHORTEST_WINDOW = 10
"""Frames that it must have at least."""

SHORTEST_MOVIE = 4 * SHORTEST_WINDOW
"""Frames of the shortest movie for which windows are chosen."""

_LENGTHS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100)
_PARTS = 4  # of a field, which a pattern that moves has in common
_ROWS = 16  # on which the noise is measured
_ROWS_TOGETHER = 64  # the same beside what the pattern's motion makes, of which slopes tell


@dataclass(frozen=True)
class NoiseCurve:
    """Noise of the contrast between neighbouring averages, against their length."""

    frames: tuple[int, ...]
    variance_over_shot: tuple[float, ...]

    @property
    def shot_limited(self) -> int:
        """Longest average that is shot-noise limited, and every shorter one too; 0 for none."""
        limit = 0
        for n, ratio in zip(self.frames, self.variance_over_shot, strict=True):
            # Noise variance over shot noise up to which averaging is called shot-noise limited.
            if ratio > 1.2 * max(1.0, self.variance_over_shot[0]):
                break
            limit = n
        return limit

    def at(self, length: int) -> float:
        """Noise variance over shot noise of averages of a length."""
        return float(np.interp(length, self.frames, self.variance_over_shot))

    @property
    def best(self) -> int:
        """Length whose contrast is least noisy."""
        noise = [r / n for n, r in zip(self.frames, self.variance_over_shot, strict=True)]
        return self.frames[int(np.argmin(noise))]


def measure_noise(
    counts: NDArray[Any], camera: Camera, longest: int, *, follows: bool = False
) -> NoiseCurve:
    """Noise of averages over frames, as the Allan deviation has it: neighbours are compared.

    Notes
    -----
    D. W. Allan, Proc. IEEE 54, 221 (1966).  Variances are from the median deviation, so that
    particles, which cover few pixels at a time, do not count as noise.

    Shapes: `counts` (t, y, x).
    """
    strip = _Strip.of(counts, camera, adjacent=follows)
    lengths = sorted({*_LENGTHS[:-1], max(longest, 1)})
    lengths = [n for n in lengths if n <= longest and 2 * n <= len(counts)]
    found = (strip.compared(length)[1 if follows else 0] for length in lengths)
    return NoiseCurve(tuple(lengths), tuple(found))


def measure_motion(counts: NDArray[Any], camera: Camera, length: int) -> float:
    """Noise of averages that motion of the fixed pattern makes.

    Shapes: `counts` (t, y, x).
    """
    return _Strip.of(counts, camera, adjacent=True).compared(length)[2]


@dataclass(frozen=True)
class _Strip:
    """Some rows of all frames, and their camera."""

    counts: NDArray[Any]
    gain: FloatArray
    offset: FloatArray
    read: FloatArray
    adjacent: bool

    @classmethod
    def of(cls, counts: NDArray[Any], camera: Camera, *, adjacent: bool) -> _Strip:
        """Select rows from the whole field, or adjacent ones."""
        height = counts.shape[1]
        rows: Any = np.linspace(0, height - 1, min(_ROWS, height)).astype(int)
        if adjacent:
            first = max(height - _ROWS_TOGETHER, 0) // 2
            rows = slice(first, first + _ROWS_TOGETHER)
        shape = (height, counts.shape[2])
        gain, offset = (
            np.broadcast_to(v, shape)[rows] for v in (camera.gain_e_per_adu, camera.offset_adu)
        )
        return cls(counts[:, rows], gain, offset, camera.read_variance_e2(shape)[rows], adjacent)

    def compared(self, n: int) -> tuple[float, float, float]:
        """Variances of the difference of neighbouring averages of n frames, over shot noise.

        That of the contrast, the same without motion, and that of motion by least squares, which
        know it better than their difference; motion can be measured in adjacent rows only.
        """
        blocks = 2 * min(len(self.counts) // (2 * n), 8)
        parts = self.counts[: blocks * n].reshape(blocks, n, *self.counts.shape[1:])
        sums = self.gain * (parts.sum(axis=1, dtype=np.float64) - n * self.offset)
        lit = np.all(sums > 0, axis=0)
        before, after = np.where(lit, sums[0::2], 1.0), np.where(lit, sums[1::2], 1.0)
        power, level = (part.sum(axis=(1, 2), keepdims=True, where=lit) for part in (after, before))
        contrast = after / (power / level * before) - 1
        read = n * self.read
        sigma = np.sqrt((before + read) / before**2 + (after + read) / after**2)
        change = (contrast / sigma)[:, lit]
        noise = robust_sigma(change) ** 2
        if not self.adjacent:
            return noise, math.nan, math.nan
        light = before + after
        # pixels, whose differences make up the slope of a fine pattern
        steps = ((reach, axis) for axis in (1, 2) for reach in (1, 2, 3, 4))
        slopes = np.stack([_across(light, *step) / light for step in steps])
        seen = np.moveaxis(slopes[:, :, lit] / sigma[:, lit], 0, -1)  # (pair, pixel, slope)
        # standard deviations, from which on a difference is not asked of motion
        usual = np.abs(change) < 4.0 * math.sqrt(noise)
        turned = np.swapaxes(seen * usual[..., None], 1, 2)
        moved = np.linalg.pinv(turned @ seen, hermitian=True) @ (turned @ change[..., None])
        motion = _shared_motion(change, seen, turned, np.nonzero(lit)[1])
        motion /= max(int(np.count_nonzero(usual)), 1)
        return noise, robust_sigma(change - (seen @ moved)[..., 0]) ** 2, motion


def _shared_motion(
    change: FloatArray, seen: FloatArray, turned: FloatArray, column: NDArray[np.int64]
) -> float:
    """Give the χ² that a motion of the whole field explains.

    A bright particle changes the light like an edge that moved, but differently in every part of
    the field.  So the motion that each part tells is asked to explain each other part, and the
    median of these pairs counts.

    Shapes: `change` (pair, pixel), `seen` (pair, pixel, slope), `turned` (pair, slope, pixel),
    `column` (pixel,).
    """
    parts = np.array_split(np.argsort(column, kind="stable"), _PARTS)
    projection = np.stack([turned[..., part] @ change[:, part, None] for part in parts])
    information = np.stack([turned[..., part] @ seen[:, part] for part in parts])
    moved = np.linalg.pinv(information, hermitian=True) @ projection
    explained = [
        np.sum(moved[one] * (2 * projection[other] - information[other] @ moved[one]))
        for one, other in permutations(range(_PARTS), 2)
    ]
    by_chance = float(projection[0].size)  # of which noise takes so much away
    return _PARTS * (float(np.median(explained)) + by_chance)


def _across(images: FloatArray, reach: int, axis: int) -> FloatArray:
    """Differences between the neighbours of each pixel along an axis."""
    at = np.arange(images.shape[axis])
    after, before = (images.take(np.clip(at + step, 0, at[-1]), axis) for step in (reach, -reach))
    return np.asarray(after - before)


def choose_window(curve: NoiseCurve, frames: int) -> int:
    """Choose the window from the noise."""
    return max(SHORTEST_WINDOW, min(curve.best, longest_window(frames)))


def longest_window(frames: int) -> int:
    """Longest window that is chosen for a movie: a tenth of it, in which events seldom overlap."""
    return max(SHORTEST_WINDOW, min(100, frames // 10))
