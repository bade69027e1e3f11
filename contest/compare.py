"""Estimators beside each other: the same counts for all, along everything that varies.

The truths of the trials differ by some of their bounds.  An estimator cannot know them, and the
gradient of its bias can be measured (`yardstick`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.errors import ContrastError
from iscat_analysis.executors import Executor
from iscat_analysis.records import PARAMETERS, FloatArray, Progress, silent
from iscat_analysis.study import (
    OF_DIPOLES,
    Limits,
    Setting,
    beside_best,
    detection_snr,
    limits_of_alike,
    make_setting,
    paired,
    power_bound,
    recall_at,
    resamples,
    score_estimates,
    trial_generator,
)
from iscat_contest.estimators import Estimator
from iscat_contest.process import Answer, Job, job_of, run_estimators

RANGE_CRB = 5.0
"""Half-width of the truths' range, in bounds, as long as the following are not exceeded."""

RANGE_PX, RANGE_Z_NM, RANGE_MASS = 0.5, 10.0, 0.1
"""The same in pixels, nanometres, and relative to the mass."""

PHOTONS = (100.0, 300.0, 1e3, 3e3, 1e4, 3e4)
SNRS = (1.5, 2.5, 3.5, 5.0, 8.0, 16.0)
HEIGHTS = (0.1, 0.3, 0.5, 0.7, 0.9)
FOCI_NM = (-400.0, -200.0, 0.0, 200.0, 400.0)
DENSITIES = (0.03, 0.1, 0.3, 1.0)
WRONG_NM = (0.0, 50.0, 100.0, 200.0)
"""Points of the curves: photons collected, masses by the signal-to-noise ratio of the matched
filter, heights as shares of ``fit.z_range_nm``, changes of the focus, other particles of the same
mass per µm², and error of the focus that estimators are told."""

MAP_PHOTONS = (100.0, 500.0, 2.5e3, 1.25e4)
"""Photons collected, at each of the heights, of the map of who is best where."""

CURVE_SHARE = 4
LEAST_CURVE = 20

FALSE_ALARMS = 20
"""Empty regions above the threshold, at least, so that a rate of false alarms is known."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Counts of one experiment, drawn once for all estimators.

    Shapes: `truths` (n, 4).
    """

    job: Job
    truths: FloatArray
    limits: Limits


def draw(
    setting: Setting,
    count: int,
    *,
    seed: int,
    stream: int,
    source: Setting | None = None,
    density_um2: float = 0.0,
    empty: bool = False,
) -> Draws:
    """Draw counts: of `source`, where estimators are told another microscope; among others."""
    true = source or setting
    side_nm = true.pixels * true.context.pixel_nm
    others = replace(true, context=replace(true.context, model=true.context.wide))
    bounds = true.bounds.crb_joint
    pixel = setting.context.pixel_nm
    most = [RANGE_PX * pixel, RANGE_PX * pixel, RANGE_Z_NM, RANGE_MASS * setting.truth[3]]
    width = np.array(
        [
            min(RANGE_CRB * bounds[k], most[k]) if name in setting.free else 0.0
            for k, name in enumerate(PARAMETERS)
        ]
    )
    width = np.where(np.isfinite(width), width, np.array(most))
    low, high = setting.config.fit.z_range_nm
    width[2] = min(width[2], setting.truth[2] - low, high - setting.truth[2]) * (width[2] > 0)
    truths, starts = np.empty((2, count, 4))
    before, after = [], []
    for i in range(count):
        random = trial_generator(seed, stream, i)
        truths[i] = setting.truth + width * random.uniform(-1, 1, 4)
        start = setting.start(truths[i], random)
        starts[i] = start.x_px * pixel, start.y_px * pixel, start.z_nm, start.mass_kda
        frame = true.level_e() + (0.0 if empty else true.signal_e(truths[i]))
        if density_um2:
            for _ in range(random.poisson(density_um2 * (side_nm / 1000) ** 2)):
                place = random.uniform(-0.5, true.pixels - 0.5, 2) * pixel
                frame = frame + others.signal_e(np.array([*place, *truths[i, 2:]]))
        counts = true.windows(np.broadcast_to(frame, (true.pixels, true.pixels)), random)
        before.append(counts.before_e)
        after.append(counts.after_e)
    limits = limits_of_alike(true.experiment_in_region, true.free, truths, level=true.level)
    return Draws(job_of(setting, np.stack(before), np.stack(after), starts), truths, limits)


