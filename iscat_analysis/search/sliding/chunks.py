"""Chunks of a landing movie: its frames, read once, and cut so that they fit into memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.background import find_defects
from iscat_analysis.camera.counts import Camera, check_counts
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.records import (
    BoolArray,
    CountSource,
    FloatArray,
    Mapper,
    PlacedSource,
)
from iscat_analysis.search.sliding import (
    DARK,
    Chunk,
    make_chunk,
    measure_frames,
    stride_of,
    well_lit,
)
from iscat_analysis.threads import threads

NOISE_FRAMES = 800
"""Frames on which the noise is judged, and the windows are chosen."""

HALO = 2
"""Windows on either side of a chunk's core: a step, its neighbours, and theirs."""

_LEVEL_FRAMES = 24  # frames all over a movie, that tell how much light there is
_FIRST_LONGER = 1.24  # than others, of a chunk that is summed before they are begun
MEMORY_SHARE = 0.32  # of compute.memory_limit_mb that the stored counts may take
_PIECE_BYTES = 2**20  # read at a time: still in a processor's cache as it is copied and looked at


class Reader:
    """Reads the frames of one chunk after the other, in place or into memory."""

    def __init__(
        self,
        movie: CountSource,
        camera: Camera,
        first: int,
        last: int,
        room_bytes: int,
        *,
        dark_e: float = -math.inf,
    ) -> None:
        self._dark_e = dark_e
        self._movie = movie
        self.camera = camera
        self.first, self.last = first, last
        self.shape = (movie.shape[1], movie.shape[2])
        self.frame_bytes = math.prod(self.shape) * movie.dtype.itemsize
        self._placed = (
            movie.in_place(first, last)
            if isinstance(movie, PlacedSource) and first < last
            else None
        )
        # made at once, because growing copies; only what is written to takes memory
        room = 0 if self._placed else min(max(last - first, 0), room_bytes // self.frame_bytes)
        self._buffer = np.empty((room, *self.shape), dtype=movie.dtype)
        self._held = (first, first)
        self._light: FloatArray = np.empty(0)
        self._repeats: BoolArray = np.empty(0, dtype=np.bool_)
        self._summed: tuple[tuple[int, int], int, Chunk] | None = None  # span, stride, and that

    @property
    def in_place(self) -> bool:
        """Whether frames stay where they lie in the file."""
        return self._placed is not None

    @property
    def held_bytes(self) -> int:
        """What a frame of a chunk counts for: half where it stays in the file.

        The system can take such pages back, but would have to read them again.
        """
        return self.frame_bytes // 2 if self._placed else self.frame_bytes

    @property
    def name(self) -> str:
        """What messages call the movie."""
        return self._movie.name

    def forget(self) -> None:
        """Release the memory of the frames."""
        if self._placed:
            self._placed.let_go()
        self._buffer = self._buffer[:0].copy()
        self._held = (self.first, self.first)
        self._summed = None

    def _keep(self, kept: slice, room: int) -> None:
        """Leave only some of the frames in memory, with room for more behind them."""
        if self._placed:
            self._placed.let_go()
            return
        frames, old = self._buffer[kept], self._buffer
        if room > len(old):
            self._buffer = np.empty((room, *self.shape), dtype=self._movie.dtype)
        if self._buffer is not old or kept.start:
            self._buffer[: len(frames)] = frames

    def _frames(self, start: int, stop: int) -> NDArray[Any]:
        """Frames [start, stop) of those that are held."""
        if self._placed:
            self._placed.check()
            return self._placed.counts[start - self.first : stop - self.first]
        return self._buffer[start - self._held[0] : stop - self._held[0]]

    def counts(
        self, start: int, stop: int, mapper: Mapper = map
    ) -> tuple[NDArray[Any], BoolArray, FloatArray]:
        """Frames [start, stop), which of them are good, and their light [e per pixel]."""
        low, high = self._held
        if low != start or stop > high:  # a part of them stays with the others
            self._summed = None
            kept = min(high, stop) - start if low <= start < high else 0
            known = slice(start - low, start - low + kept) if kept else slice(0, 0)
            self._keep(known, stop - start)
            self._light, self._repeats = self._light[known], self._repeats[known]
            self._held = (start, start + kept)
            self._append(stop, mapper)
        light = self._light[: stop - start]
        good = np.isfinite(light) & ~self._repeats[: stop - start]
        return self._frames(start, stop), good, light

    def _append(self, end: int, mapper: Mapper) -> None:
        """Read on from the last frame that is in memory."""
        start, begin = self._held
        if begin >= end:
            return
        step = max(1, _PIECE_BYTES // self.frame_bytes)
        pieces = [(a, min(a + step, end)) for a in range(begin, end, step)]

        def read(piece: tuple[int, int]) -> None:
            self._buffer[piece[0] - start : piece[1] - start] = self._movie.read(*piece)

        def check(piece: tuple[int, int]) -> None:
            for run in _runs(lit[piece[0] - begin : piece[1] - begin]):
                low, high = piece[0] + run.start, piece[0] + run.stop
                frames = self._frames(low, high)
                check_counts(frames, low, self.name, camera=self.camera)

        if not self._placed:
            for _ in mapper(read, pieces):
                pass
        ahead = 1 if begin > start else 0  # the first new frame is compared with the last old one
        part = self._frames(begin - ahead, end)
        light, repeats = measure_frames(part, self.camera, mapper=mapper)
        light[light < self._dark_e] = -np.inf
        lit = np.isfinite(light[ahead:])
        for _ in mapper(check, pieces):
            pass
        if not ahead and begin > self.first:  # the frame before is not held
            (earlier,) = self._movie.read(begin - 1, begin)
            repeats[0] = np.array_equal(earlier, part[0])
        self._light = np.concatenate([self._light, light[ahead:]])
        self._repeats = np.concatenate([self._repeats, repeats[ahead:]])
        self._held = (start, end)

    def chunk(self, span: tuple[int, int], stride: int, pool: ThreadPoolExecutor) -> Chunk:
        """Frames of a span, summed in blocks, once for all who ask for it one after the other."""
        if self._summed is not None and self._summed[:2] == (span, stride):
            return self._summed[2]
        counts, good, light = self.counts(*span, pool.map)
        if not good.any():
            raise DataError(
                f"{self.name}: frames {span[0]}:{span[1]} hold no light that changes; every frame "
                "is zero or repeats the one before it; analyse the others with fit.frames = [A, B]"
            )
        chunk = make_chunk(
            span[0], counts, good, light, self.camera,
            stride=stride, defects=find_defects, mapper=pool.map,
            check=self._placed.check if self._placed else lambda: None,
        )  # fmt: skip
        self._summed = span, stride, chunk
        return chunk

    def opening(self, mapper: Mapper = map) -> NDArray[Any]:
        """Good frames among the first, for judging the noise."""
        stop = min(self.last, self.first + NOISE_FRAMES)
        counts, good, light = self.counts(self.first, stop, mapper)
        if self._dark_e > 0:  # of frames with a background
            good = good & well_lit(light)
        used = counts if good.all() else counts[good]
        if len(used) < 2:
            check_counts(counts, self.first, self.name, camera=self.camera)
            raise DataError(f"{self.name}: has no two frames that differ; export it again")
        return used


def sum_first_chunk(reader: Reader, config: Config, window: int) -> None:
    """Sum what will be the first chunk, so that whoever asks for it has it at once.

    Frames that have to be read into memory are left for then: whoever looks at them divided by the
    flicker of their light needs as much room again.
    """
    if not reader.in_place:
        return
    stride = stride_of(window)
    _, span = plan_chunks(reader, config, window, stride)[0]
    with threads(config.compute.workers) as pool:
        reader.chunk(span, stride, pool)


def _runs(flags: BoolArray) -> Iterator[slice]:
    """Yield the ranges in which a mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(np.int8), [0]])))
    for start, stop in edges.reshape(-1, 2):
        yield slice(int(start), int(stop))


def reader_of(movie: CountSource, config: Config, camera: Camera, span: tuple[int, int]) -> Reader:
    """Read frames of a landing movie."""
    dark_e = -math.inf
    if config.optics.scheme != "darkfield" and span[0] < span[1]:
        numbers = np.linspace(span[0], span[1] - 1, _LEVEL_FRAMES).astype(int).tolist()
        some = np.concatenate([movie.read(k, k + 1) for k in numbers])
        light = measure_frames(some, camera)[0]
        lit = light[well_lit(light)]
        if lit.size and np.median(lit) > 0:
            dark_e = DARK * float(np.median(lit))
    return Reader(movie, camera, *span, counts_budget(config), dark_e=dark_e)


def counts_budget(config: Config) -> int:
    """Bytes that the stored counts of a chunk may take."""
    return int(MEMORY_SHARE * config.compute.memory_limit_mb * 1e6)


def plan_chunks(
    reader: Reader,
    config: Config,
    window: int,
    stride: int,
    stretch: tuple[int, int] | None = None,
) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Divide a movie, or a stretch of it; block edges fall on the same frames in every chunk."""
    first, last = stretch or (reader.first, reader.last)
    halo = math.ceil(HALO * window / stride) * stride
    budget = counts_budget(config)
    # beside its counts, a block holds its sum and its map (where the pattern's motion is divided
    # out, that and a spectrum as well), and the field some images in doubles
    pixels = math.prod(reader.shape)
    per_block = 32 if config.background.follows_pattern else 20
    buffers_bytes = per_block * pixels // stride
    if (last - first) * (reader.frame_bytes + buffers_bytes) <= budget - 40 * pixels:
        return [((first, last), (first, last))]
    per_frame = reader.held_bytes + buffers_bytes
    room = (budget - 40 * pixels) // per_frame
    core = (room - 2 * halo) // stride * stride
    if core < stride:
        least = math.ceil((40 * pixels + per_frame * (2 * halo + stride)) / MEMORY_SHARE / 1e6)
        raise DataError(
            f"{reader.name}: windows of {window} frames of {reader.shape[1]} x {reader.shape[0]} "
            f"pixels need compute.memory_limit_mb = {least}; raise it, or lower "
            "background.window_frames"
        )
    count = 2 * math.ceil((last - first) / core / 2)  # which two processes share
    even = (last - first) / count
    # two that are held at once have the room of two
    longer = math.ceil(min(_FIRST_LONGER * even, 2 * core - even) / stride) * stride
    rest = math.ceil((last - first - longer) / (count - 1) / stride) * stride
    edges = [first, *range(first + longer, last, rest), last]
    return [
        ((begin, end), (max(begin - halo, first), min(end + halo, last)))
        for begin, end in pairwise(edges)
    ]
