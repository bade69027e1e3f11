"""What a first run compiles is said as it happens."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event

from iscat_analysis import _kernels

_PATIENCE_S = 1.0  # of compilation, before it is announced
_BETWEEN_S = 4.0  # from one line to the next
_ROOM = f"{_kernels.__name__}."
_ABOUT = {
    "curvature": "the precision of fits",
    "diffusion": "diffusion",
    "drift": "the drift of the pattern",
    "goodness": "the goodness of fits",
    "hessian": "the precision of fits",
    "track_precision": "the precision of tracks",
    "mixture": "species",
    "moving": "tracks",
    "peak": "the precision of fits",
    "radial": "the tables of the microscope",
    "scan": "the search of heights",
    "residuals": "the goodness of fits",
    "score_test": "the goodness of fits",
    "scoring": "fits",
    "track_background_operator": "the precision of tracks",
    "sliding": "sums of frames",
    "stepping": "sums of frames",
    "unsteady": "sums of frames",
}
_PICTURES = "the picture of a particle"


class Compilation(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """Listens to Numba; `compiling` makes one."""

    def __init__(self, notify: Callable[[str], None]) -> None:
        self._notify = notify
        self._lock = threading.Lock()
        self._depth = 0
        self._about = ""
        self._said: tuple[str, float] | None = None
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        """Note that a function is being compiled."""
        self._depth += 1
        module = event.data["dispatcher"].py_func.__module__
        if self._depth > 1 or not module.startswith(_ROOM):
            return
        kind = module.removeprefix(_ROOM)
        self._about = _ABOUT.get(kind, _PICTURES)
        if self._timer is None:
            self._timer = threading.Timer(_PATIENCE_S, self._announce)
            self._timer.daemon = True
            self._timer.start()
        elif self._said is not None:
            about, at = self._said
            if about != self._about and time.monotonic() - at > _BETWEEN_S:
                self._say("still compiling")

    def on_end(self, event: event.Event) -> None:
        """Note that it is compiled."""
        del event
        self._depth -= 1

    def _announce(self) -> None:
        if self._depth and self._said is None:
            self._say("compiling the numerical kernels, once per installation")

    def _say(self, text: str) -> None:
        with self._lock:
            self._said = self._about, time.monotonic()
        self._notify(f"{text}: {self._about}…")

    def close(self) -> None:
        """Say nothing any more."""
        if self._timer is not None:
            self._timer.cancel()


@contextmanager
def compiling(notify: Callable[[str], None]) -> Iterator[None]:
    """Say what is compiled until the block ends."""
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
