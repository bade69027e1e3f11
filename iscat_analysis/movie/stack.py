"""`Stack`, the movie that every later stage reads, and `Frames`, what each format provides.

Frames that a file stores several together, in chunks or shards: none is decoded twice.

Whoever reads a few frames decodes all that are stored with them; the next ones are then at hand.
Several threads may read: one decodes a slab, the others wait for it.

Frames of a movie that another one is made of: some of them, or all with other counts.

Frames that lie in several files, as Micro-Manager writes TIFF beyond 4 GB, or that take turns with
those of other channels.
"""

from __future__ import annotations

import hashlib
import math
import platform
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import DataError
from iscat_analysis.files import fingerprint, refuse_changed, sha256_of_files, states_of
from iscat_analysis.last_used import memoize
from iscat_analysis.movie.addresses import MARK, split_address
from iscat_analysis.records import BoolArray, CountSource, InPlace, PlacedSource, StackMetadata
from iscat_analysis.text import printable
from iscat_analysis.threads import start_in_thread

_KEPT_BYTES = 2**28  # of decoded frames that are kept

Read = Callable[[int, int], NDArray[Any]]
"""Reads frames ``[start, stop)`` as a new array (t, y, x)."""


def in_slabs(read: Read, shape: tuple[int, ...], dtype: np.dtype[Any], depth: int) -> Read:
    """Read frames through slabs of `depth` frames, of which some are kept."""
    depth = min(depth, shape[0])
    kept = _KEPT_BYTES // max(depth * math.prod(shape[1:]) * dtype.itemsize, 1)
    if depth < 2 or kept < 2:  # one thread ends in a slab while another begins in the next
        return read
    slab = memoize(kept, lambda begin: read(begin, min(begin + depth, shape[0])))

    def read_slabs(start: int, stop: int) -> NDArray[Any]:
        out = np.empty((stop - start, *shape[1:]), dtype=dtype)
        for begin in range(start // depth * depth, stop, depth):
            low, high = max(begin, start), min(begin + depth, stop)
            out[low - start : high - start] = slab(begin)[low - begin : high - begin]
        return out

    return read_slabs


LeftOut = tuple[BoolArray, NDArray[Any]]
"""Pixels that are left out (y, x), and the counts of each in the dark."""


class Frames(Protocol):
    """The pixels of one open file or array, whatever its format."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored numbers, in native byte order."""

    @property
    def metadata(self) -> StackMetadata:
        """What the file says of itself."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of what the file implies but does not state."""

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Frames ``[start, stop)``, already known to exist, as a new array (t, y, x)."""

    def close(self) -> None:
        """Release the file."""


@runtime_checkable
class ArrayLike(Protocol):
    """An array in memory, mapped, or behind slices: of NumPy, Dask, Zarr or h5py."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Frames, rows, columns."""

    @property
    def dtype(self) -> Any:
        """Type of the counts."""

    def __getitem__(self, key: Any, /) -> Any:
        """Frames ``array[start:stop]``, which `numpy.asarray` understands."""


class ArrayFrames:
    """The frames of an array; `iscat_analysis.movie.open_stack` makes it."""

    def __init__(
        self, array: ArrayLike, name: str, metadata: StackMetadata, notes: tuple[str, ...] = ()
    ) -> None:
        self._array = array
        stored = np.dtype(array.dtype)
        self.shape = shape_of_frames(tuple(int(n) for n in array.shape), stored, name)
        self.dtype = stored.newbyteorder("=")
        self.metadata, self.notes = metadata, notes
        self.read = in_slabs(self._decoded, self.shape, self.dtype, getattr(array, "depth", 1))

    def _decoded(self, start: int, stop: int) -> NDArray[Any]:
        return np.array(self._array[start:stop], dtype=self.dtype, order="C")

    def close(self) -> None:
        """Leave the array as it is; it belongs to the caller."""


def shape_of_frames(
    shape: tuple[int, ...], stored: np.dtype[Any], name: object
) -> tuple[int, int, int]:
    """Give a shape if it is one of frames, and their numbers are counts."""
    if len(shape) != 3 or min(shape) < 1 or stored.kind not in "uif":
        raise DataError(
            f"{name}: needs to be frames (t, y, x) of integers or floats but is {stored} of "
            f"shape {shape}; save or pass the camera's counts, one frame after the other"
        )
    return shape[0], shape[1], shape[2]


def single_frame(name: object) -> DataError:
    """Make the error of a movie that has one frame."""
    return DataError(
        f"{name}: holds a single frame; a movie needs frames before and after a particle binds"
    )


def not_shared(path: Path) -> DataError:
    """Say that a file is missing or different where another process reads it."""
    return DataError(
        f"{path}: is not on {platform.node()}, or is another file there; workers read and write by "
        "path, so that their machines must share the file system"
    )


def _reopened(
    address: Path, identity: str, left_out: LeftOut | None, channel: tuple[int, int] | None
) -> Stack:
    """Open a movie that another process has open."""
    from iscat_analysis.movie import open_stack

    if not split_address(address)[0].exists():
        raise not_shared(address)
    stack = open_stack(address)
    if stack.identity != identity:
        stack.close()
        raise not_shared(address)
    stack = stack.channel(channel)
    return stack if left_out is None else stack.without(*left_out)


class Stack:
    """A movie in a file or an array; `iscat_analysis.movie.open_stack` makes it.

    Parameters
    ----------
    path : Path
        The file, or the name of the array.
    frames : Frames
        Its pixels.
    part : str
        What the movie is of the file, where it is not all: a dataset, or the shape of numbers.
    files : sequence of Path, optional
        The files that hold it; default `path`, none for an array.
    metadata : StackMetadata, optional
        What is known of the recording; default what `frames` have of it.

    Raises
    ------
    DataError
        Its pixels are floats of another length than 32 and 64 bits.
    """

    def __init__(
        self,
        path: Path,
        frames: Frames,
        *,
        part: str = "",
        files: Sequence[Path] | None = None,
        metadata: StackMetadata | None = None,
    ) -> None:
        self.path = path
        self._frames = frames
        self.metadata = frames.metadata if metadata is None else metadata
        self._channel: tuple[int, int] | None = None
        self._part = part
        self._files = (path,) if files is None else tuple(files)
        self._states = states_of(self._files)
        self._closed = False
        self._own = True
        self._left_out: LeftOut | None = None
        self._hashing: Future[str] | None = None
        if self.dtype.kind == "f" and self.dtype.itemsize not in (4, 8):  # of compiled kernels
            raise DataError(
                f"{path}: its pixels are {self.dtype}; export it as integers or 32-bit floats"
            )

    def __repr__(self) -> str:
        t, y, x = self.shape
        state = ", closed" if self._closed else ""
        return f"<Stack {self.name}: {t} frames of {y} x {x} pixels, {self.dtype}{state}>"

    def __reduce__(
        self,
    ) -> tuple[Callable[..., Stack], tuple[Path, str, LeftOut | None, tuple[int, int] | None]]:
        """Let another process open the same file."""
        if not self._files or not self._own:
            raise TypeError(f"{self.name} is no file that another process could open")
        path = self.path.absolute()
        address = Path(f"{path}{MARK}{self._part}") if self._part else path
        return _reopened, (address, self.identity, self._left_out, self._channel)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def name(self) -> str:
        """The file's name, without its folder, as text that can be written."""
        return printable(self.path.name + (MARK + self._part if self._part else ""))

    @property
    def identity(self) -> str:
        """Hash that identifies the movie without reading all of it; empty for an array."""
        try:
            return fingerprint(self._files, self._part) if self._files else ""
        except OSError as error:
            raise DataError(f"{self.path}: can no longer be read ({error.strerror})") from None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self._frames.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts, in native byte order."""
        return self._frames.dtype

    @property
    def notes(self) -> tuple[str, ...]:
        """One sentence for each thing that the file implies but does not state."""
        return self._frames.notes

    def seen_as(self, frames: Frames) -> Stack:
        """Make the same movie with frames that were derived from its own.

        Parameters
        ----------
        frames : Frames
            As many.

        Returns
        -------
        Stack
            Under the same name.
        """
        seen = self._again(frames)
        seen._own, seen._left_out = False, None
        return seen

    def channel(self, chosen: tuple[int, int] | None) -> Stack:
        """Give one of several channels whose frames take turns.

        Parameters
        ----------
        chosen : (int, int) or None
            How many channels there are, and which of them, from 0; None: the movie as it is.

        Returns
        -------
        Stack
            Under the same name; it reads from the same file.

        Raises
        ------
        DataError
            There are no two frames of it.
        """
        if chosen is None:
            return self
        (channels, which), total, known = chosen, self.shape[0], self.metadata
        images = range(which, total, channels)
        if len(images) < 2:
            raise DataError(
                f"{self.name}: has {total} frames, which are too few for channel {which} of "
                f"{channels}; give another camera.channels"
            )
        if known.ticks is not None:  # which count the intervals of the camera
            own = known.ticks[which::channels]
            known = replace(known, ticks=tuple(tick - own[0] for tick in own))
        elif known.frame_rate_hz is not None:
            known = replace(known, frame_rate_hz=known.frame_rate_hz / channels)
        where = np.array([(0, image) for image in images])
        seen = self._again(FileSet([self._frames], self._files, where, known, self.notes))
        seen.metadata, seen._channel = known, chosen
        return seen

    def without(self, pixels: BoolArray, dark: NDArray[Any]) -> Stack:
        """Set some pixels to dark counts, so that all stages leave them out.

        Parameters
        ----------
        pixels : ndarray of bool, shape (y, x)
            Which.
        dark : ndarray, shape (n,)
            Counts of each of them without light.

        Returns
        -------
        Stack
            Under the same name; it reads from the same file.
        """
        seen = self._again(self._frames)
        if self._left_out is not None:  # some are left out already
            known = np.zeros(pixels.shape, dtype=dark.dtype)
            for mask, values in ((pixels, dark), self._left_out):
                known[mask] = values
            pixels = pixels | self._left_out[0]
            dark = known[pixels]
        seen._left_out = pixels, dark
        return seen

    def _again(self, frames: Frames) -> Stack:
        """Give another one of the same file, which is hashed once for both."""
        seen = Stack.__new__(Stack)
        vars(seen).update(vars(self), _frames=frames, _closed=False)
        return seen

    def close(self) -> None:
        """Release the file; closing twice is harmless."""
        if not self._closed:
            self._closed = True
            self._frames.close()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames.

        Parameters
        ----------
        start, stop : int
            Half-open range ``[start, stop)``.

        Returns
        -------
        ndarray, shape (stop − start, y, x)
            A new array of the stored counts, in native byte order.

        Raises
        ------
        DataError
            The range leaves the movie, or the pixels cannot be decoded.
        ValueError
            The stack was closed.
        """
        self._require(start, stop)
        counts = self._frames.read(start, stop)
        if self._left_out is not None:
            pixels, dark = self._left_out
            counts[:, pixels] = dark
        return counts

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """Give frames where they lie in the file, without a copy.

        Parameters
        ----------
        start, stop : int
            Half-open range ``[start, stop)``.

        Returns
        -------
        InPlace or None
            What `read` would give; None where the file does not hold it like that.

        Raises
        ------
        DataError
            The range leaves the movie, or the file has become shorter.
        ValueError
            The stack was closed.
        """
        self._require(start, stop)
        if self._left_out is not None or not isinstance(self._frames, PlacedSource):
            return None
        return self._frames.in_place(start, stop)

    def chunks(
        self, start: int = 0, stop: int | None = None, memory_mb: float = 64.0
    ) -> Iterator[tuple[int, NDArray[Any]]]:
        """Read frames in blocks of bounded size.

        Parameters
        ----------
        start : int
            First frame.
        stop : int, optional
            One past the last frame; without it, to the end.
        memory_mb : float
            Largest size of a block [10⁶ bytes]; a block always holds at least one frame.

        Yields
        ------
        int
            Number of the block's first frame.
        ndarray, shape (t, y, x)
            The block [counts].

        Raises
        ------
        DataError
            As for `read`.
        ValueError
            `memory_mb` is not positive, or the stack was closed.
        """
        if not memory_mb > 0:
            raise ValueError(f"memory_mb = {memory_mb} must be positive")
        end = self.shape[0] if stop is None else stop
        self._require(start, end)
        _, y, x = self.shape
        step = max(1, int(memory_mb * 1e6 // (y * x * self.dtype.itemsize)))
        for first in range(start, end, step):
            yield first, self.read(first, min(first + step, end))

    def sha256(self) -> str:
        """Hash the movie, without holding it in memory.

        Returns
        -------
        str
            SHA-256 as 64 hexadecimal digits: of the bytes of a file, followed by those of further
            files of a set and by the name of a part; of an array's type, shape and counts in the
            order of the axes.

        Raises
        ------
        DataError
            The file can no longer be read, or is not the one that was opened.
        """
        if not self._files:
            digest = hashlib.sha256(f"{self.dtype.str} {self.shape}".encode())
            for _, block in self.chunks():
                digest.update(block.data)
            return digest.hexdigest()
        found = sha256_of_files(self._files, self._part)
        refuse_changed(self._files, self._states)
        return found

    def hashed(self) -> Future[str]:
        """Hash the movie in a thread of its own, once however often it is asked for.

        Returns
        -------
        Future of str
            What `sha256` gives.
        """
        if self._hashing is None:
            self._hashing = start_in_thread(self.sha256)
        return self._hashing

    def _require(self, start: int, stop: int) -> None:
        """Refuse to read from a closed stack, or frames that it does not hold."""
        if self._closed:
            raise ValueError(f"{self.name} was closed; open it again to read from it")
        total = self.shape[0]
        if not 0 <= start <= stop <= total:
            raise DataError(
                f"{self.path}: frames [{start}, {stop}) were asked for, but it holds "
                f"[0, {total}); choose frames inside that range"
            )


@dataclass(frozen=True, eq=False)
class ChangedFrames:
    """Wrapper around the frames of a movie, whose subclass overrides `read`."""

    source: CountSource

    notes: ClassVar[tuple[str, ...]] = ()
    metadata: ClassVar[StackMetadata] = StackMetadata()

    @property
    def name(self) -> str:
        """What messages call it."""
        return self.source.name

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self.source.shape

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored counts."""
        return self.source.dtype

    def close(self) -> None:
        """Do nothing: the movie has an owner."""


@dataclass(frozen=True, eq=False)
class SelectedFrames(ChangedFrames):
    """Some frames of a movie."""

    frames: NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Frames, rows, columns."""
        return self.frames.size, *self.source.shape[1:]

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames by their index in the selection.

        Shapes: result (stop − start, y, x).
        """
        wanted = self.frames[start:stop]
        runs = np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1)
        parts = [self.source.read(int(run[0]), int(run[-1]) + 1) for run in runs if run.size]
        return np.concatenate(parts) if parts else self.source.read(0, 0)


class FileSet:
    """Frames that lie in some files: `where` has the file and the image of each, shape (t, 2)."""

    def __init__(
        self,
        members: Sequence[Frames],
        files: Sequence[Path],
        where: NDArray[np.int64],
        metadata: StackMetadata,
        notes: tuple[str, ...] = (),
    ) -> None:
        self._members, self._where = members, where
        self.files = tuple(files)
        self.shape = (len(where), *members[0].shape[1:])
        self.dtype = members[0].dtype
        self.metadata, self.notes = metadata, notes

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames ``[start, stop)`` as a new array in native byte order [counts]."""
        block = np.empty((stop - start, *self.shape[1:]), dtype=self.dtype)
        for first, last in self._runs(start, stop):
            member, image = self._where[first].tolist()
            block[first - start : last - start] = self._members[member].read(
                image, image + last - first
            )
        return block

    def _runs(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Divide frames into those that follow one another in a file."""
        goes_on = (np.diff(self._where[start:stop], axis=0) == [0, 1]).all(axis=1)
        edges = [start, *(np.flatnonzero(~goes_on) + start + 1).tolist(), stop]
        return list(pairwise(edges)) if stop > start else []

    def in_place(self, start: int, stop: int) -> InPlace | None:
        """Give frames where they lie, if one file holds all of them in a row."""
        if len(self._runs(start, stop)) != 1:
            return None
        number, image = self._where[start].tolist()
        member = self._members[number]
        placed = isinstance(member, PlacedSource)
        return member.in_place(image, image + stop - start) if placed else None

    def close(self) -> None:
        """Release the files."""
        for member in self._members:
            member.close()
