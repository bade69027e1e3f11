"""Threads for independent work, and the processors that are there for it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")


_ALLOTTED: ContextVar[tuple[int, Callable[[], None]] | None] = ContextVar("allotted", default=None)


def _wanted() -> None:
    """Do nothing: the work is not cancelled."""


class _Pool(ThreadPoolExecutor):
    """Threads that check before each task whether work is cancelled; one alone is the caller's."""

    def __init__(self, count: int, stop: Callable[[], None] = _wanted) -> None:
        super().__init__(max(count, 1))
        self._alone, self._stop = count <= 1, stop

    def submit(self, task: Callable[..., Any], /, *args: Any, **options: Any) -> Future[Any]:
        def watched() -> Any:
            self._stop()
            return task(*args, **options)

        if not self._alone:
            return super().submit(watched)
        self._stop()
        done: Future[Any] = Future()
        try:
            done.set_result(task(*args, **options))
        except Exception as error:  # noqa: BLE001  # raised where the result is asked for
            done.set_exception(error)
        return done


def processors() -> int:
    """Count the processors that this process may use, which may be fewer than there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def start_in_thread(work: Callable[..., T], *arguments: Any) -> Future[T]:
    """Run a function in a thread of its own, with no more threads than are allotted to this one."""
    pool = ThreadPoolExecutor(1)
    begun = pool.submit(copy_context().run, work, *arguments)
    pool.shutdown(wait=False)
    return begun


@contextmanager
def one_thread_algebra() -> Iterator[None]:
    """Keep linear algebra to the thread that calls it, so that its sums have one order."""
    with threadpool_limits(1, user_api="blas"):
        yield


@contextmanager
def threads(count: int) -> Iterator[ThreadPoolExecutor]:
    """Run independent tasks in threads.

    Linear algebra keeps to the thread that calls it: libraries would start one more for every
    processor in each of ours, and small products then take several times as long.
    """
    pool = _Pool(*(_ALLOTTED.get() or (count,)))
    with one_thread_algebra(), pool:
        yield pool


@contextmanager
def allotted(count: int, stop: Callable[[], None]) -> Iterator[None]:
    """Limit `threads` to the number of an executor, whatever number it is asked for."""
    token = _ALLOTTED.set((count, stop))
    try:
        yield
    finally:
        _ALLOTTED.reset(token)
