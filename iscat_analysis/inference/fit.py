"""The estimator: maximum likelihood for one particle, its bias of order 1/N taken off.

Fixed and sliding windows, moving particles and the benchmark all call `fit_particle`, so that what
is benchmarked is what users get.

In iSCAT the likelihood along z repeats every λ/(2 n_s), so it is scanned first, with the amplitude
refitted at each height, and every local maximum starts a fit.  The result carries a `Status`;
nothing is returned as ok that did not converge inside its bounds and describe the data.

Whether the level of the light is fitted as well is a question of what is known about it.  Between
one window before the particles and one after, the laser power is known from the whole field, far
better than a region could tell: the level is held.  In windows that slide over a movie the light
of a region changes by more than the power does, by slow drifts and by the rings of other particles:
the level is a nuisance, and bounds count it as one.
"""

from __future__ import annotations

import math
from itertools import compress

import numpy as np

from iscat_analysis.inference.goodness import goodness_of_fit
from iscat_analysis.inference.likelihood import LEVEL, Likelihood, Optimum
from iscat_analysis.inference.precision import precision
from iscat_analysis.records import (
    FREE_PARAMETERS,
    PARAMETERS,
    Alternative,
    BoolArray,
    Box,
    Candidate,
    FitResult,
    FloatArray,
    Status,
    verdict,
)

AMBIGUITY_ODDS = 1000.0
"""A second height whose odds against the best are shorter than this is reported as ambiguous."""

POOR_FIT_P = 1e-3
"""p-value below which the model is said not to describe the data: 1 good fit in 1000."""

FOLLOWED = 30.0
"""Log-likelihood below the best optimum down to which others are followed to their ends."""

PLAIN = 2 * FOLLOWED
"""Log-likelihood of a particle against none from which the scan of heights is believed alone."""

OUTWARD = 3.0
"""Standard deviations by which the data pull a height beyond the end of its range, or a mass beyond
the end of a calibration's line, before the fit is said to be at a bound: fewer are chance."""

SCANS_PER_FRINGE = 8
"""Heights scanned per interference fringe before fitting."""

AMPLITUDE = 3
"""Index of the amplitude in θ."""

_STARTS = 8  # local maxima of the scan that are followed
_WINDOW_NM = 350.0  # how far x and y may move from the start
_NOTHING_KNOWN = np.zeros((5, 5))  # information where nothing was looked at


def window_nm(pixel_nm: float) -> float:
    """How far x and y may move from the start of a fit.

    Parameters
    ----------
    pixel_nm : float
        Pixel side [nm].

    Returns
    -------
    float
        Distance [nm].
    """
    return max(_WINDOW_NM, 3 * pixel_nm)


def search_box(
    likelihood: Likelihood,
    start: Candidate,
    mode: str,
    z_range_nm: tuple[float, float],
    *,
    level: bool = False,
) -> Box:
    """Bounds of the search around a start.

    Parameters
    ----------
    likelihood : Likelihood
        Its grid limits x and y.
    start : Candidate
        Where the search begins.
    mode : str
        Key of `FREE_PARAMETERS`.
    z_range_nm : (float, float)
        Bounds of z where it is free [nm].
    level : bool
        Also fit a common background level.

    Returns
    -------
    Box
        Where z is free the amplitude keeps one sign: a change of sign is half a fringe.  What is
        not free has no width, wherever it lies.
    """
    names = FREE_PARAMETERS[mode]
    grid = likelihood.grid
    reach = window_nm(grid.pixel_nm)
    x, y, _, amplitude, _ = fixed = start_theta(likelihood, start).tolist()
    largest = 100 * max(abs(amplitude), abs(likelihood.model.nominal_amplitude))
    signed = "z_nm" not in names and likelihood.model.rho > 0
    half = grid.pixel_nm / 2
    free = [name in names for name in PARAMETERS] + [level]
    lower = (
        max(x - reach, grid.x_nm[0] - half), max(y - reach, grid.y_nm[0] - half), z_range_nm[0],
        -largest if signed else 0.0, -1.0,
    )  # fmt: skip
    upper = (
        min(x + reach, grid.x_nm[-1] + half), min(y + reach, grid.y_nm[-1] + half), z_range_nm[1],
        largest, 1.0,
    )  # fmt: skip
    low, high = (
        np.array(
            [end if moves else value for moves, end, value in zip(free, ends, fixed, strict=True)]
        )
        for ends in (lower, upper)
    )
    return Box(np.array(free), low, high)


