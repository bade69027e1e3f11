"""Arrays in MATLAB's ``.mat`` files of versions 5 to 7; version 7.3 is HDF5.

MATLAB's movies have the axes (y, x, t) and are stored column by column.  Arrays are found here and
mapped where they lie, or unpacked into a temporary file.  SciPy would hold them in memory whole,
and ends the process with a segmentation fault on some files in which a byte has changed.
Format: MATLAB, "MAT-File Format", level 5 (The MathWorks).
"""

from __future__ import annotations

import io
import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from iscat_analysis.errors import DataError
from iscat_analysis.movie.containers import Member, is_movie
from iscat_analysis.movie.mapped_frames import COLUMNS_TOGETHER
from iscat_analysis.reading import open_regular

_HEADER_BYTES = 128
_HDF5_HEADER = b"MATLAB 7.3 MAT-file"
_ORDERS = {b"IM": "<", b"MI": ">"}
_MATRIX, _COMPRESSED = 14, 15
_TYPES = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_CLASSES = {
    1: "a cell array", 2: "a struct", 3: "an object", 4: "text", 5: "a sparse matrix",
    16: "a function", 17: "an object",
}  # fmt: skip
_COMPLEX = 0x800
_OPAQUE = 17  # which has no shape
_LARGEST_HEADER = 4096  # bytes of a shape or a name
_MOST_ARRAYS = 1000
_BLOCK = 65_536


class _Inflating(io.RawIOBase):
    """The bytes that a part of a file has when it is unpacked."""

    def __init__(self, file: BinaryIO, start: int, size: int) -> None:
        self._file, self._at, self._end = file, start, start + size
        self._inflate = zlib.decompressobj()

    def readable(self) -> bool:
        """Tell that it can be read."""
        return True

    def readinto(self, room: Any) -> int:
        """Fill some of the room, none of it at the end."""
        got = b""
        while not got and not self._inflate.eof:
            packed = self._inflate.unconsumed_tail
            if not packed:
                self._file.seek(self._at)
                packed = self._file.read(min(_BLOCK, self._end - self._at))
                self._at += len(packed)
            if not packed:
                break
            got = self._inflate.decompress(packed, len(room))
        room[: len(got)] = got
        return len(got)


def is_matlab_hdf5(path: Path) -> bool:
    """Tell whether a file is one of version 7.3, which is HDF5 behind a header of MATLAB's."""
    with open_regular(path) as file:
        return file.read(len(_HDF5_HEADER)) == _HDF5_HEADER


def arrays_of_mat(file: BinaryIO, path: Path) -> dict[str, Member | str]:
    """List the arrays of a file."""
    end = file.seek(0, io.SEEK_END)
    file.seek(0)
    order = _ORDERS.get(file.read(_HEADER_BYTES)[-2:])
    if order is None:
        raise DataError(f"{path}: begins like a MATLAB file but is damaged; save it again")
    found: dict[str, Member | str] = {}
    place = _HEADER_BYTES
    while place < end and len(found) < _MOST_ARRAYS:
        file.seek(place)
        kind, size = struct.unpack(f"{order}II", file.read(8))
        start, place = place + 8, place + 8 + size
        if place > end:
            raise DataError(
                f"{path}: is truncated (an array should reach byte {place} of {end}); copy it "
                "again or save it again"
            )
        if kind == _COMPRESSED:
            unpacked: Any = io.BufferedReader(_Inflating(file, start, size))
            name, held = _variable(unpacked, order, 8)
        elif kind == _MATRIX:
            name, held = _variable(file, order, 0)
        else:
            raise DataError(f"{path}: is damaged (it has an element of kind {kind}); save it again")
        if isinstance(held, str):
            found[name] = held
            continue
        shape, stored, nbytes, skipped = held
        if kind == _MATRIX:
            found[name] = Member(shape, stored, COLUMNS_TOGETHER, nbytes, start + skipped)
        else:
            unpack = partial(_unpack, file, start, size, skipped)
            found[name] = Member(shape, stored, COLUMNS_TOGETHER, size, unpack=unpack)
    return found


def _unpack(file: BinaryIO, start: int, size: int, skipped: int) -> Any:
    packed = io.BufferedReader(_Inflating(file, start, size))
    packed.read(skipped)
    return packed


def _variable(
    stream: BinaryIO, order: str, skipped: int
) -> tuple[str, str | tuple[tuple[int, int, int], np.dtype[Any], int, int]]:
    """Read what comes before the numbers of an array, `skipped` bytes left out.

    Returns its name, and what it holds in words or the shape (t, y, x), type, length and place of
    its numbers.
    """
    stream.read(skipped)
    (word, _), length = struct.unpack(f"{order}II", _element(stream, order)[0][:8]), 16
    lengths = [skipped, length]
    code, shape = word & 0xFF, []
    if code != _OPAQUE:
        raw, length = _element(stream, order)
        shape = np.frombuffer(raw, f"{order}i4").tolist()
        lengths.append(length)
    raw, length = _element(stream, order)
    name = raw.decode("utf-8", "replace")
    if code in _CLASSES or word & _COMPLEX:
        return name, f"is {_CLASSES.get(code, 'complex')}"
    frames = (shape[-1], *shape[:2])
    if len(shape) < 3 or set(shape[2:-1]) - {1} or not is_movie(frames):
        return name, f"has the shape {' x '.join(map(str, shape))}"
    kind, size = struct.unpack(f"{order}II", stream.read(8))
    if kind not in _TYPES:
        return name, f"holds numbers of kind {kind}"
    place = sum(lengths) + length + 8
    return name, (frames, np.dtype(f"{order}{_TYPES[kind]}"), size, place)


def _element(stream: BinaryIO, order: str) -> tuple[bytes, int]:
    """Read a short list or text, and how many bytes it takes."""
    head = stream.read(8)
    kind, size = struct.unpack(f"{order}II", head)
    if kind >> 16:  # up to four bytes lie in the head itself
        return head[4 : 4 + (kind >> 16)], 8
    if size > _LARGEST_HEADER:
        raise ValueError(f"a shape or a name of {size} bytes")
    padded = -(-size // 8) * 8
    raw = stream.read(padded)
    if len(raw) < padded:
        raise EOFError("it ends within the description of an array")
    return raw[:size], 8 + padded
