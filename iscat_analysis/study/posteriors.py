"""Are the posteriors right?  Simulation-based calibration on the sampler that the main job uses.

Particles are drawn from a prior, data from the particles, posteriors from the data; the rank of the
truth among a posterior's draws is then uniform, whatever the posterior's shape (S. Talts et al.,
arXiv:1804.06788, 2018).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.inference.fit import compile_kernels, fit_particle, parts_of
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.records import PARAMETERS, BoolArray, Box, FloatArray
from iscat_analysis.study.scores import rank_test
from iscat_analysis.study.setting import Setting
from iscat_analysis.study.trials import trial_generator
from iscat_analysis.threads import threads

RANKS = 100
"""Possible ranks: each posterior is thinned to one draw less."""

WALKERS, STEPS = 32, 300
"""Chains of the study; short, since a rank needs a hundred draws only."""


@dataclass(frozen=True)
class PosteriorRanks:
    """Ranks and credible intervals over draws from the prior."""

    names: tuple[str, ...]
    ranks: NDArray[np.int64]
    width_over_crb: FloatArray
    inside68: BoolArray
    inside95: BoolArray
    refused: int

    @property
    def kept(self) -> BoolArray:
        """Draws with a posterior, shape (n,)."""
        return self.ranks[:, 0] >= 0

    def p_values(self, bins: int = 20) -> dict[str, float]:
        """p-value of uniform ranks for every parameter."""
        kept = self.ranks[self.kept]
        return {n: rank_test(kept[:, i], RANKS, bins)[0] for i, n in enumerate(self.names)}


def calibrate_posterior(
    setting: Setting,
    draws: int,
    *,
    lower: FloatArray,
    upper: FloatArray,
    seed: int,
    stream: int = 0,
    workers: int = 1,
    gain: float = 1.0,
    advance: Callable[[int], None] | None = None,
) -> PosteriorRanks:
    """Draw particles from a flat prior and rank each among the draws of its posterior.

    Shapes: `lower, upper` (4,).
    """
    index = [PARAMETERS.index(name) for name in setting.free]
    k = len(index)
    ranks = np.full((draws, k), -1, dtype=np.int64)
    widths = np.full((draws, k), np.nan)
    inside = np.zeros((2, draws, k), dtype=bool)
    model = setting.context.model
    compile_kernels(model, parts_of(setting.free, posteriors=True))
    amplitudes = [model.scale.amplitude(float(m)) for m in (lower[3], upper[3])]

    def one(i: int) -> bool:
        random = trial_generator(seed, stream, i)
        truth = random.uniform(lower, upper)
        frame = setting.level_e() + setting.signal_e(truth)
        likelihood = setting.likelihood(setting.windows(frame, random, gain=gain))
        start = setting.start(truth, random)
        fit = fit_particle(
            likelihood, start, setting.mode, (float(lower[2]), float(upper[2])), level=setting.level
        )
        prior = Box(
            free=fit.box.free,
            lower=np.array([*lower[:3], min(amplitudes), fit.box.lower[4]]),
            upper=np.array([*upper[:3], max(amplitudes), fit.box.upper[4]]),
        )
        theta = np.where(prior.free, np.clip(fit.theta, prior.lower, prior.upper), fit.theta)
        posterior = sample_posterior(
            likelihood, replace(fit, theta=theta, box=prior),
            walkers=WALKERS, steps=STEPS, seed=int(random.integers(2**31)),
        )  # fmt: skip
        if advance is not None:
            advance(1)
        if not posterior.converged:
            return False
        samples = posterior.samples.reshape(-1, k)
        thinned = samples[np.linspace(0, len(samples) - 1, RANKS - 1).astype(int)]
        ranks[i] = np.sum(thinned < truth[index], axis=0)
        theta = np.array([*truth[:3], model.scale.amplitude(float(truth[3])), 0.0])
        fisher = likelihood.score_fisher(theta)[2][np.ix_(index, index)]
        unit = np.where(np.array(index) == 3, abs(model.scale.slope(theta[3])), 1.0)
        widths[i] = samples.std(axis=0) / (np.sqrt(np.diag(np.linalg.inv(fisher))) * unit)
        for band, (low, high) in enumerate(((15.8655, 84.1345), (2.5, 97.5))):
            ends = np.percentile(samples, [low, high], axis=0)
            inside[band, i] = (ends[0] <= truth[index]) & (truth[index] <= ends[1])
        return True

    with threads(workers) as pool:
        done = list(pool.map(one, range(draws)))
    names = tuple(setting.scored)  # a rank is the same in the diameter as in the mass
    return PosteriorRanks(names, ranks, widths, inside[0], inside[1], draws - sum(done))
