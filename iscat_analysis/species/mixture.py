"""A mixture of species, and the one that makes the events seen most likely."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr, logsumexp

from iscat_analysis._kernels.mixture import detection_score, mixture_em, mixture_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events

_SIZE_FLOOR = 1e-3  # of a component's share of the events
_EM_STEPS = 40


@dataclass(frozen=True, eq=False)
class Mixture:
    """Species, each a normal distribution of masses.

    Attributes
    ----------
    weight : ndarray, shape (k,)
        w, shares of the particles that came.
    mean : ndarray, shape (k,)
        μ [kDa].
    variance : ndarray, shape (k,)
        τ² [kDa²].
    log_likelihood : float
        Of the events that it was fitted to.
    """

    weight: FloatArray
    mean: FloatArray
    variance: FloatArray
    log_likelihood: float = -math.inf

    def bic(self, n: int) -> float:
        """Bayesian information criterion for n events."""
        return -2 * self.log_likelihood + (3 * self.weight.size - 1) * math.log(n)

    def by_mass(self) -> Mixture:
        """Give the same mixture with its species by rising mass."""
        order = np.argsort(self.mean)
        return replace(
            self, weight=self.weight[order], mean=self.mean[order], variance=self.variance[order]
        )

    def log_terms(self, events: Events) -> FloatArray:
        """Logarithm of w_k N(x_i; μ_k, τ_k² + σ_i²), shape (n, k)."""
        total = self.variance + events.variance[:, np.newaxis]
        distance = events.x[:, np.newaxis] - self.mean
        with np.errstate(divide="ignore"):
            weight = np.log(self.weight)
        return np.asarray(weight - 0.5 * (distance**2 / total + np.log(2 * math.pi * total)))

    def shares(self, events: Events) -> FloatArray:
        """Probability that each event is of each species, shape (n, k)."""
        terms = self.log_terms(events)
        return np.asarray(np.exp(terms - logsumexp(terms, axis=1, keepdims=True)))

    def chance(self, events: Events) -> FloatArray:
        """Probability that a particle of each species is seen, per event's noise (n or 1, k)."""
        if events.efficiency is None:
            return np.ones((1, self.mean.size))
        reach = np.sqrt(self.variance + events.filter_variance)
        return np.asarray(np.exp(log_ndtr((self.mean - events.efficiency.threshold_kda) / reach)))

    def arrived(self, events: Events) -> float:
        """Particles that came for these events to be seen: Σ_i 1/Z_i."""
        return float(
            np.sum(np.broadcast_to(1 / (self.chance(events) @ self.weight), events.x.shape))
        )


def climb(events: Events, start: Mixture) -> Mixture:
    """Climb towards the maximum as if nothing were missed: a start for `polish`.

    Parameters
    ----------
    events : Events
        What was seen.
    start : Mixture
        Where to begin.

    Returns
    -------
    Mixture
        After some steps of expectation and maximisation.
    """
    weight, mean, variance = start.weight.copy(), start.mean.copy(), start.variance.copy()
    mixture_em(events.x, events.variance, weight, mean, variance, _EM_STEPS)
    return Mixture(weight, mean, variance)


def height(events: Events, start: Mixture) -> float:
    """Say how good a start is, as if nothing were missed.

    Parameters
    ----------
    events : Events
        What was seen.
    start : Mixture
        A candidate.

    Returns
    -------
    float
        Log-likelihood.
    """
    return float(
        mixture_score(events.x, events.variance, start.weight, start.mean, start.variance)[0]
    )


def polish(
    events: Events, start: Mixture, *, evaluations: int = 400, tolerance: float = 1e-9
) -> Mixture:
    """Maximise the likelihood of the events seen, with its gradient, under τ² ≥ 0.

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
    k = start.weight.size
    scale = max(float(np.median(events.sigma)), 1e-9)
    n = events.x.size

    def unpack(theta: FloatArray) -> Mixture:
        logits = np.concatenate([[0.0], theta[: k - 1]])
        weight = np.exp(logits - logits.max())
        weight /= weight.sum()
        return Mixture(weight, theta[k - 1 : 2 * k - 1] * scale, theta[2 * k - 1 :] * scale**2)

    def loss(theta: FloatArray) -> tuple[float, FloatArray]:
        mixture = unpack(theta)
        value, (by_weight, by_mean, by_variance) = mixture_score(
            events.x, events.variance, mixture.weight, mixture.mean, mixture.variance
        )
        if events.efficiency is None:
            by_weight = by_weight - n * mixture.weight
        else:
            seen, slopes = detection_score(
                events.filter_variance[:, 0], events.efficiency.threshold_kda,
                n // len(events.filter_variance),
                mixture.weight, mixture.mean, mixture.variance,
            )  # fmt: skip
            value -= seen
            by_weight = by_weight - slopes[0]
            by_mean = by_mean - slopes[1]
            by_variance = by_variance - slopes[2]
        gradient = np.concatenate([by_weight[1:], by_mean * scale, by_variance * scale**2])
        return -value / n, -gradient / n

    weight = np.maximum(start.weight, _SIZE_FLOOR)
    logits = np.log(weight / weight[0])[1:]
    top = float(events.x.max())
    theta = np.concatenate([logits, start.mean / scale, start.variance / scale**2])
    bounds = (
        [(-12.0, 12.0)] * (k - 1)
        + [(0.0, 1.05 * top / scale)] * k
        + [(0.0, (top / scale) ** 2)] * k
    )
    theta = np.clip(theta, [b[0] for b in bounds], [b[1] for b in bounds])
    # TNC and not L-BFGS-B, whose calls of a threaded BLAS take longer than all the rest.
    found = minimize(
        loss, theta, jac=True, method="TNC", bounds=bounds,
        options={"maxfun": evaluations, "ftol": tolerance, "gtol": 1e-6},
    )  # fmt: skip
    return replace(unpack(np.asarray(found.x)), log_likelihood=-float(found.fun) * n)
