"""The compiled inner loops and their tables; they take and return arrays only.

Numba stores compiled kernels in the package's folder, or in the user's cache if that folder cannot
be written; NUMBA_CACHE_DIR names another folder.  If none can be written, they are kept until the
process ends.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Set
from typing import Any

from iscat_analysis.errors import ConfigError

try:
    from numba import config, njit
    from numba.core import event
except ValueError as error:  # from an environment variable such as NUMBA_NUM_THREADS=0
    raise ConfigError(
        f"Numba refuses a variable of the environment ({error}): correct or unset those that "
        "begin with NUMBA_"
    ) from None

from iscat_analysis._kernels import checksums


def _probe() -> None:
    """Do nothing; Numba compiles this function to find its folder."""


def _find_folder() -> tuple[str, bool]:
    """Name the folder of compiled kernels, and tell whether it is removed when the process ends."""
    if config.DISABLE_JIT:
        return "", False
    try:
        return njit(cache=True)(_probe).stats.cache_path, False
    except RuntimeError:
        try:
            folder = tempfile.mkdtemp(prefix="iscat-kernels-")
        except OSError:
            raise ConfigError(
                "no folder can be written in which compiled kernels could be kept: set "
                "NUMBA_CACHE_DIR to one that can"
            ) from None
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        config.CACHE_DIR = folder
        return folder, True


FOLDER, TEMPORARY = _find_folder()
"""Folder of compiled kernels, and whether every process compiles its kernels again."""

NO_ROOM = checksums.refusal(FOLDER)
"""Why the folder cannot store more, for example on a full disk; empty if it can."""

checksums.remove_damaged(FOLDER)

_COMPILED = checksums.Compiled(FOLDER)
event.register("numba:compile", _COMPILED)


def record_checksums() -> None:
    """List the kernels that this process compiled, so that later processes load them."""
    _COMPILED.record()


atexit.register(record_checksums)


def environment() -> dict[str, str]:
    """Give the environment of a process that uses the same folder of compiled kernels."""
    return os.environ | ({"NUMBA_CACHE_DIR": config.CACHE_DIR} if TEMPORARY else {})


def kernel(
    *, fastmath: bool | Set[str] = False, forceinline: bool = False, _nrt: bool = True
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function with Numba at its first call, and store the compiled code.

    The function runs without the interpreter's lock, and divides by zero like NumPy.  No entry for
    callers in C is compiled, which nobody calls and which takes a twentieth of the time.
    """
    decorator: Callable[[Callable[..., Any]], Any] = njit(
        cache=not NO_ROOM, nogil=True, error_model="numpy",
        fastmath=fastmath, forceinline=forceinline, _nrt=_nrt, no_cfunc_wrapper=True,
    )  # fmt: skip
    return decorator
