"""From an open movie to one whose camera, optics and kind are known: load and calibrate."""

from __future__ import annotations

from concurrent.futures import Future
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.calibration.mass import with_standards
from iscat_analysis.camera.burnt_in import text_message, text_summary, without_text
from iscat_analysis.camera.counts import Camera, camera_from_config, refuse_overflow, refuse_ratio
from iscat_analysis.camera.field_sample import whole_frames
from iscat_analysis.camera.learned import with_camera
from iscat_analysis.camera.metadata import resolve_metadata
from iscat_analysis.camera.processed import find_processing
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.camera_numbers import law_messages
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
from iscat_analysis.diagnosis.stage import motion_message, with_drift_correction
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
from iscat_analysis.search.sliding.chunks import reader_of
from iscat_analysis.search.sliding.planning import sum_first_chunk
from iscat_analysis.threads import one_thread_algebra, start_in_thread

_FIRST_FRAMES = 64  # frames that are looked at before anything else, fewer of a large field


def prepare(movie: Stack, config: Config, run: Run) -> Prepared:
    """Load and calibrate a movie."""
    if config.optics.scheme == "darkfield":
        darkfield_photons(config.particle)
    movie = movie.channel(config.camera.channels)
    config, notes = resolve_metadata(config, movie.metadata)
    for note in (*movie.notes, *notes):
        run.warn(note)
    mode = background_mode(config)
    run.notify(describe_background_mode(config))
    span = fitted_frames(movie, config, config.background.recorded)
    tracked = config.fit.mode == "track"
    if tracked:
        from iscat_analysis.tracking.tracks import judge_times

        for note in judge_times(config, tracked_frames(movie, config), movie.name):
            run.warn(note)
    if config.optics.psf == "measured":
        run.warn(
            'optics.psf = "measured": bounds are those of the template, and there is no quantum '
            "bound, because a picture does not say what light made it"
        )
    stretches = Stretches((span,))
    if mode == "sliding" and config.optics.scheme != "darkfield":
        stretches = find_stretches(movie, span, config.fit.excluded_frames)
    elif config.fit.excluded_frames:
        raise ConfigError(
            "fit.excluded_frames: frames are left out of landing movies only, which have an "
            'interferometric scheme and background.method = "sliding"; cut others with fit.frames'
        )
    asked = config.fit.frames
    if stretches.breaks:  # all that is learned of the movie is learned within one of its parts
        run.warn(stretches.message(movie.name))
        span = stretches.main
        config = _within(config, span)
    start, stop = config.background.recorded or span
    stored, auto = movie, config.camera.assumed is not config.camera
    stated = camera_from_config(config.camera, (movie.shape[1], movie.shape[2]), movie.dtype)
    refuse_ratio(movie.read(0, 1)[0], f"{movie.name}: frame 0", stated)
    first_frames = whole_frames(movie.shape[1:], _FIRST_FRAMES)
    begun = movie.read(start, max(start, min(stop, start + first_frames, movie.shape[0])))
    refuse_channels(begun, stated, movie.name)
    del begun
    movie, config, known = with_camera(movie, config, (start, min(stop, movie.shape[0])))
    camera = known.camera
    for text in (*known.messages, *law_messages(known)):
        run.warn(f"{movie.name}: {text}")
    if known.text is not None:
        stored = without_text(stored, known.text, camera)
        run.warn(text_message(known.text, movie.name))
    if known.padding_message:
        run.notify(f"{movie.name}: {known.padding_message}")
    if auto:
        run.notify(f"{movie.name}: {known.description}")
    whole, kept = movie, None
    if mode == "fixed" and not tracked and config.optics.scheme != "darkfield":
        kept = without_repeats(movie, config, camera)
        movie, config = kept.movie, kept.config
        if kept.message:
            run.warn(kept.message)
        span = fitted_frames(movie, config, config.background.recorded)
        start, stop = config.background.recorded or span
    processing = find_processing(movie, camera, span, moving=tracked)
    if processing is not None:
        run.warn(f"{movie.name}: {processing.message}")
    stop = min(stop, start + first_frames, movie.shape[0])
    seen = movie.read(start, max(start, stop))
    if mode != "sliding":  # windows that slide pass over frames that repeat
        _refuse_still(seen, f"{movie.name}: frames {start} to {stop - 1}")
    refuse_overflow(stored.read(start, max(start, stop)), movie.name)
    swapped = axes_warning(movie.name, seen)
    if swapped:
        run.warn(swapped)
    del seen
    summary: dict[str, Any] = {"camera": known.summary}
    if processing is not None:
        summary["processing"] = processing.summary
    changes_future: Future[Changes] | None = None
    noise_survey: NoiseSurvey | None = None

    with one_thread_algebra():  # in all threads until the light is judged
        if mode == "sliding":
            judged, noise_survey, motion = _landing_light(movie, config, camera, span)
            if config.background.drift_correction == "auto":
                config = with_drift_correction(config, moves=bool(motion))
            if motion:
                run.notify(f"{movie.name}: {motion}; its motion is followed and divided out")
                judged, noise_survey, _ = _landing_light(movie, config, camera, span)
        else:
            if tracked:  # in the light as it is; again if anything of it is unsteady
                changes_future = start_in_thread(look_at_changes, movie, config, camera, span)
            judged = judge_light(movie, config, camera)
    for text in judged.messages:
        run.warn(f"{movie.name}: {text}")
    unsteady = judged.steady is not movie
    movie, lines, steady = judged.movie, judged.lines, judged.steady
    if lines is not None:
        summary["lines"] = lines.summary
    if mode == "sliding" or (tracked and unsteady):
        changes_future = start_in_thread(look_at_changes, steady, config, camera, span)
    digest = movie.hashed()
    configured = config
    wrong = wrong_sign(config)
    if wrong is not None:
        config, learned = learn_sign(
            steady, wrong, camera, warn=run.warn, notify=run.notify, opening=noise_survey
        )
        config = _with_standards(config, run)
    else:
        config, learned = learn_optics(
            steady, _with_standards(config, run), camera,
            warn=run.warn, notify=run.notify, opening=noise_survey,
        )  # fmt: skip
    if learned:
        summary["optics"] = learned
    if mode == "sliding" and config.optics.focus_jumps:
        whole_of, stretches = stretches, stretches.with_jumps(
            [frame for frame, rise in config.optics.focus_jumps if rise]
        )  # fmt: skip
        if stretches is not whole_of:
            run.warn(stretches.message(movie.name))
    run.clock.lap("optics")
    other_kind = ""
    if changes_future is not None:
        changes = changes_future.result()
        if config.optics.na != configured.optics.na:
            changes = look_at_changes(steady, config, camera, span)
        summary["changes"] = changes_summary(changes)
        other_kind = (as_landing if tracked else as_moving)(changes, movie.name)
        if other_kind:
            run.warn(other_kind)
    if mode != "sliding":
        _refuse_what_only_slides(run, movie.name)
    if stretches.breaks:
        config = _within(config, asked)
    summary["left_out"] = stretches.summary | {
        "texts": [] if known.text is None else text_summary(known.text)
    }
    return Prepared(
        whole, movie, steady, config, camera, mode, lines, noise_survey, other_kind, digest,
        summary, stretches, known.response, processing, kept,
    )  # fmt: skip


