"""How far the work is: bars on a terminal, a line in a notebook, and nothing elsewhere."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from importlib import import_module
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

    from iscat_analysis.records import Progress

P = ParamSpec("P")
R = TypeVar("R")


def automatic(stage: str, done: int, total: int) -> None:
    """Stand for what is shown where somebody looks; `told` puts it in the place of this."""


def told(work: Callable[P, R]) -> Callable[P, R]:
    """Let work show its progress by itself: where stderr is a terminal, and in a notebook.

    Its argument `progress` is `automatic` by default.
    """

    @wraps(work)
    def shown(*args: P.args, **kwargs: P.kwargs) -> R:
        if kwargs.get("progress", automatic) is not automatic:
            return work(*args, **kwargs)
        with _shown() as progress:
            kwargs["progress"] = progress
            return work(*args, **kwargs)

    return shown


@contextmanager
def _shown() -> Iterator[Progress]:
    """Show progress where somebody looks."""
    if _in_notebook():
        shown: Any = import_module("IPython.display")  # it has no types
        line = shown.display({"text/plain": "working"}, raw=True, display_id=True)
        with Lines(
            lambda text: line.update({"text/plain": text}, raw=True), every_s=1.0, first_s=0.0
        ) as lines:
            yield lines
    elif sys.stderr is not None and sys.stderr.isatty():
        from rich.console import Console

        with bars(Console(stderr=True)) as drawn:
            yield drawn
    else:
        yield automatic


def _in_notebook() -> bool:
    """Tell whether IPython runs in the kernel of a notebook."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return shell is not None and "IPKernelApp" in shell.config


@contextmanager
def bars(console: Console) -> Iterator[Progress]:
    """Show bars with the time left on a terminal; one without end moves while no stage reports."""
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[steps]}"),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    lock, tasks = threading.Lock(), dict[str, "TaskID"]()
    with Bars(*columns, console=console, transient=True) as drawn:
        between = drawn.add_task("working", total=None, steps="")

        def show(stage: str, done: int, total: int) -> None:
            with lock:
                if stage not in tasks:
                    tasks[stage] = drawn.add_task(stage, total=total, steps="")
                steps = f"{done}/{total}"
                drawn.update(tasks[stage], completed=done, total=total, steps=steps)
                drawn.update(between, visible=done >= total)

        yield show


class Lines:
    """Progress as lines of text: the end of each stage, and a sign of life in between.

    `say` prints a line.  A stage is told once it has lasted `first_s`, and then every `every_s`; in
    that time something is said even where no stage reports, as while kernels are compiled.
    """

    def __init__(
        self, say: Callable[[str], None], *, first_s: float = 2.0, every_s: float = 10.0
    ) -> None:
        self._say, self._first_s, self._every_s = say, first_s, every_s
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._last_notice = ""
        self._stage = ""
        self._begun = self._heard = time.monotonic()
        self._first = (0.0, 0)  # when the stage first reported, and how much was done
        self._due = self._begun + first_s

    def __enter__(self) -> Lines:
        threading.Thread(target=self._live, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def _live(self) -> None:
        """Say that the work goes on where nothing else was said for long."""
        while not self._ended.wait(self._every_s / 4):
            with self._lock:
                now = time.monotonic()
                if now - self._heard < self._every_s:
                    continue
                self._heard = now
                stage = f" on {self._stage}" if self._stage else ""
                text = f"working{stage}, {duration(now - self._begun)} so far"
            self._say(text)

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Tell that so much of a stage is done, if it is time to."""
        with self._lock:
            now = time.monotonic()
            if stage != self._stage:
                if self._stage:
                    self._due = now + self._first_s
                self._stage, self._first = stage, (now, done)
            text = f"{stage}: {done} of {total}"
            if done < total:
                if now < self._due:
                    return
                self._due = now + self._every_s
                begun, known = self._first
                if done > known:
                    left = (now - begun) * (total - done) / (done - known)
                    text += f", about {duration(left)} left"
            else:
                self._stage, self._due = "", now + self._first_s
            if text == self._last_notice:  # a stage that is run again has said so already
                return
            self._last_notice, self._heard = text, now
        self._say(text)


def duration(seconds: float) -> str:
    """Write a time as people say it: ``"8 s"``, ``"3 min"`` or ``"2 h 5 min"``."""
    if seconds < 100:
        return f"{math.ceil(seconds)} s"
    minutes = math.ceil(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"
