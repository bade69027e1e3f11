"""Compiled kernels on disk, for later processes with the same sources.

Numba's own cache takes a function for unchanged while its own file is, whatever became of kernels
that are inlined into it; numbers its files, so that two processes may take the same number; and
runs what it finds without a check.  Here a folder is named by the hash of all sources of kernels
and of what else decides the machine code, and a file by a function and the types of its arguments.
A file begins with the hash of its content, gets its name when it is complete, and is not written to
again: processes that compile the same kernel at the same time make the same file, and one whose
sources were replaced while it runs does not mix the two.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import secrets
import shutil
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config
from numba.core.compiler import CompileResult
from numba.core.registry import cpu_target
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

_SOURCES = os.path.dirname(__file__)  # noqa: PTH120  # kernels know no paths
_PREFIX = "iscat-kernels-"


def _state(path: str) -> tuple[int, int]:
    """Give what changes of a file when it is edited or replaced."""
    found = os.stat(path)  # noqa: PTH116
    return found.st_mtime_ns, found.st_size


def _read_sources() -> tuple[str, dict[str, tuple[int, int]]]:
    """Hash all sources of kernels; give the state of each as well."""
    digest, states = hashlib.sha256(), {}
    with suppress(OSError):  # packed in an archive: nothing is kept
        for name in sorted(os.listdir(_SOURCES)):  # noqa: PTH208
            if name.endswith(".py"):
                path = os.path.join(_SOURCES, name)  # noqa: PTH118
                states[path] = _state(path)
                with open(path, "rb") as file:  # noqa: PTH123
                    content = file.read()
                digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest(), states


_HASH, _STATES = _read_sources()


def _folder_name() -> str:
    """Hash what decides the machine code; a processor has a name and features."""
    versions = (numba.__version__, llvmlite.__version__, np.__version__, sys.version)
    settings = (
        str(config.OPT), config.BOUNDSCHECK, config.LOOP_VECTORIZE, config.SLP_VECTORIZE,
        config.USING_SVML,
    )  # fmt: skip
    processor = cpu_target.target_context.codegen().magic_tuple()
    return _PREFIX + _short_hash(_HASH, versions, settings, processor)


def _short_hash(*values: object) -> str:
    return hashlib.sha256(repr(values).encode()).hexdigest()[:20]


@cache
def folder() -> str:
    """Give the folder of compiled kernels; it is there, unless none can be made.

    NUMBA_CACHE_DIR names the folder around it.  Otherwise that is the user's cache, or the
    package's where the user has none.
    """
    named = config.CACHE_DIR
    parents = [os.path.abspath(named)] if named else [  # noqa: PTH100  # processes change theirs
        AppDirs("iscat-analysis", appauthor=False).user_cache_dir,
        os.path.join(_SOURCES, "__pycache__"),  # noqa: PTH118
    ]  # fmt: skip
    found = [os.path.join(parent, _folder_name()) for parent in parents]  # noqa: PTH118
    for one, parent in zip(found, parents, strict=True):
        with suppress(OSError):
            new = not os.path.isdir(one)  # noqa: PTH112
            os.makedirs(one, exist_ok=True)  # noqa: PTH103
            if new:
                _remove_unused(parent)
            with suppress(OSError):  # of somebody else: it can be read
                os.utime(one)
            return one
    return found[0]


def _remove_unused(parent: str) -> None:
    """Remove the folders of other sources that no process has begun with for a month."""
    with suppress(OSError):  # another process removes them as well
        for entry in os.scandir(parent):
            unused_s = time.time() - entry.stat().st_mtime
            if entry.name.startswith(_PREFIX) and unused_s > 30 * 86400.0:
                shutil.rmtree(entry.path, ignore_errors=True)


_CHANGED: set[str] = set()
_REFUSED: set[str] = set()


def can_be_kept(function: Callable[..., Any]) -> bool:
    """Tell whether a function is that of the sources that were hashed.

    It is not if it stands elsewhere or has variables of another function around it, or if its file
    was replaced before it was loaded; then what calls it, and is loaded later, is not either.
    """
    path = function.__code__.co_filename
    with suppress(OSError):
        if path in _STATES and _state(path) != _STATES[path]:
            _CHANGED.add(path)
    return path in _STATES and not _CHANGED and function.__closure__ is None


class Kept:
    """The compiled forms of one function; Numba calls the methods, under its own lock."""

    def __init__(self, function: Callable[..., Any]) -> None:
        module = function.__module__.rpartition(".")[2]
        self._name = f"{module}.{function.__qualname__}"
        self._line = function.__code__.co_firstlineno

    @property
    def cache_path(self) -> str:
        """Name the folder."""
        return folder()

    def _path(self, signature: object) -> str:
        name = f"{self._name}-{_short_hash(self._line, signature)}.kernel"
        return os.path.join(folder(), name)  # noqa: PTH118

    def load_overload(self, sig: object, target_context: Any) -> CompileResult | None:
        """Load a form, or None; a file that is damaged is removed."""
        target_context.refresh()
        path = self._path(sig)
        try:
            with open(path, "rb") as file:  # noqa: PTH123
                digest, content = file.read(hashlib.sha256().digest_size), file.read()
        except OSError:
            return None
        if hashlib.sha256(content).digest() == digest:
            return CompileResult._rebuild(target_context, *pickle.loads(content))
        with suppress(OSError):
            os.unlink(path)  # noqa: PTH108
        warnings.warn(
            f"{path}: is damaged, and is compiled again; if this happens more than once, check the "
            "disk",
            stacklevel=2,
        )
        return None

    def save_overload(self, sig: object, result: CompileResult) -> None:
        """Keep a form, or say once why none can be kept."""
        if _REFUSED or result.lifted or result.library.has_dynamic_globals:
            return
        content = dumps(result._reduce())
        path = self._path(sig)
        made = f"{path}.{os.getpid()}-{secrets.token_hex(4)}"
        try:
            os.makedirs(folder(), exist_ok=True)  # noqa: PTH103
            with open(made, "xb") as file:  # noqa: PTH123
                file.write(hashlib.sha256(content).digest() + content)
            os.replace(made, path)  # noqa: PTH105
        except OSError as error:
            if not os.path.exists(path):  # noqa: PTH110  # Windows replaces none that is being read
                _refuse(error)
        finally:
            with suppress(OSError):
                os.unlink(made)  # noqa: PTH108


def _refuse(error: OSError) -> None:
    _REFUSED.add(folder())
    warnings.warn(
        f"compiled kernels cannot be kept in {folder()} ({error.strerror or error}): every run "
        "compiles them anew; make room there and let it be written, or set NUMBA_CACHE_DIR to "
        "another folder",
        stacklevel=3,
    )
