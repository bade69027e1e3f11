"""Arrays in ``.npz`` files: ZIP archives of arrays that NumPy saved.

An array of Python objects is never read, since that would run what the file says.
"""

from __future__ import annotations

import io
import struct
import zipfile
from functools import partial
from pathlib import Path
from typing import IO, BinaryIO

from iscat_analysis.errors import DataError
from iscat_analysis.movie.containers import Member, is_movie
from iscat_analysis.movie.mapped_frames import read_header

_SUFFIX = ".npy"
_LOCAL_HEADER = struct.Struct("<26xHH")  # lengths of the name, and of what is added to it
_ENCRYPTED = 1
_LARGEST_HEADER = 2**16  # of an array, unpacked
_MOST_ARRAYS = 1000


def arrays_of_npz(file: BinaryIO, path: Path) -> dict[str, Member | str]:
    """List the arrays of an archive."""
    archive = zipfile.ZipFile(file)
    listed = archive.infolist()
    infos = [info for info in listed if info.filename.endswith(_SUFFIX)][:_MOST_ARRAYS]
    if listed and not infos:
        raise DataError(f"{path}: is a ZIP archive without arrays of NumPy; unpack it")
    return {info.filename.removesuffix(_SUFFIX): _held(archive, info, file, path) for info in infos}


def _held(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, file: BinaryIO, path: Path
) -> Member | str:
    if info.flag_bits & _ENCRYPTED:
        return "is encrypted"
    with archive.open(info) as packed:
        header = read_header(io.BytesIO(packed.read(_LARGEST_HEADER)), path)
    if header.stored.hasobject:
        return "holds Python objects, which are not read"
    if header.stored.kind not in "uif" or not is_movie(header.shape):
        return f"holds {header.stored} of shape {header.shape}"
    if info.compress_type == zipfile.ZIP_STORED:
        file.seek(info.header_offset)
        lengths = _LOCAL_HEADER.unpack(file.read(_LOCAL_HEADER.size))
        place = info.header_offset + _LOCAL_HEADER.size + sum(lengths) + header.offset
        return Member(*header[:3], info.file_size - header.offset, place)
    unpack = partial(_unpack, archive, info, header.offset)
    return Member(*header[:3], info.compress_size, unpack=unpack)


def _unpack(archive: zipfile.ZipFile, info: zipfile.ZipInfo, start: int) -> IO[bytes]:
    packed = archive.open(info)
    packed.read(start)
    return packed
