"""The figures and the page of an analysis."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

from iscat_analysis.records import Analysis
from iscat_analysis.report.event_figures import event_figures
from iscat_analysis.report.page import page_context, page_of, page_sketches
from iscat_analysis.report.style import drawn, publish
from iscat_analysis.report.tables import event_table


def draw(analysis: Analysis, folder: Path, most: int) -> str:
    """Draw all figures into a folder, images of `most` events among them; give the page."""
    table = event_table(analysis)
    shown = list(page_sketches(analysis, table))
    about = page_context(analysis, table, folder)
    figures = publish(drawn(chain(shown, event_figures(analysis, most))), folder)
    return page_of(about, {name: figures[name] for name, _ in shown if name in figures})
