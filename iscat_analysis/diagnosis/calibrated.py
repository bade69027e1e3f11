"""The one door to a movie: steps after which its camera and its light are known.

A movie on its way to being searched: what the steps of `calibrated` have found so far.

Analysis, preview, `iscat init`, redrawn events and calibrations of the optics all open a movie by
these steps, so that they see the same frames, noise and threshold.  Each takes as many steps as it
needs, from the first on; those of an analysis go on in `iscat_analysis.pipeline.prepare`.  A step
takes a state and gives the next one, with its findings, which the user should know.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from iscat_analysis import camera as cameras
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.causes import axes_warning
from iscat_analysis.diagnosis.frames import KeptFrames, refuse_channels, without_repeats
from iscat_analysis.diagnosis.light import (
    JudgedLight,
    judge_light,
    motion_in,
    with_drift_correction,
)
from iscat_analysis.diagnosis.noise import NoiseSurvey, law_finding, survey_noise
from iscat_analysis.diagnosis.recognise import Changes, look_at_changes
from iscat_analysis.diagnosis.stretches import Stretches, find_stretches
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import Finding, existing, unreported
from iscat_analysis.findings import camera as of
from iscat_analysis.findings.files import FILE_IMPLIES
from iscat_analysis.fitting.ranges import describe_background_mode, fitted_frames
from iscat_analysis.fitting.run import Notify, notify_nobody
from iscat_analysis.movie import Stack
from iscat_analysis.pieces.counts import darkfield_photons
from iscat_analysis.records import Status
from iscat_analysis.search.chunks import reader_of, sum_first_chunk
from iscat_analysis.threads import one_thread_algebra, start_in_thread


@dataclass(frozen=True)
class Prepared:
    """A movie and what is known of it, before it is searched.

    Attributes
    ----------
    stored : Stack
        The counts of the file.
    whole : Stack
        All frames, with a linear response and without burnt-in text.
    movie : Stack
        The frames that are analysed.
    steady : Stack
        The same with what is unsteady in their light divided out.
    config : Config
        With what metadata and frames say; it is limited to the longest stretch of a movie that
        breaks until `over_all_stretches`.
    asked : Config
        The same before frames were left out.
    known : LearnedCamera
        The camera's numbers, and where they come from.
    ahead : bool
        An analysis follows, whose next sums are begun while the light is judged.
    notify : callable
        Told at once of what takes minutes.
    """

    stored: Stack
    whole: Stack
    movie: Stack
    steady: Stack
    config: Config
    asked: Config
    known: cameras.LearnedCamera
    ahead: bool = False
    notify: Notify = notify_nobody
    stretches: Stretches = field(default_factory=lambda: Stretches(()))
    kept: KeptFrames | None = None
    processing: cameras.Processing | None = None
    lines: cameras.LightModel | None = None
    opening: NoiseSurvey | None = None
    changes: Future[Changes] | None = None
    other_kind: str = ""
    summary: Mapping[str, Any] = field(default_factory=dict)

    @property
    def tracked(self) -> bool:
        """Whether particles are followed from frame to frame."""
        return self.config.fit.follows_tracks

    @property
    def camera(self) -> cameras.Camera:
        """The camera, as it is configured until its numbers are learned."""
        return self.known.camera

    @property
    def span(self) -> tuple[int, int]:
        """Frames that are fitted."""
        return fitted_frames(self.movie, self.config, self.config.background.recorded)

    @property
    def learned_from(self) -> tuple[int, int]:
        """Frames that tell of camera and light: the background's, where it has some."""
        start, stop = self.config.background.recorded or self.span
        return start, min(stop, self.movie.shape[0])

    @property
    def flags(self) -> tuple[Status, ...]:
        """Flags of all rows, because they are about the movie."""
        law = self.camera.law
        bent = law is not None and (law.bent or (law.dilutes and law.flickers))
        found = {Status.NONLINEAR: bent, Status.PROCESSED: self.processing is not None}
        return tuple(flag for flag, true in found.items() if true)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.movie.shape[1], self.movie.shape[2]

    def over_all_stretches(self) -> Prepared:
        """Take all stretches of a movie that breaks, not only the one in which it was learned."""
        if not self.stretches.breaks:
            return self
        return replace(self, config=within(self.config, self.asked.fit.frames))

    def with_frames_asked(self, config: Config) -> Config:
        """Put the frames into a configuration that were asked for before some were left out."""
        asked = {"fit": self.asked.fit, "background": self.asked.background}
        return config.model_copy(update=asked)


