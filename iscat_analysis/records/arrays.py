"""Types of arrays, and the callback that reports progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Mapper = Callable[..., Iterable[Any]]
"""`map`, or the one of a pool."""


class Progress(Protocol):
    """Callback for the progress of a step; the command line draws a bar on stderr."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Report that `done` of `total` steps of `stage` are finished."""


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""
