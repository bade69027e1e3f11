"""What a text beside a movie says of its recording: names and values, or JSON.

Programs that cannot write into the movie's file leave their settings under its name: Andor Solis
``movie.txt``, PyLabLib ``movie_settings.dat``, Basler's viewer ``movie.pfs``, Micro-Manager
``movie_metadata.txt``, and laboratories ``movie.json`` of their own.  Of all that is in them only
the names of `driver_names` are read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from iscat_analysis.movie.driver_names import Told, told_by
from iscat_analysis.reading import is_file, json_of, read_text
from iscat_analysis.records import StackMetadata

_ENDS = (".json", ".txt", ".dat", ".pfs", "_settings.dat", "_metadata.txt")
_LINE = re.compile(r"\s*([^\t:=#]+?|cam/[^\t]+?)\s*[\t:=]\s*(\S.*?)\s*")
_MOST_NAMES = 20_000  # of all frames of a long movie
_LONGEST_LINE = 400


def with_side_files(metadata: StackMetadata, movie: Path) -> StackMetadata:
    """Fill what a movie does not say of itself from the texts beside it."""
    for path in _beside(movie):
        told = _read(path)
        fresh = {
            name: value
            for name, value in vars(told).items()
            if value is not None and getattr(metadata, name) is None
        }
        if fresh:
            sources = [metadata.source] if metadata.source != "none" else []
            metadata = replace(metadata, **fresh, source="+".join([*sources, path.name]))
    return metadata


def _beside(movie: Path) -> Iterator[Path]:
    """Name the texts that belong to a movie, as far as they are there."""
    stems = dict.fromkeys((movie.stem, movie.name.partition(".ome.")[0], movie.name))
    names = [f"{stem}{end}" for stem in stems for end in _ENDS]
    if movie.stem == "frames":  # as PyLabLib calls a movie that has a folder of its own
        names.append("settings.dat")
    if is_file(movie / "metadata.txt"):  # of a folder of frames, as Micro-Manager writes it
        yield movie / "metadata.txt"
    for name in dict.fromkeys(names):
        path = movie.with_name(name)
        if name != movie.name and is_file(path):
            yield path


def _read(path: Path) -> Told:
    """Read what one text tells; nothing of one that cannot be read."""
    try:
        text = read_text(path, errors="replace")
        if text.lstrip()[:1] in ("{", "["):
            return told_by(dict(_flat(json_of(text))))
    except (OSError, ValueError):
        return Told()
    lines = (line for line in text.splitlines() if len(line) <= _LONGEST_LINE)
    pairs = (match.groups() for line in lines if (match := _LINE.fullmatch(line)))
    return told_by({key: value for (key, value), _ in zip(pairs, range(_MOST_NAMES), strict=False)})


def _flat(value: object) -> Iterator[tuple[str, object]]:
    """Name the values of a nest of brackets, as ``camera/ExposureTime``."""
    pending: list[tuple[str, object]] = [("", value)]
    for _ in range(_MOST_NAMES):
        if not pending:
            return
        key, part = pending.pop()
        if isinstance(part, dict) and "PropVal" not in part:
            pending += [(f"{key}/{name}" if key else str(name), one) for name, one in part.items()]
        elif not isinstance(part, list):
            yield key, part
