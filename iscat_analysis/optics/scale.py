"""Mass and the amplitude of the scattered field: by the absolute model, or by a calibration."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Calibration

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class MassScale:
    """The map between mass and the amplitude a of the model's field.

    Without a calibration a is the mass in kDa.  With one, the signed peak contrast
    C = L·a + Q·a² of the model at the calibration height equals gradient·m + sign(m)·offset, which
    replaces the model's absolute scale.

    Attributes
    ----------
    calibration : Calibration or None
        The line.
    linear, quadratic : float
        L and Q, per unit amplitude.
    """

    calibration: Calibration | None = None
    linear: float = 0.0
    quadratic: float = 0.0

    def amplitude(self, mass_kda: float) -> float:
        """Amplitude a of a particle of a given mass [kDa]."""
        if self.calibration is None:
            return mass_kda
        line = self.calibration
        contrast = line.gradient_per_kda * mass_kda + math.copysign(1.0, mass_kda) * line.offset
        root = math.sqrt(max(self.linear**2 + 4 * self.quadratic * contrast, 0.0))
        return 2 * contrast / (self.linear + math.copysign(root, self.linear))

    def mass(self, amplitude: FloatArray) -> FloatArray:
        """Mass [kDa] of amplitudes of any shape; the inverse of `amplitude`."""
        amplitude = np.asarray(amplitude, dtype=float)
        if self.calibration is None:
            return amplitude
        line = self.calibration
        contrast = self.linear * amplitude + self.quadratic * amplitude**2
        sign = np.sign(contrast * line.gradient_per_kda)
        return (contrast - sign * line.offset) / line.gradient_per_kda

    def slope(self, amplitude: float) -> float:
        """Return dm/da [kDa per unit amplitude]."""
        if self.calibration is None:
            return 1.0
        rise = self.linear + 2 * self.quadratic * amplitude
        return rise / self.calibration.gradient_per_kda
