"""HDF5 files whose structure is checked before any of it is believed.

libhdf5 is asked where the bytes of a dataset lie, never for the bytes: it inflates chunks without
a limit, follows links into other files, and needs a plugin for the filters that instruments use.
Here every chunk is decoded into the size it declares, which the file's own size bounds.
Format: HDF5 File Format Specification 3.0 (The HDF Group).
"""

from __future__ import annotations

import math
import mmap
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.mapped import map_file, refuse_changed

IntArray = NDArray[np.int64]

SIGNATURE = b"\x89HDF\r\n\x1a\n"

_LARGEST_CHUNK_BYTES = 2**28
_LARGEST_TEXT_BYTES = 4096
_BOMB_RATIO = 2000  # decoded over stored; Deflate reaches 1032, on constant images only
_BOMB_BYTES = 64_000_000  # an array smaller than this is harmless whatever its ratio
_CACHE_BYTES = 64_000_000
_WHAT_IT_RAISES = (
    OSError, RuntimeError, ValueError, TypeError, KeyError, AttributeError, OverflowError,
    MemoryError, SystemError, struct.error,
)  # fmt: skip

_HEAP = struct.Struct("<4s4xQ")  # signature, version, size of the whole
_HEAP_OBJECT = struct.Struct("<H6xQ")  # index, then references and reserved bytes, size

_Decoder = Callable[[bytes, int, int], bytes]


def _inflate(raw: bytes, size: int, itemsize: int) -> bytes:
    del itemsize
    stream = zlib.decompressobj()
    found = stream.decompress(raw, size + 1)
    if len(found) == size and not stream.eof:
        raise ValueError("its checksum is missing")
    return found


def _unshuffle(raw: bytes, size: int, itemsize: int) -> bytes:
    del size
    planes = np.frombuffer(raw, np.uint8).reshape(itemsize, -1)
    return planes.T.tobytes()


def _imagecodecs(name: str) -> _Decoder:
    def decode(raw: bytes, size: int, itemsize: int) -> bytes:
        del itemsize
        return bytes(getattr(imagecodecs, f"{name}_decode")(raw, out=size))

    return decode


_DECODERS: Mapping[int, _Decoder] = {
    1: _inflate,
    2: _unshuffle,
    32000: _imagecodecs("lzf"),
    32001: _imagecodecs("blosc"),
    32004: _imagecodecs("lz4h5"),
    32015: _imagecodecs("zstd"),
}
"""What undoes each filter, by its registered number: Deflate, shuffle, LZF, Blosc, LZ4, Zstandard.
Each is given the stored bytes, the size they must have afterwards, and the size of one number."""