def compare_estimators(
    config: Config,
    estimators: Sequence[Estimator],
    *,
    trials: int,
    seed: int,
    time_limit_s: float,
    executor: Executor | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Let estimators see the same counts, and score them: ``estimators``, ``paired``, curves."""
    mode = config.fit.mode if config.fit.mode in OF_DIPOLES else "mass"
    settings = {m: make_setting(config, m) for m in OF_DIPOLES}
    tables = {
        m: draw(s, trials, seed=seed, stream=1000 + k) for k, (m, s) in enumerate(settings.items())
    }
    fewer = max(trials // CURVE_SHARE, LEAST_CURVE)
    points = [
        *_points(config, settings[mode], fewer, seed),
        *_map_points(config, settings[mode], fewer, seed),
    ]
    rate = max(config.bounds.false_alarm_probability, FALSE_ALARMS / max(trials, 2 * FALSE_ALARMS))
    empty = draw(settings["mass"], trials, seed=seed, stream=1900, empty=True)
    jobs = [*(d.job for d in tables.values()), *(d.job for _, _, d in points), empty.job]
    answers = run_estimators(estimators, jobs, time_limit_s, executor, progress)
    out: dict[str, Any] = {"estimators": {}, "estimator_curves": {}, "paired": {}}
    for one in estimators:
        out["estimators"][one.name] = _scores(tables, answers[one.name], seed)
        out["estimators"][one.name]["about"] = one.about
    for m, (k, drawn) in zip(tables, enumerate(tables.values()), strict=True):
        columns = {name: given[k].columns for name, given in answers.items()}
        scores = {name: entry[m] for name, entry in out["estimators"].items()}
        weights = resamples(trials, seed)
        out["paired"][m] = beside_best(columns, scores, drawn.truths, drawn.limits, weights)
    named = {name: given[len(tables) :] for name, given in answers.items()}
    out["estimator_curves"] = {"mode": mode, "trials": fewer, **_curves(points, named, seed)}
    out["estimator_map"] = {"mode": mode, "trials": fewer, **_map(points, named, seed)}
    out["detection"] = _detection(points, named, settings["mass"], rate, seed)
    return out


def _scores(tables: Mapping[str, Draws], answers: Sequence[Answer], seed: int) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for (mode, drawn), answer in zip(tables.items(), answers, strict=False):
        count = len(drawn.truths)
        weights = resamples(count, seed)
        scored = score_estimates(answer.columns, drawn.truths, drawn.limits, weights)
        out[mode] = {
            **scored,
            "trials": count,
            "failed": sum(answer.failures.values()),
            "failures": answer.failures,
            "seconds_per_fit": answer.seconds / count,
            "processor_seconds_per_fit": answer.processor_seconds / count,
            "peak_mb": answer.peak_mb,
        }
    return out


Point = tuple[str, float, Draws]
"""Axis, abscissa, counts; of the map the height, with all photons one after the other."""

MAP = "map"


def _points(config: Config, setting: Setting, count: int, seed: int) -> list[Point]:
    """Draw what the curves show: axis, abscissa, counts."""
    mode, optics = setting.mode, config.optics
    found: list[Point] = []

    def add(axis: str, value: float, one: Setting, **options: Any) -> None:
        stream = 1100 + len(found)
        found.append((axis, value, draw(one, count, seed=seed, stream=stream, **options)))

    made = partial(make_setting, config, mode, context=setting.context)
    faintest = made(collected=PHOTONS[0])
    for photons in PHOTONS:
        z_nm = float(faintest.truth[2])
        add("photons", photons, made(collected=photons, z_nm=z_nm))
    mass = make_setting(config, "mass")
    per_kda = float(detection_snr(mass.experiment_in_region, mass.truth[3:])[0]) / mass.truth[3]
    for snr in SNRS if math.isfinite(per_kda) else ():
        kda = snr / per_kda
        add("mass", kda, replace(mass, truth=np.array([*mass.truth[:3], kda])))
    low, high = config.fit.z_range_nm
    for share in HEIGHTS:
        z_nm = low + share * (high - low)
        add("height", z_nm, made(z_nm=z_nm))
    for change in FOCI_NM:
        if (one := _refocused(config, mode, change)) is not None:
            add("focus", optics.focus_nm + change, one)
    for density in DENSITIES:
        add("density", density, setting, density_um2=density)
    for wrong in WRONG_NM:
        if (true := _refocused(config, mode, wrong)) is not None:
            add("wrong_focus", wrong, setting, source=replace(true, truth=setting.truth))
    return found


def _map_points(config: Config, setting: Setting, count: int, seed: int) -> list[Point]:
    """Draw what the map shows, row by row."""
    low, high = config.fit.z_range_nm
    found: list[Point] = []
    for share in HEIGHTS:
        z_nm = low + share * (high - low)
        for photons in MAP_PHOTONS:
            one = make_setting(
                config, setting.mode, context=setting.context, collected=photons, z_nm=z_nm
            )
            drawn = draw(one, count, seed=seed, stream=1500 + len(found))
            found.append((MAP, z_nm, drawn))
    return found


def _map(
    points: Sequence[Point], answers: Mapping[str, Sequence[Answer]], seed: int
) -> dict[str, Any]:
    """Tell who keeps most of the information at each height and light, and who is as good.

    As good are those whose mean square error on the same counts is not larger, by its interval.
    """
    cells = [(number, drawn) for number, (axis, _, drawn) in enumerate(points) if axis == MAP]
    heights = [value for axis, value, _ in points if axis == MAP][:: len(MAP_PHOTONS)]
    out: dict[str, Any] = {}
    for place, (number, drawn) in enumerate(cells):
        weights, count = resamples(len(drawn.truths), seed), len(drawn.truths)
        row, column = divmod(place, len(MAP_PHOTONS))
        scored = {
            who: score_estimates(given[number].columns, drawn.truths, drawn.limits, weights)
            for who, given in answers.items()
        }
        for i, name in enumerate(drawn.limits.free):
            table = out.setdefault(
                name, {key: [[None] * len(MAP_PHOTONS) for _ in heights] for key in _CELL}
            )
            kept = {
                who: one[name]["efficiency_crb"] * one[name]["answered"] / count
                for who, one in scored.items()
                if math.isfinite(one.get(name, {}).get("efficiency_crb", math.nan))
                and not one[name]["below_bound"]
            }
            if not kept:
                continue
            best = max(kept, key=lambda who: kept[who])
            truth, crb = drawn.truths[:, PARAMETERS.index(name)], drawn.limits.crb[:, i]
            errors = {who: answers[who][number].columns[name] - truth for who in kept}
            equal = [
                who
                for who in kept
                if who != best
                and not paired(errors[who], errors[best], crb, weights)["mse_ratio_ci95"][0] > 1
            ]
            for key, value in zip(_CELL, (best, kept[best], equal), strict=True):
                table[key][row][column] = value
    return {"photons": list(MAP_PHOTONS), "height_nm": heights, "parameters": out}


_CELL = ("best", "kept", "equal")


def _refocused(config: Config, mode: str, change_nm: float) -> Setting | None:
    """Change the focus; nothing where the calibration's sign does not suit the new one."""
    changed = config.optics.model_copy(update={"focus_nm": config.optics.focus_nm + change_nm})
    try:
        return make_setting(config.model_copy(update={"optics": changed}), mode)
    except ContrastError:
        return None


def _curves(
    points: Sequence[Point], answers: Mapping[str, Sequence[Answer]], seed: int
) -> dict[str, Any]:
    """Tabulate error and bounds along each axis, for every parameter and estimator."""
    out: dict[str, Any] = {}
    for number, (axis, value, drawn) in enumerate(points):
        if axis == MAP:
            continue
        curve = out.setdefault(axis, {"at": [], "bounds": {}, "estimators": {}})
        curve["at"].append(value)
        for i, name in enumerate(drawn.limits.free):
            bounds = curve["bounds"].setdefault(name, {"crb": [], "qcrb": [], "holevo": []})
            bounds["crb"].append(float(np.sqrt(np.mean(drawn.limits.crb[:, i] ** 2))))
            bounds["qcrb"].append(float(drawn.limits.qcrb[0, i]))
            bounds["holevo"].append(float(drawn.limits.holevo[0, i]))
        weights = resamples(len(drawn.truths), seed)
        for who, given in answers.items():
            scored = score_estimates(given[number].columns, drawn.truths, drawn.limits, weights)
            lines = curve["estimators"].setdefault(who, {})
            for name in drawn.limits.free:
                line = lines.setdefault(
                    name, {"rmse": [], "rmse_ci95": [], "efficiency_crb": [], "failed": []}
                )
                entry = scored.get(name, {})
                line["rmse"].append(entry.get("rmse", math.nan))
                line["rmse_ci95"].append(entry.get("rmse_ci95", (math.nan, math.nan)))
                line["efficiency_crb"].append(entry.get("efficiency_crb", math.nan))
                line["failed"].append(entry.get("failed", len(drawn.truths)))
    return out


def _detection(
    points: Sequence[Point],
    answers: Mapping[str, Sequence[Answer]],
    setting: Setting,
    rate: float,
    seed: int,
) -> dict[str, Any]:
    """Tabulate recall against mass, for every estimator that gives a mass."""
    masses = [(k, value) for k, (axis, value, _) in enumerate(points) if axis == "mass"]
    known = np.array([value for _, value in masses])
    snr = detection_snr(setting.experiment_in_region, known)
    found: dict[str, Any] = {}
    for who, given in answers.items():
        nothing = given[-1].columns.get("mass_kda")
        if nothing is None or not np.isfinite(nothing).any():
            continue
        recalls = [
            recall_at(nothing, given[k].columns.get("mass_kda", np.zeros(1)), rate, seed)
            for k, _ in masses
        ]
        found[who] = {key: [one[key] for one in recalls] for key in ("recall", "recall_ci95")}
    return {
        "false_alarm_rate": rate,
        "mass_kda": known.tolist(),
        "snr": snr.tolist(),
        "matched_filter": [power_bound(float(s), rate) for s in snr],
        "estimators": found,
    }
