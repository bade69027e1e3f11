"""A particle of two equal halves: their distance and direction, and the mass that a point loses.

With half of the light from x + h and half from x − h the picture is [s(x + h) + s(x − h)]/2, s that
of a point of the whole mass.  Both fields add up, so that only the square of the scattered light
|e(x + h) − e(x − h)|²/4 is missing, which is less than 1e-4 of the light for proteins.  For small h
the picture is s + ½ hhᵀ·∇∇s: a covariance of places of one direction, which starts the fit.  ±h are
one particle.

Twice the gain in log-likelihood over the point tests whether a picture asks for it.  All
covariances of places have three parameters, and those of pairs are some of them, so that by chance
the gain is at most χ² of three degrees of freedom.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from iscat_analysis.inference.goodness import goodness_of_fit
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.nuisances import MASS, Evidence, Z
from iscat_analysis.inference.slow_scoring import maximize_slowly
from iscat_analysis.records import FitResult, FloatArray

_FARTHEST_NM = 250.0  # of a half from the middle; beyond it, they are two particles
_SHORTEST_NM = 20.0  # at which the fit starts: at 0 the derivative along h vanishes
_STEP_NM = 60.0  # largest step of a place
_TOLERANCE, _PASSES = 2e-4, 80


class Pair(NamedTuple):
    """The fit of two halves, in columns of ``fits.csv``.

    Attributes
    ----------
    pair_mass_kda, separation_nm, angle_deg : float
        Mass of both, their distance, and its direction from x towards y, 0 to 180°.
    sigma_pair_mass_kda, sigma_separation_nm, sigma_angle_deg : float
        Errors from the Fisher information, which are the Cramér–Rao bounds too.
    p_point : float
        Probability that a point gains as much by chance.
    pair_chi2_reduced, pair_p_value : float
        Goodness of fit.
    """

    pair_mass_kda: float = math.nan
    sigma_pair_mass_kda: float = math.nan
    separation_nm: float = math.nan
    sigma_separation_nm: float = math.nan
    angle_deg: float = math.nan
    sigma_angle_deg: float = math.nan
    p_point: float = math.nan
    pair_chi2_reduced: float = math.nan
    pair_p_value: float = math.nan


def pair_of(likelihood: Likelihood, fit: FitResult, evidence: Evidence) -> Pair:
    """Fit two halves beside a point; all is NaN where the fit does not converge.

    `evidence` has the width and length of the picture, as the fit of the point leaves it.
    """
    wide, across, along = evidence.spread_nm2, evidence.across_nm2, evidence.along_nm2
    covariance_nm2 = np.array([[wide + across, along], [along, wide - across]])
    if not np.isfinite(covariance_nm2).all():
        return Pair()
    free = np.append(fit.box.free, [True, True])
    free[Z] = False
    size, direction = np.linalg.eigh(covariance_nm2)
    half = direction[:, -1] * max(math.sqrt(max(size[-1], 0.0)), _SHORTEST_NM)
    half *= min(1.0, 0.8 * _FARTHEST_NM / math.hypot(*half))
    reach = [_FARTHEST_NM, _FARTHEST_NM]
    places = [_STEP_NM, _STEP_NM]
    theta, value, _, converged, fisher = maximize_slowly(
        lambda theta: _score_fisher(likelihood, theta), np.append(fit.theta, half), free,
        np.append(fit.box.lower, np.negative(reach)), np.append(fit.box.upper, reach),
        np.array([*places, np.inf, np.inf, 1.0, *places]),
        tolerance=_TOLERANCE, passes=_PASSES, least=-math.inf,
    )  # fmt: skip
    if not converged:
        return Pair()
    kept = np.flatnonzero(free)
    covariance = np.zeros(fisher.shape)
    scale = 1 / np.sqrt(np.diag(fisher)[kept])
    scaled = fisher[np.ix_(kept, kept)] * np.outer(scale, scale)
    covariance[np.ix_(kept, kept)] = np.linalg.inv(scaled) * np.outer(scale, scale)
    apart = math.hypot(theta[5], theta[6])
    along = theta[5:] / apart
    sigma_along, sigma_across = (
        math.sqrt(unit @ covariance[5:, 5:] @ unit) for unit in (along, along[::-1] * [-1, 1])
    )
    model = likelihood.model
    point, _, _ = _score_fisher(likelihood, np.append(fit.theta, [0.0, 0.0]))
    rows, _ = _rows(likelihood, theta)
    chi2, p_value = goodness_of_fit(likelihood, theta[:5], free[:5], rows)
    return Pair(
        pair_mass_kda=float(model.scale.mass(np.array(theta[MASS]))),
        separation_nm=2 * apart,
        angle_deg=math.degrees(math.atan2(theta[6], theta[5])) % 180,
        sigma_pair_mass_kda=math.sqrt(covariance[MASS, MASS])
        * abs(model.scale.slope(float(theta[MASS]))),
        sigma_separation_nm=2 * sigma_along,
        sigma_angle_deg=math.degrees(sigma_across / apart),
        p_point=float(chdtrc(3, max(2 * (value - point), 0.0))),
        pair_chi2_reduced=chi2,
        pair_p_value=p_value,
    )


def _rows(likelihood: Likelihood, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give the signal of both halves with its derivatives, and those along h.

    Shapes: `theta` (7,), results (ny, ROWS, nx), (2, ny, nx).
    """
    shift = np.array([*theta[5:], 0.0, 0.0, 0.0])
    one, other = (likelihood.derivatives(theta[:5] + sign * shift) for sign in (1.0, -1.0))
    return (one + other) / 2, np.moveaxis(one[:, 1:3] - other[:, 1:3], 1, 0) / 2


def _score_fisher(
    likelihood: Likelihood, theta: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Log-likelihood, its gradient and the expected information.

    Shapes: `theta` (7,), `score` (7,), `fisher` (7, 7).
    """
    rows, along = _rows(likelihood, theta)
    signal, *own = np.moveaxis(rows, 1, 0)[:5]
    return likelihood.score_of(signal, np.array([*own, *along]), float(theta[LEVEL]))
