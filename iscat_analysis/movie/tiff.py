"""TIFF movies, in a file, a set of files, or a folder of files with one frame each.

tifffile reads the images.  It repairs what it can, by leaving out what it cannot read; whatever it
left out is a reason here to refuse the file.  The images are counted against every description: a
movie that was written frame by frame describes one frame in each image, and a reader that believes
the first of these descriptions returns one frame of thousands.

Cameras write thousands of headers, one before each frame, and to read each tag of each takes a
tenth of a millisecond.  A header that repeats another's, byte for byte but for the place of the
pixels, was read and judged before.
"""

from __future__ import annotations

import itertools
import logging
import math
import mmap
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import tifffile
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.descriptions import (
    TIME_FROM_HEIGHTS,
    Described,
    OmeMovie,
    described_frames,
    elapsed_ms,
    files_of_set,
    frame_index,
    imagej_hints,
    is_ome,
    merge,
    metamorph_hints,
    micro_manager_axes,
    micro_manager_hints,
    plain_hints,
    read_ome,
    time_axis,
)
from iscat_analysis.movie.mapped import (
    MOST_FRAME_DECODED_RATIO,
    WHAT_LIBRARIES_RAISE,
    damaged,
    frames_in_place,
    map_file,
    refuse_changed,
    refuse_growth,
    release,
    unmap,
)
from iscat_analysis.movie.stack import FileSet
from iscat_analysis.reading import open_regular
from iscat_analysis.records import InPlace, StackMetadata
from iscat_analysis.units import listed

STRIP_OFFSETS, TILE_OFFSETS, STRIP_SIZES, TILE_SIZES = 273, 324, 279, 325
"""Codes of the tags that say where the pixels lie, and how many bytes they have."""

_LOSSLESS = {1, 5, 8, 32773, 32946, 34925, 50000}
"""No compression, LZW, Deflate, PackBits, old Deflate, LZMA, Zstandard."""


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


def refuse_unread_pixels(page: tifffile.TiffPage, file_size: int, path: Path) -> None:
    """Refuse an image whose strips or tiles are not all listed, and whole, in the file."""
    number, rows, columns = page.index, page.imagelength, page.imagewidth
    frame_bytes = rows * columns * (page.dtype.itemsize if page.dtype else 8) * page.samplesperpixel
    if not 0 < frame_bytes <= 2**31:  # 32 768 × 32 768 pixels of 16 bits, beyond any camera
        raise _damaged(path, f"image {number} declares {rows} x {columns} pixels")
    needed = math.prod(page.chunked)
    tag = page.tags.get(TILE_OFFSETS) or page.tags.get(STRIP_OFFSETS)
    listed = tag.count if tag is not None else 0
    if page.compression != 1 and not {STRIP_SIZES, TILE_SIZES} & set(page.tags.keys()):
        raise _damaged(path, f"image {number} does not say how long its pixel data are")
    if not listed == len(page.dataoffsets) == len(page.databytecounts) == needed:
        raise _damaged(path, f"image {number} lists {listed} strips or tiles but needs {needed}")
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
            raise _damaged(path, f"image {number} needs more than the {stored} bytes it stores")


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


def _damaged(path: Path, how: str) -> DataError:
    """Make the error of a damaged file."""
    return DataError(f"{path}: is damaged ({how}); export it again")


_ELSEWHERE = {282: 5, 283: 5, 305: 2, 306: 2}
"""Resolutions, program and time, with their types: they lie outside the list of tags, and those of
the first image count."""

_PLACES = {3: "H", 4: "I", 16: "Q"}  # types of number that may say where pixels are


