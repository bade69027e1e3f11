"""What is known of a particle before it is seen, and the bound that this gives.

A normal prior on the mass (a species) or the height (a membrane) narrows a posterior below the
Cramér–Rao bound, which speaks of estimators without any prior.  The bound that holds is van
Trees': the Fisher information of the data, averaged over the prior, plus that of the prior
(H. L. Van Trees, *Detection, Estimation, and Modulation Theory* I (1968), section 2.4).

The posterior of one particle, sampled with emcee on the likelihood that was maximised.

The prior is flat inside the box that the fit searched, or normal in mass or height.  Half of the
moves propose from a mixture of Student t distributions around the optima, which decorrelate in a
step or two where the posterior is nearly normal; the other half are differential evolution (ter
Braak, Stat. Comput. 16, 239, 2006), which need no such luck.  A chain grows until its diagnostics
hold or its budget ends, and is then refused.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.fit import ModelFit
from iscat_analysis.inference.likelihood import Likelihood, ModelLikelihood
from iscat_analysis.optics.model import Parameter
from iscat_analysis.records import FitResult, FloatArray, PosteriorResult

if TYPE_CHECKING:
    import emcee

NODES = 5
"""Gauss–Hermite nodes of each prior, over which the Fisher information is averaged."""


@dataclass(frozen=True)
class Prior:
    """Independent normal distributions of some parameters; flat in the others."""

    normal: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def log_density(self, thetas: FloatArray, parameters: Sequence[Parameter]) -> FloatArray:
        """Logarithm of the density, up to a constant.

        Shapes: `thetas` (n, p), result (n,).
        """
        total = np.zeros(len(thetas))
        for each, value in zip(parameters, thetas.T, strict=True):
            if each.name in self.normal:
                mean, width = self.normal[each.name]
                if each.scale is not None:
                    total += np.log(np.maximum(np.abs(each.scale.slopes(value)), 1e-300))
                total -= 0.5 * ((each.reported(value) - mean) / width) ** 2
        return total

    def steps(self, parameters: Sequence[Parameter]) -> dict[int, tuple[float, float]]:
        """Give mean and standard deviation in θ: of the amplitude in place of the mass."""
        found = {}
        for index, each in enumerate(parameters):
            if each.name in self.normal:
                mean, width = self.normal[each.name]
                mean = each.fitted(mean)
                found[index] = (mean, width / abs(each.slope(mean)))
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
    likelihood: ModelLikelihood, theta: FloatArray, index: NDArray[np.intp], prior: Prior
) -> FloatArray:
    """Van Trees bound of one particle of which some parameters have a normal prior.

    Shapes: `theta` (p,), `index` (k,), result (k,).
    """
    parameters = likelihood.parameters
    normal = {k: v for k, v in prior.steps(parameters).items() if k in index}
    points, weights = np.polynomial.hermite_e.hermegauss(NODES)
    average = np.zeros((index.size, index.size))
    for chosen in product(range(NODES), repeat=len(normal)):
        at = np.array(theta, dtype=float)
        weight = 1.0
        for node, (k, (mean, width)) in zip(chosen, normal.items(), strict=True):
            at[k] = mean + width * points[node]
            at[k] = np.clip(at[k], *parameters[k].limits)  # no height lies inside the glass
            weight *= weights[node] / math.sqrt(2 * math.pi)
        average += weight * likelihood.score_fisher(at)[2][np.ix_(index, index)]
    known = np.array([normal[k][1] ** -2 if k in normal else 0.0 for k in index])
    unit = 1 / np.sqrt(np.diag(average) + known)  # so that no unit is much larger than another
    bound: FloatArray = unit * van_trees(average * np.outer(unit, unit), np.diag(known * unit**2))
    means = np.array([normal[k][0] if k in normal else theta[k] for k in index])
    slopes = [parameters[k].slope(float(mean)) for k, mean in zip(index, means, strict=True)]
    return np.asarray(bound * np.abs(slopes))


MAX_R_HAT = 1.01
MIN_ESS = 400.0
MIN_TAUS = 50.0
"""Autocorrelation times that a chain must last."""

EXTENSIONS = 4
"""A chain may grow to this many times its configured length before it is refused."""

_STUDENT_DOF = 5  # of the Student t proposal: heavier tails than any regular posterior
_PROPOSAL_SCALE = 1.2  # its scale over the posterior's


def sample_posterior(
    likelihood: ModelLikelihood,
    fit: FitResult | ModelFit,
    *,
    walkers: int = 32,
    steps: int = 2000,
    seed: int = 0,
    prior: Prior | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> PosteriorResult:
    """Sample the posterior of a fitted particle, of any model."""
    import emcee  # takes a third of a second, and only chains need it

    index, parameters = np.flatnonzero(fit.box.free), likelihood.parameters
    names = [parameters[i].name for i in index]
    physical = index < len(parameters) - 1
    known = {} if prior is None else prior.normal
    normal = {name: known[name] for name in names if name in known}  # what is free can be learned
    prior = Prior(normal)
    proposal = _Proposal.around(likelihood, fit, index, prior)
    lower, upper = fit.box.lower[index], fit.box.upper[index]

    def log_probability(points: FloatArray) -> FloatArray:
        inside = np.all((points >= lower) & (points <= upper), axis=1)
        out = np.full(len(points), -np.inf)
        thetas = np.tile(fit.theta, (int(inside.sum()), 1))
        thetas[:, index] = points[inside]
        out[inside] = likelihood.values(thetas, pictured=True)
        if normal:
            out[inside] += prior.log_density(thetas, parameters)
        return out

    random = np.random.RandomState(np.random.SeedSequence(seed).generate_state(8))
    sampler = emcee.EnsembleSampler(
        walkers,
        index.size,
        log_probability,
        moves=[(emcee.moves.MHMove(proposal), 0.5), (emcee.moves.DEMove(), 0.5)],
        vectorize=True,
    )
    sampler.log_prob_fn = log_probability  # emcee's wrapper prints a traceback on Ctrl-C
    width = upper - lower  # draws of the proposal are reflected into the box
    folded = np.mod(proposal.draw(walkers, random) - lower, 2 * width)
    begun = lower + np.minimum(folded, 2 * width - folded)
    state = emcee.State(begun, random_state=random.get_state())
    for _ in range(EXTENSIONS):
        for latest in sampler.sample(state, iterations=steps):
            if stopped():
                raise CancelledError
            state = latest
        samples, values = _after_burn_in(sampler)
        numbers, complaints = _diagnose(samples)
        if not complaints:
            break
    if normal:  # what is kept is the likelihood
        thetas = np.tile(fit.theta, (values.size, 1))
        thetas[:, index] = samples.reshape(values.size, -1)
        values = values - prior.log_density(thetas, parameters).reshape(values.shape)
    for column, i in enumerate(index):
        samples[..., column] = parameters[i].reported(samples[..., column])
    bound = posterior_bound(likelihood, fit.theta, index, prior)[physical] if normal else None
    # the level of the light, where it is free, says nothing of the particle: it is integrated over
    return PosteriorResult(
        names=tuple(np.array(names)[physical].tolist()),
        samples=samples[..., physical],
        log_likelihood=values,
        **{name: values[physical] for name, values in numbers.items()},
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        converged=not complaints,
        message="; ".join(complaints) or "τ, split R̂ and effective sample sizes are good",
        van_trees=bound,
    )


@dataclass(frozen=True)
class _Proposal:
    """Independent draws from a mixture of Student t distributions; an emcee proposal function."""

    centres: FloatArray  # (modes, d)
    log_weights: FloatArray  # (modes,)
    factor: FloatArray  # (d, d), square root of the scale matrix
    whiten: FloatArray  # (d, d), its inverse

    @classmethod
    def around(
        cls,
        likelihood: ModelLikelihood,
        fit: FitResult | ModelFit,
        index: NDArray[np.intp],
        prior: Prior,
    ) -> _Proposal:
        """Build it from the fit's covariance, its alternative heights and the prior."""
        fisher = likelihood.score_fisher(fit.theta)[2][np.ix_(index, index)]
        steps = prior.steps(likelihood.parameters)
        known = np.diag([steps[k][1] ** -2 if k in steps else 0.0 for k in index])
        wanted = np.array([steps[k][0] if k in steps else 0.0 for k in index])
        fisher = fisher + known
        scale = 1 / np.sqrt(np.maximum(np.diag(fisher), 1e-300))
        values, vectors = np.linalg.eigh(fisher * np.outer(scale, scale))
        widths = 1 / np.sqrt(np.maximum(values, 1e-4))
        factor = _PROPOSAL_SCALE * scale[:, None] * vectors * widths
        centres, gaps = [fit.theta[index]], [0.0]
        for other in fit.alternatives:
            if other.log_likelihood_gap < 15:
                theta = np.array(fit.theta)
                theta[2] = other.z_nm
                if isinstance(likelihood, Likelihood) and likelihood.model.is_sized:
                    theta[3] = other.mass_kda
                centres.append(theta[index])
                gaps.append(other.log_likelihood_gap)
        weights = -np.minimum(gaps, 3.0)
        narrow = factor @ factor.T / _PROPOSAL_SCALE**2  # the covariance
        towards = [centre + narrow @ known @ (wanted - centre) for centre in centres]
        weights = weights - np.logaddexp.reduce(weights)
        return cls(np.array(towards), weights, factor, np.linalg.inv(factor))

    def draw(self, count: int, random: np.random.RandomState) -> FloatArray:
        """Draw points, shape (count, d)."""
        modes = random.choice(len(self.centres), size=count, p=np.exp(self.log_weights))
        normal = random.standard_normal((count, len(self.factor)))
        stretch = np.sqrt(_STUDENT_DOF / random.chisquare(_STUDENT_DOF, count))
        return self.centres[modes] + stretch[:, None] * (normal @ self.factor.T)

    def log_density(self, points: FloatArray) -> FloatArray:
        """Log density of points, shape (n,)."""
        d = len(self.factor)
        apart = (points - self.centres[:, None]) @ self.whiten.T
        squares = np.sum(apart**2, axis=2)
        norm = gammaln((_STUDENT_DOF + d) / 2) - gammaln(_STUDENT_DOF / 2)
        log_t = norm - 0.5 * (_STUDENT_DOF + d) * np.log1p(squares / _STUDENT_DOF)
        density: FloatArray = np.logaddexp.reduce(log_t + self.log_weights[:, None], axis=0)
        return density

    def __call__(
        self, points: FloatArray, random: np.random.RandomState
    ) -> tuple[FloatArray, FloatArray]:
        """Propose for every walker: the new points and ln q(old)/q(new)."""
        fresh = self.draw(len(points), random)
        return fresh, self.log_density(points) - self.log_density(fresh)


