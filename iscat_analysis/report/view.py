"""Which page a result has."""

from __future__ import annotations

from pathlib import Path

from iscat_analysis.errors import DataError

PAGES = (
    "report.html", "batch.html", "camera.html", "calibration.html", "optics.html", "template.html",
    "benchmark.html", "comparison.html",
)  # fmt: skip
"""Pages that the commands write."""


def page_of(result: Path) -> Path:
    """Find the page of a result."""
    if result.suffix.lower() in (".html", ".htm") and result.is_file():
        return result
    folder = result.with_suffix(".iscat") if result.is_file() else result
    found = [folder / name for name in PAGES if (folder / name).is_file()]
    if found:
        return found[0]
    if folder.is_dir():
        raise DataError(
            f"{folder}: holds no page ({', '.join(PAGES)}); give the output folder of iscat fit, "
            "batch, calibrate or benchmark"
        )
    if result.is_file():
        raise DataError(
            f"{result}: has no result beside it ({folder.name}); analyse it with iscat fit, or "
            "give the folder of its result"
        )
    raise DataError(f"{result}: there is no such folder; check the path")
