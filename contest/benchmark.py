"""`iscat benchmark`: everything one configuration can say about its own estimators, as a folder.

Estimators of others are set beside it: the same counts for all, along everything that varies.  The
truths of the trials differ by some of their bounds.  An estimator cannot know them, and the
gradient of its bias can be measured (`yardstick`).
"""

from __future__ import annotations

import math
import platform
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.config import Config, config_to_toml, refuse_sphere
from iscat_analysis.errors import ConfigError, ContrastError
from iscat_analysis.records import PARAMETERS, FloatArray, Progress, Status, silent
from iscat_analysis.report import BENCHMARK_NAMES, atomic_folder, render_benchmark
from iscat_analysis.schemas import to_json
from iscat_analysis.study import (
    MIN_TRIALS,
    OF_DIPOLES,
    OF_SPHERES,
    RANKS,
    Limits,
    PosteriorRanks,
    Setting,
    Trials,
    beside_best,
    calibrate_posterior,
    detection_snr,
    limits_of_alike,
    make_setting,
    paired,
    power_bound,
    pull_histogram,
    rank_test,
    recall_at,
    resamples,
    run_trials,
    score,
    score_estimates,
    share,
    share_interval,
    trial_generator,
)
from iscat_contest.estimators import Estimator
from iscat_contest.process import Answer, Job, answer, job_of, run_estimators
from iscat_contest.scoring import bibtex, ranking
from iscat_contest.simple import gauss_ls, peak

PHOTONS = (100.0, 300.0, 1e3, 3e3, 1e4, 3e4)
"""Collected scattered photons of the first curve."""

HEIGHTS = 9
"""Heights of the second curve, spread over ``fit.z_range_nm``."""


CURVE_SHARE = 4
"""A point of a curve has this many times fewer trials than the table."""


PRIOR_XY_NM = 100.0
PRIOR_Z_NM = 60.0
PRIOR_MASS = 2.0
"""Half-widths, and factor, of the prior that particles are drawn from for the posteriors."""

LEAST_TRIALS = 20
"""Of a table, and of a point of a curve."""

TIME_LIMIT_S = 600.0
"""Of an estimator, for all that it is asked."""


