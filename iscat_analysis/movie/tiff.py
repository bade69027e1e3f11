"""TIFF movies: which images are the frames, and their pixels.

tifffile reads the images.  It repairs what it can, by leaving out what it cannot read; whatever it
left out is a reason here to refuse the file.  The images are counted against every description: a
movie that was written frame by frame describes one frame in each image, and a reader that believes
the first of these descriptions returns one frame of thousands.
"""

from __future__ import annotations

import itertools
import logging
import math
import mmap
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import tifffile
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.descriptions import (
    TIME_FROM_HEIGHTS,
    Described,
    described_frames,
    elapsed_ms,
    frame_index,
    imagej_hints,
    merge,
    metamorph_hints,
    micro_manager_axes,
    micro_manager_hints,
    order_by_time,
    out_of_order,
    plain_hints,
    time_axis,
)
from iscat_analysis.movie.file_set import FileSet, open_set
from iscat_analysis.movie.mapped import (
    WHAT_LIBRARIES_RAISE,
    frames_in_place,
    map_file,
    refuse_changed,
    refuse_growth,
    release,
    unmap,
)
from iscat_analysis.movie.ome import is_ome, read_ome, read_ome_set
from iscat_analysis.movie.tiff_checks import (
    MOST_FRAME_DECODED_RATIO,
    STRIP_OFFSETS,
    STRIP_SIZES,
    TILE_OFFSETS,
    TILE_SIZES,
    Image,
    damaged,
    pixel_type,
    refuse_differences,
    refuse_overlap,
    refuse_unread_pixels,
    refuse_volumes,
)
from iscat_analysis.movie.tiff_headers import Repetition, repetition_of
from iscat_analysis.records import InPlace, StackMetadata

TIFF_SUFFIXES = (".tif", ".tiff", ".btf", ".tf8", ".stk")
"""Of files that are taken for TIFF movies where a folder is searched for them."""

_DESCRIPTION, _MICRO_MANAGER = 270, 51123
_METAMORPH, _METAMORPH_PLANES = 33628, 33629  # UIC1Tag and UIC2Tag
_ESSENTIAL = {
    256, 257, 258, 259, 266, _DESCRIPTION, STRIP_OFFSETS, 277, 278, STRIP_SIZES, 317, 322, 323,
    TILE_OFFSETS, TILE_SIZES, 339, 32997, _METAMORPH_PLANES,
}  # fmt: skip
"""Tags without which an image would be taken for another: size, type, encoding, place, text."""

_INLINE = 8  # elements that may stand in the list of tags itself

_PLAIN = dict.fromkeys(("is_lsm", "is_ndpi", "is_ome", "is_scanimage", "is_stk"), False)
"""Dialects whose images tifffile would guess rather than read."""


