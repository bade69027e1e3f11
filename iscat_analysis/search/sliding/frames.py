"""Consecutive frames in memory: their light, their sums in blocks, regions of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.sliding import block_sums, frame_totals, region_sum
from iscat_analysis._kernels.stepping import part_sums
from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import BoolArray, FloatArray, Mapper
from iscat_analysis.search.sliding.stored import HeldRegions, StoredFrames
from iscat_analysis.search.sliding.tiles import Box, FieldSums

HALF = 0.5
"""Share of the usual light, below which a shutter is not open."""

DARK = 0.05
"""Share of the usual light, below which it is closed."""

# Times the usual change from one frame to the next, that it takes at least
_LEAST_CHANGE_RATIO = 8.0
# Of the light of a frame's first and last rows, and of these over the middle one's
_LEAST_EDGE_LIGHT = 0.1
_EDGE_E = 400.0  # photoelectrons of a row, without which it tells nothing
_COPIED = 256  # frames of a region that are copied together from a file
_LIGHT_QUANTILE = 0.75  # quantile of the light of frames


@dataclass(frozen=True)
class Chunk:
    """Consecutive frames in memory, with their power."""

    first: int
    counts: StoredFrames
    good: BoolArray
    power: FloatArray
    camera: Camera
    mean_e: FloatArray
    usable: BoolArray
    saturated: BoolArray
    edges: NDArray[np.int64]
    blocks_e: NDArray[np.float32]  # a millionth of their noise is lost
    check: Callable[[], None]
    let_go: Callable[[], None]  # of pages of the file, once a region was copied
    level_e: float  # mean light of a pixel and frame, of the whole field
    lends_blocks: bool  # whether maps may take their memory: nobody else asks for this chunk
    _regions: HeldRegions = field(init=False, repr=False, default_factory=HeldRegions)

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
        counts = self._regions.frames(here, rows, columns, self._copied)
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
        block_sums(
            counts, (top + rows[0], left + columns[0]), good,
            row_of_sums(counts.dtype, sums.shape[1]), sums, np.empty((0, 0), dtype=counts.dtype),
        )  # fmt: skip
        self.let_go()
        dark = np.count_nonzero(good) * _at(self.camera.offset_adu, box)
        return np.asarray(_at(self.camera.gain_e_per_adu, box) * (sums - dark))

    def _copied(
        self, frames: slice, rows: tuple[int, int], columns: tuple[int, int]
    ) -> NDArray[Any]:
        """Copy a region; of a file that is let go a few frames at a time: each maps megabytes."""
        if self.let_go is _nothing or frames.stop - frames.start <= _COPIED:
            counts = _region(self.counts, frames, rows, columns)
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

    @property
    def pixels(self) -> NDArray[Any]:
        """Stored counts, shape (t, ny·nx): longer loops than those along a row."""
        return self.counts.reshape(len(self.counts), self.mean_e.size)

    def frames(self, start: int, stop: int) -> Patch:
        """Select some of the frames, without a copy."""
        here = slice(max(start - self.first, 0), max(stop - self.first, 0))
        return replace(
            self, first=self.first + here.start, counts=self.counts[here], good=self.good[here],
            power=self.power[here],
        )  # fmt: skip

    def window(self, start: int, stop: int) -> tuple[FloatArray, int, float]:
        """Sum frames.

        Shapes: `electrons` (ny, nx).
        """
        part = self.frames(start, stop)
        out = np.zeros(self.mean_e.shape)
        region_sum(part.pixels, part.good, out.reshape(-1))
        frames = int(np.count_nonzero(part.good))
        return self.gain * (out - frames * self.offset), frames, float(part.power.sum())

    def windows(self, ends: Sequence[int]) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
        """Sum contiguous parts of the frames.

        Shapes: `electrons` (n, ny, nx), `frames` (n,), `power` (n,).
        """
        edges = np.clip(np.asarray(ends, dtype=np.int64) - self.first, 0, len(self.good))
        out = np.empty((edges.size - 1, *self.mean_e.shape))
        part_sums(self.counts, self.good, edges, out)
        known = np.zeros((2, len(self.good) + 1))
        np.cumsum(self.good, out=known[0, 1:])
        np.cumsum(self.power, out=known[1, 1:])
        frames, power = np.diff(known[:, edges])
        electrons = self.gain * (out - frames[:, None, None] * self.offset)
        return electrons, frames.astype(np.int64), power

    def part(self, rows: slice, columns: slice) -> Patch:
        """Copy some of its pixels, which count from its own first one."""
        here = rows, columns
        return replace(
            self,
            counts=_region(
                StoredFrames([self.counts]),
                slice(0, len(self.counts)),
                (rows.start, rows.stop),
                (columns.start, columns.stop),
            ),
            gain=_at(self.gain, here),
            offset=_at(self.offset, here),
            read_noise_e=_at(self.read_noise_e, here),
            mean_e=self.mean_e[here],
            usable=self.usable[here],
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

    for _ in mapper(some, range(0, len(counts), 64)):
        pass
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
    bright_enough = (usual > _LEAST_EDGE_LIGHT * usual[1]) & (usual * counts.shape[2] > _EDGE_E)
    found: BoolArray = ((light < _LEAST_EDGE_LIGHT * usual) & bright_enough).any(axis=1)
    return found


def well_lit(light_e: FloatArray, least: float = HALF) -> BoolArray:
    """Tell which frames have the usual light, unlike those of a closed or opening shutter.

    Shapes: `light_e` (t,), result (t,).
    """
    lit: BoolArray = np.isfinite(light_e)
    if lit.any():
        known = light_e[lit]
        usual = float(np.quantile(known, _LIGHT_QUANTILE))
        change = float(np.median(np.abs(np.diff(known)))) if known.size > 1 else 0.0
        lit &= usual - light_e <= max((1 - least) * usual, _LEAST_CHANGE_RATIO * change)
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


def make_chunk(
    first: int,
    counts: NDArray[Any],
    good: BoolArray,
    light_e: FloatArray,
    camera: Camera,
    *,
    stride: int,
    defects: Callable[[FloatArray, FloatArray], BoolArray],
    check: Callable[[], None] = lambda: None,
    mapper: Mapper = map,
) -> Chunk:
    """Sum consecutive frames in blocks.

    Shapes: `counts` (t, y, x), `good` (t,), `light_e` (t,).
    """
    stored = StoredFrames([counts])
    edges, blocks, highest = _sum_blocks(stored, good, camera, stride, check, mapper, highest=True)
    sums = _judged(
        (first, first + len(counts)), good, light_e, blocks.sum(axis=0, dtype=np.float64),
        highest.max(axis=0), camera, defects,
    )  # fmt: skip
    return _chunk(stored, sums, camera, edges, blocks, check, _nothing, lends_blocks=False)


def sums_of(
    span: tuple[int, int],
    good: BoolArray,
    light_e: FloatArray,
    total: FloatArray,
    highest: NDArray[Any],
    camera: Camera,
    defects: Callable[[FloatArray, FloatArray], BoolArray],
) -> FieldSums:
    """Say which light and which pixels some frames have.

    Shapes: `good, light_e` (t,), `total, highest` (y, x), in counts.
    """
    dark = np.count_nonzero(good) * np.asarray(camera.offset_adu)
    electrons = camera.gain_e_per_adu * (total - dark)
    return _judged(span, good, light_e, electrons, highest, camera, defects)


def _judged(
    span: tuple[int, int],
    good: BoolArray,
    light_e: FloatArray,
    electrons: FloatArray,
    highest: NDArray[Any],
    camera: Camera,
    defects: Callable[[FloatArray, FloatArray], BoolArray],
) -> FieldSums:
    """Say which light frames have, and which pixels of their sum can be used.

    Shapes: `good, light_e` (t,), `electrons, highest` (y, x).
    """
    power = np.where(good, light_e, 0.0)
    power /= power[good].mean()
    saturated = camera.saturated(highest)
    variance = camera.read_variance_e2((electrons.shape[0], electrons.shape[1]))
    defective = defects(electrons, np.count_nonzero(good) * variance)
    usable = ~(saturated | defective) & (electrons > 0)
    mean = electrons / power.sum()
    return FieldSums(span, good, power, float(mean.mean()), mean, usable, saturated)


def make_tile_chunk(
    counts: StoredFrames,
    sums: FieldSums,
    camera: Camera,
    *,
    stride: int,
    check: Callable[[], None],
    let_go: Callable[[], None],
    mapper: Mapper = map,
) -> Chunk:
    """Sum the frames of a tile in blocks; light and pixels left out are known from the field.

    Shapes: `counts` (t, y, x).
    """

    def check_and_let_go() -> None:
        check()
        let_go()

    edges, blocks, _ = _sum_blocks(
        counts, sums.good, camera, stride, check_and_let_go, mapper, highest=False
    )
    let_go()
    return _chunk(counts, sums, camera, edges, blocks, check, let_go, lends_blocks=True)


def _chunk(
    counts: StoredFrames,
    sums: FieldSums,
    camera: Camera,
    edges: NDArray[np.int64],
    blocks: NDArray[np.float32],
    check: Callable[[], None],
    let_go: Callable[[], None],
    *,
    lends_blocks: bool,
) -> Chunk:
    """Put frames, their blocks and what is known of them together."""
    return Chunk(
        sums.span[0], counts, sums.good, sums.power, camera, sums.mean_e, sums.usable,
        sums.saturated, edges, blocks, check, let_go, sums.level_e, lends_blocks,
    )  # fmt: skip


def _nothing() -> None:
    """Keep the pages of the frames."""


def _sum_blocks(
    counts: StoredFrames,
    good: BoolArray,
    camera: Camera,
    stride: int,
    check: Callable[[], None],
    mapper: Mapper,
    *,
    highest: bool,
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[Any]]:
    """Sum blocks of so many frames, and find the highest count of each pixel in each if asked to.

    Shapes: `counts` (t, y, x), `blocks_e` (k, y, x), `most` (k, y, x) or (k, 0, 0).
    """
    frames, rows, columns = counts.shape
    edges = np.append(np.arange(0, frames, stride), frames).astype(np.int64)
    blocks = np.zeros((edges.size - 1, rows, columns), dtype=np.float32)
    offset = np.asarray(camera.offset_adu)
    most = np.empty(blocks.shape if highest else (len(blocks), 0, 0), dtype=counts.dtype)

    def one(k: int) -> None:
        check()
        block, corner = counts.whole(int(edges[k]), int(edges[k + 1]))
        lit = good[edges[k] : edges[k + 1]]
        if highest:
            top, left = corner
            most[k] = block[np.argmax(lit), top : top + rows, left : left + columns]
        block_sums(block, corner, lit, row_of_sums(counts.dtype, columns), blocks[k], most[k])
        blocks[k] -= np.count_nonzero(lit) * offset
        blocks[k] *= camera.gain_e_per_adu

    for _ in mapper(one, range(edges.size - 1)):
        pass
    return edges, blocks, most


def _region(
    counts: StoredFrames, frames: slice, rows: tuple[int, int], columns: tuple[int, int]
) -> NDArray[Any]:
    """Copy a region of some frames."""
    ends = zip((rows, columns), counts.shape[1:], strict=True)
    if not all(0 <= low <= high <= size for (low, high), size in ends):
        raise IndexError(f"rows {rows} and columns {columns} of frames of shape {counts.shape[1:]}")
    seen = counts.array(frames.start, frames.stop, (slice(*rows), slice(*columns)))
    return seen if seen.base is None else seen.copy()


def _at(value: float | FloatArray, here: tuple[slice, slice]) -> Any:
    """Return a number, or the region of a map."""
    return value[here] if isinstance(value, np.ndarray) else value
