"""The frames of a landing movie, read once, in parts that fit into memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product, repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label

from iscat_analysis._kernels.sliding import block_sums
from iscat_analysis.camera import Camera, check_counts, sampled
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.movie.mapped import Scratch
from iscat_analysis.records import BoolArray, CountSource, FloatArray, Mapper
from iscat_analysis.search.frames import (
    DARK,
    EVERYWHERE,
    Box,
    Chunk,
    FieldSums,
    StoredFrames,
    Tile,
    cut_field,
    frames_in_place,
    make_chunk,
    measure_frames,
    row_of_sums,
    sums_of,
    well_lit,
)
from iscat_analysis.search.sliding import stride_of
from iscat_analysis.search.templates import LARGEST_IMAGE
from iscat_analysis.threads import threads

NOISE_FRAMES = 800
"""Frames on which the noise is judged, and the windows are chosen."""

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
        self.placed = frames_in_place(movie, first, last)
        # made at once, because growing copies; only what is written to takes memory
        room = min(max(last - first, 0), room_bytes // self.frame_bytes)
        if len(self.placed) > 1 and room == last - first:  # of several files, that all fit
            self.placed = []
        if self.placed:
            room = 0
            self._lying = StoredFrames([run.counts for run in self.placed])
        self._buffer = np.empty((room, *self.shape), dtype=movie.dtype)
        self._room_bytes = room_bytes
        self._scratch: Scratch | None = None  # frames that do not fit into memory
        self._held = (first, first)
        self._light: FloatArray = np.empty(0)
        self._repeats: BoolArray = np.empty(0, dtype=np.bool_)
        self._summed: tuple[tuple[int, int], int, Chunk] | None = None  # span, stride, and that

    @property
    def held_bytes(self) -> int:
        """What a frame of a chunk counts for: half where it stays in one file.

        The system can take such pages back, but would have to read them again.
        """
        return self.frame_bytes // 2 if len(self.placed) == 1 else self.frame_bytes

    @cached_property
    def sampled(self) -> Reader:
        """A reader of a sample of the pixels, by which noise is judged; itself of a small field."""
        movie, camera = sampled(self._movie, self.camera)
        if movie is self._movie:
            return self
        return Reader(movie, camera, self.first, self.last, self._room_bytes, dark_e=self._dark_e)

    def forget_sample(self) -> None:
        """Release the frames of the sample of the pixels, where there is one."""
        if self.sampled is not self:
            self.sampled.forget()

    def read(self, start: int, stop: int) -> NDArray[Any]:
        """Read frames of the movie, without keeping them."""
        return self._movie.read(start, stop)

    @property
    def name(self) -> str:
        """What messages call the movie."""
        return self._movie.name

    def forget(self) -> None:
        """Release the memory of the frames."""
        self._let_go()
        self._buffer = self._buffer[:0].copy()
        self._scratch = None
        self._held = (self.first, self.first)
        self._summed = None

    def _let_go(self) -> None:
        """Give back the memory of frames that lie in files."""
        for run in self.placed:
            run.let_go()
        if self._scratch is not None:
            self._scratch.let_go()

    def _check(self) -> None:
        """Refuse files that have become shorter."""
        for run in self.placed:
            run.check()

    def _keep(self, kept: slice, room: int) -> None:
        """Leave only some of the frames, with room for more behind them."""
        if self.placed:
            self._let_go()
            return
        frames, old = self._buffer[kept], self._buffer
        if room > len(old):
            shape = (room, *self.shape)
            if room * self.frame_bytes > self._room_bytes:
                self._scratch = Scratch(shape, self._movie.dtype)
                self._buffer = self._scratch.array
            else:
                self._buffer = np.empty(shape, dtype=self._movie.dtype)
        if self._buffer is not old or kept.start:
            step = self._at_once(len(frames))
            for start in range(0, len(frames), step):  # forward, so that none is overwritten
                part = frames[start : start + step]
                self._buffer[start : start + len(part)] = part
                self._let_go()

    def _at_once(self, frames: int) -> int:
        """Count the frames that are looked at together: all, where they fit into memory."""
        if frames * self.frame_bytes <= self._room_bytes:
            return max(frames, 1)
        # of frames that are looked at together where not all fit into memory
        return max(8, (2**26) // self.frame_bytes)

    def _frames(self, start: int, stop: int) -> NDArray[Any]:
        """Frames [start, stop) of those that are held, as one array."""
        return self._stored(start, stop).array(0, stop - start)

    def _stored(self, start: int, stop: int, box: Box = EVERYWHERE) -> StoredFrames:
        """Frames [start, stop) of those that are held, where they lie."""
        if self.placed:
            self._check()
            return self._lying.views(start - self.first, stop - self.first, box)
        first = self._held[0]
        return StoredFrames([self._buffer]).views(start - first, stop - first, box)

    def counts(self, start: int, stop: int) -> tuple[NDArray[Any], BoolArray, FloatArray]:
        """Frames [start, stop), which of them are good, and their light [e per pixel]."""
        good, light = self._hold(start, stop, map)
        return self._frames(start, stop), good, light

    def _hold(self, start: int, stop: int, mapper: Mapper) -> tuple[BoolArray, FloatArray]:
        """Hold frames [start, stop); tell which of them are good, and their light."""
        low, high = self._held
        if low != start or stop > high:  # a part of them stays with the others
            self._summed = None
            kept = min(high, stop) - start if low <= start < high else 0
            known = slice(start - low, start - low + kept) if kept else slice(0, 0)
            self._keep(known, stop - start)
            self._light, self._repeats = self._light[known], self._repeats[known]
            self._held = (start, start + kept)
            step = self._at_once(stop - start)
            for end in (*range(self._held[1] + step, stop, step), stop):
                self._append(end, mapper)
                if step < stop - start:
                    self._let_go()
        light = self._light[: stop - start]
        return np.isfinite(light) & ~self._repeats[: stop - start], light

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
            for (run,) in find_objects(label(lit[piece[0] - begin : piece[1] - begin])[0]):
                low, high = piece[0] + run.start, piece[0] + run.stop
                frames = self._frames(low, high)
                check_counts(frames, low, self.name, camera=self.camera)

        if not self.placed:
            list(mapper(read, pieces))
        ahead = 1 if begin > start else 0  # the first new frame is compared with the last old one
        part = self._frames(begin - ahead, end)
        light, repeats = measure_frames(part, self.camera, mapper=mapper)
        light[light < self._dark_e] = -np.inf
        lit = np.isfinite(light[ahead:])
        list(mapper(check, pieces))
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
        good, light = self._lit(span, pool)
        frames = span[0], self._frames(*span), good, light, self.camera
        chunk = make_chunk(*frames, stride=stride, mapper=pool.map, check=self._check)
        self._summed = span, stride, chunk
        return chunk

    def field_sums(self, span: tuple[int, int], pool: ThreadPoolExecutor) -> FieldSums:
        """Sum the frames of a span over the whole field, for all of its tiles."""
        good, light = self._lit(span, pool)
        counts = self._stored(*span)
        total, highest = np.zeros(self.shape), np.zeros(self.shape, dtype=self._movie.dtype)
        # of rows, whose sums over the frames are made at a time
        bands = list(pairwise(np.linspace(0, self.shape[0], 4 + 1).astype(int).tolist()))

        def add(band: tuple[int, int], frames: NDArray[Any], lit: BoolArray) -> None:
            rows = slice(*band)
            row = row_of_sums(counts.dtype, self.shape[1])
            block_sums(frames, (band[0], 0), lit, row, total[rows], highest[rows])

        step = self._at_once(len(counts))
        for start in range(0, len(counts), step):
            frames, _ = counts.whole(start, min(start + step, len(counts)))
            lit = good[start : start + step]
            list(pool.map(add, bands, repeat(frames), repeat(lit)))
            self._let_go()
        dark = np.count_nonzero(good) * np.asarray(self.camera.offset_adu)
        electrons = self.camera.gain_e_per_adu * (total - dark)
        return sums_of(span, good, light, electrons, highest, self.camera)

    def tile_chunk(
        self, sums: FieldSums, tile: Tile, stride: int, pool: ThreadPoolExecutor
    ) -> Chunk:
        """Frames of one tile, summed in blocks."""
        if not self.placed:
            self._hold(*sums.span, pool.map)
        counts, camera = self._stored(*sums.span, tile.here), self.camera.part(tile.here)
        part = sums.span[0], counts, sums.good, sums.power, camera
        return make_chunk(
            *part, stride=stride, sums=sums, mapper=pool.map, check=self._check, let_go=self._let_go
        )

    def _lit(self, span: tuple[int, int], pool: ThreadPoolExecutor) -> tuple[BoolArray, FloatArray]:
        """Tell which frames of a span are good, and their light; refused where none is."""
        good, light = self._hold(*span, pool.map)
        if not good.any():
            raise DataError(
                f"{self.name}: frames {span[0]}:{span[1]} hold no light that changes; every frame "
                "is zero or repeats the one before it; analyse the others with fit.frames = [A, B]"
            )
        return good, light

    def opening(self) -> NDArray[Any]:
        """Good frames among the first, for judging the noise."""
        stop = min(self.last, self.first + NOISE_FRAMES)
        counts, good, light = self.counts(self.first, stop)
        if self._dark_e > 0:  # of frames with a background
            good = good & well_lit(light)
        used = counts if good.all() else counts[good]
        if len(used) < 2:
            check_counts(counts, self.first, self.name, camera=self.camera)
            raise DataError(f"{self.name}: has no two frames that differ; export it again")
        return used


def reader_of(movie: CountSource, config: Config, camera: Camera, span: tuple[int, int]) -> Reader:
    """Read frames of a landing movie."""
    dark_e = -math.inf
    if config.optics.interferes and span[0] < span[1]:
        # 24 frames all over a movie tell how much light there is
        numbers = np.linspace(span[0], span[1] - 1, 24).astype(int).tolist()
        seen, theirs = sampled(movie, camera)
        some = np.concatenate([seen.read(k, k + 1) for k in numbers])
        light = measure_frames(some, theirs)[0]
        lit = light[well_lit(light)]
        if lit.size and np.median(lit) > 0:
            dark_e = DARK * float(np.median(lit))
    return Reader(movie, camera, *span, counts_budget(config), dark_e=dark_e)


def counts_budget(config: Config) -> int:
    """Bytes that the stored counts of a chunk may take."""
    return int(MEMORY_SHARE * config.compute.memory_limit_mb * 1e6)


HALO = 2
"""Windows on either side of a chunk's core: a step, its neighbours, and theirs."""

