"""Movies in files of arrays: NumPy's, MATLAB's, and plain numbers that something describes.

Plain numbers whose bytes or axes lie in another order than was said are told by their smoothness.
Read in the right order, a pixel changes by its noise from frame to frame, and neighbours have
similar light.  With its bytes the other way round it changes by a third of the range of its type;
where rows are taken for columns, neighbours are pixels from all over the frame.

PyLabLib cam-control writes ``movie.bin`` with ``movie_settings.dat``, or ``frames.bin`` with
``settings.dat``; a long movie in parts, ``movie_0000.bin``, ``movie_0001.bin``…  The keys are
``save/frame/shape``, ``save/frame/dtype``, ``save/saved`` and ``save/append``
(https://pylablib-cam-control.readthedocs.io, "File formats").  PiSCAT's movies are named by their
shape and type, as ``control_4999_128_128_uint16_2.33FPS.raw`` (https://piscat.readthedocs.io).

``.npz`` and ``.mat`` files hold several arrays under names, of which one is a movie.  An array of
Python objects is never read, since that would run what the file says.  MATLAB's movies, of versions
5 to 7, have the axes (y, x, t) and are stored column by column; version 7.3 is HDF5.  Their arrays
are found here and mapped where they lie, or unpacked into a temporary file.  SciPy would hold them
in memory whole, and ends the process with a segmentation fault on some files in which a byte has
changed.  Format: MATLAB, "MAT-File Format", level 5 (The MathWorks).
"""

from __future__ import annotations

import glob
import io
import math
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK, Layout, layout
from iscat_analysis.movie.mapped import (
    WHAT_LIBRARIES_RAISE,
    Scratch,
    damaged,
    frames_in_place,
    map_file,
    refuse_changed,
    refuse_growth,
    release,
    unmap,
)
from iscat_analysis.movie.stack import ArrayFrames, FileSet, Frames, shape_of_frames, single_frame
from iscat_analysis.reading import is_file, open_regular, read_text
from iscat_analysis.records import InPlace, StackMetadata
from iscat_analysis.units import listed

_LEAST_PIXELS = 1024  # of a frame that tell an order


def bytes_are_swapped(counts: NDArray[Any]) -> bool:
    """Tell whether numbers are far smoother in time with their bytes the other way round.

    The noisiest real movies are three times as smooth.

    Shapes: `counts` (t, y, x), in pairs of successive frames.
    """
    if counts.dtype.itemsize < 2 or counts.size < _LEAST_PIXELS:
        return False
    given, swapped = (_change(numbers) for numbers in (counts, counts.byteswap()))
    return given > 8 * swapped


