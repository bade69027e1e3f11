"""HDF5 files whose structure is checked before any of it is believed.

h5py is asked where the bytes of a dataset lie, never for the bytes: libhdf5 inflates chunks without
a limit, follows links into other files, runs in circles in the heap of a damaged file, and needs a
plugin for the filters that instruments use.  Here imagecodecs decodes every chunk into the size
that it declares, which the file's own size bounds.
Format: HDF5 File Format Specification 3.0 (The HDF Group).
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import h5py
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.mapped import (
    Writer,
    damaged,
    map_file,
    refuse_changed,
    refuse_growth,
    refuse_large_chunks,
    writer_of,
)
from iscat_analysis.movie.stack import Read, in_slabs

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
