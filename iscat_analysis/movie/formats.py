"""The formats of movies: how each is told and opened, and which movies a folder holds.

`FORMATS` is the one list: `open_stack`, `iscat batch` and the app take from it what a movie is.

Movies in the files of Nikon and Zeiss, which packages of the field read: nd2 and pylibCZIrw.

Where frames were not written, both give zeros; a frame without any light is refused here.
"""

from __future__ import annotations

import math
import threading
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.files import refuse_changed, states_of
from iscat_analysis.movie.addresses import MARK, split_address
from iscat_analysis.movie.arrays import (
    NPY_SIGNATURE,
    arrays_of_mat,
    arrays_of_npz,
    description_of,
    holds_one,
    is_matlab_hdf5,
    open_member,
    open_npy,
    open_raw,
    open_recorded,
    recorded_files,
)
from iscat_analysis.movie.arrays import SUFFIXES as RECORDED
from iscat_analysis.movie.descriptions import (
    TIME_FROM_HEIGHTS,
    Hints,
    inverse,
    measure_clock,
    merge,
    positive,
    time_axis,
    with_side_files,
)
from iscat_analysis.movie.mapped import HDF5_SIGNATURE, Writer, damaged, refuse_growth, writer_of
from iscat_analysis.movie.stack import Frames, Stack, single_frame
from iscat_analysis.movie.tiff import (
    TIFF_SUFFIXES,
    FrameFiles,
    files_described,
    frames_in,
    holds_single_frames,
    open_tiff,
)
from iscat_analysis.reading import is_file, open_regular
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
        refuse_growth(math.prod(shape) * dtype.itemsize, path.stat().st_size, f"{path}: it")
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


class Format(NamedTuple):
    """A format of movies.

    Attributes
    ----------
    title : str
        What messages call it.
    suffixes : tuple of str
        Endings of files and folders that are taken for movies where a folder is searched for them.
    detects : callable
        Whether a file is one of these, by its path and its first eight bytes; a folder by its path.
    open : callable
        Opens a path; the text behind `MARK` names one of several movies in a file.
    holds_one : callable
        Whether a path, found by its ending where a folder is searched, is one movie.
    has_parts : bool
        Whether a file has room for several movies under names.
    """

    title: str
    suffixes: tuple[str, ...]
    detects: Callable[[Path, bytes], bool]
    open: Callable[[Path, str], Frames]
    holds_one: Callable[[Path], bool] = Path.is_file
    has_parts: bool = False


def is_zarr(path: Path) -> bool:
    """Tell whether a folder is one of Zarr's."""
    return any(is_file(path / mark) for mark in ("zarr.json", ".zgroup", ".zarray"))


def _open_zarr(folder: Path, part: str) -> Frames:
    needed_package("zarr", "zarr", "Zarr", folder)
    from iscat_analysis.movie.ome_zarr import open_zarr

    return open_zarr(folder, part)


def _open_hdf5(path: Path, part: str, *, by_columns: bool = False) -> Frames:
    from iscat_analysis.movie.hdf5 import open_hdf5  # h5py takes long

    return open_hdf5(path, part, by_columns=by_columns)


def _one_dataset(path: Path) -> bool:
    from iscat_analysis.movie.hdf5 import is_one_movie

    return is_one_movie(path)


def _open_matlab(path: Path, part: str) -> Frames:
    if is_matlab_hdf5(path):
        return _open_hdf5(path, part, by_columns=True)
    return open_member(path, part, read=arrays_of_mat, kind="a MATLAB file")


def _one_variable(path: Path) -> bool:
    return _one_dataset(path) if is_matlab_hdf5(path) else holds_one(path, read=arrays_of_mat)


def _is_recording(path: Path) -> bool:
    """Tell whether something describes plain numbers, which are no single frame with settings."""
    return description_of(path) is not None and not path.stem.endswith("_snapshot")


def _begins(*signatures: bytes) -> Callable[[Path, bytes], bool]:
    return lambda _, head: head.startswith(signatures)


