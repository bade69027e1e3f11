"""The last stage: an `Analysis` becomes a folder of tables, figures and one self-contained page.

``tables`` writes what programs read, ``answer`` says in a few words what was found, ``movie_page``
and its figures are what people open, and ``output`` makes the folder appear whole or not at all.
The other modules are a page each: of a batch, of bounds, of a calibration, of a benchmark.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iscat_analysis.records import Analysis
from iscat_analysis.report.output import (
    BENCHMARK_NAMES,
    CHALLENGE_NAMES,
    OUTPUT_NAMES,
    atomic_folder,
    check_output,
)
from iscat_analysis.report.tables import write_posterior, write_tables

if TYPE_CHECKING:
    from iscat_analysis.report.benchmark import render_benchmark, render_challenge
    from iscat_analysis.report.movie_page import render_report
    from iscat_analysis.report.page import render_page

__all__ = [
    "BENCHMARK_NAMES",
    "CHALLENGE_NAMES",
    "OUTPUT_NAMES",
    "atomic_folder",
    "check_output",
    "fill_report",
    "render_benchmark",
    "render_challenge",
    "render_page",
    "render_report",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Import pages where they are asked for: Matplotlib is a quarter of all that a fit imports."""
    for module in ("page", "movie_page", "benchmark") if name in __all__ else ():
        found = vars(import_module(f"{__name__}.{module}"))
        if name in found:
            return found[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def write_report(
    analysis: Analysis, folder: Path, *, overwrite: bool = False, figures: bool = False
) -> Path:
    """Write everything one analysis found into a folder.

    ``fits.csv``, ``fits.parquet``, in mode ``track`` ``tracks.csv`` and ``tracks.parquet``,
    ``summary.json``, ``config.toml``, ``posterior.nc`` (where a posterior converged),
    ``response.csv`` (where the camera is not linear), ``report.html``, and ``figures/`` if they are
    wanted.  The folder appears complete or not at all; an earlier result is replaced only once the
    new one is complete.
    """
    with atomic_folder(folder, overwrite) as building:
        fill_report(analysis, building, figures=figures)
    return folder


def fill_report(analysis: Analysis, folder: Path, *, figures: bool = False) -> None:
    """Write a report into a folder of its own."""
    from iscat_analysis.report.movie_page import render_report  # its templates take long to load

    write_tables(analysis, folder)
    write_posterior(analysis, folder / "posterior.nc")
    if figures:
        from iscat_analysis.report.plots import write_figures

        write_figures(analysis, folder / "figures")
    (folder / "report.html").write_text(render_report(analysis), encoding="utf-8")
