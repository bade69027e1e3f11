"""The line between contrast and mass, and the conversion of contrasts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import ndtri

from iscat_analysis.calibration.mass.peaks import ContrastPeak
from iscat_analysis.calibration.mass.standards import Standards
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import FloatArray

Landing = Literal["dark", "bright"]


def mass_from_contrast(
    contrast: ArrayLike, gradient_per_kda: float, offset: float = 0.0
) -> FloatArray:
    """Convert signed peak contrasts to masses."""
    if gradient_per_kda == 0 or not math.isfinite(gradient_per_kda):
        raise ConfigError(f"gradient_per_kda = {gradient_per_kda:g} says nothing about mass")
    c = np.asarray(contrast, dtype=np.float64)
    direction = math.copysign(1.0, gradient_per_kda)
    masses: FloatArray = (
        np.sign(direction * c) * (direction * np.abs(c) - offset) / gradient_per_kda
    )
    return masses


def line_sigma_kda(
    mass_kda: ArrayLike,
    gradient_per_kda: float,
    covariance: FloatArray,
    sigma_contrast: ArrayLike = 0.0,
) -> FloatArray:
    """Propagate the errors of the line, and of a contrast, into a mass.

    Shapes: `covariance` (2, 2).
    """
    mass = np.abs(np.asarray(mass_kda, dtype=np.float64))
    variance = (
        np.square(np.asarray(sigma_contrast, dtype=np.float64))
        + mass**2 * covariance[0, 0]
        + 2 * mass * covariance[0, 1]
        + covariance[1, 1]
    )
    return np.asarray(np.sqrt(variance) / abs(gradient_per_kda))


@dataclass(frozen=True, eq=False)
class MassCalibration:
    """The line between contrast and mass; `calibrate_mass` makes it."""

    gradient_per_kda: float
    offset: float
    covariance: FloatArray
    chi2: float
    dof: int
    standards: pd.DataFrame
    peaks: tuple[ContrastPeak, ...]
    landing: Landing
    events: int
    notes: tuple[str, ...] = ()
    recorded: Standards | None = None

    def mass_kda(self, contrast: ArrayLike) -> FloatArray:
        """Convert signed peak contrasts to masses."""
        return mass_from_contrast(contrast, self.gradient_per_kda, self.offset)

    def sigma_kda(self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0) -> FloatArray:
        """Give the standard deviation of such a mass."""
        return line_sigma_kda(
            self.mass_kda(contrast), self.gradient_per_kda, self.covariance, sigma_contrast
        )

    def prediction_interval(
        self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Give the interval that holds the true mass with a probability of 95 %."""
        reach = float(ndtri(0.975)) * self.sigma_kda(contrast, sigma_contrast)
        mass = self.mass_kda(contrast)
        return mass - reach, mass + reach

    def to_toml(self) -> str:
        """Write the section ``[calibration]`` to paste into a configuration.

        The section contains the standard errors of the line and their correlation, from which an
        analysis computes the contribution of the calibration to the error of each mass.  It also
        contains the optics of the standards if they are known.
        """
        s_se, o_se = (math.sqrt(self.covariance[k, k]) for k in (0, 1))
        return (
            "[calibration]\n"
            f"gradient_per_kda = {self.gradient_per_kda:.6g}\n"
            f"offset = {self.offset:.6g}\n"
            f"gradient_se_per_kda = {s_se:.4g}  # {100 * abs(s_se / self.gradient_per_kda):.2g} %\n"
            f"offset_se = {o_se:.4g}\n"
            f"correlation = {self.covariance[0, 1] / (s_se * o_se):.5f}\n"
            f"dof = {self.dof}\n"
            f"{self.recorded.to_toml() if self.recorded else ''}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``calibration.json`` holds."""
        return {
            "gradient_per_kda": self.gradient_per_kda,
            "gradient_se": math.sqrt(self.covariance[0, 0]),
            "offset": self.offset,
            "offset_se": math.sqrt(self.covariance[1, 1]),
            "covariance": self.covariance.tolist(),
            "chi2": self.chi2,
            "dof": self.dof,
            "landing": self.landing,
            "events": self.events,
            "standards": self.standards.to_dict("records"),
            "peaks": [vars(peak) for peak in self.peaks],
            "notes": list(self.notes),
            "recorded": None if self.recorded is None else self.recorded.to_dict(),
        }
