"""Files that hold several arrays under names, of which one is a movie: NumPy's and MATLAB's."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.mapped import WHAT_LIBRARIES_RAISE, refuse_growth
from iscat_analysis.movie.mapped_frames import Axes, MappedFrames, as_frames
from iscat_analysis.movie.stack import ArrayFrames, Frames
from iscat_analysis.reading import first_line, open_regular
from iscat_analysis.records import StackMetadata
from iscat_analysis.scratch import Scratch

SHOWN_NAMES = 5
"""Names of arrays in a message."""


@dataclass(frozen=True)
class Member:
    """An array of frames in a file.

    Attributes
    ----------
    shape : tuple of int
        Frames, rows, columns.
    stored : dtype
        Type of the numbers, as they are stored.
    axes : tuple of int
        Which of the three axes is stored slowest, and which fastest.
    size : int
        Bytes in the file.
    place : int
        First byte in the file, where the array is not compressed.
    unpack : callable or None
        Opens the bytes of a compressed array, as a stream with `readinto`.
    """

    shape: tuple[int, ...]
    stored: np.dtype[Any]
    axes: Axes
    size: int
    place: int = 0
    unpack: Callable[[], Any] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the array when it is unpacked."""
        return math.prod(self.shape) * self.stored.itemsize


ReadMembers = Callable[[BinaryIO, Path], Mapping[str, Member | str]]
"""Lists what a file holds: arrays of frames, and in words what else."""


def open_member(path: Path, part: str, *, read: ReadMembers, kind: str) -> Frames:
    """Open the array that is named, or the only one of frames."""
    with open_regular(path) as file:
        try:
            members = read(file, path)
            if not members:
                raise DataError(f"{path}: is {kind} that holds no array; export the movie as TIFF")
            name, member = _chosen(path, part, members)
            alone = part or len(members) == 1
            notes = () if alone else (f"its frames are those of the array {name}",)
            return _frames(member, f"{path}{MARK}{name}", path, notes)
        except DataError:
            raise
        except (zipfile.BadZipFile, zlib.error, EOFError, *WHAT_LIBRARIES_RAISE) as error:
            raise DataError(
                f"{path}: begins like {kind} but is damaged ({first_line(error)}); copy it again "
                "or save it again"
            ) from None


def holds_one(path: Path, *, read: ReadMembers) -> bool:
    """Tell whether a file holds exactly one movie; a damaged one is left to whoever opens it."""
    try:
        with open_regular(path) as file:
            return sum(isinstance(held, Member) for held in read(file, path).values()) == 1
    except (DataError, zipfile.BadZipFile, zlib.error, EOFError, *WHAT_LIBRARIES_RAISE):
        return True


def is_movie(shape: Sequence[int]) -> bool:
    """Tell whether an array has the axes (t, y, x), several of each."""
    return len(shape) == 3 and min(shape) > 1


def name_one(path: Path, names: Sequence[str], what: str) -> DataError:
    """Ask for a name where a file holds several movies."""
    shown = ", ".join(names[:SHOWN_NAMES]) + (", …" if len(names) > SHOWN_NAMES else "")
    return DataError(
        f"{path}: holds {len(names)} {what} of frames ({shown}); name one, as in "
        f'"{path}{MARK}{names[0]}"'
    )


def _chosen(path: Path, part: str, members: Mapping[str, Member | str]) -> tuple[str, Member]:
    movies = {name: held for name, held in members.items() if isinstance(held, Member)}
    if not part and len(movies) > 1:
        raise name_one(path, list(movies), "arrays")
    wanted = part.strip("/") if part else next(iter(movies), "")
    if wanted in movies:
        return wanted, movies[wanted]
    others = {name: str(held) for name, held in members.items() if name not in movies}
    if wanted in others:
        others = {wanted: others[wanted]}
    held = "; ".join(f"{name} {text}" for name, text in list(others.items())[:SHOWN_NAMES])
    if part and wanted not in members:
        held = "is not there"
    raise DataError(
        f"{path}{MARK + part if part else ''}: {held}; frames, several of each axis, are in: "
        f"{', '.join(list(movies)[:SHOWN_NAMES]) or 'none'}"
    )


def _frames(member: Member, name: str, path: Path, notes: tuple[str, ...]) -> Frames:
    shape, stored, axes = member.shape, member.stored, member.axes
    if member.unpack is None:
        if member.nbytes > member.size:
            raise DataError(
                f"{name}: is truncated ({member.size} of {member.nbytes} bytes are there); copy "
                "the file again or save it again"
            )
        return MappedFrames(path, shape, stored, offset=member.place, axes=axes, notes=notes)
    refuse_growth(member.nbytes, member.size, f"{name}: it")
    room = Scratch((member.nbytes,), np.dtype(np.uint8)).array
    with member.unpack() as packed:
        filled, view = 0, room.data
        while filled < len(view) and (count := packed.readinto(view[filled:])):
            filled += count
    if filled < len(view):
        raise DataError(
            f"{name}: is truncated ({filled} of {len(view)} bytes are there); copy the file again "
            "or save it again"
        )
    return ArrayFrames(as_frames(room, shape, stored, axes), name, StackMetadata(), notes)
