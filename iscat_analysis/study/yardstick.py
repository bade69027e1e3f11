"""Estimates on the scale of the bounds, with intervals from a bootstrap over the trials.

Errors are taken in units of each particle's own Cramér–Rao bound, so that particles of different
mass or light can be scored together.  A straight line of the error against the truth is fitted as
well: its slope is the gradient of the bias, ∂b, and what is left is the spread.  An estimator with
a bias is held to the bound of its own mean value,

    Var θ̂ᵢ ≥ g V gᵀ,        gⱼ = δᵢⱼ + ∂bᵢ/∂θⱼ,        V the joint Cramér–Rao bound

(H. L. Van Trees, *Detection, Estimation, and Modulation Theory I* (1968), 2.4.2).  One that lies
below this has had help from something other than the counts.

All statistics are functions of weighted sums over the trials, and a resample is a set of weights;
the same resamples serve all estimators of the same trials, so that differences are paired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from iscat_analysis.bounds import Experiment, event_bounds, holevo_over_quantum
from iscat_analysis.bounds.detection import detection_limit
from iscat_analysis.bounds.experiment import detector, expected_likelihood, light_of
from iscat_analysis.optics.model import collected_area_nm2
from iscat_analysis.records import PARAMETERS, BoolArray, FloatArray
from iscat_analysis.study.scores import MIN_TRIALS

RESAMPLES = 1000
"""Of the bootstrap; the ends of a 95 % interval are then known to a few percent of its width."""

FAR = 4.0
"""Standard errors below the bound that are no chance."""

FOLLOWS = 0.2
"""An estimator whose mean moves less than this share of the truth does not estimate it."""


_WIDE = float(ndtri(0.975))


def resamples(count: int, seed: int) -> FloatArray:
    """Weights of the bootstrap's resamples; the first row is the sample itself.

    Shapes: result (RESAMPLES + 1, count).
    """
    random = np.random.default_rng([seed, count])
    out = np.ones((RESAMPLES + 1, count))
    for row in range(1, RESAMPLES + 1):
        out[row] = np.bincount(random.integers(0, count, count), minlength=count)
    return out


def score_estimates(
    columns: Mapping[str, FloatArray], limits: Limits, seed: int
) -> dict[str, dict[str, Any]]:
    """Score every free parameter that an estimator gives.

    Shapes: `columns` (n,) each.
    """
    truths, weights = limits.truths, resamples(len(limits), seed)
    index = [PARAMETERS.index(name) for name in limits.free]
    deviation = truths[:, index] - truths[:, index].mean(axis=0)
    out = {}
    for i, name in enumerate(limits.free):
        if name in columns and np.any(np.isfinite(columns[name])):
            error = columns[name] - truths[:, index[i]]
            sigma = columns.get(f"sigma_{name}", np.full(error.size, np.nan))
            out[name] = _score(error, sigma, deviation, limits, i, weights)
    return out


def _score(
    error: FloatArray,
    sigma: FloatArray,
    deviation: FloatArray,
    limits: Limits,
    i: int,
    weights: FloatArray,
) -> dict[str, Any]:
    kept = np.isfinite(error) & np.isfinite(limits.crb[:, i])
    error, sigma, w = error[kept], sigma[kept], weights[:, kept]
    crb, covariance = limits.crb[kept, i], limits.covariance[kept]
    qcrb, holevo = limits.qcrb[kept, i], limits.holevo[kept, i]
    counts: dict[str, Any] = {"answered": int(kept.sum()), "failed": int((~kept).sum())}
    bounds = {"crb": _rms(crb), "qcrb": _rms(qcrb), "holevo": _rms(holevo)}
    if error.size < MIN_TRIALS:
        return {**counts, **bounds, "verdict": "too few estimates to be scored"}
    total = w.sum(axis=1)
    scaled = error / crb
    left, slopes = _line(scaled, deviation[kept] / crb[:, None], 1 / crb, w)
    gradient = slopes.copy()
    gradient[:, i] += 1
    in_crb = np.mean(covariance / crb[:, None, None] ** 2, axis=0)
    own_bound = np.sqrt(np.einsum("bi,ij,bj->b", gradient, in_crb, gradient))
    square = (w @ scaled**2) / total
    with np.errstate(divide="ignore", invalid="ignore"):
        found = {
            "bias": (w @ error) / total,
            "spread": left * bounds["crb"],
            "rmse": np.sqrt((w @ error**2) / total),
            "spread_over_crb": left,
            "spread_over_qcrb": left * bounds["crb"] / bounds["qcrb"],
            "spread_over_holevo": left * bounds["crb"] / bounds["holevo"],
            "efficiency_crb": 1 / square,
            "efficiency_qcrb": 1 / ((w @ (error / qcrb) ** 2) / total),
            "efficiency_holevo": 1 / ((w @ (error / holevo) ** 2) / total),
            "bias_gradient": slopes[:, i],
            "biased_bound_over_crb": own_bound,
            "spread_over_biased_bound": left / own_bound,
            **_own_errors(error, sigma, w),
        }
    scored: dict[str, Any] = {**counts, **bounds}
    for name, values in found.items():
        scored[name] = float(values[0])
        scored[f"{name}_ci95"] = _interval(values)
    scored["bias_se"] = _standard_error(found["bias"])
    below = error.size >= _enough(deviation.shape[1]) and _below(
        found["spread_over_biased_bound"], float(own_bound[0])
    )
    return {**scored, "below_bound": below, "verdict": _verdict(scored, below)}


def _line(
    scaled: FloatArray, slopes: FloatArray, constant: FloatArray, w: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fit error against truth in every resample; the spread about the line, and its slopes.

    Shapes: `scaled, constant` (n,), `slopes` (n, d), result (resamples,) and (resamples, d).
    """
    # variation of the truth, in units of the bound, below which there is no gradient to measure
    varied = (np.std(slopes, axis=0) > 1e-6) & (len(slopes) >= _enough(slopes.shape[1]))
    features = np.column_stack([constant, slopes[:, varied]])
    size = np.sqrt(np.mean(features**2, axis=0))
    features = features / size
    p = features.shape[1]
    products = (features[:, :, None] * features[:, None, :]).reshape(len(features), p * p)
    matrix = (w @ products).reshape(-1, p, p)
    right = w @ (features * scaled[:, None])
    line = np.einsum("bij,bj->bi", np.linalg.pinv(matrix, hermitian=True), right)
    rest = w @ scaled**2 - np.einsum("bi,bi->b", line, right)
    free = np.maximum(w.sum(axis=1) - p, 1.0)
    out = np.zeros((len(w), slopes.shape[1]))
    out[:, varied] = (line / size)[:, 1:]
    return np.sqrt(np.maximum(rest, 0.0) / free), out


