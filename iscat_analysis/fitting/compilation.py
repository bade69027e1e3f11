"""What a first run compiles: said as it happens, and done by two processes."""

from __future__ import annotations

import importlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from numba.core import event

from iscat_analysis import _kernels
from iscat_analysis.config import Config
from iscat_analysis.copies import Copy, LostError
from iscat_analysis.fitting.background_mode import way_of
from iscat_analysis.inference.noise import parts_of
from iscat_analysis.records import FREE_PARAMETERS

_PATIENCE_S = 1.0  # of compilation, before it is announced
_BETWEEN_S = 4.0  # from one line to the next
_REHEARSAL = "iscat_analysis.pipeline.rehearsal"
_ROOM = f"{_kernels.__name__}."
_ABOUT = {
    "curvature": "the precision of fits",
    "diffusion": "diffusion",
    "drift": "the drift of the pattern",
    "goodness": "the goodness of fits",
    "hessian": "the precision of fits",
    "judging": "the precision of tracks",
    "mixture": "species",
    "moving": "tracks",
    "peak": "the precision of fits",
    "radial": "the tables of the microscope",
    "scan": "the search of heights",
    "residuals": "the goodness of fits",
    "score_test": "the goodness of fits",
    "scoring": "fits",
    "sharing": "the precision of tracks",
    "sliding": "sums of frames",
    "stepping": "sums of frames",
    "unsteady": "sums of frames",
}
_PICTURES = "the picture of a particle"


class Compilation(event.Listener):  # type: ignore[misc]  # Numba is not typed
    """Listens to Numba; `compiling` makes one."""

    def __init__(
        self, notify: Callable[[str], None], *, together: bool, needs: Sequence[str]
    ) -> None:
        self.needs = needs
        self._notify = notify
        self._together = together
        self._other: Copy | subprocess.Popen[bytes] | None = None
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
        if self._together and self._other is None:
            self._other = self._started()
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

    def _started(self) -> Copy | subprocess.Popen[bytes] | None:
        """Start the other process; what it does not compile is compiled in this one."""
        try:
            if sys.platform == "linux":
                copied = Copy(self._rehearsed)
                copied.ask(self.needs)
                return copied
            if not sys.executable or getattr(sys, "frozen", False):  # inside another program
                return None
            nowhere = subprocess.DEVNULL
            command = [sys.executable, "-P", "-m", _REHEARSAL, *self.needs]
            return subprocess.Popen(
                command, stdin=nowhere, stdout=nowhere, stderr=nowhere, env=_kernels.environment()
            )
        except (OSError, LostError):
            return None

    def _rehearsed(self, needs: Sequence[str]) -> None:
        """Be the other process, a copy, which says nothing and starts no third one."""
        event.unregister("numba:compile", self)
        importlib.import_module(_REHEARSAL).rehearse(needs)

    def close(self) -> None:
        """Say nothing any more, and end the other process."""
        if self._timer is not None:
            self._timer.cancel()
        if isinstance(self._other, subprocess.Popen):
            self._other.kill()
            self._other.wait()
        elif self._other is not None:
            self._other.end()
            self._other.close()


def needs_of(config: Config) -> tuple[str, ...]:
    """Name the kernels that an analysis needs and not every other one does."""
    way = way_of(config)
    free = FREE_PARAMETERS[config.track.free if way == "tracks" else config.fit.mode]
    parts = parts_of(free, posteriors=config.samples_posterior)
    return parts if way == "fixed" else (*parts, way)


@contextmanager
def compiling(
    notify: Callable[[str], None], workers: int, needs: Sequence[str] = ()
) -> Iterator[Compilation]:
    """Say what is compiled until the block ends."""
    if _kernels.TEMPORARY:
        notify(
            "compiled kernels cannot be kept, because neither the installation nor the home "
            "folder can be written: every run compiles them anew; set NUMBA_CACHE_DIR to a folder "
            "that can be written"
        )
    listener = Compilation(notify, together=workers > 1, needs=needs)
    try:
        with event.install_listener("numba:compile", listener):
            yield listener
    finally:
        listener.close()
        for folder, reason in _kernels.UNKEPT.items():
            notify(
                f"compiled kernels cannot be kept in {folder} ({reason}): the next run compiles "
                "them anew; make room there, or set NUMBA_CACHE_DIR to another folder"
            )
