"""Preloaded by the workers that tests start: their reports are written without figures."""

from __future__ import annotations

from typing import Any

import pytest
from sketches import sketch_figures


def dask_setup(worker: Any) -> None:
    """Prepare a worker."""
    del worker
    sketch_figures(pytest.MonkeyPatch())
