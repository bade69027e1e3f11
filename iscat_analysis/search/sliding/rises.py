"""Whether the light of a step rises over some frames, as of a particle that settles.

A line from one level to the other, between two frames, is set against a step.  The frames of the
line are left out of fits, whatever the course in them; but light that settles exponentially goes on
rising after any line, and an exponential that describes the frames better than the line tells so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from iscat_analysis._kernels.stepping import best_line
from iscat_analysis.records import FloatArray

IntArray = NDArray[np.int64]

_LEAST_GAIN = 6.0  # log-likelihood by which a line describes the frames better than a step
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
    """

    frames: int
    centre: int
    height: float
    p_line: float


def find_rise(heights: FloatArray, weight: FloatArray, turn: int, step: float) -> Rise | None:
    """Find a rise around the best step, whose log-likelihood is given; None where it is a step.

    Shapes: `heights` (t,), `weight` (t,).
    """
    if step < _LEAST_GAIN:
        return None
    lit = np.flatnonzero(weight > 0)
    w = weight[lit]
    y = heights[lit] - np.average(heights[lit], weights=w)
    best, found = step + _LEAST_GAIN, (0, turn)

    def tried(rise: int, first: int, last: int, step: int) -> None:
        nonlocal best, found
        first += max(math.ceil((rise // 2 + 1 - first) / step), 0) * step
        centres = first, min(last + 1, heights.size - rise // 2), step
        best, centre = best_line(lit, w, y, rise, centres, best)
        found = (rise, centre) if centre else found

    for rise in _RISE_FRAMES:
        if 2 * rise < heights.size:
            half = rise // 2
            tried(rise, turn - half, turn + half, max(rise // 8, 1))
    roughly, centre = found
    if not roughly:
        return None
    reach = max(roughly // 5, 2)
    for rise in range(round(0.7 * roughly), round(1.4 * roughly) + 1, max(roughly // 12, 1)):
        tried(max(rise, 2), centre - reach, centre + reach, 1)
    rise, centre = found
    begins = centre - rise / 2 + rise * np.linspace(-0.25, 0.25, 11)
    curves = [_settling(lit, rise * share, begins[:, None]) for share in _DECAY_SHARES]
    better = float(_gains(np.concatenate(curves), w, y).max()) - best
    p_line = float(erfc(np.sqrt(max(better, 0.0))))  # of χ² with one degree of freedom
    return Rise(rise, centre, _gain_beyond(heights, weight, centre, rise // 2 + 1), p_line)


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
