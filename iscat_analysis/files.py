"""Files that are there whole or not at all, and locks between processes.

Hashes of files, by which a result names the movie that it is of.
"""

from __future__ import annotations

import errno
import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from iscat_analysis.errors import DataError
from iscat_analysis.reading import open_regular

_UNFINISHED: dict[Path, bool] = {}  # all true; the last begun is last
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Register a path that `discard_unfinished` removes while the block runs."""
    _UNFINISHED[path] = True
    try:
        yield
    finally:
        kept = _UNFINISHED.pop(path, False)
    if not kept:
        raise KeyboardInterrupt


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file under another name, and rename it when it is complete."""
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}.partial")
    partial.touch(exist_ok=False)  # nobody else's file or link has this name
    try:
        with unfinished(partial):
            yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def discard_unfinished() -> None:
    """Remove what is being written, for a process that ends without unwinding its stack."""
    while _UNFINISHED:
        path, _ = _UNFINISHED.popitem()
        if path.is_dir():
            remove_folder(path)
        else:
            path.unlink(missing_ok=True)


def remove_folder(folder: Path) -> None:
    """Remove a folder, also if an interrupt or a new file arrives meanwhile."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        if folder.exists():
            shutil.rmtree(folder, ignore_errors=True)


def take(lock: FileLock, timeout_s: float) -> bool:
    """Take a lock within some time, for ever where it is negative.

    False where the disk knows no locks: work goes on without.  Raises `filelock.Timeout` where
    another run holds the lock, and DataError where a link is in its place.
    """
    try:
        lock.acquire(timeout=timeout_s)
    except Timeout:
        raise
    except OSError as error:
        if error.errno == errno.ELOOP or Path(lock.lock_file).is_symlink():
            raise DataError(
                f"{lock.lock_file}: is a link, where a lock has to be a file, and is left alone; "
                "remove it, or choose another `out`"
            ) from None
        if error.errno not in _NO_LOCKS:
            raise
        return False
    return True


def sha256_of_files(files: Sequence[Path], part: str = "") -> str:
    """Hash a movie, without holding it in memory."""
    digest = hashlib.sha256()
    for path in files:
        try:
            with open_regular(path) as file:
                hashlib.file_digest(file, lambda: digest)
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
