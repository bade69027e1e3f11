"""Landing movies: particles land and leave at unknown times and places, and the windows slide.

The movie is read once, in chunks that fit into memory.  A chunk has a core, whose steps are its
own, and three windows of frames on either side, so that every step in the core is seen with all
its neighbours.  A step on the seam may be dated on either side of it: both chunks report what lies
near it, and the one whose core holds it is believed.  Chunks depend on the movie and the
configuration alone, so a finished one can be kept on disk and a resumed run gives the same result.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_right
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Camera, LightModel, SteadyFrames, Trajectory
from iscat_analysis.config import LARGEST_SD_NM, Config, with_absolute_paths
from iscat_analysis.diagnosis import DRIFT_PX, NoiseSurvey, Prepared, pixel_warnings, survey_over
from iscat_analysis.errors import FloodError
from iscat_analysis.executors import Executor, LocalExecutor
from iscat_analysis.fitting.context import AnalysisContext, make_context
from iscat_analysis.fitting.events import untold_message
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.fitting.run import Notify, Run, notify_nobody
from iscat_analysis.inference.height_spread import spread_of_heights
from iscat_analysis.landing.chunks import ChunkSetting, Store, analyse_part, chunk_job, field_job
from iscat_analysis.landing.maps import maps_are_local, searched_warning
from iscat_analysis.landing.merging import FinishedChunk, MergedChunks, joined
from iscat_analysis.records import CountSource, FloatArray, Progress, Status, counted, silent
from iscat_analysis.search.chunks import Part, plan_parts
from iscat_analysis.search.frames import FieldSums
from iscat_analysis.search.sliding import boundaries, stride_of
from iscat_analysis.threads import one_thread_algebra, start_in_thread, threads
from iscat_analysis.units import listed

JUMP = 0.1
"""Relative change of the light from one frame to the next that is reported."""

LOST = 0.05
"""Share of the frames that may be left out without a word on what is missed by it."""


def frame_warnings(
    name: str,
    merged: MergedChunks,
    drift: list[float] | None,
    light: FloatArray,
    first: int,
    window: int,
    *,
    corrected: bool = False,
) -> Iterator[str]:
    """Warn of frames that were left out and of motion of the pattern.

    Shapes: `light` (t,).
    """
    missing = merged.repeats() + first
    if missing.size:
        verb = "is" if missing.size == 1 else "are"
        share = missing.size / light.size
        lost = f"; {share:.0%} of the movie, with what lands there, is lost" if share > LOST else ""
        yield (
            f"{name}: {_frames(missing)} {verb} dark, cut off, not finite or the same as "
            "the frame before (behind a shutter, dropped or stuck in the camera); left out, the "
            f"other frames are used{lost}"
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
    yield from (finding.text for finding in pixel_warnings(*merged.masks()))
    yield from _drift_warnings(name, merged, drift, light.size / window, corrected)


def _drift_warnings(
    name: str, merged: MergedChunks, drift: list[float] | None, windows: float, corrected: bool
) -> Iterator[str]:
    """Say how the fixed pattern moved, and whether its motion was divided out."""
    way = merged.trajectory()
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
    return f"frame{'' if frames.size == 1 else 's'} {listed(frames, 4)}"


HEIGHT_FRAMES = 2000
"""Frames from which heights are learned, at most."""

LEAST_SD_NM = 0.1
"""Least spread that is learned: with none the height would be held again."""

_FIELDS = 2  # chunks whose sums over the field are kept: one ends while the next begins

POSTERIORS = 20
"""Events whose posterior is sampled, where the configuration asks for it."""


def find_landings(ready: Prepared, run: Run) -> DetectionResult:
    """Find what lands or leaves between windows that slide over a movie."""
    for warning in run.executor.warnings(ready.config.compute.memory_limit_mb):
        run.notify(warning)
    try:
        config = with_learned_heights(ready, run)
        found = analyse_landings(
            ready.movie,
            config,
            ready.camera,
            warn=run.warn,
            progress=run.progress,
            prepare=run.warm_up,
            partial=run.partial,
            identity=ready.movie.identity if run.partial else "",
            lines=ready.lines,
            executor=run.executor,
            opening=ready.opening,
            stretches=ready.stretches.kept,
        )
    except FloodError as error:  # what seems to be noise is then particles
        raise FloodError(ready.other_kind) if ready.other_kind else error from None
    run.clock.lap("landing")
    return found


def with_learned_heights(ready: Prepared, run: Run) -> Config:
    """Learn mean and spread of the heights from the first frames, where these are left open.

    These frames are analysed with a prior so wide that the light determines the heights.  A number
    that the light does not determine keeps its prior.
    """
    config = ready.config
    particle = config.particle
    if not particle.height_is_open or config.fit.mode != "mass":
        return config
    first, last = ready.stretches.main
    some = config.fit.model_copy(update={"frames": (first, min(last, first + HEIGHT_FRAMES))})
    trial = config.model_copy(update={"fit": some})
    found = analyse_landings(
        ready.movie, trial, ready.camera, warn=notify_nobody, progress=silent, prepare=run.warm_up,
        lines=ready.lines,
    )  # fmt: skip
    run.clock.lap("heights")
    good = (found.fits["status"] == Status.OK).to_numpy()
    spread = None if found.evidence is None else spread_of_heights(*found.evidence[good, :2].T)
    if spread is None or spread.mean_se_nm > particle.height_prior_sd_nm / 2:
        run.warn(
            "the heights cannot be learned from so few or so faint particles: they are taken as "
            f"{particle.nominal_height_nm:g} ± {particle.height_prior_sd_nm:g} nm"
        )
        return config
    run.notify(f"{ready.movie.name}: {spread}, learned from {spread.events} particles")
    if ready.summary.get("optics", {}).get("calibrated"):
        run.warn(
            "a common height and the focus are one number, and the focus was learned from the same "
            f"particles: only their spread, {spread.sd_nm:.1f} nm, is known, and the mean of "
            f"{spread.mean_nm:.1f} nm is where the learned optics put it"
        )
    learned = {
        "learned_height_nm": max(round(spread.mean_nm, 2), 0.0),
        "height_sd_nm": min(max(round(spread.sd_nm, 2), LEAST_SD_NM), LARGEST_SD_NM),
    }
    return config.model_copy(update={"particle": particle.model_copy(update=learned)})


def _do_nothing(context: AnalysisContext) -> None:
    """Do nothing."""


def analyse_landings(
    movie: CountSource,
    config: Config,
    camera: Camera,
    *,
    warn: Notify,
    progress: Progress,
    prepare: Callable[[AnalysisContext], None] = _do_nothing,
    partial: Path | None = None,
    identity: str = "",
    lines: LightModel | None = None,
    executor: Executor | None = None,
    opening: NoiseSurvey | None = None,
    stretches: Sequence[tuple[int, int]] = (),
) -> DetectionResult:
    """Find and fit every particle that lands or leaves, in each stretch of a movie by itself."""
    executor = executor or LocalExecutor()
    first, last = fitted_frames(movie, config)
    stretches = stretches or ((first, last),)
    total = sum(stop - start for start, stop in stretches)
    frames = movie if lines is None else SteadyFrames(movie, lines, camera)
    opening = survey_over(frames, config, camera, (first, last), opening)
    reader, noise, window = opening.reader, opening.noise, opening.window
    for finding in noise.findings_of(movie.name):
        warn(finding.text)
    stride = stride_of(window)
    count = sum(boundaries(stop - start, window) for start, stop in stretches)
    posterior = config.samples_posterior
    sampling = config.posterior.model_copy(update={"enabled": posterior})
    config = config.model_copy(update={"posterior": sampling})
    with one_thread_algebra():
        context = make_context(
            config, reader.shape, searches=count, noise=noise.spectrum, lines=lines, sliding=True
        )
    prepare(context)
    in_place = maps_are_local(context, moving=config.background.follows_pattern)
    chunks = [
        chunk
        for stretch in stretches
        for chunk in plan_parts(reader, config, window, stride, stretch, in_place=in_place)
    ]
    plan = [part for chunk in chunks for part in chunk]
    store = Store(partial, config, identity, reader.shape, (first, last), camera)
    movie_job = ChunkSetting(
        frames, camera, with_absolute_paths(config), (first, last), count, window,
        noise.spectrum, noise.excess, lines,
    )  # fmt: skip
    merged = MergedChunks(reader.shape, [stop for _, stop in stretches])
    fields = _Fields()
    # of each chunk the tile before the last, and the frames of the next chunk
    before_last = {
        end - 2: after[0].span
        for end, after in zip(np.cumsum([*map(len, chunks)]).tolist(), chunks[1:], strict=False)
    }
    interrupted = False
    with threads(executor.threads(config.compute.workers, len(plan))) as pool:

        def summed(span: tuple[int, int]) -> FieldSums:
            return fields.of(
                span,
                lambda: executor.call(
                    field_job, movie_job, span, here=lambda: reader.field_sums(span, pool)
                ),
            )

        def finish(number: int) -> FinishedChunk:
            done = None if posterior else store.load(number)
            if done is None:
                part = plan[number]
                budget = POSTERIORS - merged.sampled if posterior else 0
                earlier = merged.earlier(number, part.core[0] - window)  # before all of this chunk
                if executor.distant:
                    reader.forget()  # whoever does it has a reader of its own

                sums = None
                if part.tile is not None:
                    sums = summed(part.span).part(part.tile.here)
                    if reader.in_place and number in before_last:
                        summed(before_last[number])  # while another process does the other tiles

                def here() -> FinishedChunk:
                    return analyse_part(
                        reader, context, part, sums, window, pool, budget, noise.excess, earlier
                    )

                done = executor.call(chunk_job, movie_job, part, sums, budget, earlier, here=here)
                store.save(number, done)
            merged.note(number, done)
            return done

        try:
            with closing(_finished(finish, chunks, executor, merged, posterior)) as finished:
                for frames_done, stopped in finished:
                    if frames_done < total:
                        progress("landing", frames_done, total)
                    if stopped:
                        interrupted = True
                        break
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            interrupted = True
    forgetting = start_in_thread(reader.forget)
    fits, views, repeats = merged.result()
    light, drift, begin = merged.light(), merged.drift(), stretches[0][0]
    forgetting.result()
    if not interrupted:  # and their memory is free again
        progress("landing", total, total)
    wanted = config.background.follows_pattern
    for text in frame_warnings(movie.name, merged, drift, light, begin, window, corrected=wanted):
        warn(text)
    searched = merged.searched().summary(_median_snr(fits), context.templates.threshold, stride)
    if text := searched_warning(movie.name, searched):
        warn(text)
    if config.fit.index:
        missing = int(fits["refractive_index"].isna().sum())
        n_sample = config.optics.n_sample
        if text := untold_message(merged.untold, missing, len(fits), n_sample):
            warn(f"{movie.name}: {text}")
    if merged.cause:
        warn(f"{movie.name}: {merged.cause}")
    if not config.background.power_normalization:
        warn(
            "background.power_normalization = false has no effect on a landing movie: each frame "
            "is weighed by its own light"
        )
    summary = {
        "window_frames": window,
        "stride_frames": stride,
        "boundaries_searched": count,
        **_counted(fits),
        "shot_noise_limited_frames": opening.curve.shot_limited,
        "noise_frames": list(opening.curve.frames),
        "noise_variance_over_shot": list(opening.curve.variance_over_shot),
        "noise_spectrum": noise.summary,
        **({"judged_by": opening.sample} if opening.sample else {}),
        **searched,
        "frames_left_out": merged.left_out(),
        "drift_px": drift,
        **_trajectory_summary(merged.trajectory()),
        "chunks": len(chunks),
        "tiles": len(chunks[0]),
    }
    return DetectionResult(
        context=context,
        fits=fits,
        views=views,
        image=context.contrasts(merged.image),
        compared=Compared(
            frames_before=(0, 0),
            frames_after=(begin, begin + light.size),
            power_ratio=1.0,
            power=light / np.nanmean(light) if np.isfinite(light).any() else light,
            masked_pixels=merged.masked_pixels,
        ),
        heading="landing",
        summary=summary,
        repeats=repeats,
        empty=merged.empty,
        evidence=merged.evidence,
        trajectory=merged.trajectory(),
        interrupted=interrupted,
    )


def _finished(
    finish: Callable[[int], FinishedChunk],
    chunks: Sequence[Sequence[Part]],
    executor: Executor,
    merged: MergedChunks,
    posterior: bool,
) -> Generator[tuple[int, bool]]:
    """Finish chunks and their tiles, and merge them in order, in whatever order they come.

    Yields the number of frames that are done, and whether it stopped within a chunk.  Each chunk
    has the posteriors that those before it left to sample: with posteriors, one follows another.
    """
    count = sum(map(len, chunks))
    edges = np.cumsum([0, *map(len, chunks)]).tolist()

    def results() -> Iterator[tuple[int, FinishedChunk]]:
        alone = 0
        while posterior and alone < count and merged.sampled < POSTERIORS:
            yield alone, finish(alone)
            alone += 1
        for number, done in executor.each(finish, range(alone, count)):
            yield alone + number, done

    waiting: dict[int, FinishedChunk] = {}
    ready, frames = 0, 0.0
    for number, done in results():
        waiting[number] = done
        merged.note(number, done)
        home = bisect_right(edges, number) - 1
        frames += (done.core[1] - done.core[0]) / len(chunks[home])
        while ready < len(chunks) and all(k in waiting for k in range(*edges[ready : ready + 2])):
            merged.add(
                _whole(chunks[ready], [waiting.pop(k) for k in range(*edges[ready : ready + 2])])
            )
            ready += 1
        yield round(frames), done.stopped


def _whole(parts: Sequence[Part], done: Sequence[FinishedChunk]) -> FinishedChunk:
    """Give a chunk of the whole field, joined where it was divided."""
    tiles = [part.tile for part in parts if part.tile is not None]
    return joined(tiles, done) if tiles else done[0]


@dataclass
class _Field:
    """What the frames of a chunk say of the whole field, once they are summed."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    sums: FieldSums | None = None


class _Fields:
    """Sums over the whole field, made once for all tiles of a chunk."""

    def __init__(self) -> None:
        self._known: dict[tuple[int, int], _Field] = {}
        self._lock = threading.Lock()

    def of(self, span: tuple[int, int], make: Callable[[], FieldSums]) -> FieldSums:
        """Give the sums of a span; those of spans long before are forgotten."""
        with self._lock:
            if span not in self._known:
                for old in sorted(self._known)[: 1 - _FIELDS]:
                    del self._known[old]
            own = self._known.setdefault(span, _Field())
        with own.lock:
            if own.sums is None:
                own.sums = make()
            return own.sums


def _median_snr(table: pd.DataFrame) -> float:
    """Median signal-to-noise ratio of the particles; 0 where there is none."""
    good = table["snr"][table["status"] == Status.OK] if len(table) else []
    return float(np.median(good)) if len(good) else 0.0


def _counted(table: pd.DataFrame) -> dict[str, int]:
    """Count landings and leavings."""
    left = counted(table)["mass_kda"] < 0
    return {"landings": int((~left).sum()), "leavings": int(left.sum())}


def _trajectory_summary(trajectory: Trajectory | None) -> dict[str, Any]:
    """Summarise a trajectory of the fixed pattern."""
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
