"""The scheduler and the workers that tests start, whose reports are written without figures."""

from __future__ import annotations

import os
import time
from importlib import import_module

from iscat_analysis.threads import threads


def serve(kind: str, options: list[str]) -> None:
    """Be a ``scheduler`` or a ``worker``."""
    import_module(f"distributed.cli.dask_{kind}").main(options)


def busy(seconds: float, *, progress: object = None) -> tuple[int, int, float, float]:
    """Give the process, its threads, and when it was busy."""
    del progress
    began = time.monotonic()
    with threads(7) as pool:
        count = pool._max_workers
    time.sleep(seconds)
    return os.getpid(), count, began, time.monotonic()
