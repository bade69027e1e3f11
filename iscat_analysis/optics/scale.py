"""Mass and the amplitude of the scattered field: by the absolute model, or by a calibration.

A particle of mass m scatters a field of amplitude a, in any microscope.  The contrast of this
amplitude, C = L·a + Q·a², depends on the optics: L and Q depend on focus, aperture, phase and
height.  The line of a calibration was measured with the optics of its standards, so that

    gradient·m + sign(m)·offset = L_there·a + Q_there·a²

gives the mass of an amplitude that was fitted with any other optics.  For faint particles this is
the gradient times the contrast per kDa of the model here over that of the model there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from iscat_analysis.config import Calibration, Optics
from iscat_analysis.records import BoolArray, FloatArray

LARGEST_SCALE_CHANGE = 1 / 3
"""Largest change of the contrast per kDa, from the optics of the standards to others, for which the
model converts the scale: beyond it, small errors of the optics are large errors of the mass."""


def carry_refusal(here: Optics, there: Optics, ratio: float) -> str:
    """Say why the model does not convert the scale of standards to other optics; else nothing."""
    for key in ("scheme", "polarization", "analyzer", "psf"):
        mine, theirs = getattr(here, key), getattr(there, key)
        if mine != theirs:
            return f"they were measured with optics.{key} = {theirs}, and this is {mine}"
    # Two wavelengths that differ by less are of the same laser line
    if abs(here.wavelength_nm - there.wavelength_nm) > 1.0:
        return (
            f"they were measured at {there.wavelength_nm:g} nm, and this is at "
            f"{here.wavelength_nm:g} nm"
        )
    if not abs(ratio - 1) <= LARGEST_SCALE_CHANGE:
        return (
            f"by the model the contrast per kDa is {ratio:.3g} of that with the standards' optics, "
            "a change of more than a third"
        )
    return ""


@dataclass(frozen=True)
class MassScale:
    """The map between mass and the amplitude a of the model's field.

    Without a calibration a is the mass in kDa.  With one, the signed peak contrast
    C = L·a + Q·a² of the model, at the optics and the height of the standards, equals
    gradient·m + sign(m)·offset, which replaces the model's absolute scale.  `here` is L at the
    optics of the model; `refusal` says why the scale cannot be converted to these optics.

    The line crosses zero contrast at the mass −offset/gradient.  If this mass is positive, each
    contrast up to the offset belongs to two masses of opposite sign, which differ by twice this
    mass; `mass` gives the one with the sign of the contrast.  If it is negative, contrasts below
    the offset belong to no mass, and `mass` continues the line below zero.
    """

    calibration: Calibration | None = None
    linear: float = 0.0
    quadratic: float = 0.0
    here: float | None = None
    refusal: str = ""

    @property
    def carried(self) -> float:
        """Contrast per kDa at the model's own optics over that at the optics of the standards."""
        return 1.0 if self.here is None else self.here / self.linear

    def peak(self, amplitude: FloatArray) -> FloatArray:
        """Contrast of amplitudes of any shape at the optics of the standards."""
        return self.linear * amplitude + self.quadratic * amplitude**2

    def amplitude(self, mass_kda: float) -> float:
        """Amplitude a of a particle of a given mass [kDa]."""
        return float(self.amplitudes(mass_kda))

    def amplitudes(self, mass_kda: ArrayLike) -> FloatArray:
        """`amplitude` of masses of any shape."""
        mass_kda = np.asarray(mass_kda, dtype=float)
        if self.calibration is None:
            return mass_kda
        line = self.calibration
        contrast = line.gradient_per_kda * mass_kda + np.copysign(1.0, mass_kda) * line.offset
        root = np.sqrt(np.maximum(self.linear**2 + 4 * self.quadratic * contrast, 0.0))
        return np.asarray(2 * contrast / (self.linear + np.copysign(root, self.linear)))

    def mass(self, amplitude: FloatArray) -> FloatArray:
        """Mass [kDa] of amplitudes of any shape; the inverse of `amplitude`."""
        amplitude = np.asarray(amplitude, dtype=float)
        if self.calibration is None:
            return amplitude
        line = self.calibration
        contrast = self.peak(amplitude)
        sign = np.sign(contrast * line.gradient_per_kda)
        return (contrast - sign * line.offset) / line.gradient_per_kda

    def slope(self, amplitude: float) -> float:
        """Return dm/da [kDa per unit amplitude]."""
        return float(self.slopes(np.asarray(amplitude)))

    def bend(self, mass_kda: FloatArray) -> FloatArray:
        """Give the relative error of a line of faint standards for heavy particles.

        The scattered field is proportional to the mass, but the contrast also contains its square.
        If the standards are faint, the contrast of a line differs from C = L·a + Q·a² by −Q·a/L.
        """
        sizes = np.abs(np.asarray(mass_kda, dtype=float))
        if self.calibration is None:
            return np.zeros(sizes.shape)
        whole = self.linear + self.quadratic * self.amplitudes(sizes)
        return np.asarray(self.linear / whole - 1)

    def slopes(self, amplitude: FloatArray) -> FloatArray:
        """`slope` of amplitudes of any shape."""
        amplitude = np.asarray(amplitude, dtype=float)
        if self.calibration is None:
            return np.ones(amplitude.shape)
        rise = self.linear + 2 * self.quadratic * amplitude
        return np.asarray(rise / self.calibration.gradient_per_kda)

    def off_line(self, amplitude: FloatArray, sigma_kda: FloatArray, errors: float) -> BoolArray:
        """Tell which contrasts do not belong to a single mass on the line of a calibration."""
        amplitude, sigma_kda = np.asarray(amplitude, dtype=float), np.asarray(sigma_kda)
        if self.calibration is None or self.calibration.offset == 0.0:
            return np.zeros(amplitude.shape, dtype=np.bool_)
        line = self.calibration
        size = np.abs(self.peak(amplitude) / line.gradient_per_kda)
        crossing = -line.offset / line.gradient_per_kda
        if crossing > 0:
            return (size < crossing + errors * sigma_kda) & (2 * crossing > sigma_kda)
        return np.asarray(size < -crossing - errors * sigma_kda)