class TiffFrames:
    """The frames of a TIFF file; `open_tiff` makes it."""

    def __init__(
        self,
        data: mmap.mmap,
        path: Path,
        *,
        dtype: np.dtype[Any],
        images: Sequence[Image],
        n_frames: int,
        metadata: StackMetadata,
        notes: tuple[str, ...],
        decode: Callable[..., Any],
    ) -> None:
        self._data = data
        self._path = path
        self.stored = dtype
        self._images = images
        self._decode = decode
        rows, columns = images[0].shape
        self.dtype: np.dtype[Any] = dtype.newbyteorder("=")
        self.shape = (n_frames, rows, columns)
        self.metadata = metadata
        self.notes = notes
        self._starts = self._find_starts(n_frames)

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Shapes: result (stop − start, y, x).
        """
        refuse_changed(self._path, self._data)
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        if self._starts is None:
            for number in range(start, stop):
                self._decode_into(block[number - start], self._images[number], number)
            return block
        for number, first in enumerate(self._starts[start:stop]):
            block[number] = np.ndarray(
                self.shape[1:], self.stored, buffer=self._data, offset=int(first)
            )
        if start < stop:
            used = self._starts[start:stop]
            release(self._data, int(used.min()), int(used.max()))
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
        first = int(self._starts[start])
        return frames_in_place(self._path, self._data, first, shape, self.stored)

    def close(self) -> None:
        """Release the file."""
        unmap(self._data)

    def _find_starts(self, n_frames: int) -> NDArray[np.int64] | None:
        """First byte of every frame, where all of them lie in the file as they are."""
        starts = [image.start for image in self._images if image.start is not None]
        if len(starts) < len(self._images):
            return None
        size = math.prod(self.shape[1:]) * self.dtype.itemsize
        followers = n_frames - len(starts)  # frames without an image of their own
        end = max(starts) + size * (1 + followers)
        if end > len(self._data):
            raise DataError(
                f"{self._path}: is truncated (its {n_frames} frames should reach byte {end} of "
                f"{len(self._data)}); copy it again or export it again"
            )
        if followers:
            return starts[0] + size * np.arange(n_frames, dtype=np.int64)
        return np.array(starts, dtype=np.int64)

    def _decode_into(self, frame: NDArray[Any], image: Image, number: int) -> None:
        rows, columns = frame.shape
        for segment, (offset, size) in enumerate(zip(image.offsets, image.sizes, strict=True)):
            try:
                pixels, place, _ = self._decode(self._data[offset : offset + size], segment)
                top, left = place[2], place[3]
                tile = pixels[0, : rows - top, : columns - left, 0]
                frame[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
            except WHAT_LIBRARIES_RAISE as error:
                raise DataError(
                    f"{self._path}: the pixels of frame {number} cannot be decompressed "
                    f"({error or type(error).__name__}); copy the file again or export it again"
                ) from None


def open_tiff(path: Path, *, member: bool = False) -> TiffFrames | FileSet:
    """Open a TIFF movie."""
    data = map_file(path)
    try:
        with _unheard(), tifffile.TiffFile(path, **_PLAIN) as file:
            return _open(file, data, path, member)
    except DataError:
        data.close()
        raise
    except WHAT_LIBRARIES_RAISE as error:
        size = len(data)
        data.close()
        raise DataError(
            f"{path}: is truncated or damaged ({_first_line(error)}; it is {size} bytes long); "
            "copy it again or export it again"
        ) from None


@contextmanager
def open_frame_file(path: Path) -> Iterator[TiffFrames]:
    """Open a file that may hold a single frame, for a moment."""
    frames = cast(TiffFrames, open_tiff(path, member=True))  # a member is no set
    try:
        yield frames
    finally:
        frames.close()


def is_single_image(path: Path) -> bool:
    """Tell whether a file holds one image, and describes no set of files."""
    try:
        with _unheard(), tifffile.TiffFile(path, **_PLAIN) as file:
            page = file.pages[0]
            texts = [_text(tag.value) for tag in page.tags.getall(_DESCRIPTION, ())]
            joined = any(is_ome(text) and "FileName" in text for text in texts)
            return len(file.pages) == 1 and _planes(page) == 1 and not joined
    except WHAT_LIBRARIES_RAISE:  # whoever opens it says what is wrong with it
        return False


def first_texts(path: Path) -> tuple[str, ...]:
    """Read the descriptions of the first image alone."""
    with _unheard(), tifffile.TiffFile(path, **_PLAIN) as file:
        return tuple(_text(tag.value) for tag in file.pages[0].tags.getall(_DESCRIPTION, ()))


def _open(
    file: tifffile.TiffFile, data: mmap.mmap, path: Path, member: bool
) -> TiffFrames | FileSet:
    images = list(_images(file, data, path))
    refuse_volumes(file.pages[0], path)
    texts = images[0].texts
    ome_text = next((text for text in texts if is_ome(text)), None)
    notes: tuple[str, ...] = ()
    if member:
        order, n_frames, hints = list(range(len(images))), len(images), []
    elif ome_text is not None and (several := read_ome_set(ome_text, path)) is not None:
        data.close()
        return open_set(several, path, partial(open_tiff, member=True))
    elif ome_text is not None:
        ome = read_ome(ome_text, len(images), path)
        order = ome.order.tolist()
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
        notes = (*notes, out_of_order(found))
    first = file.pages[order[0]]
    dtype = pixel_type(first, path).newbyteorder(file.byteorder)
    refuse_differences(frames, path)
    if n_frames < 2 and not member:
        raise DataError(
            f"{path}: holds a single frame; a movie needs frames before and after a particle binds"
        )
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
    return TiffFrames(
        data,
        path,
        dtype=dtype,
        images=frames,
        n_frames=n_frames,
        metadata=merge(hints, path),
        notes=(*notes, *(note for hint in hints for note in hint.notes)),
        decode=first.decode,
    )


def _images(file: tifffile.TiffFile, data: mmap.mmap, path: Path) -> Iterator[Image]:
    """Read the images one by one, and refuse the file where tifffile would repair it."""
    seen: set[int] = set()
    following = values = long_values = 0
    image: Image | None = None
    pattern: Repetition | None = None
    for number in itertools.count():
        again = None
        if pattern is not None and following not in seen:
            again = pattern.find(data, following)
        if again is not None and image is not None:
            seen.add(following)
            start, following = again
            values += long_values
            refuse_overlap(values, data, path)
            yield replace(image, offsets=(start,), start=None if image.start is None else start)
            continue
        if number and not following:
            break
        try:
            page = file.pages[number]
        except IndexError:
            break
        if page.offset in seen:
            raise damaged(path, f"its list of frames runs in a circle after {number}")
        seen.add(page.offset)
        tags, following = _declared_tags(file.tiff, data, page.offset)
        if len(tags) != len(page.tags) and set(tags) & _ESSENTIAL - set(page.tags.keys()):
            raise damaged(path, f"the header of image {number} is truncated or cannot be read")
        long_values = sum(tag.valuebytecount for tag in page.tags if tag.count > _INLINE)
        values += long_values
        refuse_overlap(values, data, path)
        refuse_unread_pixels(page, len(data), path)
        image = Image(
            page.shape,
            page.dtype,
            page.hash,
            page.is_reduced,
            tuple(_text(tag.value) for tag in page.tags.getall(_DESCRIPTION, ())),
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


def _text(value: str | bytes) -> str:
    """Text of a description, which tifffile gives as bytes where it is not UTF-8."""
    text = value if isinstance(value, str) else value.decode("latin-1")
    return text.partition("\0")[0].strip()


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
def _unheard() -> Iterator[None]:
    """Keep log messages of tifffile off stderr, unless the program has set up logging."""
    logger, handler = logging.getLogger("tifffile"), logging.NullHandler()
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).splitlines()), "") or type(error).__name__