_SPAN_BYTES = 6e9  # of the frames of a chunk of a large field: they stay in the system's cache
_SUM_BYTES, _MAP_BYTES, _HIGHEST_BYTES = 4, 4, 2  # of a pixel of a block
_TILE_BYTES = 160  # of a pixel of a tile, beside its blocks and maps


@dataclass(frozen=True)
class Part:
    """A chunk of a movie, or one tile of it; in some the noise where nothing lands is measured."""

    core: tuple[int, int]
    span: tuple[int, int]
    tile: Tile | None = None
    controlled: bool = True


def plan_parts(
    reader: Reader,
    config: Config,
    window: int,
    stretch: tuple[int, int] | None = None,
    *,
    in_place: bool = True,
) -> list[list[Part]]:
    """Divide a movie, or a stretch of it, into chunks, and each chunk of a large field into tiles.

    Block edges fall on the same frames in every chunk.  Maps of a tile take no memory of their own
    where they are made in place.
    """
    first, last = stretch or (reader.first, reader.last)
    stride, halo = stride_of(window), halo_frames(window)
    core = plan_chunks(reader, config, window, last - first)
    tiles: Sequence[Tile | None] = [None]
    if not core:
        parts, core = choose_tiles(reader, config, window, last - first, in_place=in_place)
        tiles = cut_field(reader.shape, parts, halo_px(config))
    count = max(math.ceil((last - first) / core), 1)
    even = max(math.ceil((last - first) / count / stride), 1) * stride
    # tiles of a movie, or some more, tell enough of the noise where nothing lands
    every = max(1, count * len(tiles) // 16) if tiles[0] else 1
    return [
        [
            Part(
                (begin, end),
                (max(begin - halo, first), min(end + halo, last)),
                tile,
                controlled=(number * len(tiles) + place) % every == 0,
            )
            for place, tile in enumerate(tiles)
        ]
        for number, (begin, end) in enumerate(pairwise([*range(first, last, even), last]))
    ]


def halo_px(config: Config) -> int:
    """Width of the halo of a tile: from a fitted square to the centre of its farthest neighbour."""
    return math.ceil((LARGEST_IMAGE + 0.5) * config.roi_px) + 2


def halo_frames(window: int) -> int:
    """Length of the halo of a chunk."""
    stride = stride_of(window)
    return math.ceil(HALO * window / stride) * stride


def choose_tiles(
    reader: Reader, config: Config, window: int, frames: int, *, in_place: bool
) -> tuple[tuple[int, int], int]:
    """Choose rows and columns of tiles, and the frames of a core, that look at least at halos."""
    side, halo, stride = halo_px(config), halo_frames(window), stride_of(window)
    smallest = config.roi_px
    per_block = _SUM_BYTES + _moving_bytes(config) + (0 if in_place else _MAP_BYTES)
    # of what counts may take; the images and regions of its steps have the rest
    budget, per_frame = 0.63 * counts_budget(config), per_block / stride
    longest = int(_SPAN_BYTES // reader.frame_bytes)
    rows, columns = reader.shape
    choices: list[tuple[float, tuple[int, int], int]] = []
    for high, wide in product(range(1, rows // smallest + 1), range(1, columns // smallest + 1)):
        pixels = _largest(rows, high, side) * _largest(columns, wide, side)
        room = min(int((budget / pixels - _TILE_BYTES) / per_frame), longest)
        core = frames if room >= frames else (room - 2 * halo) // stride * stride
        if core >= stride:
            looked_at = (rows + 2 * side * (high - 1)) * (columns + 2 * side * (wide - 1))
            choices.append((looked_at * min(core + 2 * halo, frames) / core, (high, wide), core))
    if not choices:
        needed = min(2 * halo + stride, frames)
        if needed > longest:
            raise DataError(
                f"{reader.name}: windows of {window} frames need {needed} frames at a time, and "
                f"{_SPAN_BYTES / 1e9:g} GB hold {longest} of {columns} x {rows} pixels: lower "
                "background.window_frames, or cut the field"
            )
        of_pixel = _TILE_BYTES + per_frame * needed
        share = (smallest + 2 * side) ** 2 * of_pixel / budget
        least = config.compute.memory_limit_mb * share
        raise DataError(
            f"{reader.name}: windows of {window} frames of {columns} x {rows} pixels need "
            f"compute.memory_limit_mb = {math.ceil(least)}; raise it, or lower "
            "background.window_frames"
        )
    _, tiles, core = min(choices, key=lambda choice: choice[0])
    return tiles, core


def _largest(size: int, parts: int, halo: int) -> int:
    """Count the rows of the largest of so many tiles; the first and the last have one halo."""
    return min(math.ceil(size / parts) + min(parts - 1, 2) * halo, size)


def _moving_bytes(config: Config) -> int:
    """Bytes of a pixel of a block for the motion of the pattern: its contrast and a spectrum."""
    return 12 if config.background.follows_pattern else 0


def plan_chunks(reader: Reader, config: Config, window: int, frames: int) -> int:
    """Give the frames of a core where the field is not divided; 0 where it has to be."""
    halo, stride = halo_frames(window), stride_of(window)
    # beside counts and blocks, the field holds some images in doubles
    pixels = math.prod(reader.shape)
    budget = counts_budget(config) - 40 * pixels
    per_block = _SUM_BYTES + _MAP_BYTES + _HIGHEST_BYTES + _moving_bytes(config)
    buffers_bytes = per_block * pixels // stride
    if frames * (reader.frame_bytes + buffers_bytes) <= budget:
        return max(frames, 1)
    core = (budget // (reader.held_bytes + buffers_bytes) - 2 * halo) // stride * stride
    return core if core >= max(halo, stride) else 0  # else most of the work would be that of halos


def sum_first_chunk(reader: Reader, config: Config, window: int) -> None:
    """Sum what will be the first chunk, so that whoever asks for it has it at once.

    Frames that have to be read into memory are left for then: whoever looks at them divided by the
    flicker of their light needs as much room again.
    """
    if not reader.placed:
        return
    first, *_ = plan_parts(reader, config, window)[0]
    if first.tile is None:
        with threads(config.compute.workers) as pool:
            reader.chunk(first.span, stride_of(window), pool)
