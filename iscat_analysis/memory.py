"""What the C library does with the memory of arrays that are freed; only GNU's can be told."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # GNU's names for them
_EVERYTHING = 2**31 - 1  # the largest size that it can be told
_USUAL_BYTES = 32 * 2**20  # what the library comes to by itself
_LARGE_BYTES = 4 * 2**20  # from where on an array goes back by itself
_KEPT_BYTES = 16 * 2**20  # at the end of the others, at most

_OTHERS = OSError, AttributeError, TypeError  # what libraries that are not GNU's end in


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Have memory that is freed kept for the next arrays, and given back at the end.

    The system clears memory before it gives it, which takes longer than many a step of ours with
    the array that lies in it.
    """
    _keep_up_to(_EVERYTHING, _EVERYTHING)
    try:
        yield
    finally:
        _give_back(_USUAL_BYTES, _USUAL_BYTES)


def give_back_freed_memory() -> None:
    """Have memory of large arrays go back to the system, now and from now on as they are freed.

    The C library otherwise keeps up to 32 MB at a time, between others that are still in use.
    Smaller arrays, which every event makes anew, lie in memory that is kept.
    """
    _give_back(_LARGE_BYTES, _KEPT_BYTES)


def _give_back(large: int, kept: int) -> None:
    _keep_up_to(large, kept)
    with suppress(*_OTHERS):
        ctypes.CDLL(None).malloc_trim(0)


def _keep_up_to(large: int, kept: int) -> None:
    with suppress(*_OTHERS):
        library = ctypes.CDLL(None)
        library.mallopt(_TRIM_THRESHOLD, kept)
        library.mallopt(_MMAP_THRESHOLD, large)
