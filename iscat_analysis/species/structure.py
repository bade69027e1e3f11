"""Mixtures whose components share parameters, in one sample or in several.

The logarithms of the weights, the means and the logarithms of the whole widths of the components of
a sample are linear in a few parameters θ,

    (ln w_k + c, μ_k, ln T_k) = origin + design·θ,    T_k² = τ_k² + σ²,

with Σ w_k = 1 and the usual error σ of the events.  A free mixture has a parameter for each; a
ladder has μ_k = n_k m₁ + b; two samples that share masses have the same columns for these and their
own for the weights; the background has its share alone.  The likelihood is that of `mixture` and
adds over samples, with the prior of widths in place of a fixed width; its slope is the slope of
each sample times its design.

How wide peaks are: a weak prior on widths that grow with a power of the mass.

The logarithm of the whole width of a peak, T² = τ² + σ² with the usual error σ of the events, lies
about a line in the logarithm of the mass,

    ln T_k = a + p ln m_k + d_k,    p ~ N(1/2, 1/2),    d_k ~ N(0, `_DEVIATION`),

with any a: shot noise makes p one half where every particle has its own light, and 0 where all
share that of the background.  What the table tells of a and p is integrated out, so that the prior
is a quadratic form in the widths alone.  One peak by itself is free, two tell little of each other,
and in a table of several a spike of three events or a peak as wide as two is unlikely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from iscat_analysis._kernels.mixture import detection_score, mixture_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Edge, Events
from iscat_analysis.species.maximum import Maximum, Problem, maximise
from iscat_analysis.species.mixture import Kinds, Mixture

LOGIT_REACH = 12.0
"""Weights stay within a factor of e to this power of that of the first species."""

WIDTH_STEP = 0.3
"""Of ln T: a typical step."""


class Means(NamedTuple):
    """Means that are linear in some parameters, and the limits of these.

    Shapes: `slopes` (k, p), `limits` (2, p), `origin` (k,).
    """

    slopes: FloatArray
    limits: FloatArray
    origin: FloatArray | float = 0.0


@dataclass(frozen=True, eq=False)
class Structure:
    """Linear map from parameters, within limits, to the components of one sample.

    The prior of the parameters is −|rows θ − middle|²/2.

    Shapes: `design` (3, every, p), `origin` (3, every), `low, high, scale` (p,), `rows` (r, p),
    `middle` (r,).
    """

    design: FloatArray
    origin: FloatArray
    noise: float
    low: FloatArray
    high: FloatArray
    scale: FloatArray
    rows: FloatArray
    middle: FloatArray
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

    def slope(self, mixture: Mixture, slopes: FloatArray) -> FloatArray:
        """Turn slopes in ln w, μ and τ² into such in the parameters.

        Shapes: `slopes` (3, k), result (p,).
        """
        slopes = slopes.copy()
        slopes[2] *= 2 * (mixture.variance + self.noise)
        return np.asarray(slopes.ravel() @ self.design.reshape(slopes.size, -1))


Samples = Sequence[tuple[Events, Structure]]


def score(events: Events, mixture: Mixture) -> tuple[float, FloatArray]:
    """Log-likelihood of the events seen, and its slope.

    Shapes: `slopes` (3, k).
    """
    n = events.x.size
    species = mixture.weight, mixture.mean, mixture.variance
    value, slopes = mixture_score(events.x, events.variance, species)
    if events.efficiency is None:
        slopes[0] -= n * mixture.weight
        return value, slopes
    noise, threshold_kda = events.filter_variance[:, 0], events.efficiency.threshold_kda
    seen, missed = detection_score(noise, threshold_kda, n // len(noise), species)
    return value - seen + events.log_seen, slopes - missed


def log_likelihood(samples: Samples, theta: FloatArray) -> tuple[float, FloatArray]:
    """Log-likelihood of several samples with the prior, and its slope.

    Shapes: `theta` (p,), `slope` (p,).
    """
    first = samples[0][1]
    away = first.rows @ theta - first.middle
    total, slope = -0.5 * float(away @ away), -first.rows.T @ away
    for events, structure in samples:
        mixture = structure.mixture(theta)
        value, slopes = score(events, mixture)
        total += value
        slope += structure.slope(mixture, slopes)
    return total, slope


def parameters(samples: Samples, mixtures: Sequence[Mixture]) -> FloatArray:
    """Parameters of mixtures that these structures made, or nearly so, by least squares.

    Of what it shares, each sample counts as its number of events.

    Shapes: result (p,).
    """
    rows, values = [], []
    for (events, structure), mixture in zip(samples, mixtures, strict=True):
        # weight of a component that a sample lacks, at a start
        logits = np.log(np.maximum(mixture.weight, 1e-6))
        width = np.log(mixture.variance + structure.noise) / 2
        value = np.array([logits - logits[0], mixture.mean, width]) - structure.origin
        size = math.sqrt(events.x.size)
        rows.append(size * structure.design.reshape(value.size, -1))
        values.append(size * value.ravel())
    return np.asarray(np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0])


def joint_problem(samples: Samples) -> Problem:
    """Make the problem of maximising the likelihood of all samples."""
    first, size = samples[0][1], sum(events.x.size for events, _ in samples)
    return Problem(partial(log_likelihood, samples), first.low, first.high, first.scale, size)


def maximise_jointly(
    samples: Samples, start: Sequence[Mixture], near: FloatArray | None = None
) -> Maximum:
    """Maximise the likelihood of the events of all samples; `near` as for `maximise`.

    Shapes: `near` (p, p).
    """
    return maximise(joint_problem(samples), parameters(samples, start), near)


def free_structure(events: Events, start: Mixture) -> Structure:
    """Free weights and widths, and free means where the detector can see the components."""
    k, top = start.narrow, float(events.x.max())
    lightest = min(_lightest(events, start), 0.9 * top)
    free = Means(np.eye(k), np.repeat([[lightest], [1.05 * top]], k, axis=1))
    return structure_of(start, events.usual_variance, free, np.full(k, top), prior=not events.plain)


def structure_of(
    start: Mixture,
    noise: float,
    means: Means,
    widest: FloatArray,
    *,
    common: bool = False,
    prior: bool = True,
    logits: FloatArray | None = None,
) -> Structure:
    """Make a structure of means that are linear in p, of a width for each or one in `common`.

    Weights are linear in l, or free.  The background of `start` stays as it is, but for its share;
    a prior of widths is of components near those of `start`.

    Shapes: `widest` (k,), `logits` (every, l).
    """
    (k, p), every, unit = means.slopes.shape, start.weight.size, math.sqrt(noise)
    widths = np.ones((k, 1)) if common else np.eye(k)
    most = widest[:1] if common else widest
    if logits is None:
        logits = np.eye(every)[:, 1 : k + int(start.broad > 0)]
        logits[k:, k - 1 :] = 1.0
    of_mean, q = logits.shape[1], most.size
    of_width = of_mean + p
    design, fixed = np.zeros((3, every, of_width + q)), np.zeros((3, every))
    design[0, :, :of_mean] = logits
    design[1, :k, of_mean:of_width] = means.slopes
    design[2, :k, of_width:] = widths
    fixed[1, :k], fixed[1, k:] = means.origin, start.mean[k:]
    fixed[2, k:] = np.log(start.variance[k:] + noise) / 2
    rows, middle = width_prior(start.mean[:k]) if prior else (np.zeros((0, k)), np.zeros(0))
    reach = np.full(of_mean, LOGIT_REACH)
    return Structure(
        design,
        fixed,
        noise,
        low=np.concatenate([-reach, means.limits[0], np.full(q, math.log(unit))]),
        high=np.concatenate([reach, means.limits[1], np.log(np.maximum(most, 2 * unit))]),
        scale=np.concatenate([np.ones(of_mean), np.full(p, unit), np.full(q, WIDTH_STEP)]),
        rows=np.hstack([np.zeros((middle.size, of_width)), rows @ widths]),
        middle=middle,
        broad=start.broad,
        kind=start.kind,
    )


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
    # standard deviations below the threshold, where 3 % are seen
    return max(min(events.efficiency.threshold_kda - 1.88 * spread, seen), 0.0)


def polish(events: Events, start: Mixture) -> Mixture:
    """Maximise the likelihood of the events seen over all mixtures of as many species."""
    return fit_jointly(events, start, free_structure(events, start))


def fit_jointly(
    events: Events, start: Mixture, structure: Structure, near: FloatArray | None = None
) -> Mixture:
    """Maximise the likelihood of one sample's events over the mixtures of a structure.

    Shapes: `near` (p, p), as for `maximise`.
    """
    found = maximise_jointly([(events, structure)], [start], near)
    return replace(
        structure.mixture(found.theta),
        log_likelihood=found.value,
        parameters=structure.design.shape[2],
    )


_POWER = 0.5
_DEVIATION = 0.25  # of ln T


def width_prior(mass: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give R and c of the prior −|R ln T − c|²/2 of widths at about these masses.

    Shapes: `mass` (k,), results (k, k), (k,).
    """
    away = np.log(np.maximum(mass, 1e-9))
    away = away - away.mean()
    # of a, in ln T: as good as flat
    covariance = _DEVIATION**2 * np.eye(mass.size) + 100.0**2
    covariance += 0.5**2 * np.outer(away, away)
    rows = np.linalg.inv(np.linalg.cholesky(covariance))
    return rows, rows @ (_POWER * away)
