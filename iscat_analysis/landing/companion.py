"""A second process beside this one, which does half of the chunks of a landing movie.

Threads of one process take turns at Python, so that two of them analyse chunks no faster than one.
The second process is a copy of the first, made when the models are ready and their kernels loaded:
it shares their memory, has nothing to load, and opens the movie again for itself.  Systems other
than Linux have none (`iscat_analysis.copies`).
"""

from __future__ import annotations

import os
import pickle
import queue
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

from iscat_analysis.config import Config
from iscat_analysis.copies import Copy, LostError
from iscat_analysis.landing.chunk_work import ChunkSetting
from iscat_analysis.memory import give_back_freed_memory
from iscat_analysis.places import Here, Place
from iscat_analysis.records import Progress, silent
from iscat_analysis.threads import allotted, is_allotted, processors

_LOOK_S = 0.2  # between two looks at whether an interrupt has come
_PATIENCE, _PATIENCE_S = 10.0, 30.0  # for its last item: times the longest of ours, and more

T = TypeVar("T")
R = TypeVar("R")


class Pair:
    """The process that asks, and a copy of it for as long as `each` is at work."""

    def __init__(self, threads: int) -> None:
        self._first = os.getpid()
        self._threads = max(1, threads // 2)
        self._opened: tuple[object, Any] | None = None  # as given, and as opened again

    @property
    def distant(self) -> bool:
        """Whether this is the second process."""
        return os.getpid() != self._first

    def remarks(self, memory_limit_mb: int) -> list[str]:
        """Say nothing; see `iscat_analysis.places.Place`."""
        del memory_limit_mb
        return []

    def threads(self, wanted: int) -> int:
        """Give half of the threads to each process; see `iscat_analysis.places.Place`."""
        del wanted
        return self._threads

    def call(self, job: Callable[..., R], /, *arguments: Any, progress: Progress = silent) -> R:
        """Do a job in this process; see `iscat_analysis.places.Place`.

        In the second one the first argument, which holds the movie, is taken as another process
        would receive it, once for all jobs.
        """
        if not self.distant:
            return job(*arguments, progress=progress)
        common, *rest = arguments
        if self._opened is None or self._opened[0] is not common:
            self._opened = common, pickle.loads(pickle.dumps(common))
        with allotted(self._threads, lambda: None):
            return job(self._opened[1], *rest, progress=progress)

    def each(self, work: Callable[[T], R], items: Sequence[T]) -> Generator[tuple[int, R]]:
        """Do something with every item, in both processes; see `iscat_analysis.places.Place`.

        The first item is done here, where it may have been begun.  What the second process was at
        when it was lost is done in the first.  So is what it does not finish: a lock that another
        thread held when the copy was made is never released there.
        """
        waiting = deque(enumerate(items))
        begun_here = deque([waiting.popleft()] if waiting else ())
        done: queue.SimpleQueue[tuple[int, R] | Exception] = queue.SimpleQueue()
        try:
            other = Copy(lambda number: work(items[number]))
        except OSError:  # there is no room for another process
            yield from Here().each(work, items)
            return

        asked = threading.Event()

        def drive() -> None:
            try:
                ask()
            finally:
                asked.set()
                other.end()  # which takes 20 ms, and nothing waits for it
                other.close()

        def ask() -> None:
            while waiting:
                try:
                    number, item = waiting.popleft()
                except IndexError:  # the other thread was quicker
                    return
                try:
                    done.put((number, other.do(number)))
                except LostError:
                    waiting.appendleft((number, item))
                    return
                except Exception as error:  # noqa: BLE001  # raised where results are asked for
                    done.put(error)
                    return

        driver = threading.Thread(target=drive, daemon=True, name="companion")
        driver.start()
        longest, idle_since = 0.0, 0.0
        try:
            # whether it is done is looked at first: what it leaves behind is there then
            while begun_here or not asked.is_set() or waiting or not done.empty():
                while not done.empty():
                    found = done.get()
                    if isinstance(found, Exception):
                        raise found
                    yield found
                try:
                    number, item = (begun_here or waiting).popleft()
                except IndexError:
                    idle_since = idle_since or time.monotonic()
                    asked.wait(_LOOK_S)
                    if time.monotonic() - idle_since > _PATIENCE * longest + _PATIENCE_S:
                        other.end()
                    continue
                begun = time.monotonic()
                result = work(item)
                longest = max(longest, time.monotonic() - begun)
                yield number, result
        except BaseException:
            other.end()
            driver.join()
            raise


def paired(place: Place, config: Config, setting: ChunkSetting, chunks: int) -> Place:
    """Let a second process help, where there is something to do for it and room."""
    wanted = (
        sys.platform == "linux"
        and isinstance(place, Here)
        and not is_allotted()
        and chunks > 1
        and min(config.compute.workers, processors()) > 1
    )
    if not wanted:
        return place
    try:
        pickle.dumps(setting)
    except TypeError:  # an array in memory, which cannot be opened again
        return place
    give_back_freed_memory()  # two processes hold it
    return Pair(config.compute.workers)
