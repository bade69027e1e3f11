"""Finished chunks of a landing movie, joined from tiles and merged: each event once, by frame.

An event belongs to the tile whose core holds its centre.  On a seam two tiles may each place it in
the other's core, or each in its own: of what one reports beyond its core, that is kept which no
other reports.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Trajectory, measure_drift, middle_of
from iscat_analysis.fitting.events import Told
from iscat_analysis.inference.nuisances import NOTHING
from iscat_analysis.landing.maps import Searched
from iscat_analysis.records import FRAME_COLUMN, BoolArray, EventView, FloatArray, make_rows
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.frames import Tile
from iscat_analysis.search.sliding import MapArray

VIEWS = 1000
"""Events whose images are kept for the report."""

CLIPS = 250
"""Events of which a clip is kept, the first; the page holds fewer."""

_DRIFT_PX = 512  # of the middle of the field, whose drift is measured

SEAM_PX = 2.0
"""Estimates of one step by two chunks, or two tiles, are nearer than this."""


@dataclass(frozen=True)
class FinishedChunk:
    """The results of a chunk that are kept."""

    core: tuple[int, int]
    lines: pd.DataFrame  # of fits.csv, which have no numbers yet
    repeats: FloatArray  # of every row, from `iscat_analysis.inference.split_frames`
    views: tuple[EventView, ...]
    good: BoolArray  # of the core
    light: FloatArray
    masked: BoolArray
    saturated: BoolArray
    strongest: MapArray
    ends_e: MapArray  # mean images of its first and last quarter, at the ends of a stretch alone
    sampled: int = field(default=0)
    stopped: bool = False  # in the middle of its chains
    trajectory: Trajectory | None = None  # of the pattern, in all frames that were read
    cause: str = ""  # what the model probably has wrong
    empty: EmptySpread | None = None  # noise where nothing lands or leaves
    evidence: FloatArray = field(
        default_factory=lambda: np.empty((0, len(NOTHING)))
    )  # of every row
    searched: Searched | None = None  # share of the field at each boundary
    untold: FloatArray = field(default_factory=lambda: np.empty((0, 2)))  # `Told` of some rows


class MergedChunks:
    """Finished chunks, in order."""

    def __init__(self, shape: tuple[int, int], ends: Sequence[int] = ()) -> None:
        self._done: list[FinishedChunk] = []
        self._ends = set(ends)  # of the stretches of the movie
        self._dated: dict[int, NDArray[np.int64]] = {}
        self._sampled: dict[int, int] = {}
        self._strongest = np.zeros((2, *shape), dtype=np.float32)
        self._masked, self._saturated = (np.zeros(shape, dtype=np.bool_) for _ in range(2))
        self.cause = ""
        self.untold: list[Told] = []
        self.empty: EmptySpread | None = None
        self.evidence = np.empty((0, len(NOTHING)))  # of the rows of `result`

    def note(self, number: int, done: FinishedChunk) -> None:
        """Register the events of a finished chunk, which may not be the next one in order."""
        frame = done.lines["frame"].to_numpy() if len(done.lines) else np.empty(0, dtype=np.int64)
        self._sampled[number] = done.sampled
        self._dated[number] = frame[(frame >= done.core[0]) & (frame < done.core[1])]

    @property
    def sampled(self) -> int:
        """Events whose posterior is sampled."""
        return sum(self._sampled.values())

    def earlier(self, number: int, frame: int) -> int:
        """Count the events before a frame in finished chunks before a given one."""
        known = list(self._dated.items())  # other threads note theirs
        return sum(int((dated < frame).sum()) for n, dated in known if n < number)

    def add(self, done: FinishedChunk) -> None:
        """Append the next chunk."""
        stronger = done.strongest[0] > self._strongest[0]
        np.copyto(self._strongest, done.strongest, where=stronger)
        self._masked |= done.masked
        self._saturated |= done.saturated
        self.cause = self.cause or done.cause
        self.untold += [(power, sigma) for power, sigma in done.untold.tolist()]
        if done.empty is not None:
            self.empty = done.empty if self.empty is None else self.empty + done.empty
        # the images are merged; holding them for every chunk would grow with the movie
        small, none = np.empty((2, 0, 0), dtype=np.float32), np.empty((0, 0), dtype=np.bool_)
        kept = done.views if sum(len(d.views) for d in self._done) < 2 * VIEWS else ()
        if sum(view.clip is not None for d in self._done for view in d.views) >= 2 * CLIPS:
            kept = tuple(replace(view, clip=None) for view in kept)
        self._done.append(replace(done, strongest=small, masked=none, saturated=none, views=kept))

    @property
    def image(self) -> FloatArray:
        """Amplitude of the strongest step of each pixel."""
        image: FloatArray = self._strongest[1].astype(np.float64)
        return image

    def result(self) -> tuple[pd.DataFrame, tuple[EventView, ...], tuple[FloatArray, ...]]:
        """Events of all chunks, each once, numbered in order of frame; their views and repeats."""
        homes = [(done, row) for done in self._done for row in range(len(done.lines))]
        if not homes:
            return make_rows([], {"event": [], FRAME_COLUMN: []}), (), ()
        table = pd.concat([d.lines for d in self._done if len(d.lines)], ignore_index=True)
        cores = np.array([done.core for done, _ in homes])
        frame = table["frame"].to_numpy()
        own = (frame >= cores[:, 0]) & (frame < cores[:, 1])
        finished = np.zeros(len(table), dtype=np.bool_)
        for done in self._done:
            finished |= (frame >= done.core[0]) & (frame < done.core[1])
        kept = SameSteps(table).with_strangers(own, ~own & finished)
        y, x = (table[name].to_numpy(float) for name in ("y_nm", "x_nm"))
        order = sorted(np.flatnonzero(kept).tolist(), key=lambda i: (frame[i], y[i], x[i]))
        views, repeats = [], []
        for number, i in enumerate(order):
            done, row = homes[i]
            repeats.append(done.repeats[row])
            if number < VIEWS and row < len(done.views):
                view = replace(done.views[row], event=number)
                views.append(view if number < CLIPS else replace(view, clip=None))
        evidence = [homes[i][0].evidence[homes[i][1]] for i in order]
        self.evidence = np.array(evidence).reshape(-1, len(NOTHING))
        rows = make_rows(table.iloc[order], {"event": range(len(order))})
        return rows, tuple(views), tuple(repeats)

    def searched(self) -> Searched:
        """Which part of field and time was searched."""
        return Searched.joined([d.searched for d in self._done if d.searched is not None])

    def _opens(self, number: int) -> bool:
        """Whether a stretch begins with this chunk."""
        return number == 0 or self._closes(self._done[number - 1])

    def _closes(self, done: FinishedChunk) -> bool:
        """Whether a stretch ends with this chunk."""
        return done.core[1] in self._ends

    def _in_place(self, values: Sequence[NDArray[Any]], between: Any) -> NDArray[Any]:
        """Put what each chunk says of its frames in their order, and something between stretches.

        Shapes: result (t,).
        """
        if not self._done:
            return np.empty(0)
        first = self._done[0].core[0]
        out = np.full(self._done[-1].core[1] - first, between)
        for done, own in zip(self._done, values, strict=True):
            out[done.core[0] - first : done.core[0] - first + len(own)] = own
        return out

    def light(self) -> FloatArray:
        """Light of the finished frames; NaN where one was left out."""
        return self._in_place([done.light for done in self._done], np.nan)

    def left_out(self) -> int:
        """Frames that are zero or repeat the one before."""
        return int(sum(np.count_nonzero(~d.good) for d in self._done))

    def repeats(self) -> NDArray[np.int64]:
        """Frames left out, counted from the first of the movie's part that was read."""
        good = self._in_place([done.good for done in self._done], True)
        return np.flatnonzero(~good.astype(np.bool_))

    def trajectory(self) -> Trajectory | None:
        """Trajectory of the fixed pattern through all chunks; None where none was followed."""
        parts: list[Trajectory] = []
        way: Trajectory | None = None  # the chunk before, halo included
        for done in self._done:
            part = done.trajectory
            if part is None:
                continue
            if way is not None:
                common = part.frames <= way.frames[-1]
                common[0] = True
                offset = way.at(part.frames[common]) - part.shift_px[common]
                part = replace(part, shift_px=part.shift_px + offset.mean(axis=0))
            own = (part.frames >= done.core[0]) & (part.frames < done.core[1])
            parts.append(Trajectory(part.frames[own], part.shift_px[own], part.error_px[own]))
            way = part
        if not parts:
            return None
        return Trajectory(
            np.concatenate([p.frames for p in parts]),
            np.concatenate([p.shift_px for p in parts]) - parts[0].shift_px[0],
            np.concatenate([p.error_px for p in parts]),
        )

    def unfollowed(self) -> list[tuple[int, int]]:
        """Frames of chunks in which the motion was not followed, or that had no pattern."""
        return [done.core for done in self._done if done.trajectory is None]

    def drift(self) -> list[float] | None:
        """Shift (y, x) of the fixed pattern from the first frames to the last [px].

        It is that of all stretches together: from one to the next there is nothing to follow.
        """
        if not self._done:
            return None
        way = self.trajectory()
        if way is not None:
            return [float(d) for d in way.shift_px[-1]]
        first = [done for k, done in enumerate(self._done) if self._opens(k)]
        last = [done for done in self._done[:-1] if self._closes(done)] + self._done[-1:]
        if last[-1].ends_e.size == 0:  # it was interrupted in the middle of a stretch
            return None
        middle = middle_of(first[0].ends_e.shape, _DRIFT_PX)
        moved = [
            measure_drift(*(part[middle].astype(np.float64) for part in (a.ends_e[0], b.ends_e[1])))
            for a, b in zip(first, last, strict=True)
        ]
        dy, dx = np.sum(moved, axis=0).tolist()
        return [dy, dx] if math.isfinite(dy) and math.isfinite(dx) else None

    @property
    def masked_pixels(self) -> int:
        """Pixels that are not used in some chunk."""
        return int(self._masked.sum())

    def masks(self) -> tuple[int, int]:
        """Defective and saturated pixels."""
        defective = self._masked & ~self._saturated
        return int(defective.sum()), int(self._saturated.sum())


