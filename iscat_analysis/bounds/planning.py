"""Planning an experiment: bounds along one axis, the best setting, and what a precision takes.

The light that falls on the particle is held: where the attenuation or the pixel size changes, the
background per pixel follows (β² and pixel area); the scattered photons stay.  A calibration belongs
to the configured optics: it fixes how strongly a mass scatters, there and along the scan.

`optimize`, `effort` and `budget` ask the question of `plan` and `event_bounds` backwards; the bound
they speak of is the joint one over the free parameters of the mode.
"""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import pandas as pd
import scipy
from numba import get_num_threads
from pydantic import ValidationError

from iscat_analysis.bounds.classical import bounds_from_matrices
from iscat_analysis.bounds.experiment import (
    Experiment,
    detector,
    height_of,
    information_fraction,
    plan,
    reach_of,
)
from iscat_analysis.config import Config, parse_config
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.forward import MassScale, forward_model
from iscat_analysis.records import FREE_PARAMETERS, PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.threads import threads

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
    return detector(config)[0]


def _key(
    section: str, key: str
) -> tuple[Callable[[Config], float], Callable[[Config, float], Mapping[str, Mapping[str, Any]]]]:
    """Give what reads one key of a section, and what changes it."""
    return lambda c: getattr(getattr(c, section), key), lambda _, v: {section: {key: v}}


def _attenuated(config: Config, value: float) -> Mapping[str, Mapping[str, Any]]:
    if not config.optics.interferes:
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
    if config.optics.interferes:
        photons *= (value / old) ** 2
    return {
        "camera": {"pixel_size_nm": value},
        "bounds": {"pixels": round(side / value) if value > 0 else 0, "photons_per_pixel": photons},
    }


def _field(config: Config, value: float) -> Mapping[str, Mapping[str, Any]]:
    return {"bounds": {"pixels": round(value / _pixel_nm(config))}}


_ATTENUATION, _PHOTONS = (
    "amplitude of the reference that passes",
    "background photons per pixel and frame",
)

AXES = {
    axis.name: axis
    for axis in (
        Axis("z", "height z [nm]", height_of, _key("bounds", "z_nm")[1], False),
        Axis("focus", "focus height [nm]", *_key("optics", "focus_nm"), True),
        Axis("attenuation", _ATTENUATION, _key("optics", "attenuation")[0], _attenuated, True),
        Axis("na", "numerical aperture", *_key("optics", "na"), True),
        Axis("pixel", "pixel size [nm]", _pixel_nm, _pixelated, False),
        Axis("fov", "field of view [nm]", lambda c: c.bounds.pixels * _pixel_nm(c), _field, False),
        Axis("photons", _PHOTONS, *_key("bounds", "photons_per_pixel"), False),
    )
}
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

    def refused(why: str) -> ConfigError:
        return ConfigError(f"`scan` = {text}: {why}")

    if not equals or name not in AXES:
        raise refused(
            "write it as NAME=start:stop:step or NAME=a,b,c, with NAME one of "
            f"{', '.join(AXES)}; as in `scan` = z=0:2000:50"
        )
    example = f"as in `scan` = {name}=0:2000:50"
    try:
        parts = [float(part) for part in numbers.replace(",", ":").split(":")]
    except ValueError:
        raise refused(f"{numbers!r} is not start:stop:step nor a,b,c; {example}") from None
    if not all(map(math.isfinite, parts)):
        raise refused("needs finite numbers")
    if ":" not in numbers:
        return AXES[name], np.array(parts)
    if "," in numbers or len(parts) != 3:
        raise refused(f"needs three numbers start:stop:step, {example}")
    start, stop, step = parts
    if step == 0 or (stop - start) / step < 0:
        raise refused(
            f"the step {step:g} does not lead from {start:g} to {stop:g}; change its sign or size"
        )
    count = math.floor((stop - start) / step * (1 + 1e-12) + 1e-9) + 1
    if count > MAX_POINTS:
        raise refused(f"has {count} points, at most {MAX_POINTS}; take a larger step")
    return AXES[name], np.array([start + step * i for i in range(count)])


def changed(config: Config, axis: Axis, value: float) -> Config:
    """Move a configuration along an axis."""
    return with_keys(config, axis.change(config, float(value)), where=f"{axis.name} = {value:g}")


def with_keys(
    config: Config, sections: Mapping[str, Mapping[str, Any]], *, where: str = "configuration"
) -> Config:
    """Replace keys of sections of a configuration, which are checked again."""
    try:
        return config.model_copy(
            update={
                name: type(section).model_validate({**section.model_dump(), **keys})
                for name, keys in sections.items()
                if (section := getattr(config, name)) is not None
            }
        )
    except ValidationError:  # again, as a whole, for a message that names the key
        values = config.model_dump(exclude_none=True)
        for name, keys in sections.items():
            values.setdefault(name, {}).update(keys)
        return parse_config(values, where=where)


