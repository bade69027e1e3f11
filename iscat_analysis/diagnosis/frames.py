"""Frames that are left out: of other channels, dark, cut off, or repeated.

Channels whose frames take turns in one series are recognised.

Frames without light, or without a part of it, among those that are summed.

Frames that repeat the one before are left out of a movie with a recorded background.

A frame that was stuck in the camera counts the same light twice.  The frames that are left are
analysed as a movie of their own, and what is found gets the numbers of the file back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import Camera
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding
from iscat_analysis.findings.camera import FRAMES_DARK, REPEATS_LEFT_OUT
from iscat_analysis.fitting.ranges import frame_ranges
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.movie import ChangedFrames, SelectedFrames, Stack
from iscat_analysis.records import BoolArray, FloatArray, Windows
from iscat_analysis.search.frames import DARK, cut_off, measure_frames, well_lit
from iscat_analysis.units import are, frames_listed

_MOST = 4  # channels that are looked for


def refuse_channels(counts: NDArray[Any], camera: Camera, name: str) -> None:
    """Refuse frames of several kinds that take turns: each is a movie of its own.

    Frames of one channel differ by noise, those of another by its pattern as well.

    Shapes: `counts` (t, y, x).
    """
    channels = channels_of(counts, camera)
    if channels > 1:
        others = " or ".join(f"{channels}:{k}" for k in range(1, channels))
        raise DataError(
            f"{name}: frames of {channels} kinds take turns, as of {channels} channels or cameras "
            f"that were saved as one series: choose one with --channels {channels}:0, or {others} "
            f"(camera.channels = [{channels}, 0])"
        )


def channels_of(counts: NDArray[Any], camera: Camera) -> int:
    """Tell how many channels take turns; 1 where none do.

    Shapes: `counts` (t, y, x).
    """
    shape = counts.shape[1:]
    every = max(1, -(-math.prod(shape) // 4096))  # some thousand pixels all over the field
    cut = camera.mapped(lambda image: np.broadcast_to(image, shape).reshape(-1)[::every])
    light = cut.to_electrons(counts.reshape(len(counts), -1)[:, ::every])
    power = light.mean(axis=1, keepdims=True)
    fresh = np.array([True, *(not np.array_equal(a, b) for a, b in pairwise(counts))])
    light, power = light[fresh], power[fresh]
    if len(light) < 2 * _MOST or not (np.isfinite(power) & (power > 0)).all():
        return 1
    light /= power
    apart = [
        float(np.median(np.mean((light[n:] - light[:-n]) ** 2, axis=1)))
        for n in range(1, _MOST + 1)
    ]
    # frames of one channel differ by so much less
    found = (n for n in range(2, _MOST + 1) if apart[n - 1] < 0.1 * min(apart[: n - 1]))
    return next(found, 1)


@dataclass(frozen=True, eq=False)
class _DarkFramesReplaced(ChangedFrames):
    """A movie in which dark frames are replaced."""

    frames: NDArray[np.int64]
    dark: NDArray[Any]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames, those that are dark as the camera sees the dark."""
        counts = self.source.read(start, stop)
        inside = self.frames[(self.frames >= start) & (self.frames < stop)] - start
        if inside.size:
            counts = counts.copy()
            counts[inside] = self.dark
        return counts


def without_cut_off(movie: Stack, camera: Camera, windows: Windows) -> tuple[Stack, Finding | None]:
    """Leave frames with missing light out of sums, and list the dark ones."""
    numbers = np.concatenate([np.arange(*windows.frames_before), np.arange(*windows.frames_after)])
    power = windows.power
    usual = float(np.median(power))
    whole = numbers[np.argsort(np.abs(power - usual))[:2]]
    beside = np.concatenate([movie.read(n, n + 1) for n in whole.tolist()])
    dim = numbers[power < 0.97 * usual].tolist()  # a part of which may be missing
    frames = (np.concatenate([movie.read(n, n + 1), beside]) for n in dim)
    cut = np.array(dim, dtype=np.int64)[[bool(cut_off(part, camera)[0]) for part in frames]]
    missing = np.union1d(cut, numbers[~well_lit(power, DARK)])
    if not missing.size:
        return movie, None
    words = {"frames": frames_listed(missing), "are": are(missing.size)}
    finding = FRAMES_DARK({**words, "of": numbers.size}, where=movie.name)
    if cut.size:
        movie = movie.seen_as(_DarkFramesReplaced(movie, cut, camera.without_light(movie)))
    return movie, finding


