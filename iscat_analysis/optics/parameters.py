"""Parameters of the optics by name: what each may be, and the configuration that holds it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from iscat_analysis.config import JUMPS, MOVES, Config, field_keys
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.field_map import BASES, BEND, DRIFT, WEIGHTS, moves_in
from iscat_analysis.records import FloatArray

FOCUS_STEP = "focus_step_nm"
"""Rise of the focus from picture to picture of a scan [nm]; the one parameter that is not a key of
``[optics]``."""

RISES = (FOCUS_STEP, *MOVES)
"""What moves the focus from one picture to another, and is no property of the microscope."""

FIELD = tuple(name for name in WEIGHTS if name not in MOVES and not name.startswith("reference_"))
"""What differs over the field, and shows in the shape of pictures: of the reference's amplitude,
which shows in their size alone, the pictures of particles of unknown mass say nothing."""

Settings = Mapping[str, Any]
"""Values of ``[optics]`` by key, each aberration under its own name (``z5``…)."""

PRIMARY = ("z5", "z6", "z7", "z8", "z11")
"""Astigmatism, coma, spherical aberration."""

SECONDARY = ("z9", "z10")
"""Trefoil."""

HIGHER = ("z22",)
"""Secondary spherical aberration."""


@dataclass(frozen=True)
class Parameter:
    """A continuous parameter of the optics that pictures may tell."""

    group: str
    """Its name for ``--free``."""

    prior_range: float
    """How far it may plausibly lie from the configured value; what the data leave wider than this,
    they do not tell."""

    largest_step: float
    """Of one step of the search."""

    usual_error: float
    """Standard deviation of a configured value that nobody has measured."""

    mirrored: int = 1
    """Its sign in the microscope on the other side of focus that makes the same pictures."""

    period: float = math.inf
    """The change that makes no difference."""


_EVEN, _ODD = (Parameter("zernike", 100.0, 25.0, 5.0, mirrored=sign) for sign in (-1, 1))

PARAMETERS = {
    "focus_nm": Parameter("focus", 1000.0, 120.0, 30.0),
    FOCUS_STEP: Parameter("focus", 50.0, 2.0, 1.0, -1),
    DRIFT: Parameter("focus", 1000.0, 100.0, 30.0, -1),
    BEND: Parameter("focus", 4000.0, 500.0, 100.0, -1),
    **dict.fromkeys(JUMPS, Parameter("focus", 1000.0, 100.0, 30.0, -1)),
    "na": Parameter("na", 0.05, 0.02, 0.01),
    "reference_phase_deg": Parameter("phase", 180.0, 40.0, 10.0, -1, period=360.0),
    "mask_na": Parameter("mask", 0.3, 0.1, 0.02),
    "attenuation": Parameter("mask", 0.5, 0.1, 0.05),
    **{
        name: _ODD if name in ("z7", "z8", "z9", "z10") else _EVEN
        for name in PRIMARY + SECONDARY + HIGHER
    },
    "polarization_deg": Parameter("polarization", 90.0, 30.0, 5.0, period=180.0),
}
"""Every continuous parameter, in the order of results.  A new one is a row here, a value in
`settings_of`, and a derivative of the forward model."""

PARAMETERS |= {
    name: replace(
        PARAMETERS[base],
        period=math.inf,
        mirrored=-1 if base == "focus_nm" else PARAMETERS[base].mirrored,
    )
    for name, (base, *_) in BASES.items()
    if name in FIELD
}
"""A coefficient of the field changes the parameters that `WEIGHTS` says, and is as large as these.
"""

FREE = {
    group: tuple(name for name, parameter in PARAMETERS.items() if parameter.group == group)
    for group in ("focus", "na", "phase", "mask", "zernike", "polarization")
}
"""What ``--free`` may name, and the continuous parameters that each stands for; whether light is
linear or circular is a choice beside them."""

LEAST_IMAGES = 12
"""Pictures without which nothing is calibrated: eight to fit and four to judge."""

MOST_IMAGES = 60
"""Pictures that are used at most, two thirds of them to fit."""

FAINTEST = 8.0
"""Signal-to-noise ratio below which a picture says too little of the microscope."""

MASK_NA = 0.02
"""Smallest mask, and the narrowest ring around it."""

_LOWEST_NA = 0.3
_NA_ROOM = 2e-3  # below the index of the oil


def free_groups(text: str | Sequence[str] | None) -> tuple[str, ...]:
    """Read which groups of parameters are free."""
    if text is None:
        return tuple(FREE)
    if not isinstance(text, (str, list, tuple)):
        raise ConfigError(f"`free` = {text!r}: give some of {', '.join(FREE)}")
    given = [str(name) for name in (text.split(",") if isinstance(text, str) else text)]
    names = {name.strip() for name in given if name.strip()}
    unknown = sorted(names - set(FREE))
    if unknown or not names:
        raise ConfigError(
            f"`free` = {','.join(given)}: {unknown[0] if unknown else 'nothing'!r} cannot be set "
            f"free; give some of {', '.join(FREE)}"
        )
    return tuple(name for name in FREE if name in names)


def exists(name: str, settings: Settings) -> bool:
    """Tell whether a microscope has a parameter."""
    if name in ("mask_na", "attenuation"):
        return bool(settings["mask_na"] > 0)
    if name == "polarization_deg":
        return bool(settings["polarization"] == "linear")
    return name in settings


def free_names(groups: Sequence[str], settings: Settings, terms: Sequence[str]) -> tuple[str, ...]:
    """Name the continuous parameters that are free in a microscope."""
    return tuple(
        name
        for group in groups
        for name in FREE[group]
        if (not is_term(name) or name in terms) and exists(name, settings)
    )


def is_term(name: str) -> bool:
    """Tell whether a name is that of an aberration."""
    return name[0] == "z" and name[1:].isdigit()


def prior_range(name: str) -> float:
    """Give the plausible distance of a parameter from the configured value."""
    return PARAMETERS[name].prior_range


def change_of(before: Settings, after: Settings, names: Sequence[str]) -> FloatArray:
    """Change of parameters, the short way round where they are angles; shape (n,)."""
    out = np.array([after[name] - before[name] for name in names], dtype=float)
    for i, period in enumerate(PARAMETERS[name].period for name in names):
        if math.isfinite(period):
            out[i] -= period * np.rint(out[i] / period)
    return out


def optics_limits(n_immersion: float, n_glass: float) -> dict[str, tuple[float, float]]:
    """Bounds of the parameters of a microscope that can exist."""
    top = min(n_immersion, n_glass) - _NA_ROOM
    return {
        "na": (_LOWEST_NA, top),
        "mask_na": (MASK_NA, top - MASK_NA),
        "attenuation": (0.005, 1.0),
    }


def heights_free(config: Config) -> bool:
    """Tell whether every particle has a height of its own, which is fitted."""
    mode = config.fit.mode
    return (config.track.free if mode == "track" else mode) in ("localize", "joint")


def settings_of(config: Config) -> dict[str, Any]:
    """Parameters that a calibration may change, as configured."""
    optics = config.optics
    keys = ("focus_nm", "na", "reference_phase_deg", "mask_na", "attenuation",
            "polarization", "polarization_deg", "analyzer")  # fmt: skip
    terms = dict.fromkeys(filter(is_term, FREE["zernike"]), 0.0) | dict(optics.aberrations_nm)
    return {key: getattr(optics, key) for key in keys} | terms


def with_settings(config: Config, settings: Settings) -> Config:
    """Put parameters into a configuration."""
    plain = {
        k: v for k, v in settings.items() if not is_term(k) and k != FOCUS_STEP and k not in WEIGHTS
    }
    plain |= moves_in(config.optics, settings)
    plain |= field_keys({name: settings.get(name, 0.0) for name in FIELD})
    terms = {key: value for key, value in settings.items() if is_term(key) and value}
    optics = config.optics.model_copy(update={**plain, "aberrations_nm": terms})
    return config.model_copy(update={"optics": optics})


_TAKES_PART = 0.3  # component of a direction, in prior ranges, above which a parameter is named


@dataclass(frozen=True)
class Hidden:
    """A parameter that pictures do not determine within its plausible range."""

    name: str
    others: tuple[str, ...]
    direction: Mapping[str, float]

    @property
    def why(self) -> str:
        """Say it in a few words."""
        return "not told apart from " + ", ".join(self.others) if self.others else "not visible"


def find_hidden(information: FloatArray, names: Sequence[str]) -> Hidden | None:
    """Find the worst determined direction, if it is wider than what is plausible.

    Shapes: `information` (n, n).
    """
    if not names:
        return None
    scale = np.array([prior_range(name) for name in names])
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    if values[0] >= 1:
        return None
    weights = np.abs(vectors[:, 0])
    name = names[int(np.argmax(weights))]
    others = tuple(n for n, w in zip(names, weights, strict=True) if w > _TAKES_PART and n != name)
    with np.errstate(divide="ignore"):
        width = float(1 / np.sqrt(max(values[0], 0.0)))
    moves = {
        n: float(v * s * width)
        for n, v, s in zip(names, vectors[:, 0], scale, strict=True)
        if n == name or n in others
    }
    return Hidden(name, others, moves)
