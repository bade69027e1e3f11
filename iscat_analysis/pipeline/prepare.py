"""From an open movie to one whose camera, optics and kind are known: load and calibrate."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.calibration.mass import with_standards
from iscat_analysis.camera.burnt_in import text_said, text_summary, without_text
from iscat_analysis.camera.counts import Camera, camera_from_config, refuse_overflow, refuse_ratio
from iscat_analysis.camera.learned import with_camera
from iscat_analysis.camera.metadata import resolve_metadata
from iscat_analysis.camera.processed import find_processing
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.camera_numbers import law_said
from iscat_analysis.diagnosis.causes import axes_warning
from iscat_analysis.diagnosis.changes import Changes
from iscat_analysis.diagnosis.light import JudgedLight, judge_light
from iscat_analysis.diagnosis.noise import NoiseSurvey, survey_noise
from iscat_analysis.diagnosis.prepared import Prepared
from iscat_analysis.diagnosis.recognise import (
    as_landing,
    as_moving,
    changes_summary,
    look_at_changes,
)
from iscat_analysis.diagnosis.repeated_frames import without_repeats
from iscat_analysis.diagnosis.stage import followed, motion_said
from iscat_analysis.diagnosis.stretches import Stretches, find_stretches
from iscat_analysis.diagnosis.turns import refuse_channels
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.fitting.background_mode import background_mode, describe_background_mode
from iscat_analysis.fitting.ranges import fitted_frames, tracked_frames
from iscat_analysis.fitting.run import Run
from iscat_analysis.instrument.contrast_sign import learn_sign, wrong_sign
from iscat_analysis.instrument.learning import learn_optics
from iscat_analysis.movie import Stack
from iscat_analysis.pieces.setups import darkfield_photons
from iscat_analysis.search.sliding.chunks import reader_of, sum_first_chunk
from iscat_analysis.threads import beside, one_thread_algebra
from iscat_analysis.tracking.tracks import judge_times

_OPENING = 64  # frames that are looked at before anything else


def prepare(movie: Stack, config: Config, run: Run) -> Prepared:
    """Load and calibrate a movie."""
    if config.optics.scheme == "darkfield":
        darkfield_photons(config.particle)
    movie = movie.channel(config.camera.channels)
    config, notes = resolve_metadata(config, movie.metadata)
    for note in (*movie.notes, *notes):
        run.warn(note)
    way = background_mode(config)
    run.notify(describe_background_mode(config))
    span = fitted_frames(movie, config, config.background.recorded)
    tracked = config.fit.mode == "track"
    if tracked:
        for note in judge_times(config, tracked_frames(movie, config), movie.name):
            run.warn(note)
    if config.optics.psf == "measured":
        run.warn(
            'optics.psf = "measured": bounds are those of the template, and there is no quantum '
            "bound, because a picture does not say what light made it"
        )
    stretches = Stretches((span,))
    if way == "sliding" and config.optics.scheme != "darkfield":
        stretches = find_stretches(movie, span)
    asked = config.fit.frames
    if stretches.breaks:  # all that is learned of the movie is learned within one of its parts
        run.warn(stretches.message(movie.name))
        span = stretches.main
        config = _within(config, span)
    start, stop = config.background.recorded or span
    stored, auto = movie, config.camera.assumed is not config.camera
    stated = camera_from_config(config.camera, (movie.shape[1], movie.shape[2]), movie.dtype)
    refuse_ratio(movie.read(0, 1)[0], f"{movie.name}: frame 0", stated)
    refuse_channels(movie.read(start, min(stop, start + _OPENING)), stated, movie.name)
    movie, config, known = with_camera(movie, config, (start, min(stop, movie.shape[0])))
    camera = known.camera
    for text in (*known.messages, *law_said(known)):
        run.warn(f"{movie.name}: {text}")
    if known.text is not None:
        stored = without_text(stored, known.text, camera)
        run.warn(text_said(known.text, movie.name))
    if known.padding:
        run.notify(f"{movie.name}: {known.padding}")
    if auto:
        run.notify(f"{movie.name}: {known.said}")
    whole, kept = movie, None
    if way == "fixed" and not tracked and config.optics.scheme != "darkfield":
        kept = without_repeats(movie, config, camera)
        movie, config = kept.movie, kept.config
        if kept.message:
            run.warn(kept.message)
        span = fitted_frames(movie, config, config.background.recorded)
        start, stop = config.background.recorded or span
    processing = find_processing(movie, camera, span, moving=tracked)
    if processing is not None:
        run.warn(f"{movie.name}: {processing.message}")
    stop = min(stop, start + _OPENING, movie.shape[0])
    seen = movie.read(start, max(start, stop))
    if way != "sliding":  # windows that slide pass over frames that repeat
        _refuse_still(seen, f"{movie.name}: frames {start} to {stop - 1}")
    refuse_overflow(stored.read(start, max(start, stop)), movie.name)
    swapped = axes_warning(movie.name, seen)
    if swapped:
        run.warn(swapped)
    summary: dict[str, Any] = {"camera": known.summary}
    if processing is not None:
        summary["processing"] = processing.summary
    looking: Future[Changes] | None = None
    opened: NoiseSurvey | None = None

    with one_thread_algebra():  # in all threads until the light is judged
        if way == "sliding":
            judged, opened, motion = _landing_light(movie, config, camera, span)
            if config.background.drift_correction == "auto":
                config = followed(config, moves=bool(motion))
            if motion:
                run.notify(f"{movie.name}: {motion}; its motion is followed and divided out")
                judged, opened, _ = _landing_light(movie, config, camera, span)
        else:
            if tracked:  # in the light as it is; again if anything of it is unsteady
                looking = beside(look_at_changes, movie, config, camera, span)
            judged = judge_light(movie, config, camera)
    for text in judged.messages:
        run.warn(f"{movie.name}: {text}")
    unsteady = judged.steady is not movie
    movie, lines, steady = judged.movie, judged.lines, judged.steady
    if lines is not None:
        summary["lines"] = lines.summary
    if way == "sliding" or (tracked and unsteady):
        looking = beside(look_at_changes, steady, config, camera, span)
    digest = movie.hashed()
    configured = config
    wrong = wrong_sign(config)
    if wrong is not None:
        config, learned = learn_sign(
            steady, wrong, camera, warn=run.warn, notify=run.notify, opening=opened
        )
        config = _with_standards(config, run)
    else:
        config, learned = learn_optics(
            steady, _with_standards(config, run), camera,
            warn=run.warn, notify=run.notify, opening=opened,
        )  # fmt: skip
    if learned:
        summary["optics"] = learned
    run.clock.lap("optics")
    other_kind = ""
    if looking is not None:
        changes = looking.result()
        if config.optics.na != configured.optics.na:
            changes = look_at_changes(steady, config, camera, span)
        summary["changes"] = changes_summary(changes)
        other_kind = (as_landing if tracked else as_moving)(changes, movie.name)
        if other_kind:
            run.warn(other_kind)
    if way != "sliding":
        _refuse_what_only_slides(run, movie.name)
    if stretches.breaks:
        config = _within(config, asked)
    summary["left_out"] = stretches.summary | {
        "texts": [] if known.text is None else text_summary(known.text)
    }
    return Prepared(
        whole, movie, steady, config, camera, way, lines, opened, other_kind, digest, summary,
        stretches, known.response, processing, kept,
    )  # fmt: skip


def _within(config: Config, frames: tuple[int, int] | None) -> Config:
    """Look at some frames only."""
    fit = config.fit.model_copy(update={"frames": frames})
    return config.model_copy(update={"fit": fit})


def _with_standards(config: Config, run: Run) -> Config:
    """Say once that a gradient came without the optics of its standards, and where it is taken."""
    found = with_standards(config)
    if found is not config:
        optics = found.optics
        run.notify(
            "[calibration] does not say with what optics its standards were measured: the gradient "
            f"is taken at those of the configuration (focus {optics.focus_nm:g} nm, NA "
            f"{optics.na:g}, height {found.particle.nominal_height_nm:g} nm); "
            "`iscat calibrate mass` writes a line with its optics"
        )
    return found


def _landing_light(
    movie: Stack, config: Config, camera: Camera, span: tuple[int, int]
) -> tuple[JudgedLight, NoiseSurvey, str]:
    """Judge the light of a landing movie and, in steady light, noise and motion of some frames.

    Motion is looked for where that is left open, and told in words.  The first chunk, which is
    wanted next, is summed while the light is still being judged.
    """

    def opening_of(seen: Stack) -> tuple[NoiseSurvey, str]:
        opened = survey_noise(reader_of(seen, config, camera, span), config)
        left_open = config.background.drift_correction == "auto"
        motion = motion_said(seen, opened) if left_open else ""
        if not motion:
            sum_first_chunk(opened.reader, config, opened.window)
        return opened, motion

    opening = beside(opening_of, movie)  # in the light as it is; again if anything is unsteady
    judged = judge_light(movie, config, camera)
    if judged.steady is not movie:
        opening = beside(opening_of, judged.steady)
    return judged, *opening.result()


def _refuse_still(counts: NDArray[Any], name: str) -> None:
    """Refuse frames that are all the same: they have no noise, by which everything is judged."""
    if len(counts) > 1 and all(np.array_equal(frame, counts[0]) for frame in counts[1:]):
        raise DataError(f"{name} are all the same; export the movie again")


def _refuse_what_only_slides(run: Run, name: str) -> None:
    """Say that workers are left idle, and refuse to inject particles."""
    if run.place.distant:
        run.notify(f"{name}: is analysed in this process: only landing movies have chunks")
    if run.inject:
        raise ConfigError(
            f"`inject` = {run.inject}: particles are added to landing movies only, which have an "
            'interferometric scheme and background.method = "sliding"; leave it out'
        )
