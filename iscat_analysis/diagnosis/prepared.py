"""A movie on its way to being searched: what the steps of `calibrated` have found so far."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.learned import LearnedCamera
from iscat_analysis.camera.lines import Lines
from iscat_analysis.camera.processed import Processing
from iscat_analysis.camera.response import Response
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.changes import Changes
from iscat_analysis.diagnosis.noise import NoiseSurvey
from iscat_analysis.diagnosis.repeated_frames import KeptFrames
from iscat_analysis.diagnosis.stretches import Stretches
from iscat_analysis.fitting.ranges import BackgroundMode, background_mode, fitted_frames
from iscat_analysis.fitting.run import Notify, notify_nobody
from iscat_analysis.movie import Stack
from iscat_analysis.records import Status


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
    known: LearnedCamera
    ahead: bool = False
    notify: Notify = notify_nobody
    stretches: Stretches = field(default_factory=lambda: Stretches(()))
    kept: KeptFrames | None = None
    processing: Processing | None = None
    lines: Lines | None = None
    opening: NoiseSurvey | None = None
    changes: Future[Changes] | None = None
    other_kind: str = ""
    summary: Mapping[str, Any] = field(default_factory=dict)

    @property
    def background_mode(self) -> BackgroundMode:
        """Which frames are compared with which."""
        return background_mode(self.config)

    @property
    def tracked(self) -> bool:
        """Whether particles are followed from frame to frame."""
        return self.config.fit.mode == "track"

    @property
    def camera(self) -> Camera:
        """The camera, as it is configured until its numbers are learned."""
        return self.known.camera

    @property
    def response(self) -> Response | None:
        """Response curve of the camera, where the counts show one."""
        return self.known.response

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
    def digest(self) -> Future[str]:
        """Hash of the file."""
        return self.movie.hashed()

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
    fit = config.fit.model_copy(update={"frames": frames})
    return config.model_copy(update={"fit": fit})
