"""Evidence of one event about the assumptions of its fit: its height, and that it is a point.

A fit in mode mass holds the height, and takes the particle for a point that rests.  Each of these
has a derivative of the image: ∂s/∂z; and ½ Σ·∇∇s for a particle whose light is spread over places
of covariance Σ, because it wiggles or has parts that are apart.  With u the score along them and I
their information once everything that was fitted follows, I⁻¹u estimates them, and uᵀI⁻¹u tests
whether they are there (Rao's score test; C. R. Rao, Proc. Camb. Phil. Soc. 44, 50, 1948).

`pair_of` fits two equal halves: their mass, distance and direction.  For small h the image of
`Halves` is s + ½ hhᵀ·∇∇s, s that of a point: a covariance of places of one direction, which starts
the fit.  ±h are one particle.

Twice the gain in log-likelihood over a point tests for two halves.  Pairs are special cases of a
covariance of places, which has three parameters, so that by chance the gain is at most χ² of three
degrees of freedom.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from iscat_analysis.inference.fit import fit_model, goodness_of_fit
from iscat_analysis.inference.laws import PixelTerms
from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.inference.maximiser import imitation
from iscat_analysis.inference.models import FARTHEST_HALF_NM, Halves
from iscat_analysis.records import Box, FitResult, FloatArray

Z, MASS = 2, 3
"""Where height and amplitude stand in θ."""

_XX, _XY, _YY = 5, 6, 7  # rows of second derivatives


class Evidence(NamedTuple):
    """Evidence of the light of one event, or of many, beside its fit.

    Attributes
    ----------
    z_nm, sigma_z_nm : float or ndarray
        Height that the light alone asks for, without a prior, and its error [nm].
    mass_per_z : float or ndarray
        ∂mass/∂z of a height that is held [kDa/nm].
    spread_nm2, sigma_spread_nm2 : float or ndarray
        Variance of the particle's places along each axis, and its error [nm²].
    mass_per_spread : float or ndarray
        ∂mass/∂variance of a particle that is taken for a point [kDa/nm²].
    chi2_spread : float or ndarray
        Test of any covariance of places against none: χ² of three degrees of freedom.
    across_nm2, along_nm2, sigma_across_nm2 : float or ndarray
        Half of what the variance along x has beyond that along y, their covariance, and the error
        of each [nm²].
    rise_frames : float or ndarray
        Frames over which the light of a step rises; 0 of one that rises at once, or seems to.
    """

    z_nm: FloatArray
    sigma_z_nm: FloatArray
    mass_per_z: FloatArray
    spread_nm2: FloatArray
    sigma_spread_nm2: FloatArray
    mass_per_spread: FloatArray
    chi2_spread: FloatArray
    across_nm2: FloatArray
    along_nm2: FloatArray
    sigma_across_nm2: FloatArray
    rise_frames: FloatArray


NOTHING = (math.nan,) * len(Evidence._fields)
"""Evidence of an event that says nothing."""


def evidence_of(likelihood: Likelihood, fit: FitResult, rise: int = 0) -> FloatArray:
    """Look beside a fit of place and mass, of a step whose light rises over so many frames.

    Shapes: result (11,), in the order of `Evidence`.
    """
    theta, free = fit.theta, fit.box.free
    if likelihood.model.is_measured or likelihood.model.is_sized or not free[MASS]:
        return np.array(NOTHING)
    rows = np.moveaxis(likelihood.derivatives(theta), 1, 0)
    terms = likelihood.noise.terms(likelihood.data, rows[0], float(theta[LEVEL]))
    if not math.isfinite(terms.value):
        return np.array(NOTHING)
    axes = [*rows[1:5], terms.by_level]
    fitted = [i for i in range(5) if free[i] and i != Z]
    slope = likelihood.model.scale.slope(float(theta[MASS]))
    lifted = _beside(terms, [axes[i] for i in fitted], [axes[Z]])
    if lifted is None:
        return np.array(NOTHING)
    (up,), ((known,),), follow = lifted
    mass = fitted.index(MASS)
    own = [theta[Z] + up / known, known**-0.5, follow[0, mass] * slope]
    fitted = [i for i in range(5) if free[i]]
    round_ = (rows[_XX] + rows[_YY]) / 2
    across = (rows[_XX] - rows[_YY]) / 2
    prior = None
    if free[Z]:
        mean, information = likelihood.height_prior
        prior = fitted.index(Z), theta[Z] - mean, information
    spread = _beside(terms, [axes[i] for i in fitted], [round_, across, rows[_XY]], prior)
    if spread is None:
        return np.array([*own, *NOTHING[3:-1], rise])
    up_, known_, follow = spread
    chi2 = float(up_ @ np.linalg.solve(known_, up_))
    wide = [up_[0] / known_[0, 0], known_[0, 0] ** -0.5, follow[0, fitted.index(MASS)] * slope]
    two = np.linalg.inv(known_[1:, 1:])
    error = np.linalg.det(two) ** 0.25  # geometric mean
    return np.array([*own, *wide, chi2, *(two @ up_[1:]), error, rise])


def _beside(
    terms: PixelTerms,
    fitted: list[FloatArray],
    extra: list[FloatArray],
    known: tuple[int, float, float] | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Give score and information of directions once all that was fitted follows, and how it does.

    `known` holds the number of a fitted one that has a prior, its way from the mean of that, and
    the information of the prior.

    Shapes: results (k,), (k, k), (k, n).
    """
    k = len(extra)
    all_ = np.array([*extra, *fitted]).reshape(k + len(fitted), -1)
    score, fisher = all_ @ terms.score.ravel(), (all_ * terms.information.ravel()) @ all_.T
    if known is not None:
        index, away, information = known
        score[k + index] -= information * away
        fisher[k + index, k + index] += information
    if not np.all(np.diag(fisher) > 0):
        return None
    try:
        follow = imitation(fisher, k)
    except np.linalg.LinAlgError:
        return None
    left = fisher[:k, :k] + fisher[:k, k:] @ follow
    unit = 1 / np.sqrt(np.diag(fisher)[:k])
    if np.linalg.eigvalsh(left * np.outer(unit, unit))[0] <= 1e-6:
        return None
    return score[:k] + follow.T @ score[k:], left, follow.T


