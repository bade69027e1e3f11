"""Calibrations of a batch: camera from flats, optics and masses from calibrants.

Where a calibration fails, the configuration is used, and the user is told; the movies are analysed
all the same.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from iscat_analysis.answers.calibrations import camera_calibration, mass_calibration
from iscat_analysis.calibration import contrast_over, standards_of
from iscat_analysis.config import Calibration, Config, load_config, read_toml
from iscat_analysis.day.jobs import Outcome, Runner, hash_of, sha256_of
from iscat_analysis.day.table import Movie, Plan, configured
from iscat_analysis.errors import DataError, SignError
from iscat_analysis.movie import open_stack

_OPTICS = (
    "polarization", "polarization_deg", "analyzer", "na", "attenuation", "mask_na", "focus_nm",
    "reference_phase_deg", "aberrations_nm", "covariance",
)  # fmt: skip
"""What a calibration of the optics measures."""


@dataclass(frozen=True)
class Day:
    """A planned batch, and its calibrations."""

    plan: Plan
    settings: Mapping[str, Any] = field(default_factory=dict)
    outcomes: Mapping[str, Outcome] = field(default_factory=dict)
    camera: str = "as configured"
    optics: str = "as configured"
    mass: str = "as configured"
    failed: tuple[tuple[str, str], ...] = ()
    standards_kda: tuple[float, ...] = ()


def calibrate_day(plan: Plan, runner: Runner) -> Day:
    """Make the calibrations of a batch that are not made yet."""
    settings: dict[str, Any] = {}
    outcomes: dict[str, Outcome] = {}
    failed: list[tuple[str, str]] = []
    origins = {
        "mass": "as configured" if plan.config.calibration else "none: the model's own scale"
    }
    if plan.flats:
        measured, found = _camera(plan, runner)
        outcomes |= found
        settings |= measured
        if measured:
            origins["camera"] = f"flats: {', '.join(n for n, o in found.items() if not o.why)}"
        else:
            failed.append(("camera", next(o.why for o in found.values() if o.why)))
    tables: dict[str, Path] = {}
    learned: dict[str, Any] | None = None
    for movie in plan.calibrants:
        config = configured(plan.config, {**settings, **(learned or {})}, movie.row)
        folder = runner.out / "calibration" / f"{movie.name}.iscat"
        outcome = runner.analyse(f"calibrants/{movie.name}", movie.row.path, config, folder)
        if outcome.state != "done":
            outcomes[movie.name] = outcome
            continue
        tables[movie.name] = folder / "fits.csv"
        if learned is None and (optics := _optics(folder, plan.config)) is not None:
            learned, origin = optics
            origins["optics"] = f"{origin} by {movie.name}"
    settings |= learned or {}
    standards: tuple[float, ...] = ()
    if plan.standards:
        outcome, calibration = _mass(plan, tables, runner)
        if outcome.state == "done":
            standards = tuple(outcome.record["standards_kda"]) if outcome.record else ()
            settings["calibration"] = calibration
            origins["mass"] = f"calibrants: {', '.join(tables)}"
        else:
            failed.append(("mass", outcome.why or "not made yet"))
    return Day(plan, settings, outcomes, failed=tuple(failed), standards_kda=standards, **origins)


def _camera(plan: Plan, runner: Runner) -> tuple[dict[str, Any], dict[str, Outcome]]:
    """Measure the camera on the flats that can be read."""
    outcomes: dict[str, Outcome] = {}
    good: list[Movie] = []
    for flat in plan.flats:
        try:
            with open_stack(flat.row.path):
                good.append(flat)
        except DataError as error:
            outcomes[flat.name] = Outcome("failed", str(error))
    if not good:
        return {}, outcomes
    configured_offset = plan.config.camera.offset_adu
    # An offset of zero, the default, or a map gives no dark level: it is measured on the flats.
    known = configured_offset if isinstance(configured_offset, float) else 0.0
    offset = known or None
    out = runner.out / "calibration" / "camera"
    paths = {flat.name: flat.row.path for flat in good}

    def work() -> dict[str, Any]:
        camera_calibration(
            list(paths.values()), out, offset_adu=offset, overwrite=True, progress=runner.progress
        )
        return {"inputs": {name: {"sha256": sha256_of(path)} for name, path in paths.items()}}

    outcome = runner.job("camera", hash_of(offset), paths, out / "camera.toml", work)
    outcomes |= dict.fromkeys(paths, outcome)
    if outcome.state != "done":
        return {}, outcomes
    measured = read_toml(out / "camera.toml")["camera"]
    return {f"camera.{key}": value for key, value in measured.items()}, outcomes


def _optics(folder: Path, config: Config) -> tuple[dict[str, Any], str] | None:
    """Read the optics from the analysis of a calibrant; None where it could not test them."""
    if config.optics.file is not None:
        return None
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    optics = summary.get("optics", {})
    if not optics or optics.get("reason"):
        return None
    if not optics["calibrated"]:
        return {}, "confirmed"
    learned = read_toml(folder / "config.toml")["optics"]
    keys = {f"optics.{key}": learned[key] for key in _OPTICS if key in learned}
    return {**keys, "optics.calibrate": "auto"}, "learned"


def _mass(plan: Plan, tables: Mapping[str, Path], runner: Runner) -> tuple[Outcome, dict[str, Any]]:
    """Fit the line through the standards to the events of all calibrants."""
    if not tables:
        return Outcome("failed", "no calibrant could be analysed"), {}
    folder = runner.out / "calibration"
    out = folder / "mass"

    def work() -> dict[str, Any]:
        events = folder / "calibrants.csv"
        frames, standards = _together(tables)
        joined = pd.concat(frames, ignore_index=True)
        joined.to_csv(events, index=False, lineterminator="\n")
        try:
            found = mass_calibration(
                events,
                [mass for mass, _ in plan.standards],
                out,
                standards_se_kda=[se for _, se in plan.standards],
                standards=standards,
                overwrite=True,
            )
        except SignError as error:  # which way they land is what the configuration says
            raise DataError(
                f"{error.problem}, correct the sign of calibration.gradient_per_kda, or "
                "optics.focus_nm or optics.reference_phase_deg"
            ) from None
        masses = [float(mass) for mass in found.standards["mass_kda"]]
        hashes = {name: {"sha256": sha256_of(path)} for name, path in tables.items()}
        return {"standards_kda": masses, "inputs": hashes}

    key = hash_of(plan.standards)
    outcome = runner.job("mass", key, tables, out / "calibration.toml", work)
    if outcome.state != "done":
        return outcome, {}
    line = read_toml(out / "calibration.toml")["calibration"]
    keys = Calibration.model_fields  # what this line does not say is not that of another
    return outcome, {key: line.get(key) for key in keys}


def _together(tables: Mapping[str, Path]) -> tuple[list[pd.DataFrame], Config]:
    """Read the events of all calibrants, with contrasts converted to the optics of the first."""
    configs = {name: load_config(path.with_name("config.toml")) for name, path in tables.items()}
    first = next(iter(configs.values()))
    frames = []
    for name, path in tables.items():
        ratio, refusal = contrast_over(configs[name], standards_of(first))
        if refusal:
            raise DataError(
                f"{name}: the contrasts of its standards do not go with those of "
                f"{next(iter(configs))}: {refusal}; record calibrants with the same optics"
            )
        table = pd.read_csv(path)
        frames.append(table.assign(contrast=table["contrast"] / ratio))
    return [f for f in frames if len(f)] or frames, first
