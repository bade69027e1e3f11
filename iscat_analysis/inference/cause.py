"""Why a model does not describe bright particles: the shape of what it leaves over.

What the fits of several particles leave over is regressed, in standard deviations, on the change
that each parameter of the microscope makes to the picture, with the directions of the fit (place,
height, mass and level) taken out; once for a small step of the parameter, and once for the step
that this asks for.  The parameter that explains most of χ² is named.  It is a hint: a step towards
another microscope, one parameter at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.fit import AMPLITUDE
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import PixelGrid, forward_model
from iscat_analysis.records import BoolArray, FloatArray

LEAST_EXPLAINED_SHARE = 0.3
"""Share of χ² in excess that a parameter must explain to be named."""


class _Part(NamedTuple):
    """A number of the microscope: keys of ``[optics]`` or Zernike terms, with small steps of them.

    Beside the critical angle, and where rings have moved by half of their distance, a first order
    says little: steps that are `far` are tried whole.  In dark field, where light on either side of
    the best focus looks much alike, `far_dark` replaces them.
    """

    steps: Mapping[str, float]
    unit: str | None = None
    far: Sequence[float] = ()
    far_dark: Sequence[float] = ()


def _both_ways(step: float, count: int) -> tuple[float, ...]:
    return tuple(step * k for k in range(-count, count + 1) if k)


PIXEL, _WAVELENGTH = "camera.pixel_size_nm", "wavelength"
_PHASE = "reference phase"
_PARTS = {
    "focus": _Part({"focus_nm": 20.0}, "nm", _both_ways(50.0, 6), _both_ways(50.0, 20)),
    "numerical aperture": _Part({"na": 0.005}, "", _both_ways(0.03, 5)),
    _WAVELENGTH: _Part({"wavelength_nm": 2.0}, "nm", _both_ways(20.0, 4)),
    _PHASE: _Part({"reference_phase_deg": 5.0}, "degrees"),
    "spherical aberration": _Part({"z11": 5.0}, "nm rms", far_dark=_both_ways(15.0, 4)),
    "astigmatism": _Part({"z5": 5.0, "z6": 5.0}),
    "coma": _Part({"z7": 5.0, "z8": 5.0}),
    PIXEL: _Part({}, "%", _both_ways(5.0, 4)),
}
"""Steps are small enough for a first order, and for what a table of the field resolves."""

_TURNED = "polarisation, as if turned by 90° (or the movie transposed)"
_MASK = "mask in the pupil"
_OTHERS: Mapping[str, Mapping[str, Any]] = {
    _TURNED: {},
    "polarisation, as if circular light passed an analyser": {
        "polarization": "circular",
        "analyzer": True,
    },
    "polarisation, as if linear light reached the camera without an analyser": {
        "polarization": "linear",
        "analyzer": False,
    },
    _MASK: {"mask_na": 0.6, "attenuation": 0.3},
    'emission, as if it were "dong2021"': {"emission": "dong2021"},
    'emission, as if it were "reciprocal"': {"emission": "reciprocal"},
}
"""Other settings, which are there or not; of a mask any share."""

_WHOLE_STEP = 0.5  # of one that is tried whole, which the residuals ask for at least
_MOST_SCALE_CHANGE = 30.0  # per cent, farther than which no pixel size is tried

_Picture = Callable[[PixelGrid, float, float, float, float], FloatArray]


@dataclass(frozen=True)
class Cause:
    """The change of the microscope that the residuals of several fits resemble."""

    name: str
    share: float
    step: float | None
    unit: str
    events: int
    learned: bool
    other_steps: tuple[float, ...] = ()
    rivals: tuple[tuple[str, float, str], ...] = ()

    @property
    def likeness(self) -> str:
        """What the residuals resemble, in words."""
        by = ""
        if self.step is not None:
            *first, last = (_rounded(step) for step in (self.step, *self.other_steps))
            several = f"{', '.join(first)} or {last}" if first else last
            by = f", off by about {several} {self.unit}".rstrip()
        by += "".join(
            f", or {name}, by {_rounded(step)} {unit}" for name, step, unit in self.rivals
        )
        if self.other_steps or self.rivals:
            by += ", which these pictures do not tell apart"
        return f"a wrong {self.name}{by} ({self.share:.0%} of it)"

    @property
    def message(self) -> str:
        """One line for the user."""
        elsewhere = "" if self.learned else " with an interferometric movie of the same microscope"
        remedy = f"correct it, or calibrate the optics{elsewhere}"
        # Share below which more may be wrong, and a correction of that parameter alone is no
        # advice
        if self.share < 0.6:
            remedy = f"that explains only a part, so calibrate the optics{elsewhere}"
        return (
            f"the model does not describe the brightest particles ({self.events} looked at): what "
            f"it leaves over looks most like {self.likeness}; {remedy}"
        )


def likely_cause(
    config: Config, fits: Sequence[tuple[Likelihood, FloatArray, BoolArray]]
) -> Cause | None:
    """Name the part of the microscope whose change resembles the residuals most."""
    if not fits or config.optics.convention != "exact":
        return None
    left = [_Left.of(*fit) for fit in fits]
    excess = sum(each.excess for each in left)
    if excess <= 0:
        return None
    found = {name: _explained_by(config, name, left, excess) for name in (*_PARTS, *_OTHERS)}
    named = {name: tried for name, tried in found.items() if tried[0][0] > LEAST_EXPLAINED_SHARE}
    if not named:  # a share is above 1 where there is less noise than the camera's numbers say
        return None
    name = max(named, key=lambda name: named[name][0][0])
    share, step = named[name][0]
    pixels = sum(each.rest.size for each in left)
    # causes that are both tried whole differ by 3 % of χ² in excess, and by 4 standard errors
    margin = max(1 - share, 0.03) + 4.0 * math.sqrt(2 * pixels) / excess

    others = [other for s, other in named[name][1:] if s > share - margin]
    # what stretches pictures: a movie may not tell one from the other
    rival = {PIXEL: _WAVELENGTH, _WAVELENGTH: PIXEL}.get(name, "")
    rivals = [
        (rival, other, _PARTS[rival].unit or "")
        for share_of_other, other in named.get(rival, ())
        if share_of_other > share - margin
    ]
    unit = _PARTS[name].unit if name in _PARTS else None
    return Cause(
        name=name,
        share=min(share, 1.0),
        step=None if unit is None else step,
        unit=unit or "",
        events=len(fits),
        learned=config.optics.interferes,
        other_steps=tuple(others),
        rivals=tuple(rivals),
    )


def _explained_by(
    config: Config, name: str, left: Sequence[_Left], excess: float
) -> list[tuple[float, float]]:
    """Share of the excess χ² that each step of a parameter explains, and that step.

    The best one comes first.  The others are local maxima, such as pictures on the other side of
    focus.
    """
    part, reach = _PARTS.get(name), left[0].reach_nm
    changes = _neighbours(config, name, reach)
    if not changes:
        return [(0.0, 0.0)]
    share, steps = _explained(left, changes, excess, whole=part is None and name != _MASK)
    step = float(steps[0])
    if part is None or len(changes) > 1:
        return [(share, step)]
    # far from a first order: the same, as far away as it seems, if a microscope is there
    turns = name == _PHASE and left[0].free_mass
    if turns:
        # A picture turned by Δ is cos Δ of the picture plus sin Δ of its derivative.  The fitted
        # mass takes up the cosine, so that the residual per mass is tan Δ.
        step = math.degrees(math.atan(math.radians(step)))
    if share > LEAST_EXPLAINED_SHARE and (there := _neighbours(config, name, reach, step)):
        share, steps = _explained(left, there, excess)
        step = step if turns else float(steps[0])
    far_dark = () if config.optics.interferes else part.far_dark
    whole: list[tuple[float, float]] = []
    for far in far_dark or part.far:
        if not (there := _neighbours(config, name, reach, far)):
            continue
        share_there, steps = _explained(left, there, excess)
        # what is as bright elsewhere may be much brighter here: of |E|² only the shape is alike
        alike = _WHOLE_STEP < steps[0] / far < 1 / _WHOLE_STEP
        if alike or (far_dark and steps[0] / far > 0):
            whole.append((share_there, far))
    return _peaks((share, step), whole) if far_dark else [max([(share, step), *whole])]


def _peaks(
    best: tuple[float, float], whole: list[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Find the steps that explain more than the neighbouring ones, the best first.

    A step from a first-order fit replaces the neighbouring grid step if it explains more.
    """
    tops = [
        each
        for before, each, after in zip([None, *whole], whole, [*whole[1:], None], strict=False)
        if (before is None or each > before) and (after is None or each > after)
    ]
    near = [top for top in tops if top[1] * best[1] > 0]
    if not near or best > max(near):
        tops = [top for top in tops if top not in near] + [best]
    return sorted(tops, reverse=True)


