"""Arrays in, arrays out: the compiled inner loops and the tables they run on.

Numba keeps what it compiled in the package's folder, or where that cannot be written in the user's.
Where neither can, it refuses to begin; kernels are then kept as long as the process lives.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile

from numba import config, njit

from iscat_analysis.errors import ConfigError


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


def environment() -> dict[str, str]:
    """Give the environment of a process that keeps compiled kernels where this one does.

    Returns
    -------
    dict of str to str
        For `subprocess.Popen`.
    """
    return os.environ | ({"NUMBA_CACHE_DIR": config.CACHE_DIR} if TEMPORARY else {})
