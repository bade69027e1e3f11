"""What becomes of changes in a movie: whether particles land and stay, or move.

Averages A_j of successive blocks of frames change where something happens.  A change is seen as
S_j = A_{j+1} − A_{j−1}, with the block in which it happens between.  Where a particle lands or
leaves, the blocks before agree with each other, and so do those after: A_{j+2} − A_{j+1} and
A_{j−1} − A_{j−2} are noise.  Where one came that moves, it is gone again after, or came just
before, and one of these differences undoes the change: it is near −S_j.  A pattern that drifts
steadily changes by S_j/2 each time, which is neither.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from iscat_analysis.medians import middle
from iscat_analysis.search.peaks import maxima

CLEAR = 12.0
"""Standard deviations of noise that a change must exceed: the ratios below then have errors of a
tenth."""

STAYS, UNDONE = 0.15, -0.5
"""Bounds of what the neighbouring differences come to, as parts of a change: beyond the first, and
beyond noise, it does not stay, for rings of others make less; below the second it is undone."""

_SHARED = 0.5  # of the picture's share beside its centre, which the pixels there have at least
_QUIET = 4.0  # standard deviations of noise
_SPOT = 0.21  # standard deviation of a spot, in wavelengths over NA
_NORMAL = 1.4826  # standard deviation of a normal law over its median deviation
_BESIDE = 1, 2, 2  # blocks and pixels on either side within which a change is the largest
_LEAST_BLOCKS = 5


@dataclass(frozen=True)
class Changes:
    """Clear changes in a movie.

    Attributes
    ----------
    number : int
        How many there are.
    staying : float
        Share after which everything stays as it is, as before; NaN where there is none.
    undone : float
        Share that is undone at once, or undoes another.
    """

    number: int
    staying: float
    undone: float


def find_changes(blocks: Sequence[NDArray[np.floating]], spot_px: float) -> Changes:
    """Look for changes from block to block, and at what becomes of them.

    Parameters
    ----------
    blocks : sequence of ndarray, shape (y, x)
        Mean images of successive blocks of frames, over that of all: 1 where nothing changes.
    spot_px : float
        Standard deviation of a particle's picture [px], from `spot_of`.

    Returns
    -------
    Changes
        None in fewer than 5 blocks.
    """
    if len(blocks) < _LEAST_BLOCKS:
        return Changes(0, float("nan"), float("nan"))
    smooth = np.empty((len(blocks), *blocks[0].shape), dtype=np.float32)
    for image, out in zip(blocks, smooth, strict=True):
        contrast = image - 1  # whose noise single precision holds
        out[:] = gaussian_filter(contrast, spot_px)
        out -= gaussian_filter(contrast, 4 * spot_px)
    lag = np.diff(smooth, axis=0)
    noise = _NORMAL * _median_deviation(lag)
    change = smooth[3:-1] - smooth[1:-3]
    size = np.abs(change)
    peaks = maxima(size, max(CLEAR * noise, 0.0), _BESIDE)
    found = tuple(peaks[_of_spots(blocks, peaks, spot_px)].T)
    if not found[0].size:
        return Changes(0, float("nan"), float("nan"))
    before, after = (part[found] / change[found] for part in (lag[: len(change)], lag[3:]))
    quiet = np.maximum(_QUIET * noise / size[found], STAYS)
    staying = np.maximum(np.abs(before), np.abs(after)) < quiet
    undone = np.minimum(before, after) < UNDONE
    return Changes(found[0].size, float(staying.mean()), float(undone.mean()))


def _of_spots(
    blocks: Sequence[NDArray[np.floating]], peaks: NDArray[np.int64], spot_px: float
) -> NDArray[np.bool_]:
    """Tell changes whose neighbouring pixels change as well from pixels that blink."""
    least = least_beside(spot_px)
    real = np.ones(len(peaks), dtype=np.bool_)
    rows, columns = blocks[0].shape
    for number, (t, y, x) in enumerate(peaks.tolist()):
        if 0 < y < rows - 1 and 0 < x < columns - 1:
            part = slice(y - 1, y + 2), slice(x - 1, x + 2)
            change = blocks[t + 3][part] - blocks[t + 1][part]
            beside = (change[0, 1] + change[2, 1] + change[1, 0] + change[1, 2]) / 4
            real[number] = beside * np.sign(change[1, 1]) > least * abs(change[1, 1])
    return real


def _median_deviation(values: NDArray[np.floating]) -> float:
    """Median of the magnitudes of deviations from the median."""
    deviation = values.ravel() - middle(values.flatten())
    return float(middle(np.abs(deviation, out=deviation)))


def least_beside(spot_px: float) -> float:
    """Give the part of a particle's change that the pixels beside its centre have at least.

    Parameters
    ----------
    spot_px : float
        Standard deviation of a particle's picture [px], from `spot_of`.

    Returns
    -------
    float
        Below it, a pixel changes by itself.
    """
    return _SHARED * math.exp(-0.5 / spot_px**2)


def spot_of(wavelength_nm: float, na: float, pixel_nm: float) -> float:
    """Give the standard deviation of a particle's picture.

    Parameters
    ----------
    wavelength_nm : float
        Of the light [nm].
    na : float
        Numerical aperture.
    pixel_nm : float
        Side of a pixel [nm].

    Returns
    -------
    float
        In pixels, at least half a one.
    """
    return max(_SPOT * wavelength_nm / na / pixel_nm, 0.5)
