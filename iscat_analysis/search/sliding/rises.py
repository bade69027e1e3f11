"""Whether the light of a step rises over some frames, as of a particle that settles.

A line from one level to the other, between two frames, is set against a step.  The frames of the
line are left out of fits, whatever the course in them; but light that settles exponentially goes on
rising after any line, and an exponential that describes the frames better than the line tells so.

Particles of one kind rise alike, and the noise of a faint one may hide its rise or feign one.  The
duration is therefore estimated from all steps together, and a step has another one only if its own
likelihood is clearly larger with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc, logsumexp

from iscat_analysis._kernels.stepping import best_line
from iscat_analysis.records import FloatArray

IntArray = NDArray[np.int64]

_LEAST_GAIN = 6.0  # log-likelihood by which another course is better than the expected one
_ALONE = 0.1  # probability that a step has a course of its own
_RISE_FRAMES = (3, 5, 8, 12, 18, 27, 40, 60, 90)  # tried first, then others near the best
_DECAY_SHARES = (0.15, 0.25, 0.35, 0.5, 0.7)  # over the frames of the line


@dataclass(frozen=True)
class Rise:
    """Frames over which the light of a step rises.

    Attributes
    ----------
    frames, centre : int
        How many, and the one in their middle, counted from the first that was looked at.
    height : float
        Of the frames after over those before.
    p_line : float
        Chance that a line seems so much worse than an exponential.
    settling : tuple of float
        Log-likelihoods of exponentials over that of the line.
    """

    frames: int
    centre: int
    height: float
    p_line: float
    settling: tuple[float, ...]


def find_rise(
    heights: FloatArray, weight: FloatArray, turn: int, step: float, expected: int = 0
) -> tuple[Rise | None, tuple[float, ...]]:
    """Find a rise around the best step, whose log-likelihood is given; None where it is a step.

    A course other than the expected one, which is a step if no frames of a rise are expected, must
    be clearly better.  The gains of all lines over the step are given as well, for `common_rise`.

    Shapes: `heights` (t,), `weight` (t,).
    """
    lit = np.flatnonzero(weight > 0)
    w = weight[lit]
    y = heights[lit] - np.average(heights[lit], weights=w)

    def tried(rise: int, reach: int, every: int = 1, about: int = turn) -> tuple[float, int, int]:
        if 2 * rise >= heights.size:
            return 0.0, rise, turn
        first, last = about - reach, min(about + reach + 1, heights.size - rise // 2)
        first += max(math.ceil((rise // 2 + 1 - first) / every), 0) * every
        gain, centre = best_line(lit, w, y, rise, (first, last, every), 0.0)
        return gain, rise, centre or turn

    def judged(course: tuple[float, int, int]) -> float:
        return course[0] + _LEAST_GAIN * (course[1] == expected)

    lines = [tried(rise, rise // 2, max(rise // 8, 1)) for rise in _RISE_FRAMES]
    profile = tuple(gain - step for gain, *_ in lines)
    usual = [tried(expected, expected)] if expected else []
    best = max([(step, 0, turn), *lines, *usual], key=judged)
    _, rise, centre = best
    if rise not in (0, expected):
        finer = range(round(0.7 * rise), round(1.4 * rise) + 1, max(rise // 12, 1))
        near = [tried(max(other, 2), max(rise // 5, 2), about=centre) for other in finer]
        best = max([best, *near])
    gain, rise, centre = best
    if not rise:
        return None, profile
    begins = centre - rise / 2 + rise * np.linspace(-0.25, 0.25, 11)
    curves = [_settling(lit, rise * share, begins[:, None]) for share in _DECAY_SHARES]
    settling = tuple(float(_gains(curve, w, y).max()) - gain for curve in curves)
    p_line = float(erfc(np.sqrt(max(*settling, 0.0))))  # of χ² with one degree of freedom
    height = _gain_beyond(heights, weight, centre, rise // 2 + 1)
    return Rise(rise, centre, height, p_line, settling), profile


def common_rise(profiles: Sequence[tuple[float, ...]]) -> int:
    """Give the frames over which the light of most steps rises; 0 if they are steps."""
    best = _common(profiles)
    return _RISE_FRAMES[best - 1] if best else 0


def go_on_rising(settling: Sequence[tuple[float, ...]]) -> bool:
    """Tell whether most rises are exponentials, of which each may be too faint to show it."""
    return _common(settling) > 0


def _common(profiles: Sequence[tuple[float, ...]]) -> int:
    """Give the number of the course that most steps have; 0 for the one that gains refer to.

    The likelihood of a step has its own course with a small probability, whatever the others do.
    """
    each = np.array([(0.0, *profile) for profile in profiles if profile])
    if not each.size:
        return 0
    own = math.log(_ALONE / each.shape[1]) + logsumexp(each, axis=1, keepdims=True)
    total = np.logaddexp(math.log1p(-_ALONE) + each, own).sum(axis=0)
    best = int(np.argmax(total))
    return best if total[best] > total[0] + _LEAST_GAIN else 0


def line(frames: IntArray, rise: int, centre: int) -> FloatArray:
    """Share of the new light in frames during a linear rise."""
    return np.asarray(np.clip((frames + 0.5 - centre) / rise + 0.5, 0.0, 1.0))


def _settling(frames: IntArray, decay: float, begin: FloatArray) -> FloatArray:
    """Share of the new light in frames during an exponential rise."""
    return np.asarray(-np.expm1(-np.maximum(frames + 0.5 - begin, 0.0) / decay))


def _gains(traces: FloatArray, weight: FloatArray, heights: FloatArray) -> FloatArray:
    """Log-likelihood of each time course with a free height, over that of a constant.

    Shapes: `traces` (n, t), `weight` (t,), `heights` (t,) less their mean, result (n,).
    """
    traces = traces - (traces @ weight / weight.sum())[:, None]
    along, known = traces @ (weight * heights), (traces**2) @ weight
    return np.where(along > 0, 0.5 * along**2 / np.maximum(known, 1e-300), 0.0)


def _gain_beyond(heights: FloatArray, weight: FloatArray, turn: int, gap: int) -> float:
    """Difference of the means after and before a gap.

    Shapes: `heights` (t,), `weight` (t,).
    """
    sides = (slice(0, max(turn - gap, 0)), slice(turn + gap, None))
    light = [float(weight[side].sum()) for side in sides]
    if min(light) <= 0:
        return 0.0
    first, last = (float(weight[side] @ heights[side]) for side in sides)
    return last / light[1] - first / light[0]
