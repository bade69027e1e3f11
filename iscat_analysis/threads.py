"""Threads for independent work."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """Run independent tasks in threads.

    Linear algebra keeps to the thread that calls it: libraries would start one more for every
    processor in each of ours, and small products then take several times as long.

    Parameters
    ----------
    count : int
        Threads at most.

    Yields
    ------
    ThreadPoolExecutor
        Open until the block ends.
    """
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(count) as pool:
        yield pool
