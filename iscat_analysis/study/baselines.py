"""The estimators that most labs use, to be compared on the same counts.

Both see the contrast image alone (dark field: the image above background).  Mass follows from the
amplitude by proportionality, with the factor taken from the noiseless image of the true particle: a
calibration as good as it can be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.records import Candidate, FloatArray
from iscat_analysis.study.setting import Setting
from iscat_analysis.study.simple_estimators import around, fit_gaussian, half_width, highest


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
            half_px=half_width(optics, pixel),
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
        grid, image = likelihood.grid, np.nan_to_num(likelihood.measured_signal())
        pixel, origin = grid.pixel_nm, np.array([grid.x_nm[0], grid.y_nm[0]])
        begin = np.array([start.x_px, start.y_px]) - origin / pixel
        cut = around(image.shape, begin, self.half_px)
        found = fit_gaussian(image[cut], cut, begin, self.sigma_nm / pixel, self.polarity)[0]
        x, y = found[1:3] * pixel + origin
        return np.array([x, y, math.nan, found[0]])

    def _peak(self, likelihood: Likelihood, start: Candidate) -> FloatArray:
        grid = likelihood.grid
        pixel, origin = grid.pixel_nm, np.array([grid.x_nm[0], grid.y_nm[0]])
        begin = np.array([start.x_px, start.y_px]) - origin / pixel
        found = highest(likelihood.measured_signal(), begin, self.polarity, refined=False)
        x, y = found[:2] * pixel + origin
        return np.array([x, y, math.nan, found[2]])
