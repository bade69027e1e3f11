"""A movie that is ready to be searched: camera, optics and background mode are known."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.lines import Lines
from iscat_analysis.camera.processed import Processing
from iscat_analysis.camera.response import Response
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.noise import NoiseSurvey
from iscat_analysis.diagnosis.repeated_frames import KeptFrames
from iscat_analysis.diagnosis.stretches import Stretches
from iscat_analysis.fitting.background_mode import BackgroundMode
from iscat_analysis.movie import Stack
from iscat_analysis.records import Status


@dataclass(frozen=True)
class Prepared:
    """A movie that can be searched; `whole` is all of it, `movie` what is analysed."""

    whole: Stack
    movie: Stack
    steady: Stack
    config: Config
    camera: Camera
    background_mode: BackgroundMode
    lines: Lines | None
    opening: NoiseSurvey | None
    other_kind: str
    digest: Future[str]
    summary: Mapping[str, Any]
    stretches: Stretches
    response: Response | None = None
    processing: Processing | None = None
    kept: KeptFrames | None = None

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
