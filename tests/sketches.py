"""Reports whose figures are not written, which takes most of the time of a small run."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from iscat_analysis.records import Analysis
from iscat_analysis.report import page
from iscat_analysis.report.event_figures import event_figures
from iscat_analysis.report.style import Sketch

PAGES = tuple(
    importlib.import_module(f"iscat_analysis.report.{name}")
    for name in (
        "batch",
        "benchmark",
        "bounds",
        "calibration",
        "estimators",
        "optics",
        "page",
        "paper",
        "template",
    )
)
"""Modules that publish figures."""


def sketch(
    figures: Iterable[tuple[str, Figure]],
    folder: Path | None = None,
    *,
    printed: bool = False,
    pause_s: float = 0.0,
) -> dict[str, Markup]:
    """Take the place of `publish`: files of a kilobyte stand for the figures.

    Parameters
    ----------
    figures : iterable of (str, Figure)
        As `publish` is given them; a generator draws each.
    folder : Path, optional
        Where the files go.
    printed : bool
        Makes no difference here.
    pause_s : float
        A moment after each file, in which a process can be killed.

    Returns
    -------
    dict of str to Markup
        An empty SVG element for each.
    """
    del printed
    names = [name for name, _ in figures]
    for name in names if folder is not None else ():
        (folder / f"{name}.svg").write_bytes(b"<svg/>\n" * 150)
        time.sleep(pause_s)
    return dict.fromkeys(names, Markup("<svg/>"))


def without_images(analysis: Analysis, most: int) -> Iterator[Sketch]:
    """Take the place of `event_figures` in a folder: the images take half of a small run's time."""
    for name, _ in event_figures(analysis, most):
        yield name, Figure


def sketch_figures(patch: pytest.MonkeyPatch) -> None:
    """Let every report be written without its figures."""
    for module in PAGES:
        patch.setattr(module, "publish", sketch)
    patch.setattr(page, "event_figures", without_images)
