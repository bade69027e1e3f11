"""Boundaries between parts of a camera that are read out by different amplifiers.

The gain of each amplifier changes by itself.  Halves, quadrants or stripes of the field then change
from frame to frame as a whole: the sum over rows or columns has a step at the boundary, which
smooth light does not have.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.special import chdtri

from iscat_analysis.camera.light_changes import Changes
from iscat_analysis.records import BoolArray, FloatArray

AmplifierBoundaries = tuple[tuple[int, ...], tuple[int, ...]]
"""Rows and columns at which another part begins."""

_MOST_BOUNDARIES = 3  # along an axis
_SMOOTH_DEGREE = 6  # degree of the light along an axis over which a step must stand out
_FEWEST_LINES = 8  # lines of a part
_BY_CHANCE = 1e-12  # that the gains of pairs are as far above noise
# Times what nine in ten lines differ from those before, that they do at a seam
_LEAST_STEP_RATIO = 10.0
_MOST_UNEXPLAINED_SHARE = 0.5  # of what smooth light leaves over, more than which seams may not
_NINE_IN_TEN = 0.9
_NORMAL_SQUARE = 0.4549364231195724  # median of the square of a normal variable


def find_amplifier_boundaries(
    changes: Changes, window: int, known: AmplifierBoundaries = ((), ())
) -> AmplifierBoundaries:
    """Find rows and columns at which the change of the light has a step."""
    least = changes.least(window) / changes.error
    return _along(changes, 2, least, known[0]), _along(changes, 1, least, known[1])


def parts_of(
    shape: tuple[int, int], boundaries: AmplifierBoundaries
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Give indicator functions of the parts between boundaries.

    Shapes: `rows, columns` (y, k) and (x, m), `products` (k, m).
    """
    rows, columns = (
        np.equal.outer(np.searchsorted(cuts, np.arange(n), side="right"), np.arange(len(cuts) + 1))
        for n, cuts in zip(shape, boundaries, strict=True)
    )
    if not any(boundaries):
        rows, columns = rows[:, :0], columns[:, :0]
    products = np.ones((rows.shape[1], columns.shape[1]), dtype=np.bool_)
    return rows.astype(np.float64), columns.astype(np.float64), products


def _along(changes: Changes, axis: int, least: float, known: tuple[int, ...]) -> tuple[int, ...]:
    """Find the boundaries along an axis of (pairs, y, x)."""
    light = changes.light_e.sum(axis=axis - 1)
    lit = light > 0
    before, after = np.moveaxis(changes.sums_e.sum(axis=axis + 1)[..., lit], 1, 0)
    light, lit_positions = light[lit], np.flatnonzero(lit)
    change = after / after.sum(axis=1, keepdims=True) - before / before.sum(axis=1, keepdims=True)
    change *= light.sum() / np.sqrt(light * changes.noises[:, None])
    count = light.size
    if count < 2 * _FEWEST_LINES + _SMOOTH_DEGREE:
        return known
    differences = change[:, 2:-1] + change[:, 3:] - change[:, 1:-2] - change[:, :-3]
    jumps = np.zeros(count)
    jumps[2:-1] = np.median(np.square(differences), axis=0)
    sharp = jumps > _LEAST_STEP_RATIO * np.quantile(jumps, _NINE_IN_TEN)
    root = np.sqrt(light)[:, None]
    smooth = root * legvander(np.linspace(-1, 1, count), _SMOOTH_DEGREE)
    steps = root * (np.arange(count)[:, None] >= np.arange(count))
    tried = np.searchsorted(lit_positions, known).tolist()
    kept, unexplained = len(tried), np.inf
    significant = float(chdtri(len(change), _BY_CHANCE)) / len(change)
    while True:
        basis, _ = np.linalg.qr(np.hstack([smooth, steps[:, tried]]))
        rest = change - (change @ basis) @ basis.T
        left = float(np.median(np.square(rest).sum(axis=1))) - (count - basis.shape[1])
        if left < _MOST_UNEXPLAINED_SHARE * unexplained:
            kept, unexplained = len(tried), left
        if len(tried) == _MOST_BOUNDARIES:
            break
        independent_steps = steps - basis @ (basis.T @ steps)
        far = sharp.copy()
        for cut in (0, *tried, count):
            far[max(cut - _FEWEST_LINES + 1, 0) : cut + _FEWEST_LINES] = False
        size = np.where(far, np.linalg.norm(independent_steps, axis=0), np.inf)
        gains = np.square(rest @ (independent_steps / size))
        best = int(gains.sum(axis=0).argmax())
        if np.median(gains[:, best]) / _NORMAL_SQUARE - 1 < max(significant, least):
            break
        tried.append(best)
    return tuple(sorted(int(lit_positions[k]) for k in tried[:kept]))
