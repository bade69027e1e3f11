"""Frames that repeat the one before are left out of a movie with a recorded background.

A frame that was stuck in the camera counts the same light twice.  The frames that are left are
analysed as a movie of their own, and what is found gets the numbers of the file back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.config import Config
from iscat_analysis.fitting.ranges import frame_ranges
from iscat_analysis.fitting.results import DetectionResult
from iscat_analysis.movie import Stack
from iscat_analysis.movie.selected_frames import StackFrames
from iscat_analysis.records import BoolArray
from iscat_analysis.search.frames import DARK, measure_frames, well_lit
from iscat_analysis.units import listed

IntArray = NDArray[np.int64]

_READ = 64  # frames at a time
_NAMED = 4


@dataclass(frozen=True, eq=False)
class KeptFrames:
    """The frames that are analysed, and their numbers in the file; None where these are all."""

    movie: Stack
    config: Config
    configured: Config
    numbers: IntArray | None = None
    message: str = ""

    def put_back(self, found: DetectionResult) -> DetectionResult:
        """Give what was found the numbers of the file, and the ranges that were configured."""
        if self.numbers is None:
            return found
        compared, numbers = found.compared, self.numbers
        spans, power = [], []
        begin = 0
        for first, last in (compared.frames_before, compared.frames_after):
            kept = numbers[first:last]
            span = (int(kept[0]), int(kept[-1]) + 1) if kept.size else (0, 0)
            light = np.full(span[1] - span[0], np.nan)
            light[kept - span[0]] = compared.power[begin : begin + kept.size]
            begin += kept.size
            spans.append(span)
            power.append(light)
        own = found.context.config.model_copy(
            update={"background": self.configured.background, "fit": self.configured.fit}
        )
        frame = numbers[found.fits["frame"].to_numpy(dtype=np.int64)]
        return replace(
            found,
            context=replace(found.context, config=own),
            fits=found.fits.assign(frame=frame),
            compared=replace(
                compared, frames_before=spans[0], frames_after=spans[1], power=np.concatenate(power)
            ),
        )


def without_repeats(movie: Stack, config: Config, camera: Camera) -> KeptFrames:
    """Leave out frames that repeat the one before, unless they are dark, which is told apart."""
    before, after = frame_ranges(movie, config)
    spans = [span for span in (before, after) if span is not None]
    used = np.concatenate([np.arange(*span) for span in spans])
    if used.max() >= movie.shape[0] or np.diff(used).min(initial=1) < 1:  # refused later
        return KeptFrames(movie, config, config)
    kept = [span[0] + np.flatnonzero(~_repeats(movie, camera, span)) for span in spans]
    numbers = np.concatenate(kept)
    missing = np.setdiff1d(used, numbers)
    if not missing.size or min(part.size for part in kept) < 2:  # nothing else is there
        return KeptFrames(movie, config, config)
    middle = kept[0].size if before is not None else 0
    background, fit = config.background, config.fit
    if before is not None:
        background = background.model_copy(update={"frames": (0, middle)})
    fit = fit.model_copy(update={"frames": (middle, numbers.size)})
    own = config.model_copy(update={"background": background, "fit": fit})
    many = missing.size > 1
    message = (
        f"{movie.name}: {'frames' if many else 'frame'} {listed(missing.tolist(), _NAMED)} of "
        f"{used.size} {'repeat' if many else 'repeats'} the frame before (stuck in the camera), "
        f"and {'are' if many else 'is'} left out"
    )
    return KeptFrames(movie.seen_as(StackFrames(movie, numbers)), own, config, numbers, message)


def _repeats(movie: Stack, camera: Camera, span: tuple[int, int]) -> BoolArray:
    """Tell which frames of a range repeat the one before, and have light.

    Shapes: result (t,).
    """
    light_e, same = np.empty(span[1] - span[0]), np.empty(span[1] - span[0], dtype=np.bool_)
    for start in range(*span, _READ):
        begin, stop = max(start - 1, span[0]), min(start + _READ, span[1])
        light, repeats = measure_frames(movie.read(begin, stop), camera)
        here = slice(start - span[0], stop - span[0])
        light_e[here], same[here] = light[start - begin :], repeats[start - begin :]
    found: BoolArray = same & well_lit(light_e, DARK)
    return found
