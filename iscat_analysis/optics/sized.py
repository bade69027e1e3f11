"""Images of spheres, whose field is not proportional to their mass.

The amplitude a of a sphere is its mass, as that of a dipole on the scale of the model.  Its pattern
in the pupil changes with a, so that each mass has a model of its own, `SizedModel.at`: this one is
linear, and its pictures at the amplitude a are those of the sphere.  Derivatives along x, y and z
are analytic.  Those along a are differences between masses that differ by `MASS_STEP` of the mass;
their error is 1e-6 of the derivative, and 1e-5 of the second one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from iscat_analysis._kernels.hessian import PAIRS
from iscat_analysis.optics.aperture import aperture_on
from iscat_analysis.optics.grid import PixelGrid
from iscat_analysis.optics.memoize import memoize
from iscat_analysis.optics.model import ForwardModel
from iscat_analysis.optics.spheres import Sphere
from iscat_analysis.optics.waves import with_light_of
from iscat_analysis.units import sphere_mass_kda

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

MASS_STEP = 5e-4
"""Relative step of the mass in differences, a 6000th of the diameter."""

_MASSES_KEPT = 48  # models of single masses at hand
_INDICES_KEPT = 6
_SCANNED_KEPT = 64  # the same of a scan, with tables along z of some MB each
_SECOND = {pair: 5 + k for k, pair in enumerate(PAIRS)}  # rows of second derivatives


@dataclass(frozen=True)
class SizedModel(ForwardModel):
    """Expected images of a sphere in one microscope; its tables are of the nominal mass."""

    sphere: Sphere = field(kw_only=True)
    """The nominal sphere."""

    mass_range_kda: tuple[float, float] = field(kw_only=True)
    """Masses among which a fit searches."""

    dimming: ComplexArray | float = field(default=1.0, kw_only=True)
    """What every plane wave was multiplied by: spheres of all masses move alike."""

    @property
    def is_sized(self) -> bool:
        """Whether particles are spheres, whose picture changes its shape with their size."""
        return True

    def at(self, amplitude: float) -> ForwardModel:
        """Give the model whose pictures grow in proportion to the amplitude near this one."""
        return self._of_mass(self.sphere.of_mass(amplitude))

    def scanned(self, amplitude: float) -> ForwardModel:
        """Give `at`, kept with its table along z apart from the masses that a fit passes by."""
        return self._of_scan(self.sphere.of_mass(amplitude))

    def of_index(self, index: float) -> SizedModel:
        """Give the model of spheres, or of cores in the same shell, of another index."""
        return self._of_index(index)

    @cached_property
    def _of_index(self) -> Callable[[float], SizedModel]:
        def make(index: float) -> SizedModel:
            return replace(self, sphere=replace(self.sphere, index=complex(index)))

        return memoize(_INDICES_KEPT, make)

    @cached_property
    def _of_mass(self) -> Callable[[Sphere], ForwardModel]:
        return memoize(_MASSES_KEPT, self._linear)

    @cached_property
    def _of_scan(self) -> Callable[[Sphere], ForwardModel]:
        return memoize(_SCANNED_KEPT, self._linear)

    def _linear(self, sphere: Sphere) -> ForwardModel:
        """Make the model of the pattern of one sphere."""
        pupil = self.aperture.pupil
        opening = aperture_on(self.optics, pupil.theta, pupil.weight, sphere)
        wave = with_light_of(self.wave, opening, self.factor, self.oil_nm)
        linear = ForwardModel(**{**parts_of(self), "aperture": opening, "wave": wave})
        return linear.dimmed(np.asarray(self.dimming, dtype=complex))

    def dimmed(self, factor: ComplexArray) -> Self:
        """As `ForwardModel.dimmed`."""
        return replace(super().dimmed(factor), dimming=self.dimming * factor)

    def step_of(self, amplitude: float) -> float:
        """Give the step of the mass with which differences are taken [kDa]."""
        return MASS_STEP * self.sphere.of_mass(amplitude).mass_kda

    def amplitude_image(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> FloatArray:
        """As `ForwardModel.amplitude_image`."""
        return self.at(amplitude).amplitude_image(grid, x_nm, y_nm, z_nm, amplitude)

    def amplitude_gradient(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray]:
        """As `ForwardModel.amplitude_gradient`."""
        signal, own = self.at(amplitude).amplitude_gradient(grid, x_nm, y_nm, z_nm, amplitude)
        own[3] = self._along_mass(grid, x_nm, y_nm, z_nm, amplitude)
        return signal, own

    def amplitude_hessian(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As `ForwardModel.amplitude_hessian`."""
        rows = self.derivative_rows(grid, np.array([x_nm, y_nm, z_nm, amplitude]))
        out = np.moveaxis(rows, 1, 0)
        second = np.empty((4, 4, *grid.shape))
        for (i, j), row in _SECOND.items():
            second[i, j] = second[j, i] = out[row]
        return out[0], out[1:5], second

    def derivative_rows(
        self, grid: PixelGrid, theta: FloatArray, height: str = "exact"
    ) -> FloatArray:
        """As `ForwardModel.derivative_rows`; no mass has a table along z."""
        exact = "exact" if height == "between" else height
        amplitude = float(theta[3])
        step = self.step_of(amplitude)
        below, rows, above = (
            self.at(a).derivative_rows(grid, np.array([*theta[:3], a]), exact)
            for a in (amplitude - step, amplitude, amplitude + step)
        )
        rows[:, 4] = (above[:, 0] - below[:, 0]) / (2 * step)
        for k in range(3):
            rows[:, _SECOND[k, 3]] = (above[:, 1 + k] - below[:, 1 + k]) / (2 * step)
        rows[:, _SECOND[3, 3]] = (above[:, 0] - 2 * rows[:, 0] + below[:, 0]) / step**2
        return rows

    def amplitude_joint_gradient(
        self,
        grid: PixelGrid,
        x_nm: float,
        y_nm: float,
        z_nm: float,
        amplitude: float,
        names: Sequence[str],
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """As `ForwardModel.amplitude_joint_gradient`."""
        place = (grid, x_nm, y_nm, z_nm, amplitude)
        signal, own, shared = self.at(amplitude).amplitude_joint_gradient(*place, names)
        own[3] = self._along_mass(*place)
        return signal, own, shared

    def field(
        self, dx_nm: FloatArray, dy_nm: FloatArray, z_nm: float, mass_kda: float
    ) -> ComplexArray:
        """As `ForwardModel.field`."""
        return self.at(mass_kda).field(dx_nm, dy_nm, z_nm, mass_kda)

    def amplitude_contrast(self, z_nm: float, amplitude: float, height: str = "exact") -> float:
        """As `ForwardModel.amplitude_contrast`; no mass has a table along z."""
        del height
        return self.at(amplitude).amplitude_contrast(z_nm, amplitude)

    def _along_mass(
        self, grid: PixelGrid, x_nm: float, y_nm: float, z_nm: float, amplitude: float
    ) -> FloatArray:
        """Differentiate the signal along the mass."""
        step = self.step_of(amplitude)
        below, above = (
            self.amplitude_image(grid, x_nm, y_nm, z_nm, a)
            for a in (amplitude - step, amplitude + step)
        )
        return np.asarray((above - below) / (2 * step))


def sized(model: ForwardModel, sphere: Sphere, diameters_nm: tuple[float, float]) -> SizedModel:
    """Make the model of spheres of all masses from that of one, with the diameters to search."""
    low, high = (sphere_mass_kda(diameter, sphere.density_kg_m3) for diameter in diameters_nm)
    return SizedModel(**parts_of(model), sphere=sphere, mass_range_kda=(low, high))


def parts_of(model: ForwardModel) -> dict[str, Any]:
    """Name the parts of which a linear model is made."""
    return {each.name: getattr(model, each.name) for each in fields(ForwardModel)}
