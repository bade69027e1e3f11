"""The folder of an answer, and what its user is told."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
import pandas as pd
import tifffile

from iscat_analysis.inference.checks import path_in
from iscat_analysis.records import Progress, silent
from iscat_analysis.report import atomic_folder, check_output
from iscat_analysis.report.tables import CSV_DIGITS
from iscat_analysis.schemas import to_json

Notify = Callable[[str], None]


class Writing(TypedDict, total=False):
    """How an answer is written, and who is told."""

    overwrite: bool
    progress: Progress
    notify: Notify | None


@dataclass(frozen=True)
class AnswerFolder:
    """The folder of an answer, where one is wanted, and the names of all that may be in it."""

    path: Path | None
    known: frozenset[str]
    overwrite: bool = False
    progress: Progress = silent
    notify: Notify | None = None

    def write(self, files: Mapping[str, Any]) -> None:
        """Write all files of an answer, or none.

        A table becomes CSV, an array TIFF, a document with the name of its schema JSON; text and
        bytes stay as they are, what is None is left out, and a function makes the content.
        """
        if self.path is None:
            return
        with atomic_folder(self.path, self.overwrite, known=self.known) as building:
            for name, content in files.items():
                path = building / name
                content = content() if callable(content) else content
                if isinstance(content, pd.DataFrame):
                    content.to_csv(path, index=False, float_format=f"%.{CSV_DIGITS}g")
                elif isinstance(content, np.ndarray):
                    tifffile.imwrite(path, content)
                elif isinstance(content, tuple):
                    path.write_text(to_json(*content) + "\n", encoding="utf-8")
                elif content is not None:
                    path.write_bytes(content if isinstance(content, bytes) else content.encode())


def folder_for(out: str | Path | None, *known: str, **writing: Unpack[Writing]) -> AnswerFolder:
    """Check the folder of an answer before the work begins."""
    folder = AnswerFolder(
        None if out is None else path_in("`out`", out), frozenset(known), **writing
    )
    if folder.path is not None:
        check_output(folder.path, folder.overwrite, known=folder.known)
    return folder


def tell(notes: Iterable[str], notify: Notify | None) -> None:
    """Give notes to whoever wants them."""
    if notify is not None:
        for note in notes:
            notify(note)
