"""The likelihood of one region: value, score, Fisher and observed information, maximum.

`iscat_analysis.inference.counts` makes it of counts.

θ has the parameters of the particle model in their order, and then g, the logarithm of a common
level, normally fixed at 0.  `ModelLikelihood` is that of any particle; `Likelihood` is that of
`ForwardModel`, with θ = (x [nm], y [nm], z [nm], a, g), a the model's amplitude (the mass in kDa
unless a calibration is given), and of dipoles the compiled kernels know all of it.  With a prior of
the height, each of its values is of likelihood × prior.

The model is known for heights in its `z_range_nm` and where no pixel is farther from the particle
than its `reach_nm`.  Outside this support, and where a parameter is not a finite number, a
log-likelihood is −∞ and what has no limit there is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from iscat_analysis._kernels.lens import Lens, Pixels
from iscat_analysis._kernels.noise import Measured
from iscat_analysis._kernels.radial import AxialTable
from iscat_analysis._kernels.scoring import (
    CONVERGED,
    add_prior,
    box_supported,
    maximize,
    scan_heights,
    score_pass,
    supported,
    value_batch,
)
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.inference.checks import vector_of
from iscat_analysis.inference.heights import HeightPrior
from iscat_analysis.inference.laws import NOISE_LAWS, NoiseLaw
from iscat_analysis.inference.maximiser import PASSES, TOLERANCE, Optimum, maximise
from iscat_analysis.inference.models import ParticleModel
from iscat_analysis.optics.model import ForwardModel, Parameter
from iscat_analysis.optics.pixels import PixelGrid, margin_nm
from iscat_analysis.records import BoolArray, Box, FloatArray

LEVEL = 4
"""Index of the level in the θ of a `Likelihood`."""

LARGEST_LEVEL = 50.0
"""Logarithm of the level beyond which no light is meant, and counts would overflow."""

_LEVEL = Parameter("log_level", limits=(-LARGEST_LEVEL, LARGEST_LEVEL), step=1.0)


@dataclass(frozen=True)
class ModelLikelihood:
    """One region's counts under one noise law, of any particle model."""

    model: ParticleModel
    grid: PixelGrid
    noise: NoiseLaw
    data: FloatArray

    def __post_init__(self) -> None:
        if not isinstance(self.noise, NoiseLaw) or NOISE_LAWS.get(self.noise.name) != self.noise:
            raise ConfigError(f"noise = {self.noise!r}: give one of `NOISE_LAWS`")
        ready = isinstance(self.data, np.ndarray) and self.data.dtype == np.float64
        if not ready or self.data.shape != (4, *self.grid.shape):
            raise DataError(
                f"data: has shape {np.shape(self.data)}, the grid needs {(4, *self.grid.shape)} of "
                "64-bit floats; build it with `conditional` or `poisson`"
            )
        if not self.data.flags.c_contiguous:
            object.__setattr__(self, "data", np.ascontiguousarray(self.data))
        if not np.all(np.isfinite(self.data)):
            raise DataError("data: holds values that are not finite; mask those pixels")

    def under(self, model: ParticleModel) -> ModelLikelihood:
        """Likelihood of the same counts under another particle model."""
        return ModelLikelihood(model, self.grid, self.noise, self.data)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """What θ consists of."""
        return (*self.model.parameters, _LEVEL)

    @property
    def n_pixels(self) -> int:
        """Pixels that are not masked."""
        return int(np.count_nonzero(self.used))

    @property
    def used(self) -> BoolArray:
        """Which pixels are not masked, shape (ny, nx)."""
        return self.noise.used(self.data)

    def values(self, thetas: FloatArray, *, pictured: bool = False) -> FloatArray:
        """Log-likelihood at many parameter vectors.

        Where `pictured`, images at the model's height come from a table of them, whatever their
        pixels, if the particle is a dipole; it is as right as the images of fits.

        Shapes: `thetas` (n, p), result (n,).
        """
        del pictured
        points = vector_of("thetas", thetas, (-1, len(self.parameters)))
        return np.array([self.score_fisher(point)[0] for point in points])

    def supports(self, thetas: FloatArray) -> BoolArray:
        """Tell where the model is known.

        Shapes: `thetas` (n, p), result (n,).
        """
        low, high = np.array([each.limits for each in self.parameters]).T
        return np.asarray((np.isfinite(thetas) & (thetas >= low) & (thetas <= high)).all(axis=1))

    def score_fisher(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Log-likelihood, its gradient and the expected information.

        Shapes: `theta` (p,), `score` (p,), `fisher` (p, p).
        """
        count = len(self.parameters)
        point = vector_of("theta", theta, (count,))
        nothing = -np.inf, np.full(count, np.nan), np.full((count, count), np.nan)
        if not self.supports(point[None])[0]:
            return nothing
        signal, slopes = self.model.signal(self.grid, point[:-1])
        value, score, fisher = self.score_of_signal(signal, slopes, float(point[-1]))
        if not math.isfinite(value):
            return nothing
        for i, each in enumerate(self.parameters):
            if each.prior is not None:
                away, information = point[i] - each.prior[0], each.prior[1] ** -2
                value -= 0.5 * information * away**2
                score[i] -= information * away
                fisher[i, i] += information
        return value, score, fisher

    def score_of_signal(
        self, signal: FloatArray, slopes: FloatArray, level: float
    ) -> tuple[float, FloatArray, FloatArray]:
        """Log-likelihood of a signal, its gradient and the expected information.

        Parameters are those of the slopes, and the level.

        Shapes: `signal` (ny, nx), `slopes` (n, ny, nx), `score` (n + 1,), `fisher` (n + 1, n + 1).
        """
        terms = self.noise.terms(self.data, signal, level)
        rows = np.concatenate([slopes, terms.by_level[None]]).reshape(len(slopes) + 1, -1)
        score = rows @ terms.score.ravel()
        return terms.value, score, (rows * terms.information.ravel()) @ rows.T

    def maximize(
        self, start: FloatArray, box: Box, *, tolerance: float = TOLERANCE, least: float = -math.inf
    ) -> Optimum:
        """Maximise by damped Fisher scoring inside a box.

        Shapes: `start` (p,).
        """
        theta, box = self._checked(start, box)
        return maximise(
            self.score_fisher, theta, box, self.farthest, tolerance=tolerance, least=least
        )

    def farthest(self, theta: FloatArray) -> FloatArray:
        """Largest change of each parameter in one step from a point.

        Shapes: `theta`, result (p,).
        """
        each_of = zip(self.parameters, np.abs(theta).tolist(), strict=True)
        return np.array(
            [min(one.step, one.growth * size if size else math.inf) for one, size in each_of]
        )

    def measured_signal(self) -> FloatArray:
        """Signal that the counts show, shape (ny, nx); NaN where masked."""
        with np.errstate(divide="ignore", invalid="ignore"):
            out = self.noise.measured_signal(self.data)
        return np.where(self.used, out, np.nan)

    def signal_information(self, signal: FloatArray | None = None) -> FloatArray:
        """Fisher information of each pixel about its own signal.

        Shapes: `signal` (ny, nx), result (ny, nx).
        """
        s = np.zeros(self.grid.shape) if signal is None else signal
        return self.noise.signal_information(self.data, s)

    def _checked(self, start: FloatArray, box: Box) -> tuple[FloatArray, Box]:
        """Check the shapes of a start and of a box, and whether one is inside the other."""
        shape = (len(self.parameters),)
        theta = vector_of("start", start, shape).copy()
        lower, upper = vector_of("lower", box.lower, shape), vector_of("upper", box.upper, shape)
        free = np.ascontiguousarray(box.free, dtype=np.bool_)
        if free.shape != shape:
            raise DataError(f"free: has shape {free.shape} where {shape} is needed")
        if not np.all(~free | ((theta >= lower) & (theta <= upper))):
            raise ConfigError(
                f"start = {_listed(theta)} lies outside the box from {_listed(lower)} to "
                f"{_listed(upper)}: clip it, or widen the box"
            )
        return theta, Box(free, lower, upper)


@dataclass(frozen=True)
class Likelihood(ModelLikelihood):
    """One region's counts under one noise law; build it with `conditional` or `poisson`."""

    model: ForwardModel
    prior: HeightPrior | None = None

    @property
    def measured(self) -> Measured:
        """Noise law and data, as kernels take them."""
        return self.noise.code, self.data

    @property
    def height_prior(self) -> tuple[float, float]:
        """Mean and information of the prior of z, as kernels take them."""
        return (0.0, 0.0) if self.prior is None else (self.prior.mean_nm, self.prior.information)

    def values(self, thetas: FloatArray, *, pictured: bool = False) -> FloatArray:
        """As `ModelLikelihood.values`."""
        points = vector_of("thetas", thetas, (-1, 5))
        inside = self.supports(points)
        out, known = np.full(len(points), -np.inf), points[inside]
        if not len(known):
            return out
        if self.model.is_sized:  # each mass has its own picture
            out[inside] = [
                self.noise.terms(self.data, self.signal(point), float(point[LEVEL])).value
                for point in known
            ]
            return out
        lens, table = self._table(known, pictured=pictured)
        out[inside] = value_batch(table, lens, *self._arguments[1:], known)
        out[np.isnan(out)] = -np.inf  # an amplitude so large that the light overflows
        if self.prior is not None:
            out += self.prior.log_density(points[:, 2])
        return out

    def supports(self, thetas: FloatArray) -> BoolArray:
        """As `ModelLikelihood.supports`."""
        inside: BoolArray = supported(thetas, *self._support)
        return inside

    def score_fisher(self, theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """As `ModelLikelihood.score_fisher`."""
        point = vector_of("theta", theta, (5,))
        if self.model.is_sized or not self.supports(point[None])[0]:
            return super().score_fisher(point)
        score, fisher = np.empty(5), np.empty((5, 5))
        profile = self.model.profile(point[2])
        value = score_pass(profile, *self._arguments, point, (score, fisher))
        if self.prior is not None:
            value += add_prior(self.height_prior, point, (score, fisher))
        return value, score, fisher

    def maximize(
        self,
        start: FloatArray,
        box: Box,
        *,
        tolerance: float = TOLERANCE,
        passes: int = PASSES,
        least: float = -math.inf,
    ) -> Optimum:
        """As `ModelLikelihood.maximize`; a box that leaves the support is refused."""
        if self.model.is_sized:
            return super().maximize(start, box, tolerance=tolerance, least=least)
        theta, box = self._checked(start, box)
        free, lower, upper = box.free, box.lower, box.upper
        lens, pixels, measured = self._arguments
        if free[2]:
            table = self.model.axial_table
        elif self.is_pictured(theta[2], np.where(free, lower, theta), np.where(free, upper, theta)):
            lens, table = self.model.picture_table(self.grid.pixel_nm, max(self.grid.shape))
        else:
            table = self.model.height_table(theta[2])
        search = free, lower, upper, self.farthest(np.zeros(5)), tolerance, passes, least
        value, used, outcome, fisher = maximize(
            (tuple(table), tuple(lens), tuple(pixels)), measured, search, self.height_prior, theta
        )
        return Optimum(theta, value, used, outcome == CONVERGED, fisher)

    def scan_heights(
        self, heights: FloatArray, theta: FloatArray, amplitude_range: tuple[float, float] | None
    ) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood along z at fixed x, y, with the amplitude refitted at each height.

        Shapes: `heights` (n,), `theta` (5,), `values, amplitudes` (n,).
        """
        heights, point = vector_of("heights", heights, (-1,)), vector_of("theta", theta, (5,))
        points = np.tile(point, (heights.size, 1))
        points[:, 2] = heights
        inside = self.supports(points)
        known = heights[inside]
        lens, pixels, measured = self._arguments
        picture = tuple(self.model.axial_table), tuple(lens), tuple(pixels)
        limits = amplitude_range or (0.0, 0.0)
        found, refitted = scan_heights(picture, measured, known, limits, point)
        if self.prior is not None:
            found += self.prior.log_density(known)
        values, amplitudes = np.full(heights.size, -np.inf), np.full(heights.size, np.nan)
        values[inside], amplitudes[inside] = found, refitted
        return values, amplitudes

    def derivatives(self, theta: FloatArray, free: BoolArray | None = None) -> FloatArray:
        """Signal and its first and second derivatives.

        Shapes: `theta` (5,), `free` (5,), result (ny, ROWS, nx).
        """
        height = "exact" if free is None else "between" if free[2] else "fixed"
        return self.model.derivative_rows(self.grid, self._supported(theta), height)

    def residuals(self, theta: FloatArray) -> FloatArray:
        """Give data minus model in standard deviations; NaN where masked.

        Shapes: `theta` (5,), result (ny, nx).
        """
        return self.noise.residuals(self.data, self.signal(theta), math.exp(theta[LEVEL]))

    def signal(self, theta: FloatArray) -> FloatArray:
        """Signal of the model at θ, which must lie in the support; shape (ny, nx)."""
        x, y, z, amplitude, _ = self._supported(theta).tolist()
        return self.model.amplitude_image(self.grid, x, y, z, amplitude)

    def _supported(self, theta: FloatArray) -> FloatArray:
        """Return θ, unless the model is not known there."""
        point = vector_of("theta", theta, (5,))
        if not self.supports(point[None])[0]:
            raise ConfigError(
                f"theta = {_listed(point)}: {self._supports()}; move the particle or give "
                "forward_model a larger reach_nm or z_max_nm"
            )
        return point

    def _checked(self, start: FloatArray, box: Box) -> tuple[FloatArray, Box]:
        """Refuse a box that a fit could leave the support in as well."""
        theta, box = super()._checked(start, box)
        if not box_supported((box.free, box.lower, box.upper), theta, *self._support):
            raise ConfigError(
                f"lower = {_listed(box.lower)}, upper = {_listed(box.upper)}: {self._supports()}; "
                "narrow the box or give forward_model a larger reach_nm or z_max_nm"
            )
        return theta, box

    def is_pictured(self, z_nm: float, lower: FloatArray, upper: FloatArray) -> bool:
        """Whether a table of the picture at the model's height serves all places in a box.

        One serves all particles at that height; others are met once.
        """
        model, grid = self.model, self.grid
        # the table of a picture of more than 128 pixels along an axis would not be worth it
        if z_nm != model.height_nm or max(grid.shape) > 128 or model.is_measured:
            return False
        far_x = max(upper[0] - grid.x_nm[0], grid.x_nm[-1] - lower[0])
        far_y = max(upper[1] - grid.y_nm[0], grid.y_nm[-1] - lower[1])
        inside = max(far_x, far_y) < max(grid.shape) * grid.pixel_nm
        reach = model.reach_nm - math.sqrt(2) * margin_nm(model.optics, grid.pixel_nm)
        return inside and math.hypot(far_x, far_y) < reach and grid.is_regular

    def _supports(self) -> str:
        low, high = self.model.z_range_nm
        return (
            f"the model is known for z_nm from {low:g} to {high:g} and up to "
            f"{self.model.reach_nm:.0f} nm from the particle to the farthest pixel"
        )

    def _table(self, thetas: FloatArray, *, pictured: bool) -> tuple[Lens, AxialTable]:
        """Profiles along z, or at the particle's fixed height where no other is asked for."""
        model, fixed = self.model, self.model.height_nm
        if not np.all(thetas[:, 2] == fixed):
            return model.lens, model.axial_table
        if pictured and self.is_pictured(fixed, thetas.min(0), thetas.max(0)):
            return model.picture_table(self.grid.pixel_nm, max(self.grid.shape))
        return model.lens, model.height_table(fixed)

    @cached_property
    def _support(self) -> tuple[tuple[FloatArray, FloatArray, float], tuple[float, ...]]:
        """What `supported` takes after θ."""
        grid, model = self.grid, self.model
        limits = model.reach_nm, *model.z_range_nm, LARGEST_LEVEL
        return (grid.x_nm, grid.y_nm, grid.pixel_nm / 2), limits

    @cached_property
    def _arguments(self) -> tuple[Lens, Pixels, Measured]:
        """What every scoring kernel takes after the profiles."""
        return self.model.lens, self.model.pixels(self.grid), self.measured


def _listed(theta: FloatArray) -> str:
    return "(" + ", ".join(f"{value:g}" for value in theta) + ")"
