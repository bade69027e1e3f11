"""Write scores as a folder that can be cited: JSON, page, figures, BibTeX, and an archive."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from iscat_analysis.errors import DataError
from iscat_analysis.files import whole_file
from iscat_analysis.report import CHALLENGE_NAMES, atomic_folder, render_challenge
from iscat_analysis.schemas import to_json

_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest that an archive can name: no date is part of a score


def write_scores(document: Mapping[str, Any], folder: Path, *, overwrite: bool = False) -> Path:
    """Write ``challenge.json``, ``challenge.html``, ``benchmark.bib`` and ``figures/``."""
    with atomic_folder(folder, overwrite, known=CHALLENGE_NAMES) as building:
        text = to_json("challenge", document) + "\n"
        (building / "challenge.json").write_text(text, encoding="utf-8")
        (building / "figures").mkdir()
        page = render_challenge(document, folder=building / "figures")
        (building / "challenge.html").write_text(page, encoding="utf-8")
        (building / "benchmark.bib").write_text(bibtex(document["title"], text), encoding="utf-8")
    return folder


def bibtex(title: str, document: str) -> str:
    """Cite a score by the hash of its JSON, and the program that made it."""
    digest = hashlib.sha256(document.encode()).hexdigest()
    number = version("iscat-analysis")
    return (
        f"@misc{{iscat_benchmark_{digest[:8]},\n"
        f"  title        = {{{title}: estimators beside the Cram{{\\'e}}r--Rao bounds}},\n"
        f"  howpublished = {{iscat-analysis {number}}},\n"
        f"  note         = {{SHA-256 of the scores {digest}}},\n"
        "}\n\n"
        "@software{iscat_analysis,\n"
        "  author  = {{The iscat-analysis developers}},\n"
        "  title   = {iscat-analysis},\n"
        f"  version = {{{number}}},\n"
        "}\n"
    )


def write_archive(folder: Path, archive: Path, *, title: str, overwrite: bool = False) -> None:
    """Pack a folder with what a repository of data asks for; equal scores give equal bytes."""
    if archive.exists() and not overwrite:
        raise DataError(f"{archive}: exists already; give another name, or pass `overwrite`")
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    about = {
        "title": title,
        "upload_type": "dataset",
        "description": "Estimators of particles in interferometric scattering movies, scored "
        "against classical and quantum Cramér–Rao bounds.",
        "creators": [{"name": "give the authors here"}],
        "keywords": ["iSCAT", "mass photometry", "Cramér-Rao bound", "benchmark"],
        "version": version("iscat-analysis"),
    }
    try:
        with whole_file(archive) as partial, zipfile.ZipFile(partial, "w") as packed:
            content = {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}
            sums = "".join(
                f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in content.items()
            )
            content["SHA256SUMS"] = sums.encode()
            content[".zenodo.json"] = (json.dumps(about, indent=1) + "\n").encode()
            for name, data in content.items():
                entry = zipfile.ZipInfo(f"{folder.resolve().name}/{name}", _EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = 0o644 << 16
                packed.writestr(entry, data)
    except OSError as error:
        raise DataError(f"{archive}: cannot be written ({error.strerror})") from None
