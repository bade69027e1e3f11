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

Does the model describe the data?  Three tests of the residuals of one fit, and their verdict:

scatter
    Pearson's χ², two-sided: noise stronger or weaker than the camera's.  Cells that expect few
    counts are pooled, and the variance carries the fourth moment of the counts.
structure
    Rao's score test against smooth changes of the image around the particle, Hermite–Gauss modes up
    to `ORDER`: a wrong focus or aperture, a neighbour.  A few directions, so that a misfit
    that drowns in the χ² of a thousand pixels is seen.
outlier
    The least likely pixel, by the exact tail of its counts: a dead, hot or saturated one.

Each p-value (`three_tests`) is uniform on good data; `goodness_of_fit` joins them by Šidák's rule.

Errors are those of the expected information and, where the likelihood is no parabola within them,
of how far it falls (`_far`).  A position that is fitted follows the noise to where it adds to the
particle, so that the amplitude comes out too large, by about 1/SNR²: 1 % at 10, 11 % at 3; this
bias of order 1/N is taken off.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincc

from iscat_analysis._kernels.goodness import count_and_test
from iscat_analysis._kernels.hessian import ROWS, errors_and_bias
from iscat_analysis.inference.counts import poisson
from iscat_analysis.inference.laws import MANY_COUNTS
from iscat_analysis.inference.likelihood import LEVEL, Likelihood, ModelLikelihood
from iscat_analysis.inference.maximiser import Optimum, covariance_of
from iscat_analysis.inference.sizes import (
    AMBIGUITY_ODDS,
    OTHER_SIZE_SHARE,
    has_other_size,
    size_probability,
    starts_of,
)
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.optics.sized import SizedModel
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

ORDER = 6
"""Largest order of the modes: (ORDER + 1)(ORDER + 2)/2 = 28 directions."""

WAIST = 0.5
"""Waist of the modes over λ/NA; with `ORDER` they reach 2 λ/NA from the particle."""

POOLED_COUNTS = 5.0
"""Cells that expect fewer counts are joined until they expect as many."""

AWAY = 3.0
"""Standard deviations from the maximum at which the likelihood is looked at."""

POOR_FIT_P = 1e-3
"""p-value below which the model is said not to describe the data: 1 good fit in 1000."""

FOLLOWED = 30.0
"""Log-likelihood below the best optimum down to which others are followed to their ends."""

PLAIN = 2 * FOLLOWED
"""Log-likelihood of a particle against none from which a scan of heights finds it by itself, unless
what was found does not describe the data."""

OUTWARD = 3.0
"""Standard deviations by which the data pull a height beyond the end of its range, or a mass beyond
the end of a calibration's line, before the fit is said to be at a bound: fewer are chance."""

AMPLITUDE = 3
"""Index of the amplitude in θ."""


def window_nm(pixel_nm: float) -> float:
    """How far x and y may move from the start of a fit."""
    return max(350.0, 3 * pixel_nm)


def search_box(
    likelihood: Likelihood,
    theta: FloatArray,
    mode: str,
    z_range_nm: tuple[float, float],
    *,
    level: bool = False,
) -> Box:
    """Bounds of the search around a start.

    Shapes: `theta` (5,).
    """
    names, model, grid = FREE_PARAMETERS[mode], likelihood.model, likelihood.grid
    reach, half = window_nm(grid.pixel_nm), grid.pixel_nm / 2
    x, y, _, amplitude, _ = fixed = theta.tolist()
    smallest, largest = 0.0, 100 * max(abs(amplitude), abs(model.nominal_amplitude))
    if isinstance(model, SizedModel):
        smallest, largest = model.mass_range_kda
    elif "z_nm" not in names and model.rho > 0:
        smallest = -largest
    if likelihood.prior is not None:
        low, high = likelihood.prior.range_nm
        z_range_nm = max(low, model.z_range_nm[0]), min(high, model.z_range_nm[1])
        names = (*names, "z_nm")
    free = [name in names for name in PARAMETERS] + [level]
    left, right = grid.x_nm.item(0) - half, grid.x_nm.item(-1) + half
    top, bottom = grid.y_nm.item(0) - half, grid.y_nm.item(-1) + half
    lower = max(x - reach, left), max(y - reach, top), z_range_nm[0], smallest, -1.0
    upper = min(x + reach, right), min(y + reach, bottom), z_range_nm[1], largest, 1.0
    return Box(np.array(free), np.where(free, lower, fixed), np.where(free, upper, fixed))


