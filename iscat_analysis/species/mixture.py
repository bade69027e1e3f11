"""A mixture of species, and the one that makes the events seen most likely."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_ndtr, logsumexp

from iscat_analysis._kernels.mixture import mixture_em, mixture_score
from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events

_EM_STEPS = 40


@dataclass(frozen=True, eq=False)
class Mixture:
    """Species, each a normal distribution of masses."""

    weight: FloatArray
    mean: FloatArray
    variance: FloatArray
    log_likelihood: float = -math.inf
    parameters: int = 0

    def bic(self, n: int) -> float:
        """Bayesian information criterion for n events."""
        free = self.parameters or 3 * self.weight.size - 1
        return -2 * self.log_likelihood + free * math.log(n)

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
        """Probability that a particle of each species is detected, for each noise (n or 1, k)."""
        if events.efficiency is None:
            return np.ones((1, self.mean.size))
        reach = np.sqrt(self.variance + events.filter_variance)
        return np.asarray(np.exp(log_ndtr((self.mean - events.efficiency.threshold_kda) / reach)))

    def arrived(self, events: Events) -> float:
        """Give the expected number of particles that arrived, detected or not: Σ_i 1/Z_i."""
        return float(
            np.sum(np.broadcast_to(1 / (self.chance(events) @ self.weight), events.x.shape))
        )


def ascend(events: Events, start: Mixture) -> Mixture:
    """EM steps without selection by the detector: a start for `structure.polish`."""
    weight, mean, variance = start.weight.copy(), start.mean.copy(), start.variance.copy()
    mixture_em(events.x, events.variance, weight, mean, variance, _EM_STEPS)
    return Mixture(weight, mean, variance)


def height(events: Events, start: Mixture) -> float:
    """Log-likelihood of a start, without selection by the detector."""
    return float(
        mixture_score(events.x, events.variance, start.weight, start.mean, start.variance)[0]
    )
