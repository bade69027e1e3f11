"""Where particles are in every frame of a movie, and which of them are one particle.

The matched filter of `iscat_analysis.search.templates`, for many frames over one background: its
noise is the same in all of them but for their power, so that one transform and one product serve
each frame.  Only particles are looked for, and not the holes that they leave in a background that
is not theirs alone yet: the sign of the contrast is the model's.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from iscat_analysis.errors import DataError
from iscat_analysis.records import BoolArray, FloatArray
from iscat_analysis.search.peaks import SAMPLED, summits
from iscat_analysis.search.templates import FAR_LOBE, NEAR, SIDELOBE, Templates

IntArray = NDArray[np.int64]

LEFT_OVER = 0.2
"""Of a particle's signal-to-noise ratio that a candidate beside it must reach when what was fitted
has been taken off: less may be what the model leaves over."""


@dataclass(frozen=True)
class Sightings:
    """Candidates in frames, in the order of the frames.

    Attributes
    ----------
    frame : ndarray of int, shape (n,)
        Frame.
    x_px, y_px : ndarray, shape (n,)
        Place [pixels].
    z_nm : ndarray, shape (n,)
        Height of the template [nm].
    strength : ndarray, shape (n,)
        Linear estimate of the amplitude.
    snr : ndarray, shape (n,)
        Signal-to-noise ratio.
    """

    frame: IntArray
    x_px: FloatArray
    y_px: FloatArray
    z_nm: FloatArray
    strength: FloatArray
    snr: FloatArray


class FrameFilter:
    """A matched filter for the frames of one movie.

    Parameters
    ----------
    templates : Templates
        The pictures and the threshold.
    level_e : ndarray, shape (y, x)
        Background at power 1 [e].
    read_e2 : ndarray, shape (y, x)
        Variance of the read noise [e²].
    used : ndarray of bool, shape (y, x)
        Pixels that may be used.
    polarity : int
        Sign of the contrasts that are wanted; 0 for both.
    roi_px : int
        Side of the fitted square [pixels].
    """

    def __init__(
        self,
        templates: Templates,
        level_e: FloatArray,
        read_e2: FloatArray,
        used: BoolArray,
        *,
        polarity: int,
        roi_px: int,
    ) -> None:
        self._templates = templates
        self._roi_px = roi_px
        light = np.where(used, level_e**2 / (level_e + read_e2), 0.0)
        self._share = np.where(used, level_e / (level_e + read_e2), 0.0).astype(np.float32)
        images = templates.images
        half = images.shape[1] // 2
        self._half, (rows, columns) = half, level_e.shape
        self._padded = [next_fast_len(n + 2 * half, real=True) for n in (rows, columns)]
        flipped = images[:, ::-1, ::-1]
        norm = self._filtered(light, rfft2(flipped**2, self._padded))
        self._norm = np.maximum(norm, 1e-9 * norm.max())
        self._duals = rfft2(flipped.astype(np.float32), self._padded)
        self._layers = np.flatnonzero((polarity == 0) | (templates.signs == polarity))

    def find(
        self,
        residual_e: NDArray[np.float32],
        power: FloatArray,
        first: int,
        known: list[FloatArray],
    ) -> Sightings:
        """Find candidates in a block of frames.

        Parameters
        ----------
        residual_e : ndarray of float32, shape (n, y, x)
            Counts minus what is expected [e].
        power : ndarray, shape (n,)
            Of these frames.
        first : int
            Number of the first of them.
        known : list of ndarray, shape (k, 3)
            What is known in each: x, y [pixels] and signal-to-noise ratio.

        Returns
        -------
        Sightings
            Above the threshold, strongest first in each frame, side lobes left out.
        """
        found: list[tuple[float, ...]] = []
        threshold = self._templates.threshold
        for i, frame in enumerate(residual_e):
            spectrum = rfft2(frame * self._share, self._padded)
            overlap = self._filtered_by(spectrum)
            snr = overlap / np.sqrt(power[i] * self._norm[self._layers])
            best = snr.max(axis=0) if len(snr) > 1 else snr[0]
            at = _maxima(best, SAMPLED * threshold)
            layers = snr[:, *at].argmax(axis=0)
            dy, dx, above = summits(snr, np.stack([layers, *at], axis=1))
            tops = [best[*at] + above, layers, *at, at[0] + dy, at[1] + dx]
            peaks = sorted(zip(*(t.tolist() for t in tops), strict=True), reverse=True)
            kept: list[tuple[float, float, float]] = []
            for height, k, row, column, y, x in peaks:
                if height <= threshold:
                    break
                if self._is_lobe(height, x, y, kept) or self._is_left_over(height, x, y, known[i]):
                    continue
                kept.append((height, x, y))
                layer = int(self._layers[k])
                strength = height / np.sqrt(power[i] * self._norm[layer, row, column])
                z = float(self._templates.z_nm[layer])
                found.append((first + i, x, y, z, float(strength), height))
        columns = np.array(found).reshape(-1, 6).T
        return Sightings(columns[0].astype(np.int64), *columns[1:])

    def _is_lobe(
        self, height: float, x: float, y: float, kept: list[tuple[float, float, float]]
    ) -> bool:
        """Whether a peak may be a side lobe of a higher one."""
        for other, ox, oy in kept:
            away = max(abs(x - ox), abs(y - oy))
            if height < other * (SIDELOBE if away < self._roi_px else FAR_LOBE):
                return True
            if np.hypot(x - ox, y - oy) < NEAR * self._roi_px:
                return True
        return False

    def _is_left_over(self, height: float, x: float, y: float, known: FloatArray) -> bool:
        """Whether a peak may be what the model leaves over of a particle that is known."""
        if not len(known):
            return False
        near = np.hypot(known[:, 0] - x, known[:, 1] - y) < NEAR * self._roi_px
        return bool(np.any(near & (height < LEFT_OVER * known[:, 2])))

    def _filtered(self, image: FloatArray, duals: NDArray[np.complex128]) -> FloatArray:
        """Correlate an image with every kernel, shape (n, y, x)."""
        half, (rows, columns) = self._half, image.shape
        full = irfft2(rfft2(image, self._padded) * duals, self._padded)
        return np.asarray(full[:, half : half + rows, half : half + columns])

    def _filtered_by(self, spectrum: NDArray[np.complex64]) -> NDArray[np.float32]:
        half, (_, rows, columns) = self._half, self._norm.shape
        full = irfft2(spectrum * self._duals[self._layers], self._padded)
        return np.asarray(full[:, half : half + rows, half : half + columns])


def _maxima(field: FloatArray, level: float) -> tuple[IntArray, IntArray]:
    """Rows and columns of the pixels above a level that none of their neighbours exceeds."""
    row, column = np.nonzero(field > level)
    padded = np.pad(field, 1, constant_values=-np.inf)
    around = sliding_window_view(padded, (3, 3))[row, column].max(axis=(1, 2))
    highest = field[row, column] == around
    return row[highest], column[highest]


def link(frame: IntArray, places_nm: FloatArray, *, reach_nm: float, memory: int) -> IntArray:
    """Say which positions are one particle.

    Parameters
    ----------
    frame : ndarray of int, shape (n,)
        Not decreasing.
    places_nm : ndarray, shape (n, axes)
        x and y [nm], and whatever else is its own, as a length: a particle keeps its mass where it
        crosses another.
    reach_nm : float
        Farthest that a particle goes from one frame to the next [nm].
    memory : int
        Frames in which it may be missed.

    Returns
    -------
    ndarray of int, shape (n,)
        Number of the track, from 0.

    Raises
    ------
    DataError
        More particles than can be told apart are in reach of each other.

    Notes
    -----
    trackpy (D. B. Allan et al., doi:10.5281/zenodo.4682814), after J. C. Crocker and D. G. Grier,
    J. Colloid Interface Sci. 179, 298 (1996).
    """
    tracks = np.zeros(len(frame), dtype=np.int64)
    if not len(frame):
        return tracks
    import trackpy

    logging.getLogger("trackpy").setLevel(logging.WARNING)  # it reports every frame
    frames = np.arange(frame[0], frame[-1] + 1)
    edges = np.searchsorted(frame, np.append(frames, frames[-1] + 1))
    spans = [slice(a, b) for a, b in pairwise(edges)]
    linked = trackpy.link_iter(
        ((int(t), places_nm[span]) for t, span in zip(frames, spans, strict=True)),
        search_range=reach_nm,
        memory=memory,
    )
    try:
        for span, (_, numbers) in zip(spans, linked, strict=True):
            tracks[span] = numbers
    except trackpy.SubnetOversizeException as trouble:
        raise DataError(
            f"too many particles are within track.max_step_nm = {reach_nm:g} of each other to tell "
            "which is which from frame to frame: lower it to the farthest that one goes, or record "
            "fewer particles or more frames a second"
        ) from trouble
    return tracks


def gaps(frame: IntArray, track: IntArray) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
    """Give the frames inside tracks in which the particle was missed.

    Parameters
    ----------
    frame, track : ndarray of int, shape (n,)
        Of each position.

    Returns
    -------
    missed : ndarray of int, shape (m,)
        Frame.
    before, after : ndarray of int, shape (m,)
        Indices of the positions between which it lies.
    share : ndarray, shape (m,)
        How far on the way from the one to the other.
    """
    order = np.lexsort((frame, track))
    missed, before, after, share = [], [], [], []
    for a, b in pairwise(order):
        if track[a] == track[b]:
            for t in range(int(frame[a]) + 1, int(frame[b])):
                missed.append(t)
                before.append(a)
                after.append(b)
                share.append((t - frame[a]) / (frame[b] - frame[a]))
    whole = [np.array(v, dtype=np.int64) for v in (missed, before, after)]
    return whole[0], whole[1], whole[2], np.array(share, dtype=float)
