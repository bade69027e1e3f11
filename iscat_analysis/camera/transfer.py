"""Photon transfer of one movie, and where its light ends.

Photon transfer of one movie: noise and response to the laser, against the light.

Pixels of one movie have different light.  The variance between frames and the slope against the
laser power are measured for each pixel, and averaged over pixels of like brightness.

Where the light of a movie ends, beside where the camera's numbers say that it does.

A contrast is a change divided by the light above the offset: an offset that is too low by a share s
of the light makes contrasts, and masses, too small by s.  Two properties of the pixels know where
the light is zero, neither of which needs the gain: how strongly they follow the laser's power,
dm_p/dρ ∝ m_p − o, and their noise, v_p = (m_p − o)/g.  See the module's page.

Whether counts have a true zero: whether their noise is that of light, where the light is even.

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
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.background import unlike_neighbours
from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.moments import Moments, brightness_bins, moments_of, stand_out, unsteady
from iscat_analysis.camera.regression import (
    LEAST_RELIABILITY,
    Estimate,
    variance_line,
    zero_of_flicker,
)
from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.records import BoolArray, FloatArray

TOLERANCE = 0.01
"""Share of the light, and of masses, that may be wrong before it is said."""


SIGMAS = 4.0
"""And the excess over the tolerance that chance must not explain."""


_LEAST_FRAMES = 16
_LEAST_PIXELS = 256
_TILE_PX = 16  # within which pixels may differ from the line together, as a speckle that shakes


@dataclass(frozen=True, eq=False)
class Transfer:
    """Variance and slope of pixels, in bins of like brightness [e]; and where lines end.

    Without `flicker` the laser is too steady, or the scene moved, and `slope` says nothing.
    Shapes: `light, variance, variance_se, slope, slope_se` (bins,).
    """

    light: FloatArray
    variance: FloatArray
    variance_se: FloatArray
    slope: FloatArray
    slope_se: FloatArray
    level: float
    noise: Estimate | None
    flicker: Estimate | None


def measure_transfer(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> Transfer | None:
    """Measure photon transfer; None where the pixels are too alike, too few, or not raw.

    Notes
    -----
    The variance of the read noise and of rounding is taken off.  Where a bright particle lands, its
    pixels change and the light of the field with them, which is no flicker.  Errors are from the
    scatter of pixels, times what squares of `_TILE_PX` pixels scatter more than these.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    if len(counts) < _LEAST_FRAMES:
        return None
    electrons = camera.to_electrons(counts)
    light = electrons.mean(axis=0)
    dark, bright = unlike_neighbours(light)
    used = camera.usable(counts, masked) & (light > 0) & ~dark & ~bright
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    try:
        jumps = _jumps(electrons, light, used)
        found = moments_of(open_stack(electrons), used, lambda _: None, jumps=jumps)
    except DataError:
        return None
    # of the shot noise; what has less, as a picture that was copied, has none
    used &= ~unsteady([found], used) & (found.variance > 1e-6 * light)
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    own = float((found.variance[used] / found.n_frames).mean())
    if own > (1 - LEAST_RELIABILITY) * float(found.mean[used].var()):
        return None
    return _binned(found, used, camera.dark_variance_e2(counts)[used])


def _jumps(electrons: FloatArray, light: FloatArray, used: BoolArray) -> BoolArray:
    """Find successive frames that differ by more than noise and power, as where a particle lands.

    Shapes: `electrons` (t, y, x), `light, used` (y, x), result (t − 1,).
    """
    mean = light[used]
    excess = np.empty(len(electrons) - 1)
    for number, (before, after) in enumerate(pairwise(electrons)):
        step = after[used] - before[used]
        step -= step.mean() / mean.mean() * mean
        excess[number] = np.mean(step**2 / mean)
    return stand_out(excess)


