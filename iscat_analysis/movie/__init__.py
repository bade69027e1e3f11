"""Movie files and arrays become a `Stack`: frames (t, y, x), read lazily, whole or not at all.

Each format is one module that offers `Frames`; `FORMATS` of `folders` names its signature.  What a
file says of itself is checked against what it holds before any pixel is read: a movie that is cut
short, or whose description announces more than it holds, is refused and never analysed in part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.hashing import refuse_changed, states_of
from iscat_analysis.movie.addresses import MARK, path_beside, split_address
from iscat_analysis.movie.file_set import FileSet
from iscat_analysis.movie.folders import FORMATS, Format, files_of
from iscat_analysis.movie.frame_files import FrameFiles, holds_single_frames
from iscat_analysis.movie.mapped_frames import open_raw
from iscat_analysis.movie.ome_zarr import is_zarr, open_zarr
from iscat_analysis.movie.recorded import description_of, open_recorded
from iscat_analysis.movie.side_files import with_side_files
from iscat_analysis.movie.stack import ArrayFrames, ArrayLike, Frames, Stack
from iscat_analysis.reading import open_regular
from iscat_analysis.records import StackMetadata

__all__ = ["ArrayLike", "Frames", "Stack", "open_stack", "path_beside"]

READERS: Mapping[bytes, Format] = {
    signature: kind for kind in FORMATS for signature in kind.signatures
}
"""The first four bytes of a file, and what it is."""

_LOSSY = "which keeps no counts: its compression leaves out what the eye does not see"
_EXPORT = "export the movie as TIFF"
_FOREIGN: Mapping[bytes, str] = {
    b"\x89PNG": f"a PNG picture; {_EXPORT}",
    b"\xff\xd8\xff": f"a JPEG picture; {_EXPORT}",
    b"\x1f\x8b": "a gzip archive; unpack it",
    b"RIFF": f"an AVI film, {_LOSSY}; {_EXPORT}",
    b"\x1aE\xdf\xa3": f"a Matroska film, {_LOSSY}; {_EXPORT}",
    b"SIMPLE": f"a FITS file; {_EXPORT}",
}
_FILM = b"ftyp"  # of MP4 and QuickTime, behind four bytes
_SIGNATURE_BYTES = 8


def open_stack(
    movie: str | Path | ArrayLike,
    *,
    name: str | None = None,
    pixel_size_nm: float | None = None,
    exposure_ms: float | None = None,
    frame_rate_hz: float | None = None,
) -> Stack:
    """Open a movie without reading its pixels.

    TIFF, BigTIFF, OME-TIFF, ImageJ, Micro-Manager and MetaMorph stacks are read; strips or tiles;
    uncompressed, LZW, Deflate, Zstandard, PackBits or LZMA; also a folder of files with a frame
    each.  So are Refeyn's ``.mp`` movies, of OneMP and TwoMP, compressed or not; datasets of HDF5
    files, as ``"day.h5::/run 3/movie"``; images and arrays of Zarr folders, OME-Zarr among them;
    ``.npy`` files; arrays of ``.npz`` and MATLAB's ``.mat`` files, as ``"day.mat::movie"``; ND2 and
    CZI, if the packages nd2 and pylibCZIrw are installed; files of plain numbers with the settings
    of PyLabLib beside them, with their shape in the name as PiSCAT's have it, or as
    ``"movie.bin::1500x128x128,uint16"``, also ``">u2"``, ``"…,header=344"`` and
    ``"…,order=columns"``; and arrays: of NumPy, memory-mapped or not, of Dask, Zarr or h5py, or
    whatever has a shape and a dtype and can be sliced.

    Parameters
    ----------
    movie : str, Path or array_like of shape (t, y, x)
        The file, or the camera's counts; of an array a few frames are read at a time.
    name : str, optional
        What messages and reports call an array; default ``"array"``.  A file has its own name.
    pixel_size_nm : float, optional
        Of an array, in the sample plane [nm].
    exposure_ms : float, optional
        Of an array [ms].
    frame_rate_hz : float, optional
        Of an array [Hz].

    Returns
    -------
    Stack
        Frames (t, y, x); close it, or use it in a ``with`` statement.

    Raises
    ------
    DataError
        The file is missing, is not a movie, is cut short, contradicts its own description, or has
        more than one axis besides y and x; or the array is not one of counts (t, y, x).
    ConfigError
        A file was given what only arrays need, or a number is not positive.
    """
    arguments = {
        "pixel_size_nm": pixel_size_nm,
        "exposure_ms": exposure_ms,
        "frame_rate_hz": frame_rate_hz,
    }
    if isinstance(movie, (str, Path)):
        given = [key for key, value in {"name": name, **arguments}.items() if value is not None]
        if given:
            raise ConfigError(
                f"{given[0]}: describes an array, but {movie} is a file, which has a name and "
                "metadata of its own; leave it out, and correct the file in the configuration, "
                "as in camera.pixel_size_nm"
            )
        return _open_file(Path(movie))
    if name is not None and not isinstance(name, str):
        raise ConfigError(f"name: is {type(name).__name__}; give a text")
    if not (isinstance(movie, ArrayLike) and isinstance(movie.shape, tuple)):
        raise DataError(
            f"{type(movie).__name__} is no movie; give the path of a file, or an array (t, y, x)"
        )
    for key, value in arguments.items():
        if value is not None and not (isinstance(value, Real) and 0 < value < math.inf):
            raise ConfigError(f"{key} = {value!r} must be a positive number")
    source = "arguments" if any(value is not None for value in arguments.values()) else "none"
    metadata = StackMetadata(pixel_size_nm, exposure_ms, frame_rate_hz, source=source)
    name = name or "array"
    return Stack(Path(name), ArrayFrames(movie, name, metadata), files=())


def _open_file(address: Path) -> Stack:
    try:
        path, part = split_address(address)
        is_folder = path.is_dir()
        is_pipe = path.exists() and not (is_folder or path.is_file())  # or a device
    except OSError as error:  # nobody may look into the folder that it is in
        raise DataError(f"{address}: cannot be read ({error.strerror})") from None
    before = states_of([path])
    stack = _opened(path, part, is_folder=is_folder, is_pipe=is_pipe)
    try:
        refuse_changed([path], before)
    except DataError:
        stack.close()
        raise
    return stack


def _opened(path: Path, part: str, *, is_folder: bool, is_pipe: bool) -> Stack:
    """Open a file or folder by what is in it."""
    if is_folder:
        if is_zarr(path):
            return _stack(path, open_zarr(path, part), part, files_of(path))
        if holds_single_frames(path, named=True):
            frames = FrameFiles(path)
            return _stack(path, frames, files=frames.files)
        raise DataError(
            f"{path}: is a folder, but not one of TIFF files with a frame each, nor of Zarr; give "
            "the path of one movie file; all movies of a folder are analysed by `iscat batch`"
        )
    if is_pipe:  # which would keep whoever opens it waiting
        raise DataError(
            f"{path}: is a pipe or a device, and a movie is read more than once: save it as a "
            "file, and give its path"
        )
    try:
        with open_regular(path) as file:
            signature = file.read(_SIGNATURE_BYTES)
    except FileNotFoundError:
        raise DataError(f"{path}: there is no such file; check the path") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    if not signature:
        raise DataError(f"{path}: is empty (0 bytes); copy it again or export it again")
    kind = READERS.get(signature[:4])
    if part and (kind is None or kind.holds_one is None):
        return _stack(path, open_raw(path, part), part)
    if description_of(path) is not None:
        recorded = open_recorded(path)
        return _stack(path, recorded, files=recorded.files)
    if kind is None:
        raise DataError(f"{path}: {_refusal(path, signature)}")
    found = kind.open(path, part)
    return _stack(path, found, part, found.files if isinstance(found, FileSet) else None)


def _stack(
    path: Path, frames: Frames, part: str = "", files: Sequence[Path] | None = None
) -> Stack:
    """Make the movie of a file, with what is known of its recording."""
    known = with_side_files(frames.metadata, path)
    return Stack(path, frames, part=part, files=files, metadata=known)


def _refusal(path: Path, signature: bytes) -> str:
    """Say what kind of file is not read, and what to do."""
    known = (what for mark, what in _FOREIGN.items() if signature.startswith(mark))
    found = f"a film, {_LOSSY}; {_EXPORT}" if signature[4:] == _FILM else next(known, "")
    needed = "needs to be a TIFF file, a Refeyn .mp movie, HDF5, Zarr, NumPy, MATLAB, ND2 or CZI"
    if found:
        return f"{needed} but is {found}"
    return (
        f"{needed} but is not one; {_EXPORT} or, if it is plain numbers, say so, "
        f'as in "{path}{MARK}1500x128x128,uint16"'
    )
