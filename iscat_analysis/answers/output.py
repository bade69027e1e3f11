"""The folder of an answer, and what its user is told."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tifffile
from matplotlib.figure import Figure

from iscat_analysis.inference.checks import path_in
from iscat_analysis.report import atomic_folder, check_output
from iscat_analysis.report.style import publish
from iscat_analysis.report.tables import CSV_DIGITS
from iscat_analysis.schemas import to_json

Notify = Callable[[str], None]


def folder_for(out: str | Path | None, known: frozenset[str], *, overwrite: bool) -> Path | None:
    """Check the folder of an answer before the work begins; None where nothing is written."""
    folder = None if out is None else path_in("`out`", out)
    if folder is not None:
        check_output(folder, overwrite, known=known)
    return folder


def write_answer(
    folder: Path | None,
    known: frozenset[str],
    files: Mapping[str, Any],
    figures: Callable[[], Iterable[tuple[str, Figure]]] | None = None,
    *,
    overwrite: bool,
) -> None:
    """Write all files of an answer, or none.

    A table becomes CSV, an array TIFF, a document with the name of its schema JSON; text and bytes
    stay as they are, and what is None is left out.
    """
    if folder is None:
        return
    with atomic_folder(folder, overwrite, known=known) as building:
        for name, content in files.items():
            path = building / name
            if isinstance(content, pd.DataFrame):
                content.to_csv(path, index=False, float_format=f"%.{CSV_DIGITS}g")
            elif isinstance(content, np.ndarray):
                tifffile.imwrite(path, content)
            elif isinstance(content, tuple):
                path.write_text(to_json(*content) + "\n", encoding="utf-8")
            elif content is not None:
                path.write_bytes(content if isinstance(content, bytes) else content.encode())
        if figures is not None:
            (building / "figures").mkdir()
            publish(figures(), building / "figures")


def tell(notes: Iterable[str], notify: Notify | None) -> None:
    """Give notes to whoever wants them."""
    if notify is not None:
        for note in notes:
            notify(note)
