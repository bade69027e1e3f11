"""Where the light of a movie ends, beside where the camera's numbers say that it does.

A contrast is a change divided by the light above the offset: an offset that is too low by a share s
of the light makes contrasts, and masses, too small by s.  Two properties of the pixels know where
the light is zero, neither of which needs the gain: how strongly they follow the laser's power,
dm_p/dρ ∝ m_p − o, and their noise, v_p = (m_p − o)/g.  See the module's page.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.camera.calibration.moments import moments_of
from iscat_analysis.camera.calibration.pixels import unlike_neighbours, unsteady
from iscat_analysis.camera.calibration.regression import (
    LEAST_RELIABILITY,
    variance_line,
    zero_of_flicker,
)
from iscat_analysis.camera.counts import Camera
from iscat_analysis.errors import DataError
from iscat_analysis.movie import open_stack
from iscat_analysis.records import BoolArray

TOLERANCE = 0.01
"""Share of the light, and of masses, that an offset may be wrong by before it is said."""

_SIGMAS = 4.0  # and the excess over the tolerance that chance must not explain
_LEAST_FRAMES, _MOST_FRAMES = 16, 256
_MOST_COUNTS = 2**22  # of a movie's counts that are looked at: a tenth of a second
_LEAST_PIXELS = 256
_LEAST_NOISE = 1e-6  # of the shot noise; what has less, as a picture that was copied, has none
_LEAST_SLOPE = 5.0  # standard errors of the slope, of which the line's zero is a quotient
_TILE_PX = 16  # within which pixels may differ from the line together, as a speckle that shakes


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
        return abs(self.share) > TOLERANCE + _SIGMAS * self.se

    def may_be(self, share: float) -> bool:
        """Tell whether the light that is none may be another share."""
        return abs(self.share - share) < TOLERANCE + _SIGMAS * self.se


def find_zero(
    counts: NDArray[Any], camera: Camera, *, masked: BoolArray | None = None
) -> LightZero | None:
    """Find where the light is zero.

    Notes
    -----
    Errors are from the scatter of squares of `_TILE_PX` pixels about the line.

    Shapes: `counts` (t, y, x), `masked` (y, x).
    """
    pixels = counts.shape[1] * counts.shape[2]
    most = min(_MOST_FRAMES, max(_LEAST_FRAMES, _MOST_COUNTS // pixels))
    counts = counts[:most]
    if len(counts) < _LEAST_FRAMES:
        return None
    electrons = camera.to_electrons(counts)
    used = ~camera.saturated(counts.max(axis=0))
    if masked is not None:
        used &= ~masked
    light = electrons.mean(axis=0)
    used &= (light > 0) & ~unlike_neighbours(light)
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    try:
        found = moments_of(open_stack(electrons), used, lambda _: None)
    except DataError:
        return None
    used &= ~unsteady([found], used) & (found.variance > _LEAST_NOISE * light)
    if np.count_nonzero(used) < _LEAST_PIXELS:
        return None
    mean, variance = found.mean[used], found.variance[used]
    level = float(mean.mean())
    own = float((variance / found.n_frames).mean())
    if own > (1 - LEAST_RELIABILITY) * float(mean.var()):
        return None
    y, x = np.nonzero(used)
    tiles = (y // _TILE_PX) * (1 + used.shape[1] // _TILE_PX) + x // _TILE_PX
    known = []
    flicker = zero_of_flicker(found.slope[used], found.slope_variance[used], mean, tiles)
    if flicker is not None:
        known.append(LightZero(flicker.value / level, flicker.se / level, flicker.value, True))
    freedom = np.full(mean.shape, found.n_frames - 1.0)
    (intercept, slope), cov = variance_line(mean, variance, freedom, tiles)
    if slope > _LEAST_SLOPE * math.sqrt(cov[1, 1]):
        zero = -intercept / slope
        gradient = np.array([-1 / slope, intercept / slope**2])
        se = math.sqrt(gradient @ cov @ gradient)
        known.append(LightZero(zero / level, se / level, zero, False))
    return min(known, key=lambda one: one.se, default=None)
