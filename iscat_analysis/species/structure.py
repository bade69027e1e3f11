"""Mixtures whose components share parameters, in one sample or in several.

The logarithms of the weights, the means and the logarithms of the whole widths of the components of
a sample are linear in a few parameters θ,

    (ln w_k + c, μ_k, ln T_k) = origin + design·θ,    T_k² = τ_k² + σ²,

with Σ w_k = 1 and the usual error σ of the events.  A free mixture has a parameter for each; a
ladder has μ_k = n_k m₁ + b; two samples that share masses have the same columns for these and their
own for the weights; the background has its share alone.  The likelihood is that of `mixture` and
adds over samples, with the prior of `widths` in place of a fixed width; its slope is the slope of
each sample times its design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from iscat_analysis._kernels.mixture import detection_score, mixture_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Edge, Events
from iscat_analysis.species.mixture import Kinds, Mixture
from iscat_analysis.species.widths import width_prior

LOGIT_REACH = 12.0
"""Weights stay within a factor of e to this power of that of the first species."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Linear map from parameters to the components of one sample."""

    design: FloatArray
    origin: FloatArray
    noise: float
    broad: int = 0
    kind: Kinds | None = None

    def mixture(self, theta: FloatArray) -> Mixture:
        """Make the components of some parameters.

        Shapes: `theta` (p,).
        """
        logits, mean, width = self.origin + self.design @ theta
        weight = np.exp(logits - logits.max())
        variance = np.maximum(np.exp(2 * width) - self.noise, 0.0)
        return Mixture(weight / weight.sum(), mean, variance, broad=self.broad, kind=self.kind)

    def parameters(self, mixture: Mixture) -> FloatArray:
        """Parameters of components that this structure made.

        Shapes: result (p,).
        """
        logits = np.log(np.maximum(mixture.weight, 1e-300))
        width = np.log(mixture.variance + self.noise) / 2
        values = np.array([logits - logits[0], mixture.mean, width]) - self.origin
        rows = self.design.reshape(-1, self.design.shape[2])
        return np.asarray(np.linalg.lstsq(rows, values.ravel(), rcond=None)[0])

    def slope(self, mixture: Mixture, slopes: FloatArray) -> FloatArray:
        """Turn slopes in ln w, μ and τ² into such in the parameters.

        Shapes: `slopes` (3, k), result (p,).
        """
        slopes = slopes.copy()
        slopes[2] *= 2 * (mixture.variance + self.noise)
        return np.asarray(slopes.ravel() @ self.design.reshape(slopes.size, -1))


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of parameters, typical steps, and the prior −|rows θ − middle|²/2.

    Shapes: `low, high, scale` (p,), `rows` (r, p), `middle` (r,).
    """

    low: FloatArray
    high: FloatArray
    scale: FloatArray
    rows: FloatArray
    middle: FloatArray


@dataclass(frozen=True, eq=False)
class Optimum:
    """The maximum of the likelihood."""

    theta: FloatArray
    log_likelihood: float


def score(events: Events, mixture: Mixture) -> tuple[float, FloatArray]:
    """Log-likelihood of the events seen, and its slope.

    Shapes: `slopes` (3, k).
    """
    n = events.x.size
    value, slopes = mixture_score(
        events.x, events.variance, mixture.weight, mixture.mean, mixture.variance
    )
    if events.efficiency is None:
        slopes[0] -= n * mixture.weight
        return value, slopes
    seen, missed = detection_score(
        events.filter_variance[:, 0], events.efficiency.threshold_kda,
        n // len(events.filter_variance), mixture.weight, mixture.mean, mixture.variance,
    )  # fmt: skip
    return value - seen + events.log_seen, slopes - missed


def log_likelihood(
    samples: Sequence[tuple[Events, Structure]], theta: FloatArray, limits: Limits
) -> tuple[float, FloatArray]:
    """Log-likelihood of several samples with the prior, and its slope.

    Shapes: `theta` (p,), `slope` (p,).
    """
    away = limits.rows @ theta - limits.middle
    total, slope = -0.5 * float(away @ away), -limits.rows.T @ away
    for events, structure in samples:
        mixture = structure.mixture(theta)
        value, slopes = score(events, mixture)
        total += value
        slope += structure.slope(mixture, slopes)
    return total, slope


def maximise(
    samples: Sequence[tuple[Events, Structure]],
    start: FloatArray,
    limits: Limits,
    *,
    evaluations: int = 400,
    tolerance: float = 1e-9,
) -> Optimum:
    """Maximise the likelihood of the events of all samples.

    Shapes: `start` (p,).
    """
    n = sum(events.x.size for events, _ in samples)
    if not start.size:
        return Optimum(start, log_likelihood(samples, start, limits)[0])

    def loss(scaled: FloatArray) -> tuple[float, FloatArray]:
        value, slope = log_likelihood(samples, scaled * limits.scale, limits)
        return -value / n, -slope * limits.scale / n

    low, high = limits.low / limits.scale, limits.high / limits.scale
    # TNC and not L-BFGS-B, whose calls of a threaded BLAS take longer than all the rest.
    found = scipy.optimize.minimize(
        loss, np.clip(start / limits.scale, low, high), jac=True, method="TNC",
        bounds=list(zip(low, high, strict=True)),
        options={"maxfun": evaluations, "ftol": tolerance, "gtol": 1e-6},
    )  # fmt: skip
    return Optimum(np.asarray(found.x) * limits.scale, -float(found.fun) * n)


def free_structure(events: Events, start: Mixture) -> tuple[Structure, Limits]:
    """Free weights and widths, and free means where the detector can see the components."""
    k, top = start.narrow, float(events.x.max())
    lightest = min(_lightest(events, start), 0.9 * top)
    return structure_of(
        events, start, np.zeros(k), np.eye(k),
        np.array([np.full(k, lightest), np.full(k, 1.05 * top)]), np.full(k, _unit(events)),
        np.eye(k), np.full(k, top), prior=not events.plain,
    )  # fmt: skip


def _unit(events: Events) -> float:
    return math.sqrt(events.usual_variance)


def structure_of(
    events: Events,
    start: Mixture,
    origin: FloatArray,
    slopes: FloatArray,
    ranges: FloatArray,
    units: FloatArray,
    widths: FloatArray,
    widest: FloatArray,
    *,
    prior: bool,
) -> tuple[Structure, Limits]:
    """Make a structure of free weights, of means that are linear in p, of widths linear in q.

    The background of `start` stays as it is, but for its share; a prior of widths is of components
    near those of `start`.

    Shapes: `origin, widest` (k,), `slopes` (k, p), `ranges` (2, p), `units` (p,), `widths` (k, q).
    """
    (k, p), q = slopes.shape, widths.shape[1]
    logits = k - 1 + int(start.broad > 0)
    every = start.weight.size
    design = np.zeros((3, every, logits + p + q))
    fixed = np.zeros((3, every))
    design[0, 1:k, : k - 1] = np.eye(k - 1)
    design[1, :k, logits : logits + p] = slopes
    design[2, :k, logits + p :] = widths
    fixed[1, :k] = origin
    if start.broad:
        design[0, k:, k - 1] = 1.0
        fixed[1, k:] = start.mean[k:]
        fixed[2, k:] = np.log(start.variance[k:] + events.usual_variance) / 2
    rows, middle = width_prior(start.mean[:k]) if prior else (np.zeros((0, k)), np.zeros(0))
    of_widths = np.zeros((rows.shape[0], logits + p + q))
    of_widths[:, logits + p :] = rows @ widths
    narrowest = np.full(q, math.log(_unit(events)))
    most = np.maximum(
        np.array([widest[column > 0].max() for column in widths.T]), 2 * _unit(events)
    )
    limits = Limits(
        np.concatenate([np.full(logits, -LOGIT_REACH), ranges[0], narrowest]),
        np.concatenate([np.full(logits, LOGIT_REACH), ranges[1], np.log(most)]),
        np.concatenate([np.ones(logits), units, np.full(q, _WIDTH_STEP)]),
        of_widths,
        middle,
    )
    return Structure(design, fixed, events.usual_variance, start.broad, start.kind), limits


def _lightest(events: Events, start: Mixture) -> float:
    """Give the least mass that a species may have [kDa].

    Below, all that is seen is a tail of noise above the threshold: lighter particles in ever
    greater numbers explain it as well.  An event that was measured lower still keeps its place.
    """
    seen = float(events.x.min())
    if events.efficiency is None:
        return seen
    square = float(np.median(events.filter_variance))
    if isinstance(events.efficiency, Edge):  # the errors may be unknown, and in the widths
        square += float(start.variance[: start.narrow].min())
    spread = math.sqrt(square)
    return max(min(events.efficiency.threshold_kda + _HARDLY_SEEN * spread, seen), 0.0)


def polish(
    events: Events, start: Mixture, *, evaluations: int = 400, tolerance: float = 1e-9
) -> Mixture:
    """Maximise the likelihood of the events seen over all mixtures of as many species."""
    structure, limits = free_structure(events, start)
    return fit_jointly(
        events, start, structure, limits, evaluations=evaluations, tolerance=tolerance
    )


def fit_jointly(
    events: Events,
    start: Mixture,
    structure: Structure,
    limits: Limits,
    *,
    evaluations: int = 400,
    tolerance: float = 1e-9,
) -> Mixture:
    """Maximise the likelihood of one sample's events over the mixtures of a structure."""
    begun = replace(start, weight=np.maximum(start.weight, _SIZE_FLOOR))
    found = maximise(
        [(events, structure)], structure.parameters(begun), limits,
        evaluations=evaluations, tolerance=tolerance,
    )  # fmt: skip
    return replace(
        structure.mixture(found.theta),
        log_likelihood=found.log_likelihood,
        parameters=structure.design.shape[2],
    )


def information(
    samples: Sequence[tuple[Events, Structure]], theta: FloatArray, limits: Limits
) -> FloatArray:
    """Observed information: minus the second derivatives of the log-likelihood.

    Shapes: `theta` (p,), result (p, p).
    """
    n = sum(events.x.size for events, _ in samples)
    step = limits.scale / math.sqrt(n) * _STEP
    rows = []
    for i, h in enumerate(step):
        shift = np.zeros(theta.shape)
        shift[i] = h
        above = np.minimum(theta + shift, limits.high)
        below = np.maximum(theta - shift, limits.low)
        rise = log_likelihood(samples, above, limits)[1]
        rise = rise - log_likelihood(samples, below, limits)[1]
        rows.append(-rise / (above[i] - below[i]))
    found = np.array(rows).reshape(theta.size, theta.size)
    return np.asarray((found + found.T) / 2)


_HARDLY_SEEN = -1.88  # standard deviations above the threshold, where 3 % are seen
_SIZE_FLOOR = 1e-3  # of a component's share of the events
_WIDTH_STEP = 0.3  # of ln T
_STEP = 0.1  # of the scale over √n, about a tenth of a standard error
