"""The figures and the page of an analysis, drawn by two processes where there is a second one.

Matplotlib takes long to load.  The second process has loaded it by now; this one loads it while the
second one draws.
"""

from __future__ import annotations

from pathlib import Path

from markupsafe import Markup

from iscat_analysis.executors import Executor
from iscat_analysis.records import Analysis, Progress, silent
from iscat_analysis.report.tables import event_table

_HERE, _ELSEWHERE = 0, 1
_SHARE = 3  # one figure of three is drawn here, beside Matplotlib's loading and the page's text


def draw(analysis: Analysis, folder: Path, most: int, place: Executor) -> str:
    """Draw all figures into a folder, images of `most` events among them; give the page."""
    parts = place.each(
        lambda part: place.call(draw_part, analysis, folder, most, part), (_HERE, _ELSEWHERE)
    )
    _, figures = next(parts)

    from iscat_analysis.report.page import page_context, page_of, page_sketches

    table = event_table(analysis)
    about = page_context(analysis, table, folder)
    for _, some in parts:
        figures |= some
    shown = [name for name, _ in page_sketches(analysis, table)]
    return page_of(about, {name: figures[name] for name in shown if name in figures})


def draw_part(
    analysis: Analysis, folder: Path, most: int, part: int, *, progress: Progress = silent
) -> dict[str, Markup]:
    """Draw a part of the figures into a folder."""
    from iscat_analysis.report.page import publish_figures

    del progress

    def is_ours(number: int) -> bool:
        return (number % _SHARE == 0) == (part == _HERE)

    return publish_figures(analysis, folder, most, is_ours)
