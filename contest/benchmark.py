"""`iscat benchmark`: everything one configuration can say about its own estimators, as a folder."""

from __future__ import annotations

import math
import platform
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from iscat_analysis.config import Config, config_to_toml, refuse_sphere
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import PARAMETERS, FloatArray, Progress, Status, silent
from iscat_analysis.report import BENCHMARK_NAMES, atomic_folder, check_output, render_benchmark
from iscat_analysis.schemas import to_json
from iscat_analysis.study import (
    MIN_TRIALS,
    OF_DIPOLES,
    OF_SPHERES,
    RANKS,
    PosteriorRanks,
    Setting,
    Trials,
    calibrate_posterior,
    make_setting,
    pull_histogram,
    rank_test,
    run_trials,
    score,
    share,
    share_interval,
)
from iscat_contest.compare import compare_estimators
from iscat_contest.estimators import Estimator
from iscat_contest.process import answer, job_of
from iscat_contest.publish import bibtex
from iscat_contest.scoring import ranking
from iscat_contest.simple import gauss_ls, peak

PHOTONS = (100.0, 300.0, 1e3, 3e3, 1e4, 3e4)
"""Collected scattered photons of the first curve."""

HEIGHTS = 9
"""Heights of the second curve, spread over ``fit.z_range_nm``."""

FINE_HEIGHTS = 161
"""Heights at which the bounds are drawn."""

CURVE_SHARE = 4
"""A point of a curve has this many times fewer trials than the table."""

POSTERIOR_SHARE = 20
"""A posterior is sampled for one in this many trials."""

PRIOR_XY_NM = 100.0
PRIOR_Z_NM = 60.0
PRIOR_MASS = 2.0
"""Half-widths, and factor, of the prior that particles are drawn from for the posteriors."""

LEAST_TRIALS = 20

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
    posteriors = max(trials // POSTERIOR_SHARE, MIN_TRIALS) if posterior else 0
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
        curves["photons"][mode] = _along_photons(config, setting, stream + 10, shorter)
        curves["z"][mode] = _along_heights(config, setting, stream + 40, shorter)
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
        "scheme": config.optics.scheme,
        "emission": config.optics.emission,
        "convention": config.optics.convention,
        "command": command or "iscat_contest.benchmark.run_benchmark",
        "config": config_to_toml(config),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("iscat-analysis", "numpy", "scipy", "numba")},
        },
    }


def write_benchmark(study: Mapping[str, Any], folder: Path, *, overwrite: bool = False) -> Path:
    """Write ``benchmark.json``, its page, ``benchmark.bib``, ``config.toml`` and ``figures/``."""
    with atomic_folder(folder, overwrite, known=BENCHMARK_NAMES) as building:
        text = to_json("benchmark", study)
        (building / "benchmark.json").write_text(text + "\n", encoding="utf-8")
        (building / "config.toml").write_text(study["config"], encoding="utf-8")
        (building / "benchmark.bib").write_text(bibtex("Benchmark", text), encoding="utf-8")
        (building / "figures").mkdir()
        page = render_benchmark(study, folder=building / "figures")
        (building / "benchmark.html").write_text(page, encoding="utf-8")
    return folder


def check_benchmark_output(folder: Path, overwrite: bool) -> None:
    """Refuse a folder that must not be written, before any work is done."""
    check_output(folder, overwrite, known=BENCHMARK_NAMES)


def _pull(trials: Trials, k: int) -> FloatArray:
    kept = trials.usable
    pull: FloatArray = (trials.estimate[kept, k] - trials.truth[kept, k]) / trials.sigma[kept, k]
    return pull


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
        out[name] = {**own.plain(), **covered, "baselines": baselines}
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


def _along_photons(config: Config, setting: Setting, stream: int, run: Run) -> dict[str, Any]:
    """Tabulate spread and bounds against the light, at a height far from the range's ends."""
    make = partial(make_setting, config, setting.mode, context=setting.context)
    clear = float(make(collected=PHOTONS[0]).truth[2])
    settings = [make(collected=photons, z_nm=clear) for photons in PHOTONS]
    return _curve(list(PHOTONS), settings, stream, run)


def _along_heights(config: Config, setting: Setting, stream: int, run: Run) -> dict[str, Any]:
    """Tabulate spread and bounds against the height; the bounds between its points as well."""
    heights = _heights(config)
    make = partial(make_setting, config, setting.mode, context=setting.context)
    curve = _curve(heights, [make(z_nm=z) for z in heights], stream, run)
    return curve | {"bounds": _bounds_along(config, setting)}


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


def _bounds_along(config: Config, setting: Setting) -> dict[str, Any]:
    """Tabulate the bounds between the heights of the curve: fringes are narrower than its steps."""
    heights = np.linspace(*_heights_of(config), FINE_HEIGHTS)
    make = partial(make_setting, config, setting.mode, context=setting.context)
    settings = [make(z_nm=float(z)) for z in heights]
    lines = {
        name: {kind: [float(getattr(s, kind)[k]) for s in settings] for kind in ("crb", "qcrb")}
        for name, k in setting.scored.items()
    }
    return {"at": heights.tolist(), **lines}


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
