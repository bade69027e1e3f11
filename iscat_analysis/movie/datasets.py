"""Movies in HDF5 files: Refeyn's, and any dataset of frames that is named or alone there.

Refeyn ``.mp`` movies: HDF5, plain or as differences from frame to frame.

The layouts are not published; they are read as other open software found them.  OneMP: dataset
``frame`` with ``configuration/Devices/AcqCam``; TwoMP, format 3: ``movie/frame`` with
``movie/configuration/acq_camera``; between the two lies a format 3 with OneMP's names.
In a compressed movie frame 0 is plain and every later one is what must be added, modulo the range
of the type, to the one before; ``movie/keyframe`` repeats some frames in full: those that its
attribute ``indices`` names, or else the last one at its end.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.containers import name_one
from iscat_analysis.movie.descriptions import Hints, merge
from iscat_analysis.movie.hdf5 import Hdf5Reader, StoredArray
from iscat_analysis.movie.mapped import (
    HARMLESS_BYTES,
    MOST_FRAME_DECODED_RATIO,
    Writer,
    refuse_changed,
)
from iscat_analysis.movie.side_files import positive
from iscat_analysis.movie.stack import Frames
from iscat_analysis.records import StackMetadata
from iscat_analysis.units import listed

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
        metadata: StackMetadata | None = None,
        notes: tuple[str, ...] = (),
        *,
        by_columns: bool = False,
    ) -> None:
        self._stored, self._data, self._by_columns = stored, reader.data, by_columns
        y, x = stored.shape[:-3:-1] if by_columns else stored.shape[-2:]
        self.shape = (stored.shape[0], y, x)
        self.dtype = stored.dtype
        self.metadata, self.notes = metadata or StackMetadata(), notes

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
