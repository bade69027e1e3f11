"""Jobs for processes that import them by their name."""

from __future__ import annotations

import warnings


def warn(text: str, *, progress: object) -> None:
    """Warn of something."""
    del progress
    warnings.warn(text, UserWarning, stacklevel=1)
