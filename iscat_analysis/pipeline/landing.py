"""Landing movies: particles land and leave at unknown times and places, and the windows slide.

The movie is read once, in chunks that fit into memory.  A chunk has a core, whose steps are its
own, and three windows of frames on either side, so that every step in the core is seen with all
its neighbours.  A step on the seam may be dated on either side of it: both chunks report what lies
near it, and the one whose core holds it is believed.  Chunks depend on the movie and the
configuration alone, so a finished one can be kept on disk and a resumed run gives the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.errors import DataError
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.inference.prior import Prior
from iscat_analysis.movie.camera import Camera
from iscat_analysis.movie.drift import Trajectory
from iscat_analysis.movie.lines import Lines, SteadyFrames
from iscat_analysis.movie.spectrum import NoiseSpectrum
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.pipeline.chunks import (
    FRAME_COLUMN,
    REPEATS_COLUMN,
    VIEWS,
    Done,
    Merged,
    Reader,
    counts_budget,
    judge_noise,
    plan_chunks,
)
from iscat_analysis.pipeline.diagnosis import DRIFT_PX, misfit_warning
from iscat_analysis.pipeline.injection import InjectedMovie, draw_particles, recovery
from iscat_analysis.pipeline.pattern import follow
from iscat_analysis.pipeline.results import Row, table_of, view_of
from iscat_analysis.pipeline.resume import Store
from iscat_analysis.pipeline.scene import (
    Scene,
    reported_steps,
    search_both,
    square_model,
    square_of,
)
from iscat_analysis.pipeline.steps import ChunkFitter, FittedStep
from iscat_analysis.records import (
    FREE_PARAMETERS,
    CountSource,
    EventView,
    FloatArray,
    Progress,
    Status,
    Windows,
)
from iscat_analysis.search.empty import EmptySpread
from iscat_analysis.search.sliding import CORRELATION, STRIDES, Chunk, boundaries, stride_of
from iscat_analysis.search.templates import LARGEST_IMAGE, make_templates
from iscat_analysis.threads import threads

POSTERIORS = 20
"""Events whose posterior is sampled, where the configuration asks for it."""

JUMP = 0.1
"""Relative change of the light from one frame to the next that is reported."""

Tell = Callable[[str], None]


def _nothing(scene: Scene) -> None:
    """Do nothing."""


@dataclass(frozen=True)
class LandingResult:
    """What was found in a landing movie.

    Attributes
    ----------
    table : pandas.DataFrame
        One row per step, in order of frame: columns `EVENT_COLUMNS` and `FRAME_COLUMN`.
    views : tuple of EventView
        Images of the first `VIEWS` events.
    windows : Windows
        Masks and the power of every frame; its sums are empty.
    image : ndarray, shape (y, x)
        Contrast of the strongest step that each pixel saw, by the matched filter.
    scene : Scene
        Models and threshold.
    repeats : tuple of ndarray
        What parts of the frames of each event say; from `iscat_analysis.inference.repeats`.
    empty : EmptySpread or None
        The noise of whole windows where nothing lands or leaves.
    summary : dict
        What ``summary.json`` adds under ``"landing"``.
    trajectory : Trajectory or None
        Of the fixed pattern, where its motion was divided out.
    interrupted : bool
        Whether the user stopped it; the chunks that were finished are kept.
    """

    table: pd.DataFrame
    views: tuple[EventView, ...]
    windows: Windows
    image: FloatArray
    scene: Scene
    repeats: tuple[FloatArray, ...]
    empty: EmptySpread | None
    summary: dict[str, Any]
    trajectory: Trajectory | None
    interrupted: bool


def has_landings(config: Config) -> bool:
    """Whether a configuration describes a movie in which the windows slide.

    Parameters
    ----------
    config : Config
        Without background frames, interferometric, not to be tracked.

    Returns
    -------
    bool
        Whether `analyse_landings` is the way to analyse it.
    """
    return (
        config.background.method == "sliding"
        and config.optics.scheme != "darkfield"
        and config.fit.mode != "track"
        and config.fit.likelihood != "poisson"
    )


def analyse_landings(
    movie: CountSource,
    config: Config,
    camera: Camera,
    *,
    tell: Tell,
    progress: Progress,
    prepare: Callable[[Scene], None] = _nothing,
    partial: Path | None = None,
    identity: str = "",
    lines: Lines | None = None,
) -> LandingResult:
    """Find and fit every particle that lands or leaves.

    Parameters
    ----------
    movie : CountSource
        The movie.
    config : Config
        Resolved; `has_landings` holds.
    camera : Camera
        Counts → photoelectrons.
    tell : callable
        Told what the user should know, one line each.
    progress : Progress
        Told how many frames are done.
    prepare : callable
        Given the models before the first fit.
    partial : Path, optional
        Folder that keeps finished chunks; who gave it removes it once the result is safe.
    identity : str
        What tells the movie's content from another's; finished chunks of another are not used.
    lines : Lines, optional
        Rows and columns that flicker; they are divided by their light as frames are read.

    Returns
    -------
    LandingResult
        Everything found.

    Raises
    ------
    DataError
        The movie is shorter than two windows, a frame is impossible, or the chunks do not fit into
        ``compute.memory_limit_mb``.
    """
    first, last = config.fit.frames or (0, movie.shape[0])
    if last > movie.shape[0]:
        raise DataError(
            f"{movie.name}: has {movie.shape[0]} frames, but fit.frames asks for {first}:{last}; "
            "change fit.frames"
        )
    frames = movie if lines is None else SteadyFrames(movie, lines, camera)
    reader = Reader(frames, camera, first, last, counts_budget(config))
    with threads(config.compute.workers) as pool:
        noise = judge_noise(reader, config, pool.map)
    curve, window = noise.curve, noise.window
    if noise.spectrum is not None and noise.spectrum.message:
        tell(f"{movie.name}: {noise.spectrum.message}")
    if noise.gain_message:
        tell(noise.gain_message)
    stride = stride_of(window)
    count = boundaries(last - first, window)
    posterior = config.samples_posterior
    sampling = config.posterior.model_copy(update={"enabled": posterior})
    config = config.model_copy(update={"posterior": sampling})
    scene = make_landing_scene(
        config, reader.shape, searches=count, noise=noise.spectrum, lines=lines
    )
    prepare(scene)
    plan = plan_chunks(reader, config, window, stride)
    store = Store(partial, config, identity, reader.shape, (first, last), camera)
    merged = Merged(reader.shape)
    interrupted = False
    with threads(config.compute.workers) as pool:
        try:
            for number, (core, span) in enumerate(plan):
                done = None if posterior else store.load(number)
                if done is None:
                    chunk = reader.chunk(span, stride, pool)
                    budget = POSTERIORS - merged.sampled if posterior else 0
                    done = _analyse_chunk(scene, chunk, core, window, pool, budget, noise.excess)
                    store.save(number, done)
                merged.add(done)
                progress("landing", core[1] - first, last - first)
                if done.stopped:
                    interrupted = True
                    break
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            interrupted = True
    table, views = merged.result(scene)
    shape = (-1, len(FREE_PARAMETERS[scene.mode]) + 1)
    repeats = tuple(np.reshape(flat, shape) for flat in table.pop(REPEATS_COLUMN))
    windows, light = merged.windows(reader.shape, (first, last))
    wanted = config.background.drift_correction
    for text in frame_warnings(movie.name, merged, light, first, window, corrected=wanted):
        tell(text)
    if merged.cause:
        tell(f"{movie.name}: {merged.cause}")
    if not config.background.power_normalization:
        tell(
            "background.power_normalization = false has no effect on a landing movie: each frame "
            "is weighed by its own light"
        )
    counted = table[table["status"] != Status.SIDELOBE]
    left = counted["mass_kda"] < 0
    summary = {
        "window_frames": window,
        "stride_frames": stride,
        "boundaries_searched": count,
        "landings": int((~left).sum()),
        "leavings": int(left.sum()),
        "shot_noise_limited_frames": curve.shot_limited,
        "noise_frames": list(curve.frames),
        "noise_variance_over_shot": list(curve.variance_over_shot),
        "noise_spectrum": noise.spectrum.summary if noise.spectrum else None,
        "frames_left_out": merged.left_out(),
        "drift_px": merged.drift(),
        **_way(merged.trajectory()),
        "chunks": len(plan),
    }
    strongest = scene.model.peak_contrast(scene.model.height_nm, scene.model.material.mass_kda)
    amplitude = scene.model.scale.amplitude(scene.model.material.mass_kda)
    return LandingResult(
        table=table,
        views=views,
        windows=windows,
        image=merged.image * strongest / amplitude,
        scene=scene,
        repeats=repeats,
        empty=merged.empty,
        summary=summary,
        trajectory=merged.trajectory(),
        interrupted=interrupted,
    )


def inject_and_recover(
    movie: CountSource,
    config: Config,
    camera: Camera,
    result: LandingResult,
    count: int,
    *,
    progress: Progress,
) -> dict[str, Any]:
    """Add known particles to a movie, analyse it again and compare.

    Parameters
    ----------
    movie : CountSource
        The movie.
    config : Config
        As it was analysed.
    camera : Camera
        Counts → photoelectrons.
    result : LandingResult
        What was found without them: their masses are drawn from it.
    count : int
        Particles.
    progress : Progress
        Told how far it is.

    Returns
    -------
    dict
        From `iscat_analysis.pipeline.injection.recovery`.

    Raises
    ------
    KeyboardInterrupt
        The user stopped it: half of a search says nothing of what is found.
    """
    frames = config.fit.frames or (0, movie.shape[0])
    window = int(result.summary["window_frames"])
    fixed = config.background.model_copy(update={"window_frames": window})
    seed = config.compute.seed
    particles = draw_particles(
        result.scene, (movie.shape[1], movie.shape[2]), frames, window, count, result.table, seed
    )
    again = analyse_landings(
        InjectedMovie(movie, camera, particles, seed, result.trajectory),
        config.model_copy(update={"background": fixed}),
        camera,
        tell=_unheard,
        progress=progress,
        lines=result.scene.lines,
    )
    if again.interrupted:
        raise KeyboardInterrupt
    return recovery(
        particles,
        again.table[again.table["status"] != Status.SIDELOBE],
        frames[1],
        result.scene.roi_px / 2,
        window,
        sign=reported_steps(result.scene),
        threshold=result.scene.templates.threshold,
    )


def _way(trajectory: Trajectory | None) -> dict[str, Any]:
    """Give what the summary says of a trajectory."""
    if trajectory is None:
        return {
            "drift_corrected": False,
            **dict.fromkeys(("drift_frames", "drift_x_px", "drift_y_px", "drift_error_px")),
        }
    return {
        "drift_corrected": True,
        "drift_frames": trajectory.frames.tolist(),
        "drift_x_px": trajectory.shift_px[:, 1].tolist(),
        "drift_y_px": trajectory.shift_px[:, 0].tolist(),
        "drift_error_px": trajectory.typical_error_px,
    }


def _unheard(text: str) -> None:
    """Say nothing: the user has been told already."""


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


def _analyse_chunk(
    scene: Scene,
    chunk: Chunk,
    core: tuple[int, int],
    window: int,
    pool: ThreadPoolExecutor,
    posteriors: int,
    excess_noise: str,
) -> Done:
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
        views=tuple(_view(row, step) for row, step in zip(rows, steps, strict=True))[:VIEWS],
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
    return replace(view, row_px=step.region.rows[0], column_px=step.region.columns[0])


def frame_warnings(
    name: str,
    merged: Merged,
    light: FloatArray,
    first: int,
    window: int,
    *,
    corrected: bool = False,
) -> Iterator[str]:
    """Say what is odd about the frames.

    Parameters
    ----------
    name : str
        What the lines call the movie.
    merged : Merged
        The chunks.
    light : ndarray, shape (t,)
        Light of every frame; NaN where it was left out.
    first : int
        Number of the first frame.
    window : int
        Frames before and after a step.
    corrected : bool
        Whether the motion of the fixed pattern was to be divided out.

    Yields
    ------
    str
        One line each.
    """
    missing = merged.repeats() + first
    if missing.size:
        verb = "is" if missing.size == 1 else "are"
        yield (
            f"{name}: {_frames(missing)} {verb} zero throughout, not finite or the same as the "
            "frame before (dropped or stuck in the camera); left out, the other frames are used"
        )
    known = np.flatnonzero(np.isfinite(light))
    change = light[known][1:] / light[known][:-1] - 1
    if change.size:
        usual = 1.4826 * float(np.median(np.abs(change)))
        jumps = known[1:][np.abs(change) > max(JUMP, 8 * usual)] + first
        if jumps.size:
            largest = 100 * float(change[np.argmax(np.abs(change))])
            yield (
                f"{name}: the brightness jumps at {_frames(jumps)} by up to {largest:+.0f} %; "
                "it is divided out, but look at the laser and at events in these frames"
            )
    defects, burnt = merged.masks()
    if defects:
        yield f"{defects} dead or hot pixels are left out"
    if burnt:
        yield (
            f"{burnt} pixels are saturated in some frame and left out; "
            "lower the exposure or the laser power"
        )
    yield from _drift_warnings(name, merged, light.size / window, corrected)


def _drift_warnings(name: str, merged: Merged, windows: float, corrected: bool) -> Iterator[str]:
    """Say how the fixed pattern moved, and what was done about it."""
    drift, way = merged.drift(), merged.trajectory()
    if way is not None and drift is not None:
        yield (
            f"{name}: the fixed pattern moved by {drift[1]:+.3f} pixels in x and "
            f"{drift[0]:+.3f} in y; corrected, to ±{way.typical_error_px:.1g} pixels"
        )
    unfollowed = merged.unfollowed() if corrected else []
    if unfollowed:
        spans = ", ".join(f"{a}:{b}" for a, b in unfollowed[:4])
        yield (
            f"{name}: no fixed pattern stands out of the noise in frames {spans}"
            f"{' and more' if len(unfollowed) > 4 else ''}, so background.drift_correction has "
            "nothing to correct there"
        )
    if corrected or drift is None:
        return
    if math.hypot(*drift) > DRIFT_PX * max(windows / 2, 1.0):
        yield (
            f"{name}: the fixed pattern moved by {drift[1]:+.2f} pixels in x and "
            f"{drift[0]:+.2f} in y; it is not corrected: set background.drift_correction = true "
            "(shorter windows, background.window_frames, suffer less too)"
        )


def _frames(frames: NDArray[np.int64]) -> str:
    shown = ", ".join(str(f) for f in frames[:4])
    more = f" and {frames.size - 4} more" if frames.size > 4 else ""
    return f"frame{'' if frames.size == 1 else 's'} {shown}{more}"
