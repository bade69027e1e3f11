"""The command line: parses, makes one library call, prints.

One file per command; `app` lists them.  Nothing of the library is imported before a command runs,
so that ``--help`` and shell completion stay quick; and `app` itself only once Ctrl-C is expected.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

__all__ = ["main", "main_fit"]

INTERRUPTED = 130

_OBJECTS = 500_000
"""New containers after which cycles among them are looked for: loading the libraries makes fewer,
which stay, and looking through them every 700 took a quarter of a short run."""

_ALGEBRA = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""What says how many threads linear algebra takes.  Work is divided among threads above it; small
products that are divided once more take several times the processors, and longer."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `iscat`."""
    return _start("iscat", arguments)


def main_fit(arguments: Sequence[str] | None = None) -> int:
    """Run `iscat-fit`, which is ``iscat fit``."""
    return _start("iscat-fit", arguments)


def _start(program: str, arguments: Sequence[str] | None) -> int:
    if arguments is None:  # the process is ours
        for name in _ALGEBRA:
            os.environ.setdefault(name, "1")
        gc.set_threshold(_OBJECTS, *gc.get_threshold()[1:])
    try:
        import signal
        import threading

        ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        ours = ours and threading.current_thread() is threading.main_thread()
        if ours:  # nothing is there to be tidied yet, and an import may lose an exception
            signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))
        try:
            from iscat_cli import app

            if arguments is None:
                from iscat_cli.shrunk import explain_bus_errors

                explain_bus_errors(program)
        finally:
            if ours:
                signal.signal(signal.SIGINT, signal.default_int_handler)
        status = app.run(program, sys.argv[1:] if arguments is None else arguments)
        if arguments is None:  # the process ends
            if status != INTERRUPTED:
                atexit._run_exitfuncs()
            _end(status)
    except KeyboardInterrupt:  # before a command began or after it ended
        status = INTERRUPTED
        if arguments is None:
            _end(status)
    return status


def _end(status: int) -> NoReturn:
    """End the process at once.

    It waits for no thread that is still at work, and tidies nothing of the libraries away, which
    takes a tenth of a second.
    """
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    os._exit(status)
