"""Arrays that do not fit into memory: pages of a file without a name, which ends with the array."""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError


class Scratch:
    """An array in a temporary file, whose pages the system takes back when it is let go."""

    def __init__(self, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        size = math.prod(shape) * dtype.itemsize
        with tempfile.TemporaryFile() as file:
            try:
                _reserve(file.fileno(), size)
            except OSError as error:
                raise DataError(
                    f"{tempfile.gettempdir()}: {size / 1e9:.1f} GB are needed there for frames "
                    f"that do not fit into memory ({error.strerror}): set TMPDIR to a folder with "
                    "room, or convert the movie to plain TIFF, which is analysed where it lies"
                ) from None
            self._pages = mmap.mmap(file.fileno(), size)
        self.array: NDArray[Any] = np.frombuffer(self._pages, dtype=dtype).reshape(shape)

    def let_go(self) -> None:
        """Give the memory of all pages back; what was written stays in the file."""
        if hasattr(self._pages, "madvise"):
            self._pages.madvise(mmap.MADV_DONTNEED)


def _reserve(number: int, size: int) -> None:
    """Give a file its size at once: a full disk that is met later kills the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(number, 0, size)
    else:
        os.truncate(number, size)
