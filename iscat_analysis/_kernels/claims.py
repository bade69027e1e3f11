"""Claims: one process compiles a kernel, and others that need it wait for what it keeps."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

try:
    import fcntl
except ImportError:  # Windows, where each process compiles what it needs
    fcntl = None  # type: ignore[assignment]

_NAME = "claims.nbi"  # as Numba names what it keeps, so that who packs or tidies knows it


@contextmanager
def claimed(folder: str, subject: str) -> Iterator[None]:
    """Claim something for this process as long as the block lasts.

    The system takes back the claims of a process that ends.  Where it keeps none, as on some file
    servers, or where two processes wait for each other, the block goes on without.
    """
    place = zlib.crc32(subject.encode())
    file = _claimed(folder, place)
    try:
        yield
    finally:
        if file is not None:
            fcntl.lockf(file, fcntl.LOCK_UN, 1, place)


def _claimed(folder: str, place: int) -> int | None:
    """Claim a byte; the file that holds it, or none where there are no claims."""
    if fcntl is None:
        return None
    try:
        file = _opened(folder)
        fcntl.lockf(file, fcntl.LOCK_EX, 1, place)
    except OSError:
        return None
    return file


@cache
def _opened(folder: str) -> int:
    """Open the file whose bytes are claimed, for good: to close it would free them all."""
    os.makedirs(folder, exist_ok=True)  # noqa: PTH103  # kernels know no paths
    return os.open(f"{folder}/{_NAME}", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
