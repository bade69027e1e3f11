"""Arrays in, arrays out: the compiled inner loops and the tables they run on.

Numba keeps what it compiled in the package's folder, or where that cannot be written in the user's.
Where neither can, it refuses to begin; kernels are then kept as long as the process lives.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Callable, Set
from contextlib import AbstractContextManager
from typing import Any

import numba
from numba import config, njit
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys

from iscat_analysis._kernels.claims import claimed
from iscat_analysis._kernels.store import KeptFiles
from iscat_analysis.errors import ConfigError

_INSIDE = range(62, 69)
"""Minor versions of Numba 0 whose insides are known: others compile every kernel as a whole."""

_major, _minor, *_ = numba.__version__.split(".")
if _major == "0" and _minor.isdecimal() and int(_minor) in _INSIDE:
    from iscat_analysis._kernels import compiler as _compiler
else:
    _compiler = None  # type: ignore[assignment]


def _probe() -> None:
    """Be something to compile."""


def _find_room() -> bool:
    """Whether compiled kernels go to a folder that is removed in the end."""
    try:
        njit(cache=True)(_probe)
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
        return True
    return False


TEMPORARY = _find_room()
"""Whether every process compiles its kernels anew."""

UNKEPT: dict[str, str] = {}
"""Folders in which this process could not keep what it compiled, and the system's reason."""


def environment() -> dict[str, str]:
    """Give the environment of a process that keeps compiled kernels where this one does."""
    return os.environ | ({"NUMBA_CACHE_DIR": config.CACHE_DIR} if TEMPORARY else {})


class _KernelCache(FunctionCache):  # type: ignore[misc]  # Numba is not typed
    """Numba's compiled functions on disk, of which one is loaded without what only compiling needs.

    Numba's own registers first how everything it knows is compiled, which takes as long as loading
    all kernels of a small run.
    """

    if _compiler is not None:
        _impl_class = _compiler.KernelStore

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        impl = self._impl
        self._cache_file = KeptFiles(
            self._cache_path, impl.filename_base, impl.locator.get_source_stamp()
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with self._guard_against_spurious_io_errors():
            rtsys.initialize(target_context)
            loaded = self._load_overload(sig, target_context)
            if loaded is not None:
                return loaded
        return super().load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            with self.claimed():  # its list of signatures is written anew
                super().save_overload(sig, data)
        except OSError as error:  # a full disk, say
            UNKEPT[self.cache_path] = error.strerror or str(error)

    def claimed(self, arguments: object = "") -> AbstractContextManager[None]:
        """Claim the function, or what is compiled of it for some arguments."""
        function = self._py_func
        return claimed(self.cache_path, f"{function.__module__}.{function.__qualname__}{arguments}")


def kernel(
    *, fastmath: bool | Set[str] = False, forceinline: bool = False, _nrt: bool = True
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function by Numba when it is first called, and keep what was compiled.

    What only other kernels call is compiled as a part of them (`iscat_analysis._kernels.compiler`).
    It runs without the interpreter's lock, and divides by zero as NumPy does.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        if config.DISABLE_JIT:
            return function
        options = {
            "nogil": True, "error_model": "numpy", "fastmath": fastmath,
            "forceinline": forceinline, "_nrt": _nrt,
        }  # fmt: skip
        if _compiler is None:
            dispatcher = njit(**options)(function)
        else:
            dispatcher = _compiler.Kernel(function, options)
        dispatcher._cache = _KernelCache(function)
        return dispatcher

    return compiled