class SameSteps:
    """Which rows of a table describe the same step."""

    def __init__(self, table: pd.DataFrame) -> None:
        self._frame, self._error, self._x, self._y, self._mass = (
            table[name].to_numpy(dtype=float)
            for name in ("frame", FRAME_COLUMN, "x_px", "y_px", "mass_kda")
        )
        self._order = np.argsort(self._frame, kind="stable")
        self._dated = self._frame[self._order]
        self._largest = float(np.nanmax(self._error, initial=0.0))

    def like(self, one: int) -> NDArray[np.int64]:
        """Give the other rows that describe the step of one."""
        frame, error = self._frame[one], self._error[one]
        reach = max(2.0, error + self._largest)
        first, last = np.searchsorted(self._dated, (frame - reach, frame + reach + 1e-9))
        others: NDArray[np.int64] = self._order[first:last]
        near = np.abs(self._frame[others] - frame) <= np.maximum(2, self._error[others] + error)
        away = np.hypot(self._x[others] - self._x[one], self._y[others] - self._y[one])
        near &= (away < SEAM_PX) & (self._mass[others] * self._mass[one] > 0) & (others != one)
        return np.asarray(others[near])

    def with_strangers(self, own: BoolArray, strangers: BoolArray) -> BoolArray:
        """Add to some rows those strangers whose step none of them describes.

        Shapes: `own, strangers` (n,), result (n,).
        """
        kept = own.copy()
        for one in np.flatnonzero(strangers).tolist():
            kept[one] = not kept[self.like(one)].any()
        return kept


