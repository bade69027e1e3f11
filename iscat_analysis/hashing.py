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
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

from iscat_analysis.copies import Copy, LostError
from iscat_analysis.errors import DataError
from iscat_analysis.threads import beside, processors

_BLOCK_BYTES = 2**24  # of a file, that are in memory at a time
_ASIDE = 5  # on the scale of `nice`: a quarter of a processor that is wanted, and all that is idle


@dataclass(frozen=True)
class BegunHash:
    """A file that is being hashed.

    Attributes
    ----------
    path : Path
        The file.
    digest : Future of str
        What `sha256_of_files` gives of it alone.
    """

    path: Path
    digest: Future[str]


def begin_hash(path: Path) -> BegunHash:
    """Hash a file while something else is done.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    BegunHash
        With a digest that raises `DataError` where the file cannot be read.
    """
    if sys.platform != "linux" or processors() < 2:
        return BegunHash(path, beside(sha256_of_files, (path,)))
    try:
        copy = Copy(_hash_aside)
    except OSError:  # there is no room for another process
        return BegunHash(path, beside(sha256_of_files, (path,)))

    def answer() -> str:
        try:
            digest: str = copy.do((path,))
        except LostError:
            return sha256_of_files((path,))
        finally:
            copy.end()
            copy.close()
        return digest

    return BegunHash(path, beside(answer))


def _hash_aside(files: Sequence[Path]) -> str:
    """Hash files while whoever waits for other processes goes first."""
    os.nice(_ASIDE)
    return sha256_of_files(files)


def sha256_of_files(files: Sequence[Path], part: str = "") -> str:
    """Hash a movie, without holding it in memory.

    Parameters
    ----------
    files : sequence of Path
        That hold it.
    part : str
        What it is of them.

    Returns
    -------
    str
        SHA-256 of the bytes of the files, and of the part, as 64 hexadecimal digits.

    Raises
    ------
    DataError
        A file cannot be read.
    """
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
