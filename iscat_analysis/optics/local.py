"""Optics that differ from place to place in the field, and from frame to frame.

A parameter of the optics is its value in the middle plus a few coefficients, each times a known
function of the place (x, y), in halves of the field from its centre, and of the time t:

    focus            tilt·x, tilt·y, curvature·(x² + y²), drift·t, bend·t², jumps after their frames
    reference phase  tilt·x, tilt·y, curvature·(x² + y²)
    coma             (Z8, Z7) = coma·(x, y): along the radius, as an objective has it off its axis
    astigmatism      (Z6, Z5) = a_x·(x, y) + a_y·(−y, x): what a tilted element adds to it
    reference        its amplitude times 1 + tilt·x + tilt·y + curvature·(x² + y²)

Over one picture, a fiftieth of the field, they count as constant.  The derivative with respect to a
coefficient is that with respect to the parameter times the function, so that fit, learner and bound
need no more than `WEIGHTS`.

`LocalModels` gives the model of a place and a frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

from iscat_analysis.config import FIELD_TERMS, JUMPS, MOVES, Config, Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.last_used import memoize
from iscat_analysis.optics.forward import forward_model
from iscat_analysis.optics.model import ForwardModel

DRIFT = "focus_drift_nm"
"""Rise of the focus in 1000 frames of a movie [nm]."""

DRIFT_FRAMES = 1000.0
"""Frames in which the focus rises by ``optics.focus_drift_nm``."""

BEND = "focus_bend_nm"
"""What the focus rises by beside that, 1000 frames from that of which it is configured [nm]."""

REFERENCE = "reference"
"""Amplitude of the reference, over that in the middle of the field."""


class Spot(NamedTuple):
    """Where in the field, in halves of it, and when, in thousands of frames, after what jumps."""

    x: float = 0.0
    y: float = 0.0
    t: float = 0.0
    after: tuple[bool, ...] = ()

    @property
    def r2(self) -> float:
        """Square of the distance from the centre."""
        return self.x**2 + self.y**2


def _jump(number: int) -> Callable[[Spot], Mapping[str, float]]:
    return lambda s: {"focus_nm": float(number < len(s.after) and s.after[number])}


WEIGHTS: Mapping[str, Callable[[Spot], Mapping[str, float]]] = {
    DRIFT: lambda s: {"focus_nm": s.t},
    BEND: lambda s: {"focus_nm": s.t**2},
    **{name: _jump(number) for number, name in enumerate(JUMPS)},
    "focus_tilt_x_nm": lambda s: {"focus_nm": s.x},
    "focus_tilt_y_nm": lambda s: {"focus_nm": s.y},
    "focus_curvature_nm": lambda s: {"focus_nm": s.r2},
    "coma_field_nm": lambda s: {"z8": s.x, "z7": s.y},
    "astigmatism_field_x_nm": lambda s: {"z6": s.x, "z5": s.y},
    "astigmatism_field_y_nm": lambda s: {"z6": -s.y, "z5": s.x},
    "phase_tilt_x_deg": lambda s: {"reference_phase_deg": s.x},
    "phase_tilt_y_deg": lambda s: {"reference_phase_deg": s.y},
    "phase_curvature_deg": lambda s: {"reference_phase_deg": s.r2},
    "reference_tilt_x": lambda s: {REFERENCE: s.x},
    "reference_tilt_y": lambda s: {REFERENCE: s.y},
    "reference_curvature": lambda s: {REFERENCE: s.r2},
}
"""Of every coefficient, the parameters that it changes at a spot, and by how much of itself."""

BASES: Mapping[str, tuple[str, ...]] = {name: tuple(of(Spot())) for name, of in WEIGHTS.items()}
"""The parameters that a coefficient changes."""

STEPS = {"focus_nm": 1.0, "reference_phase_deg": 0.5, "z5": 0.5, "z6": 0.5, "z7": 0.5, "z8": 0.5}
"""Changes of neighbouring models; half of one, which is the most that a spot is off, changes a
picture by a thousandth of its peak."""


def changes_at(terms: Mapping[str, float], spot: Spot) -> dict[str, float]:
    """Add up what coefficients change at a spot, by parameter."""
    out: dict[str, float] = {}
    for name, size in terms.items():
        if size and name in WEIGHTS:
            for base, weight in WEIGHTS[name](spot).items():
                out[base] = out.get(base, 0.0) + size * weight
    return out


def terms_of(optics: Optics) -> dict[str, float]:
    """Give the coefficients of optics that are not 0."""
    terms = {name: optics.field_term(name) for name in FIELD_TERMS}
    terms |= {DRIFT: optics.focus_drift_nm, BEND: optics.focus_bend_nm}
    terms |= {name: rise for name, (_, rise) in zip(JUMPS, optics.focus_jumps, strict=False)}
    return {name: size for name, size in terms.items() if size}


def when(optics: Optics, frame: float | None) -> Spot:
    """Give the time of a frame, or of that of which the focus is configured."""
    if frame is None:
        return Spot()
    after = tuple(frame >= start for start, _ in optics.focus_jumps)
    return Spot(t=(frame - optics.focus_frame) / DRIFT_FRAMES, after=after)


def moves_in(optics: Optics, settings: Mapping[str, float]) -> dict[str, Any]:
    """Give what moves the focus as keys of ``[optics]``, whose jumps have their frames."""
    keys = {name: settings[name] for name in (DRIFT, BEND) if name in settings}
    named = zip(JUMPS, optics.focus_jumps, strict=False)
    jumps = tuple((frame, settings.get(name, rise)) for name, (frame, rise) in named)
    return {**keys, "focus_jumps": jumps}


def changed(optics: Optics, changes: Mapping[str, float]) -> Optics:
    """Change parameters of optics; those of the reference's amplitude are not among them."""
    update: dict[str, Any] = {}
    aberrations = dict(optics.aberrations_nm)
    for base, change in changes.items():
        if base in ("focus_nm", "reference_phase_deg"):
            update[base] = getattr(optics, base) + change
        elif base != REFERENCE:
            aberrations[base] = aberrations.get(base, 0.0) + change
    return optics.model_copy(update={**update, "aberrations_nm": aberrations})


