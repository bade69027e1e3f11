"""The figures and the page of an analysis, drawn by one process or by two.

The process of `iscat_analysis.draughtsman` has a `Desk`.  One that is no copy is run as
``python -m iscat_analysis.report.drawing``: it reads what to draw from stdin, writes the page to
stdout, and has drawn all if it ends with status 0.
"""

from __future__ import annotations

import gc
import os
import pickle
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from markupsafe import Markup
from PIL import Image

from iscat_analysis.copies import aside
from iscat_analysis.records import Analysis
from iscat_analysis.report.event_figures import event_figures
from iscat_analysis.report.page import page_context, page_of, page_sketches, templates
from iscat_analysis.report.style import Sketch, drawn, new_figure, publish
from iscat_analysis.report.tables import event_table
from iscat_analysis.threads import processors

_MOST_SHARED = 256  # figures that two processes take from each other: a number is one byte


class Drawing:
    """The figures and the page of an analysis, begun before its species are known."""

    def __init__(self, analysis: Analysis, folder: Path, most: int, *, together: bool) -> None:
        self._folder = folder
        self._table = event_table(analysis)
        shown = page_sketches(analysis, self._table)
        # the field, which takes longest, comes first, so that both processes end together
        sketches = [*shown, *event_figures(analysis, most)]
        self._names = {name for name, _ in sketches}
        self._left = iter(sketches)
        self._others: Future[dict[str, Markup]] | None = None
        if together and sys.platform == "linux" and len(sketches) <= _MOST_SHARED:
            self._left = left = _taken(sketches)
            self._others = aside(lambda: publish(drawn(left), folder))

    def page(self, analysis: Analysis) -> str:
        """Draw what is left, and make the page."""
        folder = self._folder
        shown = list(page_sketches(analysis, self._table))
        late = [sketch for sketch in shown if sketch[0] not in self._names]
        about = page_context(analysis, self._table, folder)
        figures = publish(drawn(chain(late, self._left)), folder)
        if self._others is not None:
            figures |= self._others.result()
        return page_of(about, {name: figures[name] for name, _ in shown if name in figures})


def _taken(sketches: Sequence[Sketch]) -> Iterator[Sketch]:
    """Give what no other process has taken; each is a byte of a pipe that copies share."""
    reader, writer = os.pipe()
    os.write(writer, bytes(range(len(sketches))))
    os.close(writer)

    def taken() -> Iterator[Sketch]:
        while number := os.read(reader, 1):
            yield sketches[number[0]]

    return taken()


class Desk:
    """What a process does that does nothing but draw one analysis."""

    def __init__(self) -> None:
        gc.disable()  # the process is short, and what it makes stays
        # while the other process is at work: templates are compiled, formats and fonts are loaded
        for name in templates().list_templates():
            templates().get_template(name)
        Image.preinit()
        sample = new_figure(1.0, 1.0, constrained=False)
        sample.text(0.5, 0.5, "σ")
        publish([("sample", sample)])
        self._begun: tuple[Drawing, Analysis] | None = None

    def begin(self, analysis: Analysis, folder: Path, most: int) -> None:
        """Begin to draw."""
        self._begun = Drawing(analysis, folder, most, together=processors() > 1), analysis

    def page(self, summary: Mapping[str, Any]) -> str:
        """Draw what is left."""
        if self._begun is None:
            raise RuntimeError("nothing was begun")
        drawing, analysis = self._begun
        return drawing.page(replace(analysis, summary=summary))


def main() -> None:
    """Draw what stdin holds, where it holds anything."""
    desk, orders = Desk(), sys.stdin.buffer
    try:
        desk.begin(*pickle.Unpickler(orders).load())
        page = desk.page(pickle.Unpickler(orders).load())
    except EOFError:
        return
    sys.stdout.buffer.write(page.encode("utf-8"))


if __name__ == "__main__":
    main()
    sys.stdout.flush()
    os._exit(0)  # what is loaded takes 0.15 s to be tidied away
