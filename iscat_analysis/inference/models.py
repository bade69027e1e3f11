"""Particles whose picture depends on more than their place and amplitude.

A particle model has `parameters` and gives `signal(grid, values)`: its picture, and the derivatives
with respect to each of them.  That is all that likelihood, fit, posterior and bounds need, so that
any object with these two is a particle.  `ForwardModel` is one: a dipole, and as `SizedModel` a
sphere or a shell, of place and mass.  The others of the library are here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from iscat_analysis.optics.model import ForwardModel, Parameter, Values
from iscat_analysis.optics.pixels import PixelGrid
from iscat_analysis.optics.scatterers import ANGLES, Rod
from iscat_analysis.optics.sized import SeatedModel, SizedModel
from iscat_analysis.optics.waves import with_light_of
from iscat_analysis.records import FloatArray

FARTHEST_HALF_NM = 250.0
"""Of a half of a pair from the middle; beyond it, they are two particles."""

INDEX_STEP = 1e-4
"""Of differences along the refractive index; their error is 1e-6 of the derivative."""


class ParticleModel(Protocol):
    """What likelihood, fit, posterior and bounds ask of a particle."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Its parameters."""

    def signal(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Its picture (ny, nx) and the derivatives (n, ny, nx) for values of the parameters."""


@dataclass(frozen=True)
class TurningRod:
    """A rod of unknown direction: place, mass, azimuth and tilt."""

    model: ForwardModel
    rod: Rod

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of a dipole, and both angles."""
        angles = (Parameter(name, "degrees", step=20.0) for name in ANGLES)
        return (*self.model.parameters, *angles)

    def turned(self, azimuth_deg: float, tilt_deg: float) -> ForwardModel:
        """Give the model of the rod in one direction."""
        rod = self.rod.turned(azimuth_deg, tilt_deg)
        opening = replace(self.model.aperture, scatterer=rod)
        wave = with_light_of(self.model.wave, opening, self.model.factor, self.model.oil_nm)
        return replace(self.model, aperture=opening, wave=wave)

    def signal(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Picture and derivatives."""
        *place, azimuth, tilt = map(float, values)
        return self.turned(azimuth, tilt).signal(grid, place, ANGLES)


@dataclass(frozen=True)
class Halves:
    """A particle of two equal halves, at ±h from the middle: place, mass and h.

    With half of the light from x + h and half from x − h the image is [s(x + h) + s(x − h)]/2, s
    that of a point of the whole mass.  Both fields add up, so that only the square of the scattered
    light |e(x + h) − e(x − h)|²/4 is missing, which is less than 1e-4 of the light for proteins.
    """

    model: ForwardModel

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of a point, and h along x and y."""
        limits = (-FARTHEST_HALF_NM, FARTHEST_HALF_NM)
        halves = (Parameter(f"half_{axis}_nm", "nm", limits, 60.0) for axis in "xy")
        return (*self.model.parameters, *halves)

    def rows(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Picture with its first and second derivatives, and the derivatives along h.

        Shapes: results (ny, ROWS, nx), (2, ny, nx).
        """
        place, shift = np.array(values[:4]), np.array([*values[4:6], 0.0, 0.0])
        one, other = (
            self.model.derivative_rows(grid, place + sign * shift) for sign in (1.0, -1.0)
        )
        return (one + other) / 2, np.moveaxis(one[:, 1:3] - other[:, 1:3], 1, 0) / 2

    def signal(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Picture and derivatives."""
        rows, along = self.rows(grid, values)
        signal, *own = np.moveaxis(rows, 1, 0)[:5]
        return signal, np.array([*own, *along])


@dataclass(frozen=True)
class SphereOfIndex:
    """A sphere of unknown refractive index: place, mass and index."""

    model: SizedModel

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of a sphere, and the index."""
        return (*self.model.parameters, Parameter("refractive_index"))

    def signal(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Picture and derivatives, that along the index by a difference."""
        *place, index = map(float, values)
        signal, own = self.model.of_index(index).signal(grid, place)
        below, above = (
            self.model.of_index(index + step).amplitude_image(grid, *place)
            for step in (-INDEX_STEP, INDEX_STEP)
        )
        return signal, np.concatenate([own, (above - below)[None] / (2 * INDEX_STEP)])


@dataclass(frozen=True)
class SphereOfLight:
    """A sphere on the coverslip of unknown index: place, mass, and mass times light per volume.

    The image determines the light of a sphere well and its diameter less well.  The last parameter
    is therefore the light of a small sphere, which is constant along the ridge of the likelihood.
    """

    model: SeatedModel

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of a sphere, and its light."""
        return (*self.model.parameters, Parameter("light", "kDa", (0.0, math.inf)))

    def index_of(self, values: Values) -> float:
        """Give the index of a mass and its light, among those that are searched."""
        low, high = self.model.indices
        return min(max(self.model.index_of(values[4] / values[3]), low), high)

    def with_index(self, values: Values) -> FloatArray:
        """Give the values of `SphereOfIndex` of the same sphere."""
        return np.array([*values[:4], self.index_of(values)])

    def change(self, values: Values) -> FloatArray:
        """Differentiate `with_index`, shape (5, 5)."""
        mass, strength = float(values[3]), float(values[4] / values[3])
        out = np.eye(5)
        out[4, 3:] = self.model.index_slope(strength) / mass * np.array([-strength, 1.0])
        return out

    def signal(self, grid: PixelGrid, values: Values) -> tuple[FloatArray, FloatArray]:
        """Picture and derivatives."""
        signal, slopes = SphereOfIndex(self.model).signal(grid, self.with_index(values))
        return signal, np.tensordot(self.change(values).T, slopes, axes=1)
