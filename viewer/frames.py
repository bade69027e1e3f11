"""Arrays of frames that are made when they are looked at."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis import Stack


class LazyFrames:
    """What a viewer takes for an array (t, y, x): each frame is made when it is asked for."""

    ndim = 3

    def __init__(
        self, shape: tuple[int, int, int], dtype: Any, frame: Callable[[int], NDArray[Any]]
    ) -> None:
        self.shape = shape
        self.dtype = np.dtype(dtype)
        self._frame = frame

    @property
    def size(self) -> int:
        """How many numbers it holds."""
        return int(np.prod(self.shape, dtype=np.int64))

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[Any]:
        wanted, *rest = key if isinstance(key, tuple) else (key,)
        if wanted is Ellipsis:
            wanted, rest = slice(None), [Ellipsis, *rest]
        numbers = np.arange(self.shape[0])[wanted]
        if np.ndim(numbers) == 0:
            one: NDArray[Any] = np.asarray(self._frame(int(numbers)))[tuple(rest)]
            return one
        out = np.empty((len(numbers), *self.shape[1:]), dtype=self.dtype)
        for place, number in enumerate(numbers):
            out[place] = self._frame(int(number))
        several: NDArray[Any] = out[(slice(None), *rest)]
        return several

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)


class LazyMovie(LazyFrames):
    """The counts of an open movie; it is closed when nothing shows it any more."""

    def __init__(self, stack: Stack) -> None:
        super().__init__(stack.shape, stack.dtype, lambda t: stack.read(t, t + 1)[0])
        self.stack = stack
        weakref.finalize(self, stack.close)
