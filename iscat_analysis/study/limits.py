"""Bounds of each of many particles: what their estimates are measured by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from iscat_analysis.bounds import Experiment, event_bounds, holevo_over_quantum
from iscat_analysis.bounds.detection import detection_limit
from iscat_analysis.bounds.experiment import expected_likelihood
from iscat_analysis.optics.collected import collected_area_nm2, photons_per_intensity
from iscat_analysis.records import PARAMETERS, FloatArray

MOST_BOUNDS = 64
"""Bounds that are computed for particles that are nearly alike."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Bounds of n particles over d free parameters, in their order [nm, kDa].

    Shapes: `covariance` (n, d, d), `qcrb, holevo` (n, d), `snr, collected` (n,).
    """

    free: tuple[str, ...]
    covariance: FloatArray
    qcrb: FloatArray
    holevo: FloatArray
    snr: FloatArray
    collected: FloatArray

    @property
    def crb(self) -> FloatArray:
        """Joint Cramér–Rao bounds, shape (n, d)."""
        variance: FloatArray = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.sqrt(variance)

    def __len__(self) -> int:
        return len(self.covariance)

    def for_rows(self, rows: Sequence[int]) -> Limits:
        """Take the bounds of some particles, any of them more than once."""
        return Limits(
            self.free, self.covariance[rows], self.qcrb[rows], self.holevo[rows], self.snr[rows],
            self.collected[rows],
        )  # fmt: skip


def limits_at(
    experiment: Experiment,
    free: tuple[str, ...],
    truths: FloatArray,
    *,
    frames: Sequence[tuple[int, int]] | None = None,
    level: bool = False,
) -> Limits:
    """Give the bounds of particles at their true places, heights and masses.

    Shapes: `truths` (n, 4); `frames` before and after, for each.
    """
    at = experiment.config.bounds
    found = [
        _one(experiment, free, truth, pair, level=level)
        for truth, pair in zip(
            truths, frames or [(at.n_before, at.n_after)] * len(truths), strict=True
        )
    ]
    covariance, qcrb, holevo, snr, collected = (np.array(part) for part in zip(*found, strict=True))
    return Limits(free, covariance, qcrb, holevo, snr, collected)


def limits_of_alike(
    experiment: Experiment, free: tuple[str, ...], truths: FloatArray, *, level: bool = False
) -> Limits:
    """Give particles that are nearly alike their common bounds, from some of them.

    Shapes: `truths` (n, 4).
    """
    few = limits_at(experiment, free, truths[:MOST_BOUNDS], level=level)
    n = len(truths)
    squared = (np.sqrt(np.mean(part**2, axis=0)) for part in (few.qcrb, few.holevo))
    qcrb, holevo = (np.tile(part, (n, 1)) for part in squared)
    return Limits(
        free, np.tile(few.covariance.mean(axis=0), (n, 1, 1)), qcrb, holevo,
        np.full(n, few.snr.mean()), np.full(n, few.collected.mean()),
    )  # fmt: skip


def _one(
    experiment: Experiment,
    free: tuple[str, ...],
    truth: FloatArray,
    frames: tuple[int, int],
    *,
    level: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, float, float]:
    config, model, grid = experiment.config, experiment.model, experiment.grid
    x, y, z, mass = (float(v) for v in truth)
    photons, (n_before, n_after) = config.bounds.photons_per_pixel, frames
    if model.rho:
        background, per_frame = photons, photons
    else:
        background = config.background.level_e or 0.0
        per_frame = photons_per_intensity(model, photons, grid.pixel_nm)
    theta = np.array([x, y, z, model.scale.amplitude(mass), 0.0])
    read = config.camera.assumed.read_noise_e
    likelihood = expected_likelihood(
        model, grid, theta, background, per_frame, n_before=n_before, n_after=n_after,
        read_noise_e=0.0 if isinstance(read, str) else read,
    )  # fmt: skip
    collected = n_after * per_frame * collected_area_nm2(model, z, mass) / grid.pixel_nm**2
    bounds = event_bounds(likelihood, theta, free, collected, level=level)
    index = [PARAMETERS.index(name) for name in free]
    covariance = np.full((len(free), len(free)), np.nan)
    if np.all(np.isfinite(bounds.crb_joint[index])):
        scale = bounds.crb_single[index]
        scaled = bounds.fisher[np.ix_(index, index)] * np.outer(scale, scale)
        covariance = np.linalg.inv(scaled) * np.outer(scale, scale)
    qcrb = bounds.qcrb[index]
    cost = np.full(len(free), np.nan)
    if not model.is_measured:
        together = holevo_over_quantum(model, max(z, 0.0), free)
        cost = np.array([together[name] for name in free])
    fisher = likelihood.score_fisher(theta)[2]
    return covariance, qcrb, qcrb * cost, abs(theta[3]) * math.sqrt(fisher[3, 3]), collected


def detection_snr(experiment: Experiment, mass_kda: FloatArray) -> FloatArray:
    """Give the signal-to-noise ratio of the matched filter, which no test of one place beats.

    NaN in dark field, where the image is no linear function of the amplitude.

    Shapes: `mass_kda` (n,).
    """
    limit = detection_limit(experiment)
    amplitude = np.array([experiment.model.scale.amplitude(float(m)) for m in mass_kda])
    per_amplitude = limit.snr_per_amplitude if limit is not None else math.nan
    return np.asarray(np.abs(amplitude) * per_amplitude)
