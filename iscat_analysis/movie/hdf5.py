"""HDF5 files whose structure is checked before any of it is believed.

h5py is asked where the bytes of a dataset lie, never for the bytes: libhdf5 inflates chunks without
a limit, follows links into other files, runs in circles in the heap of a damaged file, and needs a
plugin for the filters that instruments use.  Here imagecodecs decodes every chunk into the size
that it declares, which the file's own size bounds.
Format: HDF5 File Format Specification 3.0 (The HDF Group).

Movies are any dataset of frames that is named or alone in a file, and Refeyn's ``.mp``, plain or as
differences from frame to frame.  Their layouts are read as other open software found them, since
they are not published.  OneMP: dataset
``frame`` with ``configuration/Devices/AcqCam``; TwoMP, format 3: ``movie/frame`` with
``movie/configuration/acq_camera``; between the two lies a format 3 with OneMP's names.
In a compressed movie frame 0 is plain and every later one is what must be added, modulo the range
of the type, to the one before; ``movie/keyframe`` repeats some frames in full: those that its
attribute ``indices`` names, or else the last one at its end.
"""

from __future__ import annotations

import math
import mmap
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import h5py
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.arrays import name_one
from iscat_analysis.movie.descriptions import Hints, merge, positive
from iscat_analysis.movie.mapped import (
    HARMLESS_BYTES,
    MOST_FRAME_DECODED_RATIO,
    Writer,
    damaged,
    map_file,
    refuse_changed,
    refuse_growth,
    refuse_large_chunks,
    writer_of,
)
from iscat_analysis.movie.stack import Frames, Read, in_slabs
from iscat_analysis.records import StackMetadata
from iscat_analysis.units import listed

_LARGEST_TEXT_BYTES = 4096
_HEAP = struct.Struct("<4s4xQ")  # signature, version, size of the whole
_HEAP_OBJECT = struct.Struct("<H6xQ")  # index, then references and reserved bytes, size

_SHUFFLE = 2
_CODECS: Mapping[int, Callable[..., Any]] = {
    1: imagecodecs.zlib_decode,
    32000: imagecodecs.lzf_decode,
    32001: imagecodecs.blosc_decode,
    32004: imagecodecs.lz4h5_decode,
    32015: imagecodecs.zstd_decode,
}
"""What undoes each filter, by its registered number."""


@dataclass(frozen=True, eq=False)
class StoredArray:
    """A dataset whose bytes were all found in the file; `Hdf5Reader.array` makes it.

    `where` has the place, the length and the filters left out of every chunk, shape (n, 3).
    """

    data: mmap.mmap
    path: Path
    name: str
    shape: tuple[int, ...]
    stored: np.dtype[Any]
    chunk: tuple[int, ...]
    where: NDArray[np.int64]
    filters: tuple[int, ...]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the numbers, in native byte order."""
        return self.stored.newbyteorder("=")

    @cached_property
    def _in_slabs(self) -> Read:
        depth = self.chunk[0] if self.filters else 1
        return in_slabs(self._decoded, self.shape, self.dtype, depth)

    @cached_property
    def _grid(self) -> tuple[int, ...]:
        """Chunks along each axis."""
        return tuple(-(-n // c) for n, c in zip(self.shape, self.chunk, strict=True))

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read rows of the first axis, ``[start, stop)``, as a new array in native byte order."""
        refuse_changed(self.path, self.data)
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        if len(self.where) == 1 and not self.filters:
            first = int(self.where[0, 0]) + start * math.prod(self.shape[1:]) * self.dtype.itemsize
            block[:] = np.ndarray(block.shape, self.stored, buffer=self.data, offset=first)
            return block
        return self._in_slabs(start, stop)

    def _decoded(self, start: int, stop: int) -> NDArray[Any]:
        """Decode the chunks of some rows, each once."""
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        depth = self.chunk[0]
        first_slab, last_slab = start // depth, -(-stop // depth)
        for place in np.ndindex(max(0, last_slab - first_slab), *self._grid[1:]):
            index = (place[0] + first_slab, *place[1:])
            pixels = self._decode(int(np.ravel_multi_index(index, self._grid)))
            source, target = [], []
            for axis, number in enumerate(index):
                origin, size = number * self.chunk[axis], self.chunk[axis]
                low, high = (start, stop) if axis == 0 else (0, self.shape[axis])
                begin, end = max(low, origin), min(high, origin + size)
                source.append(slice(begin - origin, end - origin))
                target.append(slice(begin - low, end - low))
            block[tuple(target)] = pixels[tuple(source)]
        return block

    def _decode(self, number: int) -> NDArray[Any]:
        start, length, left_out = self.where[number].tolist()
        raw = self.data[start : start + length]
        size = math.prod(self.chunk) * self.stored.itemsize
        what = f"{self.path}: chunk {number} of {self.name} cannot be decompressed"
        with damaged(what, remedy="copy the file again or export it again"):
            for position in reversed(range(len(self.filters))):
                if left_out >> position & 1:
                    continue
                if self.filters[position] == _SHUFFLE:
                    raw = np.frombuffer(raw, "u1").reshape(self.stored.itemsize, -1).T.tobytes()
                else:
                    raw = bytes(_CODECS[self.filters[position]](raw, out=size))
            return np.frombuffer(raw, self.stored).reshape(self.chunk)


