"""The noise models: how the counts of a pixel scatter about what is expected of them.

A noise model is an object with value, score, information and residual, for arrays of pixels.
`CONDITIONAL` and `POISSON` are the two, `NOISE_MODELS` has them by name.  What each means, and what
`data` (4, ny, nx) holds, says `iscat_analysis._kernels.noise`, whose formulas these are: the
kernels take the model's `code`.  `iscat_analysis.inference.noise` makes the data of counts.

Signals s are relative changes of the light, and `level` is e^g, a common factor of it.  All arrays
but `data` have shape (ny, nx).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.special import betainc, gammainc, gammaincc, pdtr, pdtrc

from iscat_analysis._kernels import noise
from iscat_analysis.records import BoolArray, FloatArray

MANY_COUNTS = 1e6
"""Counts above which tails are normal: 5 σ out to a few per cent."""

_LEAST_TAIL = 1e-11  # tail below which whole counts are not told from continuous ones
_CERTAIN = 1 - 1e-16


class PixelTerms(NamedTuple):
    """Log-likelihood of a region, and what its derivatives are made of.

    Each pixel's law has one natural coordinate η.  `score` and `information` are about η,
    `by_signal` and `by_level` are ∂η/∂s and ∂η/∂g.
    """

    value: float
    score: FloatArray
    information: FloatArray
    by_signal: FloatArray
    by_level: FloatArray

    @classmethod
    def impossible(cls, shape: tuple[int, ...]) -> PixelTerms:
        """Give those of a signal that no light can have."""
        nothing = np.zeros(shape)
        return cls(-math.inf, nothing, nothing, nothing, nothing)


class CountResponse(NamedTuple):
    """What one more count does: ∂η/∂s, ∂η/∂g, the information about η, ∂score/∂count."""

    by_signal: FloatArray
    by_level: FloatArray
    information: FloatArray
    before: FloatArray
    after: FloatArray


@dataclass(frozen=True)
class NoiseModel(ABC):
    """One noise model; it has no settings, so that all objects of a class are equal."""

    name: ClassVar[str]
    code: ClassVar[int]
    pools_few: ClassVar[bool]
    """Whether pixels that expect few counts are joined before χ² is taken."""

    def used(self, data: FloatArray) -> BoolArray:
        """Tell which pixels are not masked."""
        used: BoolArray = data[2] > 0
        return used

    @abstractmethod
    def terms(self, data: FloatArray, signal: FloatArray, g: float) -> PixelTerms:
        """Give value, score and information."""

    @abstractmethod
    def residuals(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give data minus model in standard deviations; what masked pixels have means nothing."""

    @abstractmethod
    def measured_signal(self, data: FloatArray) -> FloatArray:
        """Give the signal that the counts show."""

    @abstractmethod
    def signal_information(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the information of each pixel about its own signal."""

    @abstractmethod
    def level_direction(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the change of the signal that a small change of the level looks like."""

    @abstractmethod
    def count_response(
        self,
        data: FloatArray,
        signal: FloatArray,
        level: float,
        before: FloatArray,
        ratio: float | None,
    ) -> CountResponse:
        """Say what one more count does, of those before the step and of those after it.

        `before` are the counts that the background was measured with, `ratio` is the light after
        over that before; None where the signal is a share of the background.
        """

    @abstractmethod
    def multiplied(self, data: FloatArray, factor: FloatArray) -> FloatArray:
        """Multiply the light that is expected without the particle by a factor."""

    @abstractmethod
    def reference_change(self, data: FloatArray, bare: FloatArray) -> float:
        """Log-likelihood, without the particle, of data over that of the bare ones."""

    @abstractmethod
    def tails(self, a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
        """Give the probability of counts at least as far out, of what `tail_of_pixel` gives."""

    @abstractmethod
    def least_of_all(self, rate: FloatArray, least: float) -> float:
        """Probability that the least likely of pixels that expect `rate` has at most that tail."""


class Conditional(NoiseModel):
    """Counts after the step are binomial, given their sum with those before; η is the log-odds."""

    name = "conditional"
    code = noise.CONDITIONAL
    pools_few = False

    def terms(self, data: FloatArray, signal: FloatArray, g: float) -> PixelTerms:
        """Give value, score and information."""
        c0, c1, c2, c3 = data
        used, bright = self.used(data), 1 + signal
        if np.any(bright[used] <= 0):
            return PixelTerms.impossible(signal.shape)
        safe, odds = np.where(used, bright, 1.0), np.where(used, c2, 1.0)
        shift = np.log(safe) + g
        eta = np.log(odds) + shift
        p = 1 / (1 + np.exp(-eta))
        values = c0 * shift - c1 * (np.logaddexp(0.0, eta) - np.log1p(odds))
        score = np.where(used, c3 * (c0 - c1 * p), 0.0)
        information = np.where(used, c3 * c1 * p * (1 - p), 0.0)
        value = float(np.sum(c3 * values))
        return PixelTerms(value, score, information, 1 / safe, np.ones(signal.shape))

    def residuals(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give data minus model in standard deviations."""
        c0, c1, c2, c3 = data
        q = c2 * level * (1 + signal)
        p = q / (1 + q)
        return np.asarray((c0 - c1 * p) / np.sqrt(c1 * p * (1 - p) / c3))

    def measured_signal(self, data: FloatArray) -> FloatArray:
        """Give the signal that the counts show."""
        return np.asarray(data[0] / ((data[1] - data[0]) * data[2]) - 1)

    def signal_information(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the information of each pixel about its own signal."""
        p = data[2] * (1 + signal) / (1 + data[2] * (1 + signal))
        return np.asarray(data[3] * data[1] * p * (1 - p) / (1 + signal) ** 2)

    def level_direction(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the change of the signal that a small change of the level looks like."""
        del data
        return 1 + signal

    def count_response(
        self,
        data: FloatArray,
        signal: FloatArray,
        level: float,
        before: FloatArray,
        ratio: float | None,
    ) -> CountResponse:
        """Say what one more count does, in the sum as well as after the step."""
        del before, ratio
        _, c1, c2, c3 = data
        bright = np.maximum(1 + signal, noise.FLOOR)
        odds = c2 * level * bright
        p = odds / (1 + odds)
        information = c3 * c1 * p * (1 - p)
        return CountResponse(1 / bright, np.ones(signal.shape), information, -c3 * p, c3 * (1 - p))

    def multiplied(self, data: FloatArray, factor: FloatArray) -> FloatArray:
        """Multiply the odds."""
        out = data.copy()
        out[2] *= factor
        return out

    def reference_change(self, data: FloatArray, bare: FloatArray) -> float:
        """Log-likelihood, without the particle, of data over that of the bare ones."""
        used = self.used(bare)
        factor = np.where(used, data[2] / np.where(used, bare[2], 1.0), 1.0)
        terms = data[0] * np.log(factor) - data[1] * (np.log1p(data[2]) - np.log1p(bare[2]))
        return float(np.sum(data[3] * terms))

    def tails(self, a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
        """Tail of the binomial law, as an incomplete beta function."""
        return np.asarray(betainc(a, b, x))

    def least_of_all(self, rate: FloatArray, least: float) -> float:
        """Probability that the least likely pixel has at most that tail."""
        return -math.expm1(rate.size * math.log1p(-min(least, _CERTAIN)))


class Poisson(NoiseModel):
    """Counts are Poisson about a known background and the signal; η is the expected count."""

    name = "poisson"
    code = noise.POISSON
    pools_few = True

    def terms(self, data: FloatArray, signal: FloatArray, g: float) -> PixelTerms:
        """Give value, score and information."""
        c0, c1, c2, c3 = data
        used, level = self.used(data), math.exp(g)
        expected = level * (c1 + c2 * signal)
        rate = expected + c3
        if np.any(rate[used] <= 0):
            return PixelTerms.impossible(signal.shape)
        rate = np.where(used, rate, 1.0)
        change = expected - c1  # by itself: it may be far smaller than the counts
        gain = np.log1p(change / np.where(used, c1 + c3, 1.0))
        value = float(np.sum(np.where(used, c0 * gain - change, 0.0)))
        score = np.where(used, c0 / rate - 1, 0.0)
        return PixelTerms(value, score, np.where(used, 1 / rate, 0.0), level * c2, expected)

    def residuals(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give data minus model in standard deviations."""
        c0, c1, c2, c3 = data
        rate = level * (c1 + c2 * signal) + c3
        return np.asarray((c0 - rate) / np.sqrt(rate))

    def measured_signal(self, data: FloatArray) -> FloatArray:
        """Give the signal that the counts show."""
        return np.asarray((data[0] - data[3] - data[1]) / data[2])

    def signal_information(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the information of each pixel about its own signal; at least one count is expected.

        That bounds what a pixel can say which expects none.
        """
        _, c1, c2, c3 = data
        return np.asarray(c2**2 / np.maximum(c1 + c2 * signal + c3, 1.0))

    def level_direction(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the change of the signal that a small change of the level looks like."""
        return np.asarray(data[1] / data[2] + signal)

    def count_response(
        self,
        data: FloatArray,
        signal: FloatArray,
        level: float,
        before: FloatArray,
        ratio: float | None,
    ) -> CountResponse:
        """Say what one more count does; η is here the logarithm of the expected count."""
        _, c1, c2, c3 = data
        light = level * (c1 + c2 * signal)
        rate = np.maximum(light + c3, noise.FLOOR)
        counted = light / np.maximum(before, noise.FLOOR) if ratio is None else ratio
        counted = np.broadcast_to(counted, rate.shape)
        return CountResponse(level * c2 / rate, light / rate, rate, -counted, np.ones(rate.shape))

    def multiplied(self, data: FloatArray, factor: FloatArray) -> FloatArray:
        """Multiply the expected counts, with and without the particle."""
        out = data.copy()
        out[1:3] *= factor
        return out

    def reference_change(self, data: FloatArray, bare: FloatArray) -> float:
        """Log-likelihood, without the particle, of data over that of the bare ones."""
        now, then = data[1] + data[3], bare[1] + bare[3]
        used = self.used(data) & (then > 0)
        ratio = np.where(used, now / np.where(used, then, 1.0), 1.0)
        return float(np.sum(np.where(used, data[0] * np.log(ratio) - now + then, 0.0)))

    def tails(self, a: FloatArray, b: FloatArray, x: FloatArray) -> FloatArray:
        """Tail of the Poisson law, as an incomplete gamma function; above it where x > 0."""
        return np.asarray(np.where(x > 0, gammainc(a, b), gammaincc(a, b)))

    def least_of_all(self, rate: FloatArray, least: float) -> float:
        """Probability that the least likely pixel has at most that tail.

        Counts are whole: what each pixel can attain below it is less than that.
        """
        below = attainable_tails(rate, least)
        return -math.expm1(float(np.sum(np.log1p(-np.minimum(below, _CERTAIN)))))


CONDITIONAL, POISSON = Conditional(), Poisson()

NOISE_MODELS: Mapping[str, NoiseModel] = {model.name: model for model in (CONDITIONAL, POISSON)}
"""Every noise model, by the name that ``fit.likelihood`` gives it."""


def attainable_tails(rate: FloatArray, tail: float) -> FloatArray:
    """Probability that a Poisson count has a two-sided tail of at most `tail`, for each rate."""
    half = tail / 2
    if half < _LEAST_TAIL or half >= 0.5:
        return np.full(rate.size, min(tail, 1.0))
    out = np.full(rate.size, tail)
    few = rate < MANY_COUNTS
    mean = rate[few]
    # Bernstein's and Chernoff's inequalities enclose the counts, halving finds them
    depth = -math.log(half)
    farthest = np.ceil(mean + depth / 3 + np.sqrt(depth**2 / 9 + 2 * mean * depth))
    least = np.maximum(np.floor(mean - np.sqrt(2 * mean * depth)) - 1, -1.0)
    limit = half * (1 + 1e-9)
    above = _first(lambda k: pdtrc(k, mean) <= limit, np.floor(mean) - 1, farthest)
    below = _first(lambda k: pdtr(k, mean) > limit, least, np.ceil(mean) + 1) - 1
    out[few] = pdtrc(above, mean) + np.where(below >= 0, pdtr(np.maximum(below, 0), mean), 0.0)
    return out


def _first(
    holds: Callable[[FloatArray], BoolArray], low: FloatArray, high: FloatArray
) -> FloatArray:
    """Find the smallest whole numbers above `low` for which something holds; at `high` it does."""
    while np.any(high - low > 1):
        middle = np.where(high - low > 1, np.floor((low + high) / 2), high)
        there = holds(middle)
        low, high = np.where(there, low, middle), np.where(there, middle, high)
    return high
