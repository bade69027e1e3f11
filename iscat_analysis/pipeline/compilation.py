"""What a first run compiles: said as it happens, and done by two processes."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from numba.core import event

from iscat_analysis import _kernels
from iscat_analysis.config import Config
from iscat_analysis.inference.noise import PARTS
from iscat_analysis.records import FREE_PARAMETERS

_PATIENCE_S = 1.0  # of compilation, before it is announced
_BETWEEN_S = 4.0  # from one line to the next
_ROOM = f"{_kernels.__name__}."
# All of whose kernels it compiles.
_THEIRS = ("curvature", "goodness", "hessian", "residuals", "score_test")
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
    """Listens to Numba; `compiling` makes one.

    Parameters
    ----------
    notify : callable
        Told one line at a time.
    together : bool
        Whether a second process may be started.
    parts : sequence of str
        As in `compiling`.

    Attributes
    ----------
    parts : sequence of str
        As given.
    """

    def __init__(
        self, notify: Callable[[str], None], *, together: bool, parts: Sequence[str]
    ) -> None:
        self.parts = parts
        self._notify = notify
        self._together = together
        self._other: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._depth = 0
        self._about = ""
        self._said: tuple[str, float] | None = None
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        """Note that a function is being compiled.

        Parameters
        ----------
        event : numba.core.event.Event
            Whose data hold its dispatcher.
        """
        self._depth += 1
        module = event.data["dispatcher"].py_func.__module__
        if self._depth > 1 or not module.startswith(_ROOM):
            return
        kind = module.removeprefix(_ROOM)
        self._about = _ABOUT.get(kind, _PICTURES)
        if self._together and self._other is None:
            self._other = _started(self.parts)
        if self._timer is None:
            self._timer = threading.Timer(_PATIENCE_S, self._announce)
            self._timer.daemon = True
            self._timer.start()
        elif self._said is not None:
            about, at = self._said
            if about != self._about and time.monotonic() - at > _BETWEEN_S:
                self._say("still compiling")

    def on_end(self, event: event.Event) -> None:
        """Note that it is compiled.

        Parameters
        ----------
        event : numba.core.event.Event
            As in `on_start`.
        """
        del event
        self._depth -= 1

    def _announce(self) -> None:
        if self._depth and self._said is None:
            self._say("compiling the numerical kernels, once per installation")

    def _say(self, text: str) -> None:
        with self._lock:
            self._said = self._about, time.monotonic()
        self._notify(f"{text}: {self._about}…")

    def wait(self) -> None:
        """Wait for the other process, where there is one."""
        if self._other is not None:
            self._other.wait()

    def close(self) -> None:
        """Say nothing any more, and end the other process."""
        if self._timer is not None:
            self._timer.cancel()
        if self._other is not None and self._other.poll() is None:
            self._other.kill()
            self._other.wait()


def needed_parts(config: Config) -> tuple[str, ...]:
    """Name the kernels of `iscat_analysis.inference.noise.PARTS` that an analysis needs.

    Parameters
    ----------
    config : Config
        Of the analysis.

    Returns
    -------
    tuple of str
        Some of them, or none.
    """
    needed = {
        "heights": "z_nm" in FREE_PARAMETERS[config.fit.mode],
        "posteriors": config.samples_posterior,
    }
    return tuple(part for part in PARTS if needed[part])


def _started(parts: Sequence[str]) -> subprocess.Popen[bytes] | None:
    """Start the other process; what it does not compile is compiled in this one."""
    if not sys.executable or getattr(sys, "frozen", False):  # inside another program
        return None
    nowhere = subprocess.DEVNULL
    command = [sys.executable, "-P", "-m", "iscat_analysis.inference.ahead", *parts]
    try:
        return subprocess.Popen(
            command, stdin=nowhere, stdout=nowhere, stderr=nowhere, env=_kernels.environment()
        )
    except OSError:
        return None


@contextmanager
def compiling(
    notify: Callable[[str], None], workers: int, parts: Sequence[str] = PARTS
) -> Iterator[Compilation]:
    """Say what is compiled until the block ends.

    Parameters
    ----------
    notify : callable
        Told one line at a time, after a second of compilation.
    workers : int
        From two on, a second process compiles half of what fits need.
    parts : sequence of str
        Which of `iscat_analysis.inference.noise.PARTS` it compiles as well.

    Yields
    ------
    Compilation
        Whose `wait` waits for that process.
    """
    if _kernels.TEMPORARY:
        notify(
            "compiled kernels cannot be kept, because neither the installation nor the home "
            "folder can be written: every run compiles them anew; set NUMBA_CACHE_DIR to a folder "
            "that can be written"
        )
    listener = Compilation(notify, together=workers > 1, parts=parts)
    try:
        with (
            event.install_listener("numba:compile", listener),
            _kernels.awaited(_THEIRS, listener.wait),
        ):
            yield listener
    finally:
        listener.close()
