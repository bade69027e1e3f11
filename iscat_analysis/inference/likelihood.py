"""The noise models: log-likelihood, score, Fisher and observed information of one region.

What to use when
----------------
`conditional`
    Interferometric image after landing, with a background measured on frames before it.  The
    unknown background of every pixel drops out exactly: given b + d counts, d is binomial.
`poisson`
    The background is known, or adds to the signal (dark field).  A measured background adds its own
    variance, and read noise its own, through the shifted Poisson law of Huang et al. (2013).
`asimov_conditional`, `asimov_poisson`
    The same with expected instead of measured counts: the bounds of a planned experiment.

Parameters are always θ = (x [nm], y [nm], z [nm], a, g): a the model's amplitude (the mass in kDa
unless a calibration is given), g the logarithm of a common level, normally fixed at 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.image import Lens, Pixels
from iscat_analysis._kernels.radial import AxialTable
from iscat_analysis._kernels.scoring import (
    CONDITIONAL,
    CONVERGED,
    POISSON,
    maximize,
    scan_heights,
    score_pass,
    value_batch,
)
from iscat_analysis.optics.forward import ForwardModel, PixelGrid

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

LEVEL = 4
"""Index of the level in θ."""


@dataclass(frozen=True)
class Optimum:
    """Where a maximisation ended.

    Attributes
    ----------
    theta : ndarray, shape (5,)
        Estimate.
    log_likelihood : float
        There.
    passes : int
        Passes over the data.
    converged : bool
        Whether the remaining step is negligible.
    fisher : ndarray, shape (5, 5)
        Expected information one step before.
    """

    theta: FloatArray
    log_likelihood: float
    passes: int
    converged: bool
    fisher: FloatArray


@dataclass(frozen=True)
class Likelihood:
    """One region's counts under one noise model; build it with the functions of this module.

    Attributes
    ----------
    model : ForwardModel
        Gives the signal.
    grid : PixelGrid
        The region's pixels.
    kind : int
        CONDITIONAL or POISSON.
    data : ndarray, shape (4, ny, nx)
        Per-pixel constants; see `iscat_analysis._kernels.scoring`.  A masked pixel holds zeros.
    """

    model: ForwardModel
    grid: PixelGrid
    kind: int
    data: FloatArray

    @property
    def n_pixels(self) -> int:
        """Pixels that are not masked."""
        return int(np.count_nonzero(self._used))

    @property
    def _used(self) -> BoolArray:
        column = 3 if self.kind == CONDITIONAL else 2
        used: BoolArray = self.data[column] > 0
        return used

    def values(self, thetas: FloatArray) -> FloatArray:
        """Log-likelihood at many parameter vectors.

        Parameters
        ----------
        thetas : ndarray, shape (n, 5)
            Parameters.

        Returns
        -------
        ndarray, shape (n,)
            Relative to no particle.
        """
        out = np.empty(len(thetas))
        value_batch(*self._arguments, np.ascontiguousarray(thetas), out)
        return out

    def score_fisher(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Log-likelihood, its gradient and the expected information.

        Parameters
        ----------
        theta : ndarray, shape (5,)
            Parameters.

        Returns
        -------
        value : float
            Log-likelihood.
        score : ndarray, shape (5,)
            Gradient.
        fisher : ndarray, shape (5, 5)
            Fisher information (physics.md, section 4).
        """
        score, fisher = np.empty(5), np.empty((5, 5))
        value = score_pass(
            self.model.profile(theta[2]), *self._arguments[1:],
            np.ascontiguousarray(theta, dtype=float), score, fisher,
        )  # fmt: skip
        return value, score, fisher

    def maximize(
        self,
        start: FloatArray,
        free: BoolArray,
        lower: FloatArray,
        upper: FloatArray,
        *,
        tolerance: float = 2e-4,
        passes: int = 60,
    ) -> Optimum:
        """Maximise by damped Fisher scoring inside a box.

        Parameters
        ----------
        start, lower, upper : ndarray, shape (5,)
            Start and box.
        free : ndarray of bool, shape (5,)
            Which parameters move.
        tolerance : float
            Expected gain in log-likelihood of the last step taken; 2e-4 is a step of 0.02 standard
            deviations, after which less than 0.005 remain.
        passes : int
            Passes over the data at most.

        Returns
        -------
        Optimum
            The estimate.
        """
        theta = np.array(start, dtype=float)
        score, fisher = np.empty(5), np.empty((5, 5))
        wavelength = self.model.optics.wavelength_nm
        max_step = np.array([0.25 * wavelength, 0.25 * wavelength, 0.1 * wavelength, np.inf, 1.0])
        value, used, outcome = maximize(
            *self._arguments, free, lower, upper, max_step, tolerance, passes, theta, score, fisher
        )
        return Optimum(theta, value, used, outcome == CONVERGED, fisher)

    def scan_heights(
        self, heights: FloatArray, theta: FloatArray, amplitude_range: tuple[float, float] | None
    ) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood along z at fixed x, y, with the amplitude refitted at each height.

        Parameters
        ----------
        heights : ndarray, shape (n,)
            Heights [nm].
        theta : ndarray, shape (5,)
            The other parameters, and the amplitude to start from.
        amplitude_range : (float, float) or None
            Bounds of the amplitude; None holds it fixed.

        Returns
        -------
        values, amplitudes : ndarray, shape (n,)
            Log-likelihood and amplitude at each height.
        """
        values, amplitudes = np.empty(heights.size), np.empty(heights.size)
        scan_heights(
            *self._arguments, np.ascontiguousarray(heights, dtype=float),
            amplitude_range or (0.0, 0.0), np.ascontiguousarray(theta, dtype=float),
            values, amplitudes,
        )  # fmt: skip
        return values, amplitudes

    def observed_information(self, theta: FloatArray) -> FloatArray:
        """Negative Hessian of the log-likelihood.

        Parameters
        ----------
        theta : ndarray, shape (5,)
            Parameters.

        Returns
        -------
        ndarray, shape (5, 5)
            Observed information.
        """
        s, first, second = self.model.amplitude_hessian(self.grid, *theta[:4])
        level = np.exp(theta[LEVEL])
        used = self._used
        c0, c1, c2, c3 = (np.where(used, c, 0.0) for c in self.data)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == CONDITIONAL:
                q = c2 * level * (1 + s)
                p = q / (1 + q)
                slope = c3 * (c0 - c1 * p) / (1 + s)
                bend = c3 * (-c0 / (1 + s) ** 2 + c1 * (p / (1 + s)) ** 2)
                level_bend = -c3 * c1 * p * (1 - p)
                cross = level_bend / (1 + s)
            else:
                expected = level * (c1 + c2 * s)
                rate, gain = expected + c3, level * c2
                slope = gain * (c0 / rate - 1)
                bend = -(gain**2) * c0 / rate**2
                level_bend = expected * (c0 / rate - 1) - (expected / rate) ** 2 * c0
                cross = slope - expected * gain * c0 / rate**2
        slope, bend, level_bend, cross = (
            np.where(used, t, 0.0) for t in (slope, bend, level_bend, cross)
        )
        info = np.empty((5, 5))
        info[:4, :4] = -np.einsum("yx,ijyx->ij", slope, second)
        info[:4, :4] -= np.einsum("yx,iyx,jyx->ij", bend, first, first)
        info[LEVEL, :4] = info[:4, LEVEL] = -np.einsum("yx,iyx->i", cross, first)
        info[LEVEL, LEVEL] = -level_bend.sum()
        return info

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Give data minus model in standard deviations.

        Parameters
        ----------
        theta : ndarray, shape (5,)
            Parameters.

        Returns
        -------
        ndarray, shape (ny, nx)
            Pearson residuals, NaN where masked.
        """
        s = self.signal(theta)
        level = np.exp(theta[LEVEL])
        c0, c1, c2, c3 = self.data
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == CONDITIONAL:
                q = c2 * level * (1 + s)
                p = q / (1 + q)
                out = (c0 - c1 * p) / np.sqrt(c1 * p * (1 - p) / c3)
            else:
                rate = level * (c1 + c2 * s) + c3
                out = (c0 - rate) / np.sqrt(rate)
        return np.where(self._used, out, np.nan)

    def signal(self, theta: FloatArray) -> FloatArray:
        """Signal of the model at θ, shape (ny, nx)."""
        return _signal(self.model, self.grid, theta)

    def measured_signal(self) -> FloatArray:
        """Signal that the counts show, shape (ny, nx); NaN where masked."""
        c0, c1, c2, c3 = self.data
        with np.errstate(divide="ignore", invalid="ignore"):
            conditional = self.kind == CONDITIONAL
            out = c0 / ((c1 - c0) * c2) - 1 if conditional else (c0 - c3 - c1) / c2
        return np.where(self._used, out, np.nan)

    def signal_information(self, signal: FloatArray | None = None) -> FloatArray:
        """Fisher information of each pixel about its own signal.

        Parameters
        ----------
        signal : ndarray, shape (ny, nx), optional
            Where it is evaluated; without it, at no particle.

        Returns
        -------
        ndarray, shape (ny, nx)
            Inverse variance of `measured_signal`; 0 where masked.
        """
        s = np.zeros(self.grid.shape) if signal is None else signal
        _, c1, c2, c3 = self.data
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == CONDITIONAL:
                p = c2 * (1 + s) / (1 + c2 * (1 + s))
                out = c3 * c1 * p * (1 - p) / (1 + s) ** 2
            else:
                out = c2**2 / np.maximum(c1 + c2 * s + c3, 1.0)
        return np.where(self._used, out, 0.0)

    @property
    def _arguments(self) -> tuple[AxialTable, Lens, Pixels, int, FloatArray]:
        """What every scoring kernel takes first."""
        model = self.model
        return model.axial_table, model.lens, model.pixels(self.grid), self.kind, self.data


