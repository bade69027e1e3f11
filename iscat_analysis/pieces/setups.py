"""Arguments of the functions of arrays: microscope, particle, camera, and arrays to broadcast."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from iscat_analysis.config import (
    LARGEST_NM,
    Calibration,
    CameraConfig,
    Config,
    Fit,
    Optics,
    Particle,
)
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.checks import LARGEST, choice_in, real_array
from iscat_analysis.records import FREE_PARAMETERS

FloatArray = NDArray[np.float64]

T = TypeVar("T")

LARGEST_REGION = 1500
"""Pixels along a side of a region, whose bounds take half a gigabyte."""


def _given(name: str, value: T | None, kind: type[T], example: str) -> T:
    """Refuse an argument of another type."""
    if not isinstance(value, kind):
        raise ConfigError(
            f"{name}: is {type(value).__name__}; give what iscat_analysis.{example} returns"
        )
    return value


def config_of(
    optics: Optics | None,
    particle: Particle | None,
    camera: CameraConfig | None,
    *,
    mode: str = "joint",
    z_range_nm: tuple[float, float] | None = None,
    calibration: Calibration | None = None,
) -> Config:
    """Put microscope, particle and camera together."""
    optics = _given("optics", optics, Optics, "Optics(na=1.42)")
    particle = _given("particle", particle, Particle, "Particle(mass_kda=480)")
    camera = _given("camera", camera, CameraConfig, "Camera(pixel_size_nm=84.4)")
    if calibration is not None and not isinstance(calibration, Calibration):
        raise ConfigError(
            f"calibration: is {type(calibration).__name__}; give what "
            "iscat_analysis.Calibration(gradient_per_kda=-3.1e-5) returns, or None"
        )
    if camera.pixel_size_nm is None:
        raise ConfigError("camera.pixel_size_nm is needed: Camera(pixel_size_nm=84.4)")
    if isinstance(camera.assumed.read_noise_e, str):
        raise ConfigError(
            f"camera.read_noise_e = {camera.read_noise_e!r} is a map: give one number [e]"
        )
    choice_in("mode", mode, tuple(FREE_PARAMETERS))
    fit = {"mode": mode} if z_range_nm is None else {"mode": mode, "z_range_nm": z_range_nm}
    return Config(
        optics=optics, particle=particle, camera=camera, calibration=calibration, fit=Fit(**fit)
    )


def together(
    given: Mapping[str, ArrayLike], *, least: Mapping[str, float]
) -> dict[str, FloatArray]:
    """Broadcast arrays against one another."""
    arrays = {name: real_array(name, value) for name, value in given.items()}
    for name, array in arrays.items():
        most = LARGEST_NM if name.endswith("_nm") else LARGEST
        bad = ~(np.abs(array) <= most)
        if name in least:
            bad |= array < least[name]
        if bad.any():
            value = array[bad].flat[0]
            limit = f" of at least {least[name]:g}" if name in least else ""
            if np.isfinite(value) and abs(value) > most:
                limit = f" of at most {most:g}"
            raise ConfigError(f"{name} = {value:g}: give finite numbers{limit}")
    try:
        same = np.broadcast_arrays(*arrays.values())
    except ValueError:
        shapes = ", ".join(f"{name} {a.shape}" for name, a in arrays.items() if a.ndim)
        raise ConfigError(
            f"shapes do not go together: {shapes}; see numpy's broadcasting"
        ) from None
    return dict(zip(arrays, same, strict=True))


def darkfield_photons(particle: Particle) -> float:
    """Give the scale of masses in dark field."""
    if particle.photons_per_frame is None:
        raise ConfigError(
            "particle.photons_per_frame is needed in dark field, where it is the scale of masses: "
            "give the scattered photons that are collected per frame from a particle of "
            "particle.mass_kda, as in photons_per_frame=3000"
        )
    return particle.photons_per_frame