def joined(tiles: Sequence[Tile], done: Sequence[FinishedChunk]) -> FinishedChunk:
    """Join the tiles of one chunk."""
    homes = [(part, row) for part in done for row in range(len(part.lines))]
    order = _own_rows(tiles, done)
    lines = done[0].lines
    if homes:
        table = pd.concat([part.lines for part in done if len(part.lines)], ignore_index=True)
        lines = table.iloc[order].reset_index(drop=True)
    chosen = [homes[i] for i in order]
    views: list[EventView] = []
    for number, (part, row) in enumerate(chosen):
        if row >= len(part.views):  # it has so many that the others are not shown
            break
        view = part.views[row]
        views.append(view if number < CLIPS else replace(view, clip=None))
    has_ends = done[0].ends_e.size > 0
    middle = next(part for tile, part in zip(tiles, done, strict=True) if tile.is_central)
    return replace(
        done[0],
        lines=lines,
        repeats=np.array([part.repeats[row] for part, row in chosen]),
        evidence=np.array([part.evidence[row] for part, row in chosen]).reshape(
            -1, done[0].evidence.shape[1]
        ),
        views=tuple(views),
        masked=_field(tiles, [part.masked for part in done]),
        saturated=_field(tiles, [part.saturated for part in done]),
        strongest=_field(tiles, [part.strongest for part in done]),
        ends_e=_field(tiles, [part.ends_e for part in done]) if has_ends else done[0].ends_e,
        sampled=sum(part.sampled for part in done),
        stopped=any(part.stopped for part in done),
        trajectory=middle.trajectory,
        cause=next((part.cause for part in done if part.cause), ""),
        empty=EmptySpread.beside([part.empty for part in done]),
        searched=_searched(done),
        untold=np.concatenate([part.untold for part in done]),
    )