def _binned(found: Moments, used: BoolArray, other: FloatArray) -> Transfer:
    """Average over pixels of like brightness; find the zeros of the lines through all pixels."""
    mean, variance = found.mean[used], found.variance[used] - other
    level = float(mean.mean())
    y, x = np.nonzero(used)
    tiles = (y // _TILE_PX) * (1 + used.shape[1] // _TILE_PX) + x // _TILE_PX
    freedom = np.full(mean.shape, found.n_frames - 1.0)
    (intercept, slope), cov = variance_line(mean, variance, freedom, tiles)
    noise = None
    if slope > 5.0 * math.sqrt(cov[1, 1]):  # the zero is a quotient by the slope
        gradient = np.array([-1 / slope, intercept / slope**2])
        noise = Estimate(-intercept / slope, math.sqrt(gradient @ cov @ gradient))
    seen = found.slope[used], found.slope_variance[used], mean
    flicker = zero_of_flicker(*seen, tiles)
    _, alone = variance_line(mean, variance, freedom)
    wider = [math.sqrt(max(1.0, float(cov[1, 1] / alone[1, 1]))), 1.0]
    if flicker is not None:
        single = zero_of_flicker(*seen)
        wider[1] = max(1.0, flicker.se / single.se) if single is not None else 1.0
    rates, rates2 = found.slope[used], found.slope_variance[used]
    bins = []
    for part in brightness_bins(mean):
        noise_sd, rate_sd = variance[part].std(ddof=1), math.sqrt(rates2[part].mean())
        levels = mean[part].mean(), variance[part].mean(), rates[part].mean()
        bins.append((*levels, wider[0] * noise_sd, wider[1] * rate_sd, part.size))
    light, noises, slopes, noises_sd, slopes_sd, number = np.array(bins).T
    errors = noises_sd / np.sqrt(number), slopes_sd / np.sqrt(number)
    return Transfer(light, noises, errors[0], slopes, errors[1], level, noise, flicker)


@dataclass(frozen=True)
class LightZero:
    """Where the light is zero."""

    share: float
    se: float
    electrons: float
    flickers: bool

    @property
    def off(self) -> bool:
        """Whether the offset is wrong by more than 1 % of the light, not by chance."""
        return abs(self.share) > TOLERANCE + SIGMAS * self.se

    def may_be(self, share: float) -> bool:
        """Tell whether another share may be no light."""
        return abs(self.share - share) < TOLERANCE + SIGMAS * self.se


def find_zero(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> LightZero | None:
    """Find where the light is zero.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    pixels = counts.shape[1] * counts.shape[2]
    most = min(256, max(_LEAST_FRAMES, (2**22) // pixels))  # a tenth of a second
    found = measure_transfer(counts[:most], camera, masked=masked)
    if found is None:
        return None
    known = [
        LightZero(one.value / found.level, one.se / found.level, one.value, flickers)
        for one, flickers in ((found.flicker, True), (found.noise, False))
        if one is not None
    ]
    return min(known, key=lambda one: one.se, default=None)


TOLD = 0.1
"""Error of the zero, as a share of the light, up to which the pixels tell it well enough."""

_LEAST_UNEVEN, _OVER_LIGHT = 0.03, 2.0  # of the noise, and times that of the light
_CLEAR = 6.0  # standard errors of what was done to the movie
_QUANTILE = 0.15866  # of a normal law, one standard deviation below its middle
_QUANTILE_ERROR = 3.2  # √n times the relative error of the square of that deviation


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
    if error <= 0.25:  # frames tell nothing
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
    seen = np.minimum(steps**2 / (2 * floor), 25.0).mean(axis=1)  # more is of a particle
    seen /= seen.mean()
    light = (power[1:] + power[:-1]) / 2
    light = light - light.mean()
    spread = float(light @ light)
    if not spread > 0:
        return 0.0, math.inf
    slope = float(light @ seen) / spread
    rest = float(np.var(seen - 1 - slope * light))
    share = max(1 - other / float(np.mean(variance)), 0.1)  # of the variance, that is of light
    # successive differences share a frame
    return slope / share, math.sqrt(1.5 * rest / spread) / share


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
