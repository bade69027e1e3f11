"""One chunk of a landing movie: its models, its steps and their fits, in whatever process."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.inference.prior import Prior
from iscat_analysis.movie.camera import Camera
from iscat_analysis.movie.lines import Lines
from iscat_analysis.movie.spectrum import NoiseSpectrum
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.pipeline.chunks import (
    CLIPS,
    FRAME_COLUMN,
    REPEATS_COLUMN,
    VIEWS,
    Done,
    Reader,
    counts_budget,
)
from iscat_analysis.pipeline.diagnosis import misfit_warning
from iscat_analysis.pipeline.pattern import follow
from iscat_analysis.pipeline.results import Row, table_of, view_of
from iscat_analysis.pipeline.scene import Scene, search_both, square_model, square_of
from iscat_analysis.pipeline.steps import ChunkFitter, FittedStep
from iscat_analysis.records import CountSource, EventView, FloatArray, Progress, silent
from iscat_analysis.search.sliding import CORRELATION, STRIDES, Chunk, stride_of
from iscat_analysis.search.templates import LARGEST_IMAGE, make_templates
from iscat_analysis.threads import threads


@dataclass(frozen=True)
class ChunkSetting:
    """What the chunks of a movie have in common, for a process that can read its file.

    Attributes
    ----------
    frames : CountSource
        The movie, as it is analysed; pickled, one from a file is opened again.
    camera : Camera
        Counts → photoelectrons.
    config : Config
        Resolved, its paths absolute.
    span : (int, int)
        Half-open range of frames to analyse.
    searches : int
        Boundaries that are searched in all of them.
    window : int
        Frames before and after a step.
    noise : NoiseSpectrum or None
        Of the movie.
    excess_noise : str
        What is known of noise beyond the expected.
    lines : Lines or None
        What was divided out of the frames.
    """

    frames: CountSource
    camera: Camera
    config: Config
    span: tuple[int, int]
    searches: int
    window: int
    noise: NoiseSpectrum | None
    excess_noise: str
    lines: Lines | None


def chunk_job(
    setting: ChunkSetting,
    core: tuple[int, int],
    span: tuple[int, int],
    posteriors: int,
    *,
    progress: Progress = silent,
) -> Done:
    """Analyse one chunk from the movie's file.

    Parameters
    ----------
    setting : ChunkSetting
        Of the movie.
    core, span : (int, int)
        Half-open ranges of frames, from `iscat_analysis.pipeline.chunks.plan_chunks`.
    posteriors : int
        Events whose posterior is sampled, at most.
    progress : Progress
        Told when the frames are read.

    Returns
    -------
    Done
        The same as in the process that has the other chunks.
    """
    config, frames = setting.config, setting.frames
    reader = Reader(frames, setting.camera, *setting.span, counts_budget(config))
    with threads(config.compute.workers) as pool:
        scene = make_landing_scene(
            config,
            reader.shape,
            searches=setting.searches,
            noise=setting.noise,
            lines=setting.lines,
        )
        chunk = reader.chunk(span, stride_of(setting.window), pool)
        progress("landing", 0, 1)
        return analyse_chunk(
            scene, chunk, core, setting.window, pool, posteriors, setting.excess_noise
        )


def make_landing_scene(
    config: Config,
    field_px: tuple[int, int],
    *,
    searches: int,
    noise: NoiseSpectrum | None = None,
    lines: Lines | None = None,
) -> Scene:
    """Build the models and the matched filter, at the particles' nominal height.

    Parameters
    ----------
    config : Config
        With a pixel size.
    field_px : (int, int)
        Rows and columns.
    searches : int
        Boundaries that will be searched; they share the expected false alarms.
    noise : NoiseSpectrum, optional
        Of the movie; without it the noise is white and of the expected size.
    lines : Lines, optional
        What was divided out of the frames.

    Returns
    -------
    Scene
        Its `wide` model reaches as far as the rings of a strong particle matter.

    Raises
    ------
    ConfigError
        The region is larger than the field, or the calibration has the wrong sign.
    """
    pixel, roi_px = square_of(config, field_px)
    model = square_model(config, pixel, roi_px)
    return Scene(
        config=config,
        model=model,
        wide=forward_model(config, math.sqrt(2) * (LARGEST_IMAGE * roi_px + 2) * pixel),
        templates=make_templates(
            model,
            search_both(config.detection, searches=searches),
            pixel_nm=pixel,
            roi_nm=config.fit.roi_nm,
            z_range_nm=None,
            field_px=field_px,
            noise=noise,
            correlation=CORRELATION if searches > 1 else 0.0,
        ),
        mode=config.fit.mode,
        lines=lines,
    )


def analyse_chunk(
    scene: Scene,
    chunk: Chunk,
    core: tuple[int, int],
    window: int,
    pool: ThreadPoolExecutor,
    posteriors: int,
    excess_noise: str,
) -> Done:
    """Find and fit every step of a chunk.

    Parameters
    ----------
    scene : Scene
        Models and threshold.
    chunk : Chunk
        Its frames, with those around its core.
    core : (int, int)
        Half-open range of the frames whose steps are its own.
    window : int
        Frames before and after a step.
    pool : ThreadPoolExecutor
        Runs parts of it.
    posteriors : int
        Events whose posterior is sampled, at most.
    excess_noise : str
        What is known of noise beyond the expected.

    Returns
    -------
    Done
        Everything found.
    """
    wanted = scene.config.background.drift_correction
    trajectory = follow(chunk, pool.map) if wanted else None
    fitter = ChunkFitter(scene, chunk, window, pool, trajectory, excess_noise=excess_noise)
    seam = max(2, window // STRIDES)
    steps = fitter.run((core[0] - seam, core[1] + seam))
    rows = list(pool.map(_row, range(len(steps)), steps))
    sampled, stopped = 0, False
    for i, row in enumerate(rows):
        if sampled >= posteriors or not core[0] <= steps[i].step.at.frame < core[1]:
            continue
        settings = scene.config.posterior
        try:
            chain = sample_posterior(
                row.event.likelihood, row.event.fit,
                walkers=settings.walkers, steps=settings.steps,
                seed=scene.config.compute.seed + steps[i].step.at.frame,
                prior=Prior(settings.priors),
            )  # fmt: skip
        except KeyboardInterrupt:  # the fits are done, and kept
            stopped = True
            break
        rows[i] = replace(row, posterior=chain)
        sampled += 1
    table = table_of(scene, rows, mapper=pool.map)
    table["frame"] = [s.step.at.frame for s in steps]
    table["n_before"] = [s.n_before for s in steps]
    table["n_after"] = [s.n_after for s in steps]
    sign = np.array([s.step.sign for s in steps], dtype=float)
    table["mass_kda"] *= sign
    table["contrast"] *= sign
    table[FRAME_COLUMN] = [s.step.at.half_width for s in steps]
    table[REPEATS_COLUMN] = [s.repeats.ravel().tolist() for s in steps]
    inside = slice(core[0] - chunk.first, core[1] - chunk.first)
    light = np.where(chunk.good, chunk.power, np.nan) * float(chunk.mean_e.mean())
    return Done(
        core=core,
        table=table,
        views=tuple(map(_view, rows, fitter.with_traces(steps[:VIEWS], CLIPS))),
        good=chunk.good[inside].copy(),
        light=light[inside],
        masked=~chunk.usable,
        saturated=chunk.saturated,
        strongest=fitter.strongest,
        ends_e=_ends(chunk, inside),
        sampled=sampled,
        stopped=stopped,
        trajectory=trajectory,
        cause=misfit_warning(scene.config, [s.event for s in steps]),
        empty=fitter.empty,
    )


def _ends(chunk: Chunk, inside: slice) -> FloatArray:
    """Mean images of the first and the last quarter of a core, shape (2, y, x)."""
    lit = np.add.reduceat(chunk.good, chunk.edges[:-1], dtype=np.int64) > 0
    held = lit & (chunk.edges[:-1] >= inside.start) & (chunk.edges[1:] <= inside.stop)
    blocks = np.flatnonzero(held if held.any() else lit)
    few = max(1, blocks.size // 4)
    return np.stack([chunk.blocks_e[part].mean(axis=0) for part in (blocks[:few], blocks[-few:])])


def _row(number: int, step: FittedStep) -> Row:
    return Row(number, step.event, step.windows)


def _view(row: Row, step: FittedStep) -> EventView:
    view = view_of(row)
    return replace(
        view,
        row_px=step.region.rows[0],
        column_px=step.region.columns[0],
        trace=step.trace,
        clip=step.clip,
    )
