"""Starts of a fit of a sphere: every branch of its diameter and height.

The contrast of a sphere rises with the diameter, turns, and may change its sign, so that several
diameters have about the same image, each at a height of its own.  Diameters and heights are
therefore scanned together, and every local maximum of the likelihood starts a fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import generate_binary_structure, maximum_filter
from scipy.special import ndtr

from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.maximiser import Optimum
from iscat_analysis.optics.model import ForwardModel
from iscat_analysis.optics.sized import SizedModel
from iscat_analysis.records import Alternative, Box, FloatArray

AMBIGUITY_ODDS = 1000.0
"""Another height or diameter whose odds against the best are shorter than this is reported as
ambiguous."""

OTHER_SIZE = 3.0
"""Standard errors of the mass beyond which another maximum has another size."""

OTHER_SIZE_SHARE = 0.02
"""Share of the mass by which two maxima at one height differ at least."""


def starts_of(
    likelihood: Likelihood, theta: FloatArray, box: Box
) -> list[tuple[FloatArray, float]]:
    """Local maxima of the likelihood over heights, and over diameters of a sphere, best first.

    Each start is θ with the height and the amplitude of a maximum; beside it the log-likelihood.
    """
    model, (low, high) = likelihood.model, (float(end[2]) for end in (box.lower, box.upper))
    heights = scanned_heights(model, low, high)
    if isinstance(model, SizedModel) and box.free[3]:
        masses = scanned_masses(model, float(box.lower[3]), float(box.upper[3]))
        values = scan_sizes(likelihood, model, theta, masses, heights)
        amplitudes = np.broadcast_to(masses[:, None], values.shape)
        most = 6
    else:
        heights = np.unique([*heights, theta[2]])
        bounds = (float(box.lower[3]), float(box.upper[3])) if box.free[3] else None
        values, amplitudes = likelihood.scan_heights(heights, theta, bounds)
        most = 8
    starts = []
    for at in highest_maxima(values, most, diagonal=True):
        begin = theta.copy()
        begin[2], begin[3] = heights[at[-1]], amplitudes[at]
        starts.append((begin, float(values[at])))
    return starts


def highest_maxima(
    values: FloatArray, most: int, *, diagonal: bool = False
) -> list[tuple[int, ...]]:
    """Find the local maxima of a scan, the highest first, at most so many.

    Neighbours are next along one axis, or along several at once (`diagonal`).
    """
    known = np.where(np.isfinite(values), values, -np.inf)
    neighbours = generate_binary_structure(values.ndim, values.ndim if diagonal else 1)
    highest = maximum_filter(known, footprint=neighbours, mode="constant", cval=-np.inf)
    peaks = np.argwhere(np.isfinite(values) & (values >= highest)).tolist()
    return sorted(map(tuple, peaks), key=lambda at: -values[at])[:most]


def scan_sizes(
    likelihood: Likelihood,
    model: SizedModel,
    theta: FloatArray,
    masses: FloatArray,
    heights: FloatArray,
) -> FloatArray:
    """Log-likelihood of every mass at every height, at the place and the level of θ.

    Shapes: `theta` (5,), `masses` (m,), `heights` (n,), result (m, n).
    """
    values = np.empty((masses.size, heights.size))
    for row, mass in zip(values, masses.tolist(), strict=True):
        one = replace(likelihood, model=model.scanned(mass))
        row[:], _ = one.scan_heights(heights, np.array([*theta[:3], mass, theta[4]]), None)
    return values


def scanned_heights(model: ForwardModel, low_nm: float, high_nm: float) -> FloatArray:
    """Heights of a scan from one end of a range to the other [nm], shape (n,)."""
    # Heights scanned per interference fringe
    count = math.ceil((high_nm - low_nm) / model.fringe_nm * 8) + 1
    return np.linspace(low_nm, high_nm, max(count, 3))


def scanned_masses(model: SizedModel, low_kda: float, high_kda: float) -> FloatArray:
    """Masses of a scan from one end of a range to the other [kDa], shape (n,)."""
    low, high = (model.sphere.of_mass(mass).diameter_nm for mass in (low_kda, high_kda))
    # Ratio of the scattered amplitudes of neighbouring diameters of the scan, of small spheres
    # Largest step of the diameter in the scan over the fringe λ/(2 n_s): an eighth of a turn of
    # the phase of the light scattered backwards
    ratio, step = 1.5 ** (1 / 3), (1 / 16) * model.fringe_nm
    diameters = [low]
    while diameters[-1] < high:
        diameters.append(min(diameters[-1] * ratio, diameters[-1] + step))
    diameters[-1] = high
    return high_kda * (np.array(diameters) / high) ** 3


def has_other_size(alternatives: Sequence[Alternative], best: Optimum, sigma_kda: float) -> bool:
    """Whether another maximum, almost as likely, has another diameter."""
    mass = float(best.theta[3])
    return any(
        other.log_likelihood_gap < math.log(AMBIGUITY_ODDS)
        and abs(other.mass_kda - mass) > OTHER_SIZE * sigma_kda
        for other in alternatives
    )


def size_probability(
    likelihood: Likelihood, optima: Sequence[Optimum], box: Box, sigma_kda: float
) -> float:
    """Posterior probability of the diameter of the first optimum, flat in the diameter before.

    Each optimum is a normal distribution, of which what lies inside the range of heights counts:
    weight = likelihood · volume · dd/dm.
    """
    best = float(optima[0].theta[3])
    apart = max(OTHER_SIZE * sigma_kda, OTHER_SIZE_SHARE * best)
    weights, own = [], []
    for one in optima:
        if one.converged:
            weights.append(_log_weight(likelihood, one, box))
            own.append(abs(one.theta[3] - best) <= apart)
    if not np.isfinite(weights).any():
        return math.nan
    shares = np.exp(np.array(weights) - max(weights))
    return float(shares[own].sum() / shares.sum())


def _log_weight(likelihood: Likelihood, optimum: Optimum, box: Box) -> float:
    """Logarithm of the posterior weight of an optimum, in its free parameters and the diameter."""
    free = np.flatnonzero(box.free)
    _, score, fisher = likelihood.score_fisher(optimum.theta)
    sign, log_information = np.linalg.slogdet(fisher[np.ix_(free, free)] / (2 * math.pi))
    if not (sign > 0 and math.isfinite(log_information)):
        return -math.inf
    covariance = np.linalg.inv(fisher[np.ix_(free, free)])
    step = covariance @ score[free]  # to the top of the normal, which a wall may hide
    value = optimum.log_likelihood + 0.5 * float(score[free] @ step)
    value -= 0.5 * float(log_information)
    if box.free[2]:
        at = int(np.flatnonzero(free == 2)[0])
        z, spread = optimum.theta[2] + step[at], math.sqrt(covariance[at, at])
        below, above = ndtr((np.array([box.lower[2], box.upper[2]]) - z) / spread)
        value += math.log(max(above - below, 1e-300))
    return value - 2 / 3 * math.log(optimum.theta[3])  # dd/dm, as d goes with m^(1/3)
