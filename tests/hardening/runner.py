"""One run of `iscat` in a process of its own, as an order says.

The order is ``{"run": [argument, …]}``, with

- ``"die": [word, number]`` to end by SIGKILL ``before`` or ``after`` its so manieth renaming
  or replacing of a file;
- ``"memory_share": share`` to cut a landing movie into many chunks.

It sends word when the run begins.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from iscat_analysis.report.output import claim_output
from iscat_analysis.search import chunks
from iscat_cli import main


def obey(order: dict[str, Any], ready: Connection) -> int:
    """Do what is ordered, and give the status."""
    if "memory_share" in order:
        chunks.MEMORY_SHARE = order["memory_share"]
    if "die" in order:
        _die_while_renaming(*order["die"])
    ready.send(None)
    return main(order["run"])


def _die_while_renaming(word: str, number: int) -> None:
    count = 0

    def deadly(rename: Callable[..., Any]) -> Callable[..., Any]:
        def renamed(self: Path, target: Any) -> Any:
            nonlocal count
            count += 1
            if count == number and word == "before":
                os.kill(os.getpid(), signal.SIGKILL)
            done = rename(self, target)
            if count == number:
                os.kill(os.getpid(), signal.SIGKILL)
            return done

        return renamed

    for name in ("rename", "replace"):
        setattr(Path, name, deadly(getattr(Path, name)))


def hold(held: Connection) -> None:
    """Claim a result twice, which the same process may: it is the same run."""
    with claim_output(Path("result")), claim_output(Path("result")):
        held.send(None)
        held.recv()
