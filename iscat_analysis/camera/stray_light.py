"""Light, or dark counts, that are added to all pixels equally and change with time.

Where light of the room or the offset of the camera drifts, pixels change relative to their own
light by one over it, dim ones most.  The size of that change is the same in all parts of the field.
Smooth changes of the light do not affect it; a pattern that moves makes it differ from part to
part.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis.camera.light_changes import Changes
from iscat_analysis.records import FloatArray

_PARTS = 8  # along each axis
_SIGNIFICANT = 30.0  # squared standard errors, which follow from the differences of the parts
_RESIDUAL_SIGMAS = 4.0  # standard errors of what is left over in a part
_LEAST_PATTERN_RATIO = 10.0  # times what the noise of the mean frame tells, that its pattern must
_MOST_PATTERN_RATIO = 4.0  # times what the median part tells, more than which none should
_MOST_ADDED_SHARE = 0.25  # of the mean light, more than which is not added between windows
_LEAST_PARTS = 16
_LEAST_PATTERN_POWER = 1e-3  # by a part, of what others tell


def lift(light_e: FloatArray) -> FloatArray:
    """Relative change of pixels to which the same number is added.

    Shapes: `light_e` (y, x), result (y, x).
    """
    used = light_e > 0
    return np.where(used, light_e[used].mean() / np.where(used, light_e, 1.0), 0.0)


def find_stray_light(changes: Changes, window: int) -> float:
    """Measure a change that is added to all pixels equally, over the mean light; 0 if none."""
    light, more = changes.light_e, lift(changes.light_e)
    rows, columns = (
        np.equal.outer(np.arange(_PARTS), np.arange(n) * _PARTS // n).astype(np.float64)
        for n in light.shape
    )

    def summed(values: FloatArray) -> FloatArray:
        parts: FloatArray = rows @ values @ columns.T
        return parts.reshape(*values.shape[:-2], -1)

    held, once, twice = summed(light), summed(light * more), summed(light * more**2)
    pattern_power = np.maximum(twice - np.square(once) / np.where(held > 0, held, 1.0), 0.0)
    if not (pattern_power > 0).any():
        return 0.0
    usual = np.median(pattern_power[pattern_power > 0])
    lit = (pattern_power > 0) & (
        pattern_power < _MOST_PATTERN_RATIO * usual
    )  # without dust and particles
    if lit.sum() < _LEAST_PARTS:
        return 0.0
    mean, pattern_power = once[lit] / held[lit], pattern_power[lit]
    pixels = summed((light > 0).astype(np.float64))[lit]
    if pattern_power.sum() < _LEAST_PATTERN_RATIO * pixels.sum() * changes.noises.mean() / len(
        changes.noises
    ):
        return 0.0
    bright = np.where(light > 0, light, 1.0)
    levels, lifts, squares = [], [], []
    for sums in changes.sums_e:  # one pair after the other, to save memory
        each = sums * (light.sum() / sums.sum(axis=(1, 2), keepdims=True)) - light
        levels.append(summed(each)[:, lit])
        lifts.append(summed(each * more)[:, lit])
        squares.append(summed(np.square(each[1] - each[0]) / bright)[lit])
    level, lifted = np.array(levels), np.array(lifts)
    even = level[:, 1] - level[:, 0]
    seen = lifted[:, 1] - lifted[:, 0] - even * mean
    added = seen.sum(axis=1, keepdims=True) / pattern_power.sum()
    rest = seen - added * pattern_power
    spread = np.square(rest) / np.maximum(
        pattern_power, pattern_power.mean() * _LEAST_PATTERN_POWER
    )
    error = spread.sum(axis=1) / (lit.sum() - 1) / pattern_power.sum()
    square = float(np.median(np.square(added)))
    if square > _MOST_ADDED_SHARE**2:
        return 0.0
    if square * pattern_power.sum() / light.sum() < changes.least(window) + changes.error:
        return 0.0
    if np.median(np.square(added[:, 0]) / error) < _SIGNIFICANT:
        return 0.0
    # in variances of noise, of the pixels of a part
    noises = changes.noises[:, None]
    gain = np.square(added) * pattern_power / noises
    left = np.array(squares) / noises - np.square(even) / held[lit] / noises - gain - (pixels - 1)
    doubt = _RESIDUAL_SIGMAS * math.sqrt(2 * float(pixels.mean()) / left.size)
    if np.median(left) > np.median(gain) + doubt:
        return 0.0
    here = lifted - level * mean
    return float(np.ptp(here.sum(axis=-1))) / float(pattern_power.sum())
