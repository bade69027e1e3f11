"""What a TIFF file must hold to be read as a movie, and what it must not do to its reader."""

from __future__ import annotations

import math
import mmap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from iscat_analysis.errors import DataError

STRIP_OFFSETS, TILE_OFFSETS, STRIP_SIZES, TILE_SIZES = 273, 324, 279, 325
"""Codes of the tags that say where the pixels lie, and how many bytes they have."""

_LOSSLESS = {1, 5, 8, 32773, 32946, 34925, 50000}
"""No compression, LZW, Deflate, PackBits, old Deflate, LZMA, Zstandard."""

_LARGEST_FRAME_BYTES = 2**31  # 32 768 × 32 768 pixels of 16 bits, beyond any camera
MOST_FRAME_DECODED_RATIO = 100
"""Of one frame, which is held in memory whole, decoded over stored."""

_OVERLAP = 2  # values of tags over the size of the file; each lies in it once
_OVERLAP_BYTES = 1_000_000


@dataclass(frozen=True, slots=True)
class Image:
    """One image of the file: how it is stored, and where its strips or tiles lie."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any] | None
    encoding: int
    reduced: bool
    texts: tuple[str, ...]
    offsets: tuple[int, ...]
    sizes: tuple[int, ...]
    start: int | None
    planes: int
    """Frames whose pixels follow one another from here, as MetaMorph counts them."""
    elapsed_ms: float | None
    index: int | None
    """Time and number of the frame, as Micro-Manager wrote them beside its pixels."""

    def __str__(self) -> str:
        return f"{' x '.join(map(str, self.shape))} pixels of {self.dtype}"


def refuse_overlap(values: int, data: mmap.mmap, path: Path) -> None:
    """Refuse images that share one long value, which would cost its length each time."""
    if values > _OVERLAP * len(data) + _OVERLAP_BYTES:
        raise damaged(path, "the headers of its images overlap")


def refuse_unread_pixels(page: tifffile.TiffPage, file_size: int, path: Path) -> None:
    """Refuse an image whose strips or tiles are not all listed, and whole, in the file."""
    number, rows, columns = page.index, page.imagelength, page.imagewidth
    frame_bytes = rows * columns * (page.dtype.itemsize if page.dtype else 8) * page.samplesperpixel
    if not 0 < frame_bytes <= _LARGEST_FRAME_BYTES:
        raise damaged(path, f"image {number} declares {rows} x {columns} pixels")
    needed = math.prod(page.chunked)
    tag = page.tags.get(TILE_OFFSETS) or page.tags.get(STRIP_OFFSETS)
    listed = tag.count if tag is not None else 0
    if page.compression != 1 and not {STRIP_SIZES, TILE_SIZES} & set(page.tags.keys()):
        raise damaged(path, f"image {number} does not say how long its pixel data are")
    if not listed == len(page.dataoffsets) == len(page.databytecounts) == needed:
        raise damaged(path, f"image {number} lists {listed} strips or tiles but needs {needed}")
    if min(page.dataoffsets) <= 0 or min(page.databytecounts) <= 0:
        raise DataError(
            f"{path}: image {number} has no pixel data for part of its area; "
            "the recording or the copy was interrupted, export it again"
        )
    end = max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=True)))
    if end > file_size:
        raise DataError(
            f"{path}: is truncated (the pixels of image {number} should reach byte {end} of "
            f"{file_size}); copy it again or export it again"
        )
    if page.compression == 1:
        stored = sum(page.databytecounts)
        tile_rows, tile_columns = page.chunks[-2:] if page.samplesperpixel == 1 else (1, 1)
        if page.is_tiled and page.samplesperpixel == 1:
            rows, columns = needed * tile_rows, tile_columns
        if stored < rows * -(-columns * page.bitspersample // 8):
            raise damaged(path, f"image {number} needs more than the {stored} bytes it stores")


def refuse_volumes(page: tifffile.TiffPage, path: Path) -> None:
    """Refuse images of several planes, which descriptions may count one by one."""
    if page.imagedepth > 1:
        raise DataError(
            f"{path}: holds volumes ({page.imagedepth} planes per image); "
            "export one plane per frame"
        )


def pixel_type(page: tifffile.TiffPage, path: Path) -> np.dtype[Any]:
    """Give the type of the pixels, if the movie is of a kind that can be analysed."""
    if page.samplesperpixel > 1:
        raise DataError(
            f"{path}: holds colour images ({page.samplesperpixel} samples per pixel); "
            "export the camera's grey values"
        )
    if page.compression not in _LOSSLESS:
        name = getattr(page.compression, "name", "unknown")
        raise DataError(
            f"{path}: its compression ({name}, number {int(page.compression)}) is not supported; "
            "save it uncompressed or with Deflate"
        )
    if page.dtype is None or page.dtype.kind not in "uif":
        raise DataError(
            f"{path}: its pixels are {page.bitspersample}-bit numbers of sample format "
            f"{int(page.sampleformat)}; export it as 8-, 16- or 32-bit integers or as floats"
        )
    dtype: np.dtype[Any] = page.dtype
    return dtype


def refuse_differences(frames: Sequence[Image], path: Path) -> None:
    """Refuse frames that are not all stored alike."""
    first = frames[0]
    for number, image in enumerate(frames):
        if image.encoding != first.encoding:
            differs = str(image) != str(first)
            what = f"{image} but the first is {first}" if differs else "stored in another way"
            raise DataError(
                f"{path}: its frames differ: image {number} is {what}; "
                "export the frames of one movie to a file of their own"
            )


def damaged(path: Path, how: str) -> DataError:
    """Make the error of a damaged file."""
    return DataError(f"{path}: is damaged ({how}); export it again")
