"""The image directories (IFDs) of a TIFF file: what each frame declares and where its bytes lie.

Directories are walked once, in one pass and without building a full tag table for each, because a
movie may hold 10⁵ of them and because truncation must be found here, before any pixel is read.
TIFF 6.0 (Adobe, 1992), sections 2, 8 and 15, and the BigTIFF extension.
"""

from __future__ import annotations

import mmap
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError

IntArray = NDArray[np.int64]

_NEW_SUBFILE_TYPE = 254
_IMAGE_WIDTH = 256
_IMAGE_LENGTH = 257
_BITS_PER_SAMPLE = 258
_COMPRESSION = 259
_FILL_ORDER = 266
_IMAGE_DESCRIPTION = 270
_STRIP_OFFSETS = 273
_SAMPLES_PER_PIXEL = 277
_ROWS_PER_STRIP = 278
_STRIP_BYTE_COUNTS = 279
_X_RESOLUTION = 282
_Y_RESOLUTION = 283
_RESOLUTION_UNIT = 296
_PREDICTOR = 317
_TILE_WIDTH = 322
_TILE_LENGTH = 323
_TILE_OFFSETS = 324
_TILE_BYTE_COUNTS = 325
_SAMPLE_FORMAT = 339
_IMAGE_DEPTH = 32997
_MICRO_MANAGER = 51123

_REDUCED_IMAGE = 1
_UNCOMPRESSED = 1
_INTEGER_TYPES = {1: "u1", 3: "u2", 4: "u4", 13: "u4", 16: "u8", 18: "u8"}
_SHORT_FORMATS = {3: "H", 4: "I"}
_TEXT_TYPES = (1, 2, 7)
_RATIONAL = 5
_MOST_TAGS = 4096  # BigTIFF allows 2⁶⁴; real directories hold tens

