"""Mode ``track``: every frame is fitted on its own, then the positions are linked into tracks."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pandas as pd

from iscat_analysis.movie.background import Check, add_frames, start_power
from iscat_analysis.movie.camera import Camera
from iscat_analysis.pipeline.blank import FrameNoise
from iscat_analysis.pipeline.field import Event, fit_field
from iscat_analysis.pipeline.results import Found, Row, table_of, view_of
from iscat_analysis.pipeline.scene import Scene
from iscat_analysis.records import EventView, FloatArray, FrameSource, Progress, Windows

MEMORY = 3
"""Frames a particle may be missed in without losing its track."""


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
    table["event"] = _link(table, scene.config.detection.min_separation_nm)
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


def _link(table: pd.DataFrame, reach_nm: float) -> pd.Series[int]:
    """Track number of every row; a particle moves less than `reach_nm` between frames."""
    if table.empty:
        return table["event"]
    import trackpy

    logging.getLogger("trackpy").setLevel(logging.WARNING)  # it reports every frame
    frames = range(int(table["frame"].min()), int(table["frame"].max()) + 1)
    rows = [np.flatnonzero(table["frame"] == frame) for frame in frames]
    places = table[["x_nm", "y_nm"]].to_numpy()
    linked = trackpy.link_iter(
        ((frame, places[here]) for frame, here in zip(frames, rows, strict=True)),
        search_range=reach_nm,
        memory=MEMORY,
    )
    tracks = pd.Series(0, index=table.index)
    for here, (_, numbers) in zip(rows, linked, strict=True):
        tracks.iloc[here] = numbers
    return tracks
