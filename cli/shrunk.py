"""A file that becomes shorter while it is read: the system stops whoever touches what was beyond.

It says "Bus error" and nothing else.  Movies are looked at before each use, but somebody may write
over one in the very moment.
"""

from __future__ import annotations

import ctypes
import os
import signal

_handlers: list[object] = []  # the system holds their addresses alone


def explain_bus_errors(program: str) -> None:
    """Have this process say what has happened before it ends."""
    if not hasattr(signal, "SIGBUS"):
        return
    ours = os.getpid()
    text = (
        f"{program}: error: a file that is read became shorter; wait until it is written, then "
        "start again\n"
    ).encode()

    def say(_: int) -> None:
        if os.getpid() == ours:  # another process of ours does its work again
            os.write(2, text)
        os._exit(1)

    # Python's own handlers wait for the instruction that failed to end
    _handlers.append(ctypes.CFUNCTYPE(None, ctypes.c_int)(say))
    ctypes.CDLL(None).signal(signal.SIGBUS, _handlers[-1])
