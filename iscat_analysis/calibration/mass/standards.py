"""The optics of the standards, which a mass calibration stores.

Contrast per mass depends on the optics with which it was measured.  A calibration that stores them
can be used for movies with other optics too, because the model converts it (`optics.scale`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from iscat_analysis.config import (
    MOVING,
    Calibration,
    Config,
    Optics,
    OpticsCovariance,
    StandardsCamera,
    toml_value,
)
from iscat_analysis.optics.forward import PEAK_SEARCH_RADIUS, forward_model

_OF_A_MOVIE = {"file": None, "covariance": None, "calibrate": "auto", **MOVING}
"""Keys of [optics] that do not change the contrast of standards, and their neutral values."""


@dataclass(frozen=True)
class Standards:
    """Optics and camera with which the standards of a calibration were recorded and analysed."""

    optics: Optics
    covariance: OpticsCovariance | None
    height_nm: float
    camera: StandardsCamera

    def to_toml(self) -> str:
        """Write the end of the section ``[calibration]``, with its tables."""
        covariance = None if self.covariance is None else self.covariance.model_dump()
        tables = {
            "optics": _optics_keys(self.optics),
            "covariance": covariance,
            "camera": self.camera.model_dump(exclude_none=True),
        }
        lines = [f"height_nm = {toml_value(self.height_nm)}"]
        for name, table in tables.items():
            if table:
                lines += ["", f"[calibration.{name}]"]
                lines += [f"{key} = {toml_value(value)}" for key, value in table.items()]
        return "\n".join([*lines, ""])

    def to_dict(self) -> dict[str, Any]:
        """Give the entries of ``calibration.json``."""
        return {
            "optics": _optics_keys(self.optics),
            "covariance": None if self.covariance is None else self.covariance.model_dump(),
            "height_nm": self.height_nm,
            "camera": self.camera.model_dump(exclude_none=True),
        }


def standards_of(config: Config) -> Standards:
    """Give the record of standards that were analysed with a configuration."""
    camera = config.camera
    gain, offset = camera.gain_e_per_adu, camera.offset_adu
    return Standards(
        optics=config.optics.model_copy(update=_OF_A_MOVIE),
        covariance=None if (errors := config.optics.covariance) is None else errors.at_rest,
        height_nm=config.particle.nominal_height_nm,
        camera=StandardsCamera(
            pixel_size_nm=camera.pixel_size_nm,
            samples_per_pixel=camera.samples_per_pixel,
            fill_factor=camera.fill_factor,
            gain_e_per_adu=gain if isinstance(gain, float) else None,
            offset_adu=offset if isinstance(offset, float) else None,
        ),
    )


def with_standards(config: Config) -> Config:
    """Assume that a gradient without stored optics was measured with the configured optics."""
    line = config.calibration
    if line is None or line.optics is not None:
        return config
    found = standards_of(config)
    update = {
        "optics": found.optics,
        "covariance": found.covariance,
        "height_nm": found.height_nm,
        "optics_assumed": True,
    }
    return config.model_copy(update={"calibration": line.model_copy(update=update)})


def as_given(config: Config) -> Config:
    """Undo `with_standards` if the optics are still those configured."""
    line = config.calibration
    if line is None or not line.optics_assumed or standards_of(config).optics != line.optics:
        return config
    update = dict.fromkeys(("optics", "covariance", "height_nm"), None) | {"optics_assumed": False}
    return config.model_copy(update={"calibration": line.model_copy(update=update)})


def contrast_over(config: Config, standards: Standards) -> tuple[float, str]:
    """Give the contrast per mass over that of standards, and why it cannot be converted."""
    config = config.model_copy(update={"calibration": None})
    reach_nm = PEAK_SEARCH_RADIUS * config.optics.wavelength_nm / config.optics.na
    rises = (
        forward_model(config, reach_nm).peak_contrast(config.particle.nominal_height_nm, 1e-3) > 0
    )
    line = Calibration(
        gradient_per_kda=1e-5 if rises else -1e-5,
        optics=standards.optics,
        height_nm=standards.height_nm,
    )
    scale = forward_model(config.model_copy(update={"calibration": line}), reach_nm).scale
    return scale.carried, scale.refusal


def _optics_keys(optics: Optics) -> dict[str, Any]:
    values = optics.model_dump(exclude_none=True)
    return {key: value for key, value in values.items() if key not in _OF_A_MOVIE}