"""Share of a direction's information that is left, below which the fit has it already."""


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

    `evidence` has the width and elongation of the image beside the fit of a point.
    """
    wide, across, along = evidence.spread_nm2, evidence.across_nm2, evidence.along_nm2
    covariance_nm2 = np.array([[wide + across, along], [along, wide - across]])
    if not np.isfinite(covariance_nm2).all():
        return Pair()
    size, direction = np.linalg.eigh(covariance_nm2)
    # the fit starts at 20 nm at least: at 0 the derivative along h vanishes
    half = direction[:, -1] * max(math.sqrt(max(size[-1], 0.0)), 20.0)
    half *= min(1.0, 0.8 * FARTHEST_HALF_NM / math.hypot(*half))
    halves, far = Halves(likelihood.model), np.full(2, FARTHEST_HALF_NM)
    free = np.insert(fit.box.free, LEVEL, [True, True])
    free[Z] = False
    both = likelihood.under(halves)
    box = Box(free, np.insert(fit.box.lower, LEVEL, -far), np.insert(fit.box.upper, LEVEL, far))
    found = fit_model(both, np.insert(fit.theta, LEVEL, half), box)
    if not found.converged:
        return Pair()
    theta, covariance = found.theta, found.covariance
    apart = math.hypot(theta[4], theta[5])
    along = theta[4:6] / apart
    sigma_along, sigma_across = (
        math.sqrt(unit @ covariance[4:6, 4:6] @ unit) for unit in (along, along[::-1] * [-1, 1])
    )
    mass = halves.parameters[MASS]
    point = both.score_fisher(np.insert(fit.theta, LEVEL, [0.0, 0.0]))[0]
    rows, _ = halves.rows(likelihood.grid, theta)
    own, varied = np.delete(theta, [4, 5]), np.delete(free, [4, 5])
    chi2, p_value = goodness_of_fit(likelihood, own, varied, rows)
    return Pair(
        pair_mass_kda=float(mass.reported(theta[MASS])),
        separation_nm=2 * apart,
        angle_deg=math.degrees(math.atan2(theta[5], theta[4])) % 180,
        sigma_pair_mass_kda=math.sqrt(covariance[MASS, MASS]) * abs(mass.slope(float(theta[MASS]))),
        sigma_separation_nm=2 * sigma_along,
        sigma_angle_deg=math.degrees(sigma_across / apart),
        p_point=float(chdtrc(3, max(2 * (found.log_likelihood - point), 0.0))),
        pair_chi2_reduced=chi2,
        pair_p_value=p_value,
    )