def fit_particle(
    likelihood: Likelihood,
    start: Candidate,
    mode: str,
    z_range_nm: tuple[float, float],
    *,
    level: bool,
    correct_bias: bool = True,
) -> FitResult:
    """Fit one particle.

    Parameters
    ----------
    likelihood : Likelihood
        Of the particle's region.
    start : Candidate
        Where the search begins; in mode ``"localize"`` its mass is the fixed one.
    mode : str
        ``"mass"``, ``"localize"``, ``"joint"`` or ``"track"``.
    z_range_nm : (float, float)
        Bounds of z where it is free [nm]; elsewhere z is the start's.
    level : bool
        Whether a common level of the light is fitted too, as a nuisance: True in windows that
        slide, False where the power is known from the whole field.
    correct_bias : bool
        Take the bias of order 1/N off the estimate.  False leaves the bare maximum, to show what
        the correction does.

    Returns
    -------
    FitResult
        Estimate, uncertainty, goodness of fit and verdict.
    """
    box = search_box(likelihood, start, mode, z_range_nm, level=level)
    optima = _optima(likelihood, start, box)
    best = optima[0]
    model = likelihood.model
    alternatives = _alternatives(optima, model.fringe_nm)
    derivatives = likelihood.derivatives(best.theta, box.free)
    walls = _walls(best.theta, box)
    slope = abs(model.scale.slope(float(best.theta[AMPLITUDE])))
    known, sigma, covariance, bias = precision(
        likelihood, best.theta, best.fisher, box.free, derivatives, walls=walls, slope=slope
    )
    chi2_reduced, p_value = goodness_of_fit(likelihood, best.theta, box.free, derivatives)
    flags = []
    if not best.converged or not known:
        flags.append(Status.NOT_CONVERGED)
    if _at_bound(likelihood, best.theta, walls, sigma[2]):
        flags.append(Status.AT_BOUND)
    if alternatives and alternatives[0].log_likelihood_gap < math.log(AMBIGUITY_ODDS):
        flags.append(Status.AMBIGUOUS_Z)
    if p_value < POOR_FIT_P:
        flags.append(Status.POOR_FIT)
    estimate = best.theta
    if correct_bias and known:
        size = np.abs(bias[:4])
        size[AMPLITUDE] *= slope
        # an expansion whose first term exceeds the error has lost its meaning
        if (size <= sigma)[box.free[:4]].all():
            estimate = np.minimum(np.maximum(estimate - bias, box.lower), box.upper)
    x, y, z, amplitude = (float(value) for value in estimate[:4])
    if box.free[AMPLITUDE] and model.scale.off_line(estimate[AMPLITUDE], sigma[AMPLITUDE], OUTWARD):
        flags.append(Status.AT_BOUND)
    status, noticed = verdict(flags)
    return FitResult(
        x_nm=x,
        y_nm=y,
        z_nm=z,
        mass_kda=float(model.scale.mass(np.asarray(amplitude))),
        theta=best.theta,
        estimate=estimate,
        box=box,
        free=tuple(compress(PARAMETERS, box.free)),
        sigma=sigma,
        covariance=covariance,
        contrast=model.amplitude_contrast(z, amplitude, "between" if box.free[2] else "exact"),
        log_likelihood=best.log_likelihood,
        snr=detection_snr(likelihood, best, box),
        iterations=best.passes,
        chi2_reduced=chi2_reduced,
        p_value=p_value,
        status=status,
        flags=noticed,
        alternatives=alternatives,
    )


def detection_snr(likelihood: Likelihood, best: Optimum, box: Box) -> float:
    """Signal-to-noise ratio of a particle: √(2 Δℓ) against the same light without it.

    Where the level is a nuisance it is fitted without the particle too: a region that became
    brighter as a whole is no evidence of a particle in it.

    Parameters
    ----------
    likelihood : Likelihood
        The one that was maximised.
    best : Optimum
        Where it has its maximum.
    box : Box
        What was free there, and within which bounds.

    Returns
    -------
    float
        At least 0.
    """
    nothing = 0.0  # log-likelihoods count from no particle and no change of the level
    if box.free[LEVEL]:
        alone = np.arange(box.free.size) == LEVEL
        empty = best.theta.copy()
        empty[AMPLITUDE] = 0.0
        empty[LEVEL] = 0.0
        lower, upper = (np.where(alone, end, empty) for end in (box.lower, box.upper))
        nothing = likelihood.maximize(empty, alone, lower, upper).log_likelihood
    return math.sqrt(2 * max(best.log_likelihood - nothing, 0.0))


def start_theta(likelihood: Likelihood, start: Candidate) -> FloatArray:
    """Give a candidate's θ.

    Parameters
    ----------
    likelihood : Likelihood
        Its grid and mass scale are used.
    start : Candidate
        The candidate.

    Returns
    -------
    ndarray, shape (5,)
        θ.
    """
    pixel = likelihood.grid.pixel_nm
    amplitude = likelihood.model.scale.amplitude(start.mass_kda)
    return np.array([start.x_px * pixel, start.y_px * pixel, start.z_nm, amplitude, 0.0])


