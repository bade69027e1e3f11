"""Mode ``track``: every frame is fitted, and the positions are linked into tracks.

`find_moving` learns the background from the frames in which the particles move, block by block;
`track_frames` takes one that was recorded or is known.

In dark field particles add their light to that of the background.  The background of a pixel that
is most likely, given the particles, is the mean of what the frames have beside these.  It is found
in turns: the median of the frames, the particles over it, the light beside the particles, and so on
until that stands still.  An image is that of the path during the exposure, with the median D of the
tracks.

Of particles on a membrane the height tells nothing that their masses do not, and a background that
is learnt with them may take rings for particles at other heights, until no row is described.  Then
some of the frames are followed once more with all heights where the configuration has them.  That
is a special case of heights that are free: where it describes what these do not, they were lost,
and not the optics wrong.  Particles that move along z turn their phase by half within 100 nm, and
no single height describes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path

import numpy as np
import pandas as pd

from iscat_analysis.camera import add_frames, start_power
from iscat_analysis.config import Config
from iscat_analysis.diagnosis import (
    Prepared,
    fixed_height_warning,
    misfit_warning,
    pattern_jitter_warning,
    pixel_warnings,
)
from iscat_analysis.errors import DataError
from iscat_analysis.findings import Finding, Findings
from iscat_analysis.findings.camera import MODEL_MISFITS
from iscat_analysis.findings.tracks import HEIGHTS_SEEM_FIXED, NO_PARTICLE_MOVES
from iscat_analysis.fitting.context import AnalysisContext
from iscat_analysis.fitting.events import Event, Region, contrast_image, photons_scale
from iscat_analysis.fitting.field import add_signal, fit_field
from iscat_analysis.fitting.ranges import checked, fitted_frames, measured_windows
from iscat_analysis.fitting.results import Compared, DetectionResult, Followed, lines_of, view_of
from iscat_analysis.fitting.run import RESUMPTION_HINT, Run, saying
from iscat_analysis.optics.forward import PixelGrid
from iscat_analysis.optics.model import PATH_SPREAD, blurred, path_variance_nm2
from iscat_analysis.records import (
    BoolArray,
    FloatArray,
    Progress,
    Status,
    Windows,
    is_event,
    make_rows,
    silent,
)
from iscat_analysis.search.frames import DARK, well_lit
from iscat_analysis.species.tracks import rows_by_track
from iscat_analysis.threads import start_in_thread, threads
from iscat_analysis.tracking.blocks import Block, BlockStore, analyse_block, join_blocks
from iscat_analysis.tracking.frames import (
    Plan,
    Recording,
    diffusion_of_positions,
    exposure_of,
    keep_frames,
    plan_blocks,
    refuse_few_frames,
    tracking_context,
)
from iscat_analysis.tracking.linking import link
from iscat_analysis.tracking.optics import TrialTracks, learn_from_tracks
from iscat_analysis.tracking.sizes import SphereTrack, sphere_track, table_of_sizes
from iscat_analysis.tracking.stages import find_rows_and_background
from iscat_analysis.tracking.table import loss_to_blur, moving_table
from iscat_analysis.tracking.tracks import mass_correlation
from iscat_analysis.trust.null_field import FrameNoise

_REJECTED = "|".join([Status.NOT_CONVERGED, Status.AT_BOUND, Status.POOR_FIT])


def held_height_warning(
    config: Config, recording: Recording, span: tuple[int, int], fits: pd.DataFrame
) -> Finding | None:
    """Find whether particles seem to stay at one height, where fits with free heights fail."""
    if not config.track.heights_free or not len(fits):
        return None
    first, last = span[0], min(span[1], span[0] + 200)
    free = _rejected(fits[fits["frame"].between(first, last - 1)])
    if free.size == 0 or free.mean() <= 0.5:
        return None
    config, movie = config.changed(track={"free": "mass"}), recording.movie
    context = tracking_context(config, (movie.shape[1], movie.shape[2]), last - first)
    try:
        quietly = replace(recording, progress=silent)
        moving = find_rows_and_background(context, quietly, (first, last))
    except DataError:  # nothing can be followed at one height
        return None
    held = _rejected(moving_table(context, moving, first)[moving.field.holds(moving.rows.theta)])
    # 30 rows tell; of membranes a hundredth of the rows is not described at their height
    if held.size < 30 or 2 * held.size < free.size or held.mean() > 0.25:
        return None
    values = {"free": int(free.sum()), "free_of": free.size, "fixed": int(held.sum())}
    height = {"fixed_of": held.size, "height_nm": context.model.height_nm}
    return HEIGHTS_SEEM_FIXED({**values, **height}, where=movie.name)


def _rejected(rows: pd.DataFrame) -> BoolArray:
    """Tell which rows the model does not describe."""
    return np.asarray(rows["flags"].fillna("").str.contains(_REJECTED), dtype=np.bool_)


def beside_particles(context: AnalysisContext, windows: Windows, fits: pd.DataFrame) -> FloatArray:
    """Give the light of all frames without that of the particles, for as many frames as before.

    Shapes: result (y, x) [e].
    """
    rows, columns = windows.after_e.shape
    field, signal = Region((0, rows), (0, columns)), np.zeros(windows.after_e.shape)
    known = is_event(fits) & fits["mass_kda"].notna() & fits["x_nm"].notna()
    for place in fits.loc[known, ["x_nm", "y_nm", "z_nm", "mass_kda"]].to_numpy(float).tolist():
        add_signal(context, tuple(place), field, signal)
    one = replace(windows, power_ratio=1 / windows.n_before)  # a frame of the usual light
    light = windows.after_e - photons_scale(context, one) * signal
    return np.asarray(np.maximum(light * windows.n_before / windows.n_after, 0.0))


def _path_variance_nm2(config: Config, fits: pd.DataFrame) -> float:
    """Median variance of the paths of long tracks about their means, in an exposure."""
    if config.camera.frame_rate_hz is None:
        return 0.0
    found: list[float] = []
    for rows in rows_by_track(fits).values():
        placed = rows.placed()
        if len(placed.frame) >= config.track.min_frames:
            found += [diffusion_of_positions(config, *placed.positions())[0]] * len(placed.frame)
    return path_variance_nm2(max(float(np.median(found or [0.0])), 0.0), exposure_of(config))


_STEPS = 100  # of the progress of a block


def find_moving(ready: Prepared, run: Run) -> DetectionResult:
    """Track particles over backgrounds that are learnt with them."""
    config, camera = ready.config, ready.camera
    additive = not config.optics.interferes
    kept = keep_frames(ready.steady, camera, fitted_frames(ready.steady, config), additive=additive)
    movie, (first, last) = kept.movie, kept.span
    run.report(kept.finding)
    run.clock.lap("model")
    check = checked(movie, camera)
    with threads(config.compute.workers) as pool:
        recording = Recording(movie, camera, check, pool, run.progress)
        find = _find_in_dark_field if additive else _find_in_blocks
        return kept.put_back(find(ready, run, recording, (first, last)))


def _find_in_blocks(
    ready: Prepared, run: Run, recording: Recording, span: tuple[int, int]
) -> DetectionResult:
    """Track particles that dim or brighten backgrounds, which are learnt block by block."""
    config, movie, camera = ready.config, recording.movie, recording.camera
    jitter_future = start_in_thread(pattern_jitter_warning, movie, camera, span)
    plan = plan_blocks(recording, config, span)
    jitter = jitter_future.result()
    run.report(plan.finding(movie.name), jitter and replace(jitter, where=movie.name))
    run.clock.lap("background")
    identity = ready.steady.identity if run.partial else ""
    shelves: list[BlockStore] = []

    def analysed(
        context: AnalysisContext, number: int, folder: Path | None, *, cautious: bool = False
    ) -> Block:
        """Load a finished block, or analyse it."""
        count, part = len(plan.spans), plan.spans[number]
        store = BlockStore(folder, context.config, identity, ready.shape, span, camera)
        shelves.append(store)
        source = recording
        if count > 1:
            source = replace(recording, progress=_part_of(recording.progress, number, count))
        block: Block | None = store.load(number)
        if block is not None and block.span == part:
            source.progress("track", 1, 1)
            return block
        goes_on = number > 0, number + 1 < count
        block = analyse_block(context, source, part, goes_on=goes_on, cautious=cautious)
        store.save(number, block)
        return block

    def begin(config: Config, *, cautious: bool = False) -> TrialTracks:
        context = tracking_context(config, ready.shape, max(span[1] - span[0], 1), ready.lines)
        folder = None if cautious else run.partial
        return TrialTracks(config, context, analysed(context, 0, folder, cautious=cautious))

    interrupted = False
    try:
        begun, learned = learn_from_tracks(
            config, begin, name=movie.name, pool=recording.pool, run=run
        )
        config, context, blocks = begun.config, begun.context, [begun.block]
        try:
            for number in range(1, len(plan.spans)):
                blocks.append(analysed(context, number, run.partial))
        except KeyboardInterrupt:
            run.progress("report", 0, 1)  # to gather and keep finished blocks takes a moment
            recording.pool.shutdown(wait=False, cancel_futures=True)
            interrupted = True
        joined = join_blocks(config, blocks)
        if not interrupted and not fixed_height_warning(config, joined.fits):
            run.report(held_height_warning(ready.config, recording, plan.spans[0], joined.fits))
    except KeyboardInterrupt as stop:
        raise saying(stop, _hint(shelves, plan)) from None
    windows = joined.followed.windows
    noise = () if jitter else blocks[0].noise
    run.report(*noise, *pixel_warnings(*windows.left_out))
    if not len(joined.fits) and not interrupted:
        run.report(_nothing_found(context, blocks[0], movie.name))
    run.clock.lap("track")
    return DetectionResult(
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


def _find_in_dark_field(
    ready: Prepared, run: Run, recording: Recording, span: tuple[int, int]
) -> DetectionResult:
    """Track particles that add their light to a background that is learnt with them.

    The background is found in turns, from the median of all frames.
    """
    config, frames = ready.config, span[1] - span[0]
    refuse_few_frames(recording.movie.name, frames)
    windows = measured_windows(
        recording.movie, config, ready.camera, span, span, progress=run.progress
    )
    run.clock.lap("background")
    context = sharp = tracking_context(config, ready.shape, frames, ready.lines)
    variance_nm2, upwards = 0.0, config.track.heights_free
    last: FloatArray | None = None
    for turn in range(12):
        told = Findings()  # only the last turn has the background
        found = track_frames(context, recording, windows, report=told.add)
        if found.interrupted:
            break
        ground = beside_particles(context, windows, found.fits)
        error = np.sqrt(np.maximum(ground + windows.read_variance_before_e2, 1.0))
        step = np.where(windows.masked, 0.0, (ground - windows.before_e) / error)
        # 0.3 σ of the mass of a track, if all of the change were its own
        if turn > 1 and math.sqrt(np.sum(step**2)) < 0.3:
            break
        if last is not None:  # turns come nearer by one factor each, as slowly as particles move
            factor = np.sum(step * last) / np.sum(last**2)
            # factors above 0.8 are not extrapolated
            step = step / (1 - min(max(factor, 0.0), 0.8))
        last = step if turn else None
        windows = replace(windows, before_e=np.maximum(windows.before_e + step * error, 0.0))
        variance_nm2 = _path_variance_nm2(config, found.fits)
        near, far = (
            blurred(model, variance_nm2, upwards=upwards) for model in (sharp.model, sharp.wide)
        )
        context = replace(sharp, model=near, wide=far)
    run.report(*told.made)
    run.clock.lap("track")
    fits = found.fits
    path = PATH_SPREAD * loss_to_blur(sharp, variance_nm2, upwards=upwards) * fits["mass_kda"].abs()
    wider = {name: np.hypot(fits[name], path) for name in ("sigma_mass_kda", "crb_mass_kda")}
    context = replace(sharp, mode="track", config=config)
    return replace(found, context=context, fits=fits.assign(**wider), repeats=(), empty=None)


def _hint(shelves: Sequence[BlockStore], plan: Plan) -> str:
    """Say whether a block was finished, from which the same command resumes."""
    if any(shelf.kept for shelf in shelves):
        return RESUMPTION_HINT
    parts = f"in {len(plan.spans)} of them, of which the first is not"
    if len(plan.spans) == 1:
        parts = f"in one of {plan.frames} frames, which is not"
    return (
        "nothing is kept, and the same command begins anew: tracks are kept when a block of "
        f"frames is done, and this movie is analysed {parts}"
    )


def _nothing_found(context: AnalysisContext, block: Block, name: str) -> Finding:
    """Compare the signal of a particle with the noise of a frame, where no particle was found."""
    model, grid = context.model, PixelGrid.centred(context.roi_px | 1, context.pixel_nm)
    light, mass = block.level_e, model.material.mass_kda
    signal = model.image(grid, 0.0, 0.0, model.height_nm, mass)
    snr = math.sqrt(light * float(np.sum(signal**2)))
    values = {"light_e": light, "mass_kda": mass, "snr": snr}
    return NO_PARTICLE_MOVES({**values, "threshold": context.templates.threshold}, where=name)


def _part_of(progress: Progress, number: int, count: int) -> Progress:
    """Report the progress of one block as progress of all blocks."""

    def of_all(stage: str, done: int, total: int) -> None:
        if stage == "track":
            progress(stage, round(_STEPS * (number + done / total)), _STEPS * count)

    return of_all


def track_frames(
    context: AnalysisContext,
    recording: Recording,
    windows: Windows,
    *,
    doubt: str = "",
    report: Callable[[Finding], None],
) -> DetectionResult:
    """Fit each frame after the background, starting from the frame before, and link."""
    movie, camera, (first, last) = recording.movie, recording.camera, windows.frames_after
    found: list[Event] = []
    repeats: list[FloatArray] = []
    noise: FrameNoise | None = None
    events: tuple[Event, ...] = ()
    interrupted = False
    shown = np.ones(last - first, dtype=np.bool_)
    if not context.additive:
        shown = well_lit(windows.power, DARK)[-shown.size :]
    try:
        for frame in (first + np.flatnonzero(shown)).tolist():
            counts = movie.read(frame, frame + 1)
            recording.check(counts, frame)
            here = add_frames(windows, camera, counts, frame)
            if context.config.background.power_normalization:
                here = start_power(here)
            starts = [event.candidate for event in events]
            events, here = fit_field(context, here, starts=starts, pool=recording.pool)
            if events and noise is None:
                if cause := misfit_warning(context.config, events):
                    report(MODEL_MISFITS({"cause": cause}))
                elif doubt:
                    _refuse_pattern(doubt, frame, events)
                read = camera.read_variance_e2((here.after_e.shape[0], here.after_e.shape[1]))
                noise = FrameNoise(context, windows, read, [event.fit for event in events])
            if events and noise is not None:
                repeats += [noise.look(here, events)] * len(events)
            found += events
            recording.progress("track", frame + 1 - first, last - first)
    except KeyboardInterrupt:
        interrupted = True
    track = context.config.track
    places = np.array([event.place[:2] for event in found]).reshape(-1, 2)
    frames = np.array([event.frame for event in found], dtype=np.int64)
    numbers = link(frames, places, reach_nm=track.max_step_nm, memory=track.memory_frames)
    order = np.lexsort((frames, numbers))
    own, found = numbers[order], [found[k] for k in order]
    tracked: dict[int, SphereTrack] = {}
    sized = context.model.is_sized
    if sized:  # all frames of a track tell its diameter together
        for number in np.unique(own).tolist():
            mine = list(compress(found, own == number))
            tracked[number] = sphere_track(context, mine, recording.pool)
        found = [event for one in tracked.values() for event in one.events]
    fits = make_rows(lines_of(context, found), {"event": own, "track": own})
    masses = table_of_sizes(tracked, mass_correlation(context, fits)) if sized else None
    firsts = np.unique(own, return_index=True)[1].tolist()
    return DetectionResult(
        context=context,
        fits=fits,
        views=tuple(view_of(int(own[k]), found[k]) for k in firsts),
        image=contrast_image(context, windows),
        compared=Compared.of(windows),
        summary={},
        repeats=tuple(repeats[row] for row in order),
        empty=noise.spread if noise else None,
        followed=Followed(windows, masses=masses),
        interrupted=interrupted,
    )


def _refuse_pattern(doubt: str, frame: int, events: Sequence[Event]) -> None:
    """Refuse a movie in which the fixed pattern was found instead of particles."""
    poor = sum(Status.POOR_FIT in event.flags for event in events)
    # 6 places of a frame, of which 0.8 are no particles, are taken for the light's unevenness
    if len(events) >= 6 and poor >= 0.8 * len(events):
        raise DataError(
            f"of {len(events)} places in frame {frame} that look like particles {poor} do not look "
            f"like the model's picture, and would be followed through all frames: {doubt}"
        )
