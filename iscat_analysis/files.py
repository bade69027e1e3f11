"""Files that are there whole or not at all, and locks between processes."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from iscat_analysis.errors import DataError

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
