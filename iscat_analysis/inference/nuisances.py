"""Evidence of one event about the assumptions of its fit: its height, and that it is a point.

A fit in mode mass holds the height, and takes the particle for a point that rests.  Each of these
has a derivative of the image: ∂s/∂z; and ½ Σ·∇∇s for a particle whose light is spread over places
of covariance Σ, because it wiggles or has parts that are apart.  With u the score along them and I
their information once everything that was fitted follows, I⁻¹u estimates them, and uᵀI⁻¹u tests
whether they are there (Rao's score test; C. R. Rao, Proc. Camb. Phil. Soc. 44, 50, 1948).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from iscat_analysis.inference.likelihood import LEVEL, Likelihood
from iscat_analysis.records import FitResult, FloatArray

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
    pull, bend, of_level = _slopes(likelihood, rows[0], math.exp(theta[LEVEL]))
    axes = [*rows[1:5], of_level]
    fitted = [i for i in range(5) if free[i] and i != Z]
    slope = likelihood.model.scale.slope(float(theta[MASS]))
    lifted = _beside(pull, bend, [axes[i] for i in fitted], [axes[Z]])
    if lifted is None:
        return np.array(NOTHING)
    (up,), ((known,),), follow = lifted
    mass = fitted.index(MASS)
    own = [theta[Z] + up / known, known**-0.5, follow[0, mass] * slope]
    fitted = [i for i in range(5) if free[i]]
    round_ = (rows[_XX] + rows[_YY]) / 2
    across = (rows[_XX] - rows[_YY]) / 2
    spread = _beside(
        pull, bend, [axes[i] for i in fitted], [round_, across, rows[_XY]],
        known={fitted.index(Z): likelihood.height_prior} if free[Z] else {}, at_nm=theta[Z],
    )  # fmt: skip
    if spread is None:
        return np.array([*own, *NOTHING[3:-1], rise])
    up_, known_, follow = spread
    chi2 = float(up_ @ np.linalg.solve(known_, up_))
    wide = [up_[0] / known_[0, 0], known_[0, 0] ** -0.5, follow[0, fitted.index(MASS)] * slope]
    two = np.linalg.inv(known_[1:, 1:])
    error = np.linalg.det(two) ** 0.25  # geometric mean
    return np.array([*own, *wide, chi2, *(two @ up_[1:]), error, rise])


def _slopes(
    likelihood: Likelihood, signal: FloatArray, level: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Give ∂ℓ/∂s, the information about s, and ∂s/∂g of every pixel.

    Shapes: `signal` (ny, nx), results (ny, nx).
    """
    terms = likelihood.noise.terms(likelihood.data, signal, math.log(level))
    by_signal = terms.by_signal
    if not np.isfinite(terms.value):
        return by_signal, by_signal, by_signal  # which are 0 for an impossible signal
    follow = np.divide(
        terms.by_level, by_signal, out=np.zeros_like(by_signal), where=by_signal != 0
    )
    return terms.score * by_signal, terms.information * by_signal**2, follow


def _beside(
    pull: FloatArray,
    bend: FloatArray,
    fitted: list[FloatArray],
    extra: list[FloatArray],
    *,
    known: dict[int, tuple[float, float]] | None = None,
    at_nm: float = 0.0,
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Give score and information of directions once all that was fitted follows, and how it does.

    `known` holds mean and information of a prior of a fitted one, which is at `at_nm`.

    Shapes: `pull, bend` (ny, nx), results (k,), (k, k), (k, n).
    """
    all_ = np.array([*fitted, *extra]).reshape(len(fitted) + len(extra), -1)
    n, b = len(fitted), bend.ravel()
    score, fisher = all_ @ pull.ravel(), (all_ * b) @ all_.T
    for index, (mean, information) in (known or {}).items():
        score[index] -= information * (at_nm - mean)
        fisher[index, index] += information
    diagonal = np.diag(fisher)
    if not np.all(diagonal > 0):
        return None
    unit = 1 / np.sqrt(diagonal)
    scaled = fisher * np.outer(unit, unit)
    try:
        follow = -np.linalg.solve(scaled[:n, :n], scaled[:n, n:]).T
    except np.linalg.LinAlgError:
        return None
    left = scaled[n:, n:] + follow @ scaled[:n, n:]
    if np.linalg.eigvalsh(left)[0] <= _DEPENDENT:
        return None
    own = 1 / unit[n:]
    up = (score[n:] * unit[n:] + follow @ (score[:n] * unit[:n])) * own
    return up, left * np.outer(own, own), follow * unit[:n] / unit[n:, None]


_DEPENDENT = 1e-6
"""Share of a direction's information that is left, below which the fit has it already."""