@dataclass(frozen=True, slots=True)
class Repetition:
    """Header of an image, against which others are compared; `repetition_of` makes it."""

    tiff: tifffile.TiffFormat
    tags: bytes
    free: tuple[tuple[int, int], ...]
    place: tuple[str, int]
    size: int

    def find(self, data: mmap.mmap, offset: int) -> tuple[int, int] | None:
        """Compare an image."""
        end = offset + len(self.tags)
        here = bytearray(data[offset : end + self.tiff.offsetsize])
        if offset <= 0 or len(here) < len(self.tags) + self.tiff.offsetsize:
            return None
        (start,) = struct.unpack_from(self.place[0], here, self.place[1])
        (following,) = struct.unpack_from(self.tiff.offsetformat, here, len(self.tags))
        for first, last in self.free:
            here[first:last] = bytes(last - first)
        if here[: len(self.tags)] != self.tags or not 0 < start <= len(data) - self.size:
            return None
        return int(start), int(following)


def repetition_of(
    tiff: tifffile.TiffFormat, data: mmap.mmap, offset: int, size: int
) -> Repetition | None:
    """Make a pattern of the header of an image."""
    (count,) = struct.unpack_from(tiff.tagnoformat, data, offset)
    length = tiff.tagnosize + count * tiff.tagsize
    tags = bytearray(data[offset : offset + length])
    place: tuple[str, int] | None = None
    free = []
    for first in range(tiff.tagnosize, length, tiff.tagsize):
        code, kind = struct.unpack_from(f"{tiff.byteorder}HH", tags, first)
        number = struct.unpack_from(tiff.offsetformat, tags, first + 4)[0]
        last = first + tiff.tagsize
        value = last - tiff.offsetsize
        if code == STRIP_OFFSETS and number == 1 and kind in _PLACES and place is None:
            place = f"{tiff.byteorder}{_PLACES[kind]}", value
        elif _ELSEWHERE.get(code) != kind:
            continue
        free.append((value, last))
        tags[value:last] = bytes(last - value)
    return None if place is None else Repetition(tiff, bytes(tags), tuple(free), place, size)


TIFF_SUFFIXES = (".tif", ".tiff", ".btf", ".tf8", ".stk")
"""Of files that are taken for TIFF movies where a folder is searched for them."""

_DESCRIPTION, _MICRO_MANAGER = 270, 51123
_METAMORPH, _METAMORPH_PLANES = 33628, 33629  # UIC1Tag and UIC2Tag
_ESSENTIAL = {
    256, 257, 258, 259, 266, _DESCRIPTION, STRIP_OFFSETS, 277, 278, STRIP_SIZES, 317, 322, 323,
    TILE_OFFSETS, TILE_SIZES, 339, 32997, _METAMORPH_PLANES,
}  # fmt: skip
"""Tags without which an image would be taken for another: size, type, encoding, place, text."""

_PLAIN = dict.fromkeys(("is_lsm", "is_ndpi", "is_ome", "is_scanimage", "is_stk"), False)
"""Dialects whose images tifffile would guess rather than read."""


