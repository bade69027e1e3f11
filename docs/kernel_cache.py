"""One folder of compiled kernels for the tests, the manual, and every process that they start."""

from __future__ import annotations

import os
from importlib.metadata import version
from pathlib import Path


def share_kernels(root: Path) -> None:
    """Name the folder in the environment, unless it is named there.

    Kernels that were compiled with one version of NumPy or Numba do not serve another.

    Parameters
    ----------
    root : Path
        The checkout.
    """
    names = (f"{name}-{version(name)}" for name in ("numba", "numpy"))
    os.environ.setdefault("NUMBA_CACHE_DIR", str(root / ".kernels" / "_".join(names)))
