"""Repeat an experiment: draw counts, fit them, keep the estimates.

Every trial has a generator of its own, so that the result depends on the seed alone, neither on the
number of threads nor on how the trials are dealt to them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from iscat_analysis.inference.fit import compile_kernels, fit_particle, parts_of
from iscat_analysis.records import BoolArray, FitResult, FloatArray, Status
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
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, stream, trial])))


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
    compile_kernels(setting.context.model, parts_of(setting.free, posteriors=False))

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