def fit_particle(
    likelihood: Likelihood,
    start: Candidate,
    mode: str,
    z_range_nm: tuple[float, float],
    *,
    level: bool,
    correct_bias: bool = True,
) -> FitResult:
    """Fit one particle."""
    begin = start_theta(likelihood, start)
    box = search_box(likelihood, begin, mode, z_range_nm, level=level)
    optima, all_followed = _optima(likelihood, begin, box)
    found = _judged(likelihood, optima[0], box)
    if not all_followed and not found.p_value >= POOR_FIT_P:
        optima, found = _also_from(likelihood, _inside(begin, box), box, optima, found)
    quarter = likelihood.model.fringe_nm / 4  # farther away the likelihood may be no parabola
    if any(AWAY * error > quarter for error in found.sigma[:3].tolist()):
        wider, higher = _far(likelihood, box, found)
        if higher is not None:
            optima, found = _also_from(likelihood, higher, box, optima, found)
            wider, _ = _far(likelihood, box, found)
        found = wider
    best, known, sigma, bias = found.best, found.known, found.sigma, found.bias
    model = likelihood.model
    optima = _distinct(optima, model)
    alternatives = _alternatives(optima)
    estimate, sigma_kda = best.theta, float(sigma[AMPLITUDE])
    # an expansion has lost its meaning if its first term exceeds the error
    sizes = np.abs(bias[:4]) * [1.0, 1.0, 1.0, found.slope]
    if correct_bias and known and np.all((sizes <= sigma) | ~box.free[:4]):
        estimate = _inside(estimate - bias, box)
    x, y, z, amplitude = estimate[:4].tolist()
    sized = model.is_sized and bool(box.free[AMPLITUDE])
    pair = estimate[AMPLITUDE], sigma[AMPLITUDE]
    off_line = bool(box.free[AMPLITUDE] and model.scale.off_line(*pair, OUTWARD))
    gap = alternatives[0].log_likelihood_gap if alternatives else math.inf
    flags = {
        Status.NOT_CONVERGED: not (best.converged and known),
        Status.AT_BOUND: off_line or _at_bound(likelihood, best.theta, found.walls, sigma[2]),
        Status.AMBIGUOUS_Z: gap < math.log(AMBIGUITY_ODDS),
        Status.AMBIGUOUS_SIZE: model.is_sized and has_other_size(alternatives, best, sigma_kda),
        Status.POOR_FIT: found.p_value < POOR_FIT_P,
    }
    probability = math.nan
    if sized and known:
        probability = size_probability(likelihood, optima, box, sigma_kda)
    status, noticed = verdict([flag for flag, applies in flags.items() if applies])
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
        covariance=found.covariance,
        contrast=model.amplitude_contrast(z, amplitude, "between" if box.free[2] else "exact"),
        log_likelihood=best.log_likelihood,
        snr=detection_snr(likelihood, best, box),
        iterations=best.passes,
        chi2_reduced=found.chi2_reduced,
        p_value=found.p_value,
        status=status,
        flags=noticed,
        alternatives=alternatives,
        size_probability=probability,
    )


