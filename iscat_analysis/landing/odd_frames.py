"""Warnings about dark, repeated and shifted frames of a landing movie."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.diagnosis.causes import pixel_warnings
from iscat_analysis.diagnosis.fixed_pattern import DRIFT_PX
from iscat_analysis.landing.merging import MergedChunks
from iscat_analysis.records import FloatArray
from iscat_analysis.units import listed

JUMP = 0.1
"""Relative change of the light from one frame to the next that is reported."""

LOST = 0.05
"""Share of the frames that may be left out without a word on what is missed by it."""


def frame_warnings(
    name: str,
    merged: MergedChunks,
    drift: list[float] | None,
    light: FloatArray,
    first: int,
    window: int,
    *,
    corrected: bool = False,
) -> Iterator[str]:
    """Warn of frames that were left out and of motion of the pattern.

    Shapes: `light` (t,).
    """
    missing = merged.repeats() + first
    if missing.size:
        verb = "is" if missing.size == 1 else "are"
        share = missing.size / light.size
        lost = f"; {share:.0%} of the movie, with what lands there, is lost" if share > LOST else ""
        yield (
            f"{name}: {_frames(missing)} {verb} dark, cut off, not finite or the same as "
            "the frame before (behind a shutter, dropped or stuck in the camera); left out, the "
            f"other frames are used{lost}"
        )
    known = np.flatnonzero(np.isfinite(light))
    change = light[known][1:] / light[known][:-1] - 1
    if change.size:
        usual = 1.4826 * float(np.median(np.abs(change)))
        jumps = known[1:][np.abs(change) > max(JUMP, 8 * usual)] + first
        if jumps.size:
            largest = 100 * float(change[np.argmax(np.abs(change))])
            yield (
                f"{name}: the brightness jumps at {_frames(jumps)} by up to {largest:+.0f} %; "
                "it is divided out, but look at the laser and at events in these frames"
            )
    yield from pixel_warnings(*merged.masks())
    yield from _drift_warnings(name, merged, drift, light.size / window, corrected)


def _drift_warnings(
    name: str, merged: MergedChunks, drift: list[float] | None, windows: float, corrected: bool
) -> Iterator[str]:
    """Say how the fixed pattern moved, and whether its motion was divided out."""
    way = merged.trajectory()
    if way is not None and drift is not None:
        yield (
            f"{name}: the fixed pattern moved by {drift[1]:+.3f} pixels in x and "
            f"{drift[0]:+.3f} in y; corrected, to ±{way.typical_error_px:.1g} pixels"
        )
    unfollowed = merged.unfollowed() if corrected else []
    if unfollowed:
        spans = ", ".join(f"{a}:{b}" for a, b in unfollowed[:4])
        yield (
            f"{name}: no fixed pattern stands out of the noise in frames {spans}"
            f"{' and more' if len(unfollowed) > 4 else ''}, so background.drift_correction has "
            "nothing to correct there"
        )
    if corrected or drift is None:
        return
    if math.hypot(*drift) > DRIFT_PX * max(windows / 2, 1.0):
        yield (
            f"{name}: the fixed pattern moved by {drift[1]:+.2f} pixels in x and "
            f"{drift[0]:+.2f} in y; it is not corrected: set background.drift_correction = true "
            "(shorter windows, background.window_frames, suffer less too)"
        )


def _frames(frames: NDArray[np.int64]) -> str:
    return f"frame{'' if frames.size == 1 else 's'} {listed(frames, 4)}"
