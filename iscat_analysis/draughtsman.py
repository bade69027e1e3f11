"""A process that draws figures, started before they are wanted so that it is ready then.

Loading Matplotlib and drawing take as long as the rest of a small run.  The process loads it while
a movie is analysed, and then draws while tables are written.  What it has loaded is 100 MB, and as
much is no longer shared with the process that it is a copy of, so that for a movie of many chunks
it is started when most of the work is done.  On Linux it is a copy of the process that starts it,
and has what that has loaded; elsewhere it is started from a file of this package, never from the
user's script.  It ends when the process that started it does.
"""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from iscat_analysis.copies import Copy, LostError
from iscat_analysis.threads import processors

if TYPE_CHECKING:
    from iscat_analysis.records import Analysis

_DRAWING = "iscat_analysis.report.drawing"

_SHARED = ("pandas", "scipy.special")
"""What both processes need, and what is loaded once if the copy is made after it."""

Order: TypeAlias = "tuple[Analysis, Path, int] | Mapping[str, Any] | None"
"""What to begin with, the summary to end with, or nothing yet: get ready."""


class Draughtsman:
    """The process, which is still to be started, and is ended by `close`."""

    def __init__(self) -> None:
        self._other: _Other | None = None
        self._thread = ThreadPoolExecutor(1)  # that asks it one thing after the other
        self._begun = False
        self._answer: Future[Any] | None = None
        self._ending = False  # all is drawn

    def start(self) -> None:
        """Start it, once; not where this process has Matplotlib loaded, or none can be started."""
        if self._other is None and "matplotlib" not in sys.modules:
            self._other = _started()
            if self._other is not None:
                self._thread.submit(self._other.do, None)

    def begin(self, analysis: Analysis, folder: Path, most: int) -> None:
        """Let it draw what does not depend on the species, once, if there is such a process."""
        if not self._begun and self._other is not None:
            self._begun = True
            self._thread.submit(self._other.do, (analysis, folder, most))

    def end(self, summary: Mapping[str, Any]) -> None:
        """Let it draw the rest of what was begun."""
        if self._begun and self._other is not None:
            self._answer = self._thread.submit(self._other.do, summary)

    def page(self) -> str | None:
        """Wait until all is drawn."""
        if self._answer is None or self._other is None:
            return None
        try:
            page: str = self._answer.result()
        except Exception:  # noqa: BLE001  # whoever draws instead finds it again
            return None
        self._ending = True
        self._thread.submit(self._other.end)  # which takes 20 ms, and nothing waits for it
        return page

    def close(self) -> None:
        """End the process, and its copy, whatever they are at."""
        if self._other is not None and not self._ending:
            self._other.end()
        self._thread.shutdown(wait=not self._ending)
        if self._other is not None:
            self._other.close()


class _Other(Protocol):
    """What asks another process."""

    def do(self, order: Order) -> Any:
        """Have it get ready, begin to draw, or end."""

    def end(self) -> None:
        """End it, whatever it is at."""

    def close(self) -> None:
        """Close what led to it."""


def _started() -> _Other | None:
    """Start the process, where there is a processor for it."""
    if processors() < 2:
        return None
    try:
        if sys.platform == "linux":
            for name in _SHARED:
                importlib.import_module(name)
            return Copy(_Copied())
        if sys.executable and not getattr(sys, "frozen", False):
            return _Program()
    except OSError:
        pass
    return None


class _Copied:
    """What is done in a copy of this process."""

    def __init__(self) -> None:
        self._desk: Any = None

    def __call__(self, order: Order) -> str | None:
        if order is None:
            self._desk = importlib.import_module(_DRAWING).Desk()
            return None
        if isinstance(order, tuple):
            self._desk.begin(*order)
            return None
        page: str = self._desk.page(order)
        return page


class _Program:
    """A process that has nothing of this one."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", _DRAWING],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            start_new_session=True,  # Ctrl-C is for the process that started it
        )  # fmt: skip

    def do(self, order: Order) -> str | None:
        if order is None:  # it gets ready by itself
            return None
        sent = pickle.dumps(order, pickle.HIGHEST_PROTOCOL)
        if isinstance(order, tuple) and self._process.stdin is not None:
            self._process.stdin.write(sent)
            return None
        page, _ = self._process.communicate(sent)
        if self._process.returncode:
            raise LostError
        return page.decode("utf-8")

    def end(self) -> None:
        self._process.kill()
        self._process.wait()

    def close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):  # what it was sent is still on the way
                    pipe.close()
