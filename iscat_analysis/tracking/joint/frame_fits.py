"""Fits of rows, frame after frame: plain Fisher scoring where it converges, else a search.

Nearly all rows converge by plain steps.  The kernel of the search with a step control is compiled
only when the first row needs it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.background_response import Slopes
from iscat_analysis._kernels.canvas import Canvas, Field, Light, Pictures, draw_frames
from iscat_analysis._kernels.lens import LatticeLens, RoundLens, StampLens
from iscat_analysis._kernels.moving import Room, Search, fit_frames
from iscat_analysis._kernels.radial import POWERS
from iscat_analysis._kernels.scoring import maximize
from iscat_analysis.inference.laws import POISSON
from iscat_analysis.records import BoolArray, FloatArray

IntArray = NDArray[np.int64]


def room_for(field: Field, near: Pictures, free: BoolArray) -> Room:
    """Allocate the scratch memory of the kernels that fit rows.

    Shapes: `free` (5,).
    """
    index, area = np.flatnonzero(free[:4]), field.side**2
    return Room(
        np.empty(15 * area, near.nodes.dtype), np.empty(area, np.float32), _profile(near, 2), index,
        np.empty((11, 5)), np.empty((4, index.size)),
        np.empty(0 if isinstance(near.lens, StampLens) else 10 * area),
    )  # fmt: skip


def _profile(pictures: Pictures, orders: int) -> FloatArray:
    """Make room for a profile, as `iscat_analysis._kernels.scoring.blank_profile` does."""
    lens, (channels, width) = pictures.lens, pictures.heights.shape[3:]
    if isinstance(lens, StampLens):
        return np.empty((0, 0, 0))
    if isinstance(lens, LatticeLens):
        return np.empty((orders * channels, 2 * lens.half + 1, 2 * lens.half + 1))
    return np.empty((width // POWERS, POWERS, orders * channels))


def draw_rows(
    field: Field, near: Pictures, far: Pictures, starts: IntArray, first: int, last: int,
    theta: FloatArray, group: IntArray, canvas: Canvas,
) -> None:  # fmt: skip
    """Update frames first…last − 1 of the canvas to the current rows.

    Shapes: `starts` (t + 1,), `theta` (rows, 5), `group` (rows,).
    """
    draw_frames(
        field, near, far, starts, first, last, theta, group, canvas, _profile(near, 1),
        _profile(far, 1), np.empty(max(field.drawn, field.side) ** 2),
    )  # fmt: skip


def fit_rows(
    light: Light, field: Field, near: Pictures, search: Search, starts: IntArray, first: int,
    last: int, sweeps: int, theta: FloatArray, group: IntArray, canvas: Canvas, slopes: Slopes,
    outcome: IntArray, information: FloatArray, gain: FloatArray, expected: FloatArray,
    sums: NDArray[np.float32],
) -> None:  # fmt: skip
    """Fit the rows of frames first…last − 1, each `sweeps` times.

    Shapes: `starts` (t + 1,), `theta` (rows, 5), `group` (rows,).
    """
    place = np.array([first, 0, starts[first], 0, 0, 0, 0])
    room = room_for(field, near, search.free)
    background = light.background.astype(np.float32)
    while not fit_frames(
        light, field, near, search, starts, last, sweeps, theta, group, canvas, slopes, outcome,
        information, gain, expected, background, sums, place, room,
    ):  # fmt: skip
        row = int(place[2])
        gain[row], outcome[row] = fit_with_search(
            field, near, search, place, room, int(group[row]), theta[row]
        )


def fit_with_search(
    field: Field, near: Pictures, search: Search, place: IntArray, room: Room, group: int,
    theta: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """Fit a row whose plain steps diverge; θ is overwritten with the estimate.

    Returns the log-likelihood over that without the particle, and how the fit ended.

    Returns its log-likelihood over that without the particle, and how the fit ended.
    """
    top, bottom, left, right = place[3:]
    shape = 4, bottom - top, right - left
    start = room.small[10]
    data = room.pixels[: math.prod(shape)].reshape(shape).astype(np.float64)
    heights = near.heights[min(group, len(near.heights) - 1)]
    table = heights, near.first_nm, near.step_nm, near.kappa
    lens = near.lens
    if not isinstance(lens, RoundLens):
        lens = lens._replace(window=near.windows[min(group, len(near.windows) - 1)])
    x, y, offsets, weights = field.pixels
    value, _, outcome = maximize(
        table, tuple(lens), (x[left:right], y[top:bottom], offsets, weights), POISSON.code, data,
        search.free, np.maximum(search.lower, start - search.reach),
        np.minimum(search.upper, start + search.reach), search.max_step, search.tolerance,
        search.passes, theta, np.empty((5, 5)), -math.inf, (0.0, 0.0),
    )  # fmt: skip
    return value, outcome
