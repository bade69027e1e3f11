"""One mass from many frames: a particle keeps its mass while it moves.

Each frame k gives an estimate m_k with the information J_k = 1/σ_k².  Its σ_k is that of its own
estimate, and follows it: J ∝ m^p makes w_k ∝ 1 + p (m_k − m)/m, and the weighted mean is too large
by the share

    E[m̂]/m − 1 = p (σ/m)² (1 − 1/n),

which does not become less with more frames.  With shot noise alone C = m h gives
J = B Σ h²/(1 + m h), so that p = −m Σ h³/Σ h² is some hundredths for a protein and the error below
10⁻⁴; where the scattered light outshines its noise p is 2, and 10 % errors of single frames make
2 %.  So information is taken at the common mass, J_k (m̂/m_k)^p: that is independent of what noise
did to frame k.

Frames that share a measured background share its noise where the particle is at the same place;
then their errors are correlated, and the mean is that of generalised least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.special import chdtrc

from iscat_analysis.records import FloatArray

_Factor = tuple[FloatArray, bool]

_ROUNDS = 8  # of mass and weights in turn; each has an error (p σ/m)²/n of the one before
_MASS_TOLERANCE = 1e-9  # of the mass


@dataclass(frozen=True)
class CommonMass:
    """The mass of a track."""

    mass_kda: float
    sigma_mass_kda: float
    crb_mass_kda: float
    scatter: float
    p_value: float
    frames: int

    @property
    def enlargement(self) -> float:
        """Factor by which frames scatter beyond their errors (Birge, Phys. Rev. 40, 207, 1932)."""
        return max(self.scatter, 1.0) if self.frames > 1 else 1.0


def combine_masses(
    mass_kda: FloatArray,
    sigma_kda: FloatArray,
    crb_kda: FloatArray,
    *,
    power: float = 0.0,
    correlation: FloatArray | None = None,
) -> CommonMass:
    """Combine the frames of one track.

    Shapes: `mass_kda` (n,), `sigma_kda, crb_kda` (n,), `correlation` (n, n).
    """
    factor = None if correlation is None else scipy.linalg.cho_factor(correlation)
    mass = float(np.median(mass_kda))
    for _ in range(_ROUNDS):
        before, there = mass, _at(mass, mass_kda, power)
        mass, variance = _least_squares(mass_kda, sigma_kda * there, factor)
        if abs(mass - before) <= _MASS_TOLERANCE * abs(mass):
            break
    there = _at(mass, mass_kda, power)
    _, bound = _least_squares(mass_kda, crb_kda * there, factor)
    off = (mass_kda - mass) / (sigma_kda * there)
    inside = float(off @ _without_correlation(off, factor))
    free = mass_kda.size - 1
    return CommonMass(
        mass_kda=mass,
        sigma_mass_kda=float(np.sqrt(variance)),
        crb_mass_kda=float(np.sqrt(bound)),
        scatter=float(np.sqrt(inside / free)) if free else float("nan"),
        p_value=float(chdtrc(free, inside)) if free else float("nan"),
        frames=mass_kda.size,
    )


def information_power(tracks: Sequence[tuple[FloatArray, FloatArray]]) -> float:
    """Estimate how the information of a frame grows with its own estimate: p of J ∝ m^p.

    The line through ln J against ln m has one slope for all tracks and an intercept for each, so
    that differences between particles do not matter.
    """
    product = square = 0.0
    for mass, sigma in tracks:
        size, information = np.log(np.abs(mass)), -2 * np.log(sigma)
        size = size - size.mean()
        product += float(size @ (information - information.mean()))
        square += float(size @ size)
    return product / square if square > 0 else 0.0


def _at(common: float, own: FloatArray, power: float) -> FloatArray:
    """Factor that scales each frame's σ from its own estimate to the common mass."""
    return np.asarray(np.abs(own / common) ** (power / 2) if power else np.ones_like(own))


def _least_squares(
    values: FloatArray, sigma: FloatArray, factor: _Factor | None
) -> tuple[float, float]:
    """Weighted mean of correlated values, and its variance."""
    weights = _without_correlation(1 / sigma, factor) / sigma
    total = float(weights.sum())
    return float(weights @ values) / total, 1 / total


def _without_correlation(values: FloatArray, factor: _Factor | None) -> FloatArray:
    """Solve correlation · x = values; without a factor the values are independent."""
    return values if factor is None else np.asarray(scipy.linalg.cho_solve(factor, values))
