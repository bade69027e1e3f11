"""Which files hold a movie, and which movies a folder holds."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import split_address
from iscat_analysis.movie.containers import holds_one, open_member
from iscat_analysis.movie.frame_files import frames_in, holds_single_frames
from iscat_analysis.movie.mapped import HDF5_SIGNATURE, WHAT_LIBRARIES_RAISE, Writer, writer_of
from iscat_analysis.movie.mapped_frames import NPY_SIGNATURE, open_npy
from iscat_analysis.movie.matlab import arrays_of_mat, is_matlab_hdf5
from iscat_analysis.movie.microscopes import open_czi, open_nd2
from iscat_analysis.movie.npz import arrays_of_npz
from iscat_analysis.movie.ome import files_of_set, is_ome
from iscat_analysis.movie.ome_zarr import is_zarr
from iscat_analysis.movie.recorded import SUFFIXES as RECORDED
from iscat_analysis.movie.recorded import description_of, recorded_files
from iscat_analysis.movie.stack import Frames
from iscat_analysis.movie.tiff import TIFF_SUFFIXES, first_texts, open_tiff
from iscat_analysis.reading import is_file


class Format(NamedTuple):
    """A file format: its first four bytes, its suffixes, and the function that opens it.

    `holds_one` tells whether a file is one movie, of a format that has room for several; `open` is
    then given the name of one, else an empty text.
    """

    signatures: tuple[bytes, ...]
    suffixes: tuple[str, ...]
    open: Callable[[Path, str], Frames]
    holds_one: Callable[[Path], bool] | None = None


def _tiff(path: Path, _: str) -> Frames:
    return open_tiff(path)


def _npy(path: Path, _: str) -> Frames:
    return open_npy(path)


def _hdf5(path: Path, part: str) -> Frames:
    from iscat_analysis.movie.datasets import open_hdf5  # h5py takes long

    return open_hdf5(path, part)


def _one_dataset(path: Path) -> bool:
    from iscat_analysis.movie.datasets import is_one_movie

    return is_one_movie(path)


def _matlab(path: Path, part: str) -> Frames:
    if not is_matlab_hdf5(path):
        return open_member(path, part, read=arrays_of_mat, kind="a MATLAB file")
    from iscat_analysis.movie.datasets import open_hdf5

    return open_hdf5(path, part, by_columns=True)


def _one_variable(path: Path) -> bool:
    return _one_dataset(path) if is_matlab_hdf5(path) else holds_one(path, read=arrays_of_mat)


FORMATS = (
    Format((b"II\x2a\x00", b"MM\x00\x2a", b"II\x2b\x00", b"MM\x00\x2b"), TIFF_SUFFIXES, _tiff),
    Format((NPY_SIGNATURE[:4],), (".npy",), _npy),
    Format(
        (b"PK\x03\x04",),
        (".npz",),
        partial(open_member, read=arrays_of_npz, kind="a ZIP archive"),
        partial(holds_one, read=arrays_of_npz),
    ),
    Format((HDF5_SIGNATURE[:4],), (".mp", ".h5", ".hdf5"), _hdf5, _one_dataset),
    Format((b"MATL",), (".mat",), _matlab, _one_variable),
    Format((b"\xda\xce\xbe\x0a",), (".nd2",), open_nd2),
    Format((b"ZISR",), (".czi",), open_czi),
)
"""Files that are told by how they begin.  Folders, and numbers that something else describes, are
told by `_opened` of `iscat_analysis.movie`."""

_OF_SUFFIX = {suffix: kind for kind in FORMATS for suffix in kind.suffixes}
_ZARR = ".zarr"
SUFFIXES = (*_OF_SUFFIX, _ZARR, *RECORDED)
"""Files and folders that are taken for movies where a folder is searched for them; files of plain
numbers only where something describes them."""

_SNAPSHOT = "_snapshot"  # single frames, which have settings as well
_REMEMBERED = 4096  # files that were looked into


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
    kind = _OF_SUFFIX.get(path.suffix.lower())
    return kind is None or kind.holds_one is None or kind.holds_one(path)


def find_movies(folder: Path, *, but: Collection[Path] = ()) -> list[Path]:
    """List the movies of a folder by their names.

    A set of files is one movie, under the name of the first file that describes it; a folder is
    one if it holds frames in a file each; and a file with room for several if it holds only one.
    """
    found = [path for path in sorted(folder.iterdir()) if path not in but and _is_movie(path)]
    return list(_once(found))


def is_movie_folder(folder: Path) -> bool:
    """Tell whether a folder is a movie for whoever names it as one."""
    zarr = folder.suffix.lower() == _ZARR or is_zarr(folder)
    return zarr or holds_single_frames(folder, named=True)


def is_movie(address: Path) -> bool:
    """Tell whether an address names a movie, and not a folder that may hold some.

    What is not there yet is a movie if its name ends as that of one.
    """
    path, part = split_address(address)
    suffix = path.suffix.lower()
    if path.is_dir():
        return bool(part) or suffix == _ZARR or holds_single_frames(path)
    return bool(part) or suffix in SUFFIXES or path.is_file()


def _is_movie(path: Path) -> bool:
    suffix = path.suffix.lower()
    if path.name.startswith("."):
        return False
    if path.is_dir():
        return suffix == _ZARR or holds_single_frames(path)
    if suffix in RECORDED:
        return description_of(path) is not None and not path.stem.endswith(_SNAPSHOT)
    return suffix in SUFFIXES and path.is_file() and _holds_one(path, *_state(path))


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
