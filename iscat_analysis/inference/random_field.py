"""How high noise rises somewhere in a field that is searched.

The signal-to-noise ratio of a matched filter over pure noise is a smooth Gaussian field of unit
variance.  Above a high level u it has as many maxima as the expected Euler characteristic of what
exceeds that level (R. J. Adler and J. E. Taylor, *Random Fields and Geometry*, 2007, section 12.4):

    N(u) = [A u/(2π)^{3/2} + V (u² − 1)/(2π)²] e^{−u²/2},

A the area and V the volume, lengths measured by the gradient of the field: √det Λ times those in
space, Λ the covariance of the gradient.  The terms of the edges are left out, because there the
filter is cut, and maxima are not more frequent than elsewhere.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from iscat_analysis.records import FloatArray

_HIGHEST_LEVEL = 40.0  # no threshold is larger
_LEVEL_TOLERANCE = 1e-10  # to which a level is found

LOWEST = 2.0
"""Level from which on both terms of N fall as it rises."""


def extent(roughness: FloatArray, size: float) -> float:
    """Measure an area or a volume by the gradient of the field in it.

    Shapes: `roughness` (n, n).
    """
    return size * math.sqrt(max(float(np.linalg.det(roughness)), 0.0))


def expected_maxima(
    u: float, area: float, volume: float = 0.0, *, correlation: float = 0.0
) -> float:
    """Count the maxima of noise above a level.

    Notes
    -----
    What exceeds the level in two correlated fields is a wedge in the plane of both, of angle
    θ = arccos(correlation) between the normals of its sides.  By the Gaussian kinematic formula
    (ibid., chapter 15), this share q of the maxima in a plane is in both:

        q = 2 (1 − Φ(t)) + θ e^{−t²/2}/(√(2π) u),   t = u tan(θ/2).
    """
    total = area * u / (2 * math.pi) ** 1.5 + volume * (u**2 - 1) / (2 * math.pi) ** 2
    total = float(total * math.exp(-(u**2) / 2))
    if correlation <= 0:
        return total
    angle = math.acos(correlation)
    t = u * math.tan(angle / 2)
    both = 2 * float(ndtr(-t)) + angle * math.exp(-(t**2) / 2) / (math.sqrt(2 * math.pi) * u)
    return total * (1 - both)


def companions(u: float, ring: FloatArray, cell: float) -> float:
    """Give the expected number of maxima of the other sign that accompany a maximum.

    Where the field is correlated by r < 0 with that at a maximum of height v = u + 1/u, its mean is
    −|r| v, and it passes −u more often there.  That ends when the maximum is fitted and subtracted.
    """
    near = ring[ring < 0]
    spread = np.sqrt(1 - near**2)

    levels = np.array([u + near * (u + 1 / u), np.full(near.shape, u)]) / spread
    there, elsewhere = np.sum(levels * np.exp(-(levels**2) / 2), axis=1)
    return float(cell / (2 * math.pi) ** 1.5 * (there - elsewhere))


@dataclass(frozen=True)
class Excursions:
    """How often noise exceeds a level in one search."""

    area: float
    volume: float = 0.0
    correlation: float = 0.0
    ring: FloatArray | None = None
    cell: float = 0.0

    def above(self, u: float) -> float:
        """Count the maxima above a level."""
        found = expected_maxima(u, self.area, self.volume, correlation=self.correlation)
        if self.ring is not None:  # of each pair one is left
            found *= 1 - min(companions(u, self.ring, self.cell), 1.0) / 2
        return found

    def level(self, alarms: float, *, lowest: float = LOWEST) -> float:
        """Find the level that a number of maxima exceeds; `lowest` where fewer do."""

        def excess(u: float) -> float:
            return math.log(self.above(u) / alarms)

        low = max(lowest, LOWEST if self.volume else 1.0)
        if not self.area > 0 or excess(low) <= 0:
            return lowest
        high = low
        while excess(high) > 0 and high < _HIGHEST_LEVEL:
            high = min(high + 1.0, _HIGHEST_LEVEL)
        # by halves: loading SciPy's search of roots takes longer than a small search for particles
        steps = range(math.ceil((high - low) / _LEVEL_TOLERANCE))
        few = bisect_left(steps, True, key=lambda k: excess(low + k * _LEVEL_TOLERANCE) <= 0)
        return low + few * _LEVEL_TOLERANCE
