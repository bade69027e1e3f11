"""Signals that end a command: it tidies up, and is ended where that takes too long."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING

from iscat_cli import INTERRUPTED

if TYPE_CHECKING:
    from iscat_cli.console import Messages

GRACE_S = 1.5
"""After a signal to end, the time that is left for tidying up."""

WRITING_GRACE_S = 30.0
"""The same while results are being written, which a second signal cuts short."""

_AFTER_S = 0.05  # until the callback has returned: what is raised in its wake is lost as well


@contextmanager
def ending_in_time(messages: Messages) -> Iterator[None]:
    """End the process where the answer to a signal takes too long.

    Python raises `KeyboardInterrupt` between two of its own instructions, so a long call into
    compiled code delays it, and so do threads that must finish first.  The operating system's
    handler writes each signal's number into a pipe at once; a thread reads it and keeps the time.
    """
    if threading.current_thread() is not threading.main_thread() or os.name == "nt":
        yield
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    ended = threading.Event()

    def watch() -> None:
        with open(reader, "rb", buffering=0) as signals:  # noqa: PTH123  (a descriptor)
            while (number := signals.read(1)) and number[0] not in _ENDING:
                pass
            if not number:
                return
            if ended.wait(GRACE_S):
                return
            if messages.writing:
                os.set_blocking(reader, False)
                due = time.monotonic() + WRITING_GRACE_S
                while messages.writing and time.monotonic() < due:
                    if ended.wait(0.1):
                        return
                    again = signals.read(1)
                    if again and again[0] in _ENDING:
                        break
        _discard_unfinished()
        messages.error(f"interrupted: {signal.Signals(number[0]).name} was received")
        os._exit(INTERRUPTED)

    earlier = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    threading.Thread(target=watch, daemon=True, name="signals").start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(earlier)
        ended.set()
        os.close(writer)


def _discard_unfinished() -> None:
    """Remove half-written files, which there are only where the library was imported."""
    files = sys.modules.get("iscat_analysis.files")
    if files is not None:
        files.discard_unfinished()


_ENDING = {
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
}


@contextmanager
def termination_interrupts() -> Iterator[None]:
    """Let a request to end (SIGTERM, SIGHUP) end the command as Ctrl-C does: tidied up."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        del frame
        raise KeyboardInterrupt(f"{signal.Signals(number).name} was received")

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    ours = [
        number
        for number in numbers
        if threading.current_thread() is threading.main_thread()
        and signal.getsignal(number) is signal.SIG_DFL  # SIGHUP is ignored under nohup
    ]
    for number in ours:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def interrupts_kept() -> Iterator[list[BaseException]]:
    """Raise again an interrupt that a callback of compiled code swallowed.

    Python can only print what is raised where compiled code called it: the compiler's look into its
    cache, for one.  The interrupt would be lost, or end as an error of whoever made the call.
    """
    earlier = sys.unraisablehook
    swallowed: list[BaseException] = []
    again: list[threading.Timer] = []

    def hook(told: sys.UnraisableHookArgs) -> None:
        if not isinstance(told.exc_value, KeyboardInterrupt):
            earlier(told)
            return
        swallowed.append(told.exc_value)
        again.append(threading.Timer(_AFTER_S, _interrupt_main))
        again[-1].daemon = True
        again[-1].start()

    sys.unraisablehook = hook
    try:
        yield swallowed
    finally:
        for timer in again:
            timer.cancel()
        sys.unraisablehook = earlier


def _interrupt_main() -> None:
    """Interrupt the main thread, also where it waits for the operating system."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
