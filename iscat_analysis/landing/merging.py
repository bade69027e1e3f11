"""Finished parts of a landing movie, put together: each event once, in order of frame.

An event belongs to the part whose core, of frames and of pixels, holds it.  On a seam two parts may
each place it in the other's core, or each in its own: of what one reports beyond its core, that is
kept which no other reports.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
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


SEAM_PX = 2.0
"""Estimates of one step by two chunks, or two tiles, are nearer than this."""


@dataclass(frozen=True)
class FinishedChunk:
    """The results of a chunk, or of a tile of one, that are kept."""

    core: tuple[int, int]
    lines: pd.DataFrame  # of fits.csv, which have no numbers yet
    repeats: FloatArray  # of every row, from `iscat_analysis.inference.split_frames`
    views: tuple[EventView, ...]  # of the first rows
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


def joined(tiles: Sequence[Tile], done: Sequence[FinishedChunk]) -> FinishedChunk:
    """Join the tiles of one chunk."""
    rows = _Rows(done)
    kept = rows.nothing
    if len(rows.table):
        y, x = (rows.table[name].to_numpy(float) for name in ("y_px", "x_px"))
        own = np.zeros(len(rows.table), dtype=np.bool_)
        for number, tile in enumerate(tiles):
            own |= (rows.home == number) & tile.holds(y, x)
        same = SameSteps(rows.table)
        chosen = np.flatnonzero(same.with_strangers(own, ~own))
        # two of one particle, each in its own core: the clearer one is kept
        clear = np.argsort(-rows.table["snr"].to_numpy(float)[chosen], kind="stable")
        for one in chosen[clear].tolist():
            others = same.like(one)
            kept[one] = not (kept[others] & (rows.home[others] != rows.home[one])).any()
    lines, repeats, evidence, views = rows.gathered(kept)
    has_ends = done[0].ends_e.size > 0
    middle = next(part for tile, part in zip(tiles, done, strict=True) if tile.is_central)
    return replace(
        done[0],
        lines=lines if len(rows.table) else done[0].lines,
        repeats=np.array(repeats),
        evidence=evidence,
        views=tuple(view for view in takewhile(lambda view: view is not None, views) if view),
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
    known = [(part.searched, np.count_nonzero(~part.masked)) for part in done if part.searched]
    if not known:
        return None
    pixels = np.maximum([number for _, number in known], 1.0)
    shares = np.stack([searched.shares for searched, _ in known])
    return Searched(known[0][0].frames, np.average(shares, axis=0, weights=pixels))


class _Rows:
    """The rows of several parts, one after the other."""

    def __init__(self, parts: Sequence[FinishedChunk]) -> None:
        self._parts = parts
        counts = [len(part.lines) for part in parts]
        self.home = np.repeat(np.arange(len(parts)), counts)
        self._row = np.concatenate([np.arange(0), *map(np.arange, counts)])
        tables = [part.lines for part in parts if len(part.lines)]
        self.table = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()

    @property
    def nothing(self) -> BoolArray:
        """A mark for each row, none of which is set."""
        return np.zeros(self.home.size, dtype=np.bool_)

    def gathered(
        self, kept: BoolArray
    ) -> tuple[pd.DataFrame, tuple[FloatArray, ...], FloatArray, list[EventView | None]]:
        """Give rows in order of frame, and their repeats, evidence and views, None of some.

        Shapes: `kept` (n,).
        """
        order: list[int] = []
        if len(self.table):
            frame, y, x = (self.table[name].to_numpy(float) for name in ("frame", "y_nm", "x_nm"))
            order = sorted(np.flatnonzero(kept).tolist(), key=lambda i: (frame[i], y[i], x[i]))
        homes = [(self._parts[self.home[i]], int(self._row[i])) for i in order]
        evidence = np.array([part.evidence[row] for part, row in homes]).reshape(-1, len(NOTHING))
        views: list[EventView | None] = []
        for number, (part, row) in enumerate(homes[:VIEWS]):
            view = replace(part.views[row], event=number) if row < len(part.views) else None
            views.append(replace(view, clip=None) if view and number >= CLIPS else view)
        table = self.table.iloc[order].reset_index(drop=True)
        return table, tuple(part.repeats[row] for part, row in homes), evidence, views


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
        return np.asarray(self._strongest[1], dtype=np.float64)

    def result(self) -> tuple[pd.DataFrame, tuple[EventView, ...], tuple[FloatArray, ...]]:
        """Events of all chunks, each once, numbered in order of frame; their views and repeats."""
        rows = _Rows(self._done)
        if not len(rows.table):
            return make_rows([], {"event": [], FRAME_COLUMN: []}), (), ()
        frame, own, finished = rows.table["frame"].to_numpy(), rows.nothing, rows.nothing
        for number, done in enumerate(self._done):
            inside = (frame >= done.core[0]) & (frame < done.core[1])
            own |= inside & (rows.home == number)
            finished |= inside
        kept = SameSteps(rows.table).with_strangers(own, ~own & finished)
        table, repeats, self.evidence, views = rows.gathered(kept)
        table = make_rows(table, {"event": range(len(table))})
        return table, tuple(view for view in views if view is not None), repeats

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

    def left_out(self) -> NDArray[np.int64]:
        """Frames that are zero or repeat the one before, from the first that was read."""
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
        # of the middle of the field, whose drift is measured
        middle = middle_of(first[0].ends_e.shape, 512)
        moved = [
            measure_drift(*(part[middle].astype(np.float64) for part in (a.ends_e[0], b.ends_e[1])))
            for a, b in zip(first, last, strict=True)
        ]
        dy, dx = np.sum(moved, axis=0).tolist()
        return [dy, dx] if math.isfinite(dy) and math.isfinite(dx) else None

    def masks(self) -> tuple[int, int]:
        """Defective and saturated pixels."""
        return int((self._masked & ~self._saturated).sum()), int(self._saturated.sum())

    @property
    def masked_pixels(self) -> int:
        """Pixels that are not used in some chunk."""
        return int(self._masked.sum())


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

    def like(self, row: int) -> NDArray[np.int64]:
        """Give the other rows that describe the same step as a row."""
        frame, error = self._frame[row], self._error[row]
        reach = max(2.0, error + self._largest)
        first, last = np.searchsorted(self._dated, (frame - reach, frame + reach + 1e-9))
        others: NDArray[np.int64] = self._order[first:last]
        near = np.abs(self._frame[others] - frame) <= np.maximum(2, self._error[others] + error)
        away = np.hypot(self._x[others] - self._x[row], self._y[others] - self._y[row])
        near &= (away < SEAM_PX) & (self._mass[others] * self._mass[row] > 0) & (others != row)
        return np.asarray(others[near])

    def with_strangers(self, own: BoolArray, strangers: BoolArray) -> BoolArray:
        """Add to some rows those strangers whose step none of them describes.

        Shapes: `own, strangers` (n,), result (n,).
        """
        kept = own.copy()
        for row in np.flatnonzero(strangers).tolist():
            kept[row] = not kept[self.like(row)].any()
        return kept
