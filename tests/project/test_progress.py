"""Progress shows itself where somebody looks, tells the time that is left, and is never silent."""

from __future__ import annotations

import io
import sys
import time
from types import SimpleNamespace
from typing import Any

import iscat_analysis as ia
from iscat_analysis import progress as module
from iscat_analysis.progress import Lines, automatic, told


@told
def _work(steps: int, *, progress: Any = automatic) -> Any:
    for done in range(steps + 1):
        progress("landing", done, steps)
    return progress


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_nothing_is_shown_in_pipes_and_bars_are_on_a_terminal(monkeypatch) -> None:
    """Control: the same work, with and without a terminal."""
    pipe, terminal = io.StringIO(), _Terminal()
    monkeypatch.setattr(sys, "stderr", pipe)
    assert _work(3) is automatic
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    _work(3)
    assert pipe.getvalue() == ""
    assert "landing" in terminal.getvalue()
    assert "3/3" in terminal.getvalue()


def test_a_progress_that_is_given_is_the_one_that_is_told() -> None:
    given: list[tuple[str, int, int]] = []
    _work(2, progress=lambda *step: given.append(step))
    assert given == [("landing", 0, 2), ("landing", 1, 2), ("landing", 2, 2)]


def test_a_notebook_has_one_line(monkeypatch) -> None:
    shown: list[str] = []
    line = SimpleNamespace(update=lambda data, **_: shown.append(data["text/plain"]))
    kernel = SimpleNamespace(config={"IPKernelApp": {}})
    ipython = SimpleNamespace(get_ipython=lambda: kernel)
    display = SimpleNamespace(display=lambda *_, **__: line)
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    assert module._in_notebook()
    _work(3)
    assert shown[0] == "landing: 0 of 3"
    assert shown[-1] == "landing: 3 of 3"


def test_what_does_not_report_gives_signs_of_life() -> None:
    """As while kernels are compiled.  Control: nothing is said once the work has ended."""
    said: list[str] = []
    with Lines(said.append, first_s=0.0, every_s=0.1) as lines:
        time.sleep(0.5)
        lines("landing", 1, 4)
        time.sleep(0.5)
    told_then = len(said)
    time.sleep(0.3)
    assert said[0] == "working, 1 s so far"
    assert "landing: 1 of 4" in said
    assert "working on landing, 1 s so far" in said
    assert len(said) == told_then


def test_time_that_is_left_follows_from_the_steps() -> None:
    said: list[str] = []
    lines = Lines(said.append, first_s=0.0, every_s=0.0)
    lines("landing", 0, 100)
    time.sleep(0.2)
    lines("landing", 50, 100)
    assert said == ["landing: 0 of 100", "landing: 50 of 100, about 1 s left"]


def test_the_library_tells_its_progress_by_itself() -> None:
    import inspect

    for work in (ia.fit_movie, ia.calibrate_optics, ia.simulate_movie, ia.fit_stack, ia.batch,
                 ia.watch, ia.Bounds.scan):  # fmt: skip
        assert inspect.signature(work).parameters["progress"].default is automatic