def run_benchmark(
    config: Config,
    *,
    trials: int = 1000,
    seed: int = 1,
    workers: int | None = None,
    posterior: bool = True,
    estimators: Sequence[Estimator] = (),
    time_limit_s: float = TIME_LIMIT_S,
    command: str = "",
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure what the fits achieve, in every mode of the particle, on synthetic shot noise.

    Other estimators then get counts of the same experiments, each the same.
    """
    if trials < LEAST_TRIALS:
        raise ConfigError(
            f"trials = {trials} say nothing about a spread: give at least {LEAST_TRIALS}"
        )
    threads = config.compute.workers if workers is None else workers
    fewer = max(trials // CURVE_SHARE, LEAST_TRIALS)
    posteriors = max(trials // 20, MIN_TRIALS) if posterior else 0  # one in so many trials
    if estimators:
        refuse_sphere(config, "the estimators of others are of dipoles")
    modes = OF_SPHERES if config.particle.is_sphere else OF_DIPOLES
    settings = {mode: make_setting(config, mode) for mode in modes}
    total = len(modes) * (trials + fewer * (len(PHOTONS) + HEIGHTS) + posteriors * 4)
    tally = _tally(progress, total)
    run = partial(run_trials, seed=seed, workers=threads, advance=tally)
    advance = lambda n: tally(4 * n)  # noqa: E731
    sample = partial(calibrate_posterior, seed=seed, workers=threads, advance=advance)
    study: dict[str, Any] = {}
    curves: dict[str, dict[str, Any]] = {"photons": {}, "z": {}}
    histograms: dict[str, dict[str, Any]] = {"pulls": {}, "ranks": {}}
    for number, (mode, setting) in enumerate(settings.items()):
        stream = 100 * number
        found = run(setting, trials, stream=stream, keep_counts=mode in OF_DIPOLES)
        lower, upper = _prior(setting)
        ranked = sample(setting, posteriors, lower=lower, upper=upper, stream=stream + 1)
        study[mode] = _scores(setting, found, ranked) | {"posteriors": posteriors, "seed": seed}
        histograms["pulls"][mode] = {
            name: pull_histogram(_pull(found, k)) for name, k in setting.scored.items()
        }
        histograms["ranks"][mode] = _rank_histograms(ranked)
        shorter = partial(run, count=fewer)
        make = partial(make_setting, config, mode, context=setting.context)
        clear = float(make(collected=PHOTONS[0]).truth[2])  # a height far from the range's ends
        lit = [make(collected=photons, z_nm=clear) for photons in PHOTONS]
        curves["photons"][mode] = _curve(list(PHOTONS), lit, stream + 10, shorter)
        heights = _heights(config)
        curve = _curve(heights, [make(z_nm=z) for z in heights], stream + 40, shorter)
        # the bounds are drawn between its points as well: fringes are narrower than its steps
        fine = np.linspace(*_heights_of(config), 161).tolist()
        curves["z"][mode] = curve | {"bounds": _bounds_along(fine, [make(z_nm=z) for z in fine])}
    if estimators:
        limited = partial(compare_estimators, time_limit_s=time_limit_s, progress=progress)
        others = limited(config, estimators, trials=trials, seed=seed)
        parts = {
            mode: {
                "bounds": dict.fromkeys(setting.free),
                "trials": trials,
                "estimators": {who: entry[mode] for who, entry in others["estimators"].items()},
            }
            for mode, setting in settings.items()
        }
        study |= {**others, "ranking": ranking(parts)}
    return {
        **study,
        "curves": curves,
        "histograms": histograms,
        "trials": trials,
        "seed": seed,
        **{name: getattr(config.optics, name) for name in ("scheme", "emission", "convention")},
        "command": command or "iscat_contest.benchmark.run_benchmark",
        "config": config_to_toml(config),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("iscat-analysis", "numpy", "scipy", "numba")},
        },
    }


def write_benchmark(study: Mapping[str, Any], folder: Path, *, overwrite: bool = False) -> Path:
    """Write ``benchmark.json``, its page, ``benchmark.bib`` and ``config.toml``."""
    with atomic_folder(folder, overwrite, known=BENCHMARK_NAMES) as building:
        text = to_json("benchmark", study)
        (building / "benchmark.json").write_text(text + "\n", encoding="utf-8")
        (building / "config.toml").write_text(study["config"], encoding="utf-8")
        (building / "benchmark.bib").write_text(bibtex("Benchmark", text), encoding="utf-8")
        (building / "benchmark.html").write_text(render_benchmark(study), encoding="utf-8")
    return folder


def _pull(trials: Trials, k: int) -> FloatArray:
    kept = trials.usable
    return np.asarray((trials.estimate - trials.truth)[kept, k] / trials.sigma[kept, k])


def _tally(progress: Progress, total: int) -> Callable[[int], None]:
    """Count trials of several threads for one progress bar."""
    done, lock = 0, threading.Lock()

    def tally(more: int) -> None:
        nonlocal done
        with lock:
            done += more
            progress("benchmark", done, total)

    return tally


def laboratory_estimates(setting: Setting, trials: Trials) -> dict[str, dict[str, FloatArray]]:
    """Measure the counts that were kept as most laboratories do: Gaussian, and highest pixel."""
    if trials.counts_e is None:
        return {}
    before, after = trials.counts_e
    job = job_of(setting, before, after, trials.start)
    return {"gaussian": answer(gauss_ls, job).columns, "peak": answer(peak, job).columns}


def _scores(setting: Setting, found: Trials, ranked: PosteriorRanks) -> dict[str, Any]:
    """Score every free parameter, and count what failed."""
    crbs, qcrbs, kept = setting.crb, setting.qcrb, found.usable
    error = found.estimate - found.truth
    labs = laboratory_estimates(setting, found)
    out: dict[str, Any] = {}
    for i, (name, k) in enumerate(setting.scored.items()):
        crb, qcrb = float(crbs[k]), float(qcrbs[k])
        own = score(error[kept, k], found.sigma[kept, k], crb, qcrb)
        baselines = {}
        for label, columns in labs.items():
            if name not in columns or (label == "peak" and name != "mass_kda"):
                continue  # the highest pixel gives a mass only, no position
            miss = columns[name] - found.truth[:, k]
            finite = miss[np.isfinite(miss)]
            if finite.size >= MIN_TRIALS:
                scored = score(miss, np.full(miss.size, np.nan), crb, qcrb)
                names = ("bias", "bias_se", "spread", "spread_robust", "spread_over_crb")
                baselines[label] = {key: getattr(scored, key) for key in names} | {
                    "robust_over_crb": scored.spread_robust / crb,
                    "rmse_over_crb": float(np.sqrt(np.mean(finite**2))) / crb,
                    "failed": int(miss.size - finite.size),
                }
        widths = ranked.width_over_crb[ranked.kept, i]
        covered: dict[str, Any] = {}
        for level, all_inside in ((68, ranked.inside68), (95, ranked.inside95)):
            inside = all_inside[ranked.kept, i]
            covered[f"posterior_coverage{level}"] = share(inside)
            covered[f"posterior_coverage{level}_ci95"] = share_interval(inside)
        covered["posterior_width_over_crb"] = float(np.mean(widths)) if widths.size else math.nan
        out[name] = {**vars(own), **covered, "baselines": baselines}
    return out | {
        "trials": len(found),
        "failed": int(found.failed.sum()),
        "flagged": {str(s): int(found.flagged(s).sum()) for s in Status if s != Status.OK},
        "fits_per_second": len(found) / found.seconds if found.seconds else math.nan,
        "posteriors_refused": ranked.refused,
        "at": setting.described(),
    }


def _rank_histograms(ranked: PosteriorRanks) -> dict[str, Any]:
    kept = ranked.ranks[ranked.kept]
    if not len(kept):
        return {}
    bins = 20 if len(kept) >= 100 else 10 if len(kept) >= 50 else 5
    out = {}
    for i, name in enumerate(ranked.names):
        p_value, counts = rank_test(kept[:, i], RANKS, bins)
        out[name] = {"counts": counts.tolist(), "possible": RANKS, "p_value": p_value}
    return out


Run = Callable[..., Trials]
"""`run_trials` for a setting and a stream, with the rest of a benchmark's choices."""


def _curve(values: list[float], settings: list[Setting], stream: int, run: Run) -> dict[str, Any]:
    """Tabulate spread and bounds along an axis, for every free parameter."""
    found = [run(setting, stream=stream + number) for number, setting in enumerate(settings)]
    out: dict[str, Any] = {
        "at": values,
        "trials": len(found[-1]),
        "failed": [int(trials.failed.sum()) for trials in found],
        "ambiguous": [int(trials.ambiguous.sum()) for trials in found],
    }
    kinds = ("spread", "spread_ci95", "bias", "crb", "qcrb")
    for name, k in settings[0].scored.items():
        scores = [
            score(
                (trials.estimate - trials.truth)[trials.usable, k],
                trials.sigma[trials.usable, k],
                float(setting.crb[k]),
                float(setting.qcrb[k]),
            )
            for trials, setting in zip(found, settings, strict=True)
        ]
        out[name] = {kind: [getattr(one, kind) for one in scores] for kind in kinds}
    return out


def _bounds_along(heights: list[float], settings: list[Setting]) -> dict[str, Any]:
    """Tabulate the bounds of settings along the height."""
    lines = {
        name: {kind: [float(getattr(s, kind)[k]) for s in settings] for kind in ("crb", "qcrb")}
        for name, k in settings[0].scored.items()
    }
    return {"at": heights, **lines}


def _heights_of(config: Config) -> tuple[float, float]:
    """Give the heights that are searched, as far as a sphere is not inside the coverslip."""
    low, high = config.fit.z_range_nm
    radius = config.particle.nominal_diameter_nm / 2 if config.particle.is_sphere else low
    return max(low, radius), high


def _heights(config: Config) -> list[float]:
    low, high = _heights_of(config)
    inset = (high - low) / (2 * HEIGHTS)
    return [float(z) for z in np.linspace(low + inset, high - inset, HEIGHTS)]


def _prior(setting: Setting) -> tuple[FloatArray, FloatArray]:
    """Box of the prior around a setting's particle; no width where a parameter is fixed."""
    free = np.array([name in setting.free for name in PARAMETERS])
    reach = np.array([PRIOR_XY_NM, PRIOR_XY_NM, PRIOR_Z_NM, 0.0])
    factor = np.array([1.0, 1.0, 1.0, PRIOR_MASS])
    lower, upper = (setting.truth - reach) / factor, (setting.truth + reach) * factor
    lower[2], upper[2] = np.clip([lower[2], upper[2]], *setting.config.fit.z_range_nm)
    return np.where(free, lower, setting.truth), np.where(free, upper, setting.truth)


RANGE_PX, RANGE_Z_NM, RANGE_MASS = 0.5, 10.0, 0.1
"""The same in pixels, nanometres, and relative to the mass."""

SNRS = (1.5, 2.5, 3.5, 5.0, 8.0, 16.0)
HEIGHT_SHARES = (0.1, 0.3, 0.5, 0.7, 0.9)
FOCI_NM = (-400.0, -200.0, 0.0, 200.0, 400.0)
DENSITIES = (0.03, 0.1, 0.3, 1.0)
WRONG_NM = (0.0, 50.0, 100.0, 200.0)
"""Points of the curves: photons collected, masses by the signal-to-noise ratio of the matched
filter, heights as shares of ``fit.z_range_nm``, changes of the focus, other particles of the same
mass per µm², and error of the focus that estimators are told."""

MAP_PHOTONS = (100.0, 500.0, 2.5e3, 1.25e4)
"""Photons collected, at each of the heights, of the map of who is best where."""

FALSE_ALARMS = 20
"""Empty regions above the threshold, at least, so that a rate of false alarms is known."""


@dataclass(frozen=True, eq=False)
class Draws:
    """Counts of one experiment, drawn once for all estimators."""

    job: Job
    limits: Limits


@dataclass(frozen=True, eq=False)
class Point:
    """Counts at one place of a curve, or of the map, whose abscissa is the height."""

    axis: str
    value: float
    draws: Draws
    scores: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    answers: Mapping[str, Answer] = field(default_factory=dict)


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
    pixel = setting.context.pixel_nm
    area_um2 = (true.pixels * true.context.pixel_nm / 1000) ** 2
    others = replace(true, context=replace(true.context, model=true.context.wide))
    most = np.array([RANGE_PX * pixel, RANGE_PX * pixel, RANGE_Z_NM, RANGE_MASS * setting.truth[3]])
    # half-width of the truths' range, in bounds, as long as the following are not exceeded
    width = np.fmin(5.0 * true.bounds.crb_joint, most)  # where there is no bound, the most
    width[[name not in setting.free for name in PARAMETERS]] = 0.0
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
        for _ in range(random.poisson(density_um2 * area_um2) if density_um2 else 0):
            place = random.uniform(-0.5, true.pixels - 0.5, 2) * pixel
            frame = frame + others.signal_e(np.array([*place, *truths[i, 2:]]))
        counts = true.windows(np.broadcast_to(frame, (true.pixels, true.pixels)), random)
        before.append(counts.before_e)
        after.append(counts.after_e)
    limits = limits_of_alike(true.experiment_in_region, true.free, truths, level=true.level)
    return Draws(job_of(setting, np.stack(before), np.stack(after), starts), limits)


def compare_estimators(
    config: Config,
    estimators: Sequence[Estimator],
    *,
    trials: int,
    seed: int,
    time_limit_s: float,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Let estimators see the same counts, and score them: ``estimators``, ``paired``, curves."""
    mode = config.fit.mode if config.fit.mode in OF_DIPOLES else "mass"
    settings = {m: make_setting(config, m) for m in OF_DIPOLES}
    tables = {
        m: draw(s, trials, seed=seed, stream=1000 + k) for k, (m, s) in enumerate(settings.items())
    }
    fewer = max(trials // CURVE_SHARE, LEAST_TRIALS)
    points = [
        *_points(config, settings[mode], fewer, seed),
        *_map_points(config, settings[mode], fewer, seed),
    ]
    rate = max(config.bounds.false_alarm_probability, FALSE_ALARMS / max(trials, 2 * FALSE_ALARMS))
    empty = draw(settings["mass"], trials, seed=seed, stream=1900, empty=True)
    jobs = [*(d.job for d in tables.values()), *(p.draws.job for p in points), empty.job]
    answers = run_estimators(estimators, jobs, time_limit_s, progress)
    scored: dict[str, Any] = {
        one.name: {"about": one.about}
        | {m: _scored(d, answers[one.name][k], seed) for k, (m, d) in enumerate(tables.items())}
        for one in estimators
    }
    pairs = {}
    for k, (m, drawn) in enumerate(tables.items()):
        columns = {name: given[k].columns for name, given in answers.items()}
        scores = {name: entry[m] for name, entry in scored.items()}
        pairs[m] = beside_best(columns, scores, drawn.limits, seed)
    for k, point in enumerate(points):
        given = {name: found[len(tables) + k] for name, found in answers.items()}
        limits = point.draws.limits
        scores = {who: score_estimates(one.columns, limits, seed) for who, one in given.items()}
        points[k] = replace(point, answers=given, scores=scores)
    nothing = {name: found[-1] for name, found in answers.items()}
    return {
        "estimators": scored,
        "estimator_curves": {"mode": mode, "trials": fewer, **_curves(points)},
        "estimator_map": {"mode": mode, "trials": fewer, **_map(points, seed)},
        "paired": pairs,
        "detection": _detection(points, nothing, settings["mass"], rate, seed),
    }


def _scored(drawn: Draws, answer: Answer, seed: int) -> dict[str, Any]:
    count = len(drawn.limits)
    return {
        **score_estimates(answer.columns, drawn.limits, seed),
        "trials": count,
        "failed": sum(answer.failures.values()),
        "failures": answer.failures,
        "seconds_per_fit": answer.seconds / count,
        "processor_seconds_per_fit": answer.processor_seconds / count,
        "peak_mb": answer.peak_mb,
    }


MAP = "map"


def _points(config: Config, setting: Setting, count: int, seed: int) -> list[Point]:
    """Draw what the curves show."""
    mode, optics = setting.mode, config.optics
    found: list[Point] = []

    def add(axis: str, value: float, one: Setting, **options: Any) -> None:
        drawn = draw(one, count, seed=seed, stream=1100 + len(found), **options)
        found.append(Point(axis, value, drawn))

    made = partial(make_setting, config, mode, context=setting.context)
    clear = float(made(collected=PHOTONS[0]).truth[2])
    for photons in PHOTONS:
        add("photons", photons, made(collected=photons, z_nm=clear))
    mass = make_setting(config, "mass")
    per_kda = float(detection_snr(mass.experiment_in_region, mass.truth[3:])[0]) / mass.truth[3]
    for snr in SNRS if math.isfinite(per_kda) else ():
        kda = snr / per_kda
        add("mass", kda, replace(mass, truth=np.array([*mass.truth[:3], kda])))
    for z_nm in _heights_compared(config):
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
    made = partial(make_setting, config, setting.mode, context=setting.context)
    places = enumerate(product(_heights_compared(config), MAP_PHOTONS), 1500)
    return [
        Point(MAP, z, draw(made(collected=photons, z_nm=z), count, seed=seed, stream=stream))
        for stream, (z, photons) in places
    ]


def _heights_compared(config: Config) -> list[float]:
    low, high = config.fit.z_range_nm
    return [low + share * (high - low) for share in HEIGHT_SHARES]


def _map(points: Sequence[Point], seed: int) -> dict[str, Any]:
    """Tell who keeps most of the information at each height and light, and who is as good.

    As good are those whose mean square error on the same counts is not larger, by its interval.
    """
    cells = [point for point in points if point.axis == MAP]
    shape = len(cells) // len(MAP_PHOTONS), len(MAP_PHOTONS)
    out: dict[str, Any] = {}
    for (row, column), cell in zip(np.ndindex(shape), cells, strict=True):
        limits, count = cell.draws.limits, len(cell.draws.limits)
        for i, name in enumerate(limits.free):
            empty = {key: [[None] * shape[1] for _ in range(shape[0])] for key in _CELL}
            table = out.setdefault(name, empty)
            kept = {
                who: one[name]["efficiency_crb"] * one[name]["answered"] / count
                for who, one in cell.scores.items()
                if math.isfinite(one.get(name, {}).get("efficiency_crb", math.nan))
                and not one[name]["below_bound"]
            }
            if not kept:
                continue
            best = max(kept, key=lambda who: kept[who])
            truth = limits.truths[:, PARAMETERS.index(name)]
            errors = {who: cell.answers[who].columns[name] - truth for who in kept}
            against = partial(paired, theirs=errors[best], crb=limits.crb[:, i])
            weights = resamples(count, seed)
            equal = [
                who
                for who, error in errors.items()
                if who != best and not against(error, weights=weights)["mse_ratio_ci95"][0] > 1
            ]
            for key, value in zip(_CELL, (best, kept[best], equal), strict=True):
                table[key][row][column] = value
    heights = [cell.value for cell in cells[:: shape[1]]]
    return {"photons": list(MAP_PHOTONS), "height_nm": heights, "parameters": out}


_CELL = ("best", "kept", "equal")


def _refocused(config: Config, mode: str, change_nm: float) -> Setting | None:
    """Change the focus; nothing where the calibration's sign does not suit the new one."""
    changed = config.optics.model_copy(update={"focus_nm": config.optics.focus_nm + change_nm})
    try:
        return make_setting(config.model_copy(update={"optics": changed}), mode)
    except ContrastError:
        return None


def _curves(points: Sequence[Point]) -> dict[str, Any]:
    """Tabulate error and bounds along each axis, for every parameter and estimator."""
    nothing = {"rmse": math.nan, "rmse_ci95": (math.nan, math.nan), "efficiency_crb": math.nan}
    out: dict[str, Any] = {}
    for point in (point for point in points if point.axis != MAP):
        limits = point.draws.limits
        curve = out.setdefault(point.axis, {"at": [], "bounds": {}, "estimators": {}})
        curve["at"].append(point.value)
        for i, name in enumerate(limits.free):
            crb = float(np.sqrt(np.mean(limits.crb[:, i] ** 2)))
            qcrb, holevo = float(limits.qcrb[0, i]), float(limits.holevo[0, i])
            _append(curve["bounds"], name, {"crb": crb, "qcrb": qcrb, "holevo": holevo})
            for who, scored in point.scores.items():
                entry = {**nothing, "failed": len(limits), **scored.get(name, {})}
                line = {key: entry[key] for key in (*nothing, "failed")}
                _append(curve["estimators"].setdefault(who, {}), name, line)
    return out


def _append(lines: dict[str, Any], name: str, values: Mapping[str, Any]) -> None:
    """Add a point to the lines of a parameter."""
    for key, value in values.items():
        lines.setdefault(name, {}).setdefault(key, []).append(value)


def _detection(
    points: Sequence[Point], nothing: Mapping[str, Answer], setting: Setting, rate: float, seed: int
) -> dict[str, Any]:
    """Tabulate recall against mass, for every estimator that gives a mass.

    `nothing` has the answers to empty regions.
    """
    masses = [point for point in points if point.axis == "mass"]
    known = np.array([point.value for point in masses])
    snr = detection_snr(setting.experiment_in_region, known)
    found: dict[str, Any] = {}
    for who, none in nothing.items():
        empty = none.columns.get("mass_kda", np.zeros(0))
        if not np.isfinite(empty).any():
            continue
        signals = [point.answers[who].columns.get("mass_kda", np.zeros(1)) for point in masses]
        recalls = [recall_at(empty, signal, rate, seed) for signal in signals]
        found[who] = {key: [one[key] for one in recalls] for key in ("recall", "recall_ci95")}
    return {
        "false_alarm_rate": rate,
        "mass_kda": known.tolist(),
        "snr": snr.tolist(),
        "matched_filter": [power_bound(float(s), rate) for s in snr],
        "estimators": found,
    }
