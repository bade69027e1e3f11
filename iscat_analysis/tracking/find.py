"""Mode ``track``: every frame is fitted, and the positions are linked into tracks.

`find_moving` learns the background from the frames in which the particles move, block by block;
`track_frames` takes one that was recorded or is known.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from iscat_analysis.camera import Camera, Check, add_frames, start_power
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import (
    Prepared,
    fixed_height_warning,
    misfit_warning,
    pattern_jitter_warning,
    pixel_warnings,
)
from iscat_analysis.errors import DataError
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event, contrast_image
from iscat_analysis.fitting.field import fit_field
from iscat_analysis.fitting.ranges import checked, fitted_frames, measured_windows
from iscat_analysis.fitting.results import Compared, DetectionResult, Followed, lines_of, view_of
from iscat_analysis.fitting.run import RESUMPTION_HINT, Run, saying
from iscat_analysis.movie import Stack
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.records import (
    CountSource,
    EventView,
    FloatArray,
    FrameSource,
    Progress,
    Status,
    Windows,
    make_rows,
)
from iscat_analysis.search.frames import DARK, well_lit
from iscat_analysis.threads import start_in_thread, threads
from iscat_analysis.tracking.block_store import Block, BlockStore, analyse_block
from iscat_analysis.tracking.blocks import Plan, plan_blocks
from iscat_analysis.tracking.dark_field import in_turns
from iscat_analysis.tracking.frame_search import link
from iscat_analysis.tracking.frame_subset import keep_frames
from iscat_analysis.tracking.held_height import held_height_warning
from iscat_analysis.tracking.joining import join_blocks
from iscat_analysis.tracking.moving_field import refuse_few_frames, tracking_context
from iscat_analysis.tracking.sizes import sphere_track, table_of_sizes
from iscat_analysis.tracking.tracked_optics import TrialTracks, learn_from_tracks
from iscat_analysis.tracking.tracks import mass_correlation
from iscat_analysis.trust.null_field import FrameNoise

_STEPS = 100  # of the progress of a block
_PATTERN = 6  # places in a frame that are taken for the light's unevenness,
_PATTERN_SHARE = 0.8  # where so many of them are no particles


def find_moving(ready: Prepared, run: Run) -> DetectionResult:
    """Track particles over backgrounds that are learnt with them."""
    config, camera = ready.config, ready.camera
    additive = config.optics.scheme == "darkfield"
    span = fitted_frames(ready.steady, config)
    kept = keep_frames(ready.steady, camera, span, additive=additive)
    movie, (first, last) = kept.movie, kept.span
    if kept.message:
        run.warn(kept.message)
    run.clock.lap("model")
    check = checked(movie, camera)
    if additive:
        return kept.put_back(_find_in_dark_field(ready, run, movie, (first, last)))
    jitter_future = start_in_thread(pattern_jitter_warning, movie, camera, (first, last))
    with threads(config.compute.workers) as pool:
        plan = plan_blocks(movie, config, camera, check=check, span=kept.span, mapper=pool.map)
    if message := plan.message(movie.name):
        run.warn(message)
    jitter_warning = jitter_future.result()
    if jitter_warning is not None:
        run.report(replace(jitter_warning, where=movie.name))
    run.clock.lap("background")
    identity = ready.steady.identity if run.partial else ""
    shelves: list[BlockStore] = []

    def shelf(config: Config, folder: Path | None) -> BlockStore:
        shelves.append(BlockStore(folder, config, identity, ready.shape, (first, last), camera))
        return shelves[-1]

    with _with_resumption_hint(shelves, plan), threads(config.compute.workers) as pool:

        def begin(config: Config, *, cautious: bool = False) -> TrialTracks:
            context = tracking_context(config, ready.shape, max(last - first, 1), ready.lines)
            block = _analysed(
                context, movie, camera, plan, shelf(config, None if cautious else run.partial), 0,
                check=check, pool=pool, progress=run.progress, cautious=cautious,
            )  # fmt: skip
            return TrialTracks(config, context, block)

        begun, learned = learn_from_tracks(
            config, begin, name=movie.name, pool=pool, warn=run.warn, notify=run.notify
        )
        config, context = begun.config, begun.context
        blocks, interrupted = track_movie(
            context, movie, camera, plan, shelf(config, run.partial),
            check=check, pool=pool, progress=run.progress, first=begun.block,
        )  # fmt: skip
        joined = join_blocks(config, blocks, camera)
        if not interrupted and not fixed_height_warning(
            config, joined.fits
        ):  # which says it already
            held = held_height_warning(
                ready.config, movie, camera, plan.spans[0], joined.fits, check=check, pool=pool
            )
            if held:
                run.warn(held)
    windows = joined.followed.windows
    for text in () if jitter_warning else blocks[0].noise:
        run.warn(text)
    run.report(*pixel_warnings(*windows.left_out))
    if not len(joined.fits) and not interrupted:
        run.warn(f"{movie.name}: {_no_particle_message(context, blocks[0])}")
    run.clock.lap("track")
    found = DetectionResult(
        context=replace(context, mode="track", config=config),
        fits=joined.fits,
        views=joined.views,
        image=windows.after_e / windows.before_e - 1,
        compared=Compared.of(windows),
        summary=plan.summary,
        followed=joined.followed,
        optics=learned,
        interrupted=interrupted,
    )
    return kept.put_back(found)


def _find_in_dark_field(
    ready: Prepared, run: Run, movie: Stack, span: tuple[int, int]
) -> DetectionResult:
    """Track particles that add their light to a background that is learnt with them."""
    config, camera, frames = ready.config, ready.camera, span[1] - span[0]
    refuse_few_frames(movie.name, frames)
    windows = measured_windows(movie, config, camera, span, span, progress=run.progress)
    run.clock.lap("background")
    said: list[str] = []
    with threads(config.compute.workers) as pool:

        def track(context: AnalysisContext, windows: Windows) -> DetectionResult:
            said.clear()  # only the last turn has the background
            return track_frames(
                context, movie, camera, windows, {},
                check=checked(movie, camera), pool=pool, progress=run.progress, warn=said.append,
            )  # fmt: skip

        context = tracking_context(config, ready.shape, frames, ready.lines)
        found = in_turns(config, context, windows, track)
    for text in said:
        run.warn(text)
    run.clock.lap("track")
    return found


@contextmanager
def _with_resumption_hint(shelves: Sequence[BlockStore], plan: Plan) -> Iterator[None]:
    """Add to an interrupt whether a block was finished, from which the same command resumes."""
    try:
        yield
    except KeyboardInterrupt as stop:
        if any(shelf.kept for shelf in shelves):
            raise saying(stop, RESUMPTION_HINT) from None
        parts = f"in {len(plan.spans)} of them, of which the first is not"
        if len(plan.spans) == 1:
            parts = f"in one of {plan.frames} frames, which is not"
        nothing = (
            "nothing is kept, and the same command begins anew: tracks are kept when a block of "
            f"frames is done, and this movie is analysed {parts}"
        )
        raise saying(stop, nothing) from None


def _no_particle_message(context: AnalysisContext, block: Block) -> str:
    """Say why a movie may show no particle: compare its signal with the noise of a frame."""
    model, grid = context.model, PixelGrid.centred(context.roi_px | 1, context.pixel_nm)
    light, mass = float(block.level[block.used].mean()), model.material.mass_kda
    signal = model.image(grid, 0.0, 0.0, model.height_nm, mass)
    height = math.sqrt(light * float(np.sum(signal**2)))
    return (
        f"no particle was found: with {light:.3g} e per pixel and frame, a particle of "
        f"particle.mass_kda = {mass:.4g} has a signal-to-noise ratio of {height:.2g} in a frame, "
        f"and the threshold is {context.templates.threshold:.2g}; if there are particles, record "
        "with more light, or longer exposures"
    )


def track_movie(
    context: AnalysisContext,
    movie: CountSource,
    camera: Camera,
    plan: Plan,
    store: BlockStore,
    *,
    check: Check,
    pool: ThreadPoolExecutor,
    progress: Progress,
    first: Block | None = None,
) -> tuple[list[Block], bool]:
    """Track particles that are there in all frames, over backgrounds learnt with them."""
    blocks: list[Block] = [] if first is None else [first]
    interrupted = False
    try:
        for number in range(len(blocks), len(plan.spans)):
            block = _analysed(
                context, movie, camera, plan, store, number,
                check=check, pool=pool, progress=progress,
            )  # fmt: skip
            blocks.append(block)
    except KeyboardInterrupt:
        if not blocks:
            raise
        progress("report", 0, 1)  # what was finished is now gathered and kept, which takes a moment
        pool.shutdown(wait=False, cancel_futures=True)
        interrupted = True
    return blocks, interrupted


def _analysed(
    context: AnalysisContext,
    movie: CountSource,
    camera: Camera,
    plan: Plan,
    store: BlockStore,
    number: int,
    *,
    check: Check,
    pool: ThreadPoolExecutor,
    progress: Progress,
    cautious: bool = False,
) -> Block:
    """Load a finished block, or analyse it."""
    count, span = len(plan.spans), plan.spans[number]
    block_progress = progress if count == 1 else _part_of(progress, number, count)
    block: Block | None = store.load(number)
    if block is not None and block.span == span:
        block_progress("track", 1, 1)
        return block
    block = analyse_block(
        context, movie, camera, span,
        goes_on=(number > 0, number + 1 < count),
        check=check, pool=pool, progress=block_progress, cautious=cautious,
    )  # fmt: skip
    store.save(number, block)
    return block


def _part_of(progress: Progress, number: int, count: int) -> Progress:
    """Report the progress of one block as progress of all blocks."""

    def of_all(stage: str, done: int, total: int) -> None:
        if stage == "track":
            progress(stage, round(_STEPS * (number + done / total)), _STEPS * count)

    return of_all


def track_frames(
    context: AnalysisContext,
    movie: FrameSource,
    camera: Camera,
    windows: Windows,
    summary: Mapping[str, Any],
    *,
    check: Check,
    pool: ThreadPoolExecutor,
    progress: Progress,
    doubt: str = "",
    warn: Callable[[str], None],
) -> DetectionResult:
    """Fit each frame after the background, starting from the frame before, and link."""
    first, last = windows.frames_after
    lines: list[dict[str, Any]] = []
    views: list[EventView] = []
    repeats: list[FloatArray] = []
    noise: FrameNoise | None = None
    events: tuple[Event, ...] = ()
    spheres: list[Event] = []  # whose diameters all frames tell together
    interrupted = False
    shown = np.ones(last - first, dtype=np.bool_)
    if not context.additive:
        shown = well_lit(windows.power, DARK)[-shown.size :]
    try:
        for frame in (first + np.flatnonzero(shown)).tolist():
            here = _one_frame(movie, camera, windows, frame, check, context)
            starts = [event.candidate for event in events]
            events, here = fit_field(context, here, starts=starts, pool=pool)
            if events and noise is None:
                if cause := misfit_warning(context.config, events):
                    warn(cause)
                elif doubt:
                    _refuse_pattern(doubt, frame, events)
                read = camera.read_variance_e2((here.after_e.shape[0], here.after_e.shape[1]))
                noise = FrameNoise(context, windows, read, [event.fit for event in events])
            if events and noise is not None:
                repeats += [noise.look(here, events)] * len(events)
            views += [view_of(number, event) for number, event in enumerate(events)]
            spheres += events if context.model.is_sized else ()
            lines += lines_of(context, events)  # last, so that an interrupted frame has no rows
            progress("track", frame + 1 - first, last - first)
    except KeyboardInterrupt:
        interrupted = True
    track = context.config.track
    places = np.array([(line["x_nm"], line["y_nm"]) for line in lines]).reshape(-1, 2)
    frames = np.array([line["frame"] for line in lines], dtype=np.int64)
    numbers = link(frames, places, reach_nm=track.max_step_nm, memory=track.memory_frames)
    order = np.lexsort((frames, numbers))
    own = numbers[order]
    masses: pd.DataFrame | None = None
    if context.model.is_sized:
        tracked = {
            number: sphere_track(context, [spheres[k] for k in order[own == number]], pool)
            for number in np.unique(own).tolist()
        }
        again = [event for track in tracked.values() for event in track.events]
        for k, event, line in zip(order, again, lines_of(context, again), strict=True):
            lines[k], views[k] = line, view_of(0, event)
    fits = make_rows([lines[k] for k in order], {"event": own, "track": own})
    if context.model.is_sized:
        masses = table_of_sizes(tracked, mass_correlation(context, fits))
    seen: dict[int, EventView] = {}
    for number, view in zip(numbers.tolist(), views[: len(lines)], strict=True):
        if number not in seen:
            seen[number] = replace(view, event=number)
    return DetectionResult(
        context=context,
        fits=fits,
        views=tuple(seen[number] for number in sorted(seen)),
        image=contrast_image(context, windows),
        compared=Compared.of(windows),
        summary=summary,
        repeats=tuple(repeats[row] for row in order),
        empty=noise.spread if noise else None,
        followed=Followed(windows, masses=masses),
        interrupted=interrupted,
    )


def _refuse_pattern(doubt: str, frame: int, events: Sequence[Event]) -> None:
    """Refuse a movie in which the fixed pattern was found instead of particles."""
    poor = sum(Status.POOR_FIT in event.flags for event in events)
    if len(events) >= _PATTERN and poor >= _PATTERN_SHARE * len(events):
        raise DataError(
            f"of {len(events)} places in frame {frame} that look like particles {poor} do not look "
            f"like the model's picture, and would be followed through all frames: {doubt}"
        )


def _one_frame(
    movie: FrameSource,
    camera: Camera,
    windows: Windows,
    frame: int,
    check: Check,
    context: AnalysisContext,
) -> Windows:
    counts = movie.read(frame, frame + 1)
    check(counts, frame)
    single = add_frames(windows, camera, counts, frame)
    return start_power(single) if context.config.background.power_normalization else single
