"""Landing movies: particles land and leave at unknown times and places, and the windows slide.

The movie is read once, in chunks that fit into memory.  A chunk has a core, whose steps are its
own, and three windows of frames on either side, so that every step in the core is seen with all
its neighbours.  A step on the seam may be dated on either side of it: both chunks report what lies
near it, and the one whose core holds it is believed.  Chunks depend on the movie and the
configuration alone, so a finished one can be kept on disk and a resumed run gives the same result.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import Config, with_absolute_paths
from iscat_analysis.errors import DataError
from iscat_analysis.movie.camera import Camera
from iscat_analysis.movie.drift import Trajectory
from iscat_analysis.movie.lines import Lines, SteadyFrames
from iscat_analysis.pipeline.chunk_work import (
    ChunkSetting,
    analyse_chunk,
    chunk_job,
    make_landing_scene,
)
from iscat_analysis.pipeline.chunks import (
    REPEATS_COLUMN,
    Done,
    Merged,
    Reader,
    counts_budget,
    judge_noise,
    plan_chunks,
)
from iscat_analysis.pipeline.diagnosis import DRIFT_PX
from iscat_analysis.pipeline.injection import InjectedMovie, draw_particles, recovery
from iscat_analysis.pipeline.resume import Store
from iscat_analysis.pipeline.scene import Scene, reported_steps
from iscat_analysis.places import Here, Place
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
from iscat_analysis.search.sliding import boundaries, stride_of
from iscat_analysis.threads import one_thread_algebra, threads

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
    place: Place | None = None,
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
    place : Place, optional
        Where the chunks are analysed; default in this process.

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
    place = place or Here()
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
    with one_thread_algebra():
        scene = make_landing_scene(
            config, reader.shape, searches=count, noise=noise.spectrum, lines=lines
        )
    prepare(scene)
    plan = plan_chunks(reader, config, window, stride)
    store = Store(partial, config, identity, reader.shape, (first, last), camera)
    movie_job = ChunkSetting(
        frames, camera, with_absolute_paths(config), (first, last), count, window,
        noise.spectrum, noise.excess, lines,
    )  # fmt: skip
    merged = Merged(reader.shape)
    interrupted = False
    with threads(config.compute.workers) as pool:

        def finish(number: int) -> Done:
            done = None if posterior else store.load(number)
            if done is None:
                core, span = plan[number]
                budget = POSTERIORS - merged.sampled if posterior else 0
                if place.distant:
                    done = place.call(chunk_job, movie_job, core, span, budget)
                else:
                    chunk = reader.chunk(span, stride, pool)
                    done = analyse_chunk(scene, chunk, core, window, pool, budget, noise.excess)
                store.save(number, done)
            return done

        try:
            with closing(_finished(finish, len(plan), place, merged, posterior)) as finished:
                for frames_done, stopped in finished:
                    progress("landing", frames_done, last - first)
                    if stopped:
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


def _finished(
    finish: Callable[[int], Done], count: int, place: Place, merged: Merged, posterior: bool
) -> Generator[tuple[int, bool]]:
    """Finish chunks and merge them in their order, whichever comes first.

    Yields the number of frames that are done, and whether it stopped within a chunk.  Each chunk
    has the posteriors that those before it left to sample: with posteriors, one follows another.
    """

    def results() -> Iterator[tuple[int, Done]]:
        alone = 0
        while posterior and alone < count and merged.sampled < POSTERIORS:
            yield alone, finish(alone)
            alone += 1
        for number, done in place.each(finish, range(alone, count)):
            yield alone + number, done

    waiting: dict[int, Done] = {}
    ready = frames = 0
    for number, done in results():
        waiting[number] = done
        frames += done.core[1] - done.core[0]
        while ready in waiting:
            merged.add(waiting.pop(ready))
            ready += 1
        yield frames, done.stopped


def inject_and_recover(
    movie: CountSource,
    config: Config,
    camera: Camera,
    result: LandingResult,
    count: int,
    *,
    progress: Progress,
    place: Place | None = None,
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
    place : Place, optional
        As in `analyse_landings`.

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
        place=place,
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
