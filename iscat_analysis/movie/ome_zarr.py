"""Movies in Zarr folders, whose files are looked at before any of them is believed.

A folder of Zarr's whose files are looked at before any of them is believed.

zarr gives zeros for a chunk that is not there, waits for pipes and reads devices without end.
Here every file is a regular one, and every chunk that an array declares is there, before and while
it is read.

Movies in Zarr folders: OME-Zarr, and single arrays of frames.

Format: OME-NGFF 0.4 and 0.5 (doi:10.1038/s41592-021-01326-w); zarr reads the arrays.
"""

from __future__ import annotations

import itertools
import math
import os
import stat
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray
from zarr.abc.store import ByteRequest
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import LocalStore

from iscat_analysis.errors import DataError
from iscat_analysis.movie.addresses import MARK
from iscat_analysis.movie.descriptions import LENGTH_NM, TIME_S, Hints, inverse, merge, positive
from iscat_analysis.movie.mapped import damaged, refuse_growth, refuse_large_chunks
from iscat_analysis.movie.stack import ArrayFrames
from iscat_analysis.reading import LARGEST_TEXT_BYTES
from iscat_analysis.records import StackMetadata

_TEXTS = ("zarr.json", ".zgroup", ".zarray", ".zattrs", ".zmetadata")


