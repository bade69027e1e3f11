"""Hashes of files, by which a result names the movie that it is of.

A large file takes a second for each 1.7 GB.  A process of its own needs nothing that the analysis
loads, so that it is done with most files before that begins; a thread would wait for the
interpreter after every block.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from iscat_analysis.copies import Copy, LostError
from iscat_analysis.errors import DataError
from iscat_analysis.threads import beside, processors

_BLOCK_BYTES = 2**24  # of a file, that are in memory at a time
_END_BYTES = 2**20  # that a fingerprint reads of a file; many files share them
_LEAST_END_BYTES = 2**8
_ASIDE = 5  # on the scale of `nice`: a quarter of a processor that is wanted, and all that is idle


class BegunHash:
    """A file that is hashed while something else is done."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._state = _state(path)
        self._closed = False
        self._copy: Copy | None = None
        if sys.platform == "linux" and processors() > 1:
            with suppress(OSError):  # there is no room for another process
                self._copy = Copy(_hash_aside)
        self.digest = beside(self._answer)

    def _answer(self) -> str:
        if self._copy is None:
            return sha256_of_files((self.path,))
        try:
            digest: str = self._copy.do((self.path,))
        except LostError:
            if self._closed:
                raise
            return sha256_of_files((self.path,))
        finally:
            self._copy.end()
            self._copy.close()
        return digest

    def is_of(self, files: Sequence[Path]) -> bool:
        """Tell whether a movie is this file, as it was when its hash was begun."""
        return tuple(files) == (self.path,) and _state(self.path) == self._state

    def close(self) -> None:
        """Give up where it is not done yet; its process is gone then, and the file closed."""
        self._closed = True
        if self._copy is not None:
            self._copy.end()


def _state(path: Path) -> tuple[int, ...]:
    """Give what of a file changes with its content; nothing where there is no file."""
    try:
        found = path.stat()
    except OSError:
        return ()
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def _hash_aside(files: Sequence[Path]) -> str:
    """Hash files while whoever waits for other processes goes first."""
    os.nice(_ASIDE)
    return sha256_of_files(files)


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


def fingerprint(files: Sequence[Path], part: str = "") -> str:
    """Tell a movie's content from another's without reading all of it."""
    end = max(_END_BYTES // max(len(files), 1), _LEAST_END_BYTES)
    digest = hashlib.sha256(part.encode("utf-8", "backslashreplace"))
    for path in files:
        with path.open("rb") as file:
            state = os.fstat(file.fileno())
            digest.update(f"{state.st_size} {state.st_mtime_ns}".encode())
            digest.update(file.read(end))
            file.seek(max(state.st_size - end, 0))
            digest.update(file.read(end))
    return digest.hexdigest()