def _within(config: Config, frames: tuple[int, int] | None) -> Config:
    """Look at some frames only."""
    fit = config.fit.model_copy(update={"frames": frames})
    return config.model_copy(update={"fit": fit})


def _with_standards(config: Config, run: Run) -> Config:
    """Say where the gradient is taken whose standards have no recorded optics."""
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
    """Judge the light of a landing movie, and its noise and motion once the light is steady.

    The message about motion is empty where drift correction was configured or nothing moves.  The
    first chunk, which is needed next, is summed while the light is still being judged.
    """

    def survey_light(seen: Stack) -> tuple[NoiseSurvey, str]:
        noise_survey = survey_noise(reader_of(seen, config, camera, span), config)
        left_open = config.background.drift_correction == "auto"
        motion = motion_message(noise_survey) if left_open else ""
        noise_survey.reader.forget_sample()
        if not motion:
            sum_first_chunk(noise_survey.reader, config, noise_survey.window)
        return noise_survey, motion

    # in the light as it is; again if anything is unsteady
    survey = start_in_thread(survey_light, movie)
    judged = judge_light(movie, config, camera)
    if judged.steady is not movie:
        survey = start_in_thread(survey_light, judged.steady)
    return judged, *survey.result()


def _refuse_still(counts: NDArray[Any], name: str) -> None:
    """Refuse identical frames: without noise no error can be estimated."""
    if len(counts) > 1 and all(np.array_equal(frame, counts[0]) for frame in counts[1:]):
        raise DataError(f"{name} are all the same; export the movie again")


def _refuse_what_only_slides(run: Run, name: str) -> None:
    """Refuse to inject particles, and say that workers are idle, where windows do not slide."""
    if run.executor.distant:
        run.notify(f"{name}: is analysed in this process: only landing movies have chunks")
    if run.inject:
        raise ConfigError(
            f"`inject` = {run.inject}: particles are added to landing movies only, which have an "
            'interferometric scheme and background.method = "sliding"; leave it out'
        )