def scan(config: Config, axis: Axis, values: FloatArray, *, progress: Progress = silent) -> Scan:
    """Bounds along one axis, on `compute.workers` threads.

    Shapes: `values` (n,).
    """
    free = FREE_PARAMETERS[config.fit.mode]
    scale = calibrated_scale(config)
    plans = [changed(config, axis, value) for value in values]
    model = None
    if not axis.rebuilds:
        heights = [height_of(one) for one in plans]
        highest = max(*heights, config.particle.nominal_height_nm)
        model = forward_model(config, max(map(reach_of, plans)), z_max_nm=highest)
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


def _row(experiment: Experiment, free: tuple[str, ...]) -> dict[str, Any]:
    whole = experiment.bounds(PARAMETERS)
    joint = bounds_from_matrices(whole.fisher, whole.quantum, free)
    kinds = {
        "crb_single": whole.crb_single,
        "crb_joint": joint.crb_joint,
        "qcrb": whole.qcrb,
        "information": information_fraction(whole),
    }
    row: dict[str, Any] = {
        f"{kind}_{name}": value
        for kind, values in kinds.items()
        for name, value in zip(PARAMETERS, values, strict=True)
    }
    return row | {
        "n_camera": experiment.on_camera,
        "n_collected": experiment.collected,
        "photons_per_pixel": experiment.config.bounds.photons_per_pixel,
        "peak_e": experiment.peak_e,
        "inflation": joint.inflation,
        "unidentifiable": "; ".join(map(str, joint.unidentifiable)),
    }


TARGETS = {"x": "x_nm", "y": "y_nm", "z": "z_nm", "mass": "mass_kda"}
"""What a user calls the parameters."""

FOCUS_REACH_NM = 2000.0
"""Foci searched on either side of the particle [nm]."""

ATTENUATION_DECADES = 4
"""Attenuations searched below 1."""

MAX_FRAMES = 10**12
"""More frames than any experiment has."""


@dataclass(frozen=True)
class Best:
    """The setting with the smallest bound."""

    axis: str
    parameter: str
    value: float
    here: float
    bound: float
    bound_here: float
    note: str
    scan: Scan


def optimize(
    config: Config,
    axis: Literal["focus", "attenuation"],
    target: str,
    *,
    progress: Progress = silent,
) -> Best:
    """Find the focus or the attenuation that makes one bound smallest."""
    if axis not in ("focus", "attenuation"):
        raise ConfigError(f"`optimize` = {axis}: choose focus or attenuation")
    parameter = _parameter(config, target)
    line = AXES[axis]
    column = f"crb_joint_{parameter}"
    if axis == "focus":
        height = config.particle.nominal_height_nm
        # grid of the search; the bound changes over half a wavelength and more
        grid = height + np.arange(-FOCUS_REACH_NM, FOCUS_REACH_NM + 1, 25.0)
        note = "light on the particle held; the oil thickness follows the focus"
    else:
        grid = np.logspace(-ATTENUATION_DECADES, 0, 20 * ATTENUATION_DECADES + 1)
        note = "light on the particle held; the background follows the attenuation squared"
    coarse = scan(config, line, grid, progress=progress)
    well_depth_e = config.camera.well_depth_e or math.inf
    score = coarse.table[column].where(coarse.table["peak_e"] < well_depth_e).to_numpy(float)
    if not np.isfinite(score).any():
        raise ConfigError(
            f"`optimize` = {axis}: {parameter} is unidentifiable or the camera saturated at every "
            "setting; lower bounds.photons_per_pixel, or free fewer parameters with fit.mode"
        )
    best = int(np.nanargmin(score))
    scale = calibrated_scale(config)
    out_of_reach = 10 * float(score[best])

    def bound(value: float) -> float:
        experiment = plan(changed(config, line, value), scale=scale)
        if experiment.peak_e >= well_depth_e:
            return out_of_reach
        found = experiment.bounds(coarse.free).crb_joint[PARAMETERS.index(parameter)]
        return float(found) if math.isfinite(found) else out_of_reach

    value, smallest = float(grid[best]), float(score[best])
    if 0 < best < grid.size - 1:
        fine = scipy.optimize.minimize_scalar(
            bound,
            bounds=(grid[best - 1], grid[best + 1]),
            method="bounded",
            options={"xatol": 1e-3 * (grid[best + 1] - grid[best - 1])},
        )
        if fine.fun < smallest:
            value, smallest = float(fine.x), float(fine.fun)
    here = plan(config).bounds(coarse.free).crb_joint[PARAMETERS.index(parameter)]
    return Best(axis, parameter, value, line.value(config), smallest, float(here), note, coarse)


@dataclass(frozen=True)
class Goal:
    """A precision to be reached."""

    parameter: str
    value: float


