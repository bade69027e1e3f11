"""TIFF movies: which images are the frames, and their pixels.

The directories are counted against every description in the file.  Never the other way round: a
movie that was written frame by frame carries a description of one frame in each directory, and a
reader that believes the first of them returns one frame of thousands.
"""

from __future__ import annotations

import mmap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tifffile
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.axes import time_axis
from iscat_analysis.movie.descriptions import (
    described_frames,
    imagej_hints,
    micro_manager_axes,
    micro_manager_hints,
    plain_hints,
)
from iscat_analysis.movie.directory import Directory, DirectoryReader, Layout
from iscat_analysis.movie.hints import Hints, merge
from iscat_analysis.movie.mapped import map_file, refuse_changed, release
from iscat_analysis.movie.ome import is_ome, read_ome
from iscat_analysis.records import StackMetadata

_LOSSLESS = {1, 5, 8, 32773, 32946, 34925, 50000}
"""No compression, LZW, Deflate, PackBits, old Deflate, LZMA, Zstandard."""

_BOMB_RATIO = 2000  # Deflate reaches 1032, on constant images only
_FRAME_BOMB_RATIO = 100  # of one frame, which is held in memory whole
_BOMB_BYTES = 64_000_000  # smaller than this, anything is harmless whatever its ratio


class TiffFrames:
    """The frames of a TIFF file; `open_tiff` makes it.

    Parameters
    ----------
    data : mmap
        The whole file.
    path : Path
        What messages call it.
    layout : Layout
        Common to all frames.
    byte_order : str
        ``"<"`` or ``">"``.
    frames : sequence of Directory
        One per frame, or a single one that the other frames' pixels follow.
    n_frames : int
        In the movie.
    metadata : StackMetadata
        What the file says of itself.
    """

    def __init__(
        self,
        data: mmap.mmap,
        path: Path,
        layout: Layout,
        *,
        byte_order: Literal["<", ">"],
        frames: Sequence[Directory],
        n_frames: int,
        metadata: StackMetadata,
    ) -> None:
        dtype = layout.dtype
        if dtype is None:
            raise DataError(
                f"{path}: its pixels are {layout.bits}-bit numbers of sample format "
                f"{layout.sample_format}; export it as 8-, 16- or 32-bit integers or as floats"
            )
        self._data = data
        self._path = path
        self._layout = layout
        self._dtype = dtype
        self._stored_dtype = dtype.newbyteorder(byte_order)
        self._frames = frames
        self._shape = (n_frames, layout.rows, layout.columns)
        self._metadata = metadata
        self._starts = self._find_starts(n_frames)
        self._decode: Callable[..., Any] | None = None
        if self._starts is None:
            self._decode = _decoder(path, frames[0].index)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self._shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored numbers, in native byte order."""
        return self._dtype

    @property
    def metadata(self) -> StackMetadata:
        """What the file says of itself."""
        return self._metadata

    @property
    def notes(self) -> tuple[str, ...]:
        """Nothing: what TIFF metadata say is taken as they say it."""
        return ()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Parameters
        ----------
        start, stop : int
            Half-open range inside the movie.

        Returns
        -------
        ndarray, shape (stop − start, y, x)
            A new array in native byte order [counts].

        Raises
        ------
        DataError
            The file has changed since it was opened, or its pixels cannot be decoded.
        """
        refuse_changed(self._path, self._data)
        block = np.empty((stop - start, *self._shape[1:]), dtype=self._dtype)
        if start == stop:
            return block
        if self._starts is None:
            for number, frame in enumerate(self._frames[start:stop]):
                self._decode_into(block[number], frame, start + number)
            return block
        starts = self._starts[start:stop]
        steps = np.diff(starts)
        if len(steps) and steps[0] > 0 and np.all(steps == steps[0]):
            block[:] = self._mapped(int(starts[0]), (int(steps[0]),), (stop - start,))
            release(self._data, int(starts[0]), int(starts[-1]))
        else:
            for number, first in enumerate(starts):
                block[number] = self._mapped(int(first), (), ())
        return block

    def close(self) -> None:
        """Release the file."""
        self._data.close()

    def _mapped(
        self, first: int, frame_strides: tuple[int, ...], frames: tuple[int, ...]
    ) -> NDArray[Any]:
        """View the mapped bytes as frames; never handed out, so that the file can be closed."""
        _, y, x = self._shape
        size = self._dtype.itemsize
        return np.ndarray(
            (*frames, y, x),
            self._stored_dtype,
            buffer=self._data,
            offset=first,
            strides=(*frame_strides, x * size, size),
        )

    def _find_starts(self, n_frames: int) -> NDArray[np.int64] | None:
        """First byte of every frame, where all of them lie in the file as they are."""
        starts = [start for frame in self._frames if (start := frame.start) is not None]
        size = self._layout.frame_bytes
        if len(starts) < len(self._frames):
            return None
        followers = n_frames - len(starts)  # frames without a directory of their own
        end = max(starts) + size * (1 + followers)
        if end > len(self._data):
            raise DataError(
                f"{self._path}: is truncated (its {n_frames} frames should reach byte {end} of "
                f"{len(self._data)}); copy it again or export it again"
            )
        if followers:
            return starts[0] + size * np.arange(n_frames, dtype=np.int64)
        return np.array(starts, dtype=np.int64)

    def _decode_into(self, image: NDArray[Any], frame: Directory, number: int) -> None:
        rows, columns = image.shape
        decode = self._decode
        if decode is None:
            raise DataError(f"{self._path}: frame {number} has no decoder")
        pairs = zip(frame.offsets.tolist(), frame.byte_counts.tolist(), strict=True)
        for segment, (offset, count) in enumerate(pairs):
            try:
                pixels, place, _ = decode(self._data[offset : offset + count], segment)
                top, left = place[2], place[3]
                tile = pixels[0, : rows - top, : columns - left, 0]
                image[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
            except (ValueError, TypeError, IndexError, RuntimeError, MemoryError) as error:
                raise DataError(
                    f"{self._path}: the pixels of frame {number} cannot be decompressed "
                    f"({error or type(error).__name__}); copy the file again or export it again"
                ) from None


def open_tiff(path: Path) -> TiffFrames:
    """Open a TIFF movie.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    TiffFrames
        Every frame of it.

    Raises
    ------
    DataError
        It is not a movie, is cut short, or contradicts its own description.
    """
    data = map_file(path)
    try:
        return _open_mapped(data, path)
    except BaseException:
        data.close()
        raise


def _open_mapped(data: mmap.mmap, path: Path) -> TiffFrames:
    reader = DirectoryReader(data, path)
    directories = reader.directories()
    _check_kind(directories[0].layout, path)
    texts = [reader.text(extent) for extent in directories[0].descriptions]
    hints: list[Hints] = []

    ome_text = next((text for text in texts if is_ome(text)), None)
    if ome_text is not None:
        ome = read_ome(ome_text, len(directories), path)
        frames = [directories[index] for index in ome.order]
        n_frames = len(frames)
        hints.append(ome.hints)
    else:
        frames = _without_thumbnails(directories)
        n_frames = _count_frames(reader, frames, path)
    layout = _common_layout(frames, path)
    if n_frames < 2:
        raise DataError(
            f"{path}: holds a single frame; a movie needs frames before and after a particle binds"
        )

    total = n_frames * layout.frame_bytes
    if frames[0].start is None and total > max(_BOMB_BYTES, _BOMB_RATIO * len(data)):
        raise DataError(
            f"{path}: would grow from {len(data)} to {total} bytes, which no recording does; "
            "the file is damaged, export it again"
        )

    hints += _micro_manager(reader, frames, path, check_axes=ome_text is None)
    resolution = directories[0].resolution
    hints += [imagej_hints(text, resolution) for text in texts if text.startswith("ImageJ=")]
    hints.append(plain_hints(resolution))
    return TiffFrames(
        data,
        path,
        layout,
        byte_order=reader.byte_order,
        frames=frames,
        n_frames=n_frames,
        metadata=merge(hints, path),
    )


def _check_kind(layout: Layout, path: Path) -> None:
    if layout.samples > 1:
        raise DataError(
            f"{path}: holds colour images ({layout.samples} samples per pixel); "
            "export the camera's grey values"
        )
    if layout.depth > 1:
        raise DataError(
            f"{path}: holds volumes ({layout.depth} planes per image); export one plane per frame"
        )
    if layout.compression not in _LOSSLESS:
        name = tifffile.COMPRESSION(layout.compression).name if _known(layout) else "unknown"
        raise DataError(
            f"{path}: its compression ({name}, number {layout.compression}) is not supported; "
            "save it uncompressed or with Deflate"
        )


def _known(layout: Layout) -> bool:
    return layout.compression in tifffile.COMPRESSION.__members__.values()


def _without_thumbnails(directories: list[Directory]) -> list[Directory]:
    full = [directory for directory in directories if not directory.reduced]
    return full or directories


def _common_layout(frames: Sequence[Directory], path: Path) -> Layout:
    layout = frames[0].layout
    for number, frame in enumerate(frames):
        if frame.layout != layout:
            what = (
                f"{frame.layout} but the first is {layout}"
                if str(frame.layout) != str(layout)
                else "stored in another way than the first"
            )
            raise DataError(
                f"{path}: its frames differ: image {number} is {what}; "
                "export the frames of one movie to a file of their own"
            )
        stored = int(frame.byte_counts.sum())
        if layout.frame_bytes > max(_BOMB_BYTES, _FRAME_BOMB_RATIO * stored):
            raise DataError(
                f"{path}: image {number} would grow from {stored} to {layout.frame_bytes} bytes, "
                "which no recording does; the file is damaged, export it again"
            )
    return layout


def _count_frames(reader: DirectoryReader, frames: list[Directory], path: Path) -> int:
    """Set what the file holds against every description in it; the larger number must be true."""
    announced = 0
    truncated = False
    for frame in frames:
        for extent in frame.descriptions:
            found = described_frames(
                reader.text(extent), frame.layout.rows, frame.layout.columns, path
            )
            if found is not None:
                announced += found.frames
                truncated |= found.one_directory
                break
    if announced <= len(frames):
        return len(frames)
    if len(frames) == 1 and truncated and frames[0].start is not None:
        return announced
    raise DataError(
        f"{path}: describes {announced} frames but holds {len(frames)}; "
        "the recording or the copy was interrupted: export it again"
    )


def _micro_manager(
    reader: DirectoryReader, frames: list[Directory], path: Path, *, check_axes: bool
) -> list[Hints]:
    first, last = frames[0].micro_manager, frames[-1].micro_manager
    if first is None:
        return []
    try:
        with path.open("rb") as file:
            found = tifffile.read_micromanager_metadata(file, {"Summary"}).get("Summary")
    except (ValueError, OSError, RecursionError):  # older or edited: the frames still tell
        found = None
    summary = found if isinstance(found, dict) else {}
    if check_axes:
        time_axis(micro_manager_axes(summary), path)
    texts = [reader.text(extent) if extent else "" for extent in (first, last)]
    return [micro_manager_hints(texts[0], texts[1], len(frames), summary)]


def _decoder(path: Path, index: int) -> Callable[..., Any]:
    """Borrow tifffile's decoder of one image; all frames share its layout."""
    try:
        with tifffile.TiffFile(path) as file:
            decode: Callable[..., Any] = file.pages[index].decode
    except (ValueError, TypeError, IndexError, KeyError, OSError) as error:
        raise DataError(
            f"{path}: its first frame cannot be decoded ({error}); export it again"
        ) from None
    return decode
