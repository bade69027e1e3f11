"""The maximum of a smooth function of parameters that have limits, by Minuit's Migrad.

Migrad learns second derivatives on its way (Fletcher, Comput. J. 13, 317, 1970), which took it 230
evaluations for a series of tables; told what they are at the start, it takes half, and a fifth on
the way along a profile, where those of the last point serve.  It also ends where the slope is 0,
and not where second derivatives that it has not learned yet let it seem so.  Beside a saddle it is
told what they are with all curvatures turned to be those of a maximum (Gill & Murray, Math.
Program. 7, 311, 1974): with those of the saddle it took thousands.

Where a likelihood, maximised over everything else, has fallen by 1.92 from its maximum.

The square root of the deviance, twice that fall, is nearly a line in a well measured parameter, and
reaches 1.96 at the ends of the 95 % interval (Venzon & Moolgavkar, Appl. Stat. 37, 87, 1988).  Each
end is bracketed first: MINOS of iminuit, which follows the slope, ended elsewhere in 7 % of 400
intervals of few events.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from warnings import catch_warnings, simplefilter

import numpy as np
import scipy
from iminuit import Minuit
from iminuit.warnings import IMinuitWarning

from iscat_analysis.records import BoolArray, FloatArray

_TOLERANCE = 0.01  # of Minuit: 1e-5 of a log-likelihood
_DIFFERENCE = 1e-3  # of about a standard error: steps for second derivatives
_STEP = 0.02  # of the scale: the first step where second derivatives say nothing


@dataclass(frozen=True, eq=False)
class Problem:
    """A log-likelihood with its slope, the limits of its parameters, and typical steps of them.

    A parameter whose limits are the same is fixed.  `events` are as many as make the likelihood, so
    that a standard error is about a step over their root.

    Shapes: `low, high, scale` (p,).
    """

    height: Callable[[FloatArray], tuple[float, FloatArray]]
    low: FloatArray
    high: FloatArray
    scale: FloatArray
    events: int = 1

    def curvature(self, theta: FloatArray) -> FloatArray:
        """Observed information: minus the second derivatives, by differences of slopes.

        Shapes: `theta` (p,), result (p, p).
        """
        steps = _DIFFERENCE * self.scale / math.sqrt(max(self.events, 1))
        steps = np.where(theta + steps > self.high, -steps, steps)
        here = self.height(theta)[1]
        rise = np.array([here - self.height(theta + step)[1] for step in np.diag(steps)])
        found = rise / steps[:, None]
        return np.asarray((found + found.T) / 2)


@dataclass(frozen=True, eq=False)
class Maximum:
    """Where a function is largest, and how it bends there.

    Shapes: `theta` (p,), `free` (p,), which parameters are at no limit.
    """

    theta: FloatArray
    value: float
    free: BoolArray
    bends: Callable[[FloatArray], FloatArray]

    @cached_property
    def curvature(self) -> FloatArray:
        """Give minus the second derivatives (p, p)."""
        return self.bends(self.theta)

    def covariance(self) -> FloatArray:
        """Give the inverse of the curvature among free parameters, 0 for the others."""
        found = np.zeros(self.curvature.shape)
        inside = np.ix_(self.free, self.free)
        found[inside] = np.linalg.pinv(self.curvature[inside], hermitian=True)
        return found

    def errors(self) -> FloatArray:
        """Give standard errors (p,), infinite where the function does not fall to both sides."""
        variances = np.diag(self.covariance())
        return np.sqrt(np.where(variances < 0, np.inf, variances))


def maximise(problem: Problem, start: FloatArray, near: FloatArray | None = None) -> Maximum:
    """Climb from a start to a maximum; `near` are second derivatives from close by, which are kept.

    Shapes: `start` (p,), `near` (p, p).
    """
    height = lru_cache(maxsize=1)(lambda theta: problem.height(np.frombuffer(theta)))
    bends = lru_cache(maxsize=1)(lambda theta: problem.curvature(np.frombuffer(theta)))

    def curvature(theta: FloatArray) -> FloatArray:
        return bends(theta.tobytes()) if near is None else near

    def as_of_maximum(theta: FloatArray) -> FloatArray:
        return _positive(curvature(theta), problem.scale)

    reach = problem.high - problem.low
    # of its range that a start lies away from a limit, where Minuit sees no slope
    inside = 1e-3 * reach
    with catch_warnings():
        # Minuit says that it needs no diagonal, and calls for one where the matrix is a saddle's.
        simplefilter("ignore", IMinuitWarning)
        search = Minuit(
            lambda theta: -height(theta.tobytes())[0],
            np.clip(start, problem.low + inside, problem.high - inside),
            grad=lambda theta: -height(theta.tobytes())[1],
            hessian=as_of_maximum,
            g2=lambda theta: np.diag(as_of_maximum(theta)).copy(),
        )
    # strategy 0 of Minuit takes no further second derivatives
    search.errordef, search.strategy, search.tol = Minuit.LIKELIHOOD, 0, _TOLERANCE
    search.errors = _STEP * problem.scale
    # it would print where a start is no maximum, which is no news
    search.print_level = -1
    search.limits = list(zip(problem.low, problem.high, strict=True))
    search.fixed = problem.low == problem.high
    search.migrad()
    theta = np.array(search.values)
    # of its range within which a parameter is at a limit
    edge = 1e-4 * reach
    lowest, highest = theta <= problem.low + edge, theta >= problem.high - edge
    theta = np.where(lowest, problem.low, np.where(highest, problem.high, theta))
    free = ~(lowest | highest)
    return Maximum(theta, -float(search.fval), free, curvature)


def _positive(curvature: FloatArray, scale: FloatArray) -> FloatArray:
    """Turn directions in which a function does not fall into such in which it does.

    Shapes: `curvature` (p, p), `scale` (p,).
    """
    unit = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(curvature * unit)
    if values[0] > 0:
        return curvature
    # of the largest curvature, in units of the scale
    least = 1e-8 * np.abs(values).max()
    return np.asarray((vectors * np.maximum(np.abs(values), least)) @ vectors.T / unit)


ENDS_95 = (0.025, 0.975)
"""Quantiles at the ends of a 95 % interval."""

TWO_SIDED_95 = 1.959964
"""Standard errors from an estimate to an end of its 95 % interval."""


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
        # tolerance of the parameter at an end
        return float(scipy.optimize.brentq(beyond, inner, outer, xtol=1e-5))

    return end(low), end(high)
