"""One run of `iscat` in a process of its own, as an order in JSON says.

    python runner.py ORDER

The order is ``{"run": [argument, …]}``, with

- ``"die": [word, number]`` to end by SIGKILL ``before`` or ``after`` its so manieth renaming
  or replacing of a file;
- ``"memory_share": share`` to cut a landing movie into many chunks;
- ``"figures": true`` to draw the figures, which take nine tenths of a small run; otherwise files of
  a kilobyte take their places.

It writes a line to the descriptor ``"ready"`` when everything is imported, and the run begins.
"""

from __future__ import annotations

import json
import os
import pathlib
import signal
import sys
from collections.abc import Callable
from typing import Any

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

import pytest
from sketches import sketch_figures

from iscat_analysis import pipeline  # what a run imports, before the clock runs
from iscat_analysis.report import movie_page
from iscat_analysis.search import chunks
from iscat_cli import main

LOADED = (pipeline, movie_page)


def _run(order: dict[str, Any]) -> int:
    if not order.get("figures"):
        # a moment to be killed in, at each figure
        sketch_figures(pytest.MonkeyPatch(), pause_s=0.01)
    if "memory_share" in order:
        chunks.MEMORY_SHARE = order["memory_share"]
    if "die" in order:
        _die_while_renaming(*order["die"])
    os.write(order["ready"], b"\n")
    return main(order["run"])


def _die_while_renaming(word: str, number: int) -> None:
    count = 0

    def deadly(rename: Callable[..., Any]) -> Callable[..., Any]:
        def renamed(self: pathlib.Path, target: Any) -> Any:
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
        setattr(pathlib.Path, name, deadly(getattr(pathlib.Path, name)))


if __name__ == "__main__":
    sys.exit(_run(json.loads(sys.argv[1])))
