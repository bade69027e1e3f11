"""One chunk of a landing movie: its models, its steps and their fits, in any process."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
import pandas as pd

from iscat_analysis.camera import Camera, LightModel, NoiseSpectrum, Trajectory
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import misfit_warning
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import posterior_of
from iscat_analysis.fitting.pattern import corrected
from iscat_analysis.fitting.results import evidence_beside, lines_of, view_of
from iscat_analysis.fitting.run import Checkpoint, packed_views, unpacked_views
from iscat_analysis.landing.maps import Searched
from iscat_analysis.landing.merging import CLIPS, SEAM_PX, VIEWS, FinishedChunk
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
from iscat_analysis.search.chunks import Part, Reader, reader_of
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.frames import EVERYWHERE, Chunk, FieldSums, Tile
from iscat_analysis.search.sliding import STRIDES, stride_of
from iscat_analysis.search.templates import ExcessNoise
from iscat_analysis.threads import threads


class Store(Checkpoint):
    """Finished chunks of a landing movie on disk."""

    def load(self, number: int) -> FinishedChunk | None:
        """Give a finished chunk, or None."""
        found = self.read(number)
        if found is None:
            return None
        lines, data = found
        try:
            low, high = (int(n) for n in data["core"])
            return FinishedChunk(
                core=(low, high),
                lines=lines,
                repeats=data["repeats"],
                evidence=data["evidence"],
                views=unpacked_views(data),
                good=data["good"],
                light=data["light"],
                masked=data["masked"],
                saturated=data["saturated"],
                strongest=data["strongest"],
                ends_e=data["ends_e"],
                trajectory=_trajectory(data["trajectory"]),
                cause=str(data["cause"]),
                untold=data["untold"],
                searched=Searched(data["searched_frames"], data["searched_shares"]),
                empty=_empty(data["squares"], data["number"], data["shared"]),
            )
        except (ValueError, KeyError):
            return None

    def save(self, number: int, done: FinishedChunk) -> None:
        """Keep a finished chunk."""
        searched = done.searched or Searched.joined(())
        arrays = {
            "searched_frames": searched.frames,
            "searched_shares": searched.shares,
            "core": np.array(done.core),
            "repeats": done.repeats,
            "evidence": done.evidence,
            **packed_views(done.views),
            "good": done.good,
            "light": done.light,
            "masked": done.masked,
            "saturated": done.saturated,
            "strongest": done.strongest,
            "ends_e": done.ends_e,
            "trajectory": _columns(done.trajectory),
            "cause": np.array(done.cause),
            "untold": done.untold,
            "squares": np.empty(0) if done.empty is None else done.empty.squares,
            "number": np.empty(0) if done.empty is None else done.empty.counts,
            "shared": np.empty(0) if done.empty is None else done.empty.shared,
        }
        self.write(number, done.lines, arrays)


def _columns(motion: Trajectory | None) -> FloatArray:
    if motion is None:
        return np.empty((0, 5))
    return np.column_stack([motion.frames, motion.shift_px, motion.error_px])


def _empty(squares: FloatArray, counts: FloatArray, shared: FloatArray) -> EmptySpread | None:
    return EmptySpread(squares, counts, shared) if counts.size else None


def _trajectory(columns: FloatArray) -> Trajectory | None:
    return Trajectory(columns[:, 0], columns[:, 1:3], columns[:, 3:]) if len(columns) else None


_LARGEST_SHARE = 1.5  # times its share of the field, that a tile may have of the events shown


@dataclass(frozen=True)
class ChunkSetting:
    """What all chunks of a movie share, so that any process can read and analyse one."""

    frames: CountSource
    camera: Camera
    config: Config
    span: tuple[int, int]
    searches: int
    window: int
    noise: NoiseSpectrum | None
    excess_noise: ExcessNoise | None
    lines: LightModel | None

    @cached_property
    def reader(self) -> Reader:
        """The frames, for one chunk after the other."""
        return reader_of(self.frames, self.config, self.camera, self.span)

    @cached_property
    def context(self) -> AnalysisContext:
        """The models, which all chunks share."""
        return make_context(
            self.config, self.reader.shape, searches=self.searches, noise=self.noise,
            lines=self.lines, sliding=True,
        )  # fmt: skip


def chunk_job(
    setting: ChunkSetting,
    part: Part,
    sums: FieldSums | None,
    posteriors: int,
    earlier: int,
    *,
    progress: Progress = silent,
) -> FinishedChunk:
    """Open the movie and analyse one chunk, or one tile of it."""
    with threads(setting.config.compute.workers) as pool:
        return analyse_part(
            setting.reader, setting.context, part, sums, setting.window, pool, posteriors,
            setting.excess_noise, earlier, progress=progress,
        )  # fmt: skip


def field_job(
    setting: ChunkSetting, span: tuple[int, int], *, progress: Progress = silent
) -> FieldSums:
    """Open the movie and sum the frames of a chunk over the field."""
    del progress
    with threads(setting.config.compute.workers) as pool:
        return setting.reader.field_sums(span, pool)


def analyse_part(
    reader: Reader,
    context: AnalysisContext,
    part: Part,
    sums: FieldSums | None,
    window: int,
    pool: ThreadPoolExecutor,
    posteriors: int,
    excess_noise: ExcessNoise | None,
    earlier: int,
    *,
    progress: Progress = silent,
) -> FinishedChunk:
    """Read and analyse a chunk, or one tile of it, of which `sums` say what the field has."""
    if part.tile is None or sums is None:
        chunk = reader.chunk(part.span, stride_of(window), pool)
    else:
        chunk = reader.tile_chunk(sums, part.tile, stride_of(window), pool)
        context = context.on_tile(part.tile)
    progress("landing", 0, 1)
    return analyse_chunk(context, chunk, part, window, pool, posteriors, excess_noise, earlier)


def analyse_chunk(
    context: AnalysisContext,
    chunk: Chunk,
    part: Part,
    window: int,
    pool: ThreadPoolExecutor,
    posteriors: int,
    excess_noise: ExcessNoise | None,
    earlier: int,
) -> FinishedChunk:
    """Find and fit every step of a chunk, or of a tile of one; places are those of the field."""
    core, tile = part.core, part.tile
    wanted = context.config.background.follows_pattern
    still, pattern = corrected(chunk, wanted=wanted, mapper=pool.map)
    own = EVERYWHERE if tile is None else tile.inner
    fitter = ChunkFitter(
        context, still, window, pool, pattern, excess_noise=excess_noise, own=own,
        controlled=part.controlled,
    )  # fmt: skip
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
    empty_ends = [
        (mean_e / fitter.neighbours.light_in(frames, found))[own] for frames, mean_e in ends
    ]
    light = np.where(chunk.good, chunk.power, np.nan) * chunk.level_e
    lines = make_rows(lines_of(context, events, mapper=pool.map))
    corner = (0, 0) if tile is None else tile.corner
    return FinishedChunk(
        core=core,
        lines=_moved(lines, corner, context.pixel_nm),
        repeats=np.array([step.repeats for step in steps]),
        evidence=evidence_beside(context, events, mapper=pool.map),
        views=tuple(
            view_moved(
                view_of(n, events[n], posterior=chains.get(n), trace=trace, clip=clip), corner
            )
            for n, (trace, clip) in enumerate(shown)
        ),
        good=chunk.good[inside].copy(),
        light=light[inside],
        masked=~chunk.usable[own],
        saturated=chunk.saturated[own].copy(),
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
    share = 1.0 if tile is None else min(_LARGEST_SHARE * tile.share, 1.0)
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
