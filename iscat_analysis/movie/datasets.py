"""Movies in HDF5 files: Refeyn's, and any dataset of frames that is named or alone there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.hdf5 import Hdf5Reader, StoredArray
from iscat_analysis.movie.mapped import Writer
from iscat_analysis.movie.refeyn import is_refeyn, open_refeyn
from iscat_analysis.movie.stack import Frames
from iscat_analysis.records import StackMetadata

_MOST_NAMES = 1000  # that are looked at
_MOST_GROUPS = 8  # one inside the other, in which movies are looked for; named, they may be deeper
_SHOWN = 5  # in a message


class DatasetFrames:
    """The frames of a dataset; `open_hdf5` makes it."""

    metadata = StackMetadata()

    def __init__(self, stored: StoredArray, reader: Hdf5Reader, notes: tuple[str, ...]) -> None:
        self._stored, self._data = stored, reader.data
        self.shape = (stored.shape[0], stored.shape[-2], stored.shape[-1])
        self.dtype = stored.dtype
        self.notes = notes

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        return np.ascontiguousarray(self._stored.read(start, stop)).reshape(-1, *self.shape[1:])

    def close(self) -> None:
        """Release the file."""
        self._data.close()


def open_hdf5(path: Path, part: str) -> Frames:
    """Open a movie in an HDF5 file."""
    with closing(Hdf5Reader(path)) as reader:
        try:
            if not part and is_refeyn(reader):
                reader.data.close()
                return open_refeyn(path)
            names = [part.strip("/")] if part else list(_movies(reader))
            if len(names) != 1:
                raise DataError(f"{path}: {_which(path, names)}")
            stored = reader.array(names[0])
            if stored is None or not _is_movie(stored.shape):
                held = "is not there" if stored is None else f"has the shape {stored.shape}"
                others = ", ".join(f"/{name}" for name in list(_movies(reader))[:_SHOWN])
                raise DataError(
                    f"{path}{MARK}{part}: {held}; frames (t, y, x) are in: {others or 'none'}"
                )
            notes = [] if part else [f"its frames are those of the dataset /{names[0]}"]
            if reader.writer is not Writer.NONE:
                notes.append(
                    f"a program has it open to write, or ended without closing it: the "
                    f"{stored.shape[0]} frames are those that were written until now"
                )
            return DatasetFrames(stored, reader, tuple(notes))
        except BaseException:
            reader.data.close()
            raise


def is_one_movie(path: Path) -> bool:
    """Tell whether an HDF5 file holds exactly one movie."""
    try:
        with closing(Hdf5Reader(path)) as reader, closing(reader.data):
            return is_refeyn(reader) or len(list(_movies(reader))) == 1
    except DataError:
        return True


def _which(path: Path, names: list[str]) -> str:
    if not names:
        return (
            "is an HDF5 file that holds no frames (t, y, x) and is no Refeyn movie; export the "
            "movie as TIFF"
        )
    shown = ", ".join(f"/{name}" for name in names[:_SHOWN])
    more = ", …" if len(names) > _SHOWN else ""
    return (
        f"holds {len(names)} datasets of frames ({shown}{more}); name one, as in "
        f'"{path}{MARK}/{names[0]}"'
    )


def _is_movie(shape: tuple[int, ...]) -> bool:
    return len(shape) >= 3 and shape[0] > 1 and 0 not in shape and set(shape[1:-2]) <= {1}


def _movies(reader: Hdf5Reader) -> Iterator[str]:
    """Give the names of datasets that may be movies, all of whose frames may not be there."""
    waiting, seen = [""], 0
    while waiting and seen < _MOST_NAMES:
        group = waiting.pop(0)
        for name in reader.names(group):
            seen += 1
            whole = f"{group}/{name}" if group else name
            try:
                shape = reader.shape(whole)
            except DataError:  # links that lead elsewhere
                continue
            if shape is None:
                if whole.count("/") < _MOST_GROUPS:
                    waiting.append(whole)
            elif _is_movie(shape) and min(shape[-2:]) > 1:
                yield whole
