"""One of several channels whose frames take turns in a movie."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.stack import Frames
from iscat_analysis.records import StackMetadata


class ChannelFrames:
    """Every n-th frame of a movie; `Stack.channel` makes it."""

    def __init__(self, source: Frames, name: str, channels: int, which: int) -> None:
        self._source, self._channels, self._which = source, channels, which
        frames = len(range(which, source.shape[0], channels))
        if frames < 2:
            raise DataError(
                f"{name}: has {source.shape[0]} frames, which are too few for channel {which} of "
                f"{channels}; give another camera.channels"
            )
        self.shape = (frames, *source.shape[1:])
        self.dtype: np.dtype[Any] = source.dtype
        self.notes = source.notes

    @property
    def metadata(self) -> StackMetadata:
        """What the file says, with the times of these frames."""
        return self.with_times(self._source.metadata)

    def with_times(self, said: StackMetadata) -> StackMetadata:
        """Give metadata of the whole movie the times of these frames."""
        if said.ticks is not None:  # which count the intervals of the camera
            own = said.ticks[self._which :: self._channels]
            return replace(said, ticks=tuple(tick - own[0] for tick in own))
        rate = said.frame_rate_hz
        return replace(said, frame_rate_hz=None if rate is None else rate / self._channels)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        if start >= stop:
            return self._source.read(0, 0)
        first, last = (self._which + self._channels * n for n in (start, stop - 1))
        return np.ascontiguousarray(self._source.read(first, last + 1)[:: self._channels])

    def close(self) -> None:
        """Release the file."""
        self._source.close()
