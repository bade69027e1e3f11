"""Consecutive frames in memory: their light, their sums in blocks, tiles and regions of them.

Frames may lie in several arrays, as in the files of one recording, and are copied region by region.
A tile of a large field has a core, whose particles are its own, and a halo around it as wide as the
picture of a strong particle reaches, so that every particle of the core is analysed with all its
neighbours.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.sliding import block_sums, frame_totals
from iscat_analysis.camera import Camera, find_defects
from iscat_analysis.last_used import LastUsed
from iscat_analysis.records import (
    BoolArray,
    CountSource,
    FloatArray,
    InPlace,
    Mapper,
    PlacedSource,
    Windows,
)

Box = tuple[slice, slice]
"""Rows and columns."""

FloatLike = float | FloatArray

EVERYWHERE: Box = (slice(None), slice(None))
"""All pixels."""


def middle_of_box(box: Box, shape: tuple[int, int], side_px: int) -> Box:
    """Give the middle of a box in an image, of at most a given side."""
    low, high = zip(*(part.indices(n)[:2] for part, n in zip(box, shape, strict=True)), strict=True)
    begins = [max(a, (a + b - side_px) // 2) for a, b in zip(low, high, strict=True)]
    rows, columns = (
        slice(begin, min(begin + side_px, b)) for begin, b in zip(begins, high, strict=True)
    )
    return rows, columns


def is_within(box: Box, y_px: FloatLike, x_px: FloatLike, margin_px: float = 0.0) -> BoolArray:
    """Tell which places are in a box of pixels, or nearer to it than a margin."""
    kept = np.ones(np.shape(y_px), dtype=np.bool_)
    for place, part in zip((y_px, x_px), box, strict=True):
        if part.start is not None:
            kept &= place >= part.start - 0.5 - margin_px
        if part.stop is not None:
            kept &= place < part.stop - 0.5 + margin_px
    return kept


@dataclass(frozen=True)
class Tile:
    """Half-open ranges of full-frame pixels: the core of a tile, and the core with its halo."""

    core_rows: tuple[int, int]
    core_columns: tuple[int, int]
    rows: tuple[int, int]
    columns: tuple[int, int]
    field: tuple[int, int]

    @property
    def here(self) -> Box:
        """Index of the tile in a full frame."""
        return slice(*self.rows), slice(*self.columns)

    @property
    def core(self) -> Box:
        """Index of the core in a full frame."""
        return slice(*self.core_rows), slice(*self.core_columns)

    @property
    def inner(self) -> Box:
        """Index of the core in the tile; without an end where the field ends."""
        return self._core_from(self.corner)

    def _core_from(self, corner: tuple[int, int]) -> Box:
        """Core whose pixels count from a corner; without an end where the field ends."""
        spans = zip((self.core_rows, self.core_columns), corner, self.field, strict=True)
        rows, columns = (
            slice(low - first if low > 0 else None, high - first if high < size else None)
            for (low, high), first, size in spans
        )
        return rows, columns

    @property
    def corner(self) -> tuple[int, int]:
        """First row and first column."""
        return self.rows[0], self.columns[0]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that the tile has, with its halo."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]

    @property
    def share(self) -> float:
        """Share of the field that the core has."""
        (top, bottom), (left, right) = self.core_rows, self.core_columns
        return (bottom - top) * (right - left) / math.prod(self.field)

    @property
    def is_central(self) -> bool:
        """Whether its core holds the middle of the field."""
        y, x = ((n - 1) / 2 for n in self.field)
        return bool(self.holds(y, x))

    def holds(self, y_px: FloatLike, x_px: FloatLike, margin_px: float = 0.0) -> BoolArray:
        """Tell which places of the field are in the core; beyond the edge of the field it goes on.

        Shapes: `y_px, x_px` (n,), result (n,).
        """
        return is_within(self._core_from((0, 0)), y_px, x_px, margin_px)


def cut_field(shape: tuple[int, int], parts: tuple[int, int], halo_px: int) -> list[Tile]:
    """Cut a field into so many rows and columns of tiles."""

    def ranges(size: int, number: int) -> list[tuple[tuple[int, int], tuple[int, int]]]:
        edges = np.linspace(0, size, number + 1).round().astype(int).tolist()
        cores = pairwise(edges)
        return [((a, b), (max(a - halo_px, 0), min(b + halo_px, size))) for a, b in cores]

    return [
        Tile(core_rows, core_columns, rows, columns, shape)
        for core_rows, rows in ranges(shape[0], parts[0])
        for core_columns, columns in ranges(shape[1], parts[1])
    ]


@dataclass(frozen=True)
class FieldSums:
    """What some frames say of the whole field, or of a tile: made once for all of its tiles.

    The mean light of a pixel and frame, `level_e`, is always that of the whole field.

    Shapes: `good, power` (t,), the others (y, x).
    """

    span: tuple[int, int]
    good: BoolArray
    power: FloatArray
    level_e: float
    mean_e: FloatArray
    usable: BoolArray
    saturated: BoolArray

    def part(self, here: Box) -> FieldSums:
        """Copy what belongs to some pixels."""
        return replace(
            self,
            mean_e=self.mean_e[here].copy(),
            usable=self.usable[here].copy(),
            saturated=self.saturated[here].copy(),
        )


_SPREAD = 2  # times the frames that are asked for, that lie between the first and the last
_NO_COUNTS: NDArray[Any] = np.empty((0, 0, 0))


class StoredFrames:
    """Arrays of frames, one after the other, indexed as one array (t, y, x); or a box of them."""

    def __init__(self, parts: Sequence[NDArray[Any]], box: Box = EVERYWHERE) -> None:
        self._parts = parts
        ends = (part.indices(n)[:2] for part, n in zip(box, parts[0].shape[1:], strict=True))
        self._rows, self._columns = ends
        self._edges = np.cumsum([0, *map(len, parts)]).tolist()
        self.shape = (
            int(self._edges[-1]),
            self._rows[1] - self._rows[0],
            self._columns[1] - self._columns[0],
        )
        self.dtype = parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def views(self, start: int, stop: int, box: Box = EVERYWHERE) -> StoredFrames:
        """View a box of pixels in frames ``[start, stop)``."""
        held = list(zip(pairwise(self._edges), self._parts, strict=True))
        near = [one for one in held if one[0][0] < stop and start < one[0][1]] or held[:1]
        parts = [part[max(start - low, 0) : stop - low] for (low, _), part in near]
        ends = (part.indices(n)[:2] for part, n in zip(box, self.shape[1:], strict=True))
        rows, columns = (
            slice(first + low, first + high)
            for (first, _), (low, high) in zip((self._rows, self._columns), ends, strict=True)
        )
        return StoredFrames(parts, (rows, columns))

    def array(self, start: int, stop: int, box: Box = EVERYWHERE) -> NDArray[Any]:
        """Give a box of pixels in frames ``[start, stop)``: a view where one array has them all.

        Shapes: result (stop − start, y, x).
        """
        seen = self.views(start, stop, box)
        here = slice(None), slice(*seen._rows), slice(*seen._columns)
        parts = [part[here] for part in seen._parts]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def whole(self, start: int, stop: int) -> tuple[NDArray[Any], tuple[int, int]]:
        """Give contiguous frames ``[start, stop)``, and where in them these pixels begin.

        Shapes: result (stop − start, all y, all x).
        """
        seen = self.views(start, stop)
        if len(seen._parts) == 1 and seen._parts[0].flags.c_contiguous:
            return seen._parts[0], (self._rows[0], self._columns[0])
        return np.ascontiguousarray(seen.array(0, stop - start)), (0, 0)


def frames_in_place(movie: CountSource, start: int, stop: int) -> list[InPlace]:
    """Map frames where they lie, in as few runs as there are; nothing if some have to be read."""
    if not isinstance(movie, PlacedSource):
        return []
    found: list[InPlace] = []
    while start < stop:
        run, first = movie.in_place(start, stop), start
        if run is None:  # the longest that there is
            ends = range(start + 1, stop)
            count = bisect_left(ends, True, key=lambda end: movie.in_place(first, end) is None)
            run = movie.in_place(start, start + count) if count else None
        if run is None:
            return []
        found.append(run)
        start += len(run.counts)
    return found


HALF = 0.5
"""Share of the usual light, below which a shutter is not open."""

DARK = 0.05
"""Share of the usual light, below which it is closed."""

# Of the light of a frame's first and last rows, and of these over the middle one's
_LEAST_EDGE_LIGHT = 0.1
_COPIED = 256  # frames of a region that are copied together from a file


@dataclass(frozen=True)
class Chunk(FieldSums):
    """Consecutive frames in memory, with their power and their sums in blocks."""

    counts: StoredFrames
    camera: Camera
    edges: NDArray[np.int64]
    blocks_e: NDArray[np.float32]  # a millionth of their noise is lost
    check: Callable[[], None]
    let_go: Callable[[], None]  # of pages of the file, once a region was copied
    lends_blocks: bool  # whether maps may take their memory: nobody else asks for this chunk
    _held: LastUsed[tuple[int, NDArray[Any]]] = field(
        init=False, repr=False, default_factory=lambda: LastUsed(40_000_000)
    )
    """The regions that were copied last: steps at one place ask for them in each of their fits."""

    @property
    def first(self) -> int:
        """Number of the first frame."""
        return self.span[0]

    @property
    def stop(self) -> int:
        """One past the last frame."""
        return self.first + len(self.counts)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.counts.shape[1], self.counts.shape[2]

    def cut(self, start: int, stop: int) -> slice:
        """Index of frames [start, stop), clipped to those held."""
        return slice(max(start - self.first, 0), max(min(stop, self.stop) - self.first, 0))

    def patch(
        self, start: int, stop: int, rows: tuple[int, int], columns: tuple[int, int]
    ) -> Patch:
        """Copy a region of frames together, for all that is asked of it."""
        self.check()
        here, pixels = self.cut(start, stop), (slice(*rows), slice(*columns))
        camera = self.camera
        counts = self._region(here, rows, columns)
        return Patch(
            first=self.first + here.start,
            counts=counts,
            good=self.good[here],
            power=self.power[here],
            gain=_at(camera.gain_e_per_adu, pixels),
            offset=_at(camera.offset_adu, pixels),
            read_noise_e=_at(camera.read_noise_e, pixels),
            mean_e=self.mean_e[pixels],
            usable=self.usable[pixels],
            saturated=self.saturated[pixels],
        )

    def electrons(self, frames: slice, box: Box) -> FloatArray:
        """Sum the good ones of some frames of the chunk over a box of pixels, without a copy.

        Shapes: result (ny, nx).
        """
        self.check()
        counts, (top, left) = self.counts.whole(frames.start, frames.stop)
        rows, columns = (part.indices(n) for part, n in zip(box, self.shape, strict=True))
        sums = np.zeros((rows[1] - rows[0], columns[1] - columns[0]))
        good = self.good[frames]
        row, nothing = row_of_sums(counts.dtype, sums.shape[1]), np.empty((0, 0), counts.dtype)
        block_sums(counts, (top + rows[0], left + columns[0]), good, row, sums, nothing)
        self.let_go()
        dark = np.count_nonzero(good) * _at(self.camera.offset_adu, box)
        return np.asarray(_at(self.camera.gain_e_per_adu, box) * (sums - dark))

    def _region(
        self, wanted: slice, rows: tuple[int, int], columns: tuple[int, int]
    ) -> NDArray[Any]:
        """Give frames of a region, of which those that are not held yet are copied.

        Shapes: result (t, y, x).
        """
        low, held = self._held.get((rows, columns)) or (wanted.start, _NO_COUNTS)
        high = low + len(held)
        first, last = min(low, wanted.start), max(high, wanted.stop)
        if last - first > _SPREAD * (len(held) + wanted.stop - wanted.start):
            return self._copied(wanted, rows, columns)
        parts = [self._copied(slice(first, low), rows, columns)] if first < low else []
        parts += [held] if len(held) else []
        if high < last or not parts:
            parts.append(self._copied(slice(high, last), rows, columns))
        counts = parts[0] if len(parts) == 1 else np.concatenate(parts)
        self._held.hold((rows, columns), (first, counts), counts.nbytes)
        return counts[wanted.start - first : wanted.stop - first]

    def _copied(
        self, frames: slice, rows: tuple[int, int], columns: tuple[int, int]
    ) -> NDArray[Any]:
        """Copy a region; of a file that is let go a few frames at a time: each maps megabytes."""
        if self.let_go is _nothing or frames.stop - frames.start <= _COPIED:
            ends = zip((rows, columns), self.shape, strict=True)
            if not all(0 <= low <= high <= size for (low, high), size in ends):
                where = f"rows {rows} and columns {columns}"
                raise IndexError(f"{where} of frames of shape {self.shape}")
            seen = self.counts.array(frames.start, frames.stop, (slice(*rows), slice(*columns)))
            counts = seen if seen.base is None else seen.copy()
            self.let_go()
            return counts
        edges = range(frames.start, frames.stop, _COPIED)
        parts = (slice(start, min(start + _COPIED, frames.stop)) for start in edges)
        return np.concatenate([self._copied(part, rows, columns) for part in parts])


@dataclass(frozen=True)
class Patch:
    """A region of consecutive frames."""

    first: int
    counts: NDArray[Any]
    good: BoolArray
    power: FloatArray
    gain: float | FloatArray
    offset: float | FloatArray
    read_noise_e: float | FloatArray
    mean_e: FloatArray
    usable: BoolArray
    saturated: BoolArray

    @property
    def pixels(self) -> NDArray[Any]:
        """Stored counts, shape (t, ny·nx): longer loops than those along a row."""
        return self.counts.reshape(len(self.counts), self.mean_e.size)

    def frames(self, start: int, stop: int) -> Patch:
        """Select some of the frames, without a copy."""
        here = slice(max(start - self.first, 0), max(stop - self.first, 0))
        parts = {"counts": self.counts[here], "good": self.good[here], "power": self.power[here]}
        return replace(self, first=self.first + here.start, **parts)

    def window(self, start: int, stop: int) -> tuple[FloatArray, int, float]:
        """Sum frames.

        Shapes: `electrons` (ny, nx).
        """
        part = self.frames(start, stop)
        out = part.counts[part.good].sum(axis=0, dtype=np.float64)
        frames = int(np.count_nonzero(part.good))
        return self.gain * (out - frames * self.offset), frames, float(part.power.sum())

    def windows(self, before: tuple[int, int], after: tuple[int, int]) -> Windows:
        """Sum the frames before and after something; without light before, their ratio is 0."""
        before_e, n_before, light = self.window(*before)
        after_e, n_after, power = self.window(*after)
        read = np.broadcast_to(np.square(self.read_noise_e, dtype=np.float64), before_e.shape)
        return Windows(
            before_e=before_e,
            after_e=after_e,
            n_before=n_before,
            n_after=n_after,
            power_ratio=power / light if light > 0 else 0.0,
            read_variance_before_e2=n_before * read,
            read_variance_after_e2=n_after * read,
            masked=~self.usable,
            saturated=self.saturated,
            frames_before=before,
            frames_after=after,
            power=np.empty(0),
        )

    def part(self, rows: slice, columns: slice) -> Patch:
        """Copy some of its pixels, which count from its own first one."""
        here = rows, columns
        return replace(
            self,
            counts=self.counts[:, rows, columns].copy(),
            gain=_at(self.gain, here),
            offset=_at(self.offset, here),
            read_noise_e=_at(self.read_noise_e, here),
            mean_e=self.mean_e[here],
            usable=self.usable[here],
            saturated=self.saturated[here],
        )


def measure_frames(
    counts: NDArray[Any], camera: Camera, *, mapper: Mapper = map
) -> tuple[FloatArray, BoolArray]:
    """Light of every frame, and which frames repeat the one before them.

    Shapes: `counts` (t, y, x), `light_e` (t,), `repeats` (t,).
    """
    whole = np.issubdtype(counts.dtype, np.integer)
    totals = np.empty(len(counts), dtype=np.int64 if whole else np.float64)
    repeats = np.zeros(len(counts), dtype=np.bool_)
    zero = totals.dtype.type(0)

    def some(start: int) -> None:
        # one frame more in front, so that the first of these is compared as well
        begin = max(start - 1, 0)
        part = counts[begin : start + 64]
        sums, same = np.empty(len(part), dtype=totals.dtype), np.empty(len(part), dtype=np.bool_)
        frame_totals(part, zero, sums, same)
        skip = start - begin
        totals[start : start + len(part) - skip] = sums[skip:]
        repeats[start : start + len(part) - skip] = same[skip:]

    list(mapper(some, range(0, len(counts), 64)))
    pixels = counts.shape[1] * counts.shape[2]
    maps = np.ndim(camera.gain_e_per_adu) > 0
    if maps:
        gain = np.asarray(camera.gain_e_per_adu, dtype=np.float64)
        weighted = np.array([float(np.vdot(gain, frame)) for frame in counts])
        light = (weighted - float(np.sum(gain * camera.offset_adu))) / pixels
    else:
        light = camera.gain_e_per_adu * (totals / pixels - float(np.mean(camera.offset_adu)))
    return np.where((totals == 0) | cut_off(counts, camera), -np.inf, light), repeats


def cut_off(counts: NDArray[Any], camera: Camera) -> BoolArray:
    """Tell which frames lack their first or last rows, as after an interrupted transfer.

    Shapes: `counts` (t, y, x), result (t,).
    """
    ends = [0, counts.shape[1] // 2, -1]
    offset, gain = (
        np.broadcast_to(part, counts.shape[1:])[ends].mean(axis=1)
        for part in (camera.offset_adu, camera.gain_e_per_adu)
    )
    light = gain * (counts[:, ends].mean(axis=2, dtype=np.float64) - offset)
    usual = np.median(light, axis=0)
    # photoelectrons of a row, without which it tells nothing
    bright_enough = (usual > _LEAST_EDGE_LIGHT * usual[1]) & (usual * counts.shape[2] > 400.0)
    found: BoolArray = ((light < _LEAST_EDGE_LIGHT * usual) & bright_enough).any(axis=1)
    return found


def well_lit(light_e: FloatArray, least: float = HALF) -> BoolArray:
    """Tell which frames have the usual light, unlike those of a closed or opening shutter.

    Shapes: `light_e` (t,), result (t,).
    """
    lit: BoolArray = np.isfinite(light_e)
    if lit.any():
        known = light_e[lit]
        # quantile of the light of frames
        usual = float(np.quantile(known, 0.75))
        change = float(np.median(np.abs(np.diff(known)))) if known.size > 1 else 0.0
        # Times the usual change from one frame to the next, that it takes at least
        lit &= usual - light_e <= max((1 - least) * usual, 8.0 * change)
    return lit


def good_frames(counts: NDArray[Any], camera: Camera) -> BoolArray:
    """Tell which frames have the usual light, and do not repeat the one before.

    Shapes: `counts` (t, y, x), result (t,).
    """
    light, repeats = measure_frames(counts, camera)
    return well_lit(light) & ~repeats


def summed(counts: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[Any]]:
    """Sum frames, and find the highest count of every pixel.

    Shapes: `counts` (t, y, x), `sums, highest` (y, x).
    """
    sums, highest = np.zeros(counts.shape[1:], dtype=np.float32), counts[0].copy()
    good = np.ones(len(counts), dtype=np.bool_)
    block_sums(counts, (0, 0), good, row_of_sums(counts.dtype, counts.shape[2]), sums, highest)
    return sums, highest


def row_of_sums(stored: np.dtype[Any], columns: int) -> NDArray[Any]:
    """Room for a row of a block's sum, which holds it exactly."""
    exact = (np.uint32 if stored.itemsize <= 2 else np.int64) if stored.kind in "ui" else np.float64
    return np.empty(columns, dtype=exact)


