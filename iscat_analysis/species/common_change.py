"""Masses that all tracks change together, as where the focus drifts.

A track of its own cannot tell whether it changed or the microscope did, and a short one not even
that it did; all of them can.  With the mean of each track taken off, the relative masses of all
frames are fitted by one parabola in time.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.polynomial import legendre
from scipy.special import chdtri

from iscat_analysis.records import FloatArray

_DEGREE = 2
_FEWEST_TRACKS = 3
# p-value below which a common change is reported, whichever two tracks are left out.
_LARGEST_CHANCE = 1e-4
_SUSPECTS = 12  # that change most by themselves; two of these are left out in turn


def common_change(
    tracks: Sequence[tuple[FloatArray, FloatArray, FloatArray]], frames: tuple[int, int]
) -> float:
    """Range of the relative change of all masses with time; 0 where none is significant.

    Shapes: `tracks` (n,).
    """
    first, last = frames
    information, pull = [], []
    for frame, mass, sigma in tracks:
        if len(frame) <= _DEGREE + 1:
            continue
        mean = np.average(mass, weights=sigma**-2)
        weight = (mean / sigma) ** 2
        time = 2 * (frame - first) / max(last - 1 - first, 1) - 1
        slopes = legendre.legvander(time, _DEGREE)[:, 1:]
        slopes = slopes - np.average(slopes, axis=0, weights=weight)
        information.append((slopes.T * weight) @ slopes)
        pull.append(slopes.T @ (weight * (mass / mean - 1)))
    if len(pull) < _FEWEST_TRACKS:
        return 0.0
    pulls, known = np.array(pull), np.array(information)
    every, whole = pulls.sum(axis=0), known.sum(axis=0)
    least = chdtri(_DEGREE, _LARGEST_CHANCE)
    own = np.einsum("ni,nij,nj->n", pulls, np.linalg.pinv(known), pulls)
    suspects = np.argsort(-own)[:_SUSPECTS].tolist()
    for left_out in (*combinations(range(len(pulls)), 1), *combinations(suspects, 2)):
        rest = every - pulls[[*left_out]].sum(axis=0)
        if rest @ np.linalg.pinv(whole - known[[*left_out]].sum(axis=0)) @ rest < least:
            return 0.0
    found = np.linalg.pinv(whole) @ every
    change = legendre.legval(np.linspace(-1, 1, last - first), np.append(0.0, found))
    return float(np.ptp(change))
