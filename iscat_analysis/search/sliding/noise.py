"""Noise against averaging, and the windows it makes worth having."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.movie.camera import Camera
from iscat_analysis.records import Mapper

LONGEST_WINDOW = 100
"""Frames that a window chosen from the noise may have; beyond it events overlap too often."""

SHORTEST_WINDOW = 10
"""Frames that it must have at least."""

SHORTEST_MOVIE = 4 * SHORTEST_WINDOW
"""Frames of the shortest movie for which windows are chosen."""

MOVIE_SHARE = 10
"""A window chosen from the noise takes at most this part of the movie."""

SHOT_LIMITED = 1.2
"""Noise variance over shot noise up to which averaging is called shot-noise limited."""

_LENGTHS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 50, 70, 100)
_NORMAL_QUARTILE = 0.6744897501960817
_ROWS = 16  # on which the noise is measured


@dataclass(frozen=True)
class NoiseCurve:
    """Noise of the contrast between neighbouring averages, against their length.

    Attributes
    ----------
    frames : tuple of int
        Lengths n.
    variance_over_shot : tuple of float
        Robust variance of the contrast over that of shot noise; rises where averaging no longer
        helps.
    """

    frames: tuple[int, ...]
    variance_over_shot: tuple[float, ...]

    @property
    def shot_limited(self) -> int:
        """Longest average that is shot-noise limited, and every shorter one too; 0 for none."""
        limit = 0
        for n, ratio in zip(self.frames, self.variance_over_shot, strict=True):
            if ratio > SHOT_LIMITED * max(1.0, self.variance_over_shot[0]):
                break
            limit = n
        return limit

    def at(self, length: int) -> float:
        """Noise variance over shot noise of averages of a length."""
        return float(np.interp(length, self.frames, self.variance_over_shot))

    @property
    def best(self) -> int:
        """Length whose contrast is least noisy."""
        noise = [r / n for n, r in zip(self.frames, self.variance_over_shot, strict=True)]
        return self.frames[int(np.argmin(noise))]


def measure_noise(
    counts: NDArray[Any], camera: Camera, longest: int, *, mapper: Mapper = map
) -> NoiseCurve:
    """Noise of averages over frames, as the Allan deviation has it: neighbours are compared.

    Parameters
    ----------
    counts : ndarray, shape (t, y, x)
        Consecutive good frames.
    camera : Camera
        Counts → photoelectrons.
    longest : int
        Longest average wanted.
    mapper : callable
        `map`, or the one of a pool.

    Returns
    -------
    NoiseCurve
        For the lengths of which two fit into the frames.

    Notes
    -----
    D. W. Allan, Proc. IEEE 54, 221 (1966).  Variances are from the median deviation, so that
    particles, which cover few pixels at a time, do not count as noise.
    """
    rows = np.linspace(0, counts.shape[1] - 1, min(_ROWS, counts.shape[1])).astype(int)
    strip = counts[:, rows]
    shape = (counts.shape[1], counts.shape[2])
    gain, offset = (
        np.broadcast_to(v, shape)[rows] for v in (camera.gain_e_per_adu, camera.offset_adu)
    )
    read = camera.read_variance_e2(shape)[rows]

    def ratio(n: int) -> float:
        blocks = 2 * min(len(strip) // (2 * n), 8)
        parts = strip[: blocks * n].reshape(blocks, n, *strip.shape[1:])
        sums = gain * (parts.sum(axis=1, dtype=np.float64) - n * offset)
        before, after = sums[0::2], sums[1::2]
        lit = np.all(sums > 0, axis=0)
        before, after = before[:, lit], after[:, lit]
        power = after.sum(axis=1, keepdims=True) / before.sum(axis=1, keepdims=True)
        contrast = after / (power * before) - 1
        variance = (before + n * read[lit]) / before**2 + (after + n * read[lit]) / after**2
        deviation = float(np.median(np.abs(contrast) / np.sqrt(variance)))
        return (deviation / _NORMAL_QUARTILE) ** 2

    lengths = sorted({*_LENGTHS[:-1], max(longest, 1)})
    lengths = [n for n in lengths if n <= longest and 2 * n <= len(strip)]
    return NoiseCurve(tuple(lengths), tuple(mapper(ratio, lengths)))


def choose_window(curve: NoiseCurve, frames: int) -> int:
    """Choose the window from the noise.

    Parameters
    ----------
    curve : NoiseCurve
        Of the movie.
    frames : int
        Its length.

    Returns
    -------
    int
        The length whose contrast is least noisy, at most a tenth of the movie.
    """
    return max(SHORTEST_WINDOW, min(curve.best, longest_window(frames)))


def longest_window(frames: int) -> int:
    """Longest window that is chosen for a movie.

    Parameters
    ----------
    frames : int
        Frames in the movie.

    Returns
    -------
    int
        Frames.
    """
    return max(SHORTEST_WINDOW, min(LONGEST_WINDOW, frames // MOVIE_SHARE))
