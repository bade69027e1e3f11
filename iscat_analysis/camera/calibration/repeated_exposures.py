"""Frames that the camera dropped or repeated, which have no noise of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.calibration.moments import blocks
from iscat_analysis.errors import DataError
from iscat_analysis.movie.selected_frames import SelectedFrames
from iscat_analysis.records import FrameSource
from iscat_analysis.units import listed

_NAMED = 4


def without_repeats(stack: FrameSource, least: int, notes: list[str]) -> FrameSource:
    """Leave out frames that are zero throughout or equal to the frame before."""
    total = stack.shape[0]
    good = np.zeros(total, dtype=np.bool_)
    last: NDArray[Any] | None = None
    for start, stop in blocks(stack):
        for k, frame in enumerate(stack.read(start, stop), start):
            good[k] = frame.any() and not (last is not None and np.array_equal(frame, last))
            last = frame
    kept = np.flatnonzero(good)
    if kept.size <= 1 or kept.size == total:
        return stack
    if kept.size < least:
        raise DataError(
            f"{stack.name}: only {kept.size} of {total} frames are neither zero throughout nor the "
            f"same as the frame before; photon transfer needs {least} or more"
        )
    lost = np.flatnonzero(~good)
    notes.append(
        f"{stack.name}: frame{'s' if lost.size > 1 else ''} {listed(lost, _NAMED)} "
        f"{'are' if lost.size > 1 else 'is'} zero throughout or the same as the frame before "
        "(dropped or stuck in the camera); left out"
    )
    return SelectedFrames(stack, kept)
