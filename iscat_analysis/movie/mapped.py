"""Memory-mapped files, and the errors that libraries raise on damaged ones.

Arrays that do not fit into memory: pages of a file without a name, which ends with the array.
"""

from __future__ import annotations

import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.reading import OF_DAMAGE, first_line, open_regular
from iscat_analysis.records import InPlace

WHAT_LIBRARIES_RAISE = (*OF_DAMAGE, AssertionError, SystemError)
"""What a damaged file makes tifffile, h5py and imagecodecs raise."""


@contextmanager
def damaged(
    what: str, *errors: type[Exception], remedy: str = "copy it again or export it again"
) -> Iterator[None]:
    """Turn what libraries raise on damaged files, and further errors, into one clear line."""
    caught: tuple[type[Exception], ...] = (*WHAT_LIBRARIES_RAISE, *errors)
    try:
        yield
    except DataError:
        raise
    except caught as error:
        raise DataError(f"{what} ({first_line(error)}); {remedy}") from None


HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""How HDF5 files begin."""

HARMLESS_BYTES = 64_000_000
"""Whatever takes no more memory than this is harmless, whatever a file says of it."""


MOST_FRAME_DECODED_RATIO = 100
"""Of one frame, which is held in memory whole, decoded over stored."""


class Writer(Enum):
    """Whether a program has an HDF5 file open to write, and lets others read meanwhile.

    The file says so until it is closed; also if the program ended without that.
    """

    NONE = "none"
    ALONE = "alone"
    WITH_READERS = "with readers"


def writer_of(path: Path) -> Writer:
    """Read the flags of an HDF5 file, which mean that in superblocks since version 3."""
    with open_regular(path) as file:
        head = file.read(12)
    flags = head[11] if len(head) == 12 and head.startswith(HDF5_SIGNATURE) and head[8] > 2 else 0
    if not flags & 1:  # open to write
        return Writer.NONE
    return Writer.WITH_READERS if flags & 4 else Writer.ALONE


def map_file(path: Path) -> mmap.mmap:
    """Map a whole file for reading."""
    with open_regular(path) as file:
        if not os.fstat(file.fileno()).st_size:
            raise DataError(f"{path}: is empty (0 bytes); copy it again or export it again")
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)


def unmap(data: mmap.mmap) -> None:
    """Close a file, or have it closed when its frames are no longer used."""
    with suppress(BufferError):
        data.close()


def frames_in_place(
    path: Path, data: mmap.mmap, offset: int, shape: tuple[int, int, int], stored: np.dtype[Any]
) -> InPlace | None:
    """View frames that are contiguous in a file."""
    if not stored.isnative or offset % stored.itemsize:
        return None
    refuse_changed(path, data)
    counts = np.asarray(_Lying(np.frombuffer(data, dtype=np.uint8)[offset:], shape, stored))
    return InPlace(
        counts,
        partial(refuse_changed, path, data),
        partial(release, data, offset, offset + counts.nbytes),
    )


class _Lying:
    """Read-only bytes that NumPy takes for a writeable array.

    Numba would compile all kernels again for read-only arrays.
    """

    def __init__(
        self, data: NDArray[np.uint8], shape: tuple[int, int, int], stored: np.dtype[Any]
    ) -> None:
        self._data = data  # which keeps the file open
        self.__array_interface__ = {
            "version": 3, "shape": shape, "typestr": stored.str, "data": (data.ctypes.data, False),
        }  # fmt: skip


def refuse_changed(path: Path, data: mmap.mmap) -> None:
    """Refuse a file that has shrunk: touching mapped bytes beyond its end kills the process."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise DataError(f"{path}: can no longer be read ({error.strerror})") from None
    if size < len(data):
        raise DataError(
            f"{path}: shrank from {len(data)} to {size} bytes while it was open; "
            "wait until it is written, then start again"
        )


def refuse_growth(size: int, stored: int, what: str, *, ratio: int = 2000) -> None:
    """Refuse what decodes to far more than it was stored in.

    Deflate reaches a ratio of 1032, on constant images only.
    """
    if size > max(HARMLESS_BYTES, ratio * stored):
        raise DataError(
            f"{what} would grow from {stored} to {size} bytes, which no recording does; the file "
            "is damaged, export it again"
        )


def refuse_large_chunks(chunk: tuple[int, ...], dtype: np.dtype[Any], what: str) -> None:
    """Refuse an array whose chunks take too much memory, since one is decoded at a time."""
    if math.prod(chunk) * dtype.itemsize > 2**28:
        raise DataError(
            f"{what} is stored in chunks of {chunk}, too large to be decoded one at a time; save "
            "it with smaller chunks"
        )


def release(data: mmap.mmap, start: int, stop: int) -> None:
    """Release mapped pages that were copied; the system counts them as memory of this process."""
    along = 2**16  # which the system maps with what was asked for
    first = max(start - along, 0) // mmap.PAGESIZE * mmap.PAGESIZE
    last = min(stop + along, len(data))
    if last > first and hasattr(data, "madvise"):
        data.madvise(mmap.MADV_DONTNEED, first, last - first)


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
