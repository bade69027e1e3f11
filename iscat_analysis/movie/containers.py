"""Files that hold several arrays under names, of which one is a movie: NumPy's and MATLAB's.

Arrays in ``.npz`` files: ZIP archives of arrays that NumPy saved.

An array of Python objects is never read, since that would run what the file says.

Arrays in MATLAB's ``.mat`` files of versions 5 to 7; version 7.3 is HDF5.

MATLAB's movies have the axes (y, x, t) and are stored column by column.  Arrays are found here and
mapped where they lie, or unpacked into a temporary file.  SciPy would hold them in memory whole,
and ends the process with a segmentation fault on some files in which a byte has changed.
Format: MATLAB, "MAT-File Format", level 5 (The MathWorks).
"""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.mapped import WHAT_LIBRARIES_RAISE, damaged, refuse_growth
from iscat_analysis.movie.plain import COLUMNS_TOGETHER, Axes, MappedFrames, as_frames, read_header
from iscat_analysis.movie.stack import ArrayFrames, Frames
from iscat_analysis.reading import open_regular
from iscat_analysis.records import StackMetadata
from iscat_analysis.scratch import Scratch
from iscat_analysis.units import listed

_OF_ARCHIVES = (zipfile.BadZipFile, zlib.error)


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
    what, remedy = f"{path}: begins like {kind} but is damaged", "copy it again or save it again"
    with open_regular(path) as file, damaged(what, *_OF_ARCHIVES, remedy=remedy):
        members = read(file, path)
        if not members:
            raise DataError(f"{path}: is {kind} that holds no array; export the movie as TIFF")
        name, member = _chosen(path, part, members)
        alone = part or len(members) == 1
        notes = () if alone else (f"its frames are those of the array {name}",)
        return _frames(member, f"{path}{MARK}{name}", path, notes)


def holds_one(path: Path, *, read: ReadMembers) -> bool:
    """Tell whether a file holds exactly one movie; a damaged one is left to whoever opens it."""
    try:
        with open_regular(path) as file:
            return sum(isinstance(held, Member) for held in read(file, path).values()) == 1
    except (DataError, *_OF_ARCHIVES, *WHAT_LIBRARIES_RAISE):
        return True


def is_movie(shape: Sequence[int]) -> bool:
    """Tell whether an array has the axes (t, y, x), several of each."""
    return len(shape) == 3 and min(shape) > 1


def name_one(path: Path, names: Sequence[str], what: str) -> DataError:
    """Ask for a name where a file holds several movies."""
    return DataError(
        f"{path}: holds {len(names)} {what} of frames ({listed(names, 5)}); name one, as in "
        f'"{path}{MARK}{names[0]}"'
    )


def _chosen(path: Path, part: str, members: Mapping[str, Member | str]) -> tuple[str, Member]:
    movies = {name: held for name, held in members.items() if isinstance(held, Member)}
    if not part and len(movies) > 1:
        raise name_one(path, list(movies), "arrays")
    wanted = part.strip("/") if part else next(iter(movies), "")
    if wanted in movies:
        return wanted, movies[wanted]
    held = f"{wanted} {members.get(wanted, 'is not there')}"
    if not part:
        held = "; ".join(f"{name} {text}" for name, text in list(members.items())[:5])
    raise DataError(
        f"{path}{MARK + part if part else ''}: {held}; frames, several of each axis, are in: "
        f"{listed(movies, 5) or 'none'}"
    )


def _frames(member: Member, name: str, path: Path, notes: tuple[str, ...]) -> Frames:
    shape, stored, axes = member.shape, member.stored, member.axes
    filled = member.size
    if member.unpack is not None:
        refuse_growth(member.nbytes, member.size, f"{name}: it")
        room, filled = Scratch((member.nbytes,), np.dtype(np.uint8)).array, 0
        with member.unpack() as packed:
            while filled < room.size and (count := packed.readinto(room.data[filled:])):
                filled += count
    if filled < member.nbytes:
        raise DataError(
            f"{name}: is truncated ({filled} of {member.nbytes} bytes are there); copy the file "
            "again or save it again"
        )
    if member.unpack is None:
        return MappedFrames(path, shape, stored, offset=member.place, axes=axes, notes=notes)
    return ArrayFrames(as_frames(room, shape, stored, axes), name, StackMetadata(), notes)


_SUFFIX = ".npy"
_LOCAL_HEADER = struct.Struct("<26xHH")  # lengths of the name, and of what is added to it
_MOST_ARRAYS = 1000  # that are looked at


def arrays_of_npz(file: BinaryIO, path: Path) -> dict[str, Member | str]:
    """List the arrays of an archive."""
    archive = zipfile.ZipFile(file)
    listed = archive.infolist()
    infos = [info for info in listed if info.filename.endswith(_SUFFIX)][:_MOST_ARRAYS]
    if listed and not infos:
        raise DataError(f"{path}: is a ZIP archive without arrays of NumPy; unpack it")
    return {info.filename.removesuffix(_SUFFIX): _held(archive, info, file, path) for info in infos}


def _held(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, file: BinaryIO, path: Path
) -> Member | str:
    if info.flag_bits & 1:
        return "is encrypted"
    with archive.open(info) as packed:
        header = read_header(io.BytesIO(packed.read(2**16)), path)  # no header is longer
    if header.stored.hasobject:
        return "holds Python objects, which are not read"
    if header.stored.kind not in "uif" or not is_movie(header.shape):
        return f"holds {header.stored} of shape {header.shape}"
    if info.compress_type == zipfile.ZIP_STORED:
        file.seek(info.header_offset)
        lengths = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        place = info.header_offset + _LOCAL_HEADER.size + sum(lengths) + header.offset
        return Member(*header[:3], info.file_size - header.offset, place)
    unpack = partial(_unpack_npy, archive, info, header.offset)
    return Member(*header[:3], info.compress_size, unpack=unpack)


def _unpack_npy(archive: zipfile.ZipFile, info: zipfile.ZipInfo, start: int) -> IO[bytes]:
    packed = archive.open(info)
    packed.read(start)
    return packed


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
                packed = self._file.read(min(2**16, self._end - self._at))
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
    if code != 17:  # an object, which has no shape
        raw, length = _element(stream, order)
        shape = np.frombuffer(raw, f"{order}i4").tolist()
        lengths.append(length)
    raw, length = _element(stream, order)
    name = raw.decode("utf-8", "replace")
    if code in _CLASSES or word & 0x800:
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
    if size > 4096:
        raise ValueError(f"a shape or a name of {size} bytes")
    padded = -(-size // 8) * 8
    raw = stream.read(padded)
    if len(raw) < padded:
        raise EOFError("it ends within the description of an array")
    return raw[:size], 8 + padded
