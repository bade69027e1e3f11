"""Files that are there whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_UNFINISHED: dict[Path, bool] = {}  # all true; the last begun is last


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Have `discard_unfinished` remove something for as long as the block runs."""
    _UNFINISHED[path] = True
    try:
        yield
    finally:
        kept = _UNFINISHED.pop(path, False)
    if not kept:
        raise KeyboardInterrupt


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Put a file in place once everything is written."""
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
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