def _after_burn_in(sampler: emcee.EnsembleSampler) -> tuple[FloatArray, FloatArray]:
    """Cut off the burn-in: samples (chain, draw, parameter), log-likelihoods (chain, draw)."""
    tau = float(np.max(sampler.get_autocorr_time(tol=0, quiet=True)))
    length = sampler.iteration
    burn_in = min(max(length // 10, math.ceil(5 * tau) if math.isfinite(tau) else 0), length // 2)
    samples = np.moveaxis(sampler.get_chain(discard=burn_in), 0, 1)
    return np.array(samples), np.array(sampler.get_log_prob(discard=burn_in).T)


def _diagnose(samples: FloatArray) -> tuple[dict[str, FloatArray], list[str]]:
    """Give autocorrelation times, R̂ and effective sample sizes, and what is wrong with them."""
    import emcee
    from arviz_stats.base import array_stats  # takes a second, and only chains need it

    draws = samples.shape[1]
    tau = emcee.autocorr.integrated_time(np.moveaxis(samples, 0, 1), tol=0, quiet=True)
    axes = {"chain_axis": 0, "draw_axis": 1}
    r_hat = np.asarray(array_stats.rhat(samples, **axes))
    bulk = np.asarray(array_stats.ess(samples, method="bulk", **axes))
    tail = np.asarray(array_stats.ess(samples, method="tail", prob=(0.05, 0.95), **axes))
    complaints = []
    if not np.all(draws > MIN_TAUS * tau):
        needed = MIN_TAUS * float(tau.max())
        complaints.append(f"{draws} draws are fewer than {MIN_TAUS:.0f} × τ = {needed:.0f}")
    if not np.all(r_hat < MAX_R_HAT):
        complaints.append(f"split R̂ = {r_hat.max():.3f} is not below {MAX_R_HAT}")
    if not (np.all(bulk > MIN_ESS) and np.all(tail > MIN_ESS)):
        complaints.append(
            f"effective sample size {min(bulk.min(), tail.min()):.0f} is not above {MIN_ESS:.0f}"
        )
    return {"tau": tau, "r_hat": r_hat, "ess_bulk": bulk, "ess_tail": tail}, complaints
