"""From counts to the likelihood of one region, under each noise law.

What to use when
----------------
`conditional`
    Interferometric image after landing, with a background measured on frames before it.  The
    unknown background of every pixel drops out exactly: given b + d counts, d is binomial.
`poisson`
    The background is known, or adds to the signal (dark field).  A measured background adds its own
    variance, and read noise its own, through the shifted Poisson law of Huang et al. (2013).
`gaussian`
    A contrast image, whose noise is normal with a known σ in every pixel.
`asimov_conditional`, `asimov_poisson`
    The same with expected instead of measured counts: the bounds of a planned experiment.
`counts_likelihood`
    The first or the second, as `choose_noise` says of a background that was measured or not.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.camera import smooth_background
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import mask_of, pixels_of
from iscat_analysis.inference.laws import CONDITIONAL, NOISE_LAWS, POISSON, NoiseLaw
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.optics.forward import ForwardModel, PixelGrid
from iscat_analysis.records import BoolArray, FloatArray

KNOWN, MEAN, MEDIAN = 0.0, 1.0, math.pi / 2
"""Variance of a background over that of the mean of its frames."""

_STIFFNESS = 1e3
"""Contrast that would double a variance: 1e-4 of it at 10 %, and sums keep 7 digits."""


def conditional(
    model: ForwardModel,
    grid: PixelGrid,
    before_e: ArrayLike,
    after_e: ArrayLike,
    power_ratio: ArrayLike,
    *,
    read_variances_e2: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
    masked: ArrayLike | None = None,
) -> Likelihood:
    """Binomial likelihood of counts before and after landing.

    Shapes: `before_e, after_e` (ny, nx), `masked` (ny, nx).
    """
    masked = mask_of(masked, grid.shape)
    before = pixels_of("before_e", before_e, grid.shape, masked)
    after = pixels_of("after_e", after_e, grid.shape, masked)
    ratio = pixels_of("power_ratio", power_ratio, grid.shape, masked, scalar=True)
    read_before, read_after = _read_variances(read_variances_e2, grid, masked)
    if not np.any(ratio > 0):
        raise DataError(
            f"power_ratio = {float(ratio.flat[0]):g}: give the light after over that before, a "
            "positive number"
        )
    usable = (before > 0) & (after > 0) & (ratio > 0) & ~masked
    ratio = np.where(usable, ratio, 1.0)
    total, p = before + after, ratio / (1 + ratio)
    shot = total * p * (1 - p)
    read = (1 - p) ** 2 * read_after + p**2 * read_before
    data = np.stack([after, total, ratio, shot / np.where(usable, shot + read, 1.0)])
    data[:, ~usable] = 0.0
    return Likelihood(model, grid, CONDITIONAL, data)


def _read_variances(
    given: tuple[ArrayLike, ArrayLike], grid: PixelGrid, masked: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Check the variances of the read noise of the sums before and after."""
    before, after = (
        pixels_of(f"read_variance_{when}_e2", value, grid.shape, masked, scalar=True, least=0.0)
        for when, value in zip(("before", "after"), given, strict=True)
    )
    return before, after


def poisson(
    model: ForwardModel,
    grid: PixelGrid,
    counts_e: ArrayLike,
    background_e: ArrayLike,
    scale_e: ArrayLike,
    *,
    extra_variance_e2: ArrayLike = 0.0,
    masked: ArrayLike | None = None,
) -> Likelihood:
    """Poisson likelihood with expectation background + scale·signal.

    Shapes: `counts_e` (ny, nx), `masked` (ny, nx).
    """
    masked = mask_of(masked, grid.shape)
    counts = pixels_of("counts_e", counts_e, grid.shape, masked)
    names = "background_e", "scale_e", "extra_variance_e2"
    background, scale, extra = (
        pixels_of(name, value, grid.shape, masked, scalar=True)
        for name, value in zip(names, (background_e, scale_e, extra_variance_e2), strict=True)
    )
    if not np.any(scale > 0):
        raise DataError(
            f"scale_e = {float(scale.flat[0]):g}: give the photoelectrons for unit signal, a "
            "positive number"
        )
    data = np.stack([counts + extra, background, scale, extra])
    data[:, masked | (scale <= 0)] = 0.0
    return Likelihood(model, grid, POISSON, data)


