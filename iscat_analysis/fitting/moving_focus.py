"""Models of a microscope whose focus moves while a movie is recorded."""

from __future__ import annotations

from dataclasses import replace

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.optics.memoize import memoize

STEP_NM = 5.0
"""Foci of neighbouring models are so far apart: half of it, which is the most that a frame is off,
changes a picture by a thousandth of its peak."""

DRIFT_FRAMES = 1000.0
"""Frames in which the focus rises by ``optics.focus_drift_nm``."""

_MOST_MODELS = 64  # models at hand, of some MB each


class MovingFocus:
    """Models of one movie, by frame."""

    def __init__(self, config: Config, model: ForwardModel) -> None:
        self._optics = config.optics

        def moved(steps: int) -> ForwardModel:
            if not steps:
                return model
            focus = config.optics.focus_nm + steps * STEP_NM
            optics = config.optics.model_copy(update={"focus_nm": focus})
            there = config.model_copy(update={"optics": optics, "calibration": None})
            return replace(forward_model(there, model.reach_nm, like=model), scale=model.scale)

        self._moved = memoize(_MOST_MODELS, moved)

    def at(self, frame: int) -> ForwardModel:
        """Give the model of a frame."""
        optics = self._optics
        rise = optics.focus_drift_nm * (frame - optics.focus_frame) / DRIFT_FRAMES
        return self._moved(round(rise / STEP_NM))


def refuse_moving_focus(config: Config) -> None:
    """Refuse a focus that moves where pictures are those of one focus."""
    if config.optics.focus_drift_nm:
        raise ConfigError(
            f"optics.focus_drift_nm = {config.optics.focus_drift_nm:g} is known only of landing "
            'movies (background.method = "sliding") with optics.psf = "model": set it to 0'
        )