class CheckedStore(LocalStore):
    """The files of a Zarr folder; reading a chunk that is not there is an error."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, read_only=True)
        self.sizes = _sizes(folder)
        self.complete = False
        """Whether whatever is asked for must be there."""

    async def get(
        self,
        key: str,
        prototype: BufferPrototype | None = None,
        byte_range: ByteRequest | None = None,
    ) -> Buffer | None:
        """Read a file, or a part of it."""
        found = await super().get(key, prototype, byte_range)
        if found is None and self.complete:
            raise DataError(
                f"{self.root}/{key}: is missing; copy the movie again or export it again"
            )
        return found


class CheckedArray:
    """An array in frames (t, y, x) all of whose chunks are there."""

    def __init__(self, array: Any, store: CheckedStore, name: str) -> None:
        self._array, self._name = array, name
        self.dtype = np.dtype(array.dtype)
        shape = tuple(int(n) for n in array.shape)
        _refuse_incomplete(array, shape, store, name)
        if len(shape) > 3 and set(shape[1:-2]) == {1}:
            shape = (shape[0], *shape[-2:])
        self.shape = shape
        self.depth = int((array.shards or array.chunks)[0])
        """Frames that are stored together."""
        store.complete = True

    def __getitem__(self, key: slice, /) -> NDArray[Any]:
        what = f"{self._name}: frames {key.start} to {key.stop - 1} cannot be decompressed"
        with damaged(what, remedy="copy the movie again or export it again"):
            return np.asarray(self._array[key]).reshape(-1, *self.shape[1:])


def _sizes(folder: Path) -> dict[str, int]:
    """List the files of a folder, by their paths in it, with their sizes."""
    found = {}
    for where, _, names in os.walk(folder):
        for name in names:
            path = Path(where) / name
            try:
                state = path.stat()
            except OSError as error:
                raise DataError(f"{path}: cannot be read ({error.strerror})") from None
            if not stat.S_ISREG(state.st_mode):
                raise DataError(f"{path}: is a pipe or a device where a file should be")
            if name in _TEXTS and state.st_size > LARGEST_TEXT_BYTES:
                raise DataError(f"{path}: has {state.st_size} bytes, too many for a description")
            found[path.relative_to(folder).as_posix()] = state.st_size
    return found


def _refuse_incomplete(array: Any, shape: tuple[int, ...], store: CheckedStore, name: str) -> None:
    """Refuse an array that declares more than its folder holds, or lacks a chunk."""
    dtype = np.dtype(array.dtype)
    refuse_large_chunks(array.chunks, dtype, f"{name}: it")
    refuse_growth(math.prod(shape) * dtype.itemsize, sum(store.sizes.values()), f"{name}: it")
    stored = array.shards or array.chunks
    grid = [-(-n // c) for n, c in zip(shape, stored, strict=True)]
    prefix = f"{array.path}/" if array.path else ""
    # twice a chunk, which a codec may fail to compress, and room for its header
    most = 2 * math.prod(stored) * dtype.itemsize + 2**16
    if math.prod(grid) > len(store.sizes):
        raise _missing(name, f"it holds {len(store.sizes)} files and needs {math.prod(grid)}")
    for place in itertools.product(*map(range, grid)):
        key = prefix + array.metadata.encode_chunk_key(place)
        first = place[0] * stored[0]
        frames = f"frames {first} to {min(first + stored[0], shape[0]) - 1}"
        if key not in store.sizes:
            raise _missing(name, f"{key} with {frames} is missing")
        if store.sizes[key] > most:
            raise DataError(
                f"{name}: {key} has {store.sizes[key]} bytes where {most} are the most; it is "
                "damaged, copy it again or export it again"
            )
        if array.shards and _lacks_chunks(array, Path(store.root) / key, place, shape):
            raise _missing(name, f"{key} lacks some of {frames}")


def _lacks_chunks(array: Any, path: Path, place: tuple[int, ...], shape: tuple[int, ...]) -> bool:
    """Tell whether a shard lacks some of its chunks, which zarr would read as zeros.

    Its index has place and length of each chunk as two integers of 64 bits, before a checksum of 4
    bytes.
    """
    codec = array.metadata.codecs[0]
    names = [type(each).__name__ for each in codec.index_codecs]
    if names not in (["BytesCodec"], ["BytesCodec", "Crc32cCodec"]):
        raise DataError(f"{path}: its index is stored as {names}, which is not supported")
    inside = [s // c for s, c in zip(array.shards, array.chunks, strict=True)]
    count = math.prod(inside)
    length = 16 * count + 4 * (len(names) - 1)
    with path.open("rb") as file:
        if codec.index_location.value == "end":
            file.seek(max(path.stat().st_size - length, 0))
        index = file.read(16 * count)
    if len(index) < 16 * count:
        return True
    order = ">" if getattr(codec.index_codecs[0].endian, "value", "little") == "big" else "<"
    nothing = 2**64 - 1  # of a chunk that was not written
    written = np.frombuffer(index, f"{order}u8").reshape(*inside, 2)[..., 0] != nothing
    starts = [p * s for p, s in zip(place, array.shards, strict=True)]
    needed = tuple(
        slice(0, -(-(min(start + s, n) - start) // c))
        for start, s, n, c in zip(starts, array.shards, shape, array.chunks, strict=True)
    )
    return not bool(written[needed].all())


def _missing(name: str, how: str) -> DataError:
    return DataError(
        f"{name}: is incomplete ({how}); the recording or the copy was interrupted, or frames of "
        "zeros alone were left out: export it again"
    )


def open_zarr(folder: Path, part: str) -> ArrayFrames:
    """Open a movie in a Zarr folder."""
    name = f"{folder}{MARK}{part}" if part else str(folder)
    store = CheckedStore(folder)
    what = f"{name}: cannot be read as Zarr"
    with damaged(what, remedy="export it again"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of files that are none of Zarr's
        node = zarr.open(store, mode="r", path=part.strip("/") or None)
        if hasattr(node, "dtype"):
            array, metadata = node, StackMetadata()
        else:
            array, metadata = _of_group(node, name)
        checked = CheckedArray(array, store, name)
    return ArrayFrames(checked, name, metadata)


def _of_group(group: Any, name: str) -> tuple[Any, StackMetadata]:
    """Choose the array of a group, and say what it tells of its scale."""
    attributes = dict(group.attrs)
    attributes = attributes.get("ome", attributes)
    if attributes.get("multiscales"):
        image = attributes["multiscales"][0]
        finest = image["datasets"][0]
        array = group[finest["path"]]
        axes = [axis if isinstance(axis, Mapping) else {"name": axis} for axis in image["axes"]]
        return array, _scale(axes, finest, array.shape, name)
    found = {path: array for path, array in group.arrays() if len(array.shape) >= 3}
    if len(found) != 1:
        held = ", ".join(f"/{path}" for path in list(found)[:5]) or "none"
        raise DataError(
            f"{name}: name the array of frames (t, y, x) behind {MARK}, as in "
            f'"{name}{MARK}/movie"; it holds: {held}'
        )
    return next(iter(found.values())), StackMetadata()


def _scale(
    axes: list[Any], level: Mapping[str, Any], shape: tuple[int, ...], name: str
) -> StackMetadata:
    """Read pixel size and frame rate; refuse what is no movie."""
    names = [str(axis["name"]) for axis in axes]
    long = [axis for axis, size in zip(names, shape, strict=True) if size > 1]
    if names[-2:] != ["y", "x"] or names[0] != "t" or not set(long) <= {"t", "y", "x"}:
        sizes = ", ".join(f"{axis} {size}" for axis, size in zip(names, shape, strict=True))
        raise DataError(
            f"{name}: has the axes {sizes}; a movie has frames t, rows y and columns x, and "
            "whatever else once: export one channel and height"
        )
    changes = level.get("coordinateTransformations", ())
    scales = [change["scale"] for change in changes if change.get("type") == "scale"]
    scale = dict(zip(names, scales[0], strict=True)) if scales else {}
    units = {str(axis["name"]): str(axis.get("unit", "")).lower() for axis in axes}
    known = {
        axis: positive(scale.get(axis), unit)
        for axis, table in (("x", LENGTH_NM), ("y", LENGTH_NM), ("t", TIME_S))
        if (unit := table.get(units[axis])) is not None
    }
    scaled = StackMetadata(known.get("x"), frame_rate_hz=inverse(known.get("t")), source="ome-zarr")
    return merge([Hints(scaled, known.get("y"))], Path(name))
