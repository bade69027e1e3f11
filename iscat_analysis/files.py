"""Files that are there whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_UNFINISHED: set[Path] = set()


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Put a file in place once everything is written.

    Parameters
    ----------
    path : Path
        Replaced where it exists.

    Yields
    ------
    Path
        Beside it: where to write.  It is removed if writing fails.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    _UNFINISHED.add(partial)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
        _UNFINISHED.discard(partial)


def discard_unfinished() -> None:
    """Remove what is being written, for a process that ends without unwinding its stack."""
    for partial in tuple(_UNFINISHED):
        partial.unlink(missing_ok=True)
