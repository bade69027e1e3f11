"""Movies of contiguous numbers: NumPy files and raw files."""

from __future__ import annotations

import math
import tokenize
import warnings
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK, Layout, layout
from iscat_analysis.movie.disorder import bytes_are_swapped, lines_are_exchanged, looked_at
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

Axes = tuple[int, int, int]
ROWS_TOGETHER, COLUMNS_TOGETHER, FRAMES_TOGETHER = (0, 1, 2), (0, 2, 1), (2, 1, 0)
"""Which of the axes (t, y, x) is stored slowest, and which fastest: as C, MATLAB and Fortran do."""

_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class MappedFrames:
    """Frames of a file that holds only numbers, after a header."""

    metadata = StackMetadata()

    def __init__(
        self,
        path: Path,
        shape: tuple[int, ...],
        stored: np.dtype[Any],
        *,
        offset: int,
        axes: Axes = ROWS_TOGETHER,
        member: bool = False,
        notes: tuple[str, ...] = (),
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
        self._stored, self._offset, self._axes = stored, offset, axes
        self.notes = notes

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        refuse_changed(self._path, self._data)
        frames = as_frames(self._data, self.shape, self._stored, self._axes, self._offset)
        block = np.array(frames[start:stop], dtype=self.dtype, order="C")
        del frames
        if self._axes[0] == 0:
            release(self._data, self._begin(start), self._begin(stop))
        return block

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """View frames ``[start, stop)`` in the file; None if they have to be read."""
        if self._axes != ROWS_TOGETHER:
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
    with open_regular(path) as file:
        header = read_header(file, path)
    return MappedFrames(path, *header[:2], offset=header.offset, axes=header.axes)


class Header(NamedTuple):
    """What comes before the numbers of an array that NumPy saved."""

    shape: tuple[int, ...]
    stored: np.dtype[Any]
    axes: Axes
    offset: int


def read_header(file: IO[bytes], path: Path) -> Header:
    """Read what comes before the numbers of an array, and not more."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that Python 2 wrote, which are read
            version = npy.read_magic(file)
            shape, last_first, stored = _HEADERS[version](file)
            offset = file.tell()
    except (SyntaxError, tokenize.TokenError, *WHAT_LIBRARIES_RAISE) as error:
        raise DataError(
            f"{path}: begins like a NumPy array but is damaged ({first_line(error)}); save it again"
        ) from None
    return Header(shape, stored, FRAMES_TOGETHER if last_first else ROWS_TOGETHER, offset)


def as_frames(
    data: Any, shape: tuple[int, ...], stored: np.dtype[Any], axes: Axes, offset: int = 0
) -> NDArray[Any]:
    """Take bytes for frames (t, y, x)."""
    lying = tuple(shape[axis] for axis in axes)
    return np.ndarray(lying, stored, buffer=data, offset=offset).transpose(np.argsort(axes))


def open_raw(path: Path, part: str) -> MappedFrames:
    """Open a file that holds the counts and nothing else, but for a header that is passed over."""
    example = f"{path}{MARK}1500x128x128,uint16"
    found = layout(part)
    if found is None:
        raise DataError(
            f"{path}{MARK}{part}: a file of plain numbers needs frames x rows x columns and their "
            f"type, as in {example}; behind a header, and column by column: {example},header=344,"
            "order=columns"
        )
    try:
        stored = np.dtype(found.type_name)
    except (TypeError, ValueError, SyntaxError):
        raise DataError(
            f"{path}{MARK}{part}: {found.type_name} is no type of numbers; write uint8, uint16, "
            f"float32 or, for the larger byte first, >u2, as in {example}"
        ) from None
    size, frame = path.stat().st_size, found.rows * found.columns * stored.itemsize
    held = size - found.header_bytes
    number = found.frames or (max(held, 0) // frame if frame else 0)
    if number * frame != held:
        needs = f"{number * frame}" if found.frames else f"a multiple of {frame}"
        behind = f" behind a header of {found.header_bytes}" if found.header_bytes else ""
        remedy = "check the shape and the type"
        spare = held - number * frame
        if frame and number and spare > 0:
            header = found._replace(header_bytes=found.header_bytes + spare)
            remedy += (
                f" or, if the file begins with a header of {header.header_bytes} bytes, write "
                f'"{path}{MARK}{header}"'
            )
        raise DataError(f"{path}: has {size} bytes, but {part} needs {needs}{behind}; {remedy}")
    shape, axes = (number, found.rows, found.columns), ROWS_TOGETHER
    if found.by_columns:
        axes = COLUMNS_TOGETHER
    frames = MappedFrames(path, shape, stored, offset=found.header_bytes, axes=axes)
    refuse_disorder(frames, found._replace(frames=number), path)
    return frames


def refuse_disorder(frames: MappedFrames, said: Layout, path: Path) -> None:
    """Refuse numbers that are far smoother in another order than was said, and close them."""
    counts = np.concatenate([frames.read(*pair) for pair in looked_at(frames.shape[0])])
    cause = ""
    if bytes_are_swapped(counts):
        stored = np.dtype(said.type_name).newbyteorder("S")
        right = said._replace(type_name=stored.str)
        cause = (
            "the bytes of its numbers are the other way round: pixels leap over the range of "
            f"{frames.dtype} from one frame to the next, and do not as {stored.str}"
        )
    elif lines_are_exchanged(counts.transpose(0, 2, 1) if said.by_columns else counts):
        right = said._replace(by_columns=not said.by_columns)
        cause = (
            f"its frames are not stored as {said.rows} rows of {said.columns}: neighbouring pixels "
            "agree where columns and rows are exchanged"
        )
    if cause:
        frames.close()
        turned = right._replace(rows=said.columns, columns=said.rows, by_columns=said.by_columns)
        other = f' or "{path}{MARK}{turned}"' if right.by_columns != said.by_columns else ""
        raise DataError(f'{path}: {cause}; write "{path}{MARK}{right}"{other}')
