"""Reports whose figures are not drawn, which takes most of the time of a small run."""

from __future__ import annotations

import importlib
import time
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import pytest
from markupsafe import Markup
from matplotlib.figure import Figure

from iscat_analysis.answers import output

PAGES = (
    output,
    *(
        importlib.import_module(f"iscat_analysis.report.{name}")
        for name in ("batch", "benchmark", "bounds", "calibration")
    ),
)
"""Modules that publish figures."""


def sketch(
    figures: Iterable[tuple[str, Figure]],
    folder: Path | None = None,
    *,
    printed: bool = False,
    pause_s: float = 0.0,
) -> dict[str, Markup]:
    """Take the place of `publish`: files of a kilobyte stand for the figures, SVG without content.

    After each file there is a pause, in which a process can be killed.
    """
    del printed
    names = [name for name, _ in figures]
    for name in names if folder is not None else ():
        (folder / f"{name}.svg").write_bytes(b"<svg/>\n" * 150)
        time.sleep(pause_s)
    return dict.fromkeys(names, Markup("<svg/>"))


def sketch_figures(patch: pytest.MonkeyPatch, *, pause_s: float = 0.0) -> None:
    """Let every report be written without its figures, with a pause after each of their files."""
    for module in PAGES:
        patch.setattr(module, "publish", partial(sketch, pause_s=pause_s))
