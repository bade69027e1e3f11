"""The compiled inner loops and their tables; they take and return arrays only.

Compiled kernels are kept in the user's cache, or in the package's folder if that cannot be written;
NUMBA_CACHE_DIR names another folder.  If none can be written, every process compiles its own.
"""

from __future__ import annotations

from collections.abc import Callable, Set
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import ConfigError

try:
    from numba import config, njit
except ValueError as error:  # from an environment variable such as NUMBA_NUM_THREADS=0
    raise ConfigError(
        f"Numba refuses a variable of the environment ({error}): correct or unset those that "
        "begin with NUMBA_"
    ) from None

from iscat_analysis._kernels.kept import Kept, can_be_kept

FloatArray = NDArray[np.float64]
AnyFloatArray = NDArray[np.floating[Any]]
SingleArray = NDArray[np.float32]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
ComplexArray = NDArray[np.complex128]

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""What the compiler may do to the rounding of loops: all but assume that numbers are finite."""


def kernel(
    *, fastmath: bool | Set[str] = False, forceinline: bool = False, _nrt: bool = True
) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function with Numba at its first call, and keep the compiled code.

    The function runs without the interpreter's lock, and divides by zero like NumPy.  No entry for
    callers in C is compiled, which nobody calls and which takes a twentieth of the time.
    """
    decorator = njit(
        nogil=True, error_model="numpy",
        fastmath=fastmath, forceinline=forceinline, _nrt=_nrt, no_cfunc_wrapper=True,
    )  # fmt: skip

    def decorated(function: Callable[..., Any]) -> Any:
        dispatcher = decorator(function)
        if not config.DISABLE_JIT and can_be_kept(function):
            dispatcher._cache = Kept(function)
        return dispatcher

    return decorated
