"""Where the sums jump: the matched filter at every boundary between blocks.

The w frames after a boundary are set against the w before it; a particle that lands or leaves
shows as a contrast that rises and falls linearly within w frames of its step.  The statistic is
the matched filter's signal-to-noise ratio with the model's image, the root of twice the gain in
log-likelihood.  Noise of neighbouring boundaries is correlated by `CORRELATION`, which the
threshold allows for: what exceeds it at both is one false alarm.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from iscat_analysis._kernels.sliding import contrast_map
from iscat_analysis.camera import NoiseSpectrum
from iscat_analysis.last_used import kept
from iscat_analysis.records import FloatArray, Mapper
from iscat_analysis.search.frames import Chunk
from iscat_analysis.search.peaks import SAMPLED, maxima, summits

MapArray = NDArray[np.float32]

STRIDES = 4
"""Boundaries searched per window: a step midway between two loses an eighth of its height."""

CORRELATION = 1 - 3 / (2 * STRIDES)
"""Of the noise at a boundary with that at the next, of w frames after less w frames before."""

_MAPS_AT_ONCE = 4  # that threads make before they are stored


def stride_of(window: int) -> int:
    """Give the frames between two boundaries that are searched."""
    return max(1, window // STRIDES)


def boundaries(frames: int, window: int) -> int:
    """Count the boundaries that are searched in a movie."""
    return max(math.ceil(frames / stride_of(window)) - 1, 1)


@dataclass(frozen=True)
class Filter:
    """Matched filter of one chunk; the weights are those of its mean image."""

    spectrum: NDArray[np.complex64]
    size: tuple[int, int]
    half: int
    weight: MapArray
    norm: MapArray
    noise: NoiseSpectrum | None
    template: FloatArray

    def response(
        self, corner: tuple[int, int], contrast: NDArray[np.floating]
    ) -> tuple[tuple[slice, slice], MapArray]:
        """Filter a small image alone, on a field without contrast and with white noise.

        Shapes: `contrast` (ny, nx).
        """
        half, field = self.half, self.weight.shape
        inside = tuple(slice(c, c + n) for c, n in zip(corner, contrast.shape, strict=True))
        weighted = self.weight[inside] * contrast.astype(np.float32, copy=False)
        reach = contrast.shape[0] + 2 * half, contrast.shape[1] + 2 * half
        size = fft.next_fast_len(reach[0], real=True), fft.next_fast_len(reach[1], real=True)
        spectrum = fft.rfft2(weighted, s=size) * self._spectrum_of(size)
        whole = fft.irfft2(spectrum, s=size)[: reach[0], : reach[1]]
        box, seen = [], []
        for c, n, end in zip(corner, contrast.shape, field, strict=True):
            low, high = max(c - half, 0), min(c + n + half, end)
            box.append(slice(low, high))
            seen.append(slice(low - c + half, high - c + half))
        there = box[0], box[1]
        return there, whole[seen[0], seen[1]] / np.sqrt(self.norm[there])

    @kept(64)
    def _spectrum_of(self, size: tuple[int, int]) -> NDArray[np.complex64]:
        """Give the spectrum of the reversed template, its first pixel at the origin."""
        return np.asarray(fft.rfft2(self.template[::-1, ::-1].astype(np.float32), s=size))


def make_filter(chunk: Chunk, template: FloatArray, noise: NoiseSpectrum | None = None) -> Filter:
    """Prepare the matched filter.

    Shapes: `template` (k, k).
    """
    rows, columns = chunk.shape
    half = template.shape[0] // 2
    size = (fft.next_fast_len(rows + half, real=True), fft.next_fast_len(columns + half, real=True))
    mean = np.where(chunk.usable, chunk.mean_e, 0.0)
    read = chunk.camera.read_variance_e2(chunk.shape)
    weight = np.zeros(size)
    weight[:rows, :columns] = mean**2 / np.where(chunk.usable, mean + read, 1.0)
    scale = math.sqrt(float(np.sum(template**2)))  # keeps single precision in range
    reversed_ = np.zeros((2, *size))
    k = template.shape[0]
    flipped = template[::-1, ::-1]
    reversed_[0, :k, :k] = flipped
    dual = template if noise is None else noise.dual(template)
    reversed_[1, :k, :k] = (template * dual)[::-1, ::-1] / scale**2
    # the template's centre belongs at the origin, so that nothing is shifted
    spectra = fft.rfft2(np.roll(reversed_, (-half, -half), axis=(1, 2)))
    norm = fft.irfft2(fft.rfft2(weight) * spectra[1], s=size)[:rows, :columns] * scale**2
    norm = np.maximum(norm, 1e-6 * norm.max())
    light, norm = (part[:rows, :columns].astype(np.float32) for part in (weight, norm))
    return Filter(spectra[0].astype(np.complex64), size, half, light, norm, noise, template)


def sliding_maps(
    chunk: Chunk,
    matched: Filter,
    strides: int,
    *,
    explained: Callable[[int, slice, slice], FloatArray | None] | None = None,
    earlier: tuple[MapArray, FloatArray] | None = None,
    changed: Sequence[int] = (),
    in_place: bool = False,
    mapper: Mapper = map,
) -> tuple[MapArray, FloatArray]:
    """Signal-to-noise ratio of a step at every boundary between blocks and every pixel.

    Maps that are made in place take the memory of the blocks, which are gone then.

    Shapes: `snr` (k − 1, y, x), `frames` (k − 1,).
    """
    count = chunk.edges.size - 2
    rows, columns = chunk.shape
    block_power = np.add.reduceat(chunk.power, chunk.edges[:-1])
    if earlier is None:
        room = chunk.blocks_e[:count] if in_place else np.empty((count, rows, columns), np.float32)
        earlier = room, np.zeros(count)
        changed = range(count)
    snr, effective = earlier
    root = np.sqrt(matched.norm)

    def one(j: int) -> MapArray:
        low, middle, high = max(j + 1 - strides, 0), j + 1, min(j + 1 + strides, count + 1)
        powers = block_power[low:middle].sum(), block_power[middle:high].sum()
        if min(powers) <= 0:
            return np.zeros((rows, columns), dtype=np.float32)
        blocks = chunk.blocks_e
        image = np.zeros(matched.size, dtype=np.float32)
        contrast = contrast_map(blocks[low:middle], blocks[middle:high], matched.weight)
        image[:rows, :columns] = contrast
        if explained is not None:
            first, turn, last = chunk.edges[[low, middle, high]].tolist()
            known = explained(j, slice(first, turn), slice(turn, last))
            if known is not None:
                image[:rows, :columns] -= (matched.weight * known).astype(np.float32)
        if matched.noise is not None:
            field = image[:rows, :columns]
            field[:] = matched.noise.whitened(field, matched.weight)
        spectrum = fft.rfft2(image)
        spectrum *= matched.spectrum
        overlap: MapArray = fft.irfft2(spectrum, s=matched.size)[:rows, :columns]
        effective[j] = powers[0] * powers[1] / (powers[0] + powers[1])
        overlap *= math.sqrt(effective[j])
        overlap /= root
        return overlap

    def stored(j: int) -> None:
        snr[j] = one(j)

    if in_place:
        _store_behind(one, snr, strides, mapper)
    else:
        list(mapper(stored, changed))
    return snr, effective


def _store_behind(
    make: Callable[[int], MapArray], room: MapArray, strides: int, mapper: Mapper
) -> None:
    """Store each map where a block was, once no other map is made of that block.

    Shapes: `room` (k, y, x).
    """
    waiting: deque[tuple[int, MapArray]] = deque()
    for start in range(0, len(room), _MAPS_AT_ONCE):
        some = range(start, min(start + _MAPS_AT_ONCE, len(room)))
        waiting.extend(zip(some, mapper(make, some), strict=True))
        first = some.stop + 1 - strides  # block of the next map
        while waiting and waiting[0][0] < first:
            j, made = waiting.popleft()
            room[j] = made
    for j, made in waiting:
        room[j] = made


class Peak(NamedTuple):
    """A place and boundary with a local maximum of the filtered contrast."""

    frame: int
    x_px: float
    y_px: float
    snr: float
    amplitude: float


def find_steps(
    chunk: Chunk, matched: Filter, snr: MapArray, effective: FloatArray, threshold: float
) -> list[Peak]:
    """Peaks in (t, y, x) above the threshold, strongest first.

    Shapes: `snr` (n, y, x).
    """
    at = maxima(snr, SAMPLED * threshold, (1, 1, 1), both=True)
    k, i, j = at.T
    dy, dx, above = summits(snr, at)
    value = snr[k, i, j].astype(np.float64)
    height = value + np.copysign(above, value)
    amplitude = height / np.sqrt(effective[k] * matched.norm[i, j])
    boundary = chunk.first + chunk.edges[k + 1]
    columns = [part.tolist() for part in (boundary, j + dx, i + dy, height, amplitude)]
    peaks = [Peak(*row) for row in zip(*columns, strict=True) if abs(row[3]) > threshold]
    return sorted(peaks, key=lambda p: -abs(p.snr))
