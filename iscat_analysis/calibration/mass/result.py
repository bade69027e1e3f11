"""The line between contrast and mass, and what it makes of a contrast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.special import ndtri

from iscat_analysis.calibration.mass.peaks import ContrastPeak
from iscat_analysis.errors import ConfigError
from iscat_analysis.records import FloatArray

Landing = Literal["dark", "bright"]


def mass_from_contrast(
    contrast: ArrayLike, gradient_per_kda: float, offset: float = 0.0
) -> FloatArray:
    """Convert signed peak contrasts to masses.

    Parameters
    ----------
    contrast : array_like
        Signed peak contrasts.
    gradient_per_kda : float
        Contrast per kDa of a landing particle, negative where landing darkens.
    offset : float
        Contrast of a landing particle of zero mass.

    Returns
    -------
    ndarray
        Masses, negative for a particle that leaves [kDa].

    Raises
    ------
    ConfigError
        The gradient is zero or not finite.
    """
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

    Parameters
    ----------
    mass_kda : array_like
        Masses by the line, of either sign [kDa].
    gradient_per_kda : float
        Contrast per kDa.
    covariance : ndarray, shape (2, 2)
        Of gradient and offset.
    sigma_contrast : array_like
        Standard deviations of the contrasts; 0 leaves those of the line alone.

    Returns
    -------
    ndarray
        Standard deviations [kDa], by linear propagation.
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
    """The line between contrast and mass; `calibrate_mass` makes it.

    Attributes
    ----------
    gradient_per_kda : float
        s, signed peak contrast per kDa of a landing particle.
    offset : float
        o, contrast of a landing particle of zero mass.
    covariance : ndarray, shape (2, 2)
        Of (s, o), widened by χ²/dof where that exceeds one.
    chi2 : float
        Of the line, before widening.
    dof : int
        Standards less two.
    standards : pandas.DataFrame
        mass_kda, mass_se, contrast (signed), contrast_se, width, count, found_kda (the peak's mass
        by the line), residual_percent, low_kda and high_kda (95 % prediction interval of a mass
        that the line gives there).
    peaks : tuple of ContrastPeak
        Every peak that was found, matched or not.
    landing : str
        ``"dark"`` or ``"bright"``.
    events : int
        Landing events used.
    notes : tuple of str
        What the user should know, one sentence each.
    """

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

    def mass_kda(self, contrast: ArrayLike) -> FloatArray:
        """Convert signed peak contrasts to masses.

        Parameters
        ----------
        contrast : array_like
            Signed peak contrasts.

        Returns
        -------
        ndarray
            Masses, negative for a particle that leaves [kDa].
        """
        return mass_from_contrast(contrast, self.gradient_per_kda, self.offset)

    def sigma_kda(self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0) -> FloatArray:
        """Give the standard deviation of such a mass.

        Parameters
        ----------
        contrast : array_like
            Signed peak contrasts.
        sigma_contrast : array_like
            Their standard deviations; 0 leaves that of the line alone.

        Returns
        -------
        ndarray
            Standard deviations [kDa].
        """
        return line_sigma_kda(
            self.mass_kda(contrast), self.gradient_per_kda, self.covariance, sigma_contrast
        )

    def prediction_interval(
        self, contrast: ArrayLike, sigma_contrast: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Give the interval that holds the true mass with a probability of 95 %.

        Parameters
        ----------
        contrast : array_like
            Signed peak contrasts.
        sigma_contrast : array_like
            Their standard deviations.

        Returns
        -------
        low, high : ndarray
            Ends of the interval [kDa].
        """
        reach = float(ndtri(0.975)) * self.sigma_kda(contrast, sigma_contrast)
        mass = self.mass_kda(contrast)
        return mass - reach, mass + reach

    def to_toml(self) -> str:
        """Write the section ``[calibration]`` to paste into a configuration.

        The standard errors of the line and their correlation are part of it, so that analyses can
        say what the calibration contributes to the error of each mass.

        Returns
        -------
        str
            TOML text.
        """
        s_se, o_se = (math.sqrt(self.covariance[k, k]) for k in (0, 1))
        return (
            "[calibration]\n"
            f"gradient_per_kda = {self.gradient_per_kda:.6g}\n"
            f"offset = {self.offset:.6g}\n"
            f"gradient_se_per_kda = {s_se:.4g}  # {100 * abs(s_se / self.gradient_per_kda):.2g} %\n"
            f"offset_se = {o_se:.4g}\n"
            f"correlation = {self.covariance[0, 1] / (s_se * o_se):.5f}\n"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``calibration.json`` holds.

        Returns
        -------
        dict
            Nested plain values.
        """
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
        }
