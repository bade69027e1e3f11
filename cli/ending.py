"""Signals that end a command: it tidies up, and is ended where that takes too long."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from iscat_cli.console import Messages

GRACE_S = 1.5
"""After a signal to end, the time that is left for tidying up."""

WRITING_GRACE_S = 30.0
"""The same while results are being written, which a second signal cuts short."""


class Interrupts:
    """Interrupts the main thread when a signal asks the command to end, and sees that it ends.

    Python raises `KeyboardInterrupt` between two of its own instructions, so a long call into
    compiled code delays it, and so do threads that must finish first.  The signals are therefore
    blocked, and a thread waits for them, as POSIX provides for programs of many threads
    (``sigwait``).  It interrupts the main thread by SIGUSR1.  Where the command does not end in
    time, it unblocks SIGINT, whose action is the system's: the process ends, with 130 in a shell.
    """

    def __init__(self, messages: Messages, numbers: set[signal.Signals]) -> None:
        self._messages = messages
        self._numbers = numbers
        self._received = signal.SIGINT
        self._ended = threading.Event()
        self._main = threading.get_ident()
        self._swallowed = False
        self.lost = False
        self._thread = threading.Thread(target=self._watch, daemon=True, name="signals")

    def begin(self) -> None:
        """Begin to wait for signals, all of which are blocked."""
        self._thread.start()

    def stop(self) -> None:
        """Wait for signals no longer: the command has ended."""
        self._ended.set()
        signal.pthread_kill(self._thread.ident or 0, signal.SIGUSR1)
        self._thread.join()

    def handle(self, _number: int, _frame: FrameType | None) -> None:
        """Raise the interrupt, in the main thread."""
        if self._received == signal.SIGINT:
            raise KeyboardInterrupt
        raise KeyboardInterrupt(f"{self._received.name} was received")

    def note_unraisable(self, unraisable: sys.UnraisableHookArgs) -> None:
        """Have an interrupt raised again that was raised where Python can only print it.

        A callback of compiled code is such a place: the compiler's look into its cache, for one.
        The interrupt would be lost, or end as an error of whoever made the call.
        """
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            self._swallowed = self.lost = True
        else:
            sys.__unraisablehook__(unraisable)

    def answer_lost(self) -> bool:
        """Tell whether an interrupt was lost; the caller answers it, and it is not raised again."""
        self._swallowed = False
        return self.lost

    def _watch(self) -> None:
        number = signal.Signals(signal.sigwait(self._numbers | {signal.SIGUSR1}))
        if number == signal.SIGUSR1:  # from `stop`
            return
        self._received = number
        self._interrupt_main()
        if self._ends_in_time():
            signal.sigwait({signal.SIGUSR1})
            return
        _discard_unfinished()
        self._messages.error(f"interrupted: {number.name} was received")
        last = signal.SIGINT if signal.SIGINT in self._numbers else number
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {last})
        signal.raise_signal(last)

    def _interrupt_main(self) -> None:
        signal.pthread_kill(self._main, signal.SIGUSR1)

    def _ends_in_time(self) -> bool:
        """Tell whether the command ends within the time that it has."""
        begun = time.monotonic()
        while not self._ended.wait(0.05):  # between two looks at what has become of an interrupt
            if self._swallowed:
                self._swallowed = False
                self._interrupt_main()
            passed = time.monotonic() - begun
            again = signal.sigpending() & self._numbers
            if passed > GRACE_S and (
                again or not self._messages.writing or passed > GRACE_S + WRITING_GRACE_S
            ):
                return False
        return True


@contextmanager
def interrupts(messages: Messages) -> Iterator[Interrupts | None]:
    """Answer a signal to end in time, until the block ends.

    SIGTERM and SIGHUP are answered as Ctrl-C is; what is ignored, as SIGHUP under nohup, stays so.
    In a process that has threads already, which do not block the signals, nothing is changed.
    """
    if os.name == "nt" or threading.active_count() > 1:
        yield None
        return
    numbers = {
        number
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
    }
    handlers = {number: signal.getsignal(number) for number in (*numbers, signal.SIGUSR1)}
    hook = sys.unraisablehook
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, handlers)
    watched = Interrupts(messages, numbers)
    for number in numbers:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGUSR1, watched.handle)
    sys.unraisablehook = watched.note_unraisable
    watched.begin()
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})
    try:
        yield watched
    finally:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
        watched.stop()
        sys.unraisablehook = hook
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _discard_unfinished() -> None:
    """Remove half-written files, which there are only where the library was imported."""
    files = sys.modules.get("iscat_analysis.files")
    if files is not None:
        files.discard_unfinished()