@dataclass(frozen=True)
class ModelFit:
    """A maximum of the likelihood of any particle model, in the parameters of the likelihood."""

    theta: FloatArray
    box: Box
    covariance: FloatArray
    log_likelihood: float
    converged: bool
    alternatives: tuple[Alternative, ...] = ()

    @property
    def sigma(self) -> FloatArray:
        """Standard errors, NaN where not free or not determined, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))


def fit_model(likelihood: ModelLikelihood, start: FloatArray, box: Box) -> ModelFit:
    """Fit any particle model from a start inside a box.

    Shapes: `start` (p,).
    """
    found = likelihood.maximize(start, box)
    covariance = covariance_of(found.fisher, box.free)
    return ModelFit(found.theta, box, covariance, found.log_likelihood, found.converged)


def detection_snr(likelihood: Likelihood, best: Optimum, box: Box) -> float:
    """Signal-to-noise ratio of a particle: √(2 Δℓ) against the same light without it."""
    gain = best.log_likelihood - without_particle(likelihood, best.theta, box)
    return math.sqrt(2 * max(gain, 0.0))


def without_particle(likelihood: Likelihood, theta: FloatArray, box: Box) -> float:
    """Log-likelihood of the same light without a particle, relative to no change of the level.

    Where the level is a nuisance it is fitted without the particle too: a region that became
    brighter as a whole is no evidence of a particle in it.  The height of a particle that is not
    there is that of θ.

    Shapes: `theta` (5,).
    """
    if box.free[LEVEL]:
        alone = np.arange(box.free.size) == LEVEL
        empty = theta.copy()
        empty[[AMPLITUDE, LEVEL]] = 0.0
        lower, upper = (np.where(alone, end, empty) for end in (box.lower, box.upper))
        return likelihood.maximize(empty, Box(alone, lower, upper)).log_likelihood
    return 0.0 if likelihood.prior is None else float(likelihood.prior.log_density(theta[2]))


def start_theta(likelihood: Likelihood, start: Candidate) -> FloatArray:
    """Convert a candidate to θ.

    Shapes: result (5,).
    """
    pixel = likelihood.grid.pixel_nm
    amplitude = likelihood.model.scale.amplitude(start.mass_kda)
    return np.array([start.x_px * pixel, start.y_px * pixel, start.z_nm, amplitude, 0.0])


def candidate_at(likelihood: Likelihood, theta: FloatArray, snr: float = 0.0) -> Candidate:
    """Convert θ to a candidate.

    Shapes: `theta` (5,).
    """
    x, y, z, amplitude, _ = theta.tolist()
    pixel, mass = likelihood.grid.pixel_nm, likelihood.model.scale.mass(np.asarray(amplitude))
    return Candidate(x / pixel, y / pixel, z, float(mass), snr)


def _optima(likelihood: Likelihood, theta: FloatArray, box: Box) -> tuple[list[Optimum], bool]:
    """Every optimum that was reached, best first, and whether all starts were followed.

    Starts are followed in the order of their likelihood, θ itself last.  The height of θ is one of
    the scan, and where it is none of its maxima, a plain particle is found without it; it is left
    out then, unless there is no reference and so no fringes that a scan could follow.
    """
    theta, model = _inside(theta, box), likelihood.model
    if not box.free[2]:
        return [likelihood.maximize(theta, box)], True
    optima: list[Optimum] = []
    best, plain = -math.inf, False
    sized = isinstance(model, SizedModel) and bool(box.free[AMPLITUDE])
    for begin, value in starts_of(likelihood, theta, box):
        if box.free[AMPLITUDE] and begin[AMPLITUDE] == 0.0 and best > 0.0:
            # no particle there
            optima.append(Optimum(begin, value, 0, False, np.zeros((5, 5))))
            continue
        found = likelihood.maximize(_inside(begin, box), box, least=best - FOLLOWED)
        optima.append(found)
        if found.converged and found.log_likelihood > best:
            best = found.log_likelihood
            # against a mere change of the level
            alone = 0.5 * found.theta[AMPLITUDE] ** 2 * found.fisher[AMPLITUDE, AMPLITUDE]
            plain = bool(min(best, alone) > PLAIN)
    if optima and (sized or (plain and model.rho > 0)):
        return _ranked(optima), sized
    return _ranked([*optima, likelihood.maximize(theta, box, least=best - FOLLOWED)]), True


def _inside(theta: FloatArray, box: Box) -> FloatArray:
    """Clip θ to a box; fixed parameters have a range of zero."""
    return np.minimum(np.maximum(theta, box.lower), box.upper)


def _ranked(optima: list[Optimum]) -> list[Optimum]:
    """Sort optima: the best first, those that were given up last."""
    return sorted(optima, key=lambda o: (not o.converged, -o.log_likelihood))


class _Found(NamedTuple):
    """An optimum, its goodness of fit and its errors."""

    best: Optimum
    chi2_reduced: float
    p_value: float
    walls: BoolArray
    slope: float
    known: bool
    sigma: FloatArray
    covariance: FloatArray
    bias: FloatArray


def _judged(likelihood: Likelihood, best: Optimum, box: Box) -> _Found:
    """Compute goodness of fit and errors of an optimum."""
    derivatives = likelihood.derivatives(best.theta, box.free)
    chi2_reduced, p_value = goodness_of_fit(likelihood, best.theta, box.free, derivatives)
    to_wall = np.minimum(best.theta - box.lower, box.upper - best.theta)
    walls = box.free & (to_wall < 1e-6 * (box.upper - box.lower))
    slope = abs(likelihood.model.scale.slope(float(best.theta[AMPLITUDE])))
    at = likelihood, best.theta, best.fisher, box.free, derivatives
    errors = precision(*at, walls=walls, slope=slope)
    return _Found(best, chi2_reduced, p_value, walls, slope, *errors)


def _also_from(
    likelihood: Likelihood, theta: FloatArray, box: Box, optima: list[Optimum], found: _Found
) -> tuple[list[Optimum], _Found]:
    """Fit from one more start, and keep the result if it is the best."""
    last = likelihood.maximize(theta, box, least=found.best.log_likelihood - FOLLOWED)
    ranked = _ranked([*optima, last])
    return ranked, found if ranked[0] is found.best else _judged(likelihood, ranked[0], box)


def _far(likelihood: Likelihood, box: Box, found: _Found) -> tuple[_Found, FloatArray | None]:
    """Widen errors by how far the likelihood has fallen three standard deviations away.

    A parabola falls by t²/2 at t standard deviations, so that σ = d/√(2 Δℓ) at a distance d.  Each
    place is moved to either side, while the other parameters follow it as they are correlated with
    it; the larger of the errors of both sides counts, and that of the curvature where it is larger.
    Gives a higher point as well, if one of these is.
    """
    free, best, sigma = np.flatnonzero(box.free[:4]), found.best, found.sigma.copy()
    places = free[free < AMPLITUDE]
    steps = np.zeros((places.size, 5))
    steps[:, free] = found.covariance[: places.size] / found.sigma[places, None]
    steps[:, AMPLITUDE] /= found.slope
    around = _inside(best.theta + AWAY * np.concatenate([-steps, steps]), box)
    fallen = best.log_likelihood - likelihood.values(around)
    lowest = int(np.argmin(fallen))
    for k, theta, loss in zip([*places, *places], around, fallen.tolist(), strict=True):
        if loss > 0:
            sigma[k] = max(sigma[k], abs(theta[k] - best.theta[k]) / math.sqrt(2 * loss))
    factor = (sigma / found.sigma)[free]
    wider = found._replace(sigma=sigma, covariance=found.covariance * np.outer(factor, factor))
    return wider, around[lowest] if fallen[lowest] < 0 else None


def _distinct(optima: list[Optimum], model: ForwardModel) -> list[Optimum]:
    """Keep optima at other heights, or of other sizes, than better ones; the best is the first."""
    kept = optima[:1]
    for one in optima[1:]:
        z, amplitude = one.theta[2], one.theta[AMPLITUDE]
        if all(
            abs(z - other.theta[2]) > model.fringe_nm / 8
            or (
                model.is_sized
                and abs(amplitude - other.theta[AMPLITUDE])
                > OTHER_SIZE_SHARE * other.theta[AMPLITUDE]
            )
            for other in kept
        ):
            kept.append(one)
    return kept


def _alternatives(optima: list[Optimum]) -> tuple[Alternative, ...]:
    """Describe all optima but the first, which is the best."""
    best = optima[0].log_likelihood
    others = [
        Alternative(float(o.theta[2]), max(best - o.log_likelihood, 0.0), float(o.theta[AMPLITUDE]))
        for o in optima[1:]
    ]
    return tuple(sorted(others, key=lambda a: a.log_likelihood_gap))


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


def goodness_of_fit(
    likelihood: Likelihood, theta: FloatArray, free: BoolArray, rows: FloatArray | None = None
) -> tuple[float, float]:
    """Judge one fit.

    Notes
    -----
    Z. Šidák, J. Am. Stat. Assoc. 62, 626 (1967).

    Shapes: `theta` (5,), `free` (5,), `rows` (ny, ROWS, nx).
    """
    chi2, p_values = three_tests(likelihood, theta, free, rows)
    if math.isnan(p_values[0]):
        return chi2, math.nan
    return chi2, -math.expm1(len(p_values) * math.log1p(-min(*p_values, 1 - 1e-16)))


def three_tests(
    likelihood: Likelihood, theta: FloatArray, free: BoolArray, rows: FloatArray | None = None
) -> tuple[float, tuple[float, float, float]]:
    """Test one fit for the scatter of its residuals, for structure in them, and for outliers.

    Notes
    -----
    The squared residual of a count of excess kurtosis κ has variance 2 + κ; χ² follows a gamma law
    with that variance.  A smooth mode B multiplies the expected counts by 1 + ε B.  Its score, made
    independent of the fitted directions, is compared with its information (C. R. Rao, Proc. Camb.
    Phil. Soc. 44, 50, 1948).

    Shapes: `theta` (5,), `free` (5,), `rows` (ny, ROWS, nx).
    """
    rows = likelihood.derivatives(theta) if rows is None else rows
    free = np.asarray(free, dtype=np.bool_)
    optics, grid = likelihood.model.optics, likelihood.grid
    settings = WAIST * optics.wavelength_nm / optics.na, ORDER, MANY_COUNTS
    level, place = math.exp(theta[LEVEL]), (grid.x_nm, grid.y_nm, theta)
    chi2, cells, excess, least_rate, mode_chi2, modes, mode_excess, least, tails, rate = (
        count_and_test(likelihood.measured, level, rows, place, free, settings)
    )
    if likelihood.noise.pools_few and least_rate < POOLED_COUNTS:
        residual, kurtosis = _pooled(likelihood, rate)
        chi2, cells, excess = float(residual @ residual), residual.size, float(kurtosis.sum())
    freedom = cells - int(np.count_nonzero(free))
    if freedom <= 0:
        return math.nan, (math.nan, math.nan, math.nan)
    above = gamma_above(chi2, freedom, excess / cells)
    structure = gamma_above(mode_chi2, modes, mode_excess) if modes else 1.0
    if tails.size:
        least = min(least, 2 * float(likelihood.noise.tails(*tails).min()))
    outlier = likelihood.noise.smallest_tail_probability(rate[likelihood.used], least)
    return chi2 / freedom, (2 * min(above, 1 - above), structure, outlier)


def gamma_above(chi2: float, freedom: float, excess: float) -> float:
    """Upper tail of a sum of squares of variance (2 + excess)·freedom."""
    # over the variance of a sum of squares of normal residuals
    spread = max(1 + excess / 2, 0.1)
    return float(gammaincc(freedom / spread / 2, chi2 / spread / 2))


def _pooled(likelihood: Likelihood, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Residuals in standard deviations and their excess kurtosis, cells of few counts pooled."""
    used = likelihood.used
    rate = rate[used]
    few = rate < POOLED_COUNTS
    excess = likelihood.data[0][used] - rate
    order = np.argsort(-rate[few])
    bins = (np.cumsum(rate[few][order]) / POOLED_COUNTS).astype(int)
    pooled = (np.bincount(bins, v[few][order]) for v in (rate, excess))
    together, surplus = (np.asarray(v) for v in pooled)
    filled = together > 0
    rate = np.concatenate([rate[~few], together[filled]])
    excess = np.concatenate([excess[~few], surplus[filled]])
    return excess / np.sqrt(rate), 1 / rate


