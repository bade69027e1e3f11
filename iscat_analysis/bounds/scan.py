"""Bounds along one axis of an experiment.

The light that falls on the particle is held: where the attenuation or the pixel size changes, the
background per pixel follows (β² and pixel area); the scattered photons stay.  A calibration belongs
to the configured optics: it fixes how strongly a mass scatters, there and along the scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numba import get_num_threads
from numpy.typing import NDArray
from pydantic import ValidationError

from iscat_analysis.bounds.classical import bounds_from_matrices
from iscat_analysis.bounds.experiment import Experiment, information_fraction, plan
from iscat_analysis.config import Config, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import MassScale, forward_model
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, Progress, silent
from iscat_analysis.threads import threads

FloatArray = NDArray[np.float64]

STRETCH = 16
"""Neighbouring points that one thread does in a row: the tables of one serve the next."""

MAX_POINTS = 100_000
"""Points of a scan at most."""


@dataclass(frozen=True)
class Axis:
    """Something that can be varied."""

    name: str
    label: str
    value: Callable[[Config], float]
    change: Callable[[Config, float], Mapping[str, Mapping[str, Any]]]
    rebuilds: bool


def _pixel_nm(config: Config) -> float:
    if config.camera.pixel_size_nm is None:
        raise ConfigError(
            "camera.pixel_size_nm is missing: give it, as in camera.pixel_size_nm = 84.4"
        )
    return config.camera.pixel_size_nm


def _height(config: Config) -> float:
    z_nm = config.bounds.z_nm
    return config.particle.nominal_height_nm if z_nm is None else z_nm


def _attenuated(config: Config, value: float) -> Mapping[str, Mapping[str, Any]]:
    if config.optics.scheme == "darkfield":
        raise ConfigError(
            "attenuation: dark field has no reference to attenuate; choose optics.scheme = "
            '"iscat" or "cobri"'
        )
    power = (value / config.optics.attenuation) ** 2
    photons = config.bounds.photons_per_pixel * power
    return {"optics": {"attenuation": value}, "bounds": {"photons_per_pixel": photons}}


def _pixelated(config: Config, value: float) -> Mapping[str, Mapping[str, Any]]:
    old = _pixel_nm(config)
    side = config.bounds.pixels * old
    photons = config.bounds.photons_per_pixel
    if config.optics.scheme != "darkfield":
        photons *= (value / old) ** 2
    return {
        "camera": {"pixel_size_nm": value},
        "bounds": {"pixels": round(side / value) if value > 0 else 0, "photons_per_pixel": photons},
    }


def _field(config: Config, value: float) -> Mapping[str, Mapping[str, Any]]:
    return {"bounds": {"pixels": round(value / _pixel_nm(config))}}


AXES = {
    axis.name: axis
    for axis in (
        Axis("z", "height z [nm]", _height, lambda _, v: {"bounds": {"z_nm": v}}, False),
        Axis(
            "focus", "focus height [nm]", lambda c: c.optics.focus_nm,
            lambda _, v: {"optics": {"focus_nm": v}}, True,
        ),
        Axis(
            "attenuation", "amplitude of the reference that passes",
            lambda c: c.optics.attenuation, _attenuated, True,
        ),
        Axis(
            "na", "numerical aperture", lambda c: c.optics.na,
            lambda _, v: {"optics": {"na": v}}, True,
        ),
        Axis("pixel", "pixel size [nm]", _pixel_nm, _pixelated, False),
        Axis(
            "fov", "field of view [nm]", lambda c: c.bounds.pixels * _pixel_nm(c), _field, False
        ),
        Axis(
            "photons", "background photons per pixel and frame",
            lambda c: c.bounds.photons_per_pixel,
            lambda _, v: {"bounds": {"photons_per_pixel": v}}, False,
        ),
    )
}  # fmt: skip
"""What `--scan` knows."""


@dataclass(frozen=True)
class Scan:
    """Bounds along one axis."""

    name: str
    label: str
    here: float
    free: tuple[str, ...]
    table: pd.DataFrame


def parse_scan(text: str) -> tuple[Axis, FloatArray]:
    """Read what follows ``--scan``.

    Shapes: `values` (n,).
    """
    name, equals, numbers = text.partition("=")
    name = name.strip().lower()
    if not equals or name not in AXES:
        raise ConfigError(
            f"`scan` = {text}: write it as NAME=start:stop:step or NAME=a,b,c, "
            f"with NAME one of {', '.join(AXES)}; as in `scan` = z=0:2000:50"
        )
    try:
        parts = [float(part) for part in numbers.replace(",", ":").split(":")]
    except ValueError:
        raise ConfigError(
            f"`scan` = {text}: {numbers!r} is not start:stop:step nor a,b,c; "
            f"as in `scan` = {name}=0:2000:50"
        ) from None
    if not all(map(math.isfinite, parts)):
        raise ConfigError(f"`scan` = {text}: needs finite numbers")
    if ":" not in numbers:
        return AXES[name], np.array(parts)
    if "," in numbers or len(parts) != 3:
        raise ConfigError(
            f"`scan` = {text}: needs three numbers start:stop:step, as in `scan` = {name}=0:2000:50"
        )
    start, stop, step = parts
    if step == 0 or (stop - start) / step < 0:
        raise ConfigError(
            f"`scan` = {text}: the step {step:g} does not lead from {start:g} to {stop:g}; "
            "change its sign or size"
        )
    count = math.floor((stop - start) / step * (1 + 1e-12) + 1e-9) + 1
    if count > MAX_POINTS:
        raise ConfigError(
            f"`scan` = {text}: has {count} points, at most {MAX_POINTS}; take a larger step"
        )
    return AXES[name], np.array([start + step * i for i in range(count)])


def changed(config: Config, axis: Axis, value: float) -> Config:
    """Move a configuration along an axis."""
    changes = axis.change(config, float(value))
    try:
        return config.model_copy(
            update={
                name: type(section).model_validate({**section.model_dump(), **changes[name]})
                for name in changes
                if (section := getattr(config, name)) is not None
            }
        )
    except ValidationError:  # again, as a whole, for a message that names the key
        values = config.model_dump(exclude_none=True)
        for name, keys in changes.items():
            values.setdefault(name, {}).update(keys)
        return parse_config(values, where=f"{axis.name} = {value:g}")


def scan(config: Config, axis: Axis, values: FloatArray, *, progress: Progress = silent) -> Scan:
    """Bounds along one axis, on `compute.workers` threads.

    Shapes: `values` (n,).
    """
    free = FREE_PARAMETERS[config.fit.mode]
    scale = calibrated_scale(config)
    plans = [changed(config, axis, value) for value in values]
    model = None
    if not axis.rebuilds:
        reach = max(_reach(one) for one in plans)
        heights = [_height(one) for one in plans]
        model = forward_model(
            config, reach, z_max_nm=max(*heights, config.particle.nominal_height_nm)
        )
        model = replace(model, z_range_nm=(min(heights), max(heights)))

    def stretch(part: list[Config]) -> list[dict[str, Any]]:
        return [_row(plan(one, model=model, scale=scale), free) for one in part]

    rows: list[dict[str, Any]] = []
    parts = [plans[i : i + STRETCH] for i in range(0, len(plans), STRETCH)]
    with threads(min(config.compute.workers, get_num_threads())) as pool:
        for found in pool.map(stretch, parts):
            rows += found
            progress(f"scan over {axis.name}", len(rows), len(plans))
    table = pd.DataFrame(rows)
    table.insert(0, axis.name, values)
    return Scan(axis.name, axis.label, axis.value(config), free, table)


def calibrated_scale(config: Config) -> MassScale | None:
    """Mass scale that a calibration fixes at the configured optics."""
    return plan(config).model.scale if config.calibration is not None else None


def _reach(config: Config) -> float:
    half = config.bounds.pixels * _pixel_nm(config) / 2
    return 1.0001 * math.hypot(half + abs(config.bounds.x_nm), half + abs(config.bounds.y_nm))


def _row(experiment: Experiment, free: tuple[str, ...]) -> dict[str, Any]:
    whole = experiment.bounds(PARAMETERS)
    joint = bounds_from_matrices(whole.fisher, whole.quantum, free)
    fraction = information_fraction(whole)
    row: dict[str, Any] = {}
    for kind, values in (
        ("crb_single", whole.crb_single),
        ("crb_joint", joint.crb_joint),
        ("qcrb", whole.qcrb),
        ("information", fraction),
    ):
        row |= {f"{kind}_{name}": v for name, v in zip(PARAMETERS, values, strict=True)}
    return row | {
        "n_camera": experiment.on_camera,
        "n_collected": experiment.collected,
        "photons_per_pixel": experiment.config.bounds.photons_per_pixel,
        "peak_e": experiment.peak_e,
        "inflation": joint.inflation,
        "unidentifiable": "; ".join(map(str, joint.unidentifiable)),
    }
