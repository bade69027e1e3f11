"""Motion of the fixed pattern of the light, by the stage or between two sums.

Motion of the stage, as the fixed pattern shows it before anything is searched.

Noise of the background frames, and how far the fixed pattern of the light moved.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from iscat_analysis.camera import Camera, follow_pattern
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.noise import NoiseSurvey, first_counts, is_lit
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import PATTERN_MOVED
from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.movie import Stack
from iscat_analysis.records import FloatArray, Windows
from iscat_analysis.search.frames import good_frames, well_lit
from iscat_analysis.search.noise import measure_motion, measure_noise


def with_drift_correction(config: Config, *, moves: bool) -> Config:
    """Set in the configuration whether the motion of the fixed pattern is divided out."""
    background = config.background.model_copy(update={"drift_correction": moves})
    return config.model_copy(update={"background": background})


def motion_in(opening: NoiseSurvey) -> str:
    """Say that the fixed pattern of a landing movie moves; empty where it does not."""
    if opening.noise.shakes:
        return "the fixed pattern shakes"
    reader, length = opening.reader.sampled, opening.curve.frames[-1]
    last = reader.read(max(reader.first, reader.last - 2 * length), reader.last)
    last = last[good_frames(last, reader.camera)]
    share = max(
        measure_motion(counts, reader.camera, min(length, len(counts) // 2))
        for counts in (reader.opening(), last)
        if len(counts) >= 2
    )
    if not share > 0.03:  # noise alone adds 1e-3
        return ""
    return (
        f"the fixed pattern moves: averages of {length} frames differ by {1 + share:.3g} times "
        "what they would otherwise"
    )


DRIFT_PX = 0.02
"""Shift of the fixed pattern below which it is not worth a line."""

_SMALLEST_PX = 32  # side of a field in which a pattern is followed, and of its parts


def examine_background(movie: Stack, camera: Camera, windows: Windows) -> dict[str, Any]:
    """Measure the noise against averaging, and how far the fixed pattern moved."""
    curve: tuple[tuple[int, ...], tuple[float, ...]] = ((), ())
    limit = drift = error = None
    if windows.n_before >= 2 and is_lit(windows):
        frame_bytes = math.prod(movie.shape[1:]) * np.dtype(movie.dtype).itemsize
        # bytes on which the noise is measured
        some = first_counts(movie, windows, max(2, 64_000_000 // frame_bytes))
        lit = well_lit(windows.power[: len(some)])
        some = some if lit.all() or lit.sum() < 2 else some[lit]
        # the longest average of the curve
        noise = measure_noise(some, camera, min(100, len(some) // 2))
        curve, limit = (noise.frames, noise.variance_over_shot), noise.shot_limited
        moved = _pattern_moved(windows)
        if moved is not None:
            drift, error = moved[0].tolist(), moved[1].tolist()
    return {
        "noise_frames": list(curve[0]),
        "noise_variance_over_shot": list(curve[1]),
        "shot_noise_limited_frames": limit,
        "drift_px": drift,
        "drift_error_px": error,
    }


def _pattern_moved(windows: Windows) -> tuple[FloatArray, FloatArray] | None:
    """Measure the shift of the pattern along y and x, and its errors; None without a pattern.

    A particle changes the light like an edge that moved, but differently in every part of the
    field.  The errors are therefore at least the differences between parts.
    """
    rows, columns = windows.before_e.shape
    whole = _part_moved(windows, np.s_[:rows, :columns])
    if whole is None:
        return None
    side = _SMALLEST_PX
    parts = [
        _part_moved(windows, np.s_[top : top + side, left : left + side])
        for top in range(0, rows - side + 1, side)
        for left in range(0, columns - side + 1, side)
    ]
    shifts = np.array([part[0] for part in parts if part is not None])
    if len(shifts) < 4:  # parts whose differences tell an error
        return whole
    apart = SIGMA_PER_MAD * np.median(np.abs(shifts - np.median(shifts, axis=0)), axis=0)
    return whole[0], np.maximum(whole[1], apart * math.sqrt(math.pi / 2 / len(shifts)))


def _part_moved(
    windows: Windows, part: tuple[slice, slice]
) -> tuple[FloatArray, FloatArray] | None:
    """Give how far the pattern of a part of the field moved; None where it is too small."""
    used = ~windows.masked[part]
    if min(used.shape) < _SMALLEST_PX:
        return None
    motion = follow_pattern(
        np.stack([windows.before_e[part], windows.after_e[part]]),
        np.array([1.0, windows.power_ratio]),
        np.array([np.mean(windows.frames_before), np.mean(windows.frames_after)]),
        np.ascontiguousarray(used),
        np.ascontiguousarray(windows.read_variance_before_e2[part]),
    )
    if motion is None or not np.isfinite(motion.error_px).all():
        return None
    return motion.shift_px[1], motion.error_px[1]


def drift_warning(name: str, background: dict[str, Any]) -> Finding | None:
    """Find whether the fixed pattern moved, where its edges can be taken for particles."""
    if background["drift_px"] is None:
        return None
    (y, x), (y_error, x_error) = background["drift_px"], background["drift_error_px"]
    pull = math.hypot(y / y_error, x / x_error)
    if math.hypot(y, x) <= DRIFT_PX or pull <= 4.0:  # standard errors
        return None
    return PATTERN_MOVED({"x_px": x, "y_px": y}, where=name)
