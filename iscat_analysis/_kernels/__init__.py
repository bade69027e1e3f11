"""Arrays in, arrays out: the compiled inner loops and the tables they run on.

Numba keeps what it compiled in the package's folder, or where that cannot be written in the user's;
NUMBA_CACHE_DIR names another.  Where nothing can be written, kernels are kept as long as the
process lives.
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
except ValueError as error:  # of a variable of the environment, as NUMBA_NUM_THREADS=0
    raise ConfigError(
        f"Numba refuses a variable of the environment ({error}): correct or unset those that "
        "begin with NUMBA_"
    ) from None

from iscat_analysis._kernels import checksums


def _probe() -> None:
    """Be something to compile."""


def _find_folder() -> tuple[str, bool]:
    """Name the folder of compiled kernels, and tell whether it is removed in the end."""
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
"""Where compiled kernels are kept, and whether every process compiles its kernels anew."""

NO_ROOM = checksums.refusal(FOLDER)
"""Why nothing more can be kept there, as on a full disk; empty where it can."""

checksums.remove_damaged(FOLDER)

_COMPILED = checksums.Compiled(FOLDER)
event.register("numba:compile", _COMPILED)


def record_checksums() -> None:
    """Vouch for what this process compiled, so that the next one takes it."""
    _COMPILED.record()


atexit.register(record_checksums)


def environment() -> dict[str, str]:
    """Give the environment of a process that keeps compiled kernels where this one does."""
    return os.environ | ({"NUMBA_CACHE_DIR": config.CACHE_DIR} if TEMPORARY else {})


def kernel(
    *, fastmath: bool | Set[str] = False, forceinline: bool = False, _nrt: bool = True
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function by Numba when it is first called, and keep what was compiled.

    It runs without the interpreter's lock, and divides by zero as NumPy does.
    """
    decorator: Callable[[Callable[..., Any]], Any] = njit(
        cache=not NO_ROOM, nogil=True, error_model="numpy",
        fastmath=fastmath, forceinline=forceinline, _nrt=_nrt,
    )  # fmt: skip
    return decorator
