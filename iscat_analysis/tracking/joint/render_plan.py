"""What is drawn of all rows of a movie, and which rows these are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.canvas import Canvas
from iscat_analysis.tracking.joint.localizations import Localizations


@dataclass(frozen=True)
class RenderPlan:
    """A canvas and the rows that are on it."""

    rows: Localizations
    canvas: Canvas
    coarse: bool

    def moved(self, rows: Localizations, frames: int) -> Canvas:
        """Set other rows; frames in which rows changed are marked."""
        old, canvas = self.rows, self.canvas
        here, there = rows.starts(frames), old.starts(frames)
        same = np.diff(here) == np.diff(there)
        mine = np.flatnonzero(np.repeat(same, np.diff(here)))
        theirs = np.flatnonzero(np.repeat(same, np.diff(there)))
        other = (rows.group[mine] != old.group[theirs]) | (rows.track[mine] != old.track[theirs])
        same[rows.frame[mine[other]]] = False
        rings, squares = np.zeros((2, *rows.theta.shape))
        rings[mine], squares[mine] = canvas.rings[theirs], canvas.squares[theirs]
        return Canvas(canvas.total, rings, squares, canvas.drawn & same)


def blank(room: NDArray[np.float32], rows: Localizations) -> Canvas:
    """Make an empty canvas.

    Shapes: `room` (t, y, x).
    """
    nothing = np.zeros(len(room), dtype=bool)
    return Canvas(room, np.zeros_like(rows.theta), np.zeros_like(rows.theta), nothing)
