"""Rows of one track, and selections of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.records import BoolArray, FloatArray, Status, track_numbers

NO_PLACE = (Status.NOT_CONVERGED, Status.SIDELOBE, Status.TOO_CLOSE)
"""Of rows that do not say how a particle moves."""

_LARGEST_ERROR_RATIO = 300.0  # times the median error: such a place says nothing


@dataclass(frozen=True)
class TrackRows:
    """Some rows of one track, sorted by frame; the columns of ``fits.csv``."""

    frame: FloatArray
    x_nm: FloatArray
    y_nm: FloatArray
    z_nm: FloatArray
    mass_kda: FloatArray
    contrast: FloatArray
    sigma_x_nm: FloatArray
    sigma_y_nm: FloatArray
    sigma_mass_kda: FloatArray
    crb_mass_kda: FloatArray
    status: NDArray[np.object_]

    def only(self, kept: BoolArray | NDArray[np.int64]) -> TrackRows:
        """Select some of the rows."""
        return TrackRows(*(getattr(self, column.name)[kept] for column in fields(self)))

    @property
    def rejected(self) -> bool:
        """Whether fewer than half of the rows are ok."""
        return bool(np.mean(self.status == Status.OK) < 1 / 2)

    def massive(self) -> TrackRows:
        """Select rows whose mass can be used: poor fits too if the model is rejected.

        The few that are ok would be a selection of the rows that are rejected like all others.
        """
        known = np.isfinite(self.sigma_mass_kda) & np.isfinite(self.crb_mass_kda)
        judged = self.status == Status.OK
        if self.rejected:
            judged |= self.status == Status.POOR_FIT
        return self.only(known & (self.mass_kda != 0) & judged)

    def enlarged(self, factor: float) -> TrackRows:
        """Multiply the errors by a factor."""
        names = ("sigma_x_nm", "sigma_y_nm", "sigma_mass_kda")
        return replace(self, **{name: factor * getattr(self, name) for name in names})

    def placed(self) -> TrackRows:
        """Select rows whose position can be used.

        A flag that fast motion itself causes must not exclude a row, or fast steps would be
        missing.
        """
        errors = np.fmax(self.sigma_x_nm, self.sigma_y_nm)
        useful = errors <= _LARGEST_ERROR_RATIO * of_known(np.median, errors)
        useful &= np.diff(self.frame, prepend=-1) > 0
        for status in NO_PLACE:
            useful &= self.status != status
        return self.only(useful)

    def timed(self, ticks: NDArray[np.int64] | None) -> TrackRows:
        """Replace frame numbers by the count of camera intervals, where frames are missing.

        Shapes: `ticks` (t,).
        """
        return self if ticks is None else replace(self, frame=1.0 * ticks[self.frame.astype(int)])

    def positions(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give frames, places and their errors, shapes (n,), (n, 2) and (n, 2) [nm]."""
        places, errors = (self.x_nm, self.y_nm), (self.sigma_x_nm, self.sigma_y_nm)
        return self.frame, np.stack(places, axis=1), np.stack(errors, axis=1)


def rows_by_track(fits: pd.DataFrame) -> dict[int, TrackRows]:
    """Divide a table by its tracks."""
    numbers = track_numbers(fits)
    known, track = fits[numbers.notna()], numbers.dropna().to_numpy(int)
    rows = TrackRows(
        *(
            known[part.name].to_numpy(object if part.name == "status" else float)
            for part in fields(TrackRows)
        )
    )
    order = np.lexsort((rows.frame, track))
    edges = np.flatnonzero(np.diff(track[order], prepend=-1, append=-1))
    return {int(track[order[a]]): rows.only(order[a:b]) for a, b in pairwise(edges)}


def nearest_nm(groups: Mapping[int, TrackRows]) -> dict[int, float]:
    """Smallest distance of each track to any other in the same frame [nm]."""
    own = np.repeat(np.arange(len(groups)), [len(rows.frame) for rows in groups.values()])
    frame, x, y = (
        np.concatenate([getattr(rows, name) for rows in groups.values()] or [[]])
        for name in ("frame", "x_nm", "y_nm")
    )
    order = np.argsort(frame, kind="stable")
    own, frame, x, y = (values[order] for values in (own, frame, x, y))
    nearest, ahead = np.full(len(own), np.inf), 1  # of each row; others of a frame come next
    while (together := frame[ahead:] == frame[:-ahead]).any():
        one = np.flatnonzero(together & (own[ahead:] != own[:-ahead]))
        apart = np.hypot(x[one + ahead] - x[one], y[one + ahead] - y[one])
        for row in (one, one + ahead):
            nearest[row] = np.fmin(nearest[row], apart)
        ahead += 1
    closest = np.full(len(groups), np.inf)
    np.fmin.at(closest, own, nearest)
    return dict(zip(groups, closest.tolist(), strict=True))


def of_known(statistic: Callable[[FloatArray], Any], values: FloatArray) -> float:
    """Apply a statistic to the values that are finite."""
    known = values[~np.isnan(values)]
    return float(statistic(known)) if known.size else np.nan