def _enough(parameters: int) -> int:
    """Say how many particles it takes to measure gradients of the bias."""
    # particles for each slope of the line, without which it would go through them by itself
    return 5 * (1 + parameters)


def _own_errors(error: FloatArray, sigma: FloatArray, w: FloatArray) -> dict[str, FloatArray]:
    """Ask whether the error bars that an estimator gives are right."""
    stated = np.isfinite(sigma) & (sigma > 0)
    names = ("pull_mean", "pull_std", "coverage68", "coverage95")
    if stated.sum() < MIN_TRIALS:
        return dict.fromkeys(names, np.full(len(w), np.nan))
    pull, w = error[stated] / sigma[stated], w[:, stated]
    total = w.sum(axis=1)
    mean = (w @ pull) / total
    variance = (w @ pull**2) / total - mean**2
    inside = [(w @ (np.abs(pull) < k).astype(float)) / total for k in (1.0, _WIDE)]
    return dict(zip(names, (mean, np.sqrt(np.maximum(variance, 0.0)), *inside), strict=True))


def _below(ratio: FloatArray, own_bound: float) -> bool:
    """Tell whether a spread is below its own bound by more than chance."""
    if not own_bound > FOLLOWS or not math.isfinite(ratio[0]):
        return False
    return bool(ratio[0] + FAR * _standard_error(ratio) < 1)


def _verdict(scored: Mapping[str, Any], below: bool) -> str:
    """Say in words what a reader must know before the ratio is believed."""
    if below:
        return "below the bound: its estimates know more than the counts say"
    high = scored["bias_gradient_ci95"][1]
    if high < FOLLOWS - 1:
        return "does not follow the particle: its mean hardly moves with the truth"
    if scored["spread_over_crb_ci95"][1] < 1 and high < 0:
        return "below the CRB by its bias, and not below the bound of biased estimators"
    if abs(scored["bias"]) > FAR * scored["bias_se"] and abs(scored["bias"]) > scored["spread"]:
        return "biased by more than its spread"
    return ""


