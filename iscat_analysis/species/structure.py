"""Mixtures whose species share parameters, in one sample or in several.

The logarithms of the weights, the means and the variances of the species of a sample are linear in
a few parameters θ,

    (ln w_k + c, μ_k, τ_k²) = origin + design·θ,

with Σ w_k = 1.  A free mixture has a parameter for each; a ladder has μ_k = n_k m₁ + b; two samples
that share masses have the same columns for these and their own for the weights.  The likelihood is
that of `mixture` and adds over samples; its slope is the slope of each sample times its design.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from iscat_analysis._kernels.mixture import detection_score, mixture_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events
from iscat_analysis.species.mixture import Mixture

LOGIT_REACH = 12.0
"""Weights stay within a factor of e to this power of that of the first species."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Linear map from parameters to the species of one sample."""

    design: FloatArray
    origin: FloatArray

    def mixture(self, theta: FloatArray) -> Mixture:
        """Make the species of some parameters.

        Shapes: `theta` (p,).
        """
        logits, mean, variance = self.origin + self.design @ theta
        weight = np.exp(logits - logits.max())
        return Mixture(weight / weight.sum(), mean, np.maximum(variance, 0.0))

    def parameters(self, mixture: Mixture) -> FloatArray:
        """Parameters of species that this structure made.

        Shapes: result (p,).
        """
        logits = np.log(np.maximum(mixture.weight, 1e-300))
        values = np.array([logits - logits[0], mixture.mean, mixture.variance]) - self.origin
        rows = self.design.reshape(-1, self.design.shape[2])
        return np.asarray(np.linalg.lstsq(rows, values.ravel(), rcond=None)[0])


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of parameters, and typical steps."""

    low: FloatArray
    high: FloatArray
    scale: FloatArray


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
    return value - seen, slopes - missed


def log_likelihood(
    samples: Sequence[tuple[Events, Structure]], theta: FloatArray
) -> tuple[float, FloatArray]:
    """Log-likelihood of several samples and its slope.

    Shapes: `theta` (p,), `slope` (p,).
    """
    total, slope = 0.0, np.zeros(theta.shape)
    for events, structure in samples:
        value, slopes = score(events, structure.mixture(theta))
        total += value
        slope += slopes.ravel() @ structure.design.reshape(slopes.size, -1)
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
        return Optimum(start, log_likelihood(samples, start)[0])

    def loss(scaled: FloatArray) -> tuple[float, FloatArray]:
        value, slope = log_likelihood(samples, scaled * limits.scale)
        return -value / n, -slope * limits.scale / n

    low, high = limits.low / limits.scale, limits.high / limits.scale
    # TNC and not L-BFGS-B, whose calls of a threaded BLAS take longer than all the rest.
    found = scipy.optimize.minimize(
        loss, np.clip(start / limits.scale, low, high), jac=True, method="TNC",
        bounds=list(zip(low, high, strict=True)),
        options={"maxfun": evaluations, "ftol": tolerance, "gtol": 1e-6},
    )  # fmt: skip
    return Optimum(np.asarray(found.x) * limits.scale, -float(found.fun) * n)


def free_structure(events: Events, k: int) -> tuple[Structure, Limits]:
    """Free weights and variances, and free means where the detector can see the species."""
    unit = max(float(np.median(events.sigma)), 1e-9)
    top = float(events.x.max())
    full = np.eye(3 * k)[:, 1:].reshape(3, k, 3 * k - 1)
    lightest = np.full(k, min(_lightest(events), 0.9 * top))
    low = np.concatenate([np.full(k - 1, -LOGIT_REACH), lightest, np.zeros(k)])
    high = np.concatenate([np.full(k - 1, LOGIT_REACH), np.full(k, 1.05 * top), np.full(k, top**2)])
    scale = np.concatenate([np.ones(k - 1), np.full(k, unit), np.full(k, unit**2)])
    return Structure(full, np.zeros((3, k))), Limits(low, high, scale)


def _lightest(events: Events) -> float:
    """Give the least mass that a species may have [kDa].

    Below, all that is seen is a tail of noise above the threshold: lighter particles in ever
    greater numbers explain it as well.  An event that was measured lower still keeps its place.
    """
    seen = float(events.x.min())
    if events.efficiency is None:
        return seen
    spread = math.sqrt(float(np.median(events.filter_variance)))
    return max(min(events.efficiency.threshold_kda + _HARDLY_SEEN * spread, seen), 0.0)


def polish(
    events: Events, start: Mixture, *, evaluations: int = 400, tolerance: float = 1e-9
) -> Mixture:
    """Maximise the likelihood of the events seen over all mixtures of as many species."""
    structure, limits = free_structure(events, start.weight.size)
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
        rise = log_likelihood(samples, above)[1] - log_likelihood(samples, below)[1]
        rows.append(-rise / (above[i] - below[i]))
    found = np.array(rows).reshape(theta.size, theta.size)
    return np.asarray((found + found.T) / 2)


_HARDLY_SEEN = -1.88  # standard deviations above the threshold, where 3 % are seen
_SIZE_FLOOR = 1e-3  # of a component's share of the events
_STEP = 0.1  # of the scale over √n, about a tenth of a standard error
