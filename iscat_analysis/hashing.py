"""Hashes of files, by which a result names the movie that it is of."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from iscat_analysis.errors import DataError

_BLOCK_BYTES = 2**24  # of a file, that are in memory at a time


def sha256_of_files(files: Sequence[Path], part: str = "") -> str:
    """Hash a movie, without holding it in memory."""
    digest, room = hashlib.sha256(), memoryview(bytearray(_BLOCK_BYTES))
    for path in files:
        try:
            with path.open("rb", buffering=0) as file:
                while length := file.readinto(room):
                    digest.update(room[:length])
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    digest.update(part.encode("utf-8", "backslashreplace"))
    return digest.hexdigest()


def states_of(files: Sequence[Path]) -> tuple[tuple[int, ...], ...]:
    """Give what changes of files when they are replaced or written to; nothing of one not there."""
    found: list[tuple[int, ...]] = []
    for path in files:
        try:
            state = path.stat()
        except (OSError, ValueError):  # of a name with NUL
            found.append(())
        else:
            found.append((state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns))
    return tuple(found)


def refuse_changed(files: Sequence[Path], states: Sequence[tuple[int, ...]]) -> None:
    """Refuse files that were replaced or written to since their states were taken."""
    for path, before, now in zip(files, states, states_of(files), strict=True):
        if now != before:
            raise DataError(
                f"{path}: was replaced or written to while it was open; start again once nothing "
                "changes it any more"
            )


def fingerprint(files: Sequence[Path], part: str = "") -> str:
    """Tell a movie's content from another's without reading all of it."""
    # Bytes that a fingerprint reads at either end of a file; many files share them
    end = max(2**20 // max(len(files), 1), 2**8)
    digest = hashlib.sha256(part.encode("utf-8", "backslashreplace"))
    for path in files:
        with path.open("rb") as file:
            state = os.fstat(file.fileno())
            digest.update(f"{state.st_size} {state.st_mtime_ns}".encode())
            digest.update(file.read(end))
            file.seek(max(state.st_size - end, 0))
            digest.update(file.read(end))
    return digest.hexdigest()
