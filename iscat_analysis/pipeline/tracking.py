"""Mode ``track``: every frame is fitted, and the positions are linked into tracks.

`track_movie` learns the background from the frames in which the particles move; `track_particles`
takes one that was recorded or is known.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis._kernels.moving import box_of
from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.inference.moving import Ground
from iscat_analysis.movie.background import Check, add_frames, start_power
from iscat_analysis.movie.camera import Camera
from iscat_analysis.pipeline.blank import FrameNoise
from iscat_analysis.pipeline.field import Event, fit_field
from iscat_analysis.pipeline.moving import Moving, follow
from iscat_analysis.pipeline.moving_table import common_masses, moving_table
from iscat_analysis.pipeline.results import Found, Row, table_of, view_of
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import EventView, FloatArray, FrameSource, Progress, Windows
from iscat_analysis.search.moving import link


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
    *,
    check: Check,
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> Found:
    """Track particles that are there in all frames, over a background learnt with them.

    Parameters
    ----------
    scene : Scene
        From `iscat_analysis.pipeline.moving.track_scene`.
    movie : FrameSource
        The movie.
    camera : Camera
        Counts → photoelectrons.
    check : callable
        Refuses impossible counts.
    pool : ThreadPoolExecutor
        Runs blocks of frames.
    progress : Progress
        Told the stages.

    Returns
    -------
    Found
        One row per particle and frame; one view per track, of its clearest frame.

    Raises
    ------
    DataError
        The frames are not there, or too few, or too many for the memory.
    """
    span = scene.config.fit.frames or (0, movie.shape[0])
    if span[1] > movie.shape[0]:
        raise DataError(
            f"{movie.name}: has {movie.shape[0]} frames, but fit.frames asks for "
            f"{span[0]}:{span[1]}; change fit.frames"
        )
    moving = follow(scene, movie, camera, span, check=check, pool=pool, progress=progress)
    table = moving_table(scene, moving, span[0])
    windows = _windows(moving, camera, span)
    views = []
    if len(table):
        best = table.loc[table.groupby("track")["snr"].idxmax()]
        views = [_view(moving, row, span[0]) for row in best.itertuples()]
    masses = common_masses(scene, moving)
    return Found(table=table, views=tuple(views), windows=windows, masses=masses)


def _windows(moving: Moving, camera: Camera, span: tuple[int, int]) -> Windows:
    """Put the background and the sum of all frames side by side."""
    field, ground = moving.field, moving.ground
    frames = field.frames
    read = frames * camera.read_variance_e2(field.used.shape)
    return Windows(
        before_e=ground.level * ground.power.sum(),
        after_e=field.counts_e.sum(axis=0, dtype=np.float64),
        n_before=frames,
        n_after=frames,
        power_ratio=1.0,
        read_variance_before_e2=read,
        read_variance_after_e2=read,
        masked=~field.used,
        saturated=np.zeros_like(field.used),
        frames_before=span,
        frames_after=span,
        power=np.concatenate([ground.power, ground.power]),
    )


def _view(moving: Moving, row: Any, first_frame: int) -> EventView:
    """Images of one row: what was measured, the model and what it leaves over."""
    field, frame = moving.field, int(row.frame) - first_frame
    rows = moving.rows
    mine = int(np.flatnonzero((rows.frame == frame) & (rows.track == row.track))[0])
    theta = rows.theta[mine]
    spans = [
        box_of(float(centre), field.pixel_nm, field.roi_px, size)
        for centre, size in zip((theta[1], theta[0]), field.used.shape, strict=True)
    ]
    cut = slice(*spans[0]), slice(*spans[1])
    others = rows.only(np.arange(len(rows.frame)) != mine)
    ground: Ground = moving.ground
    left, alone = (field.residual(ground, r, frame, frame + 1)[0][cut] for r in (rows, others))
    light = ground.power[frame] * ground.level[cut]
    used = field.used[cut]
    noise = np.sqrt(light + (alone - left) + field.read_e2[cut])
    blank = np.where(used, 1.0, np.nan)
    return EventView(
        event=int(row.track),
        row_px=spans[0][0],
        column_px=spans[1][0],
        contrast=blank * alone / light,
        model=(alone - left) / light,
        residual=blank * left / noise,
    )


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