def precision(
    likelihood: Likelihood,
    theta: FloatArray,
    fisher: FloatArray,
    free: BoolArray,
    derivatives: FloatArray,
    *,
    walls: BoolArray | None = None,
    slope: float = 1.0,
) -> tuple[bool, FloatArray, FloatArray, FloatArray]:
    """Errors and bias of a maximum of the likelihood.

    Notes
    -----
    For counts of an exponential family with natural parameter η(θ) and variance V(η), the bias is
    −½ F⁻¹ Σ ∂η [V′ tr(F⁻¹ ∂η ∂ηᵀ) + V tr(F⁻¹ ∂²η)], the sum over pixels: D. R. Cox and E. J. Snell,
    J. R. Stat. Soc. B 30, 248 (1968), in the form of M. J. Box, ibid. 33, 171 (1971).

    Shapes: `theta` (5,), `fisher` (5, 5), `free` (5,), `derivatives` (ny, ROWS, nx), `walls` (5,),
    `sigma` (4,), `covariance` (n, n), `bias` (5,).
    """
    moving, units = free if walls is None else free & ~walls, (slope, likelihood.height_prior[1])
    level = math.exp(theta[LEVEL])
    found: tuple[bool, FloatArray, FloatArray, FloatArray] = errors_and_bias(
        likelihood.measured, level, derivatives, fisher, (free, moving), units
    )
    return found


def compile_kernels(model: ForwardModel, *, heights: bool, posteriors: bool = False) -> None:
    """Run the kernels of fits once on a few pixels, so that later calls find them compiled.

    Those of heights that are free or have a prior, and of posteriors, are run where asked for.
    """
    grid = PixelGrid.region((0, 3), (0, 3), 10.0)
    counts = np.full(grid.shape, 100.0)
    likelihood = poisson(model, grid, counts, counts, counts)
    theta = np.array([10.0, 10.0, model.height_nm, 1.0, 0.0])
    margin = np.array([1.0, 1.0, 0.0, 1.0, 0.0])
    free = np.array([True, True, heights, True, False])
    derivatives = np.random.default_rng(1).normal(size=(grid.shape[0], ROWS, grid.shape[1]))
    if heights:
        likelihood.scan_heights(theta[2:3], theta, (0.0, 2.0))
    likelihood.maximize(theta, Box(free, theta - margin, theta + margin), passes=2)
    likelihood.score_fisher(theta)
    precision(likelihood, theta, np.eye(5), free, derivatives)
    goodness_of_fit(likelihood, theta, free, derivatives)
    likelihood.derivatives(theta, free)
    if posteriors:
        likelihood.values(theta[None], pictured=True)
