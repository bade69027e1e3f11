"""Checksums of compiled kernels on disk: code that is damaged is removed and compiled again.

Numba runs the machine code that it finds in its cache as it is, and a flipped bit there ends the
process.  A list of SHA-256 stands beside the files.  What is not in the list is not trusted.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from contextlib import suppress

_LIST = "checksums.json"
_ROOM_BYTES = 2**25  # all kernels of one analysis
_KINDS = (".nbi", ".nbc")  # Numba's indices and its compiled code


def refusal(folder: str) -> str:
    """Tell why the system gives no room for compiled files; nothing where it does."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            if folder and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, _ROOM_BYTES)
    except OSError as error:
        return error.strerror or str(error)
    return ""


def remove_damaged(folder: str) -> None:
    """Remove the compiled files of a folder that are not as they were written."""
    known = _listed(folder)
    for name, digest in _digests(folder).items():
        if known.get(name) != digest:
            with suppress(OSError):
                os.unlink(f"{folder}/{name}")  # noqa: PTH108  # kernels know no paths


def record(folder: str) -> None:
    """List the compiled files of a folder as they are now; a full disk costs the next run time."""
    found = _digests(folder)
    if not found or found == _listed(folder):
        return
    with suppress(OSError), tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as file:
        json.dump(found, file)
        file.close()
        os.replace(file.name, f"{folder}/{_LIST}")  # noqa: PTH105


def _listed(folder: str) -> dict[str, str]:
    try:
        with open(f"{folder}/{_LIST}", encoding="utf-8") as file:  # noqa: PTH123
            known = json.load(file)
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _digests(folder: str) -> dict[str, str]:
    """Hash the compiled files of a folder."""
    found: dict[str, str] = {}
    with suppress(OSError):
        for name in sorted(os.listdir(folder)):  # noqa: PTH208
            if name.endswith(_KINDS):
                with suppress(OSError), open(f"{folder}/{name}", "rb") as file:  # noqa: PTH123
                    found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
