"""Libraries without what no command uses of them: a tenth of a second to load."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import LazyLoader, find_spec, module_from_spec

_UNUSED = ("f2py", "testing")


def load_numpy() -> None:
    """Load NumPy, but not yet its compiler of Fortran and its tools for tests.

    SciPy takes every name that NumPy has, and so loads these as well, which takes as long as NumPy
    itself.  Here they have their names, and are loaded by who uses them.
    """
    import numpy as np

    for unused in _UNUSED:
        name = f"numpy.{unused}"
        spec = None if name in sys.modules else find_spec(name)
        if spec is not None and spec.loader is not None:
            spec.loader = LazyLoader(spec.loader)
            sys.modules[name] = module = module_from_spec(spec)
            spec.loader.exec_module(module)
            setattr(np, unused, module)


@contextmanager
def without(name: str) -> Iterator[None]:
    """Have libraries that are loaded take an optional one for missing, if nobody has loaded it."""
    hidden = name not in sys.modules
    if hidden:
        sys.modules[name] = None  # type: ignore[assignment]  # which import takes for missing
    try:
        yield
    finally:
        if hidden:
            del sys.modules[name]
