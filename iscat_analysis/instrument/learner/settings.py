"""Parameters of the optics by name, and the sections of a configuration that hold them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from iscat_analysis.config import FIELD_TERMS, Config, field_keys
from iscat_analysis.errors import ConfigError
from iscat_analysis.instrument.learner.particle_images import (
    FIELD,
    FOCUS_DRIFT,
    FOCUS_STEP,
    Settings,
)
from iscat_analysis.optics.forward import ForwardModel, forward_model

PRIMARY = ("z5", "z6", "z7", "z8", "z11")
"""Astigmatism, coma, spherical aberration."""

SECONDARY = ("z9", "z10")
"""Trefoil."""

HIGHER = ("z22",)
"""Secondary spherical aberration."""

FREE = {
    "focus": ("focus_nm", FOCUS_STEP, FOCUS_DRIFT, *(n for n in FIELD if n[:5] == "focus")),
    "na": ("na",),
    "phase": ("reference_phase_deg", *(n for n in FIELD if n[:5] == "phase")),
    "mask": ("mask_na", "attenuation"),
    "zernike": (
        *PRIMARY,
        *SECONDARY,
        *HIGHER,
        "coma_field_nm",
        "astigmatism_field_x_nm",
        "astigmatism_field_y_nm",
    ),
    "polarization": ("polarization_deg",),
}
"""What ``--free`` may name, and the continuous parameters that each stands for; whether light is
linear or circular is a choice beside them."""


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
        k: v
        for k, v in settings.items()
        if not is_term(k) and k != FOCUS_STEP and k not in FIELD_TERMS
    }
    plain |= field_keys({name: settings.get(name, 0.0) for name in FIELD})
    terms = {key: value for key, value in settings.items() if is_term(key) and value}
    optics = config.optics.model_copy(update={**plain, "aberrations_nm": terms})
    return config.model_copy(update={"optics": optics})


def is_term(name: str) -> bool:
    """Tell whether a name is that of an aberration."""
    return name[0] == "z" and name[1:].isdigit()


def build_microscope(
    config: Config, reach_nm: float, settings: Settings, *, like: ForwardModel | None = None
) -> ForwardModel:
    """Make the forward model of other optics, with the model's own mass scale."""
    changed = with_settings(config, settings).model_copy(update={"calibration": None})
    highest = None if heights_free(config) else config.particle.nominal_height_nm
    return forward_model(changed, reach_nm, z_max_nm=highest, like=like)
