"""Movie files and arrays become a `Stack`: frames (t, y, x), read lazily, whole or not at all.

Each format is one module that offers `Frames`, and an entry of `FORMATS` in `formats`.  What a
file says of itself is checked against what it holds before any pixel is read: a movie that is cut
short, or whose description announces more than it holds, is refused and never analysed in part.
"""

from __future__ import annotations

import math
from numbers import Real
from pathlib import Path

from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.movie.addresses import MARK, path_beside, setup_beside, split_address
from iscat_analysis.movie.arrays import MappedFrames, bytes_are_swapped
from iscat_analysis.movie.descriptions import measure_clock
from iscat_analysis.movie.formats import (
    SUFFIXES,
    files_of,
    find_movies,
    is_movie,
    is_movie_folder,
    is_named_as_movie,
    is_open_to_write,
    members_of,
    open_file,
)
from iscat_analysis.movie.mapped import WHAT_LIBRARIES_RAISE
from iscat_analysis.movie.stack import (
    ArrayFrames,
    ArrayLike,
    ChangedFrames,
    Frames,
    SelectedFrames,
    Stack,
    not_shared,
    single_frame,
)
from iscat_analysis.movie.tables import read_frame, refuse_twice
from iscat_analysis.movie.tiff import holds_single_frames, open_tiff
from iscat_analysis.records import StackMetadata


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
        return open_file(Path(movie))
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
    frames = ArrayFrames(movie, name, metadata)
    if frames.shape[0] < 2:
        raise single_frame(name)
    return Stack(Path(name), frames, files=())