class StoredArray:
    """A dataset whose bytes were all found in the file; `Hdf5Reader.array` makes it.

    Parameters
    ----------
    data : mmap
        The whole file.
    path : Path
        What messages call it.
    name : str
        Of the dataset.
    shape : tuple of int
        At least one axis.
    stored : dtype
        As in the file, byte order included.
    chunk : tuple of int
        Shape of one chunk; the whole shape where the bytes lie in one piece.
    starts, sizes, masks : ndarray of int64, shape (chunk,)
        Where each chunk lies, how long it is, and which filters it left out.
    filters : tuple of int
        As they were applied; empty for plain bytes.
    """

    def __init__(
        self,
        data: mmap.mmap,
        path: Path,
        name: str,
        *,
        shape: tuple[int, ...],
        stored: np.dtype[Any],
        chunk: tuple[int, ...],
        starts: IntArray,
        sizes: IntArray,
        masks: IntArray,
        filters: tuple[int, ...],
    ) -> None:
        self._data = data
        self._path = path
        self._name = name
        self.shape = shape
        self._stored = stored
        self.dtype = stored.newbyteorder("=")
        self._chunk = chunk
        self._grid = tuple(-(-n // c) for n, c in zip(shape, chunk, strict=True))
        self._starts = starts
        self._sizes = sizes
        self._masks = masks
        self._filters = filters
        self._cached: tuple[int, NDArray[Any]] | None = None

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read rows of the first axis.

        Parameters
        ----------
        start, stop : int
            Half-open range inside the array.

        Returns
        -------
        ndarray, shape (stop − start, …)
            A new array in native byte order.

        Raises
        ------
        DataError
            The file has changed since it was opened, or a chunk cannot be decoded.
        """
        refuse_changed(self._path, self._data)
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        depth = self._chunk[0]
        rest = math.prod(self.shape[1:]) * self.dtype.itemsize
        if len(self._starts) == 1 and not self._filters:
            offset = int(self._starts[0]) + start * rest
            block[:] = np.ndarray(block.shape, self._stored, buffer=self._data, offset=offset)
        elif depth == 1 or depth * rest > _CACHE_BYTES:
            self._fill(block, start)
        else:
            for slab in range(start // depth, -(-stop // depth)):
                first, rows = slab * depth, self._slab(slab)
                begin, end = max(start, first), min(stop, first + len(rows))
                block[begin - start : end - start] = rows[begin - first : end - first]
        return block

    def _slab(self, number: int) -> NDArray[Any]:
        """All chunks that share their place on the first axis; the last ones are remembered."""
        cached = self._cached
        if cached is not None and cached[0] == number:
            return cached[1]
        first = number * self._chunk[0]
        rows = min(self._chunk[0], self.shape[0] - first)
        slab = np.empty((rows, *self.shape[1:]), dtype=self.dtype)
        self._fill(slab, first)
        self._cached = (number, slab)
        return slab

    def _fill(self, block: NDArray[Any], start: int) -> None:
        depth = self._chunk[0]
        stop = start + len(block)
        first = start // depth
        for place in np.ndindex(-(-stop // depth) - first, *self._grid[1:]):
            index = (place[0] + first, *place[1:])
            pixels = self._decoded(int(np.ravel_multi_index(index, self._grid)))
            source, target = [], []
            for axis, number in enumerate(index):
                low = number * self._chunk[axis]
                begin, end = (start, stop) if axis == 0 else (0, self.shape[axis])
                begin, end = max(begin, low), min(end, low + self._chunk[axis])
                shift = start if axis == 0 else 0
                source.append(slice(begin - low, end - low))
                target.append(slice(begin - shift, end - shift))
            block[tuple(target)] = pixels[tuple(source)]

    def _decoded(self, number: int) -> NDArray[Any]:
        start, size = int(self._starts[number]), int(self._sizes[number])
        mask = int(self._masks[number])
        expected = math.prod(self._chunk) * self._stored.itemsize
        raw = self._data[start : start + size]
        try:
            for position in reversed(range(len(self._filters))):
                if not mask >> position & 1:
                    decode = _DECODERS[self._filters[position]]
                    raw = decode(raw, expected, self._stored.itemsize)
        except (ValueError, TypeError, RuntimeError, MemoryError, zlib.error) as error:
            raise self._undecodable(number, str(error) or type(error).__name__) from None
        if len(raw) != expected:
            how = "more than" if len(raw) > expected else f"{len(raw)} of"
            raise self._undecodable(number, f"it holds {how} {expected} bytes")
        return np.frombuffer(raw, self._stored).reshape(self._chunk)

    def _undecodable(self, number: int, how: str) -> DataError:
        return DataError(
            f"{self._path}: chunk {number} of {self._name} cannot be decompressed ({how}); "
            "copy the file again or export it again"
        )


class Hdf5Reader:
    """Looks up datasets of one file; arrays found remain readable after it is closed.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    DataError
        It is not an HDF5 file, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = h5py.File(path, "r", locking=False)
        except _WHAT_IT_RAISES as error:
            raise DataError(
                f"{path}: begins like an HDF5 file but cannot be opened as one ({_said(error)}); "
                "copy it again or export it again"
            ) from None
        try:
            with self._believing_nothing():
                if self._file.userblock_size:
                    raise DataError(f"{path}: does not begin as HDF5 does; export it again")
                self.data = map_file(path)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._believing_nothing():
            self._file.close()

    def names(self, group: str) -> list[str]:
        """List what a group holds; nothing where there is no such group."""
        with self._believing_nothing():
            found = self._find(group)
            return sorted(found) if isinstance(found, h5py.Group) else []

    def array(self, name: str) -> StoredArray | None:
        """Find a dataset of numbers and all of its bytes.

        Parameters
        ----------
        name : str
            Path inside the file.

        Returns
        -------
        StoredArray or None
            None where there is none of that name.

        Raises
        ------
        DataError
            It is a link, lies in other files, is incomplete, or cannot be decoded.
        """
        with self._believing_nothing():
            dataset = self._dataset(name)
            return None if dataset is None else self._stored(dataset, name)

    def number(self, name: str) -> float | None:
        """Read a dataset of one number; None where there is none, or it is something else."""
        with self._believing_nothing():
            dataset = self._dataset(name)
            if dataset is None or dataset.dtype.kind not in "iuf" or not _single(dataset):
                return None
            return float(np.asarray(dataset[()]).reshape(()))

    def text(self, name: str) -> str | None:
        """Read a dataset of one text; None where there is none, or it is something else."""
        with self._believing_nothing():
            dataset = self._dataset(name)
            start = None if dataset is None else dataset.id.get_offset()
            if dataset is None or start is None or not _single(dataset):
                return None
            kind = h5py.check_string_dtype(dataset.dtype)
            if kind is None:
                return None
            if kind.length is None:
                return _heap_text(self.data, start)
            return _decoded_text(self.data[start : start + min(kind.length, _LARGEST_TEXT_BYTES)])

    def has_attribute(self, name: str, key: str) -> bool:
        """Whether something of this name is attached to a dataset.

        What it says is not read: the texts that h5py writes lie in a heap, in which libhdf5 runs
        in circles where a damaged file tells it to.
        """
        with self._believing_nothing():
            dataset = self._dataset(name)
            return dataset is not None and key in dataset.attrs

    def numbers(self, name: str, key: str) -> list[int] | None:
        """Read a list of integers attached to a dataset; None where there is no such thing."""
        with self._believing_nothing():
            dataset = self._dataset(name)
            if dataset is None or key not in dataset.attrs:
                return None
            attribute = dataset.attrs.get_id(key)
            if attribute.dtype.kind not in "iu" or len(attribute.shape) != 1:
                return None
            return [int(value) for value in dataset.attrs[key]]

    @contextmanager
    def _believing_nothing(self) -> Iterator[None]:
        try:
            yield
        except _WHAT_IT_RAISES as error:
            raise DataError(
                f"{self._path}: is damaged ({_said(error)}); copy it again or export it again"
            ) from None

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

    def _dataset(self, name: str) -> h5py.Dataset | None:
        found = self._find(name)
        return found if isinstance(found, h5py.Dataset) else None

    def _stored(self, dataset: h5py.Dataset, name: str) -> StoredArray:
        dtype = dataset.dtype
        if dataset.is_virtual or dataset.external:
            raise DataError(
                f"{self._path}: the data of {name} lie in other files; "
                "export the file with its data inside"
            )
        plain = dtype.kind in "iuf" and dataset.id.get_type().equal(h5py.h5t.py_create(dtype))
        if not plain or not dataset.shape:
            raise DataError(
                f"{self._path}: {name} holds {dtype}, shape {dataset.shape}, "
                "not an array of integers or floats; export it again"
            )
        shape = tuple(int(n) for n in dataset.shape)
        total = math.prod(shape) * dtype.itemsize
        if total == 0:
            return self._array(name, shape, dtype, shape, np.zeros((0, 3), np.int64), ())
        if total > max(_BOMB_BYTES, _BOMB_RATIO * len(self.data)):
            raise DataError(
                f"{self._path}: {name} would grow from a file of {len(self.data)} to {total} "
                "bytes, which no recording does; the file is damaged, export it again"
            )
        if dataset.chunks is None:
            start = dataset.id.get_offset()
            if start is None or dataset.external:
                raise self._incomplete(name, "no data were written")
            where = np.array([[start, total, 0]], np.int64)
            if start + total > len(self.data):
                raise self._incomplete(name, f"it should reach byte {start + total}")
            return self._array(name, shape, dtype, shape, where, ())
        return self._chunked(dataset, name, shape)

    def _chunked(self, dataset: h5py.Dataset, name: str, shape: tuple[int, ...]) -> StoredArray:
        chunk = tuple(int(n) for n in dataset.chunks)
        settings = dataset.id.get_create_plist()
        filters = tuple(settings.get_filter(k)[0] for k in range(settings.get_nfilters()))
        unknown = [number for number in filters if number not in _DECODERS]
        if unknown:
            raise DataError(
                f"{self._path}: {name} is compressed by HDF5 filter {unknown[0]}, which is not "
                "supported; save it uncompressed, or with Deflate or Zstandard"
            )
        if math.prod(chunk) * dataset.dtype.itemsize > _LARGEST_CHUNK_BYTES:
            raise DataError(
                f"{self._path}: {name} is stored in chunks of {chunk}, too large to be decoded "
                "one at a time; save it with smaller chunks"
            )
        grid = tuple(-(-n // c) for n, c in zip(shape, chunk, strict=True))
        expected = math.prod(grid)
        if expected > len(self.data):  # a chunk is a byte at least
            raise self._incomplete(name, f"it needs {expected} chunks")
        where = np.zeros((expected, 3), np.int64)
        count = 0

        def note(info: Any) -> bool | None:
            nonlocal count
            count += 1
            place = [o // c for o, c in zip(info.chunk_offset, chunk, strict=True)]
            if count > expected or any(p >= g for p, g in zip(place, grid, strict=True)):
                return True
            number = int(np.ravel_multi_index(place, grid))
            where[number] = info.byte_offset or 0, info.size, info.filter_mask
            return None

        dataset.id.chunk_iter(note)
        if count != expected or (where[:, :2] <= 0).any():
            raise self._incomplete(name, f"it lists {count} chunks where it needs {expected}")
        if (where[:, 0] > len(self.data) - where[:, 1]).any():
            raise self._incomplete(name, "a chunk reaches beyond the end of the file")
        return self._array(name, shape, dataset.dtype, chunk, where, filters)

    def _array(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: np.dtype[Any],
        chunk: tuple[int, ...],
        where: IntArray,
        filters: tuple[int, ...],
    ) -> StoredArray:
        return StoredArray(
            self.data,
            self._path,
            name,
            shape=shape,
            stored=dtype,
            chunk=tuple(max(1, n) for n in chunk),
            starts=where[:, 0],
            sizes=where[:, 1],
            masks=where[:, 2],
            filters=filters,
        )

    def _incomplete(self, name: str, how: str) -> DataError:
        return DataError(
            f"{self._path}: {name} is incomplete ({how}); "
            "the recording or the copy was interrupted: export it again"
        )


def _said(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _single(dataset: h5py.Dataset) -> bool:
    """Whether a dataset is one value, in the file itself and not compressed."""
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