class Hdf5Reader:
    """Looks up datasets of one file; arrays found remain readable after it is closed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._believing_nothing():
            self.writer = writer_of(path)
            if self.writer is Writer.ALONE:
                raise DataError(
                    f"{path}: a program has it open to write and lets nobody read meanwhile, or "
                    "ended without closing it: close it there, or record in SWMR mode; if that "
                    "program is gone, `h5clear -s` of the HDF5 tools releases the file"
                )
            swmr = self.writer is Writer.WITH_READERS
            self._file = h5py.File(path, "r", locking=False, swmr=swmr)
        try:
            with self._believing_nothing():
                self._block = self._file.userblock_size
                self.data = map_file(path)
        except BaseException:
            self._file.close()
            raise

    def close(self) -> None:
        """Close the file in h5py; the mapped bytes stay."""
        with self._believing_nothing():
            self._file.close()

    def names(self, group: str) -> list[str]:
        """List what a group holds; nothing where there is no such group."""
        with self._believing_nothing():
            found = self._find(group)
            return sorted(found) if isinstance(found, h5py.Group) else []

    def shape(self, name: str) -> tuple[int, ...] | None:
        """Give the shape of a dataset of numbers, written or not; None where there is none."""
        with self._dataset(name) as dataset:
            if dataset is None or dataset.dtype.kind not in "iuf" or _is_elsewhere(dataset):
                return None
            return tuple(dataset.shape)

    def array(self, name: str) -> StoredArray | None:
        """Find a dataset of numbers and all of its bytes; None where there is none."""
        with self._dataset(name) as dataset:
            if dataset is not None and dataset.dtype.names:
                raise self._no_numbers(dataset, name)
            return None if dataset is None else self._stored(dataset, name)

    def records(self, name: str) -> StoredArray | None:
        """Find a table of named numbers, one value each; None where there is no such thing."""
        with self._dataset(name) as dataset:
            if dataset is None or not dataset.dtype.names or len(dataset.shape or ()) != 1:
                return None
            return self._stored(dataset, name)

    def number(self, name: str) -> float | None:
        """Read a dataset of one number; None where there is none, or it is something else."""
        with self._dataset(name) as dataset:
            if dataset is None or dataset.dtype.kind not in "iuf" or not _single(dataset):
                return None
            return float(np.asarray(dataset[()]).reshape(()))

    def text(self, name: str) -> str | None:
        """Read a dataset of one text; None where there is none, or it is something else."""
        with self._dataset(name) as dataset:
            if dataset is None:
                return None
            start, kind = dataset.id.get_offset(), h5py.check_string_dtype(dataset.dtype)
            if start is None or kind is None or not _single(dataset):
                return None
            if kind.length is None:
                return _heap_text(self.data, start)
            return _decoded_text(self.data[start : start + min(kind.length, _LARGEST_TEXT_BYTES)])

    def has_attribute(self, name: str, key: str) -> bool:
        """Whether something of this name is attached to a dataset; it may be a text in the heap."""
        with self._dataset(name) as dataset:
            return dataset is not None and key in dataset.attrs

    def numbers(self, name: str, key: str) -> list[int] | None:
        """Read a list of integers attached to a dataset; None where there is no such thing."""
        with self._dataset(name) as dataset:
            if dataset is None or key not in dataset.attrs:
                return None
            attribute = dataset.attrs.get_id(key)
            is_list = attribute.dtype.kind in "iu" and len(attribute.shape) == 1
            return [int(value) for value in dataset.attrs[key]] if is_list else None

    def _believing_nothing(self) -> AbstractContextManager[None]:
        return damaged(f"{self._path}: begins like an HDF5 file but is damaged")

    def _find(self, name: str) -> h5py.Group | h5py.Dataset | None:
        """Walk a path link by link: a name that leads out of the file must never be followed."""
        found: h5py.Group | h5py.Dataset = self._file
        for part in name.split("/") if name else ():
            if not isinstance(found, h5py.Group):
                return None
            link = found.get(part, getlink=True)
            if link is None:
                return None
            if not isinstance(link, h5py.HardLink):
                raise DataError(
                    f"{self._path}: {name} is a link to another place, which is not followed; "
                    "export the file with its data inside"
                )
            found = found[part]
        return found

    @contextmanager
    def _dataset(self, name: str) -> Iterator[h5py.Dataset | None]:
        with self._believing_nothing():
            found = self._find(name)
            yield found if isinstance(found, h5py.Dataset) else None

    def _stored(self, dataset: h5py.Dataset, name: str) -> StoredArray:
        dtype, shape = dataset.dtype, tuple(int(n) for n in dataset.shape or ())
        if _is_elsewhere(dataset):
            raise DataError(
                f"{self._path}: the data of {name} lie in other files; "
                "export the file with its data inside"
            )
        fields = [dtype[field] for field in dtype.names or ()] or [dtype]
        plain = all(field.kind in "iuf" for field in fields)
        if not (plain and shape and dataset.id.get_type().equal(h5py.h5t.py_create(dtype))):
            raise self._no_numbers(dataset, name)
        total = math.prod(shape) * dtype.itemsize
        refuse_growth(total, len(self.data), f"{self._path}: {name}")
        filters: tuple[int, ...] = ()
        chunk = tuple(max(1, n) for n in shape)
        if total == 0:
            where = np.zeros((0, 3), np.int64)
        elif dataset.chunks is None:
            start = dataset.id.get_offset()
            if start is None:
                raise self._incomplete(name, "no data were written")
            where = np.array([[start, total, 0]], np.int64)
        else:
            chunk = tuple(int(n) for n in dataset.chunks)
            settings = dataset.id.get_create_plist()
            filters = tuple(settings.get_filter(k)[0] for k in range(settings.get_nfilters()))
            where = self._chunks(dataset, name, filters)
        if (where[:, 0] > len(self.data) - where[:, 1]).any():
            raise self._incomplete(name, "its data reach beyond the end of the file")
        return StoredArray(self.data, self._path, name, shape, dtype, chunk, where, filters)

    def _chunks(
        self, dataset: h5py.Dataset, name: str, filters: tuple[int, ...]
    ) -> NDArray[np.int64]:
        """Where every chunk lies, how long it is, and which filters it left out."""
        chunk = dataset.chunks
        unknown = [number for number in filters if number != _SHUFFLE and number not in _CODECS]
        if unknown:
            raise DataError(
                f"{self._path}: {name} is compressed by HDF5 filter {unknown[0]}, which is not "
                "supported; save it uncompressed, or with Deflate or Zstandard"
            )
        refuse_large_chunks(chunk, dataset.dtype, f"{self._path}: {name}")
        grid = tuple(-(-n // c) for n, c in zip(dataset.shape, chunk, strict=True))
        expected = math.prod(grid)
        if expected > len(self.data):  # a chunk is a byte at least
            raise self._incomplete(name, f"it needs {expected} chunks")
        where = np.zeros((expected, 3), np.int64)
        shift = self._block if self._block and _chunks_count_from_user_block() else 0
        count = 0

        def note(info: Any) -> bool | None:
            nonlocal count
            count += 1
            place = [o // c for o, c in zip(info.chunk_offset, chunk, strict=True)]
            if count > expected or any(p >= g for p, g in zip(place, grid, strict=True)):
                return True
            number = int(np.ravel_multi_index(place, grid))
            where[number] = (info.byte_offset or 0) + shift, info.size, info.filter_mask
            return None

        dataset.id.chunk_iter(note)
        if count != expected or (where[:, :2] <= 0).any():
            raise self._incomplete(name, f"it lists {count} chunks where it needs {expected}")
        return where

    def _no_numbers(self, dataset: h5py.Dataset, name: str) -> DataError:
        return DataError(
            f"{self._path}: {name} holds {dataset.dtype}, shape {dataset.shape}, "
            "not an array of integers or floats; export it again"
        )

    def _incomplete(self, name: str, how: str) -> DataError:
        return DataError(
            f"{self._path}: {name} is incomplete ({how}); "
            "the recording or the copy was interrupted: export it again"
        )


@lru_cache(maxsize=1)
def _chunks_count_from_user_block() -> bool:
    """Tell whether libhdf5 counts the places of chunks from the end of a user block.

    Until version 1.14 it does, and the others not; of contiguous data none of them does.
    """
    mark, block = b"a chunk of bytes", 512
    options = {"driver": "core", "backing_store": False, "userblock_size": block}
    with h5py.File("never written", "w", **options) as file:
        marked = np.frombuffer(mark, np.uint8)
        file.create_dataset("a", data=marked, chunks=marked.shape)
        file.flush()
        place = file["a"].id.get_chunk_info(0).byte_offset
        image = file.id.get_file_image()
    return bool(image.find(mark) == place)  # the image begins behind the block


def _is_elsewhere(dataset: h5py.Dataset) -> bool:
    """Whether the numbers of a dataset lie in other files."""
    return bool(dataset.is_virtual or dataset.external)


def _single(dataset: h5py.Dataset) -> bool:
    """Whether a dataset is one value, stored in the file and not compressed."""
    layout = dataset.id.get_create_plist().get_layout()
    inside = layout in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT) and not dataset.external
    return bool(inside and dataset.size == 1)


def _heap_text(data: mmap.mmap, start: int) -> str | None:
    """Read a text of variable length: here its length and place, there a heap that holds it.

    Specification, sections III.E (global heap) and IV.A.2.d (variable-length datatype), for files
    with offsets of eight bytes.
    """
    length, heap, number = struct.unpack_from("<IQI", data, start)
    if heap + _HEAP.size > len(data) or length > _LARGEST_TEXT_BYTES:
        return None
    signature, size = _HEAP.unpack_from(data, heap)
    position, end = heap + _HEAP.size, min(heap + size, len(data))
    while signature == b"GCOL" and position + _HEAP_OBJECT.size <= end:
        index, held = _HEAP_OBJECT.unpack_from(data, position)
        position += _HEAP_OBJECT.size
        if index == number:
            return _decoded_text(data[position : position + min(length, held)])
        if index == 0:  # the free space, which comes last
            return None
        position += -(-held // 8) * 8
    return None


def _decoded_text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace")


PIXEL_NM = {"Refeyn OneMP": 19.3, "Refeyn TwoMP": 11.8}
"""Side of an unbinned pixel by instrument [nm]; the files do not store it."""

ANCHOR_BYTES = HARMLESS_BYTES
"""Of decoded frames kept, from which later ones are reached."""


@dataclass(frozen=True)
class _Dialect:
    """Names of datasets in one generation of files."""

    frames: str
    keyframes: str
    rate: str
    exposure: str
    frame_binning: str
    pixel_binning: str
    names: tuple[str, ...]
    instrument: str | None


_ACQ = "configuration/Devices/AcqCam/"
_ENGINE = "configuration/Engines/AcqMovieEngine/"
_TWO_MP = "movie/configuration/acq_camera/"
_NAMES = ("movie/device_serials/InstrumentName", "movie/device_info/InstrumentName")
_DIALECTS = (
    _Dialect(
        "frame", "", f"{_ACQ}FrameRate", f"{_ACQ}ExposureTime", f"{_ENGINE}FrameBinning",
        f"{_ENGINE}PixelBinning", ("device_info/InstrumentName",), "Refeyn OneMP",
    ),
    _Dialect(
        "movie/frame", "movie/keyframe", f"{_TWO_MP}frame_rate", f"{_TWO_MP}exposure_time",
        f"{_TWO_MP}frame_binning", f"{_TWO_MP}pixel_binning", _NAMES, "Refeyn TwoMP",
    ),
    _Dialect(
        "movie/frame", "movie/keyframe", f"movie/{_ACQ}FrameRate", f"movie/{_ACQ}ExposureTime",
        f"movie/{_ACQ}SoftwareFrameBinning", f"movie/{_ACQ}SoftwarePixelBinning", _NAMES[::-1],
        None,
    ),
)  # fmt: skip


class DatasetFrames:
    """The frames of a dataset; of MATLAB, whose axes are (t, x, y), `by_columns`."""

    def __init__(
        self,
        stored: StoredArray,
        reader: Hdf5Reader,
        notes: tuple[str, ...] = (),
        *,
        by_columns: bool = False,
    ) -> None:
        self._stored, self._data, self._by_columns = stored, reader.data, by_columns
        y, x = stored.shape[:-3:-1] if by_columns else stored.shape[-2:]
        self.shape = (stored.shape[0], y, x)
        self.dtype = stored.dtype
        self.metadata, self.notes = StackMetadata(), notes

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        counts = self._stored.read(start, stop)
        counts = counts.reshape(len(counts), *counts.shape[-2:])
        return np.ascontiguousarray(counts.transpose(0, 2, 1) if self._by_columns else counts)

    def close(self) -> None:
        """Release the file."""
        self._data.close()


class DifferenceFrames(DatasetFrames):
    """A movie stored as differences, which are summed as it is read.

    Some decoded frames are kept, so that a read need not start at the first frame.  A movie that is
    read in order is summed once.
    """

    def __init__(
        self,
        stored: StoredArray,
        reader: Hdf5Reader,
        path: Path,
        *,
        known: tuple[int, NDArray[Any]] | None,
    ) -> None:
        super().__init__(stored, reader)
        self._path, self._known = path, known
        frame_bytes = self.shape[1] * self.shape[2] * stored.dtype.itemsize
        kept = max(1, min(self.shape[0], ANCHOR_BYTES // frame_bytes))
        self._spacing = -(-self.shape[0] // kept)
        self._step = max(1, HARMLESS_BYTES // frame_bytes)
        self._anchors: dict[int, NDArray[Any]] = {}
        self._newest: tuple[int, NDArray[Any]] | None = None
        self._lock = threading.Lock()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)``; a file that does not add up is refused."""
        refuse_changed(self._path, self._data)
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        if start == stop:
            return block
        with self._lock:
            known, frame = self._nearest(start)
            first = known + 1
            while first < stop:
                end = min(first + self._step, stop)
                if first < start:
                    end = min(end, start)
                part = self._stored.read(first, end)
                if frame is not None:
                    part[0] += frame
                np.cumsum(part, axis=0, dtype=part.dtype, out=part)
                self._remember(first, part)
                frame = part[-1]
                if first >= start:
                    block[first - start : end - start] = part
                first = end
        return block

    def _nearest(self, start: int) -> tuple[int, NDArray[Any] | None]:
        """Find the last remembered frame before `start`; −1 and None where there is none."""
        found = max((number for number in self._anchors if number < start), default=-1)
        if self._newest is not None and found < self._newest[0] < start:
            return self._newest
        return found, self._anchors.get(found)

    def _remember(self, first: int, part: NDArray[Any]) -> None:
        end = first + len(part)
        for number in range(-(-first // self._spacing) * self._spacing, end, self._spacing):
            self._anchors.setdefault(number, part[number - first].copy())
        self._newest = (end - 1, part[-1].copy())
        number, frame = self._known or (-1, part)
        if first <= number < end and not np.array_equal(part[number - first], frame):
            raise DataError(
                f"{self._path}: its frames do not add up to its last keyframe; "
                "copy the file again or export it again"
            )


def is_refeyn(reader: Hdf5Reader) -> bool:
    """Tell whether a file has frames where one of Refeyn's has them."""
    return any(reader.array(dialect.frames) is not None for dialect in _DIALECTS)


def _open_refeyn(reader: Hdf5Reader, path: Path) -> DatasetFrames:
    """Open a Refeyn ``.mp`` movie, or ``.mpr``, which holds one."""
    found = [dialect for dialect in _DIALECTS if reader.array(dialect.frames) is not None]
    dialect = next((d for d in found if reader.number(d.rate) is not None), found[0])
    stored = reader.array(dialect.frames)
    if stored is None or len(stored.shape) != 3 or 0 in stored.shape:
        shape = stored.shape if stored is not None else ()
        raise DataError(
            f"{path}: {dialect.frames} has the shape {shape}, not frames of rows and columns; "
            "export it again"
        )
    _, rows, columns = stored.shape
    frame_bytes = rows * columns * stored.dtype.itemsize
    if frame_bytes > max(HARMLESS_BYTES, MOST_FRAME_DECODED_RATIO * len(reader.data)):
        raise DataError(
            f"{path}: a frame of {rows} x {columns} pixels would be {frame_bytes} bytes, from a "
            f"file of {len(reader.data)}; the file is damaged, export it again"
        )
    frames = DatasetFrames(stored, reader)
    if stored.dtype.kind == "u" and dialect.keyframes:
        frames = _differences(reader, dialect, stored, path) or frames
    frames.metadata, frames.notes = _described(reader, dialect, path)
    return frames


def _differences(
    reader: Hdf5Reader, dialect: _Dialect, stored: StoredArray, path: Path
) -> DifferenceFrames | None:
    """Decide how the frames are encoded; None for plain ones.

    The last keyframe decides: it is among plain frames as it is, and differences must add up to
    it.  Without keyframes, an attribute ``encoding`` marks differences.
    """
    known = _last_keyframe(reader, dialect.keyframes, stored, path)
    if known is not None and np.array_equal(stored.read(known[0], known[0] + 1)[0], known[1]):
        return None
    if known is None and not reader.has_attribute(dialect.frames, "encoding"):
        return None
    frames = DifferenceFrames(stored, reader, path, known=known)
    if known is not None:
        frames.read(known[0], known[0] + 1)
    return frames


def _last_keyframe(
    reader: Hdf5Reader, name: str, stored: StoredArray, path: Path
) -> tuple[int, NDArray[Any]] | None:
    """Which frame the last keyframe repeats, and its pixels; None where that tells nothing."""
    keyframes = reader.array(name)
    if keyframes is None or not keyframes.shape[0]:
        return None
    if keyframes.shape[1:] != stored.shape[1:]:
        raise DataError(
            f"{path}: its keyframes have the shape {keyframes.shape[1:]} but its frames "
            f"{stored.shape[1:]}; export it again"
        )
    indices = reader.numbers(name, "indices")
    number = indices[-1] if indices else stored.shape[0] - 1
    if not 0 <= number < stored.shape[0]:
        raise DataError(
            f"{path}: its last keyframe should be frame {number} of {stored.shape[0]}; "
            "the recording or the copy was interrupted: export it again"
        )
    if number == 0:  # stored in full either way
        return None
    last = len(indices) - 1 if indices else keyframes.shape[0] - 1
    if last >= keyframes.shape[0]:
        raise DataError(f"{path}: lacks some of its keyframes; export it again")
    return number, keyframes.read(last, last + 1)[0]


def _described(
    reader: Hdf5Reader, dialect: _Dialect, path: Path
) -> tuple[StackMetadata, tuple[str, ...]]:
    """Read timing and binning, from which the size of a pixel follows."""
    named = (reader.text(name) for name in dialect.names)
    instrument = next((name for name in named if name), dialect.instrument)
    frame_binning = positive(reader.number(dialect.frame_binning)) or 1.0
    pixel_binning = positive(reader.number(dialect.pixel_binning))
    rate = positive(reader.number(dialect.rate), 1 / frame_binning)
    exposure = positive(reader.number(dialect.exposure), frame_binning)
    unbinned = PIXEL_NM.get(instrument or "")
    pixel = unbinned * pixel_binning if unbinned and pixel_binning else None
    known = merge([Hints(StackMetadata(pixel, exposure, rate, source="refeyn"))], path)
    if pixel is None:
        return known, ()
    note = (
        f"the file does not store its pixel size; that of every {instrument} is {unbinned:g} nm "
        f"times the pixel binning of {pixel_binning:g}: {pixel:g} nm"
    )
    return known, (note,)


def open_hdf5(path: Path, part: str, *, by_columns: bool = False) -> Frames:
    """Open a movie in an HDF5 file, with the axes (t, y, x) or, of MATLAB, (t, x, y)."""
    with closing(Hdf5Reader(path)) as reader:
        try:
            if not part and is_refeyn(reader):
                return _open_refeyn(reader, path)
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
                others = listed((f"/{name}" for name in _movies(reader)), 5) or "none"
                raise DataError(f"{path}{MARK}{part}: {held}; frames (t, y, x) are in: {others}")
            notes = [] if part else [f"its frames are those of the dataset /{names[0]}"]
            if reader.writer is not Writer.NONE:
                notes.append(
                    f"a program has it open to write, or ended without closing it: the "
                    f"{stored.shape[0]} frames are those that were written until now"
                )
            return DatasetFrames(stored, reader, notes=tuple(notes), by_columns=by_columns)
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
    """Give the names of datasets that may be movies, all of whose frames may not be there.

    Of many names a thousand are looked at, and groups that are eight deep.
    """
    waiting, seen = [""], 0
    while waiting and seen < 1000:
        group = waiting.pop(0)
        for name in reader.names(group):
            if name.startswith("#"):  # a group in which MATLAB keeps what cells refer to
                continue
            seen += 1
            whole = f"{group}/{name}" if group else name
            try:
                shape = reader.shape(whole)
            except DataError:  # links that lead elsewhere
                continue
            if shape is None:
                if whole.count("/") < 8:
                    waiting.append(whole)
            elif _is_movie(shape) and min(shape[-2:]) > 1:
                yield whole