@dataclass(eq=False)
class TiffFrames:
    """The frames of a TIFF file; `open_tiff` makes it."""

    data: mmap.mmap
    path: Path
    stored: np.dtype[Any]
    images: Sequence[Image]
    n_frames: int
    metadata: StackMetadata
    notes: tuple[str, ...]
    decode: Callable[..., Any]

    def __post_init__(self) -> None:
        self.dtype: np.dtype[Any] = self.stored.newbyteorder("=")
        rows, columns = self.images[0].shape
        self.shape = (self.n_frames, rows, columns)
        self._starts = self._find_starts(self.n_frames)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        refuse_changed(self.path, self.data)
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        if self._starts is None:
            for number in range(start, stop):
                self._decode_into(block[number - start], self.images[number], number)
            return block
        for number, first in enumerate(self._starts[start:stop]):
            block[number] = np.ndarray(
                self.shape[1:], self.stored, buffer=self.data, offset=int(first)
            )
        if start < stop:
            used = self._starts[start:stop]
            release(self.data, int(used.min()), int(used.max()))
        return block

    @property
    def place(self) -> int | None:
        """First byte of the first frame; None where it is compressed."""
        return None if self._starts is None else int(self._starts[0])

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """Give frames where they lie in the file."""
        if self._starts is None or start >= stop:
            return None
        shape = (stop - start, *self.shape[1:])
        size = math.prod(self.shape[1:]) * self.dtype.itemsize
        if np.any(np.diff(self._starts[start:stop]) != size):
            return None
        return frames_in_place(self.path, self.data, int(self._starts[start]), shape, self.stored)

    def close(self) -> None:
        """Release the file."""
        unmap(self.data)

    def _find_starts(self, n_frames: int) -> NDArray[np.int64] | None:
        """First byte of every frame, where all of them lie in the file as they are."""
        starts = [image.start for image in self.images if image.start is not None]
        if len(starts) < len(self.images):
            return None
        size = math.prod(self.shape[1:]) * self.dtype.itemsize
        followers = n_frames - len(starts)  # frames without an image of their own
        end = max(starts) + size * (1 + followers)
        if end > len(self.data):
            raise DataError(
                f"{self.path}: is truncated (its {n_frames} frames should reach byte {end} of "
                f"{len(self.data)}); copy it again or export it again"
            )
        if followers:
            return starts[0] + size * np.arange(n_frames, dtype=np.int64)
        return np.array(starts, dtype=np.int64)

    def _decode_into(self, frame: NDArray[Any], image: Image, number: int) -> None:
        rows, columns = frame.shape
        for segment, (offset, size) in enumerate(zip(image.offsets, image.sizes, strict=True)):
            what = f"{self.path}: the pixels of frame {number} cannot be decompressed"
            with damaged(what, remedy="copy the file again or export it again"):
                pixels, place, _ = self.decode(self.data[offset : offset + size], segment)
                top, left = place[2], place[3]
                tile = pixels[0, : rows - top, : columns - left, 0]
                frame[top : top + tile.shape[0], left : left + tile.shape[1]] = tile


def open_tiff(path: Path, *, member: bool = False) -> TiffFrames | FileSet:
    """Open a TIFF movie."""
    data = map_file(path)
    try:
        what = f"{path}: is truncated or damaged ({len(data)} bytes long)"
        with damaged(what), _tiff(path) as file:
            return _open(file, data, path, member)
    except DataError:
        data.close()
        raise


@contextmanager
def open_frame_file(path: Path) -> Iterator[TiffFrames]:
    """Open a file that may hold a single frame, for a moment."""
    with closing(open_tiff(path, member=True)) as frames:
        yield cast(TiffFrames, frames)  # a member is no set


def _is_single_image(path: Path) -> bool:
    """Tell whether a file holds one image, and describes no set of files."""
    try:
        with _tiff(path) as file:
            page = file.pages[0]
            return len(file.pages) == 1 and _planes(page) == 1 and not _text_of_set(page)
    except WHAT_LIBRARIES_RAISE:  # whoever opens it says what is wrong with it
        return False


def files_described(path: Path) -> tuple[str, ...]:
    """Name the files of the set that a file describes; none where it cannot be read."""
    try:
        with _tiff(path) as file:
            text = _text_of_set(file.pages[0])
        return files_of_set(text, path) if text else ()
    except (DataError, *WHAT_LIBRARIES_RAISE):  # whoever opens it says what is wrong with it
        return ()


def _text_of_set(page: tifffile.TiffPage) -> str:
    """Give the OME-XML of an image that names files; empty where there is none."""
    return next((t for t in _texts(page) if is_ome(t) and "FileName" in t), "")


