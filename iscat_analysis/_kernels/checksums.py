"""Checksums of compiled kernels on disk: code that is damaged is removed and compiled again.

Numba runs the machine code that it finds in its cache as it is, and a flipped bit there ends the
process.  A list of SHA-256 stands beside the files.  What is not in the list is not trusted, and a
process adds only what it compiled itself.
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
_PATIENCE_S = 5.0  # with others that write the list; an entry that is lost costs a compilation
_ROOM_BYTES = 2**25  # all kernels of one analysis
_KINDS = (".nbi", ".nbc")  # Numba's indices and its compiled code


class Compiled(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """Notes how the files of the functions begin that this process compiles, and lists them.

    Numba writes a function's files right after it has compiled it.  They are listed when the next
    one is compiled, so that a process that lives for hours has little that others do not trust.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._begin: set[str] = set()
        self._running: list[object] = []  # a function that others call is compiled within them

    def on_start(self, event: event.Event) -> None:
        """Note a function, by what Numba names its files after."""
        if not self._running:
            self.record()
        dispatcher = event.data["dispatcher"]
        self._running.append(dispatcher)
        function = dispatcher.py_func
        code = getattr(function, "__code__", None)
        if code is None:  # nothing that has a file
            return
        name = f"{inspect.getmodulename(code.co_filename)}.{function.__qualname__}"
        name = name.replace("<", "").replace(">", "")
        self._begin.add(f"{name}-{code.co_firstlineno}.")

    def on_end(self, event: event.Event) -> None:
        """Leave a function."""
        self._running.remove(event.data["dispatcher"])

    def record(self) -> None:
        """List what this process compiled since it last did."""
        compiled, self._begin = tuple(self._begin), set()
        record(self._folder, compiled)


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


def record(folder: str, compiled: tuple[str, ...]) -> None:
    """Add the files that begin so to the list; a full disk costs the next run time."""
    found = _digests(folder, compiled) if compiled else {}
    if not found:
        return
    lock = FileLock(f"{folder}/{_LOCK}", fallback_to_soft=False)
    with suppress(OSError):  # without, the later of two processes wins
        lock.acquire(timeout=_PATIENCE_S)
    try:
        _replace(folder, _listed(folder) | found)
    finally:
        lock.release()


def _replace(folder: str, digests: dict[str, str]) -> None:
    """Write the list whole, or leave it as it is."""
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
    """Hash the compiled files of a folder whose names begin so."""
    found: dict[str, str] = {}
    with suppress(OSError):
        for name in sorted(os.listdir(folder)):  # noqa: PTH208
            if name.endswith(_KINDS) and name.startswith(begin):
                with suppress(OSError), open(f"{folder}/{name}", "rb") as file:  # noqa: PTH123
                    found[name] = hashlib.file_digest(file, "sha256").hexdigest()
    return found
