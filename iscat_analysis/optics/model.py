"""Expected images of one particle, and their derivatives.

Simulation, fits, posterior and bounds all use `ForwardModel`.  Its *signal* is
the contrast C in the interferometric schemes and |E_sca|² for unit incident amplitude in dark field
(D21, section II; physics.md, sections 1–3 and 8).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.curvature import derivatives_between
from iscat_analysis._kernels.hessian import PAIRS, ROWS, signal_hessian
from iscat_analysis._kernels.image import Pixels, signal_gradient, signal_image
from iscat_analysis._kernels.lens import LatticeLens, Lens, RoundLens
from iscat_analysis._kernels.radial import POWERS, AxialTable, profile_between
from iscat_analysis.config import Optics
from iscat_analysis.errors import ConfigError
from iscat_analysis.optics.aperture import Aperture
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.optics.materials import Material
from iscat_analysis.optics.measured import MeasuredField
from iscat_analysis.optics.memoize import memoize
from iscat_analysis.optics.pixels import PixelArea
from iscat_analysis.optics.scale import MassScale
from iscat_analysis.optics.sensitivity import check_names, sensitivity_lattices, signal_derivatives
from iscat_analysis.optics.stamp import sample_picture
from iscat_analysis.optics.waves import Field, LatticeField, RadialField, axial_table

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_TABLES_KEPT = 4  # cached heights with their derivatives or tables, some MB each


@dataclass(frozen=True)
class ForwardModel:
    """Expected images of one particle in one microscope; build it with `forward_model`."""

    optics: Optics
    material: Material
    aperture: Aperture
    height_nm: float
    reference: float
    rho: float
    factor: complex
    oil_nm: float
    wave: Field
    strength: complex
    reach_nm: float
    z_range_nm: tuple[float, float]
    area: PixelArea
    scale: MassScale = field(default_factory=MassScale)

    @property
    def is_sized(self) -> bool:
        """Whether particles are spheres, whose picture changes its shape with their size."""
        return False

    def at(self, amplitude: float) -> ForwardModel:
        """Give the model whose pictures grow in proportion to the amplitude near this one."""
        del amplitude  # a dipole has one picture
        return self

    def dimmed(self, factor: ComplexArray) -> Self:
        """Multiply every plane wave of the light by a complex factor; shapes: `factor` (n,)."""
        wave = self.wave
        if isinstance(wave, RadialField):
            return replace(self, wave=replace(wave, source=wave.source * factor))
        if isinstance(wave, LatticeField):
            return replace(self, wave=replace(wave, harmonics=wave.harmonics * factor))
        return self

    def centre_nm(self, z_nm: float, amplitude: float) -> float:
        """Give the height of a particle's centre, of its height as a parameter."""
        del amplitude  # they are the same
        return z_nm

    @property
    def wavenumber(self) -> float:
        """2π over the vacuum wavelength [rad/nm]."""
        return 2 * math.pi / self.optics.wavelength_nm

    @property
    def is_measured(self) -> bool:
        """Whether the image was measured, so that the light in the pupil is not known."""
        return isinstance(self.wave, MeasuredField)

    @cached_property
    def lens(self) -> Lens:
        """Constants with which the kernels turn a profile into a signal."""
        return self.wave.lens(self.rho)

    def pixels(self, grid: PixelGrid) -> Pixels:
        """Return a grid with the samples inside its pixels, as the kernels take them."""
        return Pixels(grid.x_nm, grid.y_nm, *self.area.points(grid.pixel_nm))

    @property
    def fringe_nm(self) -> float:
        """Period λ/(2 n_s) of the interference with height in iSCAT [nm]."""
        return self.optics.wavelength_nm / (2 * self.optics.n_sample)

    @cached_property
    def nominal_amplitude(self) -> float:
        """Amplitude of the material's nominal mass."""
        return self.scale.amplitude(self.material.mass_kda)

    def profile(self, z_nm: float, orders: int = 2) -> FloatArray:
        """Profile of the field at a height."""
        return self.wave.profile(z_nm, orders)

    @cached_property
    def axial_table(self) -> AxialTable:
        """Profiles at the heights of `z_range_nm`, for the kernels that interpolate along z."""
        return axial_table(self.wave, self.z_range_nm)

    def height_table(self, z_nm: float) -> AxialTable:
        """Profiles at one height, in the form of `axial_table`; the last few are kept."""
        return self._height_tables(z_nm)

    @cached_property
    def _height_tables(self) -> Callable[[float], AxialTable]:
        return memoize(_TABLES_KEPT, lambda z_nm: axial_table(self.wave, (z_nm, z_nm)))

    def picture_table(self, pixel_nm: float, half_px: int) -> tuple[Lens, AxialTable]:
        """Image at `height_nm` on the grid of the pixels; the last few are kept."""
        return self._picture_tables(pixel_nm, half_px)

    @cached_property
    def _picture_tables(self) -> Callable[[float, int], tuple[Lens, AxialTable]]:
        def of(pixel_nm: float, half_px: int) -> tuple[Lens, AxialTable]:
            lens, samples = sample_picture(self, pixel_nm, half_px)
            return lens, AxialTable(samples.reshape(1, 1, 2, -1), self.height_nm, 1.0, 0.0)

        return memoize(_TABLES_KEPT, of)

    def image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> FloatArray:
        """Signal of one particle.

        Shapes: result (ny, nx).
        """
        return self.amplitude_image(grid, x_nm, y_nm, z_nm, self.scale.amplitude(mass_kda))

    def amplitude_image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> FloatArray:
        """Signal of one particle whose amplitude is known instead of its mass.

        Below the offset of a calibration two amplitudes have the same mass, so that a fitted
        amplitude must be drawn from the amplitude and not from the mass.

        Shapes: result (ny, nx).
        """
        out = np.empty(grid.shape)
        signal_image(self.profile(z_nm, 1), *self._geometry(grid, x_nm, y_nm, amplitude), out)
        return out

    def gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, mass_kda: float
    ) -> tuple[FloatArray, FloatArray]:
        """Signal and its analytic derivatives.

        Shapes: `signal` (ny, nx), `gradient` (4, ny, nx).
        """
        amplitude = self.scale.amplitude(mass_kda)
        signal, gradient = self.amplitude_gradient(grid, x_nm, y_nm, z_nm, amplitude)
        gradient[3] /= self.scale.slope(amplitude)
        return signal, gradient

    def amplitude_gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray]:
        """Signal and its derivatives in (x, y, z, a), a the amplitude.

        Shapes: `signal` (ny, nx), `gradient` (4, ny, nx).
        """
        rows = np.empty((grid.shape[0], 5, grid.shape[1]))
        signal_gradient(self.profile(z_nm, 2), *self._geometry(grid, x_nm, y_nm, amplitude), rows)
        out = np.moveaxis(rows, 1, 0)
        return out[0], out[1:]

    def amplitude_hessian(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signal, gradient and second derivatives in (x, y, z, a), a the amplitude.

        Shapes: `signal` (ny, nx), `gradient` (4, ny, nx), `hessian` (4, 4, ny, nx).
        """
        rows = self.derivative_rows(grid, np.array([x_nm, y_nm, z_nm, amplitude]))
        out = np.moveaxis(rows, 1, 0)
        second = np.empty((4, 4, *grid.shape))
        for values, (i, j) in zip(out[5:], PAIRS, strict=True):
            second[i, j] = second[j, i] = values
        return out[0], out[1:5], second

    def derivative_rows(
        self, grid: PixelGrid, theta: FloatArray, height: str = "exact"
    ) -> FloatArray:
        """Signal and its derivatives up to the second, as the kernels of a fit take them.

        Shapes: `theta` (4,), result (ny, ROWS, nx).
        """
        rows = np.empty((grid.shape[0], ROWS, grid.shape[1]))
        x, y, z, amplitude = (float(value) for value in theta[:4])
        geometry = self._geometry(grid, x, y, amplitude)
        if height == "between":
            derivatives_between(self.axial_table, *geometry[:2], theta, rows)
        elif height == "fixed" and isinstance(self.lens, RoundLens):
            signal_hessian(self.profile(z, 1), *geometry, rows)
        else:
            signal_hessian(self.profile(z, 3), *geometry, rows)
        return rows

    def joint_gradient(
        self,
        grid: PixelGrid,
        x_nm: float,
        y_nm: float,
        z_nm: float,
        mass_kda: float,
        names: Sequence[str],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signal and its analytic derivatives with respect to particle and microscope.

        Shapes: `signal` (ny, nx), `own` (4, ny, nx), `shared` (len(names).
        """
        amplitude = self.scale.amplitude(mass_kda)
        signal, own, shared = self.amplitude_joint_gradient(
            grid, x_nm, y_nm, z_nm, amplitude, names
        )
        own[3] /= self.scale.slope(amplitude)
        return signal, own, shared

    def amplitude_joint_gradient(
        self,
        grid: PixelGrid,
        x_nm: float,
        y_nm: float,
        z_nm: float,
        amplitude: float,
        names: Sequence[str],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Signal and its derivatives for an amplitude instead of a mass, see `amplitude_image`."""
        check_names(self.aperture, names)
        if self.is_measured:
            raise ConfigError('optics.psf = "measured" knows no parameters of the optics')
        lens, stack = self._sensitivities(z_nm, tuple(names))
        _, pixels, *_ = self._geometry(grid, x_nm, y_nm, amplitude)
        rows = np.empty((grid.shape[0], 5, grid.shape[1]))
        lifted = stack[:2].reshape(-1, *stack.shape[3:])
        signal_gradient(lifted, lens, pixels, x_nm, y_nm, amplitude, rows)
        out = np.moveaxis(rows, 1, 0)
        shared = signal_derivatives(stack, lens, pixels, x_nm, y_nm, amplitude)
        return out[0], out[1:], shared

    @cached_property
    def _sensitivities(self) -> Callable[[float, tuple[str, ...]], tuple[LatticeLens, FloatArray]]:
        def at(z_nm: float, names: tuple[str, ...]) -> tuple[LatticeLens, FloatArray]:
            return sensitivity_lattices(
                self.aperture,
                self.factor,
                self.oil_nm,
                z_nm, names, rho=self.rho, reach_nm=self.reach_nm,
            )  # fmt: skip

        return memoize(_TABLES_KEPT, at)

    def field(
        self, dx_nm: FloatArray, dy_nm: FloatArray, z_nm: float, mass_kda: float
    ) -> ComplexArray:
        """Scattered field over the reference (dark field: over the incident amplitude).

        Shapes: result (1 or 2, *dx_nm.shape).
        """
        amplitude = self.scale.amplitude(mass_kda)
        return amplitude * self.wave.components(dx_nm, dy_nm, z_nm)

    def peak_contrast(self, z_nm: float, mass_kda: float) -> float:
        """Signal of largest magnitude over the plane, with its sign."""
        return self.amplitude_contrast(z_nm, self.scale.amplitude(mass_kda))

    def amplitude_contrast(self, z_nm: float, amplitude: float, height: str = "exact") -> float:
        """Peak contrast of an amplitude; see `peak_contrast` and `amplitude_image`."""
        if height == "exact" or isinstance(self.wave, MeasuredField):
            return sum(self.wave.peak(z_nm, amplitude, self.rho))
        if isinstance(self.wave, RadialField):
            profile = np.empty((self.wave.table.shape[3] - 1, POWERS, 4))
        else:
            nodes = 2 * self.wave.half + 1
            profile = np.empty((3 * self.axial_table.heights.shape[2], nodes, nodes))
        profile_between(self.axial_table, z_nm, profile)
        return sum(self.wave.peak(z_nm, amplitude, self.rho, profile))

    def _geometry(
        self, grid: PixelGrid, x_nm: float, y_nm: float, amplitude: float
    ) -> tuple[Lens, Pixels, float, float, float]:
        """Arguments every image kernel takes after the profile."""
        half = grid.pixel_nm / 2
        far_x = max(abs(grid.x_nm[0] - x_nm), abs(grid.x_nm[-1] - x_nm)) + half
        far_y = max(abs(grid.y_nm[0] - y_nm), abs(grid.y_nm[-1] - y_nm)) + half
        if math.hypot(far_x, far_y) > self.reach_nm:
            raise ConfigError(
                f"the grid extends {math.hypot(far_x, far_y):.0f} nm from the particle, the model "
                f"was built for {self.reach_nm:.0f} nm: give forward_model a larger reach_nm"
            )
        return self.lens, self.pixels(grid), x_nm, y_nm, amplitude