def paired(
    ours: FloatArray, theirs: FloatArray, crb: FloatArray, weights: FloatArray
) -> dict[str, Any]:
    """Compare the errors of two estimators of the same trials, where both answered.

    Shapes: `ours, theirs, crb` (n,), `weights` (resamples, n).
    """
    both = np.isfinite(ours) & np.isfinite(theirs) & np.isfinite(crb)
    if both.sum() < MIN_TRIALS:
        return {"trials": int(both.sum()), "mse_ratio": math.nan, "mse_ratio_ci95": _NOTHING}
    w = weights[:, both]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = (w @ (ours[both] / crb[both]) ** 2) / (w @ (theirs[both] / crb[both]) ** 2)
    return {
        "trials": int(both.sum()),
        "mse_ratio": float(ratio[0]),
        "mse_ratio_ci95": _interval(ratio),
    }


def beside_best(
    columns: Mapping[str, Mapping[str, FloatArray]],
    scores: Mapping[str, Mapping[str, Any]],
    limits: Limits,
    seed: int,
) -> dict[str, Any]:
    """Compare all estimators with the most efficient one that is not below its bound.

    Shapes: `columns` (n,) each.
    """
    out: dict[str, Any] = {}
    weights = resamples(len(limits), seed)
    for i, name in enumerate(limits.free):
        ranked = {
            who: entry[name]["efficiency_crb"]
            for who, entry in scores.items()
            if math.isfinite(entry.get(name, {}).get("efficiency_crb", math.nan))
            and not entry[name]["below_bound"]
        }
        if not ranked:
            continue
        best = max(ranked, key=lambda who: ranked[who])
        truth = limits.truths[:, PARAMETERS.index(name)]
        errors = {who: one[name] - truth for who, one in columns.items() if name in one}
        out[name] = {"to": best} | {
            who: paired(error, errors[best], limits.crb[:, i], weights)
            for who, error in errors.items()
            if who != best
        }
    return out


def recall_at(empty: FloatArray, signal: FloatArray, rate: float, seed: int) -> dict[str, Any]:
    """Tell how many particles exceed what noise does in a share `rate` of empty regions.

    Shapes: `empty` (m,), `signal` (n,).
    """
    empty, signal = np.nan_to_num(np.abs(empty)), np.nan_to_num(np.abs(signal))
    first, second = resamples(empty.size, seed), resamples(signal.size, seed + 1)
    order = np.sort(empty)
    ranked = np.cumsum(first[:, np.argsort(empty)], axis=1)
    place = np.argmax(ranked >= (1 - rate) * empty.size, axis=1)
    above = signal[None] > order[place][:, None]
    share = np.sum(second * above, axis=1) / signal.size
    return {"recall": float(share[0]), "recall_ci95": _interval(share)}


def power_bound(snr: float, rate: float) -> float:
    """Probability to detect, of the best test of one known place (Neyman and Pearson)."""
    return float(ndtr(snr + ndtri(rate)))


def mean_interval(inside: BoolArray, weights: FloatArray) -> tuple[float, tuple[float, float]]:
    """Give a share of trials and its interval.

    Shapes: `inside` (n,), `weights` (resamples, n).
    """
    if not inside.size:
        return math.nan, _NOTHING
    values = (weights @ inside.astype(float)) / weights.sum(axis=1)
    return float(values[0]), _interval(values)


_NOTHING = (math.nan, math.nan)


def _interval(values: FloatArray) -> tuple[float, float]:
    """Percentiles of the resamples."""
    known = values[1:][np.isfinite(values[1:])]
    if not known.size or not math.isfinite(values[0]):
        return _NOTHING
    low, high = np.percentile(known, [2.5, 97.5])
    return float(low), float(high)


def _standard_error(values: FloatArray) -> float:
    known = values[1:][np.isfinite(values[1:])]
    return float(np.std(known)) if known.size else math.nan


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else math.nan