_KIND = {1: "u", 2: "i", 3: "f", 4: "u"}
_PACKED_BITS = (10, 12, 14)
_LARGEST_FRAME_BYTES = 2**31  # 32 768 × 32 768 pixels of 16 bits, beyond any camera
_OVERLAP = 2  # header bytes read over the size of the file; each lies in it once
_OVERLAP_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class Layout:
    """What the frames of one movie must have in common.

    Attributes
    ----------
    rows, columns : int
        Size of the image [px].
    bits, sample_format : int
        Of one sample.
    samples : int
        Per pixel; colour images have three or more.
    depth : int
        Planes in one directory.
    compression, predictor, fill_order : int
        As TIFF numbers them.
    segment_rows, segment_columns : int
        Size of a strip or tile [px].
    tiled : bool
        Whether segments are tiles.
    """

    rows: int
    columns: int
    bits: int
    sample_format: int
    samples: int
    depth: int
    compression: int
    predictor: int
    fill_order: int
    segment_rows: int
    segment_columns: int
    tiled: bool

    @property
    def dtype(self) -> np.dtype[Any] | None:
        """Type of the pixels in native byte order; None where it is not supported."""
        kind = _KIND.get(self.sample_format)
        if kind == "u" and self.bits in _PACKED_BITS:
            return np.dtype(np.uint16)
        smallest = 16 if kind == "f" else 8
        if kind is None or self.bits not in (8, 16, 32, 64) or self.bits < smallest:
            return None
        return np.dtype(f"{kind}{self.bits // 8}")

    @property
    def plain(self) -> bool:
        """Whether the stored bytes are the pixels, row after row."""
        return (
            self.compression == _UNCOMPRESSED
            and self.predictor == 1
            and self.fill_order == 1
            and self.bits not in _PACKED_BITS
            and not self.tiled
        )

    @property
    def frame_bytes(self) -> int:
        """Size of one decoded frame [bytes]."""
        dtype = self.dtype
        return self.rows * self.columns * (dtype.itemsize if dtype else 8) * self.samples

    @property
    def segments(self) -> int:
        """Strips or tiles in one frame."""
        return -(-self.rows // self.segment_rows) * -(-self.columns // self.segment_columns)

    def __str__(self) -> str:
        dtype = self.dtype or f"{self.bits}-bit"
        return f"{self.rows} x {self.columns} pixels of {dtype}"


@dataclass(frozen=True, slots=True)
class Directory:
    """One image of the file.

    Attributes
    ----------
    index : int
        Its place in the chain.
    layout : Layout
        Shape and encoding.
    offsets, byte_counts : ndarray of int64, shape (segment,)
        Where its strips or tiles lie.
    reduced : bool
        Whether it is declared a reduced copy of another image.
    descriptions : tuple of (int, int)
        Offset and length of each ImageDescription.
    micro_manager : (int, int) or None
        Offset and length of Micro-Manager's JSON.
    resolution : (float, float, int) or None
        Pixels per unit along x and y, and the unit; read from the first image only.
    """

    index: int
    layout: Layout
    offsets: IntArray
    byte_counts: IntArray
    reduced: bool
    descriptions: tuple[tuple[int, int], ...]
    micro_manager: tuple[int, int] | None
    resolution: tuple[float, float, int] | None

    @property
    def start(self) -> int | None:
        """First byte of the pixels where they lie in one piece as they are; else None."""
        layout = self.layout
        if not layout.plain:
            return None
        strip = layout.segment_rows * (layout.frame_bytes // layout.rows)
        contiguous = bool(np.all(np.diff(self.offsets) == strip))
        return int(self.offsets[0]) if contiguous else None


@dataclass(frozen=True, slots=True)
class _Dialect:
    """Byte order and field widths of one file."""

    order: Literal["<", ">"]
    big: bool

    @property
    def entry(self) -> struct.Struct:
        return struct.Struct(self.order + ("HHQ8s" if self.big else "HHI4s"))

    @property
    def count(self) -> struct.Struct:
        return struct.Struct(self.order + ("Q" if self.big else "H"))

    @property
    def pointer(self) -> struct.Struct:
        return struct.Struct(self.order + ("Q" if self.big else "I"))


class DirectoryReader:
    """Walks the directories of a memory-mapped file.

    Parameters
    ----------
    data : mmap
        The whole file.
    path : Path
        What messages call it.

    Raises
    ------
    DataError
        The header is damaged.
    """

    def __init__(self, data: mmap.mmap, path: Path) -> None:
        self._data = data
        self._path = path
        self._size = len(data)
        order: Literal["<", ">"] = "<" if data[:2] == b"II" else ">"
        if self._size < 8:
            raise self._cut_short("inside its header")
        big = struct.unpack_from(order + "H", data, 2)[0] == 43
        if big and self._size < 16:
            raise self._cut_short("inside its header")
        self._dialect = _Dialect(order, big)
        self._entry = self._dialect.entry
        self._layouts: dict[Layout, Layout] = {}
        self._header_bytes = 0

    @property
    def byte_order(self) -> Literal["<", ">"]:
        """``"<"`` or ``">"``."""
        return self._dialect.order

    def directories(self) -> list[Directory]:
        """Read every directory in the main chain.

        Returns
        -------
        list of Directory
            In the order of the chain.

        Raises
        ------
        DataError
            The chain or the pixels it points to leave the file, or it is damaged.
        """
        (position,) = self._dialect.pointer.unpack_from(self._data, 8 if self._dialect.big else 4)
        if position == 0:
            raise DataError(
                f"{self._path}: holds no image; it was not finished when it was written, "
                "export it again"
            )
        found: list[Directory] = []
        seen: set[int] = set()
        while position:
            if position in seen:
                raise self._damaged(f"its list of frames runs in a circle after {len(found)}")
            seen.add(position)
            directory, position = self.read_directory(position, len(found))
            found.append(directory)
        return found

    def read_directory(self, position: int, index: int) -> tuple[Directory, int]:
        """Read one directory.

        Parameters
        ----------
        position : int
            Where it starts [bytes].
        index : int
            Its place in the chain, for messages.

        Returns
        -------
        Directory
            Checked against the size of the file.
        int
            Where the next one starts; 0 after the last.

        Raises
        ------
        DataError
            It, or the pixels it points to, leave the file, or it is damaged.
        """
        counter, entry, pointer = self._dialect.count, self._entry, self._dialect.pointer
        if position + counter.size > self._size:
            raise self._list_cut_short(index)
        (n_tags,) = counter.unpack_from(self._data, position)
        if not 0 < n_tags <= _MOST_TAGS:
            raise self._damaged(f"image {index} lists {n_tags} tags")
        first = position + counter.size
        last = first + n_tags * entry.size
        if last + pointer.size > self._size:
            raise self._list_cut_short(index)
        tags: dict[int, tuple[int, int, bytes, int]] = {}
        descriptions = []
        inline = first + entry.size - pointer.size
        for code, kind, count, value in entry.iter_unpack(self._data[first:last]):
            if code == _IMAGE_DESCRIPTION:
                descriptions.append(self._extent((kind, count, value, inline), index))
            tags.setdefault(code, (kind, count, value, inline))
            inline += entry.size
        (following,) = pointer.unpack_from(self._data, last)

        layout = self._layout(tags, index)
        # One object for equal layouts, so that comparing 10⁵ frames is comparing identities.
        layout = self._layouts.setdefault(layout, layout)
        offsets, byte_counts = self._segments(tags, layout, index)
        private = tags.get(_MICRO_MANAGER)
        return (
            Directory(
                index=index,
                layout=layout,
                offsets=offsets,
                byte_counts=byte_counts,
                reduced=bool(self._number(tags, _NEW_SUBFILE_TYPE, 0, index) & _REDUCED_IMAGE),
                descriptions=tuple(descriptions),
                micro_manager=self._extent(private, index) if private else None,
                resolution=self._resolution(tags, index) if index == 0 else None,
            ),
            following,
        )

    def text(self, extent: tuple[int, int]) -> str:
        """Decode text, UTF-8 or else Latin-1.

        Parameters
        ----------
        extent : (int, int)
            Offset and length [bytes].

        Returns
        -------
        str
            Up to the first NUL.

        Raises
        ------
        DataError
            More text was read than the file holds.
        """
        self._charge(extent[1])
        raw = self._data[extent[0] : extent[0] + extent[1]].partition(b"\0")[0]
        try:
            return raw.decode("utf-8-sig").strip()
        except UnicodeDecodeError:
            return raw.decode("latin-1").strip()

    def _layout(self, tags: dict[int, tuple[int, int, bytes, int]], index: int) -> Layout:
        rows = self._number(tags, _IMAGE_LENGTH, 0, index)
        columns = self._number(tags, _IMAGE_WIDTH, 0, index)
        if rows == 0 or columns == 0:
            raise self._damaged(f"image {index} declares {rows} x {columns} pixels")
        tiled = _TILE_OFFSETS in tags or (_TILE_WIDTH in tags and _STRIP_OFFSETS not in tags)
        if tiled:
            segment_rows = self._number(tags, _TILE_LENGTH, 0, index)
            segment_columns = self._number(tags, _TILE_WIDTH, 0, index)
        else:
            segment_rows = min(rows, self._number(tags, _ROWS_PER_STRIP, rows, index))
            segment_columns = columns
        if segment_rows == 0 or segment_columns == 0:
            raise self._damaged(f"image {index} declares empty strips or tiles")
        layout = Layout(
            rows=rows,
            columns=columns,
            bits=self._number(tags, _BITS_PER_SAMPLE, 1, index),
            sample_format=self._number(tags, _SAMPLE_FORMAT, 1, index),
            samples=self._number(tags, _SAMPLES_PER_PIXEL, 1, index),
            depth=self._number(tags, _IMAGE_DEPTH, 1, index),
            compression=self._number(tags, _COMPRESSION, _UNCOMPRESSED, index),
            predictor=self._number(tags, _PREDICTOR, 1, index),
            fill_order=self._number(tags, _FILL_ORDER, 1, index),
            segment_rows=segment_rows,
            segment_columns=segment_columns,
            tiled=tiled,
        )
        if layout.frame_bytes > _LARGEST_FRAME_BYTES:
            raise self._damaged(f"image {index} declares {rows} x {columns} pixels")
        return layout

    def _segments(
        self, tags: dict[int, tuple[int, int, bytes, int]], layout: Layout, index: int
    ) -> tuple[IntArray, IntArray]:
        where = tags.get(_TILE_OFFSETS if layout.tiled else _STRIP_OFFSETS)
        sizes = tags.get(_TILE_BYTE_COUNTS if layout.tiled else _STRIP_BYTE_COUNTS)
        if where is None and layout.tiled:  # some writers file tiles under the names of strips
            where, sizes = tags.get(_STRIP_OFFSETS), tags.get(_STRIP_BYTE_COUNTS)
        if where is None:
            raise self._damaged(f"image {index} does not say where its pixels are")
        offsets = self._numbers(where, index)
        if sizes is not None:
            byte_counts = self._numbers(sizes, index)
        elif layout.compression == _UNCOMPRESSED and len(offsets) == 1:
            byte_counts = np.array([layout.frame_bytes], dtype=np.int64)
        else:
            raise self._damaged(f"image {index} does not say how long its pixel data are")
        expected = layout.segments if layout.samples == 1 else len(offsets)
        if len(offsets) != expected or len(byte_counts) != expected:
            raise self._damaged(
                f"image {index} lists {len(offsets)} strips or tiles where it needs {expected}"
            )
        if np.any(offsets <= 0) or np.any(byte_counts <= 0):
            raise DataError(
                f"{self._path}: image {index} has no pixel data for part of its area; "
                "the recording or the copy was interrupted, export it again"
            )
        end = int(np.max(offsets + byte_counts))
        if end > self._size:
            raise self._cut_short(
                f"the pixels of image {index} should reach byte {end} of {self._size}"
            )
        if layout.compression == _UNCOMPRESSED and layout.samples == 1:
            self._check_plain_size(layout, byte_counts, index)
        return offsets, byte_counts

    def _check_plain_size(self, layout: Layout, byte_counts: IntArray, index: int) -> None:
        row_bytes = -(-layout.segment_columns * layout.bits // 8)
        needed = row_bytes * (
            layout.segments * layout.segment_rows if layout.tiled else layout.rows
        )
        if int(np.sum(byte_counts)) < needed:
            raise self._damaged(
                f"image {index} declares {layout} but stores {int(np.sum(byte_counts))} bytes"
            )

    def _resolution(
        self, tags: dict[int, tuple[int, int, bytes, int]], index: int
    ) -> tuple[float, float, int] | None:
        pair = []
        for code in (_X_RESOLUTION, _Y_RESOLUTION):
            tag = tags.get(code)
            if tag is None or tag[0] != _RATIONAL or tag[1] != 1:
                return None
            offset, _ = self._extent(tag, index)
            numerator, denominator = struct.unpack_from(
                self._dialect.order + "II", self._data, offset
            )
            if numerator == 0 or denominator == 0:
                return None
            pair.append(numerator / denominator)
        return pair[0], pair[1], self._number(tags, _RESOLUTION_UNIT, 2, index)

    def _number(
        self, tags: dict[int, tuple[int, int, bytes, int]], code: int, default: int, index: int
    ) -> int:
        tag = tags.get(code)
        if tag is None or tag[1] == 0:
            return default
        kind, count, value, _ = tag
        if count == 1 and kind in _SHORT_FORMATS:  # by far the most common, and the fastest
            return int(struct.unpack_from(self._dialect.order + _SHORT_FORMATS[kind], value)[0])
        return int(self._numbers(tag, index)[0])

    def _numbers(self, tag: tuple[int, int, bytes, int], index: int) -> IntArray:
        kind = _INTEGER_TYPES.get(tag[0])
        if kind is None or tag[1] == 0:
            raise self._damaged(f"image {index} has a number of unknown type {tag[0]}")
        offset, length = self._extent(tag, index)
        self._charge(length)
        raw = np.frombuffer(self._data[offset : offset + length], self._dialect.order + kind)
        # A value beyond any file would wrap around as int64; held at 2⁶², it is found too large.
        largest = np.asarray(min(2**62, np.iinfo(raw.dtype).max), raw.dtype)
        numbers: IntArray = np.minimum(raw, largest).astype(np.int64)
        return numbers

    def _extent(self, tag: tuple[int, int, bytes, int], index: int) -> tuple[int, int]:
        """Offset and length of a tag's value, inline or elsewhere."""
        kind, count, value, inline = tag
        width = 8 if kind == _RATIONAL else 1 if kind in _TEXT_TYPES else 0
        if width == 0:
            width = np.dtype(_INTEGER_TYPES[kind]).itemsize if kind in _INTEGER_TYPES else 1
        length = count * width
        if length <= len(value):
            return inline, length
        (offset,) = self._dialect.pointer.unpack(value)
        if offset + length > self._size:
            raise self._cut_short(
                f"the header of image {index} should reach byte {offset + length} of {self._size}"
            )
        return offset, length

    def _charge(self, length: int) -> None:
        """Book header bytes: images that share one long list would cost its length each time."""
        self._header_bytes += length
        if self._header_bytes > _OVERLAP * self._size + _OVERLAP_BYTES:
            raise self._damaged("the headers of its images overlap")

    def _list_cut_short(self, index: int) -> DataError:
        return self._cut_short(f"its list of frames breaks off after {index} of them")

    def _cut_short(self, where: str) -> DataError:
        return DataError(f"{self._path}: is truncated ({where}); copy it again or export it again")

    def _damaged(self, how: str) -> DataError:
        return DataError(f"{self._path}: is damaged ({how}); export it again")
