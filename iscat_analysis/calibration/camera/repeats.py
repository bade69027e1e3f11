"""Frames that the camera dropped or repeated: they hold no noise of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.calibration.camera.moments import blocks
from iscat_analysis.errors import DataError
from iscat_analysis.records import FrameSource

_NAMED = 4


@dataclass(frozen=True, eq=False)
class Kept:
    """Some frames of a stack, as if it held no others.

    Attributes
    ----------
    source : FrameSource
        The stack.
    frames : ndarray of int
        Which, rising.
    """

    source: FrameSource
    frames: NDArray[np.intp]

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.source.name

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self.frames.size, *self.source.shape[1:]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)`` of those kept, shape (stop − start, y, x) [counts]."""
        wanted = self.frames[start:stop]
        runs = np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1)
        parts = [self.source.read(int(run[0]), int(run[-1]) + 1) for run in runs if run.size]
        return np.concatenate(parts) if parts else self.source.read(0, 0)


def without_repeats(stack: FrameSource, least: int, notes: list[str]) -> FrameSource:
    """Leave out frames that are zero throughout or the same as the frame before.

    Parameters
    ----------
    stack : FrameSource
        Read once, a block at a time.
    least : int
        Frames that must remain.
    notes : list of str
        Told what was left out.

    Returns
    -------
    FrameSource
        The stack itself where nothing is left out, or where no two frames differ, which the caller
        refuses with the reason.

    Raises
    ------
    DataError
        Fewer than `least` different frames remain.
    """
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
    shown = ", ".join(str(k) for k in lost[:_NAMED])
    more = f" and {lost.size - _NAMED} more" if lost.size > _NAMED else ""
    notes.append(
        f"{stack.name}: frame{'s' if lost.size > 1 else ''} {shown}{more} "
        f"{'are' if lost.size > 1 else 'is'} zero throughout or the same as the frame before "
        "(dropped or stuck in the camera); left out"
    )
    return Kept(stack, kept)
