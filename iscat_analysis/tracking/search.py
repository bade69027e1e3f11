"""Where particles are in every frame of a movie, and which of them are one particle.

The matched filter of `iscat_analysis.search.templates`, for many frames over one background: its
noise is the same in all of them but for their power, so that one transform and one product serve
each frame.  Only particles are looked for, and not the holes that they leave in a background that
is not theirs alone yet: the sign of the contrast is the model's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.search.peaks import SAMPLED, maxima, summits
from iscat_analysis.search.templates import FAR_LOBE, NEAR, SIDELOBE, Templates
from iscat_analysis.tracking.field import MovingField
from iscat_analysis.tracking.rows import BackgroundEstimate, Localizations

_BLOCK = 16  # frames that are searched at a time; more need room that is slow to clear

LEFT_OVER = 0.2
"""Of a particle's signal-to-noise ratio that a candidate beside it must reach when what was fitted
has been taken off: less may be what the model leaves over."""

_HIGHER = 2.5
"""What rings may be through optics that are not the model's, over those of the model."""


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
        self._half = half = images.shape[1] // 2
        # what wraps around falls on the first rows and columns, which are cut off
        self._padded = [next_fast_len(n + half, real=True) for n in level_e.shape]
        self._layers = np.flatnonzero((polarity == 0) | (templates.signs == polarity))
        flipped = images[:, ::-1, ::-1]
        norm = self._cut(rfft2(light, self._padded) * rfft2(flipped**2, self._padded))
        norm = np.sqrt(np.maximum(norm, 1e-9 * norm.max()))
        self._norm = norm[self._layers].astype(np.float32)
        # Side lobes of a peak, over it: of several heights they are as high as `SIDELOBE` says.
        self._lobe = SIDELOBE
        if len(self._layers) == 1:
            self._lobe = min(SIDELOBE, _HIGHER * _ring(images[self._layers[0]], NEAR * roi_px))
        self._duals = rfft2(flipped[self._layers].astype(np.float32), self._padded)

    def find(
        self, residual_e: NDArray[np.float32], power: FloatArray, known: list[FloatArray]
    ) -> Localizations:
        """Find candidates in a block of frames, numbered from 0; their places are in pixels.

        Shapes: `residual_e` (n, y, x), `power` (n,), `known` (k, 3).
        """
        at_once = max(32 // len(self._layers), 1)
        parts = []
        for start in range(0, len(residual_e), at_once):
            here = slice(start, start + at_once)
            tops = self._peaks(residual_e[here], power[here])
            tops = tops.only(self._alone(tops, known[here]))
            parts.append(replace(tops, frame=tops.frame + start))
        return Localizations.together(parts)

    def _peaks(self, residual_e: NDArray[np.float32], power: FloatArray) -> Localizations:
        """Find the peaks above the threshold, the highest of each frame first."""
        threshold = self._templates.threshold
        spectrum = rfft2(residual_e * self._share, self._padded)[:, None]
        noise = np.sqrt(power).astype(np.float32)[:, None, None, None] * self._norm
        snr = self._cut(spectrum * self._duals) / noise
        best = snr.max(axis=1)
        frame, row, column = maxima(best, SAMPLED * threshold, (0, 1, 1)).T
        layer = snr[frame, :, row, column].argmax(axis=1)
        at = np.stack([frame * len(self._layers) + layer, row, column], axis=1)
        dy, dx, above = summits(snr.reshape(-1, *snr.shape[2:]), at)
        height = best[frame, row, column] + above
        strength = height / (np.sqrt(power[frame]) * self._norm[layer, row, column])
        z_nm, nothing = self._templates.z_nm[self._layers[layer]], np.zeros(len(frame))
        theta = np.column_stack([column + dx, row + dy, z_nm, strength, nothing])
        order = np.lexsort((-column, -row, -layer, -height, frame))
        tops = replace(Localizations.of(frame, np.full(len(frame), -1), theta), snr=height)
        return tops.only(order[height[order] > threshold])

    def _alone(self, tops: Localizations, known: list[FloatArray]) -> BoolArray:
        """Tell which peaks are neither side lobes nor residues.

        The highest peaks of each frame come first.  In each round the highest remaining peak of
        every frame is accepted and its side lobes are removed.
        """
        kept, left = np.zeros(len(tops.frame), dtype=bool), np.arange(len(tops.frame))
        sure = ~self._are_left_over(tops, known)
        while left.size:
            begins = np.diff(tops.frame[left], prepend=-1) > 0
            accepted = left[begins]
            kept[accepted] = sure[accepted]
            top = accepted[np.cumsum(begins) - 1]
            hides = sure[top] & self._is_lobe(tops.only(left), tops.only(top))
            left = left[~(begins | hides)]
        return kept

    def _is_lobe(self, one: Localizations, other: Localizations) -> BoolArray:
        """Tell which peaks may be side lobes of higher ones."""
        apart = one.theta[:, :2] - other.theta[:, :2]
        within_region = np.abs(apart).max(axis=1) < self._roi_px
        lobe = one.snr < other.snr * np.where(within_region, self._lobe, FAR_LOBE)
        lobe |= np.hypot(*apart.T) < NEAR * self._roi_px
        return np.asarray(lobe | within_region if self._cautious else lobe)

    def _are_left_over(self, tops: Localizations, known: list[FloatArray]) -> BoolArray:
        """Tell which peaks may be residues of particles that were fitted already."""
        places = np.full((len(known), max(map(len, known)), 3), np.nan)
        for row, there in zip(places, known, strict=True):
            row[: len(there)] = there
        known_x, known_y, known_height = np.moveaxis(places[tops.frame], 2, 0)
        away = np.hypot(known_x - tops.theta[:, :1], known_y - tops.theta[:, 1:2])
        if self._cautious:
            return np.asarray((away < self._roi_px).any(axis=1))
        over = (away < NEAR * self._roi_px) & (tops.snr[:, None] < LEFT_OVER * known_height)
        return np.asarray(over.any(axis=1))

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


_SAMPLED = 4  # blocks, of which one tells whether the others are searched


RING_SLOPE = 1.7
"""Distance of the outer rings of a particle over its height, tan 60°: within it, what is much
fainter than the particle may be what the model leaves over of them."""


def search_frames(
    context: AnalysisContext,
    field: MovingField,
    ground: BackgroundEstimate,
    rows: Localizations,
    frames: tuple[int, int] | None = None,
    *,
    enough: int = 0,
    cautious: bool = False,
) -> Localizations:
    """Find candidates in the residual of the rows so far."""
    side = context.roi_px
    if context.config.fit.heights_free:
        side += round(2 * RING_SLOPE * context.config.fit.z_range_nm[1] / field.pixel_nm)
    sign, light = context.config.detection.sign, (ground.level, field.read_e2, field.used)
    search = FrameFilter(context.templates, *light, polarity=sign, roi_px=side, cautious=cautious)
    if frames is None:
        field.draw(ground, rows)
    starts = rows.starts(field.frames)
    places = np.column_stack([rows.theta[:, :2] / field.pixel_nm, rows.snr])
    begin, end = frames or (0, field.frames)

    def block(first: int) -> Localizations:
        last = min(first + _BLOCK, end)
        known = [places[starts[t] : starts[t + 1]] for t in range(first, last)]
        left = field.residual(ground, rows, first, last)
        found = search.find(left, ground.power[first:last], known)
        theta = found.theta * [field.pixel_nm, field.pixel_nm, 1, 1, 1]
        return replace(found, frame=found.frame + first, theta=theta)

    blocks = range(begin, end, _BLOCK)
    sample = blocks[:: _SAMPLED if enough else 1]
    mapper = field.mapper if frames is None else map
    parts = dict(zip(sample, mapper(block, sample), strict=True))
    if sum(len(part.frame) for part in parts.values()) > enough / _SAMPLED:
        others = [first for first in blocks if first not in parts]
        parts |= zip(others, mapper(block, others), strict=True)
    return Localizations.together([parts[first] for first in sorted(parts)])