def _open(
    file: tifffile.TiffFile, data: mmap.mmap, path: Path, member: bool
) -> TiffFrames | FileSet:
    images = list(_images(file, data, path))
    depth, texts = file.pages[0].imagedepth, images[0].texts
    if depth > 1:  # which descriptions may count one by one
        raise DataError(
            f"{path}: holds volumes ({depth} planes per image); export one plane per frame"
        )
    ome_text = next((text for text in texts if is_ome(text)), None)
    notes: tuple[str, ...] = ()
    if member:
        order, n_frames, hints = list(range(len(images))), len(images), []
    elif ome_text is not None:
        ome = read_ome(ome_text, len(images), path)
        if len(ome.files) > 1:
            data.close()
            return _open_set(ome, path)
        order = ome.where[:, 1].tolist()
        n_frames, hints = len(order), [ome.hints]
    else:
        # Thumbnails are left out, unless everything is declared to be one.
        order = [k for k, image in enumerate(images) if not image.reduced]
        order = order or list(range(len(images)))
        n_frames, heights = _count_frames([images[k] for k in order], path)
        hints = []
        notes = (TIME_FROM_HEIGHTS,) if heights else ()
    frames = [images[k] for k in order]
    if not member and (found := order_by_time(frames)) is not None:
        frames, order = [frames[k] for k in found], [order[k] for k in found]
        moved = sum(page != frame for frame, page in enumerate(found))
        notes = (
            *notes,
            f"{moved} of the file's {len(found)} images are not where their times (ElapsedTime-ms, "
            "or else FrameIndex) say; the frames are read in the order of these times",
        )
    first = file.pages[order[0]]
    dtype = pixel_type(first, path).newbyteorder(file.byteorder)
    refuse_differences(frames, path)
    size = math.prod(frames[0].shape) * dtype.itemsize
    for number, image in enumerate(frames):
        if image.start is None:
            what, ratio = f"{path}: image {number}", MOST_FRAME_DECODED_RATIO
            refuse_growth(size, sum(image.sizes), what, ratio=ratio)
    if frames[0].start is None:
        refuse_growth(n_frames * size, len(data), f"{path}: it")

    if _MICRO_MANAGER in first.tags:
        summary = _micro_manager_summary(path)
        if ome_text is None and not member:
            time_axis(micro_manager_axes(summary), path)
        times_ms = [image.elapsed_ms for image in frames]
        hints.append(micro_manager_hints(first.tags.valueof(_MICRO_MANAGER), times_ms, summary))
    if first.tags.valueof(_METAMORPH_PLANES) is not None:
        hints.append(metamorph_hints(*map(first.tags.valueof, (_METAMORPH, _METAMORPH_PLANES))))
    resolution = _resolution(file.pages[0])
    hints += [imagej_hints(text, resolution) for text in texts if text.startswith("ImageJ=")]
    hints.append(plain_hints(resolution))
    notes = (*notes, *(note for hint in hints for note in hint.notes))
    known = merge(hints, path)
    return TiffFrames(data, path, dtype, frames, n_frames, known, notes, first.decode)


def _images(file: tifffile.TiffFile, data: mmap.mmap, path: Path) -> Iterator[Image]:
    """Read the images one by one, and refuse the file where tifffile would repair it."""
    seen: set[int] = set()
    following = values = long_values = 0
    image: Image | None = None
    pattern: Repetition | None = None
    for number in itertools.count():
        again = None
        if values > 2 * len(data) + 1_000_000:  # one long value would cost its length each time
            raise _damaged(path, "the headers of its images overlap")
        if pattern is not None and following not in seen:
            again = pattern.find(data, following)
        if again is not None and image is not None:
            seen.add(following)
            start, following = again
            values += long_values
            yield replace(image, offsets=(start,), start=None if image.start is None else start)
            continue
        if number and not following:
            break
        try:
            page = file.pages[number]
        except IndexError:
            break
        if page.offset in seen:
            raise _damaged(path, f"its list of frames runs in a circle after {number}")
        seen.add(page.offset)
        tags, following = _declared_tags(file.tiff, data, page.offset)
        if len(tags) != len(page.tags) and set(tags) & _ESSENTIAL - set(page.tags.keys()):
            raise _damaged(path, f"the header of image {number} is truncated or cannot be read")
        # eight elements may stand in the list of tags itself
        long_values = sum(tag.valuebytecount for tag in page.tags if tag.count > 8)
        values += long_values
        refuse_unread_pixels(page, len(data), path)
        image = Image(
            page.shape,
            page.dtype,
            page.hash,
            page.is_reduced,
            _texts(page),
            page.dataoffsets,
            page.databytecounts,
            _start(page),
            _planes(page),
            elapsed_ms(recorded := page.tags.valueof(_MICRO_MANAGER)),
            frame_index(recorded),
        )
        pattern = repetition_of(file.tiff, data, page.offset, sum(image.sizes))
        yield image
    if not seen and not any(data[4:8] if not file.tiff.is_bigtiff else data[8:16]):
        raise DataError(
            f"{path}: holds no image; it was not finished when it was written, export it again"
        )
    if not seen or following:
        raise DataError(
            f"{path}: is truncated (its list of frames breaks off after {len(seen)} of them); "
            "copy it again or export it again"
        )


