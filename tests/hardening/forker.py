"""A process that has everything imported and compiled, and forks a child for each order it reads.

Orders are lines of JSON on stdin, answers lines of JSON on stdout.  An order is one run or several
at the same time, each ``{"run": [argument, …], "cwd": folder}``, with

- ``"kill": [signal, share]`` to be ended after that share of an undisturbed run's duration, which
  is the first order's or ``"duration": seconds``;
- ``"die": [word, number]`` to end by SIGKILL ``before`` or ``after`` its so manieth renaming
  or replacing of a file;
- ``"limit": bytes`` for the largest file it may write;
- ``"memory_share": share`` to cut a landing movie into many chunks;
- ``"figures": true`` to draw the figures, which take nine tenths of a small run; otherwise files of
  a kilobyte take their places.

The answer is a list of ``{"status": …, "out": …, "err": …, "seconds": …}``; a signal's status is
negative.
"""

from __future__ import annotations

import json
import os
import pathlib
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))

from sketches import PAGES, sketch

from iscat_analysis.report.style import publish
from iscat_analysis.search.sliding import chunks
from iscat_cli import main

_SKETCH = partial(sketch, pause_s=0.01)  # a moment to be killed in, at each figure


def _run(order: dict[str, Any]) -> int:
    os.chdir(order["cwd"])
    for module in PAGES:
        module.publish = publish if order.get("figures") else _SKETCH
    if "limit" in order:
        resource.setrlimit(resource.RLIMIT_FSIZE, (order["limit"], order["limit"]))
    if "memory_share" in order:
        chunks._MEMORY_SHARE = order["memory_share"]
    if "die" in order:
        _die_while_renaming(*order["die"])
    status = main(order["run"])
    sys.stdout.flush()
    sys.stderr.flush()
    return status


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


def _start(order: dict[str, Any], duration: float) -> tuple[int, int, int]:
    out, err = (os.memfd_create(name) for name in ("out", "err"))
    child = os.fork()
    if child == 0:
        status = 70
        try:
            os.dup2(out, 1)
            os.dup2(err, 2)
            status = _run(order)
        finally:
            os._exit(status)
    if "kill" in order:
        number, share = order["kill"]
        timer = threading.Timer(share * order.get("duration", duration), _signal, [child, number])
        timer.start()
    return child, out, err


def _signal(child: int, number: int) -> None:
    try:
        os.kill(child, number)  # not yet waited for, so its number is nobody else's
    except ProcessLookupError:
        return


def _finish(child: int, out: int, err: int) -> dict[str, Any]:
    # Without collecting the status, so that a late signal meets the dead child and no stranger.
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    for thread in threading.enumerate():
        if isinstance(thread, threading.Timer):
            thread.join()
    _, status = os.waitpid(child, 0)
    answer: dict[str, Any] = {"status": os.waitstatus_to_exitcode(status)}
    for name, file in (("out", out), ("err", err)):
        with os.fdopen(file, "rb") as stream:
            stream.seek(0)
            answer[name] = stream.read().decode("utf-8", "backslashreplace")
    return answer


def serve() -> None:
    """Answer until stdin ends; the first order is run twice, to be ready and to be timed."""
    duration = None
    for line in sys.stdin:
        orders = json.loads(line)
        if duration is None:
            _quietly(orders[0])
        begin = time.perf_counter()
        answers = [_finish(*started) for started in [_start(o, duration or 0) for o in orders]]
        seconds = time.perf_counter() - begin
        duration = duration or seconds
        answers = [answer | {"seconds": seconds} for answer in answers]
        sys.stdout.write(json.dumps(answers) + "\n")
        sys.stdout.flush()


def _quietly(order: dict[str, Any]) -> None:
    """Run in this process: kernels, fonts and figures are then ready in every child."""
    here, kept = pathlib.Path.cwd(), [os.dup(1), os.dup(2)]
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    try:
        _run(order)
    finally:
        os.chdir(here)
        for number, saved in zip((1, 2), kept, strict=True):
            os.dup2(saved, number)


if __name__ == "__main__":
    serve()
