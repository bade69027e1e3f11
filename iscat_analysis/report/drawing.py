"""The figures and the page of an analysis."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from markupsafe import Markup

from iscat_analysis.executors import Executor
from iscat_analysis.records import Analysis, Progress, silent
from iscat_analysis.report.event_figures import event_figures
from iscat_analysis.report.page import page_context, page_of, page_sketches
from iscat_analysis.report.style import drawn, publish
from iscat_analysis.report.tables import event_table

_PARTS = 2  # of all figures, for two processes


def draw(analysis: Analysis, folder: Path, most: int, place: Executor) -> str:
    """Draw all figures into a folder, images of `most` events among them; give the page."""
    table = event_table(analysis)
    figures: dict[str, Markup] = {}
    parts = place.each(
        lambda part: place.call(draw_part, analysis, folder, most, part), range(_PARTS)
    )
    for _, some in parts:
        figures |= some
    shown = [name for name, _ in page_sketches(analysis, table)]
    about = page_context(analysis, table, folder)
    return page_of(about, {name: figures[name] for name in shown if name in figures})


def draw_part(
    analysis: Analysis, folder: Path, most: int, part: int, *, progress: Progress = silent
) -> dict[str, Markup]:
    """Draw every other figure into a folder."""
    del progress
    sketches = chain(page_sketches(analysis, event_table(analysis)), event_figures(analysis, most))
    some = [sketch for number, sketch in enumerate(sketches) if number % _PARTS == part]
    return publish(drawn(some), folder)
