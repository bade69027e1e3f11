"""Frames of a movie that another one is made of: some of them, or all with other counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.movie.stack import Stack
from iscat_analysis.records import FrameSource, StackMetadata

S = TypeVar("S", bound=FrameSource)


@dataclass(frozen=True, eq=False)
class ChangedFrames:
    """Frames of a movie that another one can be made of; how they are read is added to it."""

    source: Stack

    notes: ClassVar[tuple[str, ...]] = ()
    metadata: ClassVar[StackMetadata] = StackMetadata()

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self.source.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts."""
        return self.source.dtype

    def close(self) -> None:
        """Do nothing: the movie has an owner."""


@dataclass(frozen=True, eq=False)
class SelectedFrames(Generic[S]):
    """Some frames of a stack."""

    source: S
    frames: NDArray[np.int64]

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.source.name

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self.frames.size, *self.source.shape[1:]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames by their index in the selection.

        Shapes: result (stop − start, y, x).
        """
        wanted = self.frames[start:stop]
        runs = np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1)
        parts = [self.source.read(int(run[0]), int(run[-1]) + 1) for run in runs if run.size]
        return np.concatenate(parts) if parts else self.source.read(0, 0)


class StackFrames(SelectedFrames[Stack], ChangedFrames):
    """Some frames of a movie, which another one can be made of."""
