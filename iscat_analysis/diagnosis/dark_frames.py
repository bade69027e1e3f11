"""Frames without light, or without a part of it, among those that are summed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.counts import Camera
from iscat_analysis.movie import Stack
from iscat_analysis.movie.selected_frames import ChangedFrames
from iscat_analysis.records import Windows
from iscat_analysis.search.frames import DARK, cut_off, well_lit
from iscat_analysis.units import listed

_DIM = 0.97
"""Share of the usual light, below which a part of a frame may be missing."""

_NAMED = 4


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


def without_cut_off(movie: Stack, camera: Camera, windows: Windows) -> tuple[Stack, str]:
    """Leave frames with missing light out of sums, and list the dark ones."""
    numbers = np.concatenate([np.arange(*windows.frames_before), np.arange(*windows.frames_after)])
    power = windows.power
    usual = float(np.median(power))
    whole = numbers[np.argsort(np.abs(power - usual))[:2]]
    beside = np.concatenate([movie.read(n, n + 1) for n in whole.tolist()])
    cut = np.array([
        n
        for n in numbers[power < _DIM * usual].tolist()
        if cut_off(np.concatenate([movie.read(n, n + 1), beside]), camera)[0]
    ], dtype=np.int64)  # fmt: skip
    missing = np.union1d(cut, numbers[~well_lit(power, DARK)])
    if not missing.size:
        return movie, ""
    one = missing.size == 1
    message = (
        f"{movie.name}: frame{'' if one else 's'} {listed(missing, _NAMED)} of {numbers.size} "
        f"{'is' if one else 'are'} dark or cut off (behind a shutter, or lost by the camera), and "
        f"{'is' if one else 'are'} left out"
    )
    if cut.size:
        dark = np.broadcast_to(np.floor(camera.offset_adu), movie.shape[1:]).astype(movie.dtype)
        movie = movie.seen_as(_DarkFramesReplaced(movie, cut, dark))
    return movie, message
