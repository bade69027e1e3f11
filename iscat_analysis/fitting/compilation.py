"""The message that kernels are being compiled, in the first run."""

from __future__ import annotations

import gc
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event

from iscat_analysis import _kernels

PATIENCE_S = 1.0  # of compilation, before it is announced
_ROOM = f"{_kernels.__name__}."
ANNOUNCED = threading.Event()
"""Set once this process has said it."""


class Compilation(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """Listens to Numba; `compiling` makes it.

    Compilers leave few cycles of objects, and to look for them takes a tenth of the time.
    """

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._depth = 0
        self._timer: threading.Timer | None = None
        self._collects = gc.isenabled()

    def on_start(self, event: event.Event) -> None:
        """Note that a function is being compiled."""
        self._depth += 1
        gc.disable()
        ours = event.data["dispatcher"].py_func.__module__.startswith(_ROOM)
        if ours and self._timer is None:
            self._timer = threading.Timer(PATIENCE_S, self._announce)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: event.Event) -> None:
        """Note that it is compiled."""
        del event
        self._depth -= 1
        if self._collects and not self._depth:
            gc.enable()

    def _announce(self) -> None:
        if self._depth and not ANNOUNCED.is_set():
            ANNOUNCED.set()
            self._notify("compiling the numerical kernels of this analysis; later runs load them…")

    def close(self) -> None:
        """Stop listening."""
        if self._timer is not None:
            self._timer.cancel()


@contextmanager
def compiling(notify: Callable[[str], None]) -> Iterator[None]:
    """Say once in this process that kernels are compiled, if they are while the block runs."""
    listener = Compilation(notify)
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        listener.close()
