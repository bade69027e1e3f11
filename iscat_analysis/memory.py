"""What the C library does with the memory of arrays that are freed; only GNU's can be told."""

from __future__ import annotations

import ctypes
from contextlib import suppress

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # GNU's names for them
_EVERYTHING = 2**31 - 1  # the largest size that it can be told
_LARGE_BYTES = 4 * 2**20  # from where on an array goes back by itself


def keep_freed_memory() -> None:
    """Have memory that is freed kept for the next arrays, up to the most that was in use at a time.

    The system clears memory before it gives it, which takes longer than many a step of ours with
    the array that lies in it.
    """
    _tell({_TRIM_THRESHOLD: _EVERYTHING, _MMAP_THRESHOLD: _EVERYTHING})


def give_back_freed_memory() -> None:
    """Have memory of large arrays go back to the system as they are freed: two processes hold it.

    The C library otherwise keeps up to 32 MB at a time, between others that are still in use.
    """
    _tell({_TRIM_THRESHOLD: _LARGE_BYTES, _MMAP_THRESHOLD: _LARGE_BYTES}, now=True)


def _tell(options: dict[int, int], *, now: bool = False) -> None:
    with suppress(OSError, AttributeError):  # of GNU
        library = ctypes.CDLL(None)
        for option, size in options.items():
            library.mallopt(option, size)
        if now:
            library.malloc_trim(0)
