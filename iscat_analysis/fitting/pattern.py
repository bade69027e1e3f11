"""The fixed pattern of a chunk as it moves: the factor it makes between two windows.

The light of frame t is P_t E(x) B(x − d_t), B the pattern in the frame of the sample and E the
light that falls on it, which stays.  Blocks of frames around a step, each without E and moved back
by its own shift, add up to B; moved to every shift of a window and averaged, E B is what that
window holds, smear included.  Only blocks within two windows make it, so that it may change slowly,
the way a movie is cut does not matter, and most particles in it are there all the time and move
with it.  One that lands or leaves within those blocks is in B with the share f of their light,
which `Neighbours` takes off again.

Two patterns that move against each other have no common motion: with their mean motion divided out,
pixels change linearly in time.  If the variance of these slopes exceeds that of noise, B is a line
in time for every pixel.  Its slope comes from the blocks before and after the windows, with a level
for each side, so that it contains neither what lands or leaves at the step nor noise of the
windows.  It is multiplied by the share of its variance that is not noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera import Mover, Trajectory, filling, follow_pattern, still_light, trusted
from iscat_analysis.fitting.events import Region
from iscat_analysis.records import ComplexArray, FloatArray, IntArray, Mapper
from iscat_analysis.search.frames import Chunk
from iscat_analysis.search.sliding import STRIDES

SPAN = 2
"""Windows before a step, and as many after it, whose frames make the pattern."""

SLOPE_SPAN = 6
"""Windows before a step, and as many after it, within which pixels may change along a line."""

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
    slope: ComplexArray
    """Change of the spectrum per frame."""

    frame: float
    """When the spectrum is that of the pattern, relative to the chunk."""

    inner: tuple[slice, slice]
    still: FloatArray
    moving: MovingPattern

    def seen(self, frames: slice) -> FloatArray:
        """Light that frames, relative to the chunk, hold per unit power without particles."""
        shifts, light = self.moving.pieces(frames)
        transfer = self.mover.transfer(shifts, light / light.sum())
        spectrum = self.spectrum + (_time(frames) - self.frame) * self.slope
        return np.asarray(self.still * self.mover.image(spectrum * transfer)[self.inner])


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
        self._block_light = np.array([self._light(block) for block in _blocks(edges)])
        self._centres = (edges[:-1] + edges[1:] - 1) / 2
        mover = Mover((chunk.shape[0], chunk.shape[1]))
        spectra = np.stack(list(mapper(partial(self._at_rest, mover), range(len(self._blocks)))))
        self._slope_variance = self._variance_of_slopes(mover, spectra)
        self.contrast = self._contrasts(mover, spectra, mapper)

    @property
    def windows(self) -> int:
        """Windows on either side of a step whose frames make the pattern."""
        return SLOPE_SPAN if self._slope_variance else SPAN

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
        return first, np.array(
            [yy - 2 * my * y + y * y, yx - my * x - mx * y + x * y, xx - 2 * mx * x + x * x]
        )

    def span(self, before: slice, after: slice) -> slice:
        """Frames, relative to the chunk, whose light makes the pattern of two windows."""
        used = np.flatnonzero(self.weights(before, after, after))
        edges = self.chunk.edges
        return slice(int(edges[used[0]]), int(edges[used[-1] + 1]))

    def weights(self, before: slice, after: slice, frames: slice) -> FloatArray:
        """Give the weight of every block in the pattern that frames of two windows see, (blocks,).

        Of the light per unit power; all together are 1.
        """
        turn = (before.stop + after.start) // 2
        blocks, light = self._around(turn), self._block_light
        mean = np.zeros(light.size)
        mean[blocks] = light[blocks] / max(light[blocks].sum(), 1e-300)
        later = _time(frames) - self._middle(blocks)
        return np.asarray(mean + later * self._slope_weights(turn) * light)

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
        shape = (here[0].stop - here[0].start, here[1].stop - here[1].start)
        mover = Mover(shape)
        blocks, slopes = self._around(frame - chunk.first), self._slope_weights(frame - chunk.first)
        around = np.zeros(slopes.size)
        around[blocks] = 1.0
        spectrum: ComplexArray | float = 0.0
        slope: ComplexArray | float = 0.0
        for k in np.flatnonzero(around + np.abs(slopes)).tolist():
            rest = mover.spectrum((chunk.blocks_e[k] / self._still)[nearest])
            rest *= mover.transfer(-self._blocks[k : k + 1], np.ones(1))
            spectrum, slope = spectrum + around[k] * rest, slope + slopes[k] * rest
        frames = slice(int(chunk.edges[blocks.start]), int(chunk.edges[blocks.stop]))
        return LocalPattern(
            mover, np.asarray(spectrum / self._light(frames)), np.asarray(slope),
            self._middle(blocks),
            (inner[0], inner[1]), self._still[region.slices], self,
        )  # fmt: skip

    def between(
        self, rows: tuple[int, int], columns: tuple[int, int], before: slice, after: slice
    ) -> FloatArray:
        """Light after over light before that the motion makes in a region."""
        turn = self.chunk.first + (before.stop + after.start) // 2
        local = self.local(Region(rows, columns), turn)
        return np.asarray(local.seen(after) / local.seen(before))

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

    def pieces(self, frames: slice) -> tuple[FloatArray, FloatArray]:
        """Shift and light of the parts of frames that lie in one block each."""
        edges = self.chunk.edges
        inside = edges[(edges > frames.start) & (edges < frames.stop)]
        cuts = [frames.start, *(int(e) for e in inside), frames.stop]
        parts = [slice(a, b) for a, b in pairwise(cuts)]
        return np.array([self.shift(p) for p in parts]), np.array([self._light(p) for p in parts])

    def _at_rest(self, mover: Mover, block: int) -> NDArray[np.complex64]:
        """Spectrum of a block in the frame of the sample; single precision is 1e-7 of it."""
        image = mover.spectrum((self.chunk.blocks_e[block] / self._still)[self._nearest])
        back = mover.transfer(-self._blocks[block : block + 1], np.ones(1))
        return (image * back).astype(np.complex64)

    def _middle(self, blocks: slice) -> float:
        """Mean frame of the light of blocks."""
        light = self._block_light[blocks]
        return float(self._centres[blocks] @ light / max(light.sum(), 1e-300))

    def _slope_weights(self, turn: int) -> FloatArray:
        """Give the weights of blocks, of their light, in the slope of pixels at a turn, (blocks,).

        They are least squares with a level of each side of its own, times the share of the
        variance of slopes that is not noise.
        """
        weights, information = self._least_squares(turn)
        share = self._slope_variance / (self._slope_variance + 1 / max(information, 1e-300))
        return weights * share

    def _least_squares(self, turn: int) -> tuple[FloatArray, float]:
        """Give weights of blocks in the slope, and the information of it per light and power."""
        middle, count = round(turn / self._stride), len(self._blocks)
        far, near = SLOPE_SPAN * STRIDES, STRIDES
        weights, information = np.zeros(count), 0.0
        for start, stop in ((middle - far, middle - near), (middle + near, middle + far)):
            side = slice(min(max(start, 0), count), min(max(stop, 0), count))
            away = self._centres[side] - self._middle(side)
            weights[side] = away * (self._block_light[side] > 0)
            information += float(self._block_light[side] @ away**2)
        return weights / max(information, 1e-300), information

    def _variance_of_slopes(self, mover: Mover, spectra: NDArray[np.complex64]) -> float:
        """Give the variance of slopes over the light, beyond that of noise; 0 where it is none."""
        chunk, used = self.chunk, self.chunk.usable
        last, read = len(chunk.counts), chunk.camera.read_variance_e2(chunk.shape)
        counts = (chunk.blocks_e.sum(axis=0) + last * read) / self._still**2
        found = []
        # at five turns slopes are compared with noise
        for turn in np.linspace(0, last, 7)[1:-1].round().astype(int).tolist():
            weights, information = self._least_squares(turn)
            if not information > 0:
                continue
            slope = mover.image(np.tensordot(weights, spectra, 1))[used]
            noise = counts[used] / max(self._block_light.sum(), 1e-300) / information
            # of a standard normal variable
            found.append((float(np.median(slope**2 / noise)) / 0.4549, information))
        # variance of slopes over that of noise; rings of what lands make it 2
        if not found or np.median([excess for excess, _ in found]) < 2.5:
            return 0.0
        return float(np.median([(excess - 1) / information for excess, information in found]))

    def _contrasts(
        self, mover: Mover, spectra: NDArray[np.complex64], mapper: Mapper
    ) -> NDArray[np.float32]:
        chunk, count, light = self.chunk, len(self._blocks), self._block_light

        def seen(spectrum: ComplexArray, blocks: slice) -> FloatArray:
            share = light[blocks] / max(light[blocks].sum(), 1e-300)
            return self._still * mover.image(spectrum * mover.transfer(self._blocks[blocks], share))

        out = np.zeros((count - 1, *chunk.shape), dtype=np.float32)

        def one(j: int) -> None:
            around = slice(max(j + 1 - _REACH, 0), j + 1 + _REACH)
            spectrum = spectra[around].sum(axis=0) / max(light[around].sum(), 1e-300)
            slopes = self._slope_weights(int(chunk.edges[j + 1]))
            slope = np.tensordot(slopes, spectra, 1) if slopes.any() else np.zeros(())
            sides = slice(max(j + 1 - STRIDES, 0), j + 1), slice(j + 1, j + 1 + STRIDES)
            before, after = (
                seen(spectrum + (self._middle(side) - self._middle(around)) * slope, side)
                for side in sides
            )
            used = chunk.usable  # the light is normalised on them, in the search as here
            level = after[used].sum() / before[used].sum()
            out[j, used] = after[used] / (level * before[used]) - 1

        for _ in mapper(one, range(count - 1)):
            pass
        return out


def _blocks(edges: IntArray) -> list[slice]:
    return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def _time(frames: slice) -> float:
    return float(frames.start + frames.stop - 1) / 2