def gaussian(
    model: ForwardModel,
    grid: PixelGrid,
    contrast: ArrayLike,
    sigma: ArrayLike,
    *,
    masked: ArrayLike | None = None,
) -> Likelihood:
    """Make the normal likelihood of contrasts of known standard deviations.

    Notes
    -----
    The shifted Poisson law with so much extra variance that it is normal.  A contrast s changes the
    variance by the share s/`_STIFFNESS`.

    Shapes: `contrast, sigma` (ny, nx), `masked` (ny, nx).
    """
    masked = mask_of(masked, grid.shape)
    seen = pixels_of("contrast", contrast, grid.shape, masked)
    spread = pixels_of("sigma", sigma, grid.shape, masked, scalar=True)
    used = ~masked & (spread > 0)
    light = _STIFFNESS / np.where(used, spread, 1.0) ** 2
    data = np.stack([light * (_STIFFNESS + seen), light, light, light * (_STIFFNESS - 1)])
    data[:, ~used] = 0.0
    return Likelihood(model, grid, POISSON, data)


def asimov_conditional(
    model: ForwardModel,
    grid: PixelGrid,
    theta: FloatArray,
    background_e: FloatArray | float,
    n_before: int,
    n_after: int,
    *,
    read_variance_e2: FloatArray | float = 0.0,
) -> Likelihood:
    """Conditional likelihood of the expected counts; its Fisher matrix is the bound's.

    Shapes: `theta` (5,).
    """
    signal = model.amplitude_image(grid, *(float(value) for value in theta[:4]))
    before = np.broadcast_to(n_before * np.asarray(background_e, dtype=float), grid.shape)
    after = n_after * np.asarray(background_e) * (1 + signal)
    exact = conditional(model, grid, before, after, n_after / n_before)
    p = after / (before + after)
    shot = (before + after) * p * (1 - p)
    read = ((1 - p) ** 2 * n_after + p**2 * n_before) * read_variance_e2
    exact.data[3] *= shot / (shot + read)
    return exact


def asimov_poisson(
    model: ForwardModel,
    grid: PixelGrid,
    theta: FloatArray,
    background_e: FloatArray | float,
    scale_e: FloatArray | float,
    *,
    extra_variance_e2: FloatArray | float = 0.0,
) -> Likelihood:
    """Poisson likelihood of the expected counts; its Fisher matrix is the bound's.

    Shapes: `theta` (5,).
    """
    signal = model.amplitude_image(grid, *(float(value) for value in theta[:4]))
    counts = background_e + scale_e * signal
    return poisson(model, grid, counts, background_e, scale_e, extra_variance_e2=extra_variance_e2)


def choose_noise(name: str, *, interferes: bool, counted: bool) -> NoiseLaw:
    """Choose a noise law by its name, or with ``"auto"`` by the kind of background.

    The conditional law is for light that interferes with a background whose frames were counted.
    """
    if name == "auto":
        return CONDITIONAL if interferes and counted else POISSON
    if name not in NOISE_LAWS:
        raise ConfigError(f"noise = {name!r}: give one of {', '.join(NOISE_LAWS)}")
    return NOISE_LAWS[name]


def counts_likelihood(
    model: ForwardModel,
    grid: PixelGrid,
    before_e: ArrayLike,
    after_e: ArrayLike,
    power_ratio: float,
    *,
    background: float,
    noise: NoiseLaw,
    scale_e: float | None = None,
    others: FloatArray | None = None,
    read_variances_e2: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
    masked: BoolArray | None = None,
) -> Likelihood:
    """Likelihood of a region's counts.

    Shapes: `before_e, after_e` (ny, nx), `others` (ny, nx), `masked` (ny, nx).
    """
    signal = np.zeros(grid.shape) if others is None else others
    if noise == CONDITIONAL:
        counts = before_e, after_e, power_ratio * (1 + signal)
        return conditional(model, grid, *counts, read_variances_e2=read_variances_e2, masked=masked)
    masked = mask_of(masked, grid.shape)
    before = pixels_of("before_e", before_e, grid.shape, masked, scalar=True)
    read_before, read_after = _read_variances(read_variances_e2, grid, masked)
    steady = smooth_background(before, read_before, masked) if background else before
    # The expected variance is that of the smooth background; the excess is that over the own one.
    extra = read_after + power_ratio**2 * (background * steady + read_before)
    extra = extra + power_ratio * (steady - before)
    level = scale = power_ratio * before * (1 + signal)
    if scale_e is not None:
        level, scale = power_ratio * before + scale_e * signal, np.asarray(scale_e)
    return poisson(model, grid, after_e, level, scale, extra_variance_e2=extra, masked=masked)