@dataclass(frozen=True, eq=False)
class Limits:
    """Bounds of n particles over d free parameters, in their order [nm, kDa].

    Shapes: `truths` (n, 4), `covariance` (n, d, d), `qcrb, holevo` (n, d), `snr, collected` (n,).
    """

    free: tuple[str, ...]
    truths: FloatArray
    covariance: FloatArray
    qcrb: FloatArray
    holevo: FloatArray
    snr: FloatArray
    collected: FloatArray

    @property
    def crb(self) -> FloatArray:
        """Joint Cramér–Rao bounds, shape (n, d)."""
        variance: FloatArray = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.sqrt(variance)

    def __len__(self) -> int:
        return len(self.covariance)

    def for_rows(self, rows: Sequence[int]) -> Limits:
        """Take the bounds of some particles, any of them more than once."""
        free, *arrays = vars(self).values()
        return Limits(free, *(array[rows] for array in arrays))


def limits_at(
    experiment: Experiment,
    free: tuple[str, ...],
    truths: FloatArray,
    *,
    frames: Sequence[tuple[int, int]] | None = None,
    level: bool = False,
) -> Limits:
    """Give the bounds of particles at their true places, heights and masses.

    Shapes: `truths` (n, 4); `frames` before and after, for each.
    """
    at = experiment.config.bounds
    found = [
        _one(experiment, free, truth, pair, level=level)
        for truth, pair in zip(
            truths, frames or [(at.n_before, at.n_after)] * len(truths), strict=True
        )
    ]
    return Limits(free, truths, *(np.array(part) for part in zip(*found, strict=True)))


def limits_of_alike(
    experiment: Experiment, free: tuple[str, ...], truths: FloatArray, *, level: bool = False
) -> Limits:
    """Give particles that are nearly alike their common bounds, from some of them.

    Shapes: `truths` (n, 4).
    """
    # bounds that are computed for particles that are nearly alike
    few = limits_at(experiment, free, truths[:64], level=level)
    n = len(truths)
    squared = (np.sqrt(np.mean(part**2, axis=0)) for part in (few.qcrb, few.holevo))
    qcrb, holevo = (np.tile(part, (n, 1)) for part in squared)
    return Limits(
        free, truths, np.tile(few.covariance.mean(axis=0), (n, 1, 1)), qcrb, holevo,
        np.full(n, few.snr.mean()), np.full(n, few.collected.mean()),
    )  # fmt: skip


def _one(
    experiment: Experiment,
    free: tuple[str, ...],
    truth: FloatArray,
    frames: tuple[int, int],
    *,
    level: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, float, float]:
    config, model, grid = experiment.config, experiment.model, experiment.grid
    x, y, z, mass = (float(v) for v in truth)
    light = light_of(config, model, grid.pixel_nm)
    theta = np.array([x, y, z, model.scale.amplitude(mass), 0.0])
    read_noise_e = detector(config)[1]
    likelihood = expected_likelihood(model, grid, theta, light, frames, read_noise_e=read_noise_e)
    collected = frames[1] * light[1] * collected_area_nm2(model, z, mass) / grid.pixel_nm**2
    bounds = event_bounds(likelihood, theta, free, collected, level=level)
    index = [PARAMETERS.index(name) for name in free]
    covariance = np.full((len(free), len(free)), np.nan)
    if np.all(np.isfinite(bounds.crb_joint[index])):
        scale = bounds.crb_single[index]
        scaled = bounds.fisher[np.ix_(index, index)] * np.outer(scale, scale)
        covariance = np.linalg.inv(scaled) * np.outer(scale, scale)
    qcrb = bounds.qcrb[index]
    cost = np.full(len(free), np.nan)
    if not model.is_measured:
        together = holevo_over_quantum(model, max(z, 0.0), free)
        cost = np.array([together[name] for name in free])
    fisher = likelihood.score_fisher(theta)[2]
    return covariance, qcrb, qcrb * cost, abs(theta[3]) * math.sqrt(fisher[3, 3]), collected


def detection_snr(experiment: Experiment, mass_kda: FloatArray) -> FloatArray:
    """Give the signal-to-noise ratio of the matched filter, which no test of one place beats.

    NaN in dark field, where the image is no linear function of the amplitude.

    Shapes: `mass_kda` (n,).
    """
    limit = detection_limit(experiment)
    amplitude = np.array([experiment.model.scale.amplitude(float(m)) for m in mass_kda])
    per_amplitude = limit.snr_per_amplitude if limit is not None else math.nan
    return np.asarray(np.abs(amplitude) * per_amplitude)
