"""Whether the focus moves while a landing movie is recorded, and the optics learned with that.

Pictures of particles that landed at different times tell it: what they ask to change about the
focus is then a line in their frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from iscat_analysis.config import Config
from iscat_analysis.fitting.moving_focus import DRIFT_FRAMES
from iscat_analysis.instrument.learner import (
    FOCUS_DRIFT,
    FREE,
    OpticsCalibration,
    ParticleImage,
    Settings,
    first_step,
    maximise,
    prior_range,
)
from iscat_analysis.instrument.learner.starts import with_masses
from iscat_analysis.instrument.microscope import calibrate_particle_images, microscopes
from iscat_analysis.instrument.particle_images import reach_nm
from iscat_analysis.records import Mapper

MOVES = 5.0
"""Standard errors from which a focus is said to move."""

LEAST_RISE_NM = 15.0
"""Rise over the movie below which pictures and masses hardly change."""

LEAST_PICTURES = 6
"""From fewer it is not known how well they tell a drift."""

_FOCI = 20  # parts of the movie with a focus of their own, in which pictures are looked at
_PASSES = 10


class FocusDrift(NamedTuple):
    """How the focus of a movie rises."""

    nm: float
    sigma_nm: float
    frames: tuple[int, int]

    @property
    def moves(self) -> bool:
        """Whether it does, and enough to matter."""
        return abs(self.nm) > MOVES * self.sigma_nm and abs(self._rise_nm) > LEAST_RISE_NM

    @property
    def is_plausible(self) -> bool:
        """Whether a focus can move so far; pictures that no focus describes ask for anything."""
        farthest = prior_range("focus_nm")
        return abs(self.nm) < prior_range(FOCUS_DRIFT) and abs(self._rise_nm) < farthest

    @property
    def said(self) -> str:
        """Say so, to first order."""
        return f"the focus moves by about {self._rise_nm:+.0f} nm over the movie"

    @property
    def _rise_nm(self) -> float:
        return self.nm * (self.frames[1] - self.frames[0]) / DRIFT_FRAMES


STEADY = FocusDrift(0.0, math.inf, (0, 0))
"""Where nothing is known of a drift."""


def focus_drift(
    sights: Sequence[ParticleImage],
    config: Config,
    settings: Settings,
    frames: tuple[int, int],
    mapper: Mapper = map,
) -> FocusDrift:
    """Measure how the focus rises, to first order."""
    seen = dated(sights, frames)
    if len({sight.focus_steps for sight in seen}) < LEAST_PICTURES:
        return STEADY
    build = microscopes(config, max(map(reach_nm, sights)))
    names = ("focus_nm", FOCUS_DRIFT)
    step, covariance = first_step(seen, build, {**settings, FOCUS_DRIFT: 0.0}, names, mapper)
    drift = FocusDrift(float(step[1]), math.sqrt(covariance[1, 1]), frames)
    return drift if drift.is_plausible else STEADY


def learned_with_drift(
    sights: Sequence[ParticleImage],
    others: Sequence[ParticleImage],
    config: Config,
    settings: Settings,
    drift: FocusDrift,
    source: Mapping[str, str],
    mapper: Mapper = map,
) -> OpticsCalibration:
    """Learn the optics together with the rise of their focus."""
    build, frames = microscopes(config, max(map(reach_nm, sights))), drift.frames
    near: dict[str, object] = {**settings, FOCUS_DRIFT: drift.nm}
    signed = with_masses(sights, build, settings)  # what leaves is seen before
    placed = with_masses(dated(signed, frames), build, near)
    fitted = maximise(placed, build, near, ("focus_nm", FOCUS_DRIFT), passes=_PASSES, mapper=mapper)
    optics = config.optics.model_copy(update={"focus_frame": _middle(frames)})
    return calibrate_particle_images(
        fitted.sights, dated(others, frames), config.model_copy(update={"optics": optics}),
        tuple(FREE), source, known=fitted.values, mapper=mapper,
    )  # fmt: skip


def with_drift(
    found: OpticsCalibration,
    sights: Sequence[ParticleImage],
    others: Sequence[ParticleImage],
    config: Config,
    frames: tuple[int, int],
    source: Mapping[str, str],
    mapper: Mapper = map,
) -> OpticsCalibration:
    """Look whether the focus moved in what was learned, and then learn the optics with that."""
    settings = found.measured.settings
    drift = focus_drift(found.measured.estimate.sights, config, settings, frames, mapper)
    if not drift.moves:
        return found
    moving = learned_with_drift(sights, others, config, settings, drift, source, mapper)
    return moving if moving.accepted or not found.accepted else found


def dated(sights: Sequence[ParticleImage], frames: tuple[int, int]) -> list[ParticleImage]:
    """Give pictures the time of the frames that show their particle."""
    part = max((frames[1] - frames[0]) / _FOCI, 1.0)
    middle = _middle(frames)

    def shown(sight: ParticleImage) -> float:
        before, after = sight.frames
        return before if sight.mass_kda < 0 else after

    return [
        replace(sight, focus_steps=round((shown(sight) - middle) / part) * part / DRIFT_FRAMES)
        for sight in sights
    ]


def _middle(frames: tuple[int, int]) -> int:
    return (frames[0] + frames[1]) // 2