def conditional(
    model: ForwardModel,
    grid: PixelGrid,
    before_e: FloatArray,
    after_e: FloatArray,
    power_ratio: FloatArray | float,
    *,
    read_variance_before_e2: FloatArray | float = 0.0,
    read_variance_after_e2: FloatArray | float = 0.0,
    masked: BoolArray | None = None,
) -> Likelihood:
    """Binomial likelihood of counts before and after landing.

    Parameters
    ----------
    model : ForwardModel
        Gives the contrast.
    grid : PixelGrid
        The pixels.
    before_e, after_e : ndarray, shape (ny, nx)
        Photoelectrons summed before and after.
    power_ratio : ndarray or float
        ρ; as an array it may carry the contrast of neighbouring particles as a factor 1 + C.
    read_variance_before_e2, read_variance_after_e2 : ndarray or float
        Read-noise variance of the sums [e²]; it lowers each pixel's weight by the share it takes
        of the variance of d − np.
    masked : ndarray of bool, shape (ny, nx), optional
        Pixels to leave out.

    Returns
    -------
    Likelihood
        Of kind CONDITIONAL.
    """
    data = np.zeros((4, *grid.shape))
    total = before_e + after_e
    p = np.broadcast_to(np.asarray(power_ratio / (1 + power_ratio)), grid.shape)
    shot = total * p * (1 - p)
    read = (1 - p) ** 2 * read_variance_after_e2 + p**2 * read_variance_before_e2
    usable = (before_e > 0) & (after_e > 0)
    if masked is not None:
        usable &= ~masked
    data[0], data[1], data[2] = after_e, total, power_ratio
    data[3] = shot / np.where(usable, shot + read, 1.0)
    data[:, ~usable] = 0.0
    return Likelihood(model, grid, CONDITIONAL, data)


