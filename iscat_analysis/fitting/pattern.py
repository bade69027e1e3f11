"""The fixed pattern of a chunk as it moves: the factor it makes between two windows.

The light of frame t is P_t E(x) B(x − d_t), B the pattern in the frame of the sample and E the
light that falls on it, which stays.  Blocks of frames around a step, each without E and moved back
by its own shift, add up to B; moved to every shift of a window and averaged, E B is what that
window holds, smear included.  Only blocks within two windows make it, so that it may change slowly,
the way a movie is cut does not matter, and most particles in it are there all the time and move
with it.  One that lands or leaves within those blocks is in B with the share f of their light,
which `Neighbours` takes off again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.drift import (
    ComplexArray,
    Mover,
    Trajectory,
    filling,
    follow_pattern,
    still_light,
    trusted,
)
from iscat_analysis.fitting.regions import Region
from iscat_analysis.records import FloatArray, Mapper
from iscat_analysis.search.sliding import STRIDES, Chunk

SPAN = 2
"""Windows before a step, and as many after it, whose frames make the pattern."""

_MARGIN_PX = 8  # around a region, so that its own edges do not matter
_REACH = SPAN * STRIDES


def follow(chunk: Chunk, mapper: Mapper = map) -> Trajectory | None:
    """Estimate the motion of the fixed pattern through a chunk."""
    light = np.add.reduceat(chunk.power, chunk.edges[:-1])
    moment = np.add.reduceat(chunk.power * np.arange(len(chunk.power)), chunk.edges[:-1])
    frames = chunk.first + moment / np.where(light > 0, light, 1.0)
    read = chunk.camera.read_variance_e2(chunk.shape)
    return follow_pattern(chunk.blocks_e, light, frames, chunk.usable, read, mapper=mapper)


def corrected(
    chunk: Chunk, *, wanted: bool, mapper: Mapper = map
) -> tuple[Chunk, MovingPattern | None]:
    """Estimate the motion of the fixed pattern through a chunk, if it is to be divided out."""
    trajectory = follow(chunk, mapper) if wanted else None
    if trajectory is None:
        return chunk, None
    pattern = MovingPattern(chunk, trajectory, mapper)
    return pattern.chunk, pattern


@dataclass(frozen=True)
class LocalPattern:
    """The pattern of a region, made of the blocks around a step."""

    mover: Mover
    spectrum: ComplexArray
    inner: tuple[slice, slice]
    still: FloatArray


class MovingPattern:
    """Where the pattern of a chunk is in every frame, and what it looks like from there."""

    def __init__(self, chunk: Chunk, trajectory: Trajectory, mapper: Mapper = map) -> None:
        self.trajectory = trajectory
        self._shift = trajectory.at(chunk.first + np.arange(len(chunk.counts), dtype=float))
        y, x = self._shift.T
        powers = np.stack([np.ones_like(y), y, x, y * y, y * x, x * x])
        self._sums = np.zeros((6, len(y) + 1))
        np.cumsum(powers * chunk.power, axis=1, out=self._sums[:, 1:])
        edges = chunk.edges
        self._blocks = np.array([self.shift(block) for block in _blocks(edges)])
        widest = max(
            float(np.ptp(self._blocks[k : k + 2 * _REACH], axis=0).max()) / 2
            for k in range(len(self._blocks))
        )
        self._nearest = filling(chunk.usable)
        self._still = still_light(chunk.blocks_e, chunk.usable)
        self._stride = int(edges[1] - edges[0])
        self.chunk = replace(chunk, usable=trusted(chunk.usable, widest))
        self.contrast = self._contrasts(mapper)

    def shift(self, frames: slice) -> FloatArray:
        """Mean shift (y, x) of the light of frames relative to the chunk [pixels]."""
        return self._moments(frames)[:2]

    def at(self, frame: int) -> FloatArray:
        """Shift (y, x) in a frame of the movie [pixels]."""
        shift: FloatArray = self._shift[min(max(frame - self.chunk.first, 0), len(self._shift) - 1)]
        return shift

    def moments(self, frames: slice, frame: int) -> tuple[FloatArray, FloatArray]:
        """First (y, x) and second (yy, yx, xx) moments of the shift since a frame of the movie."""
        y, x = self.at(frame)
        my, mx, yy, yx, xx = self._moments(frames)
        first = np.array([my - y, mx - x])
        return first, np.array([
            yy - 2 * my * y + y * y, yx - my * x - mx * y + x * y, xx - 2 * mx * x + x * x,
        ])  # fmt: skip

    def span(self, before: slice, after: slice) -> slice:
        """Frames, relative to the chunk, whose light makes the pattern of two windows."""
        blocks = self._around((before.stop + after.start) // 2)
        edges = self.chunk.edges
        return slice(int(edges[blocks.start]), int(edges[blocks.stop]))

    def local(self, region: Region, frame: int) -> LocalPattern:
        """Pattern of a region around a frame of the movie."""
        chunk = self.chunk
        sides, inner = [], []
        for (low, high), size in zip((region.rows, region.columns), chunk.shape, strict=True):
            first = max(low - _MARGIN_PX, 0)
            sides.append(slice(first, min(high + _MARGIN_PX, size)))
            inner.append(slice(low - first, high - first))
        here = (sides[0], sides[1])
        nearest = self._nearest[0][here], self._nearest[1][here]
        blocks = self._around(frame - chunk.first)
        shape = (here[0].stop - here[0].start, here[1].stop - here[1].start)
        mover = Mover(shape)
        spectrum = sum(
            mover.spectrum((chunk.blocks_e[k] / self._still)[nearest])
            * mover.transfer(-self._blocks[k : k + 1], np.ones(1))
            for k in range(blocks.start, blocks.stop)
        )
        frames = slice(int(chunk.edges[blocks.start]), int(chunk.edges[blocks.stop]))
        return LocalPattern(
            mover, np.asarray(spectrum / self._light(frames)), (inner[0], inner[1]),
            self._still[region.slices],
        )  # fmt: skip

    def seen(self, pattern: LocalPattern, frames: slice) -> FloatArray:
        """Light that frames, relative to the chunk, hold per unit power without particles."""
        shifts, light = self._pieces(frames)
        transfer = pattern.mover.transfer(shifts, light / light.sum())
        moved = pattern.mover.image(pattern.spectrum * transfer)[pattern.inner]
        return np.asarray(pattern.still * moved)

    def between(
        self, rows: tuple[int, int], columns: tuple[int, int], before: slice, after: slice
    ) -> FloatArray:
        """Light after over light before that the motion makes in a region."""
        turn = self.chunk.first + (before.stop + after.start) // 2
        local = self.local(Region(rows, columns), turn)
        return np.asarray(self.seen(local, after) / self.seen(local, before))

    def _around(self, frame: int) -> slice:
        """Blocks that make the pattern around a frame relative to the chunk."""
        middle = round(frame / self._stride)
        return slice(max(middle - _REACH, 0), min(middle + _REACH, len(self._blocks)))

    def _light(self, frames: slice) -> float:
        return float(self._sums[0, frames.stop] - self._sums[0, frames.start])

    def _moments(self, frames: slice) -> FloatArray:
        light = self._light(frames)
        if light <= 0:
            y, x = self._shift[min(frames.start, len(self._shift) - 1)]
            return np.array([y, x, y * y, y * x, x * x])
        moments: FloatArray = (self._sums[1:, frames.stop] - self._sums[1:, frames.start]) / light
        return moments

    def _pieces(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Shift and light of the parts of frames that lie in one block each."""
        edges = self.chunk.edges
        inside = edges[(edges > frames.start) & (edges < frames.stop)]
        cuts = [frames.start, *(int(e) for e in inside), frames.stop]
        parts = [slice(a, b) for a, b in pairwise(cuts)]
        return np.array([self.shift(p) for p in parts]), np.array([self._light(p) for p in parts])

    def _contrasts(self, mapper: Mapper) -> NDArray[np.float32]:
        chunk, count = self.chunk, len(self._blocks)
        mover = Mover(chunk.shape)
        light = np.array([self._light(block) for block in _blocks(chunk.edges)])

        def still(k: int) -> NDArray[np.complex64]:
            """Spectrum of a block in the frame of the sample; single precision is 1e-7 of it."""
            image = mover.spectrum((chunk.blocks_e[k] / self._still)[self._nearest])
            back = mover.transfer(-self._blocks[k : k + 1], np.ones(1))
            return (image * back).astype(np.complex64)

        def seen(spectrum: ComplexArray, blocks: slice) -> FloatArray:
            share = light[blocks] / max(light[blocks].sum(), 1e-300)
            return self._still * mover.image(spectrum * mover.transfer(self._blocks[blocks], share))

        spectra = np.stack(list(mapper(still, range(count))))
        out = np.zeros((count - 1, *chunk.shape), dtype=np.float32)

        def one(j: int) -> None:
            around = slice(max(j + 1 - _REACH, 0), j + 1 + _REACH)
            spectrum = spectra[around].sum(axis=0)
            before = seen(spectrum, slice(max(j + 1 - STRIDES, 0), j + 1))
            after = seen(spectrum, slice(j + 1, j + 1 + STRIDES))
            used = chunk.usable  # the light is normalised on them, in the search as here
            level = after[used].sum() / before[used].sum()
            out[j, used] = after[used] / (level * before[used]) - 1

        for _ in mapper(one, range(count - 1)):
            pass
        return out


def _blocks(edges: NDArray[np.int64]) -> list[slice]:
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]
