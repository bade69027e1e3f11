"""One node of work on the chunks of a landing movie, and the runner that cuts and gathers them.

`ChunkNode` holds what finds and fits the steps of one part, a chunk of frames or a tile of one, in
any process; a part has a margin of frames and pixels beyond its core, so that every step of the
core is analysed with all its neighbours.  `ChunkRunner` sends parts to where there is room, and
merges their results: each event once, in order of frame.

An event belongs to the part whose core, of frames and of pixels, holds it.  On a seam two parts may
each place it in the other's core, or each in its own: of what one reports beyond its core, that is
kept which no other reports.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress, takewhile
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Camera, LightModel, Trajectory, measure_drift, middle_of
from iscat_analysis.config import Config, with_absolute_paths
from iscat_analysis.diagnosis import Noise, misfit_warning
from iscat_analysis.executors import Executor
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import Told, posterior_of
from iscat_analysis.fitting.pattern import corrected
from iscat_analysis.fitting.results import evidence_beside, lines_of, view_of
from iscat_analysis.fitting.run import Checkpoint
from iscat_analysis.inference.nuisances import NOTHING
from iscat_analysis.landing.maps import Searched, maps_are_local
from iscat_analysis.landing.neighbours import Neighbours
from iscat_analysis.landing.steps import ChunkFitter
from iscat_analysis.landing.tasks import StepEvent
from iscat_analysis.last_used import memoize
from iscat_analysis.records import (
    FRAME_COLUMN,
    BoolArray,
    CountSource,
    EventView,
    FloatArray,
    PosteriorResult,
    Progress,
    make_rows,
    silent,
)
from iscat_analysis.search.chunks import Part, Reader, plan_parts, reader_of
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.frames import EVERYWHERE, Chunk, FieldSums, Tile
from iscat_analysis.search.sliding import STRIDES, MapArray, stride_of
from iscat_analysis.threads import one_thread_algebra, threads

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
    sampled: int = 0
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
    kept, own = rows.nothing, rows.nothing
    if len(rows.table):
        y, x = (rows.table[name].to_numpy(float) for name in ("y_px", "x_px"))
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
        table = self.table
        if len(table):
            table = table[kept].sort_values(["frame", "y_nm", "x_nm"])
        homes = [(self._parts[self.home[i]], int(self._row[i])) for i in table.index]
        evidence = np.array([part.evidence[row] for part, row in homes]).reshape(-1, len(NOTHING))
        views: list[EventView | None] = []
        for number, (part, row) in enumerate(homes[:VIEWS]):
            view = replace(part.views[row], event=number) if row < len(part.views) else None
            views.append(replace(view, clip=None) if view and number >= CLIPS else view)
        repeats = tuple(part.repeats[row] for part, row in homes)
        return table.reset_index(drop=True), repeats, evidence, views


class MergedChunks:
    """Finished chunks, in order."""

    def __init__(self, shape: tuple[int, int], ends: Sequence[int] = ()) -> None:
        self._done: list[FinishedChunk] = []
        self._ends = set(ends)  # of the stretches of the movie
        self._noted: dict[int, tuple[NDArray[np.int64], int]] = {}  # dates, and what is sampled
        self._strongest = np.zeros((2, *shape), dtype=np.float32)
        self._masked, self._saturated = (np.zeros(shape, dtype=np.bool_) for _ in range(2))
        self.cause = ""
        self.untold: list[Told] = []
        self.empty: EmptySpread | None = None
        self.evidence = np.empty((0, len(NOTHING)))  # of the rows of `result`

    def note(self, number: int, done: FinishedChunk) -> None:
        """Register the events of a finished chunk, which may not be the next one in order."""
        frame = done.lines["frame"].to_numpy() if len(done.lines) else np.empty(0, dtype=np.int64)
        dated = frame[(frame >= done.core[0]) & (frame < done.core[1])]
        self._noted[number] = dated, done.sampled

    @property
    def sampled(self) -> int:
        """Events whose posterior is sampled."""
        return sum(sampled for _, sampled in self._noted.values())

    def earlier(self, number: int, frame: int) -> int:
        """Count the events before a frame in finished chunks before a given one."""
        known = list(self._noted.items())  # other threads note theirs
        return sum(int((dated < frame).sum()) for n, (dated, _) in known if n < number)

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
        kept = done.views if sum(len(d.views) for d in self._done) < 2 * VIEWS else ()
        if sum(view.clip is not None for d in self._done for view in d.views) >= 2 * CLIPS:
            kept = tuple(replace(view, clip=None) for view in kept)
        # the images are merged; holding them for every chunk would grow with the movie
        small, none = np.empty((2, 0, 0), dtype=np.float32), np.empty((0, 0), dtype=np.bool_)
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
            if (part := done.trajectory) is None:
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
        closed = [done.core[1] in self._ends for done in self._done[:-1]]  # stretches
        first = list(compress(self._done, [True, *closed]))
        last = [*compress(self._done, closed), self._done[-1]]
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


POSTERIORS = 20
"""Events whose posterior is sampled, where the configuration asks for it."""


@dataclass(frozen=True)
class ChunkNode:
    """The work on every part of a movie, which any process can do."""

    frames: CountSource
    camera: Camera
    config: Config
    span: tuple[int, int]
    searches: int
    window: int
    noise: Noise
    lines: LightModel | None
    opened: Reader | None = None  # of this process

    def __reduce__(self) -> tuple[type[ChunkNode], tuple[object, ...]]:
        """Leave behind what is open, and models that are made again as quickly."""
        config = with_absolute_paths(self.config)
        shared = self.span, self.searches, self.window, self.noise, self.lines
        return ChunkNode, (self.frames, self.camera, config, *shared)

    @cached_property
    def reader(self) -> Reader:
        """The frames, for one chunk after the other."""
        return self.opened or reader_of(self.frames, self.config, self.camera, self.span)

    @cached_property
    def context(self) -> AnalysisContext:
        """The models, which all chunks share."""
        with one_thread_algebra():
            return make_context(
                self.config, self.reader.shape, searches=self.searches, noise=self.noise.spectrum,
                lines=self.lines, sliding=True,
            )  # fmt: skip

    def plan(self, stretch: tuple[int, int]) -> list[list[Part]]:
        """Divide a stretch of the movie into chunks, and these into tiles where they are large."""
        moving = self.config.background.follows_pattern
        in_place = maps_are_local(self.context, moving=moving)
        return plan_parts(self.reader, self.config, self.window, stretch, in_place=in_place)


class ChunkStore(Checkpoint):
    """Finished parts of a landing movie on disk."""

    records = (*Checkpoint.records, FinishedChunk, Trajectory, EmptySpread, Searched)


def chunk_job(
    node: ChunkNode,
    part: Part,
    sums: FieldSums | None,
    posteriors: int,
    earlier: int,
    *,
    progress: Progress = silent,
) -> FinishedChunk:
    """Read and analyse a part of a movie; `sums` are those of the field, where it is a tile."""
    context, window, own = node.context, node.window, EVERYWHERE
    with threads(node.config.compute.workers) as pool:
        if part.tile is None or sums is None:
            chunk = node.reader.chunk(part.span, stride_of(window), pool)
        else:
            chunk = node.reader.tile_chunk(sums, part.tile, stride_of(window), pool)
            context, own = context.on_tile(part.tile), part.tile.inner
        progress("landing", 0, 1)
        wanted = node.config.background.follows_pattern
        still, pattern = corrected(chunk, wanted=wanted, mapper=pool.map)
        neighbours = Neighbours(context, still, window, pattern)
        fitter = ChunkFitter(neighbours, pool, node.noise.excess, own, controlled=part.controlled)
        return analyse_chunk(fitter, chunk, part, posteriors, earlier)


def field_job(node: ChunkNode, span: tuple[int, int], *, progress: Progress = silent) -> FieldSums:
    """Sum the frames of a chunk over the field."""
    del progress
    with threads(node.config.compute.workers) as pool:
        return node.reader.field_sums(span, pool)


class ChunkRunner:
    """Does the work of a node on all parts of a movie, where there is room, and merges it."""

    def __init__(
        self,
        node: ChunkNode,
        stretches: Sequence[tuple[int, int]],
        executor: Executor,
        store: ChunkStore,
    ) -> None:
        self.node, self._executor, self._store = node, executor, store
        self.chunks = [chunk for stretch in stretches for chunk in node.plan(stretch)]
        self._parts = [part for chunk in self.chunks for part in chunk]
        self._edges: list[int] = np.cumsum([0, *map(len, self.chunks)]).tolist()
        self._samples = node.config.samples_posterior
        self.merged = MergedChunks(node.reader.shape, [stop for _, stop in stretches])
        # made once for all tiles of a chunk; one chunk ends while the next begins
        self._sums = memoize(2, lambda span: executor.call(field_job, node, span))

    def run(self) -> Generator[tuple[int, bool]]:
        """Merge parts in order, in whatever order they come.

        Yields the number of frames that are done, and whether it stopped within a chunk.
        """
        waiting: dict[int, FinishedChunk] = {}
        ready, frames = 0, 0.0
        for number, done in self._results():
            waiting[number] = done
            home = bisect_right(self._edges, number) - 1
            frames += (done.core[1] - done.core[0]) / len(self.chunks[home])
            while ready < len(self.chunks):
                own = range(*self._edges[ready : ready + 2])
                if not all(k in waiting for k in own):
                    break
                parts = [waiting.pop(k) for k in own]
                tiles = [part.tile for part in self.chunks[ready] if part.tile is not None]
                self.merged.add(joined(tiles, parts) if tiles else parts[0])
                ready += 1
            yield round(frames), done.stopped

    def _results(self) -> Iterator[tuple[int, FinishedChunk]]:
        """Finish parts; with posteriors one follows another, and has what is left to sample."""
        count, alone = len(self._parts), 0
        while self._samples and alone < count and self.merged.sampled < POSTERIORS:
            yield alone, self._finish(alone)
            alone += 1
        for number, done in self._executor.each(self._finish, range(alone, count)):
            yield alone + number, done

    def _finish(self, number: int) -> FinishedChunk:
        """Load a part that was finished before, or analyse it."""
        node, merged = self.node, self.merged
        known: FinishedChunk | None = None if self._samples else self._store.load(number)
        if known is None:
            part = self._parts[number]
            budget = POSTERIORS - merged.sampled if self._samples else 0
            earlier = merged.earlier(number, part.core[0] - node.window)  # before all of this chunk
            if self._executor.distant:
                node.reader.forget()  # whoever does it has a reader of its own
            tile = part.tile
            sums = None if tile is None else self._sums(part.span).part(tile.here)
            known = self._executor.call(chunk_job, node, part, sums, budget, earlier)
            # chains are sampled again
            views = tuple(replace(view, posterior=None) for view in known.views)
            self._store.save(number, replace(known, views=views))
        merged.note(number, known)
        return known


def analyse_chunk(
    fitter: ChunkFitter, chunk: Chunk, part: Part, posteriors: int, earlier: int
) -> FinishedChunk:
    """Find and fit every step of a chunk, or of a tile of one; places are those of the field."""
    neighbours, mapper = fitter.neighbours, fitter.mapper
    context, window, still = neighbours.context, neighbours.window, neighbours.chunk
    core, tile, own = part.core, part.tile, fitter.own
    corner = (0, 0) if tile is None else tile.corner
    inside = slice(core[0] - chunk.first, core[1] - chunk.first)
    ends = _ends(chunk, inside) if {*core} & {*part.span} else []  # maps take the place of blocks
    seam = max(2, window // STRIDES)
    steps = fitter.run((core[0] - seam, core[1] + seam), core)
    if tile is not None:
        steps = _near_core(steps, tile, context.pixel_nm)
    events = [step.event for step in steps]
    chains: dict[int, PosteriorResult] = {}
    of_core = [n for n, event in enumerate(events) if core[0] <= event.frame < core[1]]
    stopped = False
    try:
        for n in of_core[:posteriors]:
            chains[n] = posterior_of(context, events[n], events[n].frame)
    except KeyboardInterrupt:  # the fits are done, and kept
        stopped = True
    shown = fitter.shown(
        steps[: _shown_of(tile, VIEWS - earlier)], _shown_of(tile, CLIPS - earlier)
    )
    found = [one.step for one in steps]
    empty_ends = [(mean_e / neighbours.light_in(frames, found))[own] for frames, mean_e in ends]
    light = np.where(still.good, still.power, np.nan) * still.level_e
    lines = make_rows(lines_of(context, events, mapper=mapper))
    pattern = neighbours.pattern
    return FinishedChunk(
        core=core,
        lines=_moved(lines, corner, context.pixel_nm),
        repeats=np.array([step.repeats for step in steps]),
        evidence=evidence_beside(context, events, mapper=mapper),
        views=tuple(
            view_moved(
                view_of(n, events[n], posterior=chains.get(n), trace=trace, clip=clip), corner
            )
            for n, (trace, clip) in enumerate(shown)
        ),
        good=still.good[inside].copy(),
        light=light[inside],
        masked=~chunk.usable[own],
        saturated=still.saturated[own].copy(),
        strongest=fitter.strongest[(slice(None), *own)].copy(),  # not held with its halo
        ends_e=np.array(empty_ends, dtype=np.float32),
        sampled=len(chains),
        stopped=stopped,
        trajectory=pattern.trajectory if pattern else None,
        cause=misfit_warning(context.config, events),
        empty=fitter.empty,
        searched=fitter.searched,
        untold=np.array([step.told for step in steps if step.told]).reshape(-1, 2),
    )


def _shown_of(tile: Tile | None, left: int) -> int:
    """Give how many of the events that are still to be shown may be of a tile."""
    # times its share of the field, that a tile may have of the events shown
    share = 1.0 if tile is None else min(1.5 * tile.share, 1.0)
    return math.ceil(share * max(left, 0))


def _near_core(steps: list[StepEvent], tile: Tile, pixel_nm: float) -> list[StepEvent]:
    """Keep the steps of the core of a tile, and those on a seam, which its neighbour may miss."""
    y, x = tile.corner
    places = np.array([(s.event.fit.y_nm, s.event.fit.x_nm) for s in steps]).reshape(-1, 2)
    kept = tile.holds(places[:, 0] / pixel_nm + y, places[:, 1] / pixel_nm + x, SEAM_PX)
    return list(compress(steps, kept))


def _moved(lines: pd.DataFrame, corner: tuple[int, int], pixel_nm: float) -> pd.DataFrame:
    """Count the places of rows from the corner of the field, and not of the tile."""
    if corner == (0, 0) or not len(lines):
        return lines
    y, x = corner
    shifts = {"y_px": y, "x_px": x, "y_nm": y * pixel_nm, "x_nm": x * pixel_nm}
    return lines.assign(**{name: lines[name] + shift for name, shift in shifts.items()})


def view_moved(view: EventView, corner: tuple[int, int]) -> EventView:
    """Count the pixels of a view from the corner of the field."""
    y, x = corner
    return replace(view, row_px=view.row_px + y, column_px=view.column_px + x)


def _ends(chunk: Chunk, inside: slice) -> list[tuple[slice, FloatArray]]:
    """Mean images of the first and the last quarter of a core, and their frames.

    Shapes: each image (y, x).
    """
    lit = np.add.reduceat(chunk.good, chunk.edges[:-1], dtype=np.int64) > 0
    held = lit & (chunk.edges[:-1] >= inside.start) & (chunk.edges[1:] <= inside.stop)
    blocks = np.flatnonzero(held if held.any() else lit)
    few = max(1, blocks.size // 4)
    images = []
    for part in (blocks[:few], blocks[-few:]):
        frames = slice(int(chunk.edges[part[0]]), int(chunk.edges[part[-1] + 1]))
        images.append((frames, chunk.blocks_e[part].mean(axis=0, dtype=np.float64)))
    return images
