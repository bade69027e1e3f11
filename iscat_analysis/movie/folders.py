"""Which files hold a movie, and which movies a folder holds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import split_address
from iscat_analysis.movie.mapped import WHAT_LIBRARIES_RAISE, Writer, writer_of
from iscat_analysis.movie.mapped_frames import NPY_SIGNATURE, open_npy
from iscat_analysis.movie.ome import files_of_set, is_ome
from iscat_analysis.movie.recorded import SUFFIXES as RECORDED
from iscat_analysis.movie.recorded import description_of, recorded_files
from iscat_analysis.movie.stack import Frames
from iscat_analysis.movie.tiff import first_texts, open_tiff
from iscat_analysis.reading import is_file

_TIFF = (".tif", ".tiff", ".btf", ".tf8", ".stk")
_HDF5 = (".h5", ".hdf5")
_ZARR = ".zarr"
_REFEYN = ".mp"


class Format(NamedTuple):
    """A file format: its first bytes, its suffixes and the function that opens it."""

    signatures: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    open: Callable[[Path], Frames]


FORMATS = (
    Format((b"II\x2a\x00", b"MM\x00\x2a", b"II\x2b\x00", b"MM\x00\x2b"), _TIFF, open_tiff),
    Format((NPY_SIGNATURE[:4],), (".npy",), open_npy),
)

SUFFIXES = (
    *(suffix for kind in FORMATS for suffix in kind.suffixes), _REFEYN, *_HDF5, _ZARR, *RECORDED,
)  # fmt: skip
"""Files and folders that are taken for movies where a folder is searched for them; files of plain
numbers only where something describes them."""

_SNAPSHOT = "_snapshot"  # single frames, which have settings as well
_REMEMBERED = 4096  # files that were looked into


def files_of(address: Path) -> tuple[Path, ...]:
    """Give the files that hold a movie, without opening it."""
    path, _ = split_address(address)
    if path.is_dir():
        return tuple(sorted(file for file in path.rglob("*") if file.is_file()))
    return members_of(address)


def is_open_to_write(address: Path) -> bool:
    """Tell whether a program records a movie, and lets others read it: see `writer_of`."""
    return any(writer_of(file) is Writer.WITH_READERS for file in files_of(address))


def members_of(address: Path) -> tuple[Path, ...]:
    """Give the files of a set, or the file or folder itself, which tell one movie from another."""
    path, part = split_address(address)
    if path.suffix.lower() in _TIFF and is_file(path):
        names = _described(path, *_state(path))
        if len(names) > 1:
            members = dict.fromkeys(path.with_name(name) if name else path for name in names)
            return tuple(file for file in {**members, path: None} if is_file(file))
    return (path,) if part else recorded_files(path)


def _state(path: Path) -> tuple[int, int]:
    """Size and modification time of a file, which tell it from earlier versions."""
    try:
        state = path.stat()
    except OSError:
        return 0, 0
    return state.st_size, state.st_mtime_ns


@lru_cache(maxsize=_REMEMBERED)
def _described(path: Path, size: int, changed_ns: int) -> tuple[str, ...]:
    """Name the files of the set that a file describes."""
    del size, changed_ns
    try:
        text = next((text for text in first_texts(path) if is_ome(text)), "")
        return files_of_set(text, path) if "FileName" in text else ()
    except (DataError, *WHAT_LIBRARIES_RAISE):  # whoever opens it says what is wrong with it
        return ()


@lru_cache(maxsize=_REMEMBERED)
def _holds_one(path: Path, size: int, changed_ns: int) -> bool:
    del size, changed_ns
    from iscat_analysis.movie.datasets import is_one_movie  # h5py takes long

    return is_one_movie(path)


def find_movies(folder: Path, *, but: Collection[Path] = ()) -> list[Path]:
    """List the movies of a folder by their names.

    A set of files is one movie, under the name of the first file that describes it, and an HDF5
    file is one if it holds a single dataset of frames.
    """
    found = [path for path in sorted(folder.iterdir()) if path not in but and _is_movie(path)]
    return list(_once(found))


def is_movie(address: Path) -> bool:
    """Tell whether an address names a movie, and not a folder that may hold some.

    What is not there yet is a movie if its name ends as that of one.
    """
    path, part = split_address(address)
    suffix = path.suffix.lower()
    named = suffix == _ZARR or (suffix in SUFFIXES and not path.is_dir())
    return bool(part) or named or path.is_file()


def _is_movie(path: Path) -> bool:
    suffix = path.suffix.lower()
    if path.name.startswith(".") or suffix not in SUFFIXES:
        return False
    if suffix == _ZARR:
        return path.is_dir()
    if suffix in RECORDED:
        return description_of(path) is not None and not path.stem.endswith(_SNAPSHOT)
    return path.is_file() and (suffix not in _HDF5 or _holds_one(path, *_state(path)))


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
