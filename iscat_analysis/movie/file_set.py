"""A movie in several files: TIFF, as Micro-Manager writes it beyond 4 GB and OME describes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.descriptions import merge
from iscat_analysis.movie.ome import OmeSet
from iscat_analysis.movie.stack import Frames
from iscat_analysis.records import InPlace, PlacedSource, StackMetadata


class FileSet:
    """The frames of a set of files."""

    def __init__(
        self,
        members: Sequence[Frames],
        files: Sequence[Path],
        where: NDArray[np.int64],
        metadata: StackMetadata,
        notes: tuple[str, ...] = (),
    ) -> None:
        self._members, self._where = members, where
        self.files = tuple(files)
        self.shape = (len(where), *members[0].shape[1:])
        self.dtype = members[0].dtype
        self.metadata, self.notes = metadata, notes

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        where = self._where[start:stop]
        goes_on = (np.diff(where, axis=0) == [0, 1]).all(axis=1)
        runs = np.flatnonzero(~goes_on) + 1
        for first, last in zip([0, *runs], [*runs, len(where)], strict=True):
            if last > first:
                member, image = where[first]
                block[first:last] = self._members[member].read(image, image + last - first)
        return block

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """Give frames where they lie, if one file holds all of them in a row."""
        where = self._where[start:stop]
        if not len(where) or not (np.diff(where, axis=0) == [0, 1]).all():
            return None
        member, image = self._members[int(where[0, 0])], int(where[0, 1])
        if not isinstance(member, PlacedSource):
            return None
        return member.in_place(image, image + stop - start)

    def close(self) -> None:
        """Release the files."""
        for member in self._members:
            member.close()


def open_set(described: OmeSet, path: Path, open_member: Callable[[Path], Frames]) -> FileSet:
    """Open the files of a set, which lie beside each other."""
    files = [path.with_name(name) if name else path for name in described.files]
    with ExitStack() as opened:
        members = []
        for file in files:
            members.append(open_member(file))
            opened.callback(members[-1].close)
        last = np.full(len(files), -1)
        np.maximum.at(last, described.where[:, 0], described.where[:, 1])
        for number, (file, member) in enumerate(zip(files, members, strict=True)):
            if (member.shape[1:], member.dtype) != (members[0].shape[1:], members[0].dtype):
                raise DataError(f"{file}: has other pixels than {files[0].name}; export it again")
            needed = int(last[number]) + 1
            if needed > member.shape[0]:
                raise DataError(
                    f"{file}: holds {member.shape[0]} images, but the description of its set says "
                    f"{needed}; the recording or the copy was interrupted: export it again"
                )
        opened.pop_all()
    hints = described.hints
    return FileSet(members, files, described.where, merge([hints], path), hints.notes)