FORMATS = (
    Format(
        "a TIFF file", TIFF_SUFFIXES,
        _begins(b"II\x2a\x00", b"MM\x00\x2a", b"II\x2b\x00", b"MM\x00\x2b"),
        lambda path, _: open_tiff(path),
    ),
    Format(
        "a folder of TIFF files with a frame each", (),
        lambda path, _: holds_single_frames(path, named=True), lambda path, _: FrameFiles(path),
    ),
    Format(
        "a Refeyn .mp movie, HDF5", (".mp", ".h5", ".hdf5"), _begins(HDF5_SIGNATURE[:4]),
        _open_hdf5, _one_dataset, has_parts=True,
    ),
    Format("Zarr", (".zarr",), lambda path, _: is_zarr(path), _open_zarr, has_parts=True),
    Format("NumPy", (".npy",), _begins(NPY_SIGNATURE[:4]), lambda path, _: open_npy(path)),
    Format(
        "an archive of NumPy's", (".npz",), _begins(b"PK\x03\x04"),
        partial(open_member, read=arrays_of_npz, kind="a ZIP archive"),
        partial(holds_one, read=arrays_of_npz), has_parts=True,
    ),
    Format("MATLAB", (".mat",), _begins(b"MATL"), _open_matlab, _one_variable, has_parts=True),
    Format("ND2", (".nd2",), _begins(b"\xda\xce\xbe\x0a"), open_nd2),
    Format("CZI", (".czi",), _begins(b"ZISR"), open_czi),
    Format(
        "numbers that a text beside them or their name describes", RECORDED,
        lambda path, _: description_of(path) is not None, lambda path, _: open_recorded(path),
        _is_recording,
    ),
)  # fmt: skip
"""All formats; the first that detects a path opens it."""

_EXPORT = "export the movie as TIFF"
_LOSSY = f"which keeps no counts: its compression leaves out what the eye does not see; {_EXPORT}"


def _refused(path: Path, _: str, *, what: str) -> NoReturn:
    raise DataError(f"{path}: {_needed()} but is {what}")


FOREIGN = tuple(
    Format(what, (), detects, partial(_refused, what=what))
    for what, detects in (
        (f"a PNG picture; {_EXPORT}", _begins(b"\x89PNG")),
        (f"a JPEG picture; {_EXPORT}", _begins(b"\xff\xd8\xff")),
        ("a gzip archive; unpack it", _begins(b"\x1f\x8b")),
        (f"an AVI film, {_LOSSY}", _begins(b"RIFF")),
        (f"a Matroska film, {_LOSSY}", _begins(b"\x1aE\xdf\xa3")),
        (f"a film, {_LOSSY}", lambda _, head: head[4:] == b"ftyp"),  # MP4 and QuickTime
        (f"a FITS file; {_EXPORT}", _begins(b"SIMPLE")),
    )
)
"""Files that are known and hold no counts that can be read here."""

SUFFIXES = tuple(dict.fromkeys(suffix for kind in FORMATS for suffix in kind.suffixes))
"""Endings of files and folders that are taken for movies where a folder is searched for them."""


def _needed() -> str:
    titles = [kind.title for kind in FORMATS]
    return f"needs to be {', '.join(titles[:-1])} or {titles[-1]}"


def open_file(address: Path) -> Stack:
    """Open a movie in a file or a folder, without reading its pixels."""
    try:
        path, part = split_address(address)
        folder = path.is_dir()
        pipe = path.exists() and not (folder or path.is_file())  # or a device
    except OSError as error:  # nobody may look into the folder that it is in
        raise DataError(f"{address}: cannot be read ({error.strerror})") from None
    before = states_of([path])
    if pipe:  # which would keep whoever opens it waiting
        raise DataError(
            f"{path}: is a pipe or a device, and a movie is read more than once: save it as a "
            "file, and give its path"
        )
    head = b"" if folder else _head(path)
    kind = next((kind for kind in (*FORMATS, *FOREIGN) if kind.detects(path, head)), None)
    if part and not folder and not (kind is not None and kind.has_parts):
        frames: Frames = open_raw(path, part)
    elif kind is not None:
        frames = kind.open(path, part)
    elif folder:
        raise DataError(
            f"{path}: is a folder, but not one of TIFF files with a frame each, nor of Zarr; give "
            "the path of one movie file; all movies of a folder are analysed by `iscat batch`"
        )
    else:
        raise DataError(
            f"{path}: {_needed()} but is not one; {_EXPORT} or, if it is plain numbers, say so, "
            f'as in "{path}{MARK}1500x128x128,uint16"'
        )
    if frames.shape[0] < 2:
        frames.close()
        raise single_frame(path)
    files = getattr(frames, "files", files_of(path) if folder else None)
    known = with_side_files(frames.metadata, path)
    stack = Stack(path, frames, part=part, files=files, metadata=known)
    try:
        refuse_changed([path], before)
    except DataError:
        stack.close()
        raise
    return stack


