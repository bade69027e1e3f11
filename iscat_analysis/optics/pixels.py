"""Where the light of a pixel is sampled, so that it is integrated over the pixel's area.

A pixel counts the light on all of its active area.  The mean over a square of side d multiplies a
wave of wave vector q by sinc(q_x d/2) sinc(q_y d/2).  With pixels of 84 nm at 525 nm and NA 1.42
the picture of a particle is 5 % fainter for it, with pixels of 120 nm 9 %.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from iscat_analysis.config import AUTO, CameraConfig, Optics
from iscat_analysis.records import FloatArray

TOLERANCE = 2.5e-4
"""Largest error of the mean over a pixel, of any wave that the pupil passes; images are then right
to this part of their peak, and masses too."""

_LARGEST_NA = 1.5  # of most objectives; points do not move where optics are learned
_ZERO_ERROR = 0.9  # of the band: the error vanishes there, and is about even below and above
_NEWTON = 8  # steps to this point
_WAVES = np.linspace(0.0, 1.0, 101)  # of the band, on which the error is judged


def bandwidth(optics: Optics) -> float:
    """Largest wavenumber of the light that a camera sees [rad/nm].

    That of the interference; in dark field of the scattered light, twice as much.
    """
    return 2 * math.pi / optics.wavelength_nm * optics.na * (1 + (optics.scheme == "darkfield"))


@dataclass(frozen=True)
class PixelArea:
    """How pixels integrate.

    `samples` is their number along each axis, "auto" for as many as `TOLERANCE` asks for; `side`
    that of the active square over the spacing of pixels; `band` is the largest wavenumber that is
    averaged well [rad/nm].
    """

    samples: int | str
    side: float
    band: float

    @classmethod
    def of(cls, camera: CameraConfig, optics: Optics) -> PixelArea:
        """Area of a camera's pixels; the paper's convention samples their centres."""
        samples = camera.samples_per_pixel
        if samples == AUTO and optics.convention == "dong2021":
            samples = 1
        aperture = _LARGEST_NA if optics.na <= _LARGEST_NA else optics.n_immersion
        band = bandwidth(optics) * aperture / optics.na
        return cls(samples, math.sqrt(camera.fill_factor), band)

    def points(self, pixel_nm: float) -> tuple[FloatArray, FloatArray]:
        """Offsets from the centre along each axis [nm], and their weights, whose sum is 1."""
        half = self.side * pixel_nm / 2
        if isinstance(self.samples, int):
            places, weights = np.polynomial.legendre.leggauss(self.samples)
            return half * places, weights / 2
        places, weights = _fewest(half * self.band)
        return half * places, weights


@lru_cache(64)
def _fewest(phase: float) -> tuple[FloatArray, FloatArray]:
    """Fewest points in [−1, 1] that average waves of up to a phase at the ends; their weights.

    They are those of Gauss and Legendre, moved together by the factor with which the error changes
    sign within the band instead of growing towards its end.
    """
    for count in itertools.count(1):  # pragma: no branch
        places, weights = np.polynomial.legendre.leggauss(count)
        weights, at = weights / 2, _ZERO_ERROR * phase
        factor = 1.0
        for _ in range(_NEWTON if count > 1 else 0):
            turn = factor * at * places
            error = float(weights @ np.cos(turn)) - float(np.sinc(at / math.pi))
            factor += error / float(weights @ (np.sin(turn) * at * places))
        waves = phase * _WAVES
        mean = weights @ np.cos(np.outer(factor * places, waves))
        if np.abs(mean - np.sinc(waves / math.pi)).max() <= TOLERANCE:
            break
    return factor * places, weights
