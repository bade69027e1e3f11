"""Pixels that cannot be used: saturated, dead, hot, blinking."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from iscat_analysis.camera.calibration.moments import Moments, brightness_bins, robust_sigma
from iscat_analysis.camera.counts import converter_ceiling
from iscat_analysis.errors import DataError
from iscat_analysis.records import BoolArray, FloatArray

KINDS = ("saturated", "clipped", "dead", "hot")
"""What may be wrong with a pixel."""

_DARK, _BRIGHT = 0.2, 5.0  # of the neighbours' median, as in the stage background
_OUTLIER_SIGMAS = 8.0


def saturated(highest: NDArray[Any], name: str) -> BoolArray:
    """Find saturated pixels: at the largest number of their type, or of an ADC of 8 to 16 bits.

    Shapes: `highest` (y, x), result (y, x).
    """
    top = float(highest.max())
    ceiling = converter_ceiling(highest)
    if np.issubdtype(highest.dtype, np.integer):
        ceiling = min(ceiling, float(np.iinfo(highest.dtype).max))
    full: BoolArray = highest >= ceiling
    if full.mean() > 0.5:
        raise DataError(
            f"{name}: {100 * full.mean():.0f} % of the pixels are saturated (count {top:g}); "
            "lower the exposure or the laser power"
        )
    return full


def unlike_neighbours(light: FloatArray, *, low: float = _DARK, high: float = _BRIGHT) -> BoolArray:
    """Find pixels far darker or brighter than their neighbours.

    Shapes: `light` (y, x), result (y, x).
    """
    local = np.maximum(median_filter(light, size=5, mode="nearest"), 0.0)
    with np.errstate(invalid="ignore"):
        found: BoolArray = (light < low * local) | (light > high * local)
    return np.asarray(found & (local > 0), dtype=np.bool_)


def clipped(lowest: NDArray[Any]) -> BoolArray:
    """Find pixels that reached zero counts, below which nothing is stored.

    Shapes: `lowest` (y, x), result (y, x).
    """
    unsigned = np.issubdtype(lowest.dtype, np.unsignedinteger)
    return np.asarray((lowest == 0) & unsigned, dtype=np.bool_)


def stand_out(values: FloatArray) -> BoolArray:
    """Find pixels far above the others, in robust standard deviations.

    Shapes: `values` (y, x), result (y, x).
    """
    centre = float(np.median(values))
    spread = robust_sigma(values - centre)
    return np.asarray(values > centre + _OUTLIER_SIGMAS * max(spread, 1e-3), dtype=np.bool_)


def unsteady(found: Sequence[Moments], used: BoolArray) -> BoolArray:
    """Find pixels that blink, or over which a particle moved.

    Shapes: `used` (y, x), result (y, x).
    """
    out = np.zeros(used.shape, dtype=np.bool_)
    for item in found:
        mean, variance = item.mean[used], item.variance[used]
        smooth = np.empty(mean.size)
        for part in brightness_bins(mean):
            smooth[part] = np.median(variance[part])
        limit = 1 + _OUTLIER_SIGMAS * item.relative_se
        out[used] |= variance > limit * smooth
    return out


def mask_notes(masked: Mapping[str, BoolArray]) -> list[str]:
    """Say how many pixels are left out, and where.

    Shapes: `masked` (y, x).
    """
    notes = []
    for name, mask in masked.items():
        count = int(mask.sum())
        if count:
            place = np.argwhere(mask)[0]
            notes.append(
                f"{count} of {mask.size} pixels {'is' if count == 1 else 'are'} {name} and left "
                f"out, the first at y = {place[0]}, x = {place[1]}"
            )
    return notes