def brighter(model: ForwardModel, change: float) -> ForwardModel:
    """Give the model of a reference whose amplitude is larger by a share."""
    if not change or model.is_measured:
        return model
    share = 1 / (1 + change)
    factor, reference = model.factor * share, model.reference / share
    dimmed = ForwardModel.dimmed(model, share)  # spheres of other masses follow the factor
    return replace(dimmed, factor=factor, reference=reference)


def centre_of(optics: Optics, field_px: tuple[int, int]) -> tuple[float, float, float]:
    """Give the centre x, y of the field and half its longer side [pixels]."""
    rows, columns = field_px
    return optics.field_px or ((columns - 1) / 2, (rows - 1) / 2, max(rows, columns) / 2)


class LocalModels:
    """Models of one movie, by place and frame; masses have the scale of the field's centre."""

    def __init__(
        self, config: Config, model: ForwardModel, field_px: tuple[int, int], *, kept: int = 64
    ) -> None:
        self._optics = optics = config.optics
        self._terms = terms_of(optics)
        self._centre_px = centre_of(optics, field_px)
        self._pixel_nm = config.camera.pixel_size_nm or 1.0
        self._corner_nm = 0.0, 0.0

        def moved(steps: tuple[tuple[str, int], ...]) -> ForwardModel:
            if not steps:
                return model
            local = changed(optics, {base: n * STEPS[base] for base, n in steps})
            there = config.changed(optics=local, calibration=None)
            return replace(forward_model(there, model.reach_nm), scale=model.scale)

        self._moved = memoize(kept, moved)

    def on_tile(self, corner_nm: tuple[float, float]) -> LocalModels:
        """Give the same by places that count from the corner of a tile of the field."""
        there = copy(self)
        there._corner_nm = corner_nm
        return there

    def rise(self, frame: int) -> int:
        """Give by how many steps of its models the focus has risen in a frame."""
        moves = {name: size for name, size in self._terms.items() if name in MOVES}
        change = changes_at(moves, when(self._optics, frame)).get("focus_nm", 0.0)
        return round(change / STEPS["focus_nm"])

    def at(self, x_nm: float, y_nm: float, frame: float | None = None) -> ForwardModel:
        """Give the model of a place, in a frame or in that of which the focus is configured."""
        x, y, half = self._centre_px
        y_nm, x_nm = y_nm + self._corner_nm[0], x_nm + self._corner_nm[1]
        at_x, at_y = (x_nm / self._pixel_nm - x) / half, (y_nm / self._pixel_nm - y) / half
        spot = when(self._optics, frame)._replace(x=at_x, y=at_y)
        changes = changes_at(self._terms, spot)
        dimming = changes.pop(REFERENCE, 0.0)
        steps = ((base, round(change / STEPS[base])) for base, change in changes.items())
        return brighter(self._moved(tuple(sorted(step for step in steps if step[1]))), dimming)


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
    if terms and (config.fit.follows_tracks or config.optics.psf == "measured"):
        raise ConfigError(
            f"optics: {terms[0]} says that the microscope is not the same over the field, which "
            'is known only of particles that stay, with optics.psf = "model": set it to 0'
        )
