"""Bright steps of any shape: where the contrast changes by more than noise, whatever it looks like.

No picture of a particle is needed.  At every boundary between blocks the squared contrast over its
variance, less one, is averaged over a spot of the size of the diffraction limit; noise averages to
zero there and a step does not.  It takes a step some three times brighter than a matched filter
needs, and it finds it with a microscope of which nothing is known.

Images are smoothed as products with what a Gaussian leaves of each cosine: mirrored at its border,
an image is a sum of cosines, its discrete cosine transform, and a symmetric filter makes each of
them weaker by a factor.  For a spot of some pixels this takes a sixth of the time of sums over the
spot, and gives what `scipy.ndimage.gaussian_filter` gives.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from iscat_analysis.config import Config
from iscat_analysis.records import BoolArray, FloatArray, Mapper, Windows
from iscat_analysis.search.dating import locate_step
from iscat_analysis.search.frames import Chunk
from iscat_analysis.search.peaks import maxima
from iscat_analysis.search.sliding import STRIDES

T = TypeVar("T", np.float32, np.float64)


def spot_response(shape: tuple[int, ...], sigma_px: float) -> NDArray[np.float64]:
    """Factors by which a Gaussian filter weakens each cosine of an image.

    Shapes: result (y, x).
    """
    rows, columns = (_along(n, sigma_px) for n in shape)
    return np.multiply.outer(rows, columns)


@lru_cache(maxsize=16)
def _along(length: int, sigma_px: float) -> NDArray[np.float64]:
    """Response along one axis."""
    place = np.arange(1, math.floor(4.0 * sigma_px + 0.5) + 1)  # beyond, the spot is cut off
    weight = np.exp(-0.5 * (place / sigma_px) ** 2)
    waves = np.cos(np.pi * np.multiply.outer(np.arange(length), place) / length)
    return np.asarray((1 + 2 * waves @ weight) / (1 + 2 * weight.sum()))


def smoothed(image: NDArray[T], response: NDArray[np.floating]) -> NDArray[T]:
    """Filter an image that is mirrored at its border.

    Shapes: `image` (y, x), `response` (y, x), result (y, x).
    """
    waves = scipy.fft.dctn(image)
    waves *= response
    return np.asarray(scipy.fft.idctn(waves, overwrite_x=True))


THRESHOLD = 7.0
"""Excess of the smoothed energy over its noise; the noise of a movie of 10⁸ pixels stays below."""

ALONE_NM = 3500.0
"""Nothing else may happen nearer than this to a step while its frames are summed."""

LEAST_FRAMES = 8
"""Frames on either side without which a step is left out."""


_SHADOW_NM = 1500.0  # a weaker maximum nearer than this to a stronger one is part of it
_CORE_NM = 900.0  # radius that dates a step


@dataclass(frozen=True)
class BrightStep:
    """One bright step, summed before and after."""

    frame: int
    x_px: float
    y_px: float
    snr: float
    rows: tuple[int, int]
    columns: tuple[int, int]
    windows: Windows
    motion: FloatArray | float = 1.0


class Motion(Protocol):
    """What the motion of the fixed pattern makes of a chunk."""

    contrast: NDArray[np.float32]
    """Between the windows at every boundary between blocks, shape (k − 1, y, x)."""

    def between(
        self, rows: tuple[int, int], columns: tuple[int, int], before: slice, after: slice
    ) -> FloatArray:
        """Light after over light before in a region, frames relative to the chunk."""


class _Spot(NamedTuple):
    """A maximum of the energy."""

    frame: int
    row: int
    column: int


def find_bright_steps(
    chunk: Chunk, window: int, config: Config, *, motion: Motion | None = None, mapper: Mapper = map
) -> BrightSteps:
    """Find the bright steps of a chunk, which are cut when they are asked for."""
    pixel_nm = config.camera.pixel_nm
    moved = None if motion is None else motion.contrast
    spot_px = config.optics.resolution_nm / pixel_nm  # standard deviation
    spots = _spots(chunk, spot_px, _SHADOW_NM / pixel_nm, moved, mapper)
    return BrightSteps(chunk, spots, window, pixel_nm, config.roi_px, motion)


def _spots(
    chunk: Chunk,
    spot_px: float,
    shadow_px: float,
    moved: NDArray[np.float32] | None,
    mapper: Mapper,
) -> list[_Spot]:
    """Maxima of the energy in time and space, brightest first."""
    count = chunk.edges.size - 2
    power = np.add.reduceat(chunk.power, chunk.edges[:-1])
    frames = np.diff(chunk.edges)
    read = chunk.camera.read_variance_e2(chunk.shape)
    # standard deviation of the spot, in squares whose energy is looked at
    side = max(1, int(spot_px / 2.0))
    cells = math.ceil(chunk.shape[0] / side), math.ceil(chunk.shape[1] / side)
    energy = np.zeros((count, *cells), dtype=np.float32)

    def one(j: int) -> None:
        low, middle, high = max(j + 1 - STRIDES, 0), j + 1, min(j + 1 + STRIDES, count + 1)
        ratio = power[middle:high].sum() / max(power[low:middle].sum(), 1e-300)
        if not 0 < ratio < 1e6:
            return
        before = chunk.blocks_e[low:middle].sum(axis=0)
        after = chunk.blocks_e[middle:high].sum(axis=0)
        lit = chunk.usable & (before > 0) & (after > 0)
        if moved is not None:
            before *= 1 + moved[j]
        noise = read * (frames[middle:high].sum() + ratio**2 * frames[low:middle].sum())
        level = after.sum(where=lit, dtype=float) / before.sum(where=lit, dtype=float)
        change, variance = after - np.float32(level) * before, after + ratio**2 * before + noise
        excess, share = excess_of(change, variance, lit, side)
        energy[j] = _smoothed_energy(excess, share, spot_px / side, spot_px)

    list(mapper(one, range(count)))
    return [
        _Spot(chunk.first + int(chunk.edges[k + 1]), *(side * c + side // 2 for c in place))
        for k, *place in _maxima(energy, shadow_px / side)
    ]


def energy_of(
    change: FloatArray, variance: FloatArray, used: BoolArray, spot_px: float
) -> NDArray[np.float32]:
    """Smoothed energy of a change of the image, in standard deviations of its noise.

    Shapes: `change, variance` (y, x), `used` (y, x), result (y, x).
    """
    return _smoothed_energy(*excess_of(change, variance, used), spot_px, spot_px)


def excess_of(
    change: NDArray[np.floating], variance: FloatArray, used: BoolArray, side: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Squared change over its variance, less one, and share of used pixels, in squares of pixels.

    Shapes: `change, variance, used` (y, x), results (y/side, x/side).
    """
    excess = np.square(change, dtype=np.float32)
    np.divide(excess, variance, where=used, out=excess, casting="same_kind")
    excess -= 1
    excess[~used] = 0.0
    both = np.stack([excess, used])
    if side > 1:
        edges = [np.arange(0, size, side) for size in change.shape]
        both = np.add.reduceat(np.add.reduceat(both, edges[0], axis=1), edges[1], axis=2)
        sides = (np.diff(at, append=n) for at, n in zip(edges, change.shape, strict=True))
        both /= np.multiply.outer(*sides).astype(np.float32)
    return both[0], both[1]