def _optima(likelihood: Likelihood, start: Candidate, box: Box) -> list[Optimum]:
    """Every optimum that was reached, best first.

    Starts are followed in the order of their likelihood, and no farther than shows that the optimum
    cannot be within `FOLLOWED` of the best.  The given height is one of the scan.  Where it is none
    of its maxima, it is followed only if what was found is fainter than `PLAIN`, when each start may
    end elsewhere, or if there is no reference, when there are no fringes that a scan could follow.
    """
    theta = start_theta(likelihood, start)
    theta = np.minimum(np.maximum(theta, box.lower), box.upper)  # what is not free has no room
    if not box.free[2]:
        return [likelihood.maximize(theta, box.free, box.lower, box.upper)]
    optima: list[Optimum] = []
    best, plain = -math.inf, False
    for begin, value in _heights(likelihood, theta, box):
        if box.free[3] and begin[3] == 0.0 and best > 0.0:
            optima.append(Optimum(begin, value, 0, False, _NOTHING_KNOWN))  # no particle there
            continue
        found = likelihood.maximize(begin, box.free, box.lower, box.upper, least=best - FOLLOWED)
        optima.append(found)
        if found.converged and found.log_likelihood > best:
            best, plain = found.log_likelihood, _is_plain(found)
    if not plain or likelihood.model.rho == 0:
        optima.append(
            likelihood.maximize(theta, box.free, box.lower, box.upper, least=best - FOLLOWED)
        )
    return sorted(optima, key=lambda o: (not o.converged, -o.log_likelihood))


def _is_plain(found: Optimum) -> bool:
    """Whether a particle is told from none, and not only a level of the light from another."""
    alone = 0.5 * found.theta[AMPLITUDE] ** 2 * found.fisher[AMPLITUDE, AMPLITUDE]
    return bool(min(found.log_likelihood, alone) > PLAIN)


def _heights(likelihood: Likelihood, theta: FloatArray, box: Box) -> list[tuple[FloatArray, float]]:
    """Start at the local maxima of the likelihood along z, best first.

    Each start is θ with a maximum's height and amplitude; beside it the log-likelihood there.
    """
    low, high, given = float(box.lower[2]), float(box.upper[2]), float(theta[2])
    count = max(math.ceil((high - low) / likelihood.model.fringe_nm * SCANS_PER_FRINGE) + 1, 3)
    heights = sorted({*np.linspace(low, high, count).tolist(), given})
    bounds = (float(box.lower[3]), float(box.upper[3])) if box.free[3] else None
    values, amplitudes = likelihood.scan_heights(np.array(heights), theta, bounds)
    padded = [-math.inf, *values.tolist(), -math.inf]
    peaks = [i for i in range(len(heights)) if padded[i] <= padded[i + 1] >= padded[i + 2]]
    starts = []
    for i in sorted(peaks, key=lambda i: -padded[i + 1])[:_STARTS]:
        begin = theta.copy()
        begin[2], begin[3] = heights[i], amplitudes[i]
        starts.append((begin, padded[i + 1]))
    return starts


def _alternatives(optima: list[Optimum], fringe_nm: float) -> tuple[Alternative, ...]:
    """Optima at other heights than the best one and than each other."""
    best = optima[0].log_likelihood
    places = [(float(o.theta[2]), max(best - o.log_likelihood, 0.0)) for o in optima]
    kept = places[:1]
    for z, gap in places[1:]:
        if all(abs(z - other) > fringe_nm / 8 for other, _ in kept):
            kept.append((z, gap))
    return tuple(
        sorted((Alternative(*one) for one in kept[1:]), key=lambda a: a.log_likelihood_gap)
    )


def _walls(theta: FloatArray, box: Box) -> BoolArray:
    """Which free parameters lie on an end of the box."""
    width = box.upper - box.lower
    near = (theta - box.lower < 1e-6 * width) | (box.upper - theta < 1e-6 * width)
    walls: BoolArray = near & box.free
    return walls


def _at_bound(
    likelihood: Likelihood, theta: FloatArray, walls: BoolArray, sigma_z_nm: float
) -> bool:
    """Whether the search ended where the data do not want it to end.

    Position, amplitude and level are searched in a window of our own, whose end is never an answer.
    The ends of the heights mean something: the coverslip, or what the user knows.  Noise alone puts
    a particle near such an end onto it, and the fit is good unless the data pull on significantly.
    """
    if walls[0] or walls[1] or walls[3] or walls[LEVEL]:
        return True
    if not walls[2]:
        return False
    score = likelihood.score_fisher(theta)[1]
    return not abs(score[2]) * sigma_z_nm < OUTWARD
