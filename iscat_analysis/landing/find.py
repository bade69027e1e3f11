"""Landing movies: particles land and leave at unknown times and places, and the windows slide.

The movie is read once, in chunks that fit into memory.  A chunk has a core, whose steps are its
own, and three windows of frames on either side, so that every step in the core is seen with all
its neighbours.  A step on the seam may be dated on either side of it: both chunks report what lies
near it, and the one whose core holds it is believed.  Chunks depend on the movie and the
configuration alone, so a finished one can be kept on disk and a resumed run gives the same result.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.camera import Camera, LightModel, SteadyFrames, Trajectory
from iscat_analysis.config import LARGEST_SD_NM, Config
from iscat_analysis.diagnosis import (
    DRIFT_PX,
    NoiseSurvey,
    Prepared,
    pixel_warnings,
    survey_over,
    within,
)
from iscat_analysis.errors import FloodError
from iscat_analysis.findings import Finding
from iscat_analysis.findings import particles as of
from iscat_analysis.findings.camera import MODEL_MISFITS
from iscat_analysis.fitting.events import index_finding
from iscat_analysis.fitting.ranges import fitted_frames
from iscat_analysis.fitting.results import Compared, DetectionResult
from iscat_analysis.fitting.run import Run
from iscat_analysis.inference.heights import spread_of_heights
from iscat_analysis.landing.chunks import ChunkNode, ChunkRunner, ChunkStore, MergedChunks
from iscat_analysis.medians import robust_sigma
from iscat_analysis.records import CountSource, FloatArray, Status, counted
from iscat_analysis.search.sliding import boundaries, stride_of
from iscat_analysis.threads import start_in_thread
from iscat_analysis.units import are, frames_listed, listed


def find_landings(ready: Prepared, run: Run) -> DetectionResult:
    """Find what lands or leaves between windows that slide over a movie."""
    for warning in run.executor.warnings(ready.config.compute.memory_limit_mb):
        run.notify(warning)
    try:
        found = analyse_landings(
            ready.movie, with_learned_heights(ready, run), ready.camera, run,
            lines=ready.lines, opening=ready.opening, stretches=ready.stretches.kept,
        )  # fmt: skip
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
    particle, name = config.particle, ready.movie.name
    if not particle.height_is_open or config.fit.heights_free:
        return config
    first, last = ready.stretches.main
    # Frames from which heights are learned, at most.
    trial = within(config, (first, min(last, first + 2000)))
    found = analyse_landings(ready.movie, trial, ready.camera, Run(), lines=ready.lines)
    run.clock.lap("heights")
    good = (found.fits["status"] == Status.OK).to_numpy()
    spread = None if found.evidence is None else spread_of_heights(*found.evidence[good, :2].T)
    prior_sd_nm = particle.height_prior_sd_nm
    if spread is None or spread.mean_se_nm > prior_sd_nm / 2:
        prior = {"height_nm": particle.nominal_height_nm, "sd_nm": prior_sd_nm}
        run.report(of.HEIGHTS_NOT_LEARNED(prior))
        return config
    run.report(of.HEIGHTS_LEARNED({"spread": str(spread), "particles": spread.events}, where=name))
    if ready.summary.get("optics", {}).get("calibrated"):
        values = {"sd_nm": spread.sd_nm, "mean_nm": spread.mean_nm}
        run.report(of.COMMON_HEIGHT_UNKNOWN(values))
    learned = {
        "learned_height_nm": max(round(spread.mean_nm, 2), 0.0),
        # Least spread that is learned: with none the height would be held again.
        "height_sd_nm": min(max(round(spread.sd_nm, 2), 0.1), LARGEST_SD_NM),
    }
    return config.changed(particle=learned)


def analyse_landings(
    movie: CountSource,
    config: Config,
    camera: Camera,
    run: Run,
    *,
    lines: LightModel | None = None,
    opening: NoiseSurvey | None = None,
    stretches: Sequence[tuple[int, int]] = (),
) -> DetectionResult:
    """Find and fit every particle that lands or leaves, in each stretch of a movie by itself."""
    span = fitted_frames(movie, config)
    stretches = stretches or (span,)
    frames = movie if lines is None else SteadyFrames(movie, lines, camera)
    opening = survey_over(frames, config, camera, span, opening)
    reader, noise, window = opening.reader, opening.noise, opening.window
    run.report(*noise.findings_of(movie.name))
    config = config.changed(posterior={"enabled": config.samples_posterior})
    searches = sum(boundaries(stop - start, window) for start, stop in stretches)
    node = ChunkNode(frames, camera, config, span, searches, window, noise, lines, reader)
    run.warm_up(node.context)
    identity = getattr(movie, "identity", "") if run.partial else ""
    store = ChunkStore(run.partial, config, identity, reader.shape, span, camera)
    runner = ChunkRunner(node, stretches, run.executor, store)
    total = sum(stop - start for start, stop in stretches)
    interrupted = False
    try:
        with closing(runner.run()) as finished:
            for frames_done, stopped in finished:
                if frames_done < total:
                    run.progress("landing", frames_done, total)
                if stopped:
                    interrupted = True
                    break
    except KeyboardInterrupt:
        interrupted = True
    forgetting = start_in_thread(reader.forget)
    found = _result(runner, opening, stretches[0][0], interrupted=interrupted)
    forgetting.result()
    if not interrupted:  # and their memory is free again
        run.progress("landing", total, total)
    run.report(*landing_findings(movie.name, runner.merged, found))
    return found


def _result(
    runner: ChunkRunner, opening: NoiseSurvey, begin: int, *, interrupted: bool
) -> DetectionResult:
    """Put together what is known of a movie, or of the chunks that were finished."""
    node, merged = runner.node, runner.merged
    fits, views, repeats = merged.result()
    light, trajectory = merged.light(), merged.trajectory()
    leavings = counted(fits)["mass_kda"] < 0
    threshold, stride = node.context.templates.threshold, stride_of(node.window)
    summary = {
        "window_frames": node.window,
        "stride_frames": stride,
        "boundaries_searched": node.searches,
        "landings": int((~leavings).sum()),
        "leavings": int(leavings.sum()),
        "shot_noise_limited_frames": opening.curve.shot_limited,
        "noise_frames": list(opening.curve.frames),
        "noise_variance_over_shot": list(opening.curve.variance_over_shot),
        "noise_spectrum": node.noise.summary,
        **({"judged_by": opening.sample} if opening.sample else {}),
        **merged.searched().summary(_median_snr(fits), threshold, stride),
        "frames_left_out": merged.left_out().size,
        "drift_px": merged.drift(),
        **_trajectory_summary(trajectory),
        "chunks": len(runner.chunks),
        "tiles": len(runner.chunks[0]),
    }
    return DetectionResult(
        context=node.context,
        fits=fits,
        views=views,
        image=node.context.contrasts(merged.image),
        compared=Compared(
            frames_before=(0, 0),
            frames_after=(begin, begin + light.size),
            power_ratio=1.0,
            power=light / np.nanmean(light) if np.isfinite(light).any() else light,
            masked_pixels=merged.masked_pixels,
        ),
        summary=summary,
        repeats=repeats,
        empty=merged.empty,
        evidence=merged.evidence,
        trajectory=trajectory,
        interrupted=interrupted,
    )


def landing_findings(
    name: str, merged: MergedChunks, found: DetectionResult
) -> Iterator[Finding | None]:
    """Tell of frames that were left out, of motion, of what was not searched, and of misfits."""
    config, summary = found.context.config, found.summary
    first = found.compared.frames_after[0]
    yield from frame_findings(name, merged.left_out() + first, merged.light(), first)
    yield from pixel_warnings(*merged.masks())
    windows = found.compared.power.size / summary["window_frames"]
    follows = config.background.follows_pattern
    yield from drift_findings(name, merged, windows, corrected=follows)
    share = summary["searched_share"]
    if share is not None and share < 0.95:
        spans = sorted(summary["partly_searched"], key=lambda span: span[2])[:3]
        worst = ", ".join(f"{start}:{stop} ({part:.0%})" for start, stop, part in sorted(spans))
        values = {"share": share, "snr": summary["searched_snr"], "frames": worst}
        yield of.PARTLY_SEARCHED(values, where=name)
    if config.fit.index:
        missing = int(found.fits["refractive_index"].isna().sum())
        yield index_finding(found.context, merged.untold, missing, len(found.fits), where=name)
    if merged.cause:
        yield MODEL_MISFITS({"cause": merged.cause}, where=name)
    if not config.background.power_normalization:
        yield of.POWER_ALWAYS_FOLLOWED()


def frame_findings(
    name: str, missing: NDArray[np.int64], light: FloatArray, first: int
) -> Iterator[Finding]:
    """Tell of frames that were left out, and of jumps of the light.

    Shapes: `missing` (n,), `light` (t,).
    """
    if missing.size:
        share = missing.size / light.size
        values = {"frames": frames_listed(missing), "verb": are(missing.size), "lost": ""}
        if share > 0.05:
            values["lost"] = f"; {share:.0%} of the movie, with what lands there, is lost"
        yield of.FRAMES_LEFT_OUT({**values, "number": missing.size}, where=name)
    known = np.flatnonzero(np.isfinite(light))
    change = light[known][1:] / light[known][:-1] - 1
    usual = robust_sigma(change) if change.size else 0.0
    jumps = known[1:][np.abs(change) > max(0.1, 8 * usual)] + first
    if jumps.size:
        largest = 100 * float(change[np.argmax(np.abs(change))])
        yield of.BRIGHTNESS_JUMPS({"frames": frames_listed(jumps), "percent": largest}, where=name)


def drift_findings(
    name: str, merged: MergedChunks, windows: float, *, corrected: bool = False
) -> Iterator[Finding]:
    """Tell how the fixed pattern moved in so many windows, and whether that was divided out."""
    way, drift = merged.trajectory(), merged.drift()
    moved = {} if drift is None else {"y_px": drift[0], "x_px": drift[1]}
    if way is not None and moved:
        yield of.PATTERN_FOLLOWED(moved | {"error_px": way.typical_error_px}, where=name)
    unfollowed = merged.unfollowed() if corrected else []
    if unfollowed:
        spans = listed((f"{a}:{b}" for a, b in unfollowed), 4)
        yield of.PATTERN_NOT_FOLLOWED({"frames": spans}, where=name)
    if drift and not corrected and math.hypot(*drift) > DRIFT_PX * max(windows / 2, 1.0):
        yield of.PATTERN_MOVED(moved, where=name)


def _median_snr(table: pd.DataFrame) -> float:
    """Median signal-to-noise ratio of the particles; 0 where there is none."""
    good = table["snr"][table["status"] == Status.OK] if len(table) else []
    return float(np.median(good)) if len(good) else 0.0


def _trajectory_summary(trajectory: Trajectory | None) -> dict[str, Any]:
    """Summarise a trajectory of the fixed pattern."""
    values: tuple[Any, ...] = (False, None, None, None, None)
    if trajectory is not None:
        y, x = trajectory.shift_px.T.tolist()
        values = True, trajectory.frames.tolist(), x, y, trajectory.typical_error_px
    keys = ("drift_corrected", "drift_frames", "drift_x_px", "drift_y_px", "drift_error_px")
    return dict(zip(keys, values, strict=True))