@dataclass(frozen=True)
class _Left:
    """Residual of one fit, in standard deviations, with the directions of the fit projected out."""

    grid: PixelGrid
    place: tuple[float, float, float, float]
    signal: FloatArray
    used: BoolArray
    root: FloatArray
    fitted: FloatArray
    rest: FloatArray
    excess: float
    reach_nm: float
    free_mass: bool

    @classmethod
    def of(cls, likelihood: Likelihood, theta: FloatArray, free: BoolArray) -> _Left:
        residual = likelihood.residuals(theta)
        used = np.isfinite(residual)
        signal = likelihood.signal(theta)
        root = np.sqrt(likelihood.signal_information(signal))[used]
        _, first = likelihood.model.signal(likelihood.grid, theta[:4])
        level = likelihood.noise.terms(likelihood.data, signal, 0.0).by_level
        columns = [
            each[used] * root
            for each, is_free in zip([*first, level], free, strict=True)
            if is_free
        ]
        fitted, _ = np.linalg.qr(np.stack(columns, axis=1))
        rest = residual[used]
        mass = float(likelihood.model.scale.mass(theta[3]))
        return cls(
            grid=likelihood.grid,
            place=(float(theta[0]), float(theta[1]), float(theta[2]), mass),
            signal=signal, used=used, root=root, fitted=fitted,
            rest=rest - fitted @ (fitted.T @ rest), excess=float(rest @ rest) - rest.size,
            reach_nm=likelihood.model.reach_nm, free_mass=bool(free[AMPLITUDE]),
        )  # fmt: skip

    def change(self, step: float, picture: _Picture) -> FloatArray:
        """Change of the picture per unit of a step."""
        change = (picture(self.grid, *self.place) - self.signal)[self.used] * self.root / step
        return np.asarray(change - self.fitted @ (self.fitted.T @ change))