def within(config: Config, frames: tuple[int, int] | None) -> Config:
    """Fit some frames only."""
    return config.changed(fit={"frames": frames})


Step = Callable[[Prepared], tuple[Prepared, Sequence[Finding | None]]]
"""What is known → what is known after the step, and what it found."""


def metadata(state: Prepared) -> tuple[Prepared, list[Finding | None]]:
    """Choose the channel, and take what the file says of the recording."""
    config = state.config
    if not config.optics.interferes:
        darkfield_photons(config.particle)
    movie = state.movie.channel(config.camera.channels)
    config, notes = cameras.resolve_metadata(config, movie.metadata)
    findings: list[Finding | None] = [
        *(FILE_IMPLIES({"text": note}) for note in movie.notes),
        *notes,
    ]
    findings.append(of.BACKGROUND_WAY({"text": describe_background_mode(config)}))
    if config.optics.psf == "measured":
        findings.append(of.TEMPLATE_BOUNDS())
    span = fitted_frames(movie, config, config.background.recorded)
    state = replace(state, stored=movie, whole=movie, movie=movie, steady=movie)
    state = replace(state, config=config, asked=config, stretches=Stretches((span,)))
    return state, findings


def breaks(state: Prepared) -> tuple[Prepared, list[Finding | None]]:
    """Find where a landing movie breaks; what is learned of it is learned within one stretch."""
    config, movie = state.config, state.movie
    if not (config.background.slides and config.optics.interferes):
        if config.fit.excluded_frames:
            raise ConfigError(
                "fit.excluded_frames: frames are left out of landing movies only, which have an "
                'interferometric scheme and background.method = "sliding"; cut others with '
                "fit.frames"
            )
        return state, []
    found = find_stretches(movie, state.span, config.fit.excluded_frames)
    if not found.breaks:
        return replace(state, stretches=found), []
    state = replace(state, stretches=found, config=within(config, found.main))
    return state, [found.finding(movie.name)]


def camera(state: Prepared) -> tuple[Prepared, list[Finding | None]]:
    """Refuse what is no camera's movie, learn the camera's numbers, and leave out burnt-in text."""
    movie, config, stated = state.movie, state.config, state.camera
    name, learned_from = movie.name, state.learned_from
    cameras.refuse_ratio(movie.read(0, 1)[0], f"{name}: frame 0", stated)
    refuse_channels(movie.read(*_first_frames(state)), stated, name)
    movie, config, known = cameras.with_camera(movie, config, learned_from)
    findings = [*(replace(one, where=name) for one in known.findings), law_finding(known, name)]
    stored = state.stored
    if known.text is not None:
        stored = cameras.without_text(stored, known.text, known.camera)
        findings.append(cameras.text_finding(known.text, name))
    findings.append(known.padding(name))
    if state.config.camera.assumed is not state.config.camera:
        findings.append(of.CAMERA_NUMBERS({"text": known.description}, where=name))
    state = replace(state, stored=stored, whole=movie, movie=movie, steady=movie)
    state = replace(state, config=config, known=known, summary={"camera": known.summary})
    return state, findings


def repeats(state: Prepared) -> tuple[Prepared, list[Finding | None]]:
    """Leave out frames that were stuck in the camera, where a background was recorded."""
    config = state.config
    if config.background.way != "fixed" or state.tracked or not config.optics.interferes:
        return state, []
    kept = without_repeats(state.movie, config, state.camera)
    state = replace(state, movie=kept.movie, steady=kept.movie, config=kept.config, kept=kept)
    return state, [kept.finding]


