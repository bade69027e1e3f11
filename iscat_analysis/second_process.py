"""A second process beside this one, which does jobs at the same time and ends with it."""

from __future__ import annotations

import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from iscat_analysis.records import silent
from iscat_analysis.threads import allotted, processors

R = TypeVar("R")
_Warned = tuple[str, type[Warning], str, int]


class SecondProcess:
    """A process beside this one, which is started at once and imports what its jobs need.

    It ends with this process, however that ends: at the other end of a pipe from which nothing is
    ever read, it sees that the pipe is closed.
    """

    def __init__(self, modules: Sequence[str]) -> None:
        context = get_context("spawn")
        watched, self._held = context.Pipe(duplex=False)
        with _signals_kept():
            self._pool = ProcessPoolExecutor(
                1, mp_context=context, initializer=_end_with, initargs=(watched,)
            )
        self._pool.submit(_import_all, modules)

    def call(self, job: Callable[..., R], /, *arguments: Any) -> R:
        """Do a job there and wait for it."""
        result, warned = self._pool.submit(_with_half, job, *arguments).result()
        for one in warned:
            warnings.warn_explicit(*one)
        return result

    def end(self) -> None:
        """Kill it, whatever it does."""
        self._held.close()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Let it end when it has nothing to do."""
        self._pool.shutdown(wait=False, cancel_futures=True)


@contextmanager
def _signals_kept() -> Iterator[None]:
    """Leave signals blocked that multiprocessing unblocks when it makes its first lock."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    yield
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _end_with(watched: Connection) -> None:
    """Let this process end when the other end of a pipe is closed; Ctrl-C is the other's to see."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):  # what the other blocks is blocked here as well
        signal.pthread_sigmask(signal.SIG_SETMASK, ())

    def watch() -> None:
        watched.poll(None)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True, name="other end").start()


def _import_all(modules: Sequence[str]) -> None:
    """Import modules."""
    for module in modules:
        import_module(module)


def _with_half(job: Callable[..., R], *arguments: Any) -> tuple[R, list[_Warned]]:
    """Do a job with half of the processors; give what it warned of, for the first to say."""
    with (
        warnings.catch_warnings(record=True) as caught,
        allotted(max(1, processors() // 2), lambda: None),
    ):
        result = job(*arguments, progress=silent)
    return result, [(str(one.message), one.category, one.filename, one.lineno) for one in caught]
