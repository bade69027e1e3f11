"""The last stage: an `Analysis` becomes a folder of tables, figures and one self-contained page.

``tables`` writes what programs read, ``figures`` what papers print, ``page`` what people open.
``drawing`` makes both of the latter, and ``output`` makes the folder appear whole or not at all.
The page templates are shared: anything that wants to look like the report calls `render_page`, most
easily with ``document.html``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from iscat_analysis.executors import Executor, LocalExecutor
from iscat_analysis.records import Analysis
from iscat_analysis.report.drawing import draw
from iscat_analysis.report.output import OUTPUT_NAMES, atomic_folder, check_output
from iscat_analysis.report.posterior import write_posterior
from iscat_analysis.report.tables import write_tables

if TYPE_CHECKING:
    from iscat_analysis.report.page import render_page as render_page
    from iscat_analysis.report.page import render_report as render_report

EVENT_FIGURES = 12
"""Events whose images are drawn into the folder, at most."""

__all__ = [
    "EVENT_FIGURES",
    "OUTPUT_NAMES",
    "atomic_folder",
    "check_output",
    "fill_report",
    "render_page",
    "render_report",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Import pages where they are asked for: Matplotlib is a quarter of all that a fit imports."""
    if name not in ("render_page", "render_report"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from iscat_analysis.report import page

    return getattr(page, name)


def write_report(
    analysis: Analysis,
    folder: Path,
    *,
    overwrite: bool = False,
    event_figures: int = EVENT_FIGURES,
    executor: Executor | None = None,
) -> Path:
    """Write everything one analysis found into a folder.

    ``fits.csv``, ``fits.parquet``, in mode ``track`` ``tracks.csv`` and ``tracks.parquet``,
    ``summary.json``, ``config.toml``, ``posterior.nc`` (where a posterior converged),
    ``response.csv`` (where the camera is not linear), ``report.html`` and ``figures/``.  The folder
    appears complete or not at all; an earlier result is replaced only once the new one is complete.
    """
    with atomic_folder(folder, overwrite) as building:
        fill_report(analysis, building, event_figures=event_figures, executor=executor)
    return folder


def fill_report(
    analysis: Analysis, folder: Path, *, event_figures: int, executor: Executor | None = None
) -> None:
    """Write a report into a folder of its own."""
    pictures = folder / "figures"
    pictures.mkdir(exist_ok=True)
    write_tables(analysis, folder)
    write_posterior(analysis, folder / "posterior.nc")
    nearby = LocalExecutor() if executor is None or executor.distant else executor  # it writes here
    page = draw(analysis, pictures, event_figures, nearby)
    (folder / "report.html").write_text(page, encoding="utf-8")
