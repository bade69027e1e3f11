"""The last stage: an `Analysis` becomes a folder of tables, figures and one self-contained page.

``tables`` writes what programs read, ``figures`` what papers print, ``page`` what people open;
``drawing`` makes both of the latter, in a process of its own where a `Draughtsman` was begun, and
``output`` makes the folder appear whole or not at all.  The page templates are shared: anything
that wants to look like the report calls `render_page`, most easily with ``document.html``.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from iscat_analysis.records import Analysis
from iscat_analysis.report.output import OUTPUT_NAMES, atomic_folder, check_output
from iscat_analysis.report.posterior import write_posterior
from iscat_analysis.report.tables import write_tables

if TYPE_CHECKING:
    from iscat_analysis.draughtsman import Draughtsman
    from iscat_analysis.report.page import render_page as render_page
    from iscat_analysis.report.page import render_report as render_report

EVENT_FIGURES = 12
"""Events whose images are drawn into the folder, at most."""

__all__ = [
    "EVENT_FIGURES",
    "OUTPUT_NAMES",
    "atomic_folder",
    "check_output",
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
    draughtsman: Draughtsman | None = None,
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
    draughtsman : Draughtsman, optional
        The process that draws; default this one.

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
        pictures = building / "figures"
        pictures.mkdir()
        begun = draughtsman is not None and draughtsman.begin(analysis, pictures, event_figures)
        write_tables(analysis, building)
        write_posterior(analysis, building / "posterior.nc")
        page = draughtsman.page() if draughtsman is not None and begun else None
        if page is None:
            from iscat_analysis.report.drawing import draw

            page = draw(analysis, pictures, event_figures)
        (building / "report.html").write_text(page, encoding="utf-8")
    return folder