IntArray = NDArray[np.int64]

_READ = 64  # frames at a time


@dataclass(frozen=True, eq=False)
class KeptFrames:
    """The frames that are analysed, and their numbers in the file; None where these are all."""

    movie: Stack
    config: Config
    numbers: IntArray | None = None
    finding: Finding | None = None

    def put_back(self, found: DetectionResult, asked: Config) -> DetectionResult:
        """Give what was found the numbers of the file, and the configuration with their ranges."""
        if self.numbers is None:
            return found
        compared, numbers = found.compared, self.numbers
        spans, power = [], []
        rest = compared.power
        for first, last in (compared.frames_before, compared.frames_after):
            kept = numbers[first:last]
            span = (int(kept[0]), int(kept[-1]) + 1) if kept.size else (0, 0)
            light = np.full(span[1] - span[0], np.nan)
            light[kept - span[0]], rest = np.split(rest, [kept.size])
            spans.append(span)
            power.append(light)
        frame = numbers[found.fits["frame"].to_numpy(dtype=np.int64)]
        compared = replace(
            compared, frames_before=spans[0], frames_after=spans[1], power=np.concatenate(power)
        )
        context = replace(found.context, config=asked)
        return replace(
            found, context=context, fits=found.fits.assign(frame=frame), compared=compared
        )


def without_repeats(movie: Stack, config: Config, camera: Camera) -> KeptFrames:
    """Leave out frames that repeat the one before, unless they are dark, which is told apart."""
    before, after = frame_ranges(movie, config)
    spans = [span for span in (before, after) if span is not None]
    used = np.concatenate([np.arange(*span) for span in spans])
    if used.max() >= movie.shape[0] or np.diff(used).min(initial=1) < 1:  # refused later
        return KeptFrames(movie, config)
    seen = [light_and_repeats(movie, camera, span) for span in spans]
    kept = [
        span[0] + np.flatnonzero(~(same & well_lit(light_e, DARK)))
        for span, (light_e, same) in zip(spans, seen, strict=True)
    ]
    numbers = np.concatenate(kept)
    missing = np.setdiff1d(used, numbers)
    if not missing.size or min(part.size for part in kept) < 2:  # nothing else is there
        return KeptFrames(movie, config)
    middle = kept[0].size if before is not None else 0
    own = config.changed(
        background={} if before is None else {"frames": (0, middle)},
        fit={"frames": (middle, numbers.size)},
    )
    words = {"repeat": "repeats" if missing.size == 1 else "repeat", "are": are(missing.size)}
    words["frames"] = frames_listed(missing)
    finding = REPEATS_LEFT_OUT({**words, "of": used.size}, where=movie.name)
    return KeptFrames(movie.seen_as(SelectedFrames(movie, numbers)), own, numbers, finding)


def light_and_repeats(
    movie: Stack, camera: Camera, span: tuple[int, int]
) -> tuple[FloatArray, BoolArray]:
    """Measure the light of the frames of a range, and tell which repeat the one before.

    Shapes: both (t,).
    """
    light_e, same = np.empty(span[1] - span[0]), np.empty(span[1] - span[0], dtype=np.bool_)
    for start in range(*span, _READ):
        begin, stop = max(start - 1, span[0]), min(start + _READ, span[1])
        here = slice(start - span[0], stop - span[0])
        measured = measure_frames(movie.read(begin, stop), camera)
        light_e[here], same[here] = (each[start - begin :] for each in measured)
    return light_e, same
