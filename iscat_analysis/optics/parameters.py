"""Parameters of the optics by name: what each may be, and the configuration that holds it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from iscat_analysis.config import JUMPS, MOVES, Config, field_keys
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.local import BASES, BEND, DRIFT, WEIGHTS, moves_in
from iscat_analysis.records import BoolArray, FloatArray

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
class OpticsParameter:
    """A continuous parameter of the optics that pictures may tell."""

    group: str
    """Its name for ``--free``."""

    largest_step: float
    """Of one step of the search."""

    usual_error: float
    """Standard deviation of a configured value that nobody has measured: of the prior, unless
    ``[uncertainty] optics`` has another."""

    mirrored: int = 1
    """Its sign in the microscope on the other side of focus that makes the same pictures."""

    period: float = math.inf
    """The change that makes no difference."""


_EVEN, _ODD = (OpticsParameter("zernike", 25.0, 10.0, mirrored=sign) for sign in (-1, 1))

PARAMETERS = {
    "focus_nm": OpticsParameter("focus", 120.0, 150.0),
    FOCUS_STEP: OpticsParameter("focus", 2.0, 5.0, -1),
    DRIFT: OpticsParameter("focus", 100.0, 150.0, -1),
    BEND: OpticsParameter("focus", 500.0, 500.0, -1),
    **dict.fromkeys(JUMPS, OpticsParameter("focus", 100.0, 150.0, -1)),
    "na": OpticsParameter("na", 0.02, 0.01),
    "reference_phase_deg": OpticsParameter("phase", 40.0, 20.0, -1, period=360.0),
    "mask_na": OpticsParameter("mask", 0.1, 0.02),
    "attenuation": OpticsParameter("mask", 0.1, 0.05),
    **{
        name: _ODD if name in ("z7", "z8", "z9", "z10") else _EVEN
        for name in PRIMARY + SECONDARY + HIGHER
    },
    "z11": replace(_EVEN, usual_error=20.0),
    "polarization_deg": OpticsParameter("polarization", 30.0, 45.0, period=180.0),
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
"""Pictures of which a third is not fitted but judges, eight and four; of fewer the evidence does.
"""

MOST_IMAGES = 60
"""Pictures that are used at most, two thirds of them to fit."""

FAINTEST = 8.0
"""Signal-to-noise ratio below which a picture says too little of the microscope."""

MASK_NA = 0.02
"""Smallest mask, and the narrowest ring around it."""

_LOWEST_NA = 0.3


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


def change_of(before: Settings, after: Settings, names: Sequence[str]) -> FloatArray:
    """Change of parameters, the short way round where they are angles; shape (n,)."""
    out = np.array([after[name] - before[name] for name in names], dtype=float)
    for i, period in enumerate(PARAMETERS[name].period for name in names):
        if math.isfinite(period):
            out[i] -= period * np.rint(out[i] / period)
    return out


def optics_limits(n_immersion: float, n_glass: float) -> dict[str, tuple[float, float]]:
    """Bounds of the parameters of a microscope that can exist."""
    # a little below the index of the oil
    top = min(n_immersion, n_glass) - 2e-3
    return {
        "na": (_LOWEST_NA, top),
        "mask_na": (MASK_NA, top - MASK_NA),
        "attenuation": (0.005, 1.0),
    }


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
    return config.changed(optics={**plain, "aberrations_nm": terms})


_HALF_TURN = 180.0  # of the phase, after which particles look the same with the other sign
_SOME_MASK = {"mask_na": (0.65, 0.25), "attenuation": (0.4, 0.3)}
"""Middle and standard deviation of a mask of which the configuration knows nothing."""

_DIM_SHARE = 0.2
"""Largest usual error of a mask's transmission, over it: contrasts are as its inverse."""


@dataclass(frozen=True)
class Prior:
    """What is known of the optics before any particle is seen: a normal density of each parameter.

    Its middle is what is configured, its width the usual error of that.
    """

    middle: Settings
    own: Mapping[str, float] = field(default_factory=dict[str, float])
    """Standard deviations that are not the usual ones."""

    def errors(self, names: Sequence[str]) -> FloatArray:
        """Give the standard deviations of parameters, shape (n,)."""
        usual = {name: PARAMETERS.get(name, _EVEN).usual_error for name in names}
        if not self.middle["mask_na"]:
            usual |= {name: sigma for name, (_, sigma) in _SOME_MASK.items()}
        elif "attenuation" in usual:
            dim = _DIM_SHARE * float(self.middle["attenuation"])
            usual["attenuation"] = min(usual["attenuation"], dim)
        return np.array([self.own.get(name, usual[name]) for name in names], dtype=float)

    def changes(self, values: Settings, names: Sequence[str]) -> FloatArray:
        """Give how far parameters are from the middle, in standard deviations, shape (n,)."""
        middle = dict.fromkeys(names, 0.0) | dict(self.middle)
        if not self.middle["mask_na"]:
            middle |= {name: centre for name, (centre, _) in _SOME_MASK.items()}
        out = change_of(middle, values, names)
        for i, name in enumerate(names):
            if math.isfinite(PARAMETERS[name].period):
                out[i] -= _HALF_TURN * np.rint(out[i] / _HALF_TURN)
        return out / self.errors(names)

    def log_density(self, values: Settings, names: Sequence[str]) -> float:
        """Give the logarithm of the density over that in the middle."""
        return -0.5 * float(np.sum(self.changes(values, names) ** 2))


def prior_of(config: Config, middle: Settings | None = None) -> Prior:
    """Give the prior of the optics of a configuration."""
    return Prior(middle or settings_of(config), config.uncertainty.optics)


def are_told(sigma: FloatArray, before: FloatArray) -> BoolArray:
    """Say which parameters pictures tell, by standard deviations after and before.

    Shapes: `sigma, before`, result (n,).
    """
    # pictures that tell a parameter halve its standard deviation
    return np.asarray(sigma < 0.5 * before)


def is_usual(name: str, size: float) -> bool:
    """Tell whether a parameter may change by so much."""
    # in usual errors
    return abs(size) < 7.0 * PARAMETERS[name].usual_error
