"""The files in which compiled kernels are kept: what cannot be read is compiled again."""

from __future__ import annotations

import pickle
from typing import Any

from numba.core.caching import IndexDataCacheFile

_UNREADABLE = (OSError, EOFError, pickle.UnpicklingError)
"""Of files that are cut short or full of zeros, as after a crash or on a full disk."""


class KeptFiles(IndexDataCacheFile):  # type: ignore[misc]  # Numba is not typed
    """Numba's files of one function."""

    def load(self, key: Any) -> Any:
        """Give what was kept."""
        try:
            return super().load(key)
        except _UNREADABLE:
            return None

    def _load_index(self) -> dict[Any, str]:
        try:
            return dict(super()._load_index())
        except _UNREADABLE:
            return {}
