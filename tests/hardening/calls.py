"""Public functions with arguments that nobody means: valid ones, of which one or two are spoilt."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import iscat_analysis as ia
from iscat_analysis.config import known_keys

Generator = np.random.Generator
Call = tuple[Callable[..., Any], dict[str, Any]]

_NUMBERS = (
    0, 1, -1, 2, 0.5, -0.5, 1e-320, 1e-200, 1e-15, 1e15, 1e16, 1e150, 1e300, 1.797e308, math.nan,
    math.inf, -math.inf, 2**31, 2**53, 2**63, -(2**63), 10**400, True, 3 + 4j, np.float32(7),
    np.int8(-3),
)  # fmt: skip
_OTHERS: tuple[Any, ...] = (
    None, "", "nan", "\0", "a\nb", "n" * 300, "../..", b"x", [], [[1], [1, 2]], {}, {"a": 1},
    object(), range(4), Path("absent"), Path("n" * 300), pd.DataFrame(), pd.Series([1.0]),
    np.array(math.nan), np.zeros(0), np.zeros((3, 0)), np.full(5, 1e300), np.array(["a"]),
    np.array([None, 1]), np.ma.masked_all(3), np.zeros((2, 2, 2, 2)), np.array([1 + 1j]),
    np.datetime64("2026-01-01"), len, "mass", (0, 10), (10, 0), [66.0], ia.Optics, [math.nan],
)  # fmt: skip


def names() -> list[str]:
    """Name the functions that are called."""
    return list(_seeds())


def call(name: str, rng: Generator) -> None:
    """Call a public function with spoilt arguments."""
    function, arguments = _seeds()[name]
    spoilt = dict(arguments)
    for _ in range(1 if rng.random() < 0.7 else 3):
        key = str(rng.choice(list(spoilt)))
        spoilt[key] = _spoilt(spoilt[key], rng)
    function(**spoilt)


def sound(name: str) -> None:
    """Call a public function as it is meant to be."""
    function, arguments = _seeds()[name]
    function(**arguments)


def _spoilt(value: Any, rng: Generator) -> Any:
    """Give something in place of an argument, or the argument with a wound."""
    number = type(value) in (int, float) and abs(value) < 1e9
    number = number or (isinstance(value, np.ndarray) and value.dtype.kind in "iuf")
    if number and rng.random() < 0.5:  # what somebody might mean
        scaled = np.asarray(value) * 10.0 ** rng.uniform(-3, 3) * rng.choice([1, 1, 1, -1])
        return scaled if isinstance(value, np.ndarray) else type(value)(scaled)
    if rng.random() < 0.4:
        return _any(rng)
    if isinstance(value, np.ndarray) and value.dtype.kind in "iuf":
        return _spoilt_array(value, rng)
    if isinstance(value, pd.DataFrame):
        return _spoilt_table(value, rng)
    if isinstance(value, list) and value:
        changed = list(value)
        at = int(rng.integers(len(changed)))
        changed[at] = _spoilt(changed[at], rng)
        return changed
    if isinstance(value, dict):
        section = str(rng.choice(_SECTIONS))
        key = str(rng.choice(sorted(known_keys([section]))))
        return value | {f"{section}.{key}": _any(rng)}
    return _any(rng)


def _any(rng: Generator) -> Any:
    pool = _NUMBERS if rng.random() < 0.6 else _OTHERS
    return pool[int(rng.integers(len(pool)))]


def _spoilt_array(value: np.ndarray[Any, Any], rng: Generator) -> Any:
    kind = int(rng.integers(7))
    changed: Any = np.array(value, dtype=np.float64)
    if kind < 4 and changed.size:
        with np.errstate(all="ignore"):
            flat = changed.reshape(-1)
            number = _NUMBERS[int(rng.integers(16))]
            flat[rng.random(flat.size) < rng.choice([0.01, 0.2, 1.0])] = float(number)
            flat[int(rng.integers(flat.size))] = float(number)
        return changed
    if kind == 4:
        return changed[..., ::-1].T
    if kind == 5:
        return changed[: max(changed.shape[0] - 1, 0)] if changed.ndim else changed[None]
    return changed.astype(object) if rng.random() < 0.5 else changed.astype(np.float32)


def _spoilt_table(value: pd.DataFrame, rng: Generator) -> pd.DataFrame:
    if value.empty or not value.columns.is_unique:
        return value
    kind, column = int(rng.integers(8)), str(rng.choice(list(value.columns)))
    if kind == 0:
        return value.drop(columns=column)
    if kind == 1:
        return pd.concat([value, value[[column]]], axis=1)
    if kind == 2:
        return value.iloc[: int(rng.integers(3))]
    changed = value.copy()
    rows = rng.random(len(changed)) < rng.choice([0.05, 0.5, 1.0])
    cell = _any(rng)
    column_of = changed[column].astype(object).to_numpy(copy=True)
    for row in np.flatnonzero(rows):
        column_of[row] = cell
    changed[column] = pd.Series(list(column_of), index=changed.index, dtype=object)
    if kind > 3:
        changed[column] = changed[column].map(_as_float).astype(float)
    return changed


def _as_float(value: Any) -> float:
    try:
        return float(value) if isinstance(value, (int, float)) else math.nan
    except OverflowError:
        return math.inf


_SECTIONS = ("optics", "camera", "particle", "fit", "simulation", "bounds", "background", "track")


@cache
def _seeds() -> dict[str, Call]:
    rng = np.random.default_rng(47)
    optics, camera = ia.Optics(na=1.42, focus_nm=-300), ia.Camera(pixel_size_nm=84.4)
    protein = ia.Particle(mass_kda=480)
    scope = {"optics": optics, "particle": protein, "camera": camera}
    images = ia.psf(optics, protein, camera, pixels=13, mass_kda=[3000.0, 5000.0])
    before = rng.poisson(1e6, images.shape).astype(float)
    after = rng.poisson(1e6 * (1 + images)).astype(float)
    regions = {"before": before, "after": after, **scope, "n_before": 100, "n_after": 100}
    rod = ia.Particle(
        kind="gold", diameter_nm=15, model="rod", aspect_ratio=3, azimuth_deg=0, tilt_deg=60
    )
    rods = regions | {
        "particle": rod,
        "before": before[:1, 4:-4, 4:-4],
        "after": after[:1, 4:-4, 4:-4],
    }
    frames, walk = np.arange(12), np.cumsum(rng.normal(0, 50, (12, 2)), axis=0)
    track = {"frames": frames, "positions_nm": walk, "sigma_nm": np.full(12, 10.0)}
    track |= {"frame_rate_hz": 100.0, "exposure_ms": 5.0}
    mass = rng.normal(np.repeat([66.0, 132.0], 15), 8.0)
    events = pd.DataFrame(
        {"mass_kda": mass, "sigma_mass_kda": 8.0, "frame": np.arange(30) * 10.0,
         "x_px": rng.uniform(0, 50, 30), "y_px": rng.uniform(0, 50, 30), "snr": mass / 8}
    )  # fmt: skip
    known = {"sigma_kda": None, "limit_kda": None, "limit_sigma_kda": None, "above_kda": 30.0}
    series = pd.DataFrame({"concentration_nm": [3.0, 30.0]})
    numeric = [c for c in ia.EVENT_COLUMNS if c not in ("status", "flags")]
    fits = pd.DataFrame(rng.uniform(1, 50, (5, len(numeric))), columns=numeric)
    fits = fits.assign(event=range(5), frame=np.arange(5), status="ok", flags="", particle=[0] * 5)
    small = {"camera.pixel_size_nm": 84.4, "bounds.pixels": 11}
    tiny = {"camera.pixel_size_nm": 84.4, "simulation.frames": 2, "simulation.shape": [8, 8]}
    bench = {"camera": {"pixel_size_nm": 84.4}, "bounds": {"pixels": 11}}
    truths = pd.DataFrame(rng.uniform(20, 60, (8, 3)), columns=["x_nm", "y_nm", "mass_kda"])
    absent = {"settings": dict(small), "out": "out", "overwrite": False}
    folder = Path("absent")
    return {
        "psf": (ia.psf, scope | {"pixels": 9, "x_nm": 0.0, "y_nm": 5.0, "z_nm": 10.0,
                                 "mass_kda": np.array([100.0, 200.0]), "calibration": None}),
        "crb": (ia.crb, scope | {"photons_per_pixel": 1e4, "n_after": 5, "n_before": 5, "pixels": 9,
                                 "mode": "joint", "joint": True, "level": False, "x_nm": 0.0,
                                 "y_nm": 0.0, "z_nm": 20.0, "mass_kda": 500.0, "focus_nm": -300.0}),
        "qcrb": (ia.qcrb, scope | {"photons_per_pixel": 1e4, "n_after": 5, "mode": "joint",
                                   "joint": True, "z_nm": 20.0, "mass_kda": 500.0,
                                   "focus_nm": -300.0}),
        "bounds_for": (ia.bounds_for, {"setup": bench, "mode": "mass"}),
        "efficiency": (ia.efficiency, {
            "estimates": truths + rng.normal(0, 5, truths.shape), "truth": truths, "setup": bench,
            "mode": "mass", "seed": 1}),
        "fit_rois": (ia.fit_rois, regions | {
            "mode": "mass", "power_ratio": None, "level": None, "masked": None, "saturated": None,
            "corners_px": np.zeros((2, 2)), "calibration": None, "workers": 1}),
        "fit_rods": (ia.fit_rods, rods | {"power_ratio": None, "level": None, "masked": None}),
        "log_likelihood": (_likelihood, regions | {
            "mode": "joint", "power_ratio": None, "level": None, "z_range_nm": (0.0, 300.0),
            "masked": None, "theta": np.array([500.0, 500.0, 50.0, 3000.0])}),
        "fit_diffusion": (ia.fit_diffusion, track | {"counted": None, "level": 0.9}),
        "anomalous_test": (ia.anomalous_test, track),
        "confinement_test": (ia.confinement_test, track | {"resamples": 9, "enough": 2,
                                                           "rng": None}),
        "hydrodynamic_diameter": (ia.hydrodynamic_diameter, {
            "d_um2_s": np.array([1.0, 2.0]), "sigma_d_um2_s": 0.1, "viscosity_mpa_s": 0.9,
            "temperature_c": 25.0}),
        "refractive_index": (ia.refractive_index, {
            "mass_kda": np.array([1e5]), "diameter_nm": 100.0, "sigma_mass_kda": 10.0,
            "sigma_diameter_nm": 1.0, "index": 1.46, "density_kg_m3": 1350.0, "n_medium": 1.33}),
        "find_species": (ia.find_species, known | {
            "events": events, "k": 2, "masses_kda": None, "start_kda": None,
            "ladder": None, "steps": (), "branch": "magnitude", "draws": 0, "seed": 1,
            "kinetics": None, "out": None}),
        "find_ladder": (ia.find_species, known | {
            "events": events, "ladder": 66.0, "steps": [1, 2], "offset": False, "hold": False,
            "widths": "common", "background": False, "draws": 0}),
        "compare_samples": (ia.compare_samples, known | {
            "first": events, "other": events, "k": 1, "background": False}),
        "compare_tables": (ia.compare_tables, known | {
            "tables": [events, events], "k": 1, "workers": 1, "out": None, "overwrite": False}),
        "fit_kd": (ia.fit_kd, known | {
            "samples": series, "tables": [events, events], "model": "dimer", "masses_kda": [66.0],
            "landing_power": -0.1, "inactive": False, "out": None}),
        "fit_kinetics": (ia.fit_kinetics, {
            "events": events, "frame_rate_hz": 100.0, "frames": (0, 400), "radius_px": 1.5}),
        "to_trackpy": (ia.to_trackpy, {"fits": fits}),
        "to_napari": (ia.to_napari, {"fits": fits}),
        "to_photomol": (ia.to_photomol, {"fits": fits, "masses": True}),
        "to_picasso": (ia.to_picasso, {"fits": fits, "tracked": False}),
        "tracked_rows": (ia.tracked_rows, {"fits": fits}),
        "configure": (ia.configure, {"source": None, "settings": dict(small), "arguments": None}),
        "load_config": (ia.load_config, {"path": None, "overrides": ["optics.na=1.3"]}),
        "config_to_toml": (ia.config_to_toml, {
            "config": ia.Config(), "comments": True, "sections": ["optics"]}),
        "sections": (_sections, {"na": 1.3, "pixel_size_nm": 80.0, "mass_kda": 66.0,
                                 "gradient_per_kda": -3e-5}),
        "open_stack": (ia.open_stack, {
            "movie": np.ones((4, 8, 8)), "name": "a", "pixel_size_nm": 80.0, "exposure_ms": 1.0,
            "frame_rate_hz": 100.0}),
        "open_result": (ia.open_result, {"folder": folder, "movie": None}),
        "schema": (ia.schema, {"name": "fit"}),
        "compute_bounds": (ia.compute_bounds, {"config": None, "settings": dict(small),
                                               "mode": "mass"}),
        "forecast_optics": (
            ia.forecast_optics,
            {"config": folder, "settings": dict(small), "events": 60, "free": None},
        ),
        "simulate_movie": (ia.simulate_movie, {
            "config": {}, "path": "movie.tif", "seed": 1, "settings": dict(tiny),
            "overwrite": True}),
        "fit_movie": (ia.fit_movie, absent | {
            "movie": folder, "mode": "mass", "background": (0, 10), "frames": (10, 20),
            "workers": 1, "posterior": False, "scheduler": "threads", "scheduler_file": None}),
        "fit_stack": (ia.fit_stack, {"stack": folder, "config": ia.Config(), "inject": 0}),
        "calibrate_optics": (ia.calibrate_optics, absent | {
            "movie": folder, "free": None, "focus_step_nm": None}),
        "batch": (ia.batch, {
            "samples": folder, "out": "day", "settings": dict(small), "standards": [66.0],
            "kd": None, "only": None, "merge": False, "scheduler": "threads"}),
        "watch": (_watch, {"folder": folder, "out": "day", "settings": dict(small),
                             "interval_s": 1.0}),
    }  # fmt: skip


def _watch(**arguments: Any) -> None:
    """Watch a folder until the first wait: it would go on for ever, which is what it is for."""
    stop = threading.Event()
    stop.set()
    ia.watch(**arguments, stop=stop)


def _likelihood(*, theta: Any, **arguments: Any) -> None:
    found = ia.log_likelihood(**arguments | {"before": _first(arguments["before"]),
                                             "after": _first(arguments["after"])})  # fmt: skip
    found(theta)


def _first(value: Any) -> Any:
    return value[0] if isinstance(value, np.ndarray) and value.ndim == 3 and len(value) else value


def _sections(na: Any, pixel_size_nm: Any, mass_kda: Any, gradient_per_kda: Any) -> None:
    ia.Optics(na=na)
    ia.Camera(pixel_size_nm=pixel_size_nm)
    ia.Particle(mass_kda=mass_kda)
    ia.Calibration(gradient_per_kda=gradient_per_kda)