def parse_target(text: str, config: Config) -> Goal:
    """Read what follows ``--target``."""
    match = re.fullmatch(r"\s*(\w+)\s*=\s*([0-9.eE+-]+)\s*([A-Za-zµ]*)\s*", text)
    if match is None:
        raise ConfigError(f"`target` = {text}: write it as mass=5kDa or z=2nm")
    parameter = _parameter(config, match[1])
    unit = "kDa" if parameter == "mass_kda" else "nm"
    factors = {"kda": 1.0, "mda": 1e3, "da": 1e-3} if unit == "kDa" else {"nm": 1.0, "um": 1e3}
    factor = factors.get(match[3].lower() or unit.lower())
    try:
        value = float(match[2])
    except ValueError:
        value = math.nan
    if factor is None or not (math.isfinite(value) and value > 0):
        raise ConfigError(
            f"`target` = {text}: give a positive number of {unit}, as in {match[1]}=5{unit}"
        )
    return Goal(parameter, value * factor)


@dataclass(frozen=True)
class Effort:
    """What a precision costs."""

    background: str
    n_before: float
    n_after: float
    seconds: float | None
    collected: float


def effort(config: Config, goal: Goal) -> list[Effort]:
    """How many frames and photons a precision takes."""
    before = config.bounds.n_before
    finite = config.optics.interferes or config.background.level_e is not None
    backgrounds: list[tuple[str, Callable[[int], int]]] = []
    if before and finite:
        backgrounds.append((f"{before} frames before", lambda _: before))
        backgrounds.append(("as many frames before as after", lambda n: n))
    backgrounds.append(("known", lambda _: 0))
    return [_effort(config, goal, name, frames_before) for name, frames_before in backgrounds]


def _effort(config: Config, goal: Goal, name: str, before: Callable[[int], int]) -> Effort:
    at, model = PARAMETERS.index(goal.parameter), plan(config).model

    def planned(n_after: int) -> Experiment:
        frames = {"n_after": n_after, "n_before": before(n_after)}
        return plan(with_keys(config, {"bounds": frames}), model=model)

    def bound(n_after: int) -> float:
        return float(planned(n_after).bounds(FREE_PARAMETERS[config.fit.mode]).crb_joint[at])

    if not math.isfinite(bound(1)):
        raise ConfigError(
            f"`target`: {goal.parameter} is unidentifiable here; change the focus or free fewer "
            "parameters with fit.mode"
        )
    if bound(MAX_FRAMES) > goal.value:
        return Effort(name, before(0), math.inf, None, math.inf)
    frames = 1 + bisect_left(range(1, MAX_FRAMES), True, key=lambda n: bound(n) <= goal.value)
    rate = config.camera.frame_rate_hz
    seconds = (frames + before(frames)) / rate if rate else None
    return Effort(name, before(frames), frames, seconds, planned(frames).collected)


@dataclass(frozen=True)
class Cost:
    """One line of a budget."""

    cause: str
    factor: float
    bound: float


def budget(config: Config, parameter: str) -> list[Cost]:
    """Where the precision goes, from the light's own bound to this experiment's."""
    free = FREE_PARAMETERS[config.fit.mode]
    at = PARAMETERS.index(parameter)
    quiet = with_keys(config, {"camera": {"read_noise_e": 0.0}, "bounds": {"n_before": 0}})
    fine = with_keys(quiet, _refined(quiet))
    ideal = plan(fine).bounds(PARAMETERS)
    steps = [
        ("quantum bound", float(ideal.qcrb[at])),
        ("shot noise", float(ideal.crb_single[at])),
        ("crosstalk", float(plan(fine).bounds(free).crb_joint[at])),
    ]
    for cause, one in (
        ("pixelation", quiet),
        ("finite background", with_keys(config, {"camera": {"read_noise_e": 0.0}})),
        ("read noise", config),
    ):
        steps.append((cause, float(plan(one).bounds(free).crb_joint[at])))
    lines, before = [], steps[0][1]
    for cause, bound in steps:
        lines.append(Cost(cause, bound / before, bound))
        before = bound
    return lines


def _refined(config: Config) -> Mapping[str, Mapping[str, Any]]:
    """Divide the same field into pixels so small that they cost nothing."""
    pixel = _pixel_nm(config)
    # Fine pixels per wavelength over NA; finer ones change no bound by 1e-4
    wanted = math.ceil(pixel * 24 * config.optics.na / config.optics.wavelength_nm)
    # Side of the finest field
    split = max(1, min(wanted, 1200 // config.bounds.pixels))
    return _pixelated(config, pixel / split)


def parse_names(text: str | None, config: Config) -> list[str] | None:
    """Read several parameters, as after ``--for``."""
    return None if text is None else [_parameter(config, name.strip()) for name in text.split(",")]


def _parameter(config: Config, target: str) -> str:
    parameter = TARGETS.get(target.lower())
    if parameter is None:
        raise ConfigError(f"{target}: choose one of {', '.join(TARGETS)}")
    if parameter not in FREE_PARAMETERS[config.fit.mode]:
        raise ConfigError(
            f'{target} is not free in mode {config.fit.mode}: choose fit.mode = "joint"'
        )
    return parameter
