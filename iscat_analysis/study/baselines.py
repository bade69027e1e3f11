"""The estimators that most labs use, to be compared on the same counts.

Both see the contrast image alone (dark field: the image above background).  Mass follows from the
amplitude by proportionality, with the factor taken from the noiseless image of the true particle: a
calibration as good as it can be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.records import Candidate, FloatArray
from iscat_analysis.study.setting import Setting
from iscat_analysis.study.simple_estimators import REACH_PX, gaussian, gaussian_slopes

_EVALUATIONS = 200


@dataclass(frozen=True)
class Baselines:
    """Two-dimensional Gaussian least squares, and the peak contrast; build it with `calibrated`."""

    polarity: float
    sigma_nm: float
    half_px: int
    kda_per_gauss: float = math.nan
    kda_per_peak: float = math.nan

    @classmethod
    def calibrated(cls, setting: Setting) -> Baselines:
        """Take the proportionality from the noiseless image."""
        truth, pixel = setting.truth, setting.context.pixel_nm
        likelihood = setting.likelihood(setting.draw(truth, None))
        image = likelihood.measured_signal()
        start = Candidate(truth[0] / pixel, truth[1] / pixel, truth[2], truth[3], 0.0)
        optics = setting.config.optics
        plain = cls(
            polarity=float(np.sign(image.flat[np.nanargmax(np.abs(image))])) or 1.0,
            sigma_nm=0.21 * optics.wavelength_nm / optics.na,
            half_px=max(2, round(optics.wavelength_nm / optics.na / pixel)),
        )
        gauss, peak = plain._gauss(likelihood, start), plain._peak(likelihood, start)
        return cls(
            plain.polarity,
            plain.sigma_nm,
            plain.half_px,
            truth[3] / gauss[3] if gauss[3] else math.nan,
            truth[3] / peak[3] if peak[3] else math.nan,
        )

    def measure(self, likelihood: Likelihood, start: Candidate) -> tuple[FloatArray, FloatArray]:
        """Run both on one region.

        Shapes: `gauss, peak` (4,).
        """
        gauss, peak = self._gauss(likelihood, start), self._peak(likelihood, start)
        gauss[3] *= self.kda_per_gauss
        peak[3] *= self.kda_per_peak
        return gauss, peak

    def _gauss(self, likelihood: Likelihood, start: Candidate) -> FloatArray:
        """Fit amplitude, centre, width and offset; NaN where it does not converge."""
        grid, image = likelihood.grid, likelihood.measured_signal()
        column = round(start.x_px - grid.x_nm[0] / grid.pixel_nm)
        row = round(start.y_px - grid.y_nm[0] / grid.pixel_nm)
        across = slice(max(column - self.half_px, 0), column + self.half_px + 1)
        down = slice(max(row - self.half_px, 0), row + self.half_px + 1)
        x, y, cut = grid.x_nm[across], grid.y_nm[down], np.nan_to_num(image[down, across])
        unit = float(np.max(np.abs(cut))) or 1.0
        cut = cut / unit

        def residual(p: FloatArray) -> FloatArray:
            return (gaussian(x, y, p) - cut).ravel()

        def jacobian(p: FloatArray) -> FloatArray:
            return gaussian_slopes(x, y, p).reshape(-1, 5)

        pixel = grid.pixel_nm
        begin = np.array([
            self.polarity * 0.8, start.x_px * pixel, start.y_px * pixel, self.sigma_nm, 0.0,
        ])  # fmt: skip
        found = least_squares(
            residual, begin, jacobian, method="lm", x_scale=np.array([1, 100, 100, 100, 1.0]),
            max_nfev=_EVALUATIONS,
        )  # fmt: skip
        if not found.success or not np.all(np.isfinite(found.x)):
            return np.full(4, np.nan)
        return np.array([found.x[1], found.x[2], math.nan, found.x[0] * unit])

    def _peak(self, likelihood: Likelihood, start: Candidate) -> FloatArray:
        grid, image = likelihood.grid, likelihood.measured_signal() * self.polarity
        pixel = grid.pixel_nm
        near = (
            np.hypot(
                grid.x_nm / pixel - start.x_px, (grid.y_nm / pixel - start.y_px)[:, None]
            ) <= REACH_PX
        )  # fmt: skip
        image = np.where(near & np.isfinite(image), image, -math.inf)
        row, column = np.unravel_index(np.argmax(image), image.shape)
        height = self.polarity * float(image[row, column])
        return np.array([grid.x_nm[column], grid.y_nm[row], math.nan, height])
