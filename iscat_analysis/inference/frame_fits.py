"""Fits of rows, frame after frame, by plain steps where these lead and with more care elsewhere.

Nearly all rows are fitted by the steps of Fisher scoring as they are.  The search that brakes them
is a kernel of its own, which is compiled by the first row that needs it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.canvas import Canvas, Field, Light, Pictures
from iscat_analysis._kernels.following import Slopes
from iscat_analysis._kernels.moving import Search, Stand, fit_frames
from iscat_analysis._kernels.scoring import POISSON, maximize
from iscat_analysis.records import FloatArray

IntArray = NDArray[np.int64]


def fit_rows(
    light: Light, field: Field, near: Pictures, search: Search, starts: IntArray, first: int,
    last: int, sweeps: int, theta: FloatArray, group: IntArray, canvas: Canvas, slopes: Slopes,
    outcome: IntArray, information: FloatArray, gain: FloatArray, expected: FloatArray,
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """Fit the rows of frames first…last − 1, each `sweeps` times.

    Parameters
    ----------
    light, field, near, search, starts, sweeps, theta, group, canvas, slopes
        As in `iscat_analysis._kernels.moving.fit_frames`.
    first, last : int
        Frames.
    outcome, information, gain, expected, sums
        As there.
    """
    pixels, kind = field.side**2, near.nodes.dtype
    place = np.array([first, 0, starts[first], 0, 0, 0, 0])
    stand = Stand(place, np.empty(4 * pixels, kind), np.empty(pixels, kind), np.empty(5))
    while not fit_frames(
        light, field, near, search, starts, last, sweeps, theta, group, canvas, slopes, outcome,
        information, gain, expected, sums, stand,
    ):  # fmt: skip
        row = int(place[2])
        gain[row], outcome[row] = climb(field, near, search, stand, int(group[row]), theta[row])


def climb(
    field: Field, near: Pictures, search: Search, stand: Stand, group: int, theta: FloatArray
) -> tuple[float, int]:
    """Fit a row whose plain steps lead nowhere.

    Parameters
    ----------
    field, near, search, stand
        As in `iscat_analysis._kernels.moving.fit_frames`.
    group : int
        Number of the row's picture.
    theta : ndarray, shape (5,)
        Where it was left; overwritten with the estimate.

    Returns
    -------
    float
        Log-likelihood over that without the particle.
    int
        How the fit ended.
    """
    top, bottom, left, right = stand.place[3:]
    shape = 4, bottom - top, right - left
    data = stand.data[: math.prod(shape)].reshape(shape).astype(np.float64)
    heights = near.heights[min(group, len(near.heights) - 1)]
    table = heights, near.first_nm, near.step_nm, near.kappa
    lens = near.lens
    if "window" in lens._fields:
        lens = lens._replace(window=near.windows[min(group, len(near.windows) - 1)])
    x, y, offsets, weights = field.pixels
    value, _, outcome = maximize(
        table, tuple(lens), (x[left:right], y[top:bottom], offsets, weights), POISSON, data,
        search.free, np.maximum(search.lower, stand.start - search.reach),
        np.minimum(search.upper, stand.start + search.reach), search.max_step, search.tolerance,
        search.passes, theta, np.empty((5, 5)), -math.inf,
    )  # fmt: skip
    return value, outcome
