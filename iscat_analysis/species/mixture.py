"""A mixture of components, which are species and a background.

What is none of the species: events of any mass, evenly over its logarithm.

The density is as 1/m between the lightest and the heaviest event, made of normal distributions an
octave apart and about half an octave wide.  It varies slowly over any peak, so that it takes none
of its tails, and has one parameter, its share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, logsumexp

from iscat_analysis.records import FloatArray
from iscat_analysis.species.events import Events

Kinds = tuple[int, ...]

BACKGROUND = -1
"""The kind of components that are no species."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """Components, each a normal distribution of masses.

    The last `broad` of them are the background, whose shape is fixed.  `kind` is the number of the
    species of each of the others, or `BACKGROUND`; without it, each is a species.
    """

    weight: FloatArray
    mean: FloatArray
    variance: FloatArray
    log_likelihood: float = -math.inf
    parameters: int = 0
    broad: int = 0
    kind: Kinds | None = None

    @property
    def narrow(self) -> int:
        """Components that are free."""
        return self.weight.size - self.broad

    @property
    def kinds(self) -> NDArray[np.intp]:
        """The kind of each component, shape (k,)."""
        own = range(self.narrow) if self.kind is None else self.kind
        return np.array([*own, *[BACKGROUND] * self.broad], dtype=np.intp)

    @property
    def species(self) -> int:
        """How many species there are, without the background."""
        return int(self.kinds.max(initial=BACKGROUND)) + 1

    @property
    def background(self) -> bool:
        """Whether there is a background."""
        return bool((self.kinds == BACKGROUND).any())

    @property
    def belongs(self) -> FloatArray:
        """Give 1 where a component is of a species, the background being the last, (k, s)."""
        species = self.species
        found = np.eye(species + 1)[np.where(self.kinds == BACKGROUND, species, self.kinds)]
        return found if self.background else found[:, :species]

    def bic(self, n: int) -> float:
        """Bayesian information criterion for n events."""
        free = self.parameters or 3 * self.narrow - 1 + int(self.broad > 0)
        return -2 * self.log_likelihood + free * math.log(n)

    def by_mass(self) -> Mixture:
        """Give the same mixture with its components by rising mass."""
        order = np.append(
            np.argsort(self.mean[: self.narrow]), np.arange(self.narrow, self.mean.size)
        )
        return replace(
            self, weight=self.weight[order], mean=self.mean[order], variance=self.variance[order]
        )

    def on_background(self, mean: FloatArray, variance: FloatArray, weight: float) -> Mixture:
        """Give the free components on a background of this shape and weight.

        Shapes: `mean, variance` (j,).
        """
        own = slice(0, self.narrow)
        share = self.weight[own] / self.weight[own].sum() * (1 - weight)
        return replace(
            self,
            weight=np.append(share, np.full(mean.size, weight / max(mean.size, 1))),
            mean=np.append(self.mean[own], mean),
            variance=np.append(self.variance[own], variance),
            broad=mean.size,
        )

    def log_terms(self, events: Events) -> FloatArray:
        """Logarithm of w_k N(x_i; μ_k, τ_k² + σ_i²), shape (n, k)."""
        total = self.variance + events.variance[:, np.newaxis]
        distance = events.x[:, np.newaxis] - self.mean
        with np.errstate(divide="ignore"):
            weight = np.log(self.weight)
        return np.asarray(weight - 0.5 * (distance**2 / total + np.log(2 * math.pi * total)))

    def shares(self, events: Events) -> FloatArray:
        """Probability that each event is of each species, the background being the last (n, s)."""
        terms = self.log_terms(events)
        return np.asarray(np.exp(terms - logsumexp(terms, axis=1, keepdims=True)) @ self.belongs)

    def chance(self, events: Events) -> FloatArray:
        """Probability that a particle of a component is detected, for each noise (n or 1, k)."""
        if events.efficiency is None:
            return np.ones((1, self.mean.size))
        reach = np.sqrt(self.variance + events.filter_variance)
        return np.asarray(np.exp(log_ndtr((self.mean - events.efficiency.threshold_kda) / reach)))

    def detected(self, events: Events) -> FloatArray:
        """Share of the particles of each species that is detected (s,)."""
        chance = self.weight * self.chance(events).mean(axis=0)
        return np.asarray((chance @ self.belongs) / np.maximum(self.came, 1e-300))

    @property
    def came(self) -> FloatArray:
        """Share of each species among the particles that came (s,)."""
        return np.asarray(self.weight @ self.belongs)

    def means(self) -> FloatArray:
        """Mean mass of each species (s,)."""
        return np.asarray((self.weight * self.mean) @ self.belongs / np.maximum(self.came, 1e-300))

    def widths(self) -> FloatArray:
        """Give the standard deviation of the masses of each species, beyond errors (s,)."""
        belongs, mean = self.belongs, self.belongs @ self.means()
        apart = np.where(np.isclose(self.mean, mean, rtol=1e-9, atol=0), 0.0, self.mean - mean)
        square = self.variance + apart**2
        mean_square = (self.weight * square) @ belongs / np.maximum(self.came, 1e-300)
        return np.asarray(np.sqrt(mean_square))

    def arrived(self, events: Events) -> float:
        """Give the expected number of particles that arrived, detected or not: Σ_i 1/Z_i."""
        return float(
            np.sum(np.broadcast_to(1 / (self.chance(events) @ self.weight), events.x.shape))
        )


_OCTAVE = math.log(2.0)
_OVERLAP = 0.65  # of the distance between neighbours: with it their sum has no bumps


def broad(events: Events) -> tuple[FloatArray, FloatArray]:
    """Give means and variances of the parts of the background, which share its weight evenly.

    Shapes: results (j,), (j,).
    """
    low, high = float(events.x.min()), float(events.x.max())
    if events.efficiency is not None:
        # of the limit of detection, where nothing is seen of it
        low = min(max(low, 0.3 * events.efficiency.threshold_kda), high)
    octaves = math.log(high / low) / _OCTAVE
    if octaves < 1:
        mean = np.array([(low + high) / 2])
        return mean, (_OVERLAP * _OCTAVE * mean) ** 2
    number = math.ceil(octaves)
    step = math.log(high / low) / number
    mean = low * np.exp(step * (np.arange(number) + 0.5))
    return mean, (_OVERLAP * step * mean) ** 2
