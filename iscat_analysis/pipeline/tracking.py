"""Mode ``track``: every frame is fitted, and the positions are linked into tracks.

`track_movie` learns the background from the frames in which the particles move, block by block;
`track_particles` takes one that was recorded or is known.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pandas as pd

from iscat_analysis.config import Config
from iscat_analysis.movie.background import Check, add_frames, start_power
from iscat_analysis.movie.camera import Camera
from iscat_analysis.pipeline.blank import FrameNoise
from iscat_analysis.pipeline.block_store import Block, BlockStore, analyse_block
from iscat_analysis.pipeline.blocks import Plan
from iscat_analysis.pipeline.field import Event, fit_field
from iscat_analysis.pipeline.joining import join_blocks
from iscat_analysis.pipeline.results import Found, Row, table_of, view_of
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import EventView, FloatArray, FrameSource, Progress, Windows
from iscat_analysis.search.moving import link

_STEPS = 100  # of the progress of a block


def learns_background(config: Config) -> bool:
    """Whether the background is that of the very frames in which particles are tracked.

    Parameters
    ----------
    config : Config
        Method and frames of its background.

    Returns
    -------
    bool
        True for method ``"tracks"``, and in mode track for a median without frames of its own.
    """
    method, frames = config.background.method, config.background.frames
    return method == "tracks" or (
        config.fit.mode == "track" and method == "median" and frames is None
    )


def track_movie(
    scene: Scene,
    movie: FrameSource,
    camera: Camera,
    plan: Plan,
    store: BlockStore,
    *,
    check: Check,
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> Found:
    """Track particles that are there in all frames, over backgrounds learnt with them.

    Parameters
    ----------
    scene : Scene
        From `iscat_analysis.pipeline.moving.track_scene`.
    movie : FrameSource
        The movie.
    camera : Camera
        Counts → photoelectrons.
    plan : Plan
        Its blocks of frames.
    store : BlockStore
        Keeps the finished ones, and has those of a run that was interrupted.
    check : callable
        Refuses impossible counts.
    pool : ThreadPoolExecutor
        Runs parts of blocks.
    progress : Progress
        Told the stages.

    Returns
    -------
    Found
        One row per particle and frame; one view per track, of its clearest frame.  An interrupt
        keeps the blocks that are finished.

    Raises
    ------
    DataError
        There are too few frames.
    KeyboardInterrupt
        The user stopped it before the first block was finished.
    """
    blocks: list[Block] = []
    count = len(plan.spans)
    interrupted = False
    try:
        for number, span in enumerate(plan.spans):
            told = progress if count == 1 else _part_of(progress, number, count)
            block = store.load(number, span)
            if block is None:
                block = analyse_block(
                    scene, movie, camera, span,
                    goes_on=(number > 0, number + 1 < count),
                    check=check, pool=pool, progress=told,
                )  # fmt: skip
                store.save(number, block)
            else:
                told("track", 1, 1)
            blocks.append(block)
    except KeyboardInterrupt:
        if not blocks:
            raise
        progress("report", 0, 1)  # what was finished is now gathered and kept, which takes a moment
        pool.shutdown(wait=False, cancel_futures=True)
        interrupted = True
    return join_blocks(scene.config, blocks, camera, interrupted=interrupted)


def _part_of(progress: Progress, number: int, count: int) -> Progress:
    """Tell the progress of one block as that of all; reading is no stage of its own."""

    def told(stage: str, done: int, total: int) -> None:
        if stage == "track":
            progress(stage, round(_STEPS * (number + done / total)), _STEPS * count)

    return told


def track_particles(
    scene: Scene,
    movie: FrameSource,
    camera: Camera,
    windows: Windows,
    *,
    check: Check,
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> Found:
    """Fit each frame after the background, starting from the frame before, and link.

    Parameters
    ----------
    scene : Scene
        Models and matched filter.
    movie : FrameSource
        The movie.
    camera : Camera
        Counts → photoelectrons.
    windows : Windows
        The background, and all frames after it summed.
    check : callable
        Refuses impossible counts.
    pool : ThreadPoolExecutor
        Runs the fits of a frame.
    progress : Progress
        Told the frames.

    Returns
    -------
    Found
        One row per particle and frame, numbered by track; one view per track.  An interrupt keeps
        the frames that are done.
    """
    first, last = windows.frames_after
    tables: list[pd.DataFrame] = []
    views: list[EventView] = []
    repeats: list[FloatArray] = []
    noise: FrameNoise | None = None
    events: tuple[Event, ...] = ()
    interrupted = False
    try:
        for frame in range(first, last):
            here = _one_frame(movie, camera, windows, frame, check, scene)
            starts = [event.candidate for event in events]
            events, here = fit_field(scene, here, starts=starts, pool=pool)
            rows = [Row(number, event, here) for number, event in enumerate(events)]
            if events and noise is None:
                read = camera.read_variance_e2((here.after_e.shape[0], here.after_e.shape[1]))
                noise = FrameNoise(scene, windows, read, [event.fit for event in events])
            if events and noise is not None:
                repeats += [noise.look(here, events)] * len(events)
            views += [view_of(row) for row in rows]
            tables.append(table_of(scene, rows))  # last: of what an interrupt cuts off, no row is
            progress("track", frame + 1 - first, last - first)
    except KeyboardInterrupt:
        interrupted = True
    table = pd.concat(tables, ignore_index=True) if tables else table_of(scene, [])
    views, repeats = views[: len(table)], repeats[: len(table)]
    track = scene.config.track
    table["event"] = link(
        table["frame"].to_numpy(), table[["x_nm", "y_nm"]].to_numpy(),
        reach_nm=track.max_step_nm, memory=track.memory_frames,
    )  # fmt: skip
    table["track"] = table["event"]
    seen: dict[int, EventView] = {}
    for track, view in zip(table["event"], views, strict=True):
        seen.setdefault(int(track), replace(view, event=int(track)))
    order = np.lexsort((table["frame"], table["event"]))
    return Found(
        table=table.iloc[order].reset_index(drop=True),
        views=tuple(seen[track] for track in sorted(seen)),
        windows=windows,
        interrupted=interrupted,
        repeats=tuple(repeats[row] for row in order),
        empty=noise.spread if noise else None,
    )


def _one_frame(
    movie: FrameSource,
    camera: Camera,
    windows: Windows,
    frame: int,
    check: Check,
    scene: Scene,
) -> Windows:
    counts = movie.read(frame, frame + 1)
    check(counts, frame)
    single = add_frames(windows, camera, counts, frame)
    return start_power(single) if scene.config.background.power_normalization else single
