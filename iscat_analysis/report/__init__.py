"""The last stage: an `Analysis` becomes a folder of tables, figures and one self-contained page.

``tables`` writes what programs read, ``figures`` what papers print, ``page`` what people open;
``output`` makes the folder appear whole or not at all.  The page templates are shared: anything
that wants to look like the report calls `render_page`, most easily with ``document.html``.
"""

from __future__ import annotations

from pathlib import Path

from iscat_analysis.records import Analysis
from iscat_analysis.report.event_figures import EVENT_FIGURES
from iscat_analysis.report.event_figures import event_figures as draw_events
from iscat_analysis.report.output import OUTPUT_NAMES, atomic_folder, check_output
from iscat_analysis.report.page import render_page, render_report
from iscat_analysis.report.posterior import write_posterior
from iscat_analysis.report.style import publish
from iscat_analysis.report.tables import write_tables

__all__ = [
    "EVENT_FIGURES",
    "OUTPUT_NAMES",
    "atomic_folder",
    "check_output",
    "render_page",
    "render_report",
    "write_report",
]


def write_report(
    analysis: Analysis,
    folder: Path,
    *,
    overwrite: bool = False,
    event_figures: int = EVENT_FIGURES,
) -> Path:
    """Write everything one analysis found into a folder.

    ``fits.csv``, ``fits.parquet``, in mode ``track`` ``tracks.csv`` and ``tracks.parquet``,
    ``summary.json``, ``config.toml``, ``posterior.nc`` (where a posterior converged),
    ``report.html`` and ``figures/``.  The folder appears complete or not at
    all; an earlier result is replaced only once the new one is complete.

    Parameters
    ----------
    analysis : Analysis
        What was found; no events is a result too.
    folder : Path
        Where to write.
    overwrite : bool
        Whether an earlier result may be replaced.
    event_figures : int
        Events whose images are drawn into the folder, at most; each takes a fifth of a second.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    DataError
        The folder exists and may not be replaced, or cannot be written.
    """
    with atomic_folder(folder, overwrite) as building:
        write_tables(analysis, building)
        write_posterior(analysis, building / "posterior.nc")
        pictures = building / "figures"
        pictures.mkdir()
        page = render_report(analysis, folder=pictures)
        publish(draw_events(analysis, event_figures), pictures)
        (building / "report.html").write_text(page, encoding="utf-8")
    return folder
