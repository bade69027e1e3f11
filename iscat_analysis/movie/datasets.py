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
from iscat_analysis.movie.containers import SHOWN_NAMES, name_one
from iscat_analysis.movie.hdf5 import Hdf5Reader, StoredArray
from iscat_analysis.movie.mapped import Writer
from iscat_analysis.movie.refeyn import is_refeyn, open_refeyn
from iscat_analysis.movie.stack import Frames
from iscat_analysis.records import StackMetadata

_MOST_NAMES = 1000  # that are looked at
_MOST_GROUPS = 8  # one inside the other, in which movies are looked for; named, they may be deeper
_OF_CELLS = "#"  # begins the names of groups in which MATLAB keeps what cells refer to


class DatasetFrames:
    """The frames of a dataset; `open_hdf5` makes it."""

    metadata = StackMetadata()

    def __init__(
        self, stored: StoredArray, reader: Hdf5Reader, notes: tuple[str, ...], *, by_columns: bool
    ) -> None:
        self._stored, self._data, self._by_columns = stored, reader.data, by_columns
        y, x = stored.shape[:-3:-1] if by_columns else stored.shape[-2:]
        self.shape = (stored.shape[0], y, x)
        self.dtype = stored.dtype
        self.notes = notes

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        counts = self._stored.read(start, stop)
        counts = counts.reshape(len(counts), *counts.shape[-2:])
        return np.ascontiguousarray(counts.transpose(0, 2, 1) if self._by_columns else counts)

    def close(self) -> None:
        """Release the file."""
        self._data.close()


def open_hdf5(path: Path, part: str, *, by_columns: bool = False) -> Frames:
    """Open a movie in an HDF5 file, with the axes (t, y, x) or, of MATLAB, (t, x, y)."""
    with closing(Hdf5Reader(path)) as reader:
        try:
            if not part and is_refeyn(reader):
                reader.data.close()
                return open_refeyn(path)
            names = [part.strip("/")] if part else list(_movies(reader))
            if not names:
                raise DataError(
                    f"{path}: is an HDF5 file that holds no frames (t, y, x) and is no Refeyn "
                    "movie; export the movie as TIFF"
                )
            if len(names) > 1:
                raise name_one(path, [f"/{name}" for name in names], "datasets")
            stored = reader.array(names[0])
            if stored is None or not _is_movie(stored.shape):
                held = "is not there" if stored is None else f"has the shape {stored.shape}"
                others = ", ".join(f"/{name}" for name in list(_movies(reader))[:SHOWN_NAMES])
                raise DataError(
                    f"{path}{MARK}{part}: {held}; frames (t, y, x) are in: {others or 'none'}"
                )
            notes = [] if part else [f"its frames are those of the dataset /{names[0]}"]
            if reader.writer is not Writer.NONE:
                notes.append(
                    f"a program has it open to write, or ended without closing it: the "
                    f"{stored.shape[0]} frames are those that were written until now"
                )
            return DatasetFrames(stored, reader, tuple(notes), by_columns=by_columns)
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


def _is_movie(shape: tuple[int, ...]) -> bool:
    return len(shape) >= 3 and shape[0] > 1 and 0 not in shape and set(shape[1:-2]) <= {1}


def _movies(reader: Hdf5Reader) -> Iterator[str]:
    """Give the names of datasets that may be movies, all of whose frames may not be there."""
    waiting, seen = [""], 0
    while waiting and seen < _MOST_NAMES:
        group = waiting.pop(0)
        for name in reader.names(group):
            if name.startswith(_OF_CELLS):
                continue
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
