"""What the likelihood says, at some distance from its maximum, of how far off a place may be.

The curvature at a maximum tells the error of a place as far as the log-likelihood is a parabola,
which it is while the error is small beside the finest structure of the picture.  Of few photons,
above all out of focus in dark field, the likelihood has ridges and shoulders as wide as those of
the picture, and by the curvature one fit in a thousand is six standard deviations off.
"""

from __future__ import annotations

import math

import numpy as np

from iscat_analysis.inference.likelihood import Likelihood, Optimum
from iscat_analysis.records import Box, FloatArray

AWAY = 3.0
"""Standard deviations from the maximum at which the likelihood is looked at."""


def reaches_far(likelihood: Likelihood, sigma: FloatArray) -> bool:
    """Whether errors are so large that the curvature at the maximum may underestimate them.

    Shapes: `sigma` (4,).
    """
    quarter = likelihood.model.fringe_nm / 4
    return any(AWAY * error > quarter for error in sigma[:3].tolist())


def reach(
    likelihood: Likelihood, best: Optimum, box: Box, sigma: FloatArray, steps: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """Errors by how far the likelihood has fallen three standard deviations away.

    A parabola falls by t²/2 at t standard deviations, so that σ = d/√(2 Δℓ) at a distance d.  Each
    place is moved to either side, while the other parameters follow it as they are correlated with
    it; the larger of the errors of both sides counts, and that of the curvature where it is larger.

    Shapes: `sigma` (4,), `steps` (n, 5), `higher` (5,).
    """
    away = AWAY * np.concatenate([-steps, steps])
    around = np.minimum(np.maximum(best.theta + away, box.lower), box.upper)
    fallen = best.log_likelihood - likelihood.values(around)
    lowest = int(np.argmin(fallen))
    higher = around[lowest] if fallen[lowest] < 0 else None
    wider = sigma.copy()
    places = np.flatnonzero(box.free[:3]).tolist()
    for k, theta, loss in zip([*places, *places], around, fallen.tolist(), strict=True):
        if loss > 0:
            wider[k] = max(wider[k], abs(theta[k] - best.theta[k]) / math.sqrt(2 * loss))
    return wider, higher