def poisson(
    model: ForwardModel,
    grid: PixelGrid,
    counts_e: FloatArray,
    background_e: FloatArray | float,
    scale_e: FloatArray | float,
    *,
    extra_variance_e2: FloatArray | float = 0.0,
    masked: BoolArray | None = None,
) -> Likelihood:
    """Poisson likelihood with expectation background + scale·signal.

    Parameters
    ----------
    model : ForwardModel
        Gives the signal.
    grid : PixelGrid
        The pixels.
    counts_e : ndarray, shape (ny, nx)
        Photoelectrons.
    background_e : ndarray or float
        Expected without the particle [e].
    scale_e : ndarray or float
        Photoelectrons for unit signal: the background itself in the interferometric schemes, N·s
        in dark field.
    extra_variance_e2 : ndarray or float
        Read noise and the variance of a measured background [e²].
    masked : ndarray of bool, shape (ny, nx), optional
        Pixels to leave out.

    Returns
    -------
    Likelihood
        Of kind POISSON.
    """
    data = np.zeros((4, *grid.shape))
    data[0] = np.maximum(counts_e + extra_variance_e2, 0.0)
    data[1], data[2], data[3] = background_e, scale_e, extra_variance_e2
    if masked is not None:
        data[:, masked] = 0.0
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

    Parameters
    ----------
    model : ForwardModel
        Gives the contrast.
    grid : PixelGrid
        The pixels.
    theta : ndarray, shape (5,)
        Truth.
    background_e : ndarray or float
        Expected background per frame [e].
    n_before, n_after : int
        Frames.
    read_variance_e2 : ndarray or float
        Read-noise variance per frame [e²].

    Returns
    -------
    Likelihood
        Of kind CONDITIONAL, with the read-noise weight taken at the truth.
    """
    signal = _signal(model, grid, theta)
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

    Parameters
    ----------
    model : ForwardModel
        Gives the signal.
    grid : PixelGrid
        The pixels.
    theta : ndarray, shape (5,)
        Truth.
    background_e, scale_e, extra_variance_e2 : ndarray or float
        As in `poisson`, summed over the frames.

    Returns
    -------
    Likelihood
        Of kind POISSON.
    """
    signal = _signal(model, grid, theta)
    counts = background_e + scale_e * signal
    return poisson(model, grid, counts, background_e, scale_e, extra_variance_e2=extra_variance_e2)


def compile_kernels(model: ForwardModel) -> None:
    """Run every kernel once on a few pixels, so that later calls find them compiled.

    Parameters
    ----------
    model : ForwardModel
        Any.
    """
    grid = PixelGrid.region((0, 3), (0, 3), 10.0)
    theta = np.array([10.0, 10.0, model.height_nm, 1.0, 0.0])
    counts = np.full(grid.shape, 100.0)
    likelihood = poisson(model, grid, counts, counts, counts)
    free = np.array([True, True, True, True, False])
    likelihood.maximize(theta, free, theta - 1, theta + 1, passes=2)
    likelihood.values(theta[None])
    likelihood.score_fisher(theta)
    likelihood.observed_information(theta)
    likelihood.signal(theta)
    likelihood.scan_heights(theta[2:3], theta, None)
    model.gradient(grid, *theta[:4])


def _signal(model: ForwardModel, grid: PixelGrid, theta: FloatArray) -> FloatArray:
    x, y, z, amplitude = (float(value) for value in theta[:4])
    return model.image(grid, x, y, z, float(model.scale.mass(np.asarray(amplitude))))
