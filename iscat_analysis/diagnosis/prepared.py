"""A movie whose camera, optics and kind are known."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from iscat_analysis.camera.counts import Camera
from iscat_analysis.camera.lines import Lines
from iscat_analysis.camera.response import Response
from iscat_analysis.config import Config
from iscat_analysis.diagnosis.noise import NoiseSurvey
from iscat_analysis.fitting.background_mode import BackgroundMode
from iscat_analysis.movie import Stack


@dataclass(frozen=True)
class Prepared:
    """A movie that can be searched."""

    movie: Stack
    steady: Stack
    config: Config
    camera: Camera
    way: BackgroundMode
    lines: Lines | None
    opening: NoiseSurvey | None
    other_kind: str
    digest: Future[str]
    summary: Mapping[str, Any]
    response: Response | None = None

    @property
    def distorted(self) -> bool:
        """Whether all masses are wrong, because counts are not in proportion to the light."""
        law = self.camera.law
        if law is None:
            return False
        return law.bent or (law.dilutes and law.flickers)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.movie.shape[1], self.movie.shape[2]
