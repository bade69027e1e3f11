"""The likelihood of a region, and the choice of its noise model."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.camera import smooth_background
from iscat_analysis.inference.checks import BoolArray, FloatArray, mask_of, pixels_of
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.inference.noise import conditional, poisson
from iscat_analysis.inference.noise_models import CONDITIONAL, NOISE_MODELS, POISSON, NoiseModel
from iscat_analysis.optics.forward import ForwardModel, PixelGrid

KNOWN, MEAN, MEDIAN = 0.0, 1.0, math.pi / 2
"""Variance of a background over that of the mean of its frames."""


def choose_noise(wanted: str, *, interferes: bool, counted: bool) -> NoiseModel:
    """Choose a noise model by its name, or with ``"auto"`` by the kind of background.

    The conditional model is for light that interferes with a background whose frames were counted.
    """
    if wanted != "auto":
        return NOISE_MODELS[wanted]
    return CONDITIONAL if interferes and counted else POISSON


def counts_likelihood(
    model: ForwardModel,
    grid: PixelGrid,
    before_e: ArrayLike,
    after_e: ArrayLike,
    power_ratio: float,
    *,
    background: float,
    noise: NoiseModel,
    scale_e: float | None = None,
    others: FloatArray | None = None,
    read_variance_before_e2: ArrayLike = 0.0,
    read_variance_after_e2: ArrayLike = 0.0,
    masked: BoolArray | None = None,
) -> Likelihood:
    """Likelihood of a region's counts.

    Shapes: `before_e, after_e` (ny, nx), `others` (ny, nx), `masked` (ny, nx).
    """
    signal = np.zeros(grid.shape) if others is None else others
    if noise == CONDITIONAL:
        return conditional(
            model, grid, before_e, after_e, power_ratio * (1 + signal),
            read_variance_before_e2=read_variance_before_e2,
            read_variance_after_e2=read_variance_after_e2,
            masked=masked,
        )  # fmt: skip
    masked = mask_of("masked", masked, grid.shape)
    before = pixels_of("before_e", before_e, grid.shape, masked, scalar=True)
    read_before, read_after = (
        pixels_of(name, value, grid.shape, masked, scalar=True, least=0.0)
        for name, value in (
            ("read_variance_before_e2", read_variance_before_e2),
            ("read_variance_after_e2", read_variance_after_e2),
        )
    )
    steady = smooth_background(before, read_before, masked) if background else before
    # The expected variance is that of the smooth background; the excess is that over the own one.
    extra = read_after + power_ratio**2 * (background * steady + read_before)
    extra = extra + power_ratio * (steady - before)
    level = power_ratio * before
    if scale_e is not None:
        return poisson(
            model, grid, after_e, level + scale_e * signal, scale_e,
            extra_variance_e2=extra, masked=masked,
        )  # fmt: skip
    level = level * (1 + signal)
    return poisson(model, grid, after_e, level, level, extra_variance_e2=extra, masked=masked)