def _declared_tags(
    tiff: tifffile.TiffFormat, data: mmap.mmap, offset: int
) -> tuple[list[int], int]:
    """Codes of the tags that an image lists, and where the next image is; 0 after the last."""
    (count,) = struct.unpack_from(tiff.tagnoformat, data, offset)
    first = offset + tiff.tagnosize
    end = first + count * tiff.tagsize
    codes = np.ndarray(count, f"{tiff.byteorder}u2", data, first, (tiff.tagsize,)).tolist()
    return codes, int(struct.unpack_from(tiff.offsetformat, data, end)[0])


def _texts(page: tifffile.TiffPage) -> tuple[str, ...]:
    """Give the descriptions of an image, which tifffile gives as bytes where they are not UTF-8."""
    values = [tag.value for tag in page.tags.getall(_DESCRIPTION, ())]
    texts = (text if isinstance(text, str) else text.decode("latin-1") for text in values)
    return tuple(text.partition("\0")[0].strip() for text in texts)


def _count_frames(images: Sequence[Image], path: Path) -> tuple[int, bool]:
    """Set what the file holds against every description in it; the larger number must be true.

    Where images one after the other carry the same description, it is one of all of them.

    Returns the number of frames, and whether they lie along an axis of heights.
    """
    announced = 0
    one_image = heights = False
    for found, repeats in itertools.groupby(_described(image, path) for image in images):
        if found is not None:
            announced += found.frames * math.ceil(len(list(repeats)) / found.frames)
            one_image |= found.one_image
            heights |= found.axis == "Z"
    if announced <= len(images):
        return len(images), heights
    if len(images) == 1 and one_image and images[0].start is not None:
        return announced, heights
    raise DataError(
        f"{path}: describes {announced} frames but holds {len(images)}; "
        "the recording or the copy was interrupted: export it again"
    )


def _described(image: Image, path: Path) -> Described | None:
    """Read what an image says of the frames that begin with it."""
    if image.planes > 1:
        return Described(image.planes, "T", one_image=True)
    all_texts = (described_frames(text, image.shape, path) for text in image.texts)
    return next((found for found in all_texts if found is not None), None)


def _start(page: tifffile.TiffPage) -> int | None:
    """First byte of pixels that lie in the file as they are."""
    if not page.is_final:
        return None
    if page.is_stk:  # whose strips tifffile takes for contiguous, whatever the file says
        strips = itertools.pairwise(zip(page.dataoffsets, page.databytecounts, strict=True))
        if any(start + size != after for (start, size), (after, _) in strips):
            return None
    return int(page.dataoffsets[0])


def _planes(page: tifffile.TiffPage) -> int:
    """Count the frames that MetaMorph keeps behind one image."""
    tag = page.tags.get(_METAMORPH_PLANES)
    return 1 if tag is None else max(int(tag.count), 1)


def _micro_manager_summary(path: Path) -> dict[str, Any]:
    """Summary of the acquisition; empty where the file is of an older version or was edited."""
    try:
        with path.open("rb") as file:
            found = tifffile.read_micromanager_metadata(file, {"Summary"}).get("Summary")
    except WHAT_LIBRARIES_RAISE:
        return {}
    return found if isinstance(found, dict) else {}