def sums_of(
    span: tuple[int, int],
    good: BoolArray,
    light_e: FloatArray,
    electrons: FloatArray,
    highest: NDArray[Any],
    camera: Camera,
) -> FieldSums:
    """Say which light frames have, and which pixels of their sum can be used.

    Shapes: `good, light_e` (t,), `electrons, highest` (y, x).
    """
    power = np.where(good, light_e, 0.0)
    power /= power[good].mean()
    saturated = camera.saturated(highest)
    variance = camera.read_variance_e2((electrons.shape[0], electrons.shape[1]))
    defective = find_defects(electrons, np.count_nonzero(good) * variance)
    usable = ~(saturated | defective) & (electrons > 0)
    mean = electrons / power.sum()
    return FieldSums(span, good, power, float(mean.mean()), mean, usable, saturated)


def make_chunk(
    first: int,
    counts: NDArray[Any] | StoredFrames,
    good: BoolArray,
    light_e: FloatArray,
    camera: Camera,
    *,
    stride: int,
    sums: FieldSums | None = None,
    mapper: Mapper = map,
    check: Callable[[], None] = lambda: None,
    let_go: Callable[[], None] | None = None,
) -> Chunk:
    """Sum consecutive frames in blocks; `sums` are those of the field, where they are of a tile.

    Shapes: `counts` (t, y, x), `good` (t,), `light_e` (t,).
    """
    stored = counts if isinstance(counts, StoredFrames) else StoredFrames([counts])
    frames, rows, columns = stored.shape
    edges = np.append(np.arange(0, frames, stride), frames).astype(np.int64)
    blocks = np.zeros((edges.size - 1, rows, columns), dtype=np.float32)
    offset, end = np.asarray(camera.offset_adu), let_go or _nothing
    highest = np.empty(blocks.shape if sums is None else (len(blocks), 0, 0), dtype=stored.dtype)

    def one(k: int) -> None:
        check()
        block, (top, left) = stored.whole(int(edges[k]), int(edges[k + 1]))
        lit = good[edges[k] : edges[k + 1]]
        if sums is None:
            highest[k] = block[np.argmax(lit), top : top + rows, left : left + columns]
        row = row_of_sums(stored.dtype, columns)
        block_sums(block, (top, left), lit, row, blocks[k], highest[k])
        blocks[k] -= np.count_nonzero(lit) * offset
        blocks[k] *= camera.gain_e_per_adu
        end()

    list(mapper(one, range(edges.size - 1)))
    if sums is None:
        electrons = blocks.sum(axis=0, dtype=np.float64)
        span = first, first + frames
        sums = sums_of(span, good, light_e, electrons, highest.max(axis=0), camera)
    of_frames: dict[str, Any] = {"counts": stored, "camera": camera, "edges": edges}
    of_frames |= {"blocks_e": blocks, "check": check, "let_go": end}
    return Chunk(**vars(sums), **of_frames, lends_blocks=let_go is not None)


def _nothing() -> None:
    """Keep the pages of the frames."""


def _at(value: float | FloatArray, here: tuple[slice, slice]) -> Any:
    """Return a number, or the region of a map."""
    return value[here] if isinstance(value, np.ndarray) else value
