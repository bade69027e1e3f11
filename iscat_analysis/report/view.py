"""The page of a result."""

from __future__ import annotations

from pathlib import Path

from iscat_analysis.errors import DataError
from iscat_analysis.reading import is_file, is_folder

PAGES = (
    "report.html", "batch.html", "camera.html", "calibration.html", "optics.html", "template.html",
    "benchmark.html", "comparison.html",
)  # fmt: skip
"""Pages that the commands write."""


def page_of(result: Path) -> Path:
    """Find the page of a result."""
    if result.suffix.lower() in (".html", ".htm") and is_file(result):
        return result
    folder = result.with_suffix(".iscat") if is_file(result) else result
    found = [folder / name for name in PAGES if is_file(folder / name)]
    if found:
        return found[0]
    if is_folder(folder):
        raise DataError(
            f"{folder}: holds no page ({', '.join(PAGES)}); give the output folder of iscat fit, "
            "batch, calibrate or benchmark"
        )
    if is_file(result):
        raise DataError(
            f"{result}: has no result beside it ({folder.name}); analyse it with iscat fit, or "
            "give the folder of its result"
        )
    raise DataError(f"{result}: there is no such folder; check the path")
