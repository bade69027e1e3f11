"""The maximum of a smooth function of parameters that have limits.

Newton's method with an active set (Bertsekas, SIAM J. Control Optim. 20, 221, 1982).  Parameters at
a limit that the slope points out of are held; the others take the step to the maximum of the
parabola, and those that it carries beyond a limit stop there while the rest is solved anew.  Along
directions in which the function bends upwards the step goes by the size of the bend, so that it
leaves saddles.  Second derivatives are kept from step to step as long as the steps are as good as
these foretell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iscat_analysis.records import BoolArray, FloatArray

_MOST_STEPS = 100
_PRECISE = 1e-5  # of the height that is left to gain: 0.005 standard errors of a log-likelihood
_AT_REST = 1e-9  # the same on a saddle, which a step doubles the distance from
_FARTHEST = 3.0  # scales of a parameter that a step may go
_ENOUGH = 1e-4  # of the rise along the slope (Armijo)
_SHORTEST = 1e-6  # of a step
_CONTRACTS = 0.3  # of what was left to gain, after a step whose second derivatives were right
_FLATTEST = 1e-6  # second derivative, in units of the scales


@dataclass(frozen=True, eq=False)
class Problem:
    """A function with its slope and minus its second derivatives, and its parameters' limits.

    Shapes: `low, high, scale` (p,).
    """

    height: Callable[[FloatArray], tuple[float, FloatArray]]
    curvature: Callable[[FloatArray], FloatArray]
    low: FloatArray
    high: FloatArray
    scale: FloatArray


@dataclass(frozen=True, eq=False)
class Maximum:
    """Where a function is largest, and how it bends there.

    Shapes: `theta` (p,), `curvature` (p, p), `free` (p,), which parameters are at no limit.
    """

    theta: FloatArray
    value: float
    curvature: FloatArray
    free: BoolArray

    def covariance(self) -> FloatArray:
        """Give the inverse of the curvature among free parameters, 0 for the others."""
        found = np.zeros(self.curvature.shape)
        inside = np.ix_(self.free, self.free)
        found[inside] = np.linalg.pinv(self.curvature[inside], hermitian=True)
        return found


def maximise(problem: Problem, start: FloatArray, near: FloatArray | None = None) -> Maximum:
    """Climb from a start to a maximum; `near` are second derivatives from close by.

    Shapes: `start` (p,), `near` (p, p).
    """
    theta = np.clip(start, problem.low, problem.high)
    value, slope = problem.height(theta)
    bend, fresh = (problem.curvature(theta), True) if near is None else (near, False)
    before = np.inf
    for _ in range(_MOST_STEPS):
        step, left, peaked = _newton(problem, theta, slope, bend)
        if not fresh and (left > max(_CONTRACTS * before, _PRECISE) or not peaked):
            bend, fresh = problem.curvature(theta), True
            step, left, peaked = _newton(problem, theta, slope, bend)
        if left < (_PRECISE if peaked else _AT_REST):
            break
        reach = 1.0
        while reach > _SHORTEST:
            there = np.clip(theta + reach * step, problem.low, problem.high)
            found, steeper = problem.height(there)
            if found - value > _ENOUGH * float(slope @ (there - theta)):
                break
            reach /= 2
        else:
            if fresh:
                break
            before = 0.0
            continue
        theta, value, slope = there, found, steeper
        before, fresh = left if reach == 1 else 0.0, False
    return Maximum(theta, value, bend, ~_held(problem, theta, slope))


def _held(problem: Problem, theta: FloatArray, slope: FloatArray) -> BoolArray:
    """Tell which parameters lie at a limit that the slope does not lead away from."""
    below = (theta <= problem.low) & (slope <= 0)
    return np.asarray(below | ((theta >= problem.high) & (slope >= 0)))


def _newton(
    problem: Problem, theta: FloatArray, slope: FloatArray, bend: FloatArray
) -> tuple[FloatArray, float, bool]:
    """Give the step to the parabola's maximum within limits, half its rise, and if it is one.

    Shapes: `theta, slope` (p,), `bend` (p, p), step (p,).
    """
    scale = problem.scale
    down, up = (problem.low - theta) / scale, (problem.high - theta) / scale
    rise, free = slope * scale, ~_held(problem, theta, slope)
    size, axes = np.linalg.eigh((bend * np.outer(scale, scale))[np.ix_(free, free)])
    curve = np.eye(theta.size)
    curve[np.ix_(free, free)] = (axes * np.maximum(np.abs(size), _FLATTEST)) @ axes.T
    step, straight = np.zeros(theta.shape), None
    while free.any():
        wanted = rise[free] - curve[np.ix_(free, ~free)] @ step[~free]
        step[free] = np.linalg.solve(curve[np.ix_(free, free)], wanted)
        straight = step.copy() if straight is None else straight
        beyond = free & ((step < down) | (step > up))
        if not beyond.any():
            break
        step[beyond] = np.clip(step, down, up)[beyond]
        free = free & ~beyond
    if straight is not None and step @ rise <= 0:  # the limits turned it round
        step = straight
    step *= min(1.0, _FARTHEST / max(float(np.abs(step).max()), _FARTHEST))
    return step * scale, 0.5 * float(step @ rise), bool(np.all(size > -_FLATTEST))
