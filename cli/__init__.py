"""The command line: parses, makes one library call, prints.

One file per command; `app` lists them.  Nothing of the library is imported before a command runs,
so that ``--help`` and shell completion stay quick; and `app` itself only once Ctrl-C is expected.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

__all__ = ["main", "main_fit"]

INTERRUPTED = 130

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
    """Run a program; the interrupt of a user who presses Ctrl-C early ends it as one later."""
    if arguments is None:  # the process is ours
        for name in _ALGEBRA:
            os.environ.setdefault(name, "1")
        os.environ["MPLBACKEND"] = "Agg"  # figures are files, whatever the user's windows are
    try:
        from iscat_cli import app

        return app.run(program, sys.argv[1:] if arguments is None else arguments)
    except KeyboardInterrupt:  # before a command began or after it ended
        return INTERRUPTED
