"""The main job: load → calibrate → background → detect → fit → posterior → bounds → report."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from iscat_analysis.config import Config, config_to_toml
from iscat_analysis.errors import ConfigError, FloodError
from iscat_analysis.inference.achieved import Achieved
from iscat_analysis.inference.noise import compile_maximisation, compile_values
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.inference.prior import Prior
from iscat_analysis.movie import Stack, beside, open_stack
from iscat_analysis.movie.background import measure_windows
from iscat_analysis.movie.camera import Camera, camera_from_config, check_counts, refuse_ratio
from iscat_analysis.movie.lines import Lines, SteadyFrames
from iscat_analysis.movie.metadata import resolve_metadata
from iscat_analysis.movie.stack import printable
from iscat_analysis.pipeline.achieved import (
    measure_spread,
    spread_verdict,
    with_measured_sigma,
    with_repeats,
)
from iscat_analysis.pipeline.block_store import BlockStore
from iscat_analysis.pipeline.blocks import plan_blocks
from iscat_analysis.pipeline.compilation import Compilation, compiling
from iscat_analysis.pipeline.diagnosis import (
    EXCESS_NOISE,
    drift_warning,
    examine_background,
    judge_background,
    judge_lines,
    misfit_warning,
    pixel_warnings,
)
from iscat_analysis.pipeline.field import fit_field
from iscat_analysis.pipeline.landing import analyse_landings, has_landings, inject_and_recover
from iscat_analysis.pipeline.learning import learn_optics
from iscat_analysis.pipeline.moving import track_scene
from iscat_analysis.pipeline.ranges import fitted_frames, frame_ranges, tracked_frames
from iscat_analysis.pipeline.recognise import (
    as_landing,
    as_moving,
    changes_summary,
    look_at_changes,
)
from iscat_analysis.pipeline.repeats import field_repeats
from iscat_analysis.pipeline.results import Found, Row, summary_of, table_of, view_of
from iscat_analysis.pipeline.resume import is_resumable, partial_folder
from iscat_analysis.pipeline.scene import Scene, field_likelihood, make_scene
from iscat_analysis.pipeline.systematic import with_systematic
from iscat_analysis.pipeline.tracking import (
    learns_background,
    track_movie,
    track_particles,
)
from iscat_analysis.pipeline.tracks import judge_times, make_films, tracks_of
from iscat_analysis.places import Here, Place, versions
from iscat_analysis.records import (
    Analysis,
    Film,
    FloatArray,
    PosteriorResult,
    Progress,
    Provenance,
    Windows,
    silent,
)
from iscat_analysis.report import EVENT_FIGURES, write_report
from iscat_analysis.report.output import claim_output
from iscat_analysis.report.spread import rejection
from iscat_analysis.search.changes import Changes
from iscat_analysis.threads import threads

FEW_FIGURES = 2
"""Events of a landing movie that are drawn for print; the page shows hundreds."""

Notify = Callable[[str], None]
T = TypeVar("T")


def _quiet(text: str) -> None:
    """Say nothing."""


def fit_stack(
    stack: Path,
    config: Config,
    *,
    out: Path | None = None,
    overwrite: bool = False,
    progress: Progress = silent,
    notify: Notify = _quiet,
    command: str = "",
    inject: int = 0,
    place: Place | None = None,
) -> Analysis:
    """Analyse a movie and write the report.

    Parameters
    ----------
    stack : Path
        The movie.
    config : Config
        What to do; see `iscat_analysis.config`.
    out : Path, optional
        Output folder; default the movie's name with ``.iscat``.
    overwrite : bool
        Replace an earlier result.
    progress : Progress
        Told how far each stage is.
    notify : callable
        Told what the user should know, one line at a time.
    command : str
        The command line, for the record.
    inject : int
        Known particles to add to a landing movie in a second run, which tells how many are found
        and how well they are measured; ``summary["injection"]``.
    place : Place, optional
        Where the chunks of a landing movie are analysed; default in this process.

    Returns
    -------
    Analysis
        Everything found; also written to the folder.

    Raises
    ------
    DataError
        The movie cannot be analysed, or the folder exists.
    ConfigError
        The configuration does not suit the movie.
    KeyboardInterrupt
        The user stopped it; what was finished is in the folder.
    """
    folder = beside(stack, ".iscat") if out is None else out
    overwrite = overwrite or is_resumable(folder)
    with claim_output(folder, overwrite):
        with open_stack(stack) as movie:
            analysis = analyse(
                movie,
                config,
                progress=progress,
                notify=notify,
                command=command,
                partial=partial_folder(folder.resolve()),
                inject=inject,
                place=place,
            )
        sliding = "landing" in analysis.summary
        figures = FEW_FIGURES if sliding else EVENT_FIGURES
        write_report(analysis, folder, overwrite=overwrite, event_figures=figures)
        if not analysis.summary["interrupted"]:
            shutil.rmtree(partial_folder(folder.resolve()), ignore_errors=True)
    if analysis.summary["interrupted"]:
        progress("report", 1, 1)
        notify(f"interrupted; what was finished is in {folder}")
        raise KeyboardInterrupt
    return analysis


def analyse(
    movie: Stack,
    config: Config,
    *,
    progress: Progress = silent,
    notify: Notify = _quiet,
    command: str = "",
    partial: Path | None = None,
    inject: int = 0,
    place: Place | None = None,
) -> Analysis:
    """Analyse an open movie.

    Parameters
    ----------
    movie : Stack
        From `iscat_analysis.movie.open_stack`.
    config : Config
        What to do.
    progress, notify, command
        As in `fit_stack`.
    partial : Path, optional
        Folder that keeps the finished chunks of a landing movie, or blocks of one in mode track,
        so that an interrupted run can be resumed; without it nothing is kept.
    inject, place
        As in `fit_stack`.

    Returns
    -------
    Analysis
        Everything found.
    """
    # particles that move are fitted by kernels of their own, which call those of others
    workers = 1 if learns_background(config) else config.compute.workers
    with compiling(notify, workers) as compilation:
        return _analysed(
            movie, config, compilation, progress=progress, notify=notify, command=command,
            partial=partial, inject=inject, place=place or Here(),
        )  # fmt: skip


def _analysed(
    movie: Stack,
    config: Config,
    compilation: Compilation,
    *,
    progress: Progress,
    notify: Notify,
    command: str,
    partial: Path | None,
    inject: int,
    place: Place,
) -> Analysis:
    """Load, calibrate, search and fit; see `analyse`."""
    if place.distant and not movie.identity:
        raise ConfigError(
            f"{movie.name}: is an array, and workers read a movie from its file: save it, as with "
            "numpy.save, and give its path; or leave `scheduler` out"
        )
    started = datetime.now(UTC).isoformat(timespec="seconds")
    clock = _Clock()
    warnings: list[str] = []

    def tell(text: str) -> None:
        warnings.append(text)
        notify(text)

    config, notes = resolve_metadata(config, movie.metadata)
    for note in (*movie.notes, *notes):
        tell(note)
    if config.fit.mode == "track":
        for note in judge_times(config, tracked_frames(movie, config), movie.name):
            tell(note)
    if config.optics.scheme == "darkfield" and config.particle.photons_per_frame is None:
        photons = config.simulation.photons_per_pixel
        tell(
            f"particle.photons_per_frame is not given, so that masses rest on "
            f"simulation.photons_per_pixel = {photons:g}, which says nothing of this movie; give "
            "the scattered photons collected per frame from a particle of particle.mass_kda: the "
            "next release asks for it"
        )
        particle = config.particle.model_copy(update={"photons_per_frame": photons})
        config = config.model_copy(update={"particle": particle})
    if config.optics.psf == "measured":
        tell(
            'optics.psf = "measured": bounds are those of the template, and there is no quantum '
            "bound, because a picture does not say what light made it"
        )
    shape = (movie.shape[1], movie.shape[2])
    camera = camera_from_config(config.camera, shape, movie.dtype)
    refuse_ratio(movie.read(0, 1)[0], f"{movie.name}: frame 0", camera)
    digest = _beside(movie.sha256)
    further: dict[str, Any] = {}
    lines = judge_lines(movie, config, camera)
    steady = movie
    if lines is not None:
        tell(f"{movie.name}: {lines.message}")
        further["lines"] = lines.summary
        steady = movie.seen_as(SteadyFrames(movie, lines, camera))
    landing, tracked = has_landings(config), config.fit.mode == "track"
    looking: Future[Changes] | None = None
    if landing or tracked:
        span = fitted_frames(movie, config, config.background.frames)
        looking = _beside(look_at_changes, steady, config, camera, span)
    configured = config
    config, learned = learn_optics(steady, config, camera, tell=tell)
    if learned:
        further["optics"] = learned
    clock.lap("optics")
    other = ""
    if looking is not None:
        changes = looking.result()
        if config.optics.na != configured.optics.na:
            changes = look_at_changes(steady, config, camera, span)
        further["changes"] = changes_summary(changes)
        other = (as_landing if tracked else as_moving)(changes, movie.name)
        if other:
            tell(other)
    if place.distant and not landing:
        notify(f"{movie.name}: is analysed in this process: only landing movies have chunks")
    if landing:
        for remark in place.remarks(config.compute.memory_limit_mb):
            notify(remark)
        try:
            result = analyse_landings(
                movie,
                config,
                camera,
                tell=tell,
                progress=progress,
                prepare=lambda scene: _warm_up(scene, compilation),
                partial=partial,
                identity=movie.identity if partial else "",
                lines=lines,
                place=place,
            )
        except FloodError as error:  # what seems to be noise is then particles
            raise FloodError(other) if other else error from None
        scene, image = result.scene, result.image
        further["landing"] = result.summary
        found = Found(
            result.table, result.views, result.windows, result.interrupted,
            result.repeats, result.empty,
        )  # fmt: skip
        config = scene.config
        clock.lap("landing")
        if inject and not result.interrupted:
            try:
                further["injection"] = inject_and_recover(
                    movie, config, camera, result, inject, progress=progress, place=place
                )
            except KeyboardInterrupt:  # what the movie itself gave is kept
                found = replace(found, interrupted=True)
            clock.lap("injection")
    else:
        if inject:
            raise ConfigError(
                f"`inject` = {inject}: particles are added to landing movies only, which have an "
                'interferometric scheme and background.method = "sliding"; leave it out'
            )
        scene, found, image, measured = _measured_background(
            steady, config, camera, clock, partial,
            lines=lines, tell=tell, compilation=compilation, progress=progress,
        )  # fmt: skip
        further |= measured
    windows = found.windows
    gathering = progress
    if found.interrupted:  # what was finished is now gathered and kept, which takes a moment
        progress("report", 0, 1)
        gathering = silent  # another stage would end the time that writing is given
    found = replace(found, table=with_systematic(config, found.table))
    achieved: dict[str, Achieved] = {}
    if found.repeats:
        achieved = measure_spread(scene.mode, found.table, found.repeats, found.empty)
        table = with_repeats(scene.mode, found.table, found.repeats)
        scaled = config.fit.sigma == "measured"
        if scaled:
            table = with_measured_sigma(table, achieved)
        noise = further.get("landing") or further.get("background") or {}
        further["repeats"] = spread_verdict(
            achieved, noise, scaled=scaled, rejected=bool(rejection(found.table))
        )
        if further["repeats"]["message"]:
            tell(further["repeats"]["message"])
        found = replace(found, table=table)
    tracks: pd.DataFrame | None = None
    films: tuple[Film, ...] = ()
    if scene.mode == "track":
        tracks, said = tracks_of(
            scene, found.table, windows, masses=found.masses, tell=tell, progress=gathering
        )
        further |= said
        films = make_films(scene, steady, camera, found.parts or (windows,), found.table, tracks)
        clock.lap("tracks")
    summary = summary_of(scene, found.table, windows, clock.seconds, achieved)
    sampled = config.samples_posterior
    provenance = Provenance(
        command=printable(command) or "iscat_analysis.pipeline.analyse",
        input_path=printable(str(movie.path)),
        input_sha256=digest.result(),
        versions=versions(),
        seed=config.compute.seed if sampled else None,
        started=started,
    )
    summary |= {
        **further,
        "input": {
            "path": provenance.input_path,
            "sha256": provenance.input_sha256,
            "shape": list(movie.shape),
        },
        "seed": provenance.seed,
        "versions": dict(provenance.versions),
        "interrupted": found.interrupted,
        "warnings": warnings,
    }
    return Analysis(
        config_toml=config_to_toml(config),
        mode=scene.mode,
        scheme=config.optics.scheme,
        pixel_size_nm=scene.pixel_nm,
        table=found.table,
        views=found.views,
        ratio_image=image,
        power=windows.power,
        power_frames=np.concatenate(
            [np.arange(*windows.frames_before), np.arange(*windows.frames_after)]
        ),
        summary=summary,
        provenance=provenance,
        warnings=tuple(warnings),
        tracks=tracks,
        films=films,
    )


def _beside(work: Callable[..., T], *arguments: Any) -> Future[T]:
    """Begin work in a thread of its own."""
    pool = ThreadPoolExecutor(1)
    begun = pool.submit(work, *arguments)
    pool.shutdown(wait=False)
    return begun


def _measured_background(
    movie: Stack,
    config: Config,
    camera: Camera,
    clock: _Clock,
    partial: Path | None,
    *,
    lines: Lines | None,
    tell: Notify,
    compilation: Compilation,
    progress: Progress,
) -> tuple[Scene, Found, FloatArray, dict[str, Any]]:
    """Find particles against frames before they bound, or against a known background."""
    further: dict[str, Any] = {}
    shape = (movie.shape[1], movie.shape[2])
    if learns_background(config):
        return _moving_particles(
            movie, config, camera, clock, partial, tell=tell, progress=progress
        )
    before, after = frame_ranges(movie, config)
    searches = after[1] - after[0] if config.fit.mode == "track" else 1
    scene = make_scene(config, shape, searches=searches, lines=lines)
    _warm_up(scene, compilation)
    clock.lap("model")

    def check(counts: NDArray[Any], first: int) -> None:
        check_counts(counts, first, movie.name, camera=camera)

    windows = measure_windows(
        movie,
        camera,
        before,
        after,
        median=config.background.method == "median",
        level_e=config.background.level_e,
        power_normalization=config.background.power_normalization,
        check=check,
        progress=progress,
    )
    gain, spectrum = judge_background(movie, camera, windows)
    if spectrum is not None:
        scene = make_scene(config, shape, searches=searches, noise=spectrum, lines=lines)
        if spectrum.message:
            tell(f"{movie.name}: {spectrum.message}")
    if gain is not None and gain.message:
        tell(gain.message)
    for text in pixel_warnings(windows):
        tell(text)
    if not scene.additive:
        further["background"] = examine_background(movie, camera, windows)
        further["background"]["noise_spectrum"] = spectrum.summary if spectrum else None
        moved = drift_warning(movie.name, further["background"])
        if moved:
            tell(moved)
    clock.lap("background")
    with threads(config.compute.workers) as pool:
        if scene.mode == "track":
            found = track_particles(
                scene, movie, camera, windows, check=check, pool=pool, progress=progress
            )
        else:
            noisy = gain is not None and gain.noise_ratio > EXCESS_NOISE
            excess = (gain.message or "") if gain is not None and noisy else ""
            found = _bound_particles(
                scene, movie, camera, windows, clock,
                excess_noise=excess, tell=tell, pool=pool, progress=progress,
            )  # fmt: skip
    windows = found.windows
    image = field_likelihood(scene, windows).measured_signal()
    if scene.additive:
        image = windows.after_e - windows.power_ratio * windows.before_e
    clock.lap("results")
    return scene, found, image, further


def _moving_particles(
    movie: Stack,
    config: Config,
    camera: Camera,
    clock: _Clock,
    partial: Path | None,
    *,
    tell: Notify,
    progress: Progress,
) -> tuple[Scene, Found, FloatArray, dict[str, Any]]:
    """Track particles over backgrounds that are learnt with them."""
    first, last = config.fit.frames or (0, movie.shape[0])
    shape = (movie.shape[1], movie.shape[2])
    scene = track_scene(config, shape, max(last - first, 1))
    clock.lap("model")

    def check(counts: NDArray[Any], first: int) -> None:
        check_counts(counts, first, movie.name, camera=camera)

    plan = plan_blocks(movie, config, camera, check=check)
    if message := plan.message(movie.name):
        tell(message)
    clock.lap("background")
    identity = movie.identity if partial else ""
    store = BlockStore(partial, config, identity, shape, (first, last), camera)
    with threads(config.compute.workers) as pool:
        found = track_movie(
            scene, movie, camera, plan, store, check=check, pool=pool, progress=progress
        )
    clock.lap("track")
    image = found.windows.after_e / found.windows.before_e - 1
    further = {"blocks": plan.summary}
    return replace(scene, mode="track", config=config), found, image, further


def _bound_particles(
    scene: Scene,
    movie: Stack,
    camera: Camera,
    windows: Windows,
    clock: _Clock,
    *,
    excess_noise: str,
    tell: Notify,
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> Found:
    """Find, fit and sample the particles that bound between the two windows."""
    events, windows = fit_field(
        scene, windows, excess_noise=excess_noise, pool=pool, progress=progress
    )
    clock.lap("fit")
    cause = misfit_warning(scene.config, events)
    if cause:
        tell(cause)
    repeats, empty = field_repeats(scene, movie, camera, windows, events)
    clock.lap("repeats")
    rows = [Row(number, event, windows) for number, event in enumerate(events)]
    interrupted = False
    if scene.config.samples_posterior:
        rows, interrupted = _sampled(scene, rows, pool, progress)
        clock.lap("posterior")
    views = tuple(view_of(row) for row in rows)
    return Found(table_of(scene, rows), views, windows, interrupted, tuple(repeats), empty)


def _sampled(
    scene: Scene, rows: list[Row], pool: ThreadPoolExecutor, progress: Progress
) -> tuple[list[Row], bool]:
    """Sample the posteriors; an interrupt keeps those that are done."""
    settings, seed = scene.config.posterior, scene.config.compute.seed
    stop = threading.Event()

    def one(row: Row) -> PosteriorResult:
        return sample_posterior(
            row.event.likelihood,
            row.event.fit,
            walkers=settings.walkers,
            steps=settings.steps,
            seed=seed + row.number,
            prior=Prior(settings.priors),
            stopped=stop.is_set,
        )

    done: list[Row] = []
    try:
        for row, posterior in zip(rows, pool.map(one, rows), strict=True):
            done.append(replace(row, posterior=posterior))
            progress("posterior", len(done), len(rows))
    except KeyboardInterrupt:
        stop.set()
        pool.shutdown(cancel_futures=True)
        return done + rows[len(done) :], True
    return done, False


def _warm_up(scene: Scene, compilation: Compilation) -> None:
    """Load the compiled kernels of fits, or compile them."""
    compile_maximisation(scene.model)
    compilation.wait()
    compile_values(scene.model)


class _Clock:
    """Seconds since the last lap, by name."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.seconds: dict[str, float] = {}

    def lap(self, name: str) -> None:
        """Book the time since the last lap under a name."""
        now = time.perf_counter()
        self.seconds[name] = now - self._last
        self._last = now
