"""Whether counts have a true zero: whether their noise is that of light, where the light is even.

Contrast is a change of counts over counts above zero light.  A movie that was divided by its own
background, or had it taken off, is flat; scaled to other numbers, its zero is anywhere.  The noise
knows: raw counts m with the zero o have the variance (m − o)/g.  Where light is uneven over the
field its pixels tell o (see `transfer`); where it is even, frames do, as the laser flickers:

    κ = d ln v/d ln m = m/(m − o) .

Where the laser is steady as well nothing tells o, but what was done to the movie may still show:
its noise is uneven as the background was, although its light is even, or its mean is smoother than
the noise of its frames allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.calibration.laws import SIGMAS
from iscat_analysis.camera.counts import Camera
from iscat_analysis.records import FloatArray

TOLD = 0.1
"""Error of the zero, as a share of the light, up to which the pixels tell it well enough."""

_TOLD_IN_TIME = 0.25  # error of κ, from where frames tell nothing
_LEAST_FRAMES, _LEAST_PIXELS = 16, 256
_LEAST_UNEVEN, _OVER_LIGHT = 0.03, 2.0  # of the noise, and times that of the light
_CLEAR = 6.0  # standard errors of what was done to the movie
_QUANTILE = 0.15866  # of a normal law, one standard deviation below its middle
_QUANTILE_ERROR = 3.2  # √n times the relative error of the square of that deviation
_LARGEST_SQUARE = 25.0  # over the variance, of a change that counts: more is of a particle
_SHARED = 1.5  # variance of a sum of squares of successive differences, which share a frame


@dataclass(frozen=True)
class Zero:
    """What the noise says of the zero that is assumed.

    `error` is of it, as a share of the light, None where nothing tells; `cause` why it is none.
    """

    error: float | None
    cause: str
    level_e: float


def judge_zero(
    counts: NDArray[Any], camera: Camera, *, most_read_e2: float, moving: bool
) -> Zero | None:
    """Judge the zero of counts whose light is even over the field; None of too few counts.

    `most_read_e2` is the variance of read noise that nobody need say.  Where particles are
    `moving`, noise is uneven by them.

    Shapes: `counts` (t, y, x).
    """
    if len(counts) < _LEAST_FRAMES or counts[0].size < _LEAST_PIXELS:
        return None
    light = camera.to_electrons(counts).reshape(len(counts), -1)
    power, mean = light.mean(axis=1), light.mean(axis=0)
    level = float(power.mean())
    if level <= 0:
        return None
    steps = np.diff(light, axis=0)
    steps -= np.diff(power)[:, None] / level * mean
    variance = np.mean(steps**2, axis=0) / 2
    if not np.median(variance) > 0:
        return None
    other = float(camera.dark_variance_e2(counts).mean())
    growth, error = _growth(steps, variance, power / level, other)
    if error <= _TOLD_IN_TIME:
        if abs(growth - 1) <= SIGMAS * error:
            return Zero(math.hypot(growth - 1, error), "", level)
        if growth + SIGMAS * error < level / (level + most_read_e2):
            return Zero(
                None,
                f"from frame to frame the variance grows {growth:.2g} ± {error:.1g} times as fast "
                "as the light, and in raw counts as fast as that",
                level,
            )
    return Zero(None, "" if moving else _traces(steps, variance, mean), level)


def _growth(
    steps: FloatArray, variance: FloatArray, power: FloatArray, other: float
) -> tuple[float, float]:
    """Give how fast the variance grows with the power, relative, and its standard error.

    Shapes: `steps` (t − 1, n), `variance` (n,), `power` (t,).
    """
    floor = np.maximum(variance, 1e-3 * np.median(variance))
    seen = np.minimum(steps**2 / (2 * floor), _LARGEST_SQUARE).mean(axis=1)
    seen /= seen.mean()
    light = (power[1:] + power[:-1]) / 2
    light = light - light.mean()
    spread = float(light @ light)
    if not spread > 0:
        return 0.0, math.inf
    slope = float(light @ seen) / spread
    rest = float(np.var(seen - 1 - slope * light))
    share = max(1 - other / float(np.mean(variance)), 0.1)  # of the variance, that is of light
    return slope / share, math.sqrt(_SHARED * rest / spread) / share


def _traces(steps: FloatArray, variance: FloatArray, mean: FloatArray) -> str:
    """Say what in a movie shows that it was divided by its background, or had it taken off.

    Deviations are those below the middle: where particles come, the variance is only more.  What
    both halves of the frames share is no chance.

    Shapes: `steps` (t − 1, n), `variance, mean` (n,).
    """
    half = len(steps) // 2
    first, last = (np.mean(part**2, axis=0) / 2 for part in (steps[:half], steps[half:]))
    usual, chance = float(np.median(variance)), 1 / math.sqrt(variance.size)
    sum2, difference2 = (
        _below(part) / usual**2 for part in ((first + last) / 2, (first - last) / 2)
    )
    uneven2 = sum2 - difference2
    own = usual / (len(steps) + 1)  # variance of the mean of raw counts
    light2 = max(_below(mean) - own, 0.0) / float(mean.mean()) ** 2
    clear = uneven2 > _CLEAR * _QUANTILE_ERROR * chance * sum2
    if clear and uneven2 > max(_LEAST_UNEVEN**2, _OVER_LIGHT**2 * light2):
        return (
            f"the variance differs over the field by {100 * math.sqrt(uneven2):.2g} %, the light "
            f"by {100 * math.sqrt(light2):.1g} %, and in raw counts they are alike"
        )
    low, high = np.quantile(mean, [_QUANTILE, 1 - _QUANTILE])
    smooth = ((high - low) / 2) ** 2 / own
    if smooth * (1 + _CLEAR * _QUANTILE_ERROR / 2 * chance) < 1:
        return (
            f"the mean of the frames is smoother than their noise lets it be, with {smooth:.2g} of "
            "its variance"
        )
    return ""


def _below(values: FloatArray) -> float:
    """Square of the deviation below the median that a normal law would have."""
    middle, low = np.quantile(values, [0.5, _QUANTILE])
    return float(middle - low) ** 2