def counts(state: Prepared) -> tuple[Prepared, list[Finding | None]]:
    """Refuse counts that no camera gives, and find what was done to them before."""
    movie, name = state.movie, state.movie.name
    processing = cameras.find_processing(movie, state.camera, state.span, moving=state.tracked)
    start, stop = _first_frames(state)
    seen = movie.read(start, stop)
    if not state.config.background.slides:  # windows that slide pass over frames that repeat
        still = all(np.array_equal(frame, seen[0]) for frame in seen[1:])
        if len(seen) > 1 and still:  # without noise no error can be estimated
            raise DataError(
                f"{name}: frames {start} to {stop - 1} are all the same; export the movie again"
            )
    cameras.refuse_overflow(state.stored.read(start, stop), name)
    findings = [axes_warning(name, seen)]
    if processing is None:
        return state, findings
    findings.insert(0, replace(processing.finding, where=name))
    summary = {**state.summary, "processing": processing.summary}
    return replace(state, processing=processing, summary=summary), findings


def light(state: Prepared) -> tuple[Prepared, list[Finding | None]]:
    """Divide out unsteady light; of a landing movie judge motion, noise and window, too."""
    movie, config, name = state.movie, state.config, state.movie.name
    opening, changes = None, None
    findings: list[Finding | None] = []
    slides = config.background.slides
    follow = state.ahead and (state.tracked or slides)
    with one_thread_algebra():  # in all threads until the light is judged
        if slides:
            judged, opening, motion = _landing_light(state, config)
            if config.background.drift_correction == "auto":
                config = with_drift_correction(config, moves=bool(motion))
            if motion:
                findings.append(of.PATTERN_FOLLOWED({"what": motion}, where=name))
                judged, opening, _ = _landing_light(state, config)
        else:
            if follow:  # in the light as it is; again if anything of it is unsteady
                changes = start_in_thread(look_at_changes, movie, config, state.camera, state.span)
            judged = judge_light(movie, config, state.camera)
    findings += judged.findings
    if follow and (changes is None or judged.steady is not movie):
        steady = judged.steady
        changes = start_in_thread(look_at_changes, steady, config, state.camera, state.span)
    lines = {} if judged.lines is None else {"lines": judged.lines.summary}
    state = replace(state, movie=judged.movie, steady=judged.steady, lines=judged.lines)
    summary = {**state.summary, **lines}
    state = replace(state, config=config, opening=opening, changes=changes, summary=summary)
    return state, findings


SCAN_STEPS: tuple[Step, ...] = (metadata, camera)
"""Of a scan of the focus, whose light changes from frame to frame because it is scanned."""

LIGHT_STEPS: tuple[Step, ...] = (metadata, breaks, camera, repeats, counts, light)
"""From an open movie to steady light."""


def calibrated(
    movie: Stack,
    config: Config,
    steps: Sequence[Step] = LIGHT_STEPS,
    *,
    report: Callable[[Finding], None] = unreported,
    notify: Notify = notify_nobody,
    ahead: bool = False,
) -> Prepared:
    """Take a movie through steps; `ahead` where an analysis follows."""
    stated = cameras.camera_from_config(config.camera, movie.shape[1:], movie.dtype)
    known = cameras.LearnedCamera(config.camera, stated, {}, ())
    state = Prepared(movie, movie, movie, movie, config, config, known, ahead, notify)
    for step in steps:
        state, findings = step(state)
        for finding in existing(findings):
            report(finding)
    return state


def _first_frames(state: Prepared) -> tuple[int, int]:
    """Give the few frames that are looked at before anything else."""
    start, stop = state.learned_from
    return start, max(start, min(stop, start + cameras.whole_frames(state.shape, 64)))


def _landing_light(state: Prepared, config: Config) -> tuple[JudgedLight, NoiseSurvey, str]:
    """Judge the light of a landing movie, and its noise and motion once the light is steady.

    The message about motion is empty where drift correction was configured or nothing moves.  The
    first chunk, which an analysis needs next, is summed while the light is still being judged.
    """
    movie, span = state.movie, state.span

    def survey_light(seen: Stack) -> tuple[NoiseSurvey, str]:
        opening = survey_noise(reader_of(seen, config, state.camera, span), config)
        left_open = config.background.drift_correction == "auto"
        motion = motion_in(opening) if left_open else ""
        opening.reader.forget_sample()
        if state.ahead and not motion:
            sum_first_chunk(opening.reader, config, opening.window)
        return opening, motion

    # in the light as it is; again if anything is unsteady
    survey = start_in_thread(survey_light, movie)
    judged = judge_light(movie, config, state.camera)
    if judged.steady is not movie:
        survey = start_in_thread(survey_light, judged.steady)
    return judged, *survey.result()