def _head(path: Path) -> bytes:
    """Read the first bytes of a file, by which its format is told."""
    try:
        with open_regular(path) as file:
            head: bytes = file.read(8)
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file; check the path") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    if not head:
        raise DataError(f"{path}: is empty (0 bytes); copy it again or export it again")
    return head


def files_of(address: Path) -> tuple[Path, ...]:
    """Give the files that hold a movie, without opening it."""
    path, _ = split_address(address)
    if path.is_dir():
        inside = sorted(file for file in path.rglob("*") if file.is_file())
        return tuple(inside) if is_zarr(path) else frames_in(path) or tuple(inside)
    return members_of(address)


def is_open_to_write(address: Path) -> bool:
    """Tell whether a program records a movie, and lets others read it: see `writer_of`."""
    return any(writer_of(file) is Writer.WITH_READERS for file in files_of(address))


def members_of(address: Path) -> tuple[Path, ...]:
    """Give the files of a set, or the file or folder itself, which tell one movie from another."""
    path, part = split_address(address)
    if path.suffix.lower() in TIFF_SUFFIXES and is_file(path):
        names = _described(path, states_of([path]))
        if len(names) > 1:
            members = dict.fromkeys(path.with_name(name) if name else path for name in names)
            return tuple(file for file in {**members, path: None} if is_file(file))
    return (path,) if part else recorded_files(path)


@lru_cache(maxsize=4096)
def _described(path: Path, _: tuple[tuple[int, ...], ...]) -> tuple[str, ...]:
    """Name the files of the set that a file describes, in its present state."""
    return files_described(path)


@lru_cache(maxsize=4096)
def _holds_one(path: Path, _: tuple[tuple[int, ...], ...]) -> bool:
    return next(kind for kind in FORMATS if path.suffix.lower() in kind.suffixes).holds_one(path)


def find_movies(folder: Path, *, but: Collection[Path] = ()) -> list[Path]:
    """List the movies of a folder by their names.

    A set of files is one movie, under the name of the first file that describes it; a folder is
    one if it holds frames in a file each; and a file with room for several if it holds only one.
    """
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    movies = [path for path in inside if path not in but and is_named_as_movie(path)]
    return _once(
        [p for p in movies if p.is_dir() or (p.is_file() and _holds_one(p, states_of([p])))]
    )


def is_named_as_movie(path: Path) -> bool:
    """Tell by the ending of a file, and by the names in a folder, whether it may be a movie."""
    suffix = path.suffix.lower()
    if path.is_dir():
        return suffix == ".zarr" or holds_single_frames(path)
    return suffix in SUFFIXES


def is_movie_folder(folder: Path) -> bool:
    """Tell whether a folder is a movie for whoever names it as one."""
    zarr = folder.suffix.lower() == ".zarr" or is_zarr(folder)
    return zarr or holds_single_frames(folder, named=True)


def is_movie(address: Path) -> bool:
    """Tell whether an address names a movie, and not a folder that may hold some.

    What is not there yet is a movie if its name ends as that of one.
    """
    path, part = split_address(address)
    return bool(part) or is_named_as_movie(path) or path.is_file()


def _once(paths: Sequence[Path]) -> list[Path]:
    """Keep one file of every set."""
    sets = {path: frozenset(files) for path in paths if len(files := members_of(path)) > 1}
    named: set[frozenset[Path]] = set()
    kept = []
    for path in paths:
        mine = [files for files in sets.values() if path in files]
        if mine and (sets.get(path) is None or sets[path] in named):
            continue
        named.update(mine)
        kept.append(path)
    return kept
