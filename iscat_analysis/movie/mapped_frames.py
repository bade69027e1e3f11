"""Movies of contiguous numbers: NumPy files and raw files."""

from __future__ import annotations

import math
import tokenize
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK, layout
from iscat_analysis.movie.mapped import (
    WHAT_LIBRARIES_RAISE,
    frames_in_place,
    map_file,
    refuse_changed,
    release,
    unmap,
)
from iscat_analysis.reading import first_line, open_regular
from iscat_analysis.records import InPlace, StackMetadata

NPY_SIGNATURE = b"\x93NUMPY"

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class MappedFrames:
    """Frames of a file that holds only numbers, after a header."""

    metadata = StackMetadata()
    notes = ()

    def __init__(
        self,
        path: Path,
        shape: tuple[int, ...],
        stored: np.dtype[Any],
        *,
        offset: int,
        last_first: bool = False,
        member: bool = False,
    ) -> None:
        if len(shape) != 3 or min(shape) < 1 or stored.kind not in "uif":
            raise DataError(
                f"{path}: needs to be frames (t, y, x) of integers or floats but is {stored} of "
                f"shape {shape}; save the camera's counts, one frame after the other"
            )
        if shape[0] < 2 and not member:
            raise DataError(
                f"{path}: holds a single frame; a movie needs frames before and after a particle "
                "binds"
            )
        self._path, self._data = path, map_file(path)
        needed = offset + math.prod(shape) * stored.itemsize
        if needed > len(self._data):
            held = len(self._data)
            self._data.close()
            raise DataError(
                f"{path}: is truncated ({shape[0]} frames of {shape[1]} x {shape[2]} {stored} need "
                f"{needed} bytes, it has {held}); copy it again or export it again"
            )
        self.shape = (shape[0], shape[1], shape[2])
        self.dtype: np.dtype[Any] = stored.newbyteorder("=")
        self._stored, self._offset, self._last_first = stored, offset, last_first

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        refuse_changed(self._path, self._data)
        whole: NDArray[Any] = np.ndarray(
            self.shape, self._stored, buffer=self._data, offset=self._offset,
            order="F" if self._last_first else "C",
        )  # fmt: skip
        block = np.array(whole[start:stop], dtype=self.dtype, order="C")
        del whole
        if not self._last_first:
            release(self._data, self._begin(start), self._begin(stop))
        return block

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """View frames ``[start, stop)`` in the file; None if they have to be read."""
        if self._last_first:
            return None
        shape = (stop - start, *self.shape[1:])
        return frames_in_place(self._path, self._data, self._begin(start), shape, self._stored)

    def _begin(self, frame: int) -> int:
        return self._offset + frame * math.prod(self.shape[1:]) * self._stored.itemsize

    def close(self) -> None:
        """Release the file."""
        unmap(self._data)


def open_npy(path: Path) -> MappedFrames:
    """Open an array that NumPy saved."""
    try:
        with open_regular(path) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that Python 2 wrote, which are read
            version = npy.read_magic(file)
            shape, last_first, stored = _HEADERS[version](file)
            offset = file.tell()
    except (SyntaxError, tokenize.TokenError, *WHAT_LIBRARIES_RAISE) as error:
        raise DataError(
            f"{path}: begins like a NumPy array but is damaged ({first_line(error)}); save it again"
        ) from None
    return MappedFrames(path, shape, stored, offset=offset, last_first=last_first)


def open_raw(path: Path, part: str) -> MappedFrames:
    """Open a file that holds the counts and nothing else."""
    example = f"{path}{MARK}1500x128x128,uint16"
    found = layout(part)
    if found is None:
        raise DataError(
            f"{path}{MARK}{part}: a file of plain numbers needs frames x rows x columns and their "
            f"type, as in {example}"
        )
    frames, rows, columns, name = found
    try:
        stored = np.dtype(name)
    except (TypeError, ValueError, SyntaxError):
        raise DataError(
            f"{path}{MARK}{part}: {name} is no type of numbers; write uint8, uint16, float32 or, "
            f"for the larger byte first, >u2, as in {example}"
        ) from None
    held, frame = path.stat().st_size, rows * columns * stored.itemsize
    number = frames or (held // frame if frame else 0)
    if number * frame != held:
        raise DataError(
            f"{path}: has {held} bytes, but {part} needs "
            + (f"{number * frame}" if frames else f"a multiple of {frame}")
            + "; check the shape and the type"
        )
    return MappedFrames(path, (number, rows, columns), stored, offset=0)