def _smoothed_energy(
    excess: NDArray[np.float32], share: NDArray[np.float32], spot: float, spot_px: float
) -> NDArray[np.float32]:
    """Average an excess over a spot, in standard deviations of its noise.

    Shapes: `excess, share` (y, x), result (y, x).
    """
    response = spot_response(excess.shape, spot)
    noise = math.sqrt(2 / (4 * math.pi * spot_px**2))
    energy = smoothed(excess, response / noise)
    if share.min() < 1:
        energy /= np.maximum(smoothed(share, response), 1e-3)
    return energy


def find_bright_places(
    energy: NDArray[np.floating], *, pixel_nm: float, alone_nm: float, roi_px: int
) -> list[tuple[int, int]]:
    """Places where a single map of the energy has a maximum with no other near.

    Shapes: `energy` (y, x).
    """
    found = [(i, j) for _, i, j in _maxima(energy[None], _SHADOW_NM / pixel_nm)]
    room = roi_px // 2 + 1
    return [
        (i, j)
        for i, j in found
        if room <= i < energy.shape[0] - room
        and room <= j < energy.shape[1] - room
        and sum(math.hypot(i - k, j - m) * pixel_nm < alone_nm for k, m in found) <= 1
    ]


def _maxima(energy: NDArray[np.floating], shadow_px: float) -> list[tuple[int, int, int]]:
    """Maxima of a stack of maps, brightest first, without what belongs to a brighter one."""
    peaks = maxima(energy, THRESHOLD, (1, 2, 2))
    order = np.argsort(-energy[tuple(peaks.T)], kind="stable")
    taken: list[tuple[int, int, int]] = []
    for k, i, j in peaks[order]:
        if not any(
            abs(k - kk) < 2 * STRIDES and math.hypot(i - ii, j - jj) < shadow_px
            for kk, ii, jj in taken
        ):
            taken.append((int(k), int(i), int(j)))
    return taken


