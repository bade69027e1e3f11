"""Models of a microscope that is not the same everywhere in the field, or in all frames."""

from __future__ import annotations

from dataclasses import replace

from iscat_analysis.config import MOVES, Config, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.field_map import (
    REFERENCE,
    STEPS,
    brighter,
    centre_of,
    changed,
    changes_at,
    terms_of,
    when,
)
from iscat_analysis.optics.forward import ForwardModel, forward_model
from iscat_analysis.optics.memoize import memoize


class LocalModels:
    """Models of one movie, by place and frame; masses have the scale of the field's centre."""

    def __init__(
        self, config: Config, model: ForwardModel, field_px: tuple[int, int], *, kept: int = 64
    ) -> None:
        self._optics = optics = config.optics
        self._terms = terms_of(optics)
        self._centre_px = centre_of(optics, field_px)
        self._pixel_nm = config.camera.pixel_size_nm or 1.0

        def moved(steps: tuple[tuple[str, int], ...]) -> ForwardModel:
            if not steps:
                return model
            local = changed(optics, {base: n * STEPS[base] for base, n in steps})
            there = config.model_copy(update={"optics": local, "calibration": None})
            return replace(forward_model(there, model.reach_nm), scale=model.scale)

        self._moved = memoize(kept, moved)

    def rise(self, frame: int) -> int:
        """Give by how many steps of its models the focus has risen in a frame."""
        moves = {name: size for name, size in self._terms.items() if name in MOVES}
        change = changes_at(moves, when(self._optics, frame)).get("focus_nm", 0.0)
        return round(change / STEPS["focus_nm"])

    def at(self, x_nm: float, y_nm: float, frame: float | None = None) -> ForwardModel:
        """Give the model of a place, in a frame or in that of which the focus is configured."""
        x, y, half = self._centre_px
        at_x, at_y = (x_nm / self._pixel_nm - x) / half, (y_nm / self._pixel_nm - y) / half
        spot = when(self._optics, frame)._replace(x=at_x, y=at_y)
        changes = changes_at(self._terms, spot)
        dimming = changes.pop(REFERENCE, 0.0)
        steps = ((base, round(change / STEPS[base])) for base, change in changes.items())
        return brighter(self._moved(tuple(sorted(step for step in steps if step[1]))), dimming)


class ModelsFrom:
    """Models of a movie by places that count from a corner, as those of a tile of the field."""

    def __init__(self, whole: LocalModels, corner_nm: tuple[float, float]) -> None:
        self._whole, (self._y_nm, self._x_nm) = whole, corner_nm

    def at(self, x_nm: float, y_nm: float, frame: float | None = None) -> ForwardModel:
        """Give the model of a place; see `LocalModels`."""
        return self._whole.at(x_nm + self._x_nm, y_nm + self._y_nm, frame)


def refuse_moving_focus(config: Config) -> None:
    """Refuse a focus that moves where pictures are those of one focus."""
    moves = [name for name in terms_of(config.optics) if name in MOVES]
    if moves:
        key = moves[0] if moves[0] in Optics.model_fields else "focus_jumps"
        raise ConfigError(
            f"optics.{key} = {getattr(config.optics, key)} is known only of landing "
            'movies (background.method = "sliding") with optics.psf = "model": leave it out'
        )


def refuse_uneven_field(config: Config) -> None:
    """Refuse optics that differ over the field where one model serves all of it."""
    terms = [name for name in terms_of(config.optics) if name not in MOVES]
    if terms and (config.fit.mode == "track" or config.optics.psf == "measured"):
        raise ConfigError(
            f"optics: {terms[0]} says that the microscope is not the same over the field, which "
            'is known only of particles that stay, with optics.psf = "model": set it to 0'
        )
