"""Checksums of compiled kernels on disk: code that is damaged is removed and compiled again.

Numba runs the machine code in its cache without a check, and a flipped bit there crashes the
process.  A list of SHA-256 checksums is therefore stored beside the files.  Files that are not in
the list are not used, and a process adds only files that it compiled itself.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import tempfile
from contextlib import suppress

from filelock import FileLock
from numba.core import event

_LIST = "checksums.json"
_LOCK = "checksums.lock"
_LOCK_TIMEOUT_S = 5.0  # to wait for others that write the list; a lost entry costs a compilation
_ROOM_BYTES = 2**25  # all kernels of one analysis
_KINDS = (".nbi", ".nbc")  # Numba's indices and its compiled code


class Compiled(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """List the files of the functions that this process compiles, by the beginning of their names.

    Numba writes a function's files right after it has compiled it.  They are listed when the next
    function is compiled, so that other processes can use them while this one runs for hours.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._begin: set[str] = set()
        self._running: list[object] = []  # a called function is compiled while its caller is

    def on_start(self, event: event.Event) -> None:
        """Note a function, by the beginning of its file names."""
        if not self._running:
            self.record()
        dispatcher = event.data["dispatcher"]
        self._running.append(dispatcher)
        function = dispatcher.py_func
        code = getattr(function, "__code__", None)
        if code is None:  # it has no file
            return
        name = f"{inspect.getmodulename(code.co_filename)}.{function.__qualname__}"
        name = name.replace("<", "").replace(">", "")
        self._begin.add(f"{name}-{code.co_firstlineno}.")

    def on_end(self, event: event.Event) -> None:
        """Leave a function."""
        self._running.remove(event.data["dispatcher"])

    def record(self) -> None:
        """List the files that this process compiled since the last call."""
        compiled, self._begin = tuple(self._begin), set()
        record(self._folder, compiled)


def refusal(folder: str) -> str:
    """Say why compiled files cannot be stored; empty if they can."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            if folder and hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, _ROOM_BYTES)
    except OSError as error:
        return error.strerror or str(error)
    return ""


def remove_damaged(folder: str) -> None:
    """Remove the compiled files of a folder that have changed since they were written."""
    known = _listed(folder)
    for name, digest in _digests(folder).items():
        if known.get(name) != digest:
            with suppress(OSError):
                os.unlink(f"{folder}/{name}")  # noqa: PTH108  # kernels know no paths


def record(folder: str, compiled: tuple[str, ...]) -> None:
    """Add the files with these beginnings to the list; if the disk is full, nothing is listed."""
    found = _digests(folder, compiled) if compiled else {}
    if not found:
        return
    lock = FileLock(f"{folder}/{_LOCK}", fallback_to_soft=False)
    with suppress(OSError):  # without the lock, the later of two processes wins
        lock.acquire(timeout=_LOCK_TIMEOUT_S)
    try:
        _replace(folder, _listed(folder) | found)
    finally:
        lock.release()


def _replace(folder: str, digests: dict[str, str]) -> None:
    """Write the whole list, or leave it as it is."""
    with suppress(OSError):
        handle, made = tempfile.mkstemp(dir=folder)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                json.dump(digests, file)
            os.replace(made, f"{folder}/{_LIST}")  # noqa: PTH105
        except OSError:
            os.unlink(made)  # noqa: PTH108


def _listed(folder: str) -> dict[str, str]:
    try:
        with open(f"{folder}/{_LIST}", encoding="utf-8") as file:  # noqa: PTH123
            known = json.load(file)
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}


def _digests(folder: str, begin: tuple[str, ...] = ("",)) -> dict[str, str]:
    """Hash the compiled files of a folder with these beginnings of names."""
    found: dict[str, str] = {}
    with suppress(OSError):
        for name in sorted(os.listdir(folder)):  # noqa: PTH208
            if name.endswith(_KINDS) and name.startswith(begin):
                with suppress(OSError), open(f"{folder}/{name}", "rb") as file:  # noqa: PTH123
                    found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
