"""One chunk of a landing movie: its models, its steps and their fits, in any process."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.lines import Lines
from iscat_analysis.camera.spectrum import NoiseSpectrum
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.causes import misfit_warning
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import posterior_of
from iscat_analysis.fitting.pattern import corrected
from iscat_analysis.fitting.results import evidence_beside, lines_of, view_of
from iscat_analysis.landing.merging import CLIPS, VIEWS, FinishedChunk
from iscat_analysis.landing.steps import ChunkFitter
from iscat_analysis.records import (
    CountSource,
    FloatArray,
    PosteriorResult,
    Progress,
    make_rows,
    silent,
)
from iscat_analysis.search.sliding import STRIDES, Chunk, stride_of
from iscat_analysis.search.sliding.chunks import Reader, reader_of
from iscat_analysis.search.templates import ExcessNoise
from iscat_analysis.threads import threads


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
    lines: Lines | None

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
    core: tuple[int, int],
    span: tuple[int, int],
    posteriors: int,
    earlier: int,
    *,
    progress: Progress = silent,
) -> FinishedChunk:
    """Open the movie and analyse one chunk."""
    with threads(setting.config.compute.workers) as pool:
        chunk = setting.reader.chunk(span, stride_of(setting.window), pool)
        progress("landing", 0, 1)
        return analyse_chunk(
            setting.context, chunk, core, setting.window, pool, posteriors, setting.excess_noise,
            earlier,
        )  # fmt: skip


def analyse_chunk(
    context: AnalysisContext,
    chunk: Chunk,
    core: tuple[int, int],
    window: int,
    pool: ThreadPoolExecutor,
    posteriors: int,
    excess_noise: ExcessNoise | None,
    earlier: int,
) -> FinishedChunk:
    """Find and fit every step of a chunk."""
    wanted = context.config.background.follows_pattern
    still, pattern = corrected(chunk, wanted=wanted, mapper=pool.map)
    fitter = ChunkFitter(context, still, window, pool, pattern, excess_noise=excess_noise)
    seam = max(2, window // STRIDES)
    steps = fitter.run((core[0] - seam, core[1] + seam), core)
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
    shown = fitter.shown(steps[: max(VIEWS - earlier, 0)], CLIPS - earlier)
    inside = slice(core[0] - chunk.first, core[1] - chunk.first)
    light = np.where(chunk.good, chunk.power, np.nan) * float(chunk.mean_e.mean())
    return FinishedChunk(
        core=core,
        lines=make_rows(lines_of(context, events, mapper=pool.map)),
        repeats=np.array([step.repeats for step in steps]),
        evidence=evidence_beside(context, events, mapper=pool.map),
        views=tuple(
            view_of(n, events[n], posterior=chains.get(n), trace=trace, clip=clip)
            for n, (trace, clip) in enumerate(shown)
        ),
        good=chunk.good[inside].copy(),
        light=light[inside],
        masked=~chunk.usable,
        saturated=chunk.saturated,
        strongest=fitter.strongest,
        ends_e=_ends(chunk, inside),
        sampled=len(chains),
        stopped=stopped,
        trajectory=pattern.trajectory if pattern else None,
        cause=misfit_warning(context.config, events),
        empty=fitter.empty,
        searched=fitter.searched,
    )


def _ends(chunk: Chunk, inside: slice) -> FloatArray:
    """Mean images of the first and the last quarter of a core, shape (2, y, x)."""
    lit = np.add.reduceat(chunk.good, chunk.edges[:-1], dtype=np.int64) > 0
    held = lit & (chunk.edges[:-1] >= inside.start) & (chunk.edges[1:] <= inside.stop)
    blocks = np.flatnonzero(held if held.any() else lit)
    few = max(1, blocks.size // 4)
    return np.stack([chunk.blocks_e[part].mean(axis=0) for part in (blocks[:few], blocks[-few:])])