def _resolution(page: tifffile.TiffPage) -> tuple[float, float, int] | None:
    """Pixels per unit along x and y, and the unit."""
    pair = [page.tags.valueof(code) for code in (282, 283)]
    if any(not isinstance(value, tuple) or len(value) != 2 or 0 in value for value in pair):
        return None
    (x, x_per), (y, y_per) = pair
    unit: int = page.tags.valueof(296, 2)
    return x / x_per, y / y_per, unit


@contextmanager
def _tiff(path: Path) -> Iterator[tifffile.TiffFile]:
    """Open a file; log messages are kept off stderr, unless the program has set up logging."""
    logger, handler = logging.getLogger("tifffile"), logging.NullHandler()
    logger.addHandler(handler)
    try:
        with tifffile.TiffFile(path, **_PLAIN) as file:
            yield file
    finally:
        logger.removeHandler(handler)


def _open_set(described: OmeMovie, path: Path) -> FileSet:
    """Open the files of a set, which lie beside each other."""
    files = [path.with_name(name) if name else path for name in described.files]
    with ExitStack() as opened:
        members = []
        for file in files:
            members.append(open_tiff(file, member=True))
            opened.callback(members[-1].close)
        last = np.full(len(files), -1)
        np.maximum.at(last, described.where[:, 0], described.where[:, 1])
        for number, (file, member) in enumerate(zip(files, members, strict=True)):
            if (member.shape[1:], member.dtype) != (members[0].shape[1:], members[0].dtype):
                raise DataError(f"{file}: has other pixels than {files[0].name}; export it again")
            needed = int(last[number]) + 1
            if needed > member.shape[0]:
                raise DataError(
                    f"{file}: holds {member.shape[0]} images, but the description of its set says "
                    f"{needed}; the recording or the copy was interrupted: export it again"
                )
        opened.pop_all()
    hints = described.hints
    return FileSet(members, files, described.where, merge([hints], path), hints.notes)


def order_by_time(images: Sequence[Image]) -> list[int] | None:
    """Sort images by their times, and by their numbers where those are the same or not all known.

    Returns None where they are in order, or nothing tells it.
    """
    known = [(image.elapsed_ms, image.index) for image in images]
    keys = [values for values in zip(*known, strict=True) if None not in values]
    order = np.lexsort(keys[::-1]) if keys else np.arange(len(images))
    found: list[int] = order.tolist()
    return None if found == [*range(len(images))] else found


_DIGITS = re.compile(r"(\d+)", flags=re.ASCII)


def frames_in(folder: Path) -> tuple[Path, ...]:
    """List the TIFF files of a folder in natural order: frame2 before frame10."""
    try:
        inside = [path for path in folder.iterdir() if path.suffix.lower() in TIFF_SUFFIXES]
    except OSError:
        return ()
    shown = (path for path in inside if not path.name.startswith(".") and path.is_file())
    return tuple(sorted(shown, key=lambda path: (_numbers(path), path.name)))


def holds_single_frames(folder: Path, *, named: bool = False) -> bool:
    """Tell whether a folder is a movie of TIFF files with one image each.

    Unless somebody names it as a movie, it must have ten files, whose numbers alone differ.
    """
    files = frames_in(folder)
    if len(files) < (2 if named else 10):
        return False
    alike = named or len({*map(_pattern, files)}) == 1
    return alike and _is_single_image(files[0]) and _is_single_image(files[-1])