def _rounded(step: float) -> str:
    """Write a number with two digits and its sign."""
    return f"{float(f'{step:.2g}'):+g}"


def _explained(
    left: Sequence[_Left],
    changes: Sequence[tuple[float, _Picture]],
    excess: float,
    *,
    whole: bool = False,
) -> tuple[float, FloatArray]:
    """Share of the excess χ² that changes of the microscope explain, and their sizes.

    Of changes that are `whole`, present or not, only one is taken.
    """
    slope, curvature = np.zeros(len(changes)), np.zeros((len(changes), len(changes)))
    for each in left:
        change = np.stack([each.change(*one) for one in changes], axis=1)
        slope += change.T @ each.rest
        curvature += change.T @ change
    step = np.asarray(np.linalg.lstsq(curvature, slope, rcond=1e-9)[0], dtype=np.float64)
    if whole:
        step = np.ones(len(changes))
    return float(2 * slope @ step - step @ curvature @ step) / excess, step


def _neighbours(
    config: Config, name: str, reach_nm: float, far: float | None = None
) -> list[tuple[float, _Picture]]:
    """Give configurations that differ in one parameter of the microscope.

    They differ by `far` where it is given, else by small steps.  There are none where no optics
    have such a value, or where particles would change their sign against the calibration line.
    """
    optics, terms = config.optics, config.optics.aberrations_nm
    if name == PIXEL:
        percent = 1.0 if far is None else max(min(far, _MOST_SCALE_CHANGE), -_MOST_SCALE_CHANGE)
        larger = 1 + percent / 100
        model = forward_model(config, reach_nm * max(1.01 * larger, 1.0))

        def stretched(grid: PixelGrid, x: float, y: float, z: float, mass: float) -> FloatArray:
            across, down = larger * (grid.x_nm - x), larger * (grid.y_nm - y)
            return model.image(PixelGrid(across, down, grid.pixel_nm), 0.0, 0.0, z, mass)

        return [(percent, stretched)]
    updates: list[tuple[float, dict[str, Any]]]
    if name in _PARTS:
        steps = {key: step if far is None else far for key, step in _PARTS[name].steps.items()}
        na = optics.na + steps.get("na", 0.0)
        wavelength_nm = optics.wavelength_nm + steps.get("wavelength_nm", 0.0)
        if not (0 < na < min(optics.n_immersion, optics.n_glass) and wavelength_nm > 0):
            return []
        updates = [
            (step, {key: getattr(optics, key) + step})
            if hasattr(optics, key)
            else (step, {"aberrations_nm": {**terms, key: terms.get(key, 0.0) + step}})
            for key, step in steps.items()
        ]
    else:
        other = dict(_OTHERS[name])
        same = all(getattr(optics, key) == value for key, value in other.items())
        if name == _TURNED:
            other = {"polarization_deg": (optics.polarization_deg + 90.0) % 180.0}
            same = optics.polarization == "circular"
        updates = [] if same or (name == _MASK and optics.mask_na > 0) else [(1.0, other)]
    others = [(step, config.changed(optics=update)) for step, update in updates]
    try:
        return [(step, forward_model(other, reach_nm).image) for step, other in others]
    except ConfigError:
        return []
