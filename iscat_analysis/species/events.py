"""Events with masses, and the probability that a particle is detected."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_ndtr, ndtr

from iscat_analysis.records import BoolArray, FloatArray

POSSIBLE_KDA = (1e-6, 1e9)
"""Masses of particles, and errors of them, that a light microscope can tell of: a proton has 1e-3,
a protein as large as the wavelength 1e8.  Their squares, and ratios of these, are numbers."""


def possible(mass_kda: FloatArray, sigma_kda: FloatArray) -> BoolArray:
    """Tell which events have a possible mass and a possible error.

    Shapes: `mass_kda, sigma_kda` (n,), result (n,).
    """
    least, most = POSSIBLE_KDA
    size = np.abs(mass_kda)
    return np.asarray((size >= least) & (size <= most) & (sigma_kda >= least) & (sigma_kda <= most))


@dataclass(frozen=True)
class Efficiency:
    """Probability that a particle is detected."""

    threshold_snr: float
    sigma_kda: float
    searched: float = 1.0  # share of field and time, where bright particles hid the rest

    def __post_init__(self) -> None:
        if not (self.sigma_kda > 0 and math.isfinite(self.sigma_kda + self.threshold_snr)):
            raise ValueError(
                f"an efficiency needs a finite threshold and a positive sigma_kda, not "
                f"{self.threshold_snr:g} and {self.sigma_kda:g}"
            )

    @property
    def threshold_kda(self) -> float:
        """Mass with a detection probability of one half [kDa]."""
        return self.threshold_snr * self.sigma_kda

    def __call__(self, mass_kda: ArrayLike) -> FloatArray:
        """Probability of detection."""
        mass = np.asarray(mass_kda, dtype=np.float64)
        return np.asarray(self.searched * ndtr(mass / self.sigma_kda - self.threshold_snr))

    def extra_sigma(self, sigma: FloatArray) -> FloatArray:
        """Noise of the filter's estimate beyond that of the fit."""
        return np.asarray(np.sqrt(np.maximum(self.sigma_kda**2 - sigma**2, 0.0)))

    def deciding_sigma(self, sigma: FloatArray) -> FloatArray:
        """Noise of the estimate that decides on detection."""
        return np.maximum(sigma, self.sigma_kda)


@dataclass(frozen=True)
class Edge(Efficiency):
    """A limit that is not the filter's: of what was measured, and soft by itself."""

    softness_kda: float = 0.0

    @classmethod
    def at(cls, limit_kda: float, softness_kda: float) -> Edge:
        """Half of what is measured at the limit is seen."""
        # the least softness of a limit, over the limit
        spread = max(softness_kda, 1e-6 * limit_kda)
        return cls(limit_kda / spread, spread, softness_kda=spread)

    def extra_sigma(self, sigma: FloatArray) -> FloatArray:
        """Noise of what decides, beyond that of the fit: the same for every event."""
        return np.full(sigma.shape, self.softness_kda)

    def deciding_sigma(self, sigma: FloatArray) -> FloatArray:
        """Noise of the fit and of what decides."""
        return np.hypot(sigma, self.softness_kda)


@dataclass(frozen=True, eq=False)
class Events:
    """Events that were seen; `plain` where they are no masses, but logarithms of diameters."""

    x: FloatArray
    sigma: FloatArray
    efficiency: Efficiency | None
    plain: bool = False

    @cached_property
    def variance(self) -> FloatArray:
        """σ_i², shape (n,) [kDa²]."""
        return self.sigma**2

    @cached_property
    def filter_variance(self) -> FloatArray:
        """s_i² of the estimate that decides on detection, (n, 1), or (1, 1) where all agree."""
        s = self.efficiency.deciding_sigma(self.sigma) if self.efficiency else self.sigma
        s = s[:, np.newaxis]
        return np.asarray((s[:1] if np.all(s == s[:1]) else s) ** 2)

    @cached_property
    def usual_variance(self) -> float:
        """The median of σ_i² [kDa²]."""
        return max(float(np.median(self.variance)), 1e-18)

    @cached_property
    def log_seen(self) -> float:
        """Logarithm of the chance to see events where they were measured; of a filter it is 0.

        There it depends on nothing that is fitted.
        """
        if not isinstance(self.efficiency, Edge):
            return 0.0
        away = (self.x - self.efficiency.threshold_kda) / self.efficiency.softness_kda
        return float(log_ndtr(away).sum())
