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
    """How the species of one sample follow from the parameters.

    Attributes
    ----------
    design : ndarray, shape (3, k, p)
        Slopes of ln w, μ [kDa] and τ² [kDa²] with respect to θ.
    origin : ndarray, shape (3, k)
        Their values where θ is 0.
    """

    design: FloatArray
    origin: FloatArray

    def mixture(self, theta: FloatArray) -> Mixture:
        """Give the species that parameters stand for.

        Parameters
        ----------
        theta : ndarray, shape (p,)
            The parameters.

        Returns
        -------
        Mixture
            Without a log-likelihood.
        """
        logits, mean, variance = self.origin + self.design @ theta
        weight = np.exp(logits - logits.max())
        return Mixture(weight / weight.sum(), mean, np.maximum(variance, 0.0))

    def parameters(self, mixture: Mixture) -> FloatArray:
        """Give the parameters of species that this structure made.

        Parameters
        ----------
        mixture : Mixture
            Its logits count from the first species, whose own must not be free.

        Returns
        -------
        ndarray, shape (p,)
            By least squares, which is exact for such species.
        """
        logits = np.log(np.maximum(mixture.weight, 1e-300))
        values = np.array([logits - logits[0], mixture.mean, mixture.variance]) - self.origin
        rows = self.design.reshape(-1, self.design.shape[2])
        return np.asarray(np.linalg.lstsq(rows, values.ravel(), rcond=None)[0])


@dataclass(frozen=True, eq=False)
class Limits:
    """Where parameters may lie, and how far they typically move.

    Attributes
    ----------
    low, high, scale : ndarray, shape (p,)
        Ends of the range, and a unit in which a step of 1 matters.
    """

    low: FloatArray
    high: FloatArray
    scale: FloatArray


@dataclass(frozen=True, eq=False)
class Optimum:
    """Where the likelihood is largest.

    Attributes
    ----------
    theta : ndarray, shape (p,)
        The parameters.
    log_likelihood : float
        Of the events of all samples.
    """

    theta: FloatArray
    log_likelihood: float


def score(events: Events, mixture: Mixture) -> tuple[float, FloatArray]:
    """Log-likelihood of the events seen, and its slope.

    Parameters
    ----------
    events : Events
        What was seen.
    mixture : Mixture
        The species.

    Returns
    -------
    value : float
        Log-likelihood.
    slopes : ndarray, shape (3, k)
        With respect to ln w, the others following so that Σ w = 1, to μ and to τ².
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

    Parameters
    ----------
    samples : sequence of (Events, Structure)
        What was seen, and how its species follow.
    theta : ndarray, shape (p,)
        The parameters.

    Returns
    -------
    value : float
        Sum over the samples.
    slope : ndarray, shape (p,)
        With respect to θ.
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

    Parameters
    ----------
    samples : sequence of (Events, Structure)
        What was seen, and how its species follow.
    start : ndarray, shape (p,)
        Where to begin.
    limits : Limits
        Of the parameters.
    evaluations : int
        Of the likelihood, at most.
    tolerance : float
        Of the log-likelihood per event.

    Returns
    -------
    Optimum
        The best that was found.
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
    """Let every weight, mean and variance be free.

    Parameters
    ----------
    events : Events
        Which give the scale.
    k : int
        Species.

    Returns
    -------
    Structure
        θ = (ln w_2/w_1, …, μ_1, …, τ_1², …).
    Limits
        Means up to a little beyond the largest event.
    """
    unit = max(float(np.median(events.sigma)), 1e-9)
    top = float(events.x.max())
    full = np.eye(3 * k)[:, 1:].reshape(3, k, 3 * k - 1)
    low = np.concatenate([np.full(k - 1, -LOGIT_REACH), np.zeros(2 * k)])
    high = np.concatenate([np.full(k - 1, LOGIT_REACH), np.full(k, 1.05 * top), np.full(k, top**2)])
    scale = np.concatenate([np.ones(k - 1), np.full(k, unit), np.full(k, unit**2)])
    return Structure(full, np.zeros((3, k))), Limits(low, high, scale)


def polish(
    events: Events, start: Mixture, *, evaluations: int = 400, tolerance: float = 1e-9
) -> Mixture:
    """Maximise the likelihood of the events seen over all mixtures of as many species.

    Parameters
    ----------
    events : Events
        What was seen.
    start : Mixture
        Where to begin.
    evaluations : int
        Of the likelihood, at most.
    tolerance : float
        Of the log-likelihood per event.

    Returns
    -------
    Mixture
        With its log-likelihood.
    """
    structure, limits = free_structure(events, start.weight.size)
    return settle(events, start, structure, limits, evaluations=evaluations, tolerance=tolerance)


def settle(
    events: Events,
    start: Mixture,
    structure: Structure,
    limits: Limits,
    *,
    evaluations: int = 400,
    tolerance: float = 1e-9,
) -> Mixture:
    """Maximise the likelihood of one sample's events over the mixtures of a structure.

    Parameters
    ----------
    events : Events
        What was seen.
    start : Mixture
        Where to begin, one of this structure's.
    structure : Structure
        Which mixtures there are.
    limits : Limits
        Of the parameters.
    evaluations : int
        Of the likelihood, at most.
    tolerance : float
        Of the log-likelihood per event.

    Returns
    -------
    Mixture
        With its log-likelihood and the number of its parameters.
    """
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

    Parameters
    ----------
    samples : sequence of (Events, Structure)
        What was seen, and how its species follow.
    theta : ndarray, shape (p,)
        Where, usually at the maximum.
    limits : Limits
        Whose scale sets the steps.

    Returns
    -------
    ndarray, shape (p, p)
        Symmetric; from differences of the slope, one-sided at an end of a range.
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


_SIZE_FLOOR = 1e-3  # of a component's share of the events
_STEP = 0.1  # of the scale over √n, about a tenth of a standard error
