"""Movies in the files of Nikon and Zeiss, which packages of the field read: nd2 and pylibCZIrw.

Where frames were not written, both give zeros; a frame without any light is refused here.
"""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.movie.descriptions import (
    TIME_FROM_HEIGHTS,
    Hints,
    inverse,
    measure_clock,
    merge,
    positive,
    time_axis,
)
from iscat_analysis.movie.mapped import damaged, refuse_growth
from iscat_analysis.records import StackMetadata

_CZI_TYPES = {"Gray8": "u1", "Gray16": "u2", "Gray32": "u4", "Gray32Float": "f4"}


class ReaderFrames:
    """Frames that a package reads one by one; `open_nd2` and `open_czi` make it."""

    def __init__(
        self,
        path: Path,
        shape: tuple[int, int, int],
        dtype: np.dtype[Any],
        hints: Hints,
        *,
        axis: str,
        frame: Callable[[int], NDArray[Any]],
        close: Callable[[], None],
    ) -> None:
        if min(shape) < 1 or shape[0] < 2:
            raise DataError(
                f"{path}: holds {shape[0]} frame of {shape[1]} x {shape[2]} pixels; a movie needs "
                "frames before and after a particle binds"
            )
        size = math.prod(shape) * dtype.itemsize
        refuse_growth(size, path.stat().st_size, f"{path}: it")
        self._path, self._frame, self._close = path, frame, close
        self.shape, self.dtype = shape, dtype.newbyteorder("=")
        self.metadata = merge([hints], path)
        self.notes = (TIME_FROM_HEIGHTS,) if axis == "Z" else ()
        self._lock = threading.Lock()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        with self._lock, _believing_nothing(self._path, "its frames cannot be read"):
            for number in range(start, stop):
                block[number - start] = self._frame(number).reshape(self.shape[1:])
                if not block[number - start].any():
                    raise DataError(
                        f"{self._path}: frame {number} holds nothing but zeros, as where it was "
                        "not written; the recording or the copy was interrupted: export it again"
                    )
        return block

    def close(self) -> None:
        """Release the file."""
        self._close()


def open_nd2(path: Path, _: str = "") -> ReaderFrames:
    """Open a file of Nikon's."""
    nd2 = needed_package("nd2", "nd2", "Nikon ND2 files", path)
    with _believing_nothing(path, "it is no ND2 file, or damaged"), ExitStack() as opened:
        file = nd2.ND2File(str(path))
        opened.callback(file.close)
        sizes = dict(file.sizes)
        y, x = sizes.pop("Y"), sizes.pop("X")
        axis = time_axis(sizes, path) or "T"
        n_frames, said = sizes.get(axis, 1), file.attributes
        if said.sequenceCount < n_frames:
            raise DataError(
                f"{path}: describes {n_frames} frames but holds {said.sequenceCount}; the "
                "recording was interrupted: export those that are there"
            )
        if said.compressionType == "lossy":
            raise DataError(f"{path}: its lossy compression keeps no counts; record without it")
        hints = _if_readable(lambda: _nd2_hints(file, n_frames))
        shape, dtype = (n_frames, y, x), np.dtype(file.dtype)
        frames = ReaderFrames(
            path, shape, dtype, hints, axis=axis, frame=file.read_frame, close=file.close
        )
        opened.pop_all()
        return frames


def open_czi(path: Path, _: str = "") -> ReaderFrames:
    """Open a file of Zeiss'."""
    czi = needed_package("pylibCZIrw.czi", "czi", "Zeiss CZI files", path)
    with _believing_nothing(path, "it is no CZI file, or damaged"), ExitStack() as opened:
        file = czi.CziReader(str(path))
        opened.callback(file.close)
        ranges = {axis: last - first for axis, (first, last) in file.total_bounding_box.items()}
        y, x = ranges.pop("Y"), ranges.pop("X")
        ranges["scene"] = max(len(file.scenes_bounding_rectangle), 1)
        axis = time_axis(ranges, path) or "T"
        kinds = set(file.pixel_types.values())
        if not kinds <= set(_CZI_TYPES) or len(kinds) != 1:
            raise DataError(
                f"{path}: holds pixels of type {', '.join(sorted(kinds)) or 'unknown'}; export "
                "the camera's grey values"
            )
        hints = _if_readable(lambda: _czi_hints(file))
        shape, dtype = (ranges[axis], y, x), np.dtype(_CZI_TYPES[kinds.pop()])

        def frame(number: int) -> NDArray[Any]:
            return np.asarray(file.read(plane={axis: number}))

        frames = ReaderFrames(path, shape, dtype, hints, axis=axis, frame=frame, close=file.close)
        opened.pop_all()
        return frames


def _nd2_hints(file: Any, n_frames: int) -> Hints:
    """Read pixel size, lens and the times of all frames."""
    times = file.events(orient="list").get("Time [s]", ())
    seconds = {k: time for k, time in enumerate(times) if math.isfinite(time)}
    rate, ticks = measure_clock(seconds if len(times) == n_frames else {})  # of nothing but frames
    voxel, lens = file.voxel_size(), _of(file.metadata, "channels", 0, "microscope")
    known = StackMetadata(
        positive(voxel.x, 1e3), frame_rate_hz=rate, ticks=ticks, source="nd2",
        na=positive(_of(lens, "objectiveNumericalAperture")),
        magnification=positive(_of(lens, "objectiveMagnification")),
    )  # fmt: skip
    return Hints(known, positive(voxel.y, 1e3))


def _czi_hints(file: Any) -> Hints:
    """Read pixel size, lens and interval from the XML of a file."""
    said = file.metadata["ImageDocument"]["Metadata"]
    scaling = _of(said, "Scaling", "Items", "Distance") or ()
    metres = {each.get("@Id"): each.get("Value") for each in scaling}
    positions = _of(said, "Information", "Image", "Dimensions", "T", "Positions")
    lens = _of(said, "Information", "Instrument", "Objectives", "Objective")
    known = StackMetadata(
        positive(metres.get("X"), 1e9), source="czi", na=positive(_of(lens, "LensNA")),
        frame_rate_hz=inverse(positive(_of(positions, "Interval", "Increment"))),
        magnification=positive(_of(lens, "NominalMagnification")),
    )  # fmt: skip
    return Hints(known, positive(metres.get("Y"), 1e9))


def _if_readable(read: Callable[[], Hints]) -> Hints:
    """Do without metadata that a package cannot read."""
    try:
        return read()
    except Exception:
        return Hints(StackMetadata())


def needed_package(name: str, extra: str, what: str, path: Path) -> Any:
    """Import a package that few need, or say how to install it."""
    try:
        return import_module(name)
    except ImportError:
        raise DataError(
            f"{path}: reading {what} takes the package {name.partition('.')[0]}, which is not "
            f'installed; install it with: pip install "iscat-analysis[{extra}]"'
        ) from None


def _of(value: Any, *steps: str | int) -> Any:
    """Follow keys, indices and attributes; None where one of them is not there."""
    for step in steps:
        try:
            inside = isinstance(value, Mapping) or isinstance(step, int)
            value = value[step] if inside else getattr(value, str(step))
        except (LookupError, AttributeError, TypeError):
            return None
    return value


@contextmanager
def _believing_nothing(path: Path, what: str) -> Iterator[None]:
    """Turn whatever a package raises into one line, and what it warns of into nothing."""
    with damaged(f"{path}: {what}", Exception), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
