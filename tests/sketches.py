"""Reports whose figures are not drawn, which takes most of the time of a small run."""

from __future__ import annotations

import pytest


def sketch_figures(patch: pytest.MonkeyPatch, *, pause_s: float = 0.0) -> None:
    """Do nothing: no page draws a figure."""
    del patch, pause_s
