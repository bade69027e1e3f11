"""The message that kernels are being compiled, in the first run."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event

from iscat_analysis import _kernels

_PATIENCE_S = 1.0  # of compilation, before it is announced
_ROOM = f"{_kernels.__name__}."


class Compilation(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """Listens to Numba; `compiling` makes it."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._depth = 0
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        """Note that a function is being compiled."""
        self._depth += 1
        ours = event.data["dispatcher"].py_func.__module__.startswith(_ROOM)
        if ours and self._timer is None:
            self._timer = threading.Timer(_PATIENCE_S, self._announce)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: event.Event) -> None:
        """Note that it is compiled."""
        del event
        self._depth -= 1

    def _announce(self) -> None:
        if self._depth:
            self._notify("compiling the numerical kernels, once per installation…")

    def close(self) -> None:
        """Stop listening."""
        if self._timer is not None:
            self._timer.cancel()


@contextmanager
def compiling(notify: Callable[[str], None]) -> Iterator[None]:
    """Say which functions are being compiled while the block runs."""
    if _kernels.TEMPORARY:
        notify(
            "compiled kernels cannot be kept, because neither the installation nor the home "
            "folder can be written: every run compiles them anew; set NUMBA_CACHE_DIR to a folder "
            "that can be written"
        )
    elif _kernels.NO_ROOM:
        notify(
            f"compiled kernels cannot be kept in {_kernels.FOLDER} ({_kernels.NO_ROOM}): every run "
            "compiles them anew; make room there, or set NUMBA_CACHE_DIR to another folder"
        )
    listener = Compilation(notify)
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        listener.close()
        _kernels.record_checksums()
