"""How high noise rises somewhere in a field that is searched.

The signal-to-noise ratio of a matched filter over pure noise is a smooth Gaussian field of unit
variance.  Above a high level u it has as many maxima as the expected Euler characteristic of what
exceeds that level (R. J. Adler and J. E. Taylor, *Random Fields and Geometry*, 2007, section 12.4):

    N(u) = Σ_d L_d ρ_d(u),   ρ_0 = 1 − Φ(u),   ρ_d = (2π)^{−(d+1)/2} He_{d−1}(u) e^{−u²/2},

L_d the volume, area, length and number of the box, its edges included, with lengths measured by the
gradient of the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from iscat_analysis.records import FloatArray

_HIGHEST = 40.0  # no threshold is larger
_LOWEST = 2.0  # from where on N falls as the level rises


def curvatures(sides: Sequence[float], roughness: FloatArray) -> FloatArray:
    """Measure a box by the gradient of the field in it.

    Parameters
    ----------
    sides : sequence of float
        Length of the box along each axis, up to three of them.
    roughness : ndarray, shape (n, n)
        Covariance of the gradient of the field, of unit variance, along the same axes.

    Returns
    -------
    ndarray, shape (n + 1,)
        L_0 = 1 to L_n, its Lipschitz–Killing curvatures.
    """
    axes = range(len(sides))
    return np.array([
        sum(
            math.prod(sides[i] for i in part)
            * math.sqrt(max(float(np.linalg.det(roughness[np.ix_(part, part)])), 0.0))
            for part in map(list, combinations(axes, d))
        ) if d else 1.0
        for d in range(len(sides) + 1)
    ])  # fmt: skip


def expected_maxima(u: float, box: FloatArray, *, correlation: float = 0.0) -> float:
    """Count the maxima of noise above a level.

    Parameters
    ----------
    u : float
        The level.
    box : ndarray, shape (n + 1,)
        From `curvatures`.
    correlation : float
        Of the noise of this search with that of the next one, where what exceeds the level in both
        counts once.

    Returns
    -------
    float
        Expected number.

    Notes
    -----
    What exceeds the level in two correlated fields is a wedge in the plane of both, of angle
    θ = arccos(correlation) between the normals of its sides.  By the Gaussian kinematic formula
    (ibid., chapter 15), to the leading order in the plane, this share q of the maxima is in both:

        q = 2 (1 − Φ(t)) + θ e^{−t²/2}/(√(2π) u),   t = u tan(θ/2).
    """
    density = math.exp(-(u**2) / 2)
    hermite = (1.0, u, u**2 - 1)
    total = float(box[0]) * float(norm.sf(u))
    for d in range(1, len(box)):
        total += float(box[d]) * hermite[d - 1] * density / (2 * math.pi) ** ((d + 1) / 2)
    if correlation <= 0:
        return total
    angle = math.acos(correlation)
    t = u * math.tan(angle / 2)
    both = 2 * float(norm.sf(t)) + angle * math.exp(-(t**2) / 2) / (math.sqrt(2 * math.pi) * u)
    return total * (1 - both)


def height_reached(
    alarms: float, box: FloatArray, *, correlation: float = 0.0, lowest: float = _LOWEST
) -> float:
    """Find the level above which noise has a given expected number of maxima.

    Parameters
    ----------
    alarms : float
        That number.
    box : ndarray, shape (n + 1,)
        From `curvatures`.
    correlation : float
        As in `expected_maxima`.
    lowest : float
        The answer where noise has fewer maxima even there.

    Returns
    -------
    float
        The level, not below `lowest`.
    """

    def excess(u: float) -> float:
        return math.log(expected_maxima(u, box, correlation=correlation) / alarms)

    low = max(lowest, 1.0 if len(box) < 4 else _LOWEST)
    if excess(low) <= 0:
        return lowest
    high = low
    while excess(high) > 0 and high < _HIGHEST:
        high = min(high + 1.0, _HIGHEST)
    return float(brentq(excess, low, high, xtol=1e-10))
