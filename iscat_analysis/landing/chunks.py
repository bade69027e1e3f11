"""One node of work on the chunks of a landing movie, and the runner that cuts and gathers them.

`ChunkNode` finds and fits the steps of one part, a chunk of frames or a tile of one, in any
process; a part has a margin of frames and pixels beyond its core, so that every step of the core is
analysed with all its neighbours.  `ChunkRunner` sends parts to where there is room, and merges
their results.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
import pandas as pd

from iscat_analysis.camera import Camera, LightModel, Trajectory
from iscat_analysis.config import Config, with_absolute_paths
from iscat_analysis.diagnosis import Noise, misfit_warning
from iscat_analysis.executors import Executor
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import posterior_of
from iscat_analysis.fitting.pattern import corrected
from iscat_analysis.fitting.results import evidence_beside, lines_of, view_of
from iscat_analysis.fitting.run import Checkpoint
from iscat_analysis.landing.maps import Searched, maps_are_local
from iscat_analysis.landing.merging import (
    CLIPS,
    SEAM_PX,
    VIEWS,
    FinishedChunk,
    MergedChunks,
    joined,
)
from iscat_analysis.landing.neighbours import Neighbours
from iscat_analysis.landing.steps import ChunkFitter
from iscat_analysis.landing.tasks import StepEvent
from iscat_analysis.records import (
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
from iscat_analysis.search.sliding import STRIDES, stride_of
from iscat_analysis.threads import one_thread_algebra, threads

POSTERIORS = 20
"""Events whose posterior is sampled, where the configuration asks for it."""

_FIELDS = 2  # chunks whose sums over the field are kept: one ends while the next begins


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

    def analyse(
        self,
        part: Part,
        sums: FieldSums | None,
        posteriors: int,
        earlier: int,
        pool: ThreadPoolExecutor,
        *,
        progress: Progress = silent,
    ) -> FinishedChunk:
        """Read and analyse a part, of which `sums` say what the field has where it is a tile."""
        context, stride = self.context, stride_of(self.window)
        if part.tile is None or sums is None:
            chunk = self.reader.chunk(part.span, stride, pool)
        else:
            chunk = self.reader.tile_chunk(sums, part.tile, stride, pool)
            context = context.on_tile(part.tile)
        progress("landing", 0, 1)
        still, pattern = corrected(
            chunk, wanted=self.config.background.follows_pattern, mapper=pool.map
        )
        own = EVERYWHERE if part.tile is None else part.tile.inner
        fitter = ChunkFitter(
            Neighbours(context, still, self.window, pattern), pool, self.noise.excess, own,
            controlled=part.controlled,
        )  # fmt: skip
        return analyse_chunk(fitter, chunk, part, posteriors, earlier)


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
    """Open the movie and analyse one part of it."""
    with threads(node.config.compute.workers) as pool:
        return node.analyse(part, sums, posteriors, earlier, pool, progress=progress)


def field_job(node: ChunkNode, span: tuple[int, int], *, progress: Progress = silent) -> FieldSums:
    """Open the movie and sum the frames of a chunk over the field."""
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
        self._fields: dict[tuple[int, int], Future[FieldSums]] = {}
        self._lock = threading.Lock()

    def run(self) -> Generator[tuple[int, bool]]:
        """Merge parts in order, in whatever order they come.

        Yields the number of frames that are done, and whether it stopped within a chunk.
        """
        waiting: dict[int, FinishedChunk] = {}
        ready, frames = 0, 0.0
        with threads(self.node.config.compute.workers) as pool:
            try:
                for number, done in self._results(pool):
                    waiting[number] = done
                    self.merged.note(number, done)
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
            except KeyboardInterrupt:
                pool.shutdown(wait=False, cancel_futures=True)
                raise

    def _results(self, pool: ThreadPoolExecutor) -> Iterator[tuple[int, FinishedChunk]]:
        """Finish parts; with posteriors one follows another, and has what is left to sample."""
        count, alone = len(self._parts), 0
        while self._samples and alone < count and self.merged.sampled < POSTERIORS:
            yield alone, self._finish(alone, pool)
            alone += 1
        later = self._executor.each(lambda number: self._finish(number, pool), range(alone, count))
        for number, done in later:
            yield alone + number, done

    def _finish(self, number: int, pool: ThreadPoolExecutor) -> FinishedChunk:
        """Load a part that was finished before, or analyse it."""
        node, merged, executor = self.node, self.merged, self._executor
        known: FinishedChunk | None = None if self._samples else self._store.load(number)
        if known is None:
            part = self._parts[number]
            budget = POSTERIORS - merged.sampled if self._samples else 0
            earlier = merged.earlier(number, part.core[0] - node.window)  # before all of this chunk
            if executor.distant:
                node.reader.forget()  # whoever does it has a reader of its own
            sums = None
            if part.tile is not None:
                sums = self._sums(part.span, pool).part(part.tile.here)
                chunk = bisect_right(self._edges, number)  # the next one
                is_last_but_one = number == self._edges[chunk] - 2
                if node.reader.in_place and is_last_but_one and chunk < len(self.chunks):
                    # while another process does the other tiles
                    self._sums(self.chunks[chunk][0].span, pool)
            arguments = part, sums, budget, earlier
            known = executor.call(
                chunk_job, node, *arguments, here=lambda: node.analyse(*arguments, pool)
            )
            self._store.save(number, replace(known, views=_without_posteriors(known.views)))
        merged.note(number, known)
        return known

    def _sums(self, span: tuple[int, int], pool: ThreadPoolExecutor) -> FieldSums:
        """Give sums over the field, made once for all tiles of a chunk; the last few are kept."""
        with self._lock:
            known = self._fields.get(span)
            mine: Future[FieldSums] = Future()
            if known is None:
                for old in sorted(self._fields)[: 1 - _FIELDS]:
                    del self._fields[old]
                self._fields[span] = mine
        if known is None:
            node = self.node
            try:
                mine.set_result(
                    self._executor.call(
                        field_job, node, span, here=lambda: node.reader.field_sums(span, pool)
                    )
                )
            except BaseException as error:
                mine.set_exception(error)
                raise
        return (known or mine).result()


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
    stopped = False
    for number, event in enumerate(events):
        if len(chains) >= posteriors:
            break
        if not core[0] <= event.frame < core[1]:
            continue
        try:
            chains[number] = posterior_of(context, event, event.frame)
        except KeyboardInterrupt:  # the fits are done, and kept
            stopped = True
            break
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


def _without_posteriors(views: Sequence[EventView]) -> tuple[EventView, ...]:
    """Leave out chains, which are sampled again."""
    return tuple(replace(view, posterior=None) for view in views)


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
