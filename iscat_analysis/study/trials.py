"""Repeat an experiment: draw counts, fit them, keep the estimates.

Every trial has a generator of its own, so that the result depends on the seed alone, neither on the
number of threads nor on how the trials are dealt to them.

Posteriors are judged by simulation-based calibration on the sampler that the main job uses:
particles are drawn from a prior, data from the particles, posteriors from the data; the rank of the
truth among a posterior's draws is then uniform, whatever the posterior's shape (S. Talts et al.,
arXiv:1804.06788, 2018).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.inference.fit import compile_kernels, fit_particle
from iscat_analysis.inference.posterior import sample_posterior
from iscat_analysis.records import PARAMETERS, BoolArray, Box, FitResult, FloatArray, Status
from iscat_analysis.study.scores import rank_test
from iscat_analysis.study.setting import Setting
from iscat_analysis.threads import threads


@dataclass(frozen=True)
class Trials:
    """Estimates of repeated experiments: x, y, z and mass, or in mode `size` the diameter.

    Shapes: `start` (n, 4) [nm, kDa]; `counts_e` (2, n, y, x) before and after, where kept.
    """

    truth: FloatArray
    estimate: FloatArray
    sigma: FloatArray
    flags: tuple[frozenset[str], ...]
    p_value: FloatArray
    seconds: float
    start: FloatArray
    counts_e: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def failed(self) -> BoolArray:
        """Fits without a usable estimate: not converged or at a bound, shape (n,)."""
        return self.flagged(Status.NOT_CONVERGED) | self.flagged(Status.AT_BOUND)

    @property
    def usable(self) -> BoolArray:
        """Fits that a user would keep: neither failed nor ambiguous, shape (n,)."""
        return ~self.failed & ~self.ambiguous

    @property
    def ambiguous(self) -> BoolArray:
        """Fits of which another height or diameter is likely, shape (n,)."""
        return self.flagged(Status.AMBIGUOUS_Z) | self.flagged(Status.AMBIGUOUS_SIZE)

    @property
    def unflagged(self) -> BoolArray:
        """Fits with nothing to remark, shape (n,)."""
        return np.array([not f for f in self.flags])

    def flagged(self, status: Status) -> BoolArray:
        """Which fits carry a flag, shape (n,)."""
        return np.array([status in f for f in self.flags])


def trial_generator(seed: int, stream: int, trial: int) -> np.random.Generator:
    """Random numbers of one trial."""
    return np.random.default_rng([seed, stream, trial])


def run_trials(
    setting: Setting,
    count: int,
    *,
    seed: int,
    stream: int = 0,
    workers: int = 1,
    truths: FloatArray | None = None,
    keep_counts: bool = False,
    correct_bias: bool = True,
    advance: Callable[[int], None] | None = None,
) -> Trials:
    """Draw and fit.

    Shapes: `truths` (count, 4).
    """
    truth = np.tile(setting.truth, (count, 1)) if truths is None else np.array(truths, dtype=float)
    begin = np.empty((count, 4))
    counts = np.empty((2, count, setting.pixels, setting.pixels)) if keep_counts else None
    compile_kernels(setting.context.model, heights="z_nm" in setting.free)

    def work(i: int) -> tuple[FitResult, float]:
        random = trial_generator(seed, stream, i)
        windows = setting.draw(truth[i], random)
        likelihood, start = setting.likelihood(windows), setting.start(truth[i], random)
        begun = time.thread_time()
        fit = fit_particle(
            likelihood, start, setting.mode, setting.config.fit.z_range_nm,
            level=setting.level, correct_bias=correct_bias,
        )  # fmt: skip
        spent = time.thread_time() - begun
        place = np.array([start.x_px, start.y_px]) * setting.context.pixel_nm
        begin[i] = *place, start.z_nm, start.mass_kda
        if counts is not None:
            counts[:, i] = windows.before_e, windows.after_e
        if advance is not None:
            advance(1)
        return fit, spent

    with threads(workers) as pool:
        fits, seconds = zip(*pool.map(work, range(count)), strict=True)
    found = np.array([(fit.x_nm, fit.y_nm, fit.z_nm, fit.mass_kda) for fit in fits])
    estimate, sigma = setting.in_diameters(found, np.array([fit.sigma for fit in fits]))
    truth, _ = setting.in_diameters(truth, sigma)
    return Trials(
        truth=truth,
        estimate=estimate,
        sigma=sigma,
        flags=tuple(frozenset(str(flag) for flag in fit.flags) for fit in fits),
        p_value=np.array([fit.p_value for fit in fits]),
        seconds=sum(seconds),
        start=begin,
        counts_e=counts,
    )


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
    compile_kernels(model, heights="z_nm" in setting.free, posteriors=True)
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
