"""The noise laws: how the counts of a pixel scatter about what is expected of them.

`CONDITIONAL` and `POISSON` are the two; `NOISE_LAWS` has them by name.  What each means, and what
`data` (4, ny, nx) holds, says `iscat_analysis._kernels.noise`, whose functions of one pixel give
value, score and information here as in the compiled fits.  `iscat_analysis.inference.counts` makes
the data of counts.

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
from iscat_analysis._kernels.scoring import signal_value
from iscat_analysis.records import BoolArray, FloatArray

MANY_COUNTS = 1e6
"""Counts above which tails are normal: 5 σ out to a few per cent."""

_CERTAIN = 1 - 1e-16


class PixelTerms(NamedTuple):
    """Log-likelihood of a region, and its derivatives with the signal of each pixel.

    Attributes
    ----------
    value : float
        Relative to no particle; −∞ where a pixel would expect no light.
    score, information : ndarray, shape (ny, nx)
        ∂ℓ/∂s and the expected information about s; 0 in masked pixels.
    by_level : ndarray, shape (ny, nx)
        Change of the signal that a change of g looks like.
    """

    value: float
    score: FloatArray
    information: FloatArray
    by_level: FloatArray


@dataclass(frozen=True)
class NoiseLaw(ABC):
    """One noise law; it has no settings, so that all objects of a class are equal."""

    name: ClassVar[str]
    code: ClassVar[int]
    pools_few: ClassVar[bool]
    """Whether pixels that expect few counts are joined before χ² is taken."""

    def used(self, data: FloatArray) -> BoolArray:
        """Tell which pixels are not masked."""
        used: BoolArray = data[2] > 0
        return used

    def terms(self, data: FloatArray, signal: FloatArray, g: float) -> PixelTerms:
        """Give value, score and information."""
        level, pixels = math.exp(g), np.ascontiguousarray(signal).ravel()
        out = np.empty((3, *signal.shape))
        noise.score_of_pixels(self.code, data.reshape(4, -1), level, pixels, out.reshape(3, -1))
        dark = self.used(data) & (self.light(data, signal, level) <= 0)
        value = -math.inf if dark.any() else signal_value((self.code, data), level, pixels)
        return PixelTerms(value, *out)

    def residuals(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give data minus model in standard deviations; NaN where masked, or without light."""
        terms = self.terms(data, signal, math.log(level))
        known = self.used(data) & (self.light(data, signal, level) > 0)
        root = np.sqrt(terms.information, where=known, out=np.ones(signal.shape))
        return np.where(known, terms.score / root, math.nan)

    def signal_information(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """Give the information of each pixel about its own signal; 0 where masked."""
        return self.terms(data, signal, 0.0).information

    @abstractmethod
    def light(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give a number of each pixel that is above 0 if the pixel expects light."""

    @abstractmethod
    def measured_signal(self, data: FloatArray) -> FloatArray:
        """Give the signal that the counts show."""

    @abstractmethod
    def count_response(
        self, data: FloatArray, signal: FloatArray, level: float, before: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Give ∂score/∂count, of a count before the step and of one after it.

        `before` are the counts that the background was measured with, of which the signal is a
        share.
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
    def smallest_tail_probability(self, rate: FloatArray, least: float) -> float:
        """Probability that the smallest tail of pixels that expect `rate` is at most `least`."""


class Conditional(NoiseLaw):
    """Counts after the step are binomial, given their sum with those before."""

    name = "conditional"
    code = noise.CONDITIONAL
    pools_few = False

    def light(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give the light over that without the particle."""
        del data, level
        return 1 + signal

    def measured_signal(self, data: FloatArray) -> FloatArray:
        """Give the signal that the counts show."""
        return np.asarray(data[0] / ((data[1] - data[0]) * data[2]) - 1)

    def count_response(
        self, data: FloatArray, signal: FloatArray, level: float, before: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Give ∂score/∂count: a count before adds to the sum alone, a count after to both."""
        del before
        bright = np.maximum(1 + signal, noise.FLOOR)
        p = 1 - 1 / (1 + data[2] * level * bright)
        return -data[3] * p / bright, data[3] * (1 - p) / bright

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

    def smallest_tail_probability(self, rate: FloatArray, least: float) -> float:
        """Šidák's rule for continuous counts."""
        return -math.expm1(rate.size * math.log1p(-min(least, _CERTAIN)))


class Poisson(NoiseLaw):
    """Counts are Poisson about a known background and the signal."""

    name = "poisson"
    code = noise.POISSON
    pools_few = True

    def light(self, data: FloatArray, signal: FloatArray, level: float) -> FloatArray:
        """Give the expected counts, with the variance of the read noise."""
        return np.asarray(level * (data[1] + data[2] * signal) + data[3])

    def measured_signal(self, data: FloatArray) -> FloatArray:
        """Give the signal that the counts show."""
        return np.asarray((data[0] - data[3] - data[1]) / data[2])

    def signal_information(self, data: FloatArray, signal: FloatArray) -> FloatArray:
        """As of one expected count at least, which bounds what a dark pixel can say."""
        return np.asarray(np.minimum(super().signal_information(data, signal), data[2] ** 2))

    def count_response(
        self, data: FloatArray, signal: FloatArray, level: float, before: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Give ∂score/∂count: a count before raises the expected light."""
        light = level * (data[1] + data[2] * signal)
        after = level * data[2] / np.maximum(light + data[3], noise.FLOOR)
        return -light / np.maximum(before, noise.FLOOR) * after, after

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

    def smallest_tail_probability(self, rate: FloatArray, least: float) -> float:
        """Šidák's rule for whole counts: what each pixel can attain below `least` is less."""
        below = attainable_tails(rate, least)
        return -math.expm1(float(np.sum(np.log1p(-np.minimum(below, _CERTAIN)))))


CONDITIONAL, POISSON = Conditional(), Poisson()

NOISE_LAWS: Mapping[str, NoiseLaw] = {law.name: law for law in (CONDITIONAL, POISSON)}
"""Every noise law, by the name that ``fit.likelihood`` gives it."""


def attainable_tails(rate: FloatArray, tail: float) -> FloatArray:
    """Probability that a Poisson count has a two-sided tail of at most `tail`, for each rate."""
    half = tail / 2
    # below it whole counts are not distinguished from continuous ones
    if half < 1e-11 or half >= 0.5:
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