class FrameFiles:
    """The frames of a folder; a file is open only while it is read."""

    def __init__(self, folder: Path) -> None:
        self.files = frames_in(folder)
        _refuse_mixture(self.files, folder)
        _refuse_gaps(self.files, folder)
        with open_frame_file(self.files[0]) as first:
            self._expected = first.shape, first.dtype
            self.metadata, self.notes = first.metadata, first.notes
            self._stored, place = first.stored, first.place
        self.shape = (len(self.files), *self._expected[0][1:])
        self.dtype = self._expected[1]
        self._size = self.shape[1] * self.shape[2] * self.dtype.itemsize
        if place is None:
            self._places = [self._place(file) for file in self.files]
        else:  # headers that repeat are read once
            around = _around(self.files[0], place, self._size)
            self._places = [
                place if _around(file, place, self._size) == around else self._place(file)
                for file in self.files
            ]

    def _place(self, file: Path) -> int | None:
        """Read the header of a file that is not like the first one."""
        with open_frame_file(file) as frames:
            if frames.shape[0] > 1:
                raise DataError(
                    f"{file}: holds {frames.shape[0]} frames, but the other files of its folder "
                    "hold one each; leave only the frames of one movie there"
                )
            if (frames.shape, frames.dtype) != self._expected or frames.stored != self._stored:
                raise DataError(
                    f"{file}: has other pixels than {self.files[0].name}; leave only the frames "
                    "of one movie in the folder"
                )
            return frames.place

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        for number in range(start, stop):
            file, place = self.files[number], self._places[number]
            if place is None:  # compressed
                with open_frame_file(file) as frames:
                    block[number - start] = frames.read(0, 1)[0]
                continue
            try:
                with open_regular(file) as opened:
                    opened.seek(place)
                    raw = opened.read(self._size)
            except OSError as error:
                raise DataError(f"{file}: can no longer be read ({error.strerror})") from None
            if len(raw) < self._size:
                raise DataError(f"{file}: became shorter while it was open; start again")
            block[number - start] = np.frombuffer(raw, self._stored).reshape(self.shape[1:])
        return block

    def close(self) -> None:
        """Do nothing: no file is open."""


def _around(path: Path, place: int, size: int) -> tuple[bytes, bytes, int]:
    """Give what a file holds before and behind its pixels, and its length."""
    try:
        with open_regular(path) as file:
            before = file.read(place)
            end = file.seek(0, 2)
            file.seek(place + size)
            return before, file.read(), end
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None


def _parts(path: Path) -> list[str]:
    return _DIGITS.split(path.name)


def _numbers(path: Path) -> list[tuple[int, int | str]]:
    """Give what a name is sorted by: texts by their letters, numbers by their size."""
    return [(1, int(part)) if k % 2 else (0, part) for k, part in enumerate(_parts(path))]


def _pattern(path: Path) -> str:
    return "#".join(_parts(path)[::2])


def _refuse_mixture(files: Sequence[Path], folder: Path) -> None:
    """Refuse names of several kinds: one of them may be a background, a mean or another channel."""
    kinds = list(dict.fromkeys(map(_pattern, files)))
    if len(kinds) > 1:
        raise DataError(
            f"{folder}: holds TIFF files with different kinds of names "
            f"({', '.join(kinds[:3])}); leave only the frames of one movie there"
        )


def _refuse_gaps(files: Sequence[Path], folder: Path) -> None:
    """Refuse numbers of which some are missing, and two that count different things."""
    columns = zip(*([int(part) for part in _parts(file)[1::2]] for file in files), strict=True)
    varying = [np.array(column) for column in columns if len(set(column)) > 1]
    if len(varying) > 1 and np.prod([len(np.unique(column)) for column in varying]) == len(files):
        counts = " x ".join(str(len(np.unique(column))) for column in varying)
        raise DataError(
            f"{folder}: the names of its {len(files)} files count {counts} frames by several "
            "numbers, as of channels, heights or positions; leave only the frames of one there"
        )
    if len(varying) != 1:
        return
    steps = np.diff(varying[0])
    step = int(steps.min())
    if step > 0 and not (steps % step).any() and np.median(steps) == step:
        every = np.arange(varying[0][0], varying[0][-1] + 1, step)
        missing = np.setdiff1d(every, varying[0])
        if 0 < missing.size < len(files):
            raise DataError(
                f"{folder}: of the numbers in the names of its files {missing.size} are missing "
                f"({listed(missing, 3)}); copy the folder again or, if these frames were left out "
                "on purpose, number the files anew"
            )
