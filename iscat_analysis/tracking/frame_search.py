"""Where particles are in every frame of a movie, and which of them are one particle.

The matched filter of `iscat_analysis.search.templates`, for many frames over one background: its
noise is the same in all of them but for their power, so that one transform and one product serve
each frame.  Only particles are looked for, and not the holes that they leave in a background that
is not theirs alone yet: the sign of the contrast is the model's.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from iscat_analysis._kernels.links import link_surely
from iscat_analysis.errors import DataError
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.search.peaks import SAMPLED, maxima, summits
from iscat_analysis.search.templates import FAR_LOBE, NEAR, SIDELOBE, Templates

IntArray = NDArray[np.int64]

LEFT_OVER = 0.2
"""Of a particle's signal-to-noise ratio that a candidate beside it must reach when what was fitted
has been taken off: less may be what the model leaves over."""

_HIGHER = 2.5
"""What rings may be through optics that are not the model's, over those of the model."""

_FIELDS = 32  # of frames and templates that are filtered at a time


@dataclass(frozen=True)
class FrameCandidates:
    """Candidates in frames, in the order of the frames."""

    frame: IntArray
    x_px: FloatArray
    y_px: FloatArray
    z_nm: FloatArray
    strength: FloatArray
    snr: FloatArray


class FrameFilter:
    """A matched filter for the frames of one movie."""

    def __init__(
        self,
        templates: Templates,
        level_e: FloatArray,
        read_e2: FloatArray,
        used: BoolArray,
        *,
        polarity: int,
        roi_px: int,
        cautious: bool,
    ) -> None:
        self._templates = templates
        self._roi_px, self._cautious = roi_px, cautious
        light = np.where(used, level_e**2 / (level_e + read_e2), 0.0)
        self._share = np.where(used, level_e / (level_e + read_e2), 0.0).astype(np.float32)
        images = templates.images
        half = images.shape[1] // 2
        self._half = half
        # what wraps around falls on the first rows and columns, which are cut off
        self._padded = [next_fast_len(n + half, real=True) for n in level_e.shape]
        flipped = images[:, ::-1, ::-1]
        self._layers = np.flatnonzero((polarity == 0) | (templates.signs == polarity))
        norm = self._cut(rfft2(light, self._padded) * rfft2(flipped**2, self._padded))
        norm = np.sqrt(np.maximum(norm, 1e-9 * norm.max()))
        self._norm = norm[self._layers].astype(np.float32)
        # Side lobes of a peak, over it: of several heights they are as high as `SIDELOBE` says.
        self._lobe = SIDELOBE
        if len(self._layers) == 1:
            self._lobe = min(SIDELOBE, _HIGHER * _ring(images[self._layers[0]], NEAR * roi_px))
        self._duals = rfft2(flipped[self._layers].astype(np.float32), self._padded)

    def find(
        self,
        residual_e: NDArray[np.float32],
        power: FloatArray,
        first: int,
        known: list[FloatArray],
    ) -> FrameCandidates:
        """Find candidates in a block of frames.

        Shapes: `residual_e` (n, y, x), `power` (n,), `known` (k, 3).
        """
        parts: list[FloatArray] = []
        threshold = self._templates.threshold
        fields_at_once = max(_FIELDS // len(self._layers), 1)
        for start in range(0, len(residual_e), fields_at_once):
            stop = start + fields_at_once
            snr = self._snr(residual_e[start:stop], power[start:stop])
            best = snr.max(axis=1)
            at = maxima(best, SAMPLED * threshold, (0, 1, 1))
            frame, row, column = at.T
            layer = snr[frame, :, row, column].argmax(axis=1)
            field = frame * len(self._layers) + layer
            dy, dx, above = summits(
                snr.reshape(-1, *snr.shape[2:]), np.stack([field, row, column], 1)
            )
            height = best[frame, row, column] + above
            order = np.lexsort((-column, -row, -layer, -height, frame))
            order = order[height[order] > threshold]
            tops = np.stack([frame + start, height, column + dx, row + dy])[:, order]
            kept = self._alone(tops[0], tops[1], tops[2], tops[3], known)
            at, layer = at[order][kept], layer[order][kept]
            frames, heights, x, y = tops[:, kept]
            norm = self._norm[layer, at[:, 1], at[:, 2]]
            strength = heights / (np.sqrt(power[frames.astype(np.int64)]) * norm)
            z = self._templates.z_nm[self._layers[layer]]
            parts.append(np.stack([first + frames, x, y, z, strength, heights]))
        frames, *others = np.concatenate(parts, axis=1)
        return FrameCandidates(frames.astype(np.int64), *others)

    def _alone(
        self,
        frame: FloatArray,
        height: FloatArray,
        x: FloatArray,
        y: FloatArray,
        known: list[FloatArray],
    ) -> BoolArray:
        """Tell which peaks are neither side lobes nor residues.

        The highest peaks of each frame come first.  In each round the highest remaining peak of
        every frame is accepted and its side lobes are removed.
        """
        kept = np.zeros(len(frame), dtype=bool)
        sure = ~self._are_left_over(frame.astype(np.int64), height, x, y, known)
        left = np.arange(len(frame))
        while left.size:
            begins = np.diff(frame[left], prepend=-1) > 0
            tops = left[begins]
            kept[tops] = sure[tops]
            top = tops[np.cumsum(begins) - 1]
            hides = sure[top] & self._is_lobe(height, x, y, left, top)
            left = left[~(begins | hides)]
        return kept

    def _is_lobe(
        self, height: FloatArray, x: FloatArray, y: FloatArray, one: IntArray, other: IntArray
    ) -> BoolArray:
        """Tell which peaks may be side lobes of higher ones."""
        apart_x, apart_y = x[one] - x[other], y[one] - y[other]
        within_region = np.maximum(np.abs(apart_x), np.abs(apart_y)) < self._roi_px
        lobe = height[one] < height[other] * np.where(within_region, self._lobe, FAR_LOBE)
        lobe |= np.hypot(apart_x, apart_y) < NEAR * self._roi_px
        return np.asarray(lobe | within_region if self._cautious else lobe)

    def _are_left_over(
        self,
        frame: IntArray,
        height: FloatArray,
        x: FloatArray,
        y: FloatArray,
        known: list[FloatArray],
    ) -> BoolArray:
        """Tell which peaks may be residues of particles that were fitted already."""
        places = np.full((len(known), max(map(len, known)), 3), np.nan)
        for row, there in zip(places, known, strict=True):
            row[: len(there)] = there
        known_x, known_y, known_height = np.moveaxis(places[frame], 2, 0)
        away = np.hypot(known_x - x[:, None], known_y - y[:, None])
        if self._cautious:
            return np.asarray((away < self._roi_px).any(axis=1))
        over = (away < NEAR * self._roi_px) & (height[:, None] < LEFT_OVER * known_height)
        return np.asarray(over.any(axis=1))

    def _snr(self, residual_e: NDArray[np.float32], power: FloatArray) -> NDArray[np.float32]:
        """Give the signal-to-noise ratio of each template at each pixel, shape (n, k, y, x)."""
        spectrum = rfft2(residual_e * self._share, self._padded)[:, None]
        noise = np.sqrt(power).astype(np.float32)[:, None, None, None] * self._norm
        return np.asarray(self._cut(spectrum * self._duals) / noise)

    def _cut(self, spectrum: NDArray[Any]) -> NDArray[Any]:
        """Transform back and crop to the field."""
        (rows, columns), half = self._share.shape, self._half
        full = irfft2(spectrum, self._padded)
        return np.asarray(full[..., half : half + rows, half : half + columns])


def _ring(image: FloatArray, beyond_px: float) -> float:
    """How high a filter's answer to its own image is beyond a distance, over its peak."""
    side = 2 * len(image)
    answer = irfft2(np.abs(rfft2(image, (side, side))) ** 2, (side, side))
    along = side * np.fft.fftfreq(side)
    return float(answer[np.hypot(along, along[:, None]) >= beyond_px].max() / answer[0, 0])


def link(frame: IntArray, places_nm: FloatArray, *, reach_nm: float, memory: int) -> IntArray:
    """Say which positions are one particle.

    Notes
    -----
    What has no choice is linked at once, and the rest of each frame by
    trackpy (D. B. Allan et al., doi:10.5281/zenodo.4682814), after J. C. Crocker and D. G. Grier,
    J. Colloid Interface Sci. 179, 298 (1996).

    Shapes: `frame` (n,), `places_nm` (n, axes), result (n,).
    """
    n = len(frame)
    track = np.zeros(n, dtype=np.int64)
    if not n:
        return track
    places = np.ascontiguousarray(places_nm, dtype=np.float64)
    starts = np.searchsorted(frame, np.arange(frame[0], frame[-1] + 2)).astype(np.int64)
    taken, waiting, doubtful = np.zeros(n, dtype=bool), track.copy(), track.copy()
    state, t = np.zeros(4, dtype=np.int64), 0
    while True:
        t = link_surely(places, starts, t, reach_nm, memory, track, taken, waiting, state, doubtful)
        if t == starts.size - 1:
            break
        _, number, some, others = state.tolist()
        old, new = doubtful[:some], doubtful[some : some + others]
        before = _chosen(places[old], places[new], reach_nm)
        begun = before < 0
        track[new[begun]] = number + np.arange(np.count_nonzero(begun))
        last = old[before[~begun]]
        track[new[~begun]], taken[last] = track[last], True
        state[1] += np.count_nonzero(begun)
        t += 1
    _, first, numbers = np.unique(track, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[numbers]


def _chosen(old: FloatArray, new: FloatArray, reach_nm: float) -> IntArray:
    """Give the old position that trackpy links to each new one, -1 where there is none."""
    trackpy = load_linker()
    try:
        (_, one), (_, two) = trackpy.link_iter(iter([(0, old), (1, new)]), search_range=reach_nm)
    except trackpy.SubnetOversizeException as trouble:
        raise DataError(
            f"too many particles are within track.max_step_nm = {reach_nm:g} of each other to tell "
            "which is which from frame to frame: lower it to the farthest that one goes, or record "
            "fewer particles or more frames a second"
        ) from trouble
    where = {number: i for i, number in enumerate(one)}
    return np.array([where.get(number, -1) for number in two], dtype=np.int64)


@cache
def load_linker() -> Any:
    """Import trackpy without its log messages.

    The import takes about a second, so that it is worth starting it in a thread.
    """
    import trackpy

    logging.getLogger("trackpy").setLevel(logging.WARNING)
    return trackpy


def gaps(frame: IntArray, track: IntArray) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Give the frames inside tracks in which the particle was not found.

    Shapes: `frame, track` (n,), `missed` (m,), `before, after` (m,), `share` (m,).
    """
    order = np.lexsort((frame, track))
    before, after = order[:-1], order[1:]
    wide = (track[before] == track[after]) & (frame[after] > frame[before] + 1)
    before, after = before[wide], after[wide]
    length = frame[after] - frame[before] - 1
    first = np.cumsum(length) - length  # of the missed frames, that of each gap
    steps = 1 + np.arange(length.sum()) - np.repeat(first, length)
    before, after = np.repeat(before, length), np.repeat(after, length)
    return frame[before] + steps, before, after, steps / (frame[after] - frame[before])
