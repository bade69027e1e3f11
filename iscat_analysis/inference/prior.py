"""What is known of a particle before it is seen, and the bound that this gives.

A normal prior on the mass (a species) or the height (a membrane) narrows a posterior below the
Cramér–Rao bound, which speaks of estimators without any prior.  The bound that holds is van
Trees': the Fisher information of the data, averaged over the prior, plus that of the prior
(H. L. Van Trees, *Detection, Estimation, and Modulation Theory* I (1968), section 2.4).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import MassScale
from iscat_analysis.records import PARAMETERS, FloatArray

NODES = 5
"""Gauss–Hermite nodes of each prior, over which the Fisher information is averaged."""

_MASS = PARAMETERS.index("mass_kda")


@dataclass(frozen=True)
class Prior:
    """Independent normal distributions of some parameters; flat in the others."""

    normal: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def log_density(self, thetas: FloatArray, scale: MassScale) -> FloatArray:
        """Logarithm of the density, up to a constant.

        Shapes: `thetas` (n, 5), result (n,).
        """
        total = np.zeros(len(thetas))
        for name, (mean, width) in self.normal.items():
            value = thetas[:, PARAMETERS.index(name)]
            if name == "mass_kda":
                slopes = np.abs(scale.slopes(value))
                total += np.log(np.maximum(slopes, 1e-300))
                value = scale.mass(value)
            total -= 0.5 * ((value - mean) / width) ** 2
        return total

    def steps(self, scale: MassScale) -> dict[int, tuple[float, float]]:
        """Give mean and standard deviation in θ: of the amplitude in place of the mass."""
        found = {}
        for name, (mean, width) in self.normal.items():
            index = PARAMETERS.index(name)
            if index == _MASS:
                mean = scale.amplitude(mean)
                width = width / abs(scale.slope(mean))
            found[index] = (mean, width)
        return found


def van_trees(information: FloatArray, prior: FloatArray) -> FloatArray:
    """Bound on the error of any estimator, biased ones too, when there is prior knowledge.

    Notes
    -----
    H. L. Van Trees, *Detection, Estimation, and Modulation Theory* I (1968), section 2.4.

    Shapes: `information` (k, k), `prior` (k, k), result (k,).
    """
    total = np.asarray(information, dtype=float) + np.asarray(prior, dtype=float)
    values, vectors = np.linalg.eigh(total)
    if not values[0] > 1e-14 * max(values[-1], 1e-300):
        raise ConfigError("neither the data nor the prior determine every parameter")
    bound: FloatArray = np.sqrt(np.sum(vectors**2 / values, axis=1))
    return bound


def posterior_bound(
    likelihood: Likelihood, theta: FloatArray, index: NDArray[np.intp], prior: Prior
) -> FloatArray:
    """Van Trees bound of one particle whose mass or height has a normal prior.

    Shapes: `theta` (5,), `index` (k,), result (k,).
    """
    scale = likelihood.model.scale
    normal = {k: v for k, v in prior.steps(scale).items() if k in index}
    points, weights = np.polynomial.hermite_e.hermegauss(NODES)
    average = np.zeros((index.size, index.size))
    for chosen in product(range(NODES), repeat=len(normal)):
        at = np.array(theta, dtype=float)
        weight = 1.0
        for node, (k, (mean, width)) in zip(chosen, normal.items(), strict=True):
            at[k] = mean + width * points[node]
            at[k] = max(at[k], 0.0) if k < _MASS else at[k]  # no height lies inside the glass
            weight *= weights[node] / math.sqrt(2 * math.pi)
        average += weight * likelihood.score_fisher(at)[2][np.ix_(index, index)]
    known = np.array([normal[k][1] ** -2 if k in normal else 0.0 for k in index])
    unit = 1 / np.sqrt(np.diag(average) + known)  # so that no unit is much larger than another
    bound: FloatArray = unit * van_trees(average * np.outer(unit, unit), np.diag(known * unit**2))
    mean = normal[_MASS][0] if _MASS in normal else float(theta[_MASS])
    bound[index == _MASS] *= abs(scale.slope(mean))
    return bound
