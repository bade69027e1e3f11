"""Plain numbers that a text beside them describes, or their own name.

PyLabLib cam-control writes ``movie.bin`` with ``movie_settings.dat``, or ``frames.bin`` with
``settings.dat``; a long movie in parts, ``movie_0000.bin``, ``movie_0001.bin``…  The keys are
``save/frame/shape``, ``save/frame/dtype``, ``save/saved`` and ``save/append``
(https://pylablib-cam-control.readthedocs.io, "File formats").  PiSCAT's movies are named by their
shape and type, as ``control_4999_128_128_uint16_2.33FPS.raw`` (https://piscat.readthedocs.io).
"""

from __future__ import annotations

import glob
import re
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK, Layout
from iscat_analysis.movie.file_set import FileSet
from iscat_analysis.movie.mapped_frames import MappedFrames, refuse_disorder
from iscat_analysis.reading import is_file, read_text
from iscat_analysis.records import StackMetadata

SUFFIXES = (".bin", ".raw")
"""Of files that are looked at in this way."""

_PART = re.compile(r"_\d{4,9}$", flags=re.ASCII)
_SHAPE = re.compile(r"\(\s*(\d{1,9})\s*,\s*(\d{1,9})\s*\)", flags=re.ASCII)
_NUMBER = re.compile(r"\d{1,12}", flags=re.ASCII)
_NAME = re.compile(
    r"_(\d{1,9})_(\d{1,9})_(\d{1,9})_(u?int(?:8|16|32)|float(?:32|64))(?:_|$)", flags=re.ASCII
)


def description_of(path: Path) -> Path | None:
    """Find what describes a file of plain numbers."""
    if path.suffix.lower() not in SUFFIXES:
        return None
    for stem in dict.fromkeys((path.stem, _PART.sub("", path.stem))):
        for settings in _settings(stem, path):
            if is_file(settings):
                return settings
    return path if _named(path) is not None else None


def recorded_files(path: Path) -> tuple[Path, ...]:
    """Give the files of a movie, its settings last."""
    settings = description_of(path)
    if settings is None or settings == path:
        return (path,)
    stem = _PART.sub("", path.stem)
    if settings in _settings(path.stem, path):
        return path, settings
    parts = path.parent.glob(f"{glob.escape(stem)}_*{path.suffix}")
    mine = (each for each in parts if _PART.fullmatch(each.stem.removeprefix(stem)))
    return *sorted(mine, key=lambda each: (len(each.stem), each.stem)), settings


def _settings(stem: str, path: Path) -> list[Path]:
    """Name the settings that a recording of this name has."""
    names = [f"{stem}_settings.dat", *(["settings.dat"] if stem == "frames" else [])]
    return [path.with_name(name) for name in names]


def open_recorded(path: Path) -> FileSet:
    """Open a movie that `description_of` finds described."""
    named = _named(path) if description_of(path) == path else None
    if named is not None:
        frames, rows, columns, stored = named
        files: tuple[Path, ...] = (path,)
        counts = {path: frames}
    else:
        files = recorded_files(path)
        rows, columns, stored, counts = _counted(files[:-1], files[-1])
    if sum(counts.values()) < 2:
        raise DataError(
            f"{path}: holds a single frame; a movie needs frames before and after a particle binds"
        )
    members = []
    with ExitStack() as opened:
        for each, count in counts.items():
            if count:
                shape = (count, rows, columns)
                members.append(MappedFrames(each, shape, stored, offset=0, member=True))
                opened.callback(members[-1].close)
        if named is not None:
            refuse_disorder(members[0], Layout(*named[:3], stored.str), path)
        opened.pop_all()
    where = [(m, image) for m, member in enumerate(members) for image in range(member.shape[0])]
    return FileSet(members, files, np.array(where, dtype=np.int64), StackMetadata())


def _counted(
    files: tuple[Path, ...], settings: Path
) -> tuple[int, int, np.dtype[Any], dict[Path, int]]:
    """Read rows, columns and type, and how many frames each file holds; all of them are needed."""
    values = _read(settings)
    shape = _SHAPE.fullmatch(values.get("save/frame/shape", ""))
    name = values.get("save/frame/dtype", "")
    if shape is None or not name:
        raise DataError(
            f"{settings}: does not say save/frame/shape and save/frame/dtype, which are written "
            "when a recording ends; wait until it does, or give the shape yourself, as in "
            f'"{files[0].name}{MARK}1500x128x128,uint16"'
        )
    try:
        stored = np.dtype(name)
    except (TypeError, ValueError, SyntaxError):
        raise DataError(f"{settings}: save/frame/dtype = {name} is no type of numbers") from None
    rows, columns = int(shape[1]), int(shape[2])
    frame = rows * columns * stored.itemsize
    counts = {}
    for file in files:
        held = file.stat().st_size
        if not frame or held % frame:
            raise DataError(
                f"{file}: has {held} bytes, but {settings.name} says {rows} x {columns} pixels of "
                f"{stored}, so that it should be a multiple of {frame}; copy both again, or check "
                "that they belong together"
            )
        counts[file] = held // frame
    _refuse_incomplete(values, counts, settings)
    return rows, columns, stored, counts


def _refuse_incomplete(values: dict[str, str], counts: dict[Path, int], settings: Path) -> None:
    """Compare the frames that are there with those that were saved."""
    numbers = [int(match[0][1:]) for file in counts if (match := _PART.search(file.stem))]
    if len(counts) > 1 and numbers != list(range(len(counts))):
        lost = next(n for n in range(len(counts)) if n not in numbers)
        raise DataError(f"{settings}: part {lost:04} of its movie is missing; copy it again")
    saved, held = values.get("save/saved", ""), sum(counts.values())
    added = values.get("save/append") == "True"  # to what another recording had left there
    if _NUMBER.fullmatch(saved) and (held < int(saved) or (held > int(saved) and not added)):
        raise DataError(
            f"{settings}: says that {saved} frames were saved, but there are {held}; copy the "
            "movie again, with all of its files"
        )


def _read(settings: Path) -> dict[str, str]:
    """Read a text of keys and values."""
    try:
        text = read_text(settings, errors="replace")
    except OSError as error:
        raise DataError(f"{settings}: cannot be read ({error.strerror})") from None
    pairs = (line.split("\t", 1) for line in text.splitlines() if "\t" in line)
    return {key.strip(): value.strip() for key, value in pairs}


def _named(path: Path) -> tuple[int, int, int, np.dtype[Any]] | None:
    """Read shape and type out of a name, if the file is as long as that."""
    match = _NAME.search(path.stem)
    if match is None:
        return None
    frames, rows, columns = (int(match[k]) for k in (1, 2, 3))
    stored = np.dtype(match[4]).newbyteorder("<")
    try:
        size = path.stat().st_size
    except OSError:
        return None
    fits = frames * rows * columns * stored.itemsize == size > 0
    return (frames, rows, columns, stored) if fits else None
