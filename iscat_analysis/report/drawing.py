"""The figures and the page of an analysis, drawn by one process or by two.

Run as ``python -m iscat_analysis.report.drawing``, this is the process that
`iscat_analysis.draughtsman` starts.  It reads what to draw from stdin, writes the page to stdout,
and has drawn all if it ends with status 0.
"""

from __future__ import annotations

import gc
import os
import pickle
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from markupsafe import Markup

from iscat_analysis.records import Analysis
from iscat_analysis.report.event_figures import event_figures
from iscat_analysis.report.page import page_context, page_of, page_sketches, templates
from iscat_analysis.report.style import Sketch, drawn, inline_svg, publish
from iscat_analysis.report.tables import event_table
from iscat_analysis.threads import processors

_MOST_SHARED = 256  # figures that two processes take from each other: a number is one byte


def draw(analysis: Analysis, folder: Path, most: int, *, together: bool = False) -> str:
    """Draw all figures into a folder, and make the page.

    Parameters
    ----------
    analysis : Analysis
        What was found.
    folder : Path
        An existing folder.
    most : int
        Events whose images are drawn, at most.
    together : bool
        On Linux a copy of this process draws as well.  Only for a process that has no threads,
        which a copy would lack.

    Returns
    -------
    str
        The page.

    Raises
    ------
    RuntimeError
        The copy could not draw what it had taken.
    """
    table = event_table(analysis)
    shown = list(page_sketches(analysis, table))
    # what takes longest comes early, so that both processes end together
    sketches = [*event_figures(analysis, most), *reversed(shown)]
    copy, taken = None, iter(sketches)
    if together and sys.platform == "linux" and len(sketches) <= _MOST_SHARED:
        copy, taken = _copied(sketches, folder)
    about = page_context(analysis, table, folder)
    figures = publish(drawn(taken), folder)
    if copy is not None:
        _, status = os.waitpid(copy, 0)
        if status:
            raise RuntimeError(f"a process that drew figures ended with status {status}")
    return page_of(about, dict(_gathered(shown, figures, folder)))


def _copied(sketches: Sequence[Sketch], folder: Path) -> tuple[int, Iterator[Sketch]]:
    """Start a copy of this process that draws; give its number, and the figures that it leaves."""
    reader, writer = os.pipe()
    os.write(writer, bytes(range(len(sketches))))
    os.close(writer)
    copy = os.fork()
    if copy == 0:
        status = 1
        try:
            publish(drawn(_taken(sketches, reader)), folder)
            status = 0
        finally:
            os._exit(status)
    return copy, _taken(sketches, reader)


def _taken(sketches: Sequence[Sketch], reader: int) -> Iterator[Sketch]:
    """Take one sketch after the other that no other process has taken; each is a byte of a pipe."""
    while number := os.read(reader, 1):
        yield sketches[number[0]]


def _gathered(
    sketches: Sequence[Sketch], figures: dict[str, Markup], folder: Path
) -> Iterator[tuple[str, Markup]]:
    """Give the figures of the page in their order, those of the other process from its files."""
    for name, _ in sketches:
        file = folder / f"{name}.svg"
        if name in figures:
            yield name, figures[name]
        elif file.exists():
            yield name, inline_svg(file.read_text(encoding="utf-8"), name)


def main() -> None:
    """Draw what stdin holds, where it holds anything."""
    for name in templates().list_templates():  # compiled while the other process is at work
        templates().get_template(name)
    try:  # not until stdin ends: a copy of the other process may hold it open
        order = pickle.Unpickler(sys.stdin.buffer).load()
    except EOFError:
        return
    sys.stdout.buffer.write(draw(*order, together=processors() > 1).encode("utf-8"))


if __name__ == "__main__":
    gc.disable()  # the process is short, and what it makes stays
    main()
    sys.stdout.flush()
    os._exit(0)  # what is loaded takes 0.15 s to be tidied away
