"""Unsteady pixels and unsteady light, found before anything is searched; and its pattern's motion.

The fixed pattern of the light moves with the stage, or between two sums.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iscat_analysis import camera as cameras
from iscat_analysis.camera import Camera, LightModel, find_light, find_unsteady, follow_pattern
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.noise import SPECTRUM_FRAMES, NoiseSurvey, first_counts, is_lit
from iscat_analysis.diagnosis.recognise import least_beside, spot_of
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import PATTERN_MOVED
from iscat_analysis.medians import SIGMA_PER_MAD
from iscat_analysis.movie import Stack
from iscat_analysis.records import FloatArray, Windows
from iscat_analysis.search.frames import good_frames, measure_frames, well_lit
from iscat_analysis.search.noise import longest_window, measure_motion, measure_noise
from iscat_analysis.threads import one_thread_algebra

PAIRS = 12
"""Places in a movie at which the light of some frames is compared with that of later ones.

Half as many tell more of a large field, by the light of all its pixels.
"""


class Pair(NamedTuple):
    """Two sets of successive frames, the second a window later than the first."""

    first: int
    before: NDArray[Any]
    later: int
    after: NDArray[Any]


@dataclass(frozen=True)
class JudgedLight:
    """A movie without its unsteady pixels, and with its unsteady light divided out."""

    movie: Stack
    lines: LightModel | None
    findings: tuple[Finding, ...]
    steady: Stack


def judge_light(movie: Stack, config: Config, camera: Camera) -> JudgedLight:
    """Find pixels and parts of the light that are unsteady."""
    if not config.optics.interferes:
        return JudgedLight(movie, None, (), movie)
    pairs, window = _pairs(movie, config, camera)
    findings: list[Finding] = []
    optics, pixel_nm = config.optics, config.camera.pixel_size_nm
    spot = spot_of(optics.wavelength_nm, optics.na, pixel_nm or optics.wavelength_nm / optics.na)
    odd = find_unsteady(_apart(pairs), camera, least_beside(spot))
    if odd is not None:
        dark = camera.without_light(movie)[odd]
        for part in (part for pair in pairs for part in (pair.before, pair.after)):
            part[:, odd] = dark
        movie = movie.without(odd, dark)
        findings.append(cameras.unsteady_finding(odd, movie.name))
    lines = judge_lines(movie, config, camera, pairs, window)
    if lines is None:
        return JudgedLight(movie, None, tuple(findings), movie)
    steady = movie.seen_as(cameras.SteadyFrames(movie, lines, camera))
    return JudgedLight(movie, lines, (*findings, *lines.findings(movie.name)), steady)


def judge_lines(
    movie: Stack, config: Config, camera: Camera, pairs: Sequence[Pair], window: int
) -> LightModel | None:
    """Find rows, columns and smooth light that change and may be divided out."""
    background = config.background
    if (
        not background.power_normalization
        or background.is_known
        or (background.slides and background.follows_pattern)
        or (background.way == "tracks" and config.track.heights_free)
    ):
        return None
    first, last = background.recorded or config.fit.frames or (0, movie.shape[0])
    frames = cameras.whole_frames(movie.shape[1:], SPECTRUM_FRAMES)
    counts = movie.read(first, max(first, min(last, movie.shape[0], first + frames)))
    counts = counts[good_frames(counts, camera)]
    if not len(counts):
        return None
    with one_thread_algebra():
        surface = find_light([(p.before, p.after) for p in pairs], camera, window)
        return cameras.with_lines(counts, camera, surface)


def _apart(pairs: Sequence[Pair]) -> list[NDArray[Any]]:
    """Select frames of pairs that have no frame in common."""
    parts = sorted(
        (part for p in pairs for part in ((p.first, p.before), (p.later, p.after))),
        key=lambda part: part[0],
    )
    kept: list[NDArray[Any]] = []
    end = 0
    for first, counts in parts:
        if first >= end:
            kept.append(counts)
            end = first + len(counts)
    return kept


def _pairs(movie: Stack, config: Config, camera: Camera) -> tuple[list[Pair], int]:
    """Read frames that are as far apart as windows that are compared, and how many those have.

    Where the background has frames of its own, particles are in the others alone: both are looked
    at by themselves, and then some of one with some of the other.  Frames in which particles move
    are compared one by one, half the movie apart: what they have in common is their background.
    """
    background, moving = config.background, config.background.way == "tracks"
    total, large = movie.shape[0], math.prod(movie.shape[1:]) > cameras.LARGEST_PX
    before = (0, 0) if moving or background.slides else background.recorded or (0, 0)
    first, last = config.fit.frames or (before[1], total)
    spans = [(before[0], min(before[1], total)), (first, min(last, total))]
    spans = spans[1:] if moving or background.slides else spans
    window = max(stop - start for start, stop in spans)
    if background.slides:
        window = background.window_frames or longest_window(last - first)
    frames_each, places = 8, PAIRS // (2 if large else 1)  # that are summed at each place
    if moving:
        window, frames_each, places = window // 2, 1, 24
    frame_bytes = math.prod(movie.shape[1:]) * np.dtype(movie.dtype).itemsize
    # frames that tell unsteady pixels, of so few places; and bytes that are read
    fewest = min(3, frames_each) if large else 1
    most = min(frames_each, max(96_000_000 // (2 * places * frame_bytes), fewest))
    read: list[Pair] = []
    for start, stop in spans:
        gap = min(window, (stop - start) // 2)
        frames_each = min(most, gap, (stop - start - gap) // 3)
        if frames_each < 1:  # too few for three places
            continue
        room = stop - gap - frames_each - start
        # no pair has another's frames
        number = min(places // len(spans), room // frames_each + 1)
        # half the movie apart, and every second less: what comes again must not be missed
        gaps = (gap, math.ceil(0.62 * gap)) if moving else (gap,)
        for k, frame in enumerate(np.linspace(start, start + room, number).astype(int).tolist()):
            later = frame + gaps[k % len(gaps)]
            counts = (movie.read(at, at + frames_each) for at in (frame, later))
            read.append(Pair(frame, next(counts), later, next(counts)))
    read = _good(read, camera)
    if len(spans) == 2:
        apart = [p for p in read if p.first >= spans[1][0]]
        firsts = [p for p in read if p.first < spans[1][0]][-len(apart) :]
        # every second place in the background is also compared with the frames after it
        read += [
            Pair(one.first, one.before, other.later, other.after)
            for one, other in zip(firsts[::2], apart[::2], strict=False)
        ]
    return [p for p in read if len(p.before) and len(p.after)], window


def _good(pairs: Sequence[Pair], camera: Camera) -> list[Pair]:
    """Leave out frames that repeat or are dark, as behind a shutter."""
    if not pairs:
        return []
    parts = [part for pair in pairs for part in (pair.before, pair.after)]
    light, repeats = zip(*(measure_frames(part, camera) for part in parts), strict=True)
    kept = np.split(well_lit(np.concatenate(light)), np.cumsum([len(part) for part in parts])[:-1])
    good = [part[lit & ~same] for part, lit, same in zip(parts, kept, repeats, strict=True)]
    return [
        Pair(pair.first, before, pair.later, after)
        for pair, before, after in zip(pairs, good[::2], good[1::2], strict=True)
    ]


def with_drift_correction(config: Config, *, moves: bool) -> Config:
    """Set in the configuration whether the motion of the fixed pattern is divided out."""
    return config.changed(background={"drift_correction": moves})


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
