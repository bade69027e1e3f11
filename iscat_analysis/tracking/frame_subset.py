"""Frames that the camera dropped or repeated are left out of a movie in which particles move.

A frame that repeats the one before shows particles that stand still, and counts its light twice; a
frame without light shows nothing.  The others keep their numbers, so that a particle's step over
what is left out is one of several frames.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import Camera
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.movie import Stack, StackFrames
from iscat_analysis.records import BoolArray, FloatArray, Windows
from iscat_analysis.search.frames import DARK, measure_frames, well_lit
from iscat_analysis.units import listed

MANY = 0.05
"""Share of the frames that may be left out without a word on what that means."""

_READ = 64  # frames at a time
_NAMED = 4

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class FrameSubset:
    """The frames of a movie that are analysed."""

    movie: Stack
    span: tuple[int, int]
    numbers: IntArray | None = None
    message: str = ""

    def put_back(self, found: DetectionResult) -> DetectionResult:
        """Give frames their numbers in the movie."""
        if self.numbers is None or found.followed is None:
            return found
        numbers, followed = self.numbers, found.followed
        windows = _renumbered(followed.windows, numbers)
        after = windows.power[windows.n_before :]
        power = np.tile(np.where(after > 0, after, np.nan), 2)
        return replace(
            found,
            fits=found.fits.assign(frame=numbers[found.fits["frame"].to_numpy(dtype=np.int64)]),
            compared=replace(Compared.of(windows), power=power),
            followed=replace(
                followed,
                windows=windows,
                parts=tuple(_renumbered(part, numbers) for part in followed.parts),
            ),
        )


def keep_frames(
    movie: Stack, camera: Camera, span: tuple[int, int], *, additive: bool = False
) -> FrameSubset:
    """Leave out frames that repeat others or have no light."""
    dark, repeats = _odd(movie, camera, span, additive=additive)
    good = ~(dark | repeats)
    if good.all() or not good.any():
        return FrameSubset(movie, span)
    numbers = span[0] + np.flatnonzero(good)
    seen = movie.seen_as(StackFrames(movie, numbers))
    missing, share = span[0] + np.flatnonzero(~good), float(np.mean(repeats & ~dark))
    many, is_, same = ("s", "are", "repeat") if len(missing) > 1 else ("", "is", "repeats")
    message = (
        f"{movie.name}: frame{many} {listed(missing, _NAMED)} {is_} dark, cut off or {same} the "
        "one before (behind a shutter, dropped or stuck in the camera); left out, and steps over "
        "them count as several frames"
    )
    if share > MANY:
        message += (
            f"; {share:.0%} of the frames: if the file holds each of the camera's several times, D "
            "is too small by as much; export it with each once, at the camera's own rate"
        )
    return FrameSubset(seen, (0, len(numbers)), numbers, message)


def _odd(
    movie: Stack, camera: Camera, span: tuple[int, int], *, additive: bool
) -> tuple[BoolArray, BoolArray]:
    """Tell which frames have no light, and which repeat those before them."""
    light_e = np.empty(span[1] - span[0])
    same = np.empty(light_e.size, dtype=np.bool_)
    for start in range(*span, _READ):
        begin, stop = max(start - 1, span[0]), min(start + _READ, span[1])
        light, repeats = measure_frames(movie.read(begin, stop), camera)
        here = slice(start - span[0], stop - span[0])
        light_e[here], same[here] = light[start - begin :], repeats[start - begin :]
    return np.isneginf(light_e) if additive else ~well_lit(light_e, DARK), same


def _renumbered(windows: Windows, numbers: IntArray) -> Windows:
    """Give a range of kept frames its numbers in the movie; frames left out get no light."""
    first, last = windows.frames_after
    kept = numbers[first:last]
    span = int(kept[0]), int(kept[-1]) + 1
    before, after = np.split(windows.power, 2)
    power: FloatArray = np.zeros(span[1] - span[0])
    power[kept - span[0]] = after
    both = np.concatenate([before, power])
    return replace(windows, frames_before=span, frames_after=span, power=both)