def _change(counts: NDArray[Any]) -> float:
    """Mean change of a pixel within pairs of frames, in steps; of the logarithm of a float."""
    if counts.dtype.kind == "f":
        limits = np.finfo(counts.dtype)
        size = np.abs(np.nan_to_num(counts, nan=limits.max, posinf=limits.max, neginf=limits.max))
        values, step = np.log2(np.maximum(size, limits.smallest_subnormal).astype(np.float64)), 1
    else:  # few bits may stand in the upper bytes, all counts being multiples of a step
        bits = int(np.bitwise_or.reduce(counts, axis=None))
        values, step = counts.astype(np.float64), max(bits & -bits, 1)
    pairs = values[: len(values) // 2 * 2].reshape(-1, 2, *values.shape[1:])
    return float(np.abs(pairs[:, 1] - pairs[:, 0]).mean()) / step


def lines_are_exchanged(counts: NDArray[Any]) -> bool:
    """Tell whether frames are far smoother if they have as many lines as a line has pixels.

    A square frame is only turned over its diagonal by that, which nothing tells.

    Shapes: `counts` (t, y, x), or (t, x, y) where columns are stored one after the other.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of floats that are none
        mean = counts.mean(axis=0, dtype=np.float64)
    if mean.size < _LEAST_PIXELS or not np.isfinite(mean).all():
        return False
    given, other = (
        float(np.mean(np.diff(lines, axis=0) ** 2)) for lines in (mean, mean.reshape(mean.T.shape))
    )
    return given > 2 * other


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
        notes: tuple[str, ...] = (),
    ) -> None:
        self.shape = shape_of_frames(shape, stored, path)
        self._path, self._data = path, map_file(path)
        needed = offset + math.prod(shape) * stored.itemsize
        if needed > len(self._data):
            held = len(self._data)
            self._data.close()
            raise DataError(
                f"{path}: is truncated ({shape[0]} frames of {shape[1]} x {shape[2]} {stored} need "
                f"{needed} bytes, it has {held}); copy it again or export it again"
            )
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
    what = f"{path}: begins like a NumPy array but is damaged"
    with damaged(what, remedy="save it again"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of headers that Python 2 wrote, which are read
        version = npy.read_magic(file)
        shape, last_first, stored = _HEADERS[version](file)
        offset = file.tell()
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
    stored = _type_named(
        found.type_name,
        f"{path}{MARK}{part}: {found.type_name} is no type of numbers; write uint8, uint16, "
        f"float32 or, for the larger byte first, >u2, as in {example}",
    )
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
    shape = number, found.rows, found.columns
    axes = COLUMNS_TOGETHER if found.by_columns else ROWS_TOGETHER
    frames = MappedFrames(path, shape, stored, offset=found.header_bytes, axes=axes)
    refuse_disorder(frames, found._replace(frames=number), path)
    return frames


def _type_named(name: str, refusal: str) -> np.dtype[Any]:
    try:
        return np.dtype(name)
    except (TypeError, ValueError, SyntaxError):
        raise DataError(refusal) from None


def refuse_disorder(frames: MappedFrames, said: Layout, path: Path) -> None:
    """Refuse numbers that are far smoother in another order than was said, and close them."""
    starts = np.unique(np.linspace(0, frames.shape[0] - 2, 4, dtype=int)).tolist()
    counts = np.concatenate([frames.read(start, start + 2) for start in starts])
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


SUFFIXES = (".bin", ".raw")
"""Of files that are looked at in this way."""

_Recorded = tuple[int, int, np.dtype[Any], dict[Path, int]]
"""Rows, columns and type of frames, and how many of them each file holds."""

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
    stems = dict.fromkeys((path.stem, _PART.sub("", path.stem)))
    found = (each for stem in stems for each in _settings(stem, path) if is_file(each))
    return next(found, path if _named(path) is not None else None)


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
    files = recorded_files(path)
    named = _named(path) if len(files) == 1 else None
    rows, columns, stored, counts = named or _counted(files[:-1], files[-1])
    if sum(counts.values()) < 2:
        raise single_frame(path)
    members = []
    with ExitStack() as opened:
        for each, count in counts.items():
            if count:
                shape = (count, rows, columns)
                members.append(MappedFrames(each, shape, stored, offset=0))
                opened.callback(members[-1].close)
        if named is not None:
            refuse_disorder(members[0], Layout(counts[path], rows, columns, stored.str), path)
        opened.pop_all()
    where = [(m, image) for m, member in enumerate(members) for image in range(member.shape[0])]
    return FileSet(members, files, np.array(where, dtype=np.int64), StackMetadata())


def _counted(files: tuple[Path, ...], settings: Path) -> _Recorded:
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
    stored = _type_named(name, f"{settings}: save/frame/dtype = {name} is no type of numbers")
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


def _named(path: Path) -> _Recorded | None:
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
    return (rows, columns, stored, {path: frames}) if fits else None


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
    unpack = partial(_passed_over, partial(archive.open, info), header.offset)
    return Member(*header[:3], info.compress_size, unpack=unpack)


def _passed_over(unpack: Callable[[], IO[bytes]], count: int) -> IO[bytes]:
    """Open bytes, and leave out the first of them."""
    unpacked = unpack()
    unpacked.read(count)
    return unpacked


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
            inflated: Any = partial(_inflated, file, start, size)
            name, held = _variable(inflated(), order, 8)
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
            unpack = partial(_passed_over, inflated, skipped)
            found[name] = Member(shape, stored, COLUMNS_TOGETHER, size, unpack=unpack)
    return found


def _inflated(file: BinaryIO, start: int, size: int) -> Any:
    return io.BufferedReader(_Inflating(file, start, size))


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