def _own_rows(tiles: Sequence[Tile], done: Sequence[FinishedChunk]) -> list[int]:
    """Choose one row for each event, of all rows one after the other, in order of frame."""
    tables = [part.lines for part in done if len(part.lines)]
    if not tables:
        return []
    table = pd.concat(tables, ignore_index=True)
    own = np.concatenate([
        tile.holds(part.lines["y_px"].to_numpy(float), part.lines["x_px"].to_numpy(float))
        for tile, part in zip(tiles, done, strict=True) if len(part.lines)
    ])  # fmt: skip
    same = SameSteps(table)
    chosen = np.flatnonzero(same.with_strangers(own, ~own))
    # two of one particle, each in its own core: the clearer one is kept
    clear = chosen[np.argsort(-table["snr"].to_numpy(float)[chosen], kind="stable")]
    home = np.repeat(np.arange(len(tables)), [len(each) for each in tables])
    taken = np.zeros(len(table), dtype=np.bool_)
    for one in clear.tolist():
        others = same.like(one)
        taken[one] = not (taken[others] & (home[others] != home[one])).any()
    frame, y, x = (table[name].to_numpy(float) for name in ("frame", "y_nm", "x_nm"))
    return sorted(np.flatnonzero(taken).tolist(), key=lambda i: (frame[i], y[i], x[i]))


def _field(tiles: Sequence[Tile], parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Put the cores of tiles in their places.

    Shapes: `parts` (…, y, x), result (…, y, x).
    """
    whole = np.zeros((*parts[0].shape[:-2], *tiles[0].field), dtype=parts[0].dtype)
    for tile, part in zip(tiles, parts, strict=True):
        whole[(..., *tile.core)] = part
    return whole


def _searched(done: Sequence[FinishedChunk]) -> Searched | None:
    """Average the shares of tiles, by their pixels."""
    known = [part for part in done if part.searched is not None]
    if not known:
        return None
    pixels = np.array([np.count_nonzero(~part.masked) for part in known], dtype=np.float64)
    shares = np.stack([part.searched.shares for part in known if part.searched is not None])
    frames = known[0].searched.frames if known[0].searched is not None else np.empty(0, np.int64)
    return Searched(frames, np.average(shares, axis=0, weights=np.maximum(pixels, 1.0)))
