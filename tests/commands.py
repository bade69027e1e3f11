"""Commands that tests run in processes of their own: deaf to interrupts, or of little memory."""

from __future__ import annotations

import itertools
import resource
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from iscat_analysis import report
from iscat_analysis.study import simulate
from iscat_cli import console, main


def _wait() -> None:
    """Say so, and go on whatever comes."""
    while True:
        try:
            print("deaf", file=sys.stderr, flush=True)
            time.sleep(60)
        except KeyboardInterrupt:
            pass


def _counted(frames: Any, *_: Any) -> Iterator[Any]:
    yield from itertools.islice(frames, 2)
    _wait()


def _fill_report(_: Any, folder: Path, **__: Any) -> None:
    (folder / "fits.csv").write_text("half of it")
    _wait()


def deaf(arguments: list[str]) -> int:
    """Run a command that stops in the middle of what it writes."""
    simulate._counted = _counted  # type: ignore[attr-defined]
    report.fill_report = _fill_report  # type: ignore[assignment]
    console.WRITING_GRACE_S = 0.5
    return main(arguments)


def within(memory: int, commands: list[list[str]]) -> int:
    """Run commands in so many bytes of addresses; give the status that all of them have, or 99."""
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    statuses = {main(arguments) for arguments in commands}
    return statuses.pop() if len(statuses) == 1 else 99