@dataclass(frozen=True)
class BrightSteps:
    """Steps of a chunk, with the frames around each in which nothing else happens."""

    chunk: Chunk
    spots: Sequence[_Spot]
    window: int
    pixel_nm: float
    roi_px: int
    motion: Motion | None

    def alone(self, most: int) -> list[BrightStep]:
        """Give steps that nothing else is near, the brightest first."""
        # one after the other: between small kernels threads wait for each other at the interpreter
        cut = (self._cut(spot, self.roi_px, ALONE_NM) for spot in self.spots[: 4 * most])
        return sorted(islice(filter(None, cut), most), key=lambda step: -step.snr)

    def every(self) -> Iterator[BrightStep]:
        """Give all steps, the brightest first, in the small region that a neighbour needs."""
        side = max(5, round(1700.0 / self.pixel_nm))
        return filter(None, (self._cut(spot, side, _SHADOW_NM) for spot in self.spots))

    def _cut(self, spot: _Spot, roi_px: int, alone_nm: float) -> BrightStep | None:
        """Date a step and sum the frames before and after it; None if these are too few."""
        chunk, frame, gap = self.chunk, spot.frame, 0
        low, high = self._quiet(spot, alone_nm)
        centre, step = (spot.row, spot.column), None
        for _ in range(3):  # roughly, then dated with its own picture and centred
            first = [place - roi_px // 2 for place in centre]
            rows, columns = ((place, place + roi_px) for place in first)
            if min(first) < 0 or rows[1] > chunk.shape[0] or columns[1] > chunk.shape[1]:
                return None
            if step is None or (rows, columns) != (step.rows, step.columns):  # often it stays
                patch = chunk.patch(low, high, rows, columns)
            if step is not None:
                dated = locate_step(patch, _core(step, self.pixel_nm), (low + 1, high))
                # a step whose height changes before or after it, by less than this chance
                if dated.p_constant < 1e-3:
                    return None
                frame, gap = dated.frame, dated.gap
            ends = (low, frame - gap), (frame + gap, high)
            if min(last - start for start, last in ends) < LEAST_FRAMES:
                return None
            windows = patch.windows(*ends)
            if min(windows.n_before, windows.n_after) < LEAST_FRAMES:
                return None
            moved: FloatArray | float = 1.0
            if self.motion is not None:
                moved = self.motion.between(rows, columns, *(chunk.cut(*end) for end in ends))
            step = BrightStep(frame, centre[1], centre[0], 0.0, rows, columns, windows, moved)
            y_px, x_px, snr = centre_of_energy(*measured_contrast(step), self.pixel_nm)
            step = replace(step, y_px=y_px + first[0], x_px=x_px + first[1], snr=snr)
            centre = round(step.y_px), round(step.x_px)
        return step

    def _quiet(self, spot: _Spot, alone_nm: float) -> tuple[int, int]:
        """Give the frames around a spot in which nothing else happens near it."""
        low = max(self.chunk.first, spot.frame - self.window)
        high = min(self.chunk.stop, spot.frame + self.window)
        margin = max(1, self.window // (2 * STRIDES)) + 1  # a frame is known to half a block
        for other in self.spots:
            away = math.hypot(other.row - spot.row, other.column - spot.column)
            if other is spot or away * self.pixel_nm > alone_nm:
                continue
            if other.frame <= spot.frame:
                low = max(low, other.frame + margin)
            if other.frame >= spot.frame:
                high = min(high, other.frame - margin)
        return low, high


def measured_contrast(step: BrightStep) -> tuple[FloatArray, FloatArray]:
    """Contrast of a step, its common level taken off, and the variance of shot noise.

    Shapes: `contrast, variance` (ny, nx).
    """
    sums = step.windows.before_e, step.windows.after_e
    used = ~step.windows.masked & (sums[0] > 0) & (sums[1] > 0)
    before, after = (np.where(used, part, 1.0) for part in sums)
    expected = before * step.motion
    ratio = float(after[used].sum() / expected[used].sum())
    contrast = np.where(used, after / (ratio * expected) - 1, 0.0)
    return contrast, np.where(used, 1 / before + 1 / after, 1e6)


def _core(step: BrightStep, pixel_nm: float) -> FloatArray:
    """Give the smoothed contrast of a step around its centre, as the template that dates it."""
    contrast, _ = measured_contrast(step)
    y, x = np.ogrid[slice(*step.rows), slice(*step.columns)]
    apart2 = (y - step.y_px) ** 2 + (x - step.x_px) ** 2
    return np.asarray(gaussian_filter(contrast, 0.7) * (apart2 < (_CORE_NM / pixel_nm) ** 2))


def centre_of_energy(
    contrast: FloatArray, variance: FloatArray, pixel_nm: float
) -> tuple[float, float, float]:
    """Centre of a picture's energy, found in a shrinking neighbourhood.

    Shapes: `contrast, variance` (ny, nx).
    """
    energy = np.maximum(gaussian_filter(contrast**2 / variance - 1, 0.7), 0.0)
    y, x = np.arange(contrast.shape[0]), np.arange(contrast.shape[1])
    row, column = (contrast.shape[0] - 1) / 2, (contrast.shape[1] - 1) / 2
    for reach_nm in (900.0, 700.0, 600.0, 500.0):
        apart2 = (y[:, None] - row) ** 2 + (x - column) ** 2
        weight = energy * (apart2 < (reach_nm / pixel_nm) ** 2)
        total = float(weight.sum())
        if total <= 0:
            break
        row, column = weight.sum(axis=1) @ y / total, weight.sum(axis=0) @ x / total
    excess = float(np.sum(contrast**2 / variance) - contrast.size)
    return float(row), float(column), math.sqrt(max(excess, 0.0))
