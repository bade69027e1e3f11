"""Grids of pixels, and where the light of a pixel is sampled to integrate it over its area.

A pixel counts the light on all of its active area.  The mean over a square of side d multiplies a
wave of wave vector q by sinc(q_x d/2) sinc(q_y d/2).  With pixels of 84 nm at 525 nm and NA 1.42
the picture of a particle is 5 % fainter for it, with pixels of 120 nm 9 %.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from iscat_analysis.config import AUTO, CameraConfig, Optics
from iscat_analysis.errors import DataError
from iscat_analysis.records import FloatArray

TOLERANCE = 2.5e-4
"""Largest error of the mean over a pixel, of any wave that the pupil passes; images are then right
to this part of their peak, and masses too."""

_LARGEST_NA = 1.5  # of most objectives; points do not move where optics are learned
_WAVES = np.linspace(0.0, 1.0, 101)  # of the band, on which the error is judged


def bandwidth(optics: Optics) -> float:
    """Largest wavenumber of the light that a camera sees [rad/nm].

    That of the interference; in dark field of the scattered light, twice as much.
    """
    return 2 * math.pi / optics.wavelength_nm * optics.na * (2 - optics.interferes)


@dataclass(frozen=True)
class PixelGrid:
    """Pixel centres on a regular grid; x along columns, y down the rows."""

    x_nm: FloatArray
    y_nm: FloatArray
    pixel_nm: float

    def __post_init__(self) -> None:
        for name in ("x_nm", "y_nm"):
            axis = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, axis)
            if axis.ndim != 1 or not axis.size or not np.isfinite(axis).all():
                raise DataError(f"{name}: give the centres as one row of finite numbers")
            if (axis[1:] <= axis[:-1]).any():
                raise DataError(f"{name}: the centres must ascend; sort them, without doubles")
        if not (math.isfinite(self.pixel_nm) and self.pixel_nm > 0):
            raise DataError(f"pixel_nm = {self.pixel_nm}: give the side of a pixel, above 0 nm")

    @classmethod
    @lru_cache(maxsize=1024)  # fits that follow each other share it
    def region(cls, rows: tuple[int, int], columns: tuple[int, int], pixel_nm: float) -> PixelGrid:
        """Half-open ranges of full-frame pixels; pixel (0, 0) has its centre at (0, 0) nm."""
        x, y = (np.arange(*span, dtype=np.float64) * pixel_nm for span in (columns, rows))
        return cls(x, y, pixel_nm)

    @classmethod
    def centred(cls, pixels: int, pixel_nm: float) -> PixelGrid:
        """Return a square field with centres (i − (n−1)/2)·pixel."""
        axis = (np.arange(pixels, dtype=np.float64) - (pixels - 1) / 2) * pixel_nm
        return cls(axis, axis, pixel_nm)

    @cached_property
    def is_regular(self) -> bool:
        """Whether neighbours are one pixel apart everywhere, to a millionth of it."""
        steps = np.concatenate([np.diff(self.x_nm), np.diff(self.y_nm)])
        return bool(np.all(np.abs(steps - self.pixel_nm) < 1e-6 * self.pixel_nm))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows, columns."""
        return self.y_nm.size, self.x_nm.size

    def farthest_nm(self, x_nm: float, y_nm: float) -> float:
        """Largest distance of a place from the grid's pixels, their edges included [nm]."""
        far_x = max(abs(self.x_nm[0] - x_nm), abs(self.x_nm[-1] - x_nm))
        far_y = max(abs(self.y_nm[0] - y_nm), abs(self.y_nm[-1] - y_nm))
        return math.hypot(far_x + self.pixel_nm / 2, far_y + self.pixel_nm / 2)

    @property
    def diagonal_nm(self) -> float:
        """Largest distance inside the grid, pixel edges included [nm]."""
        return math.hypot(
            self.x_nm[-1] - self.x_nm[0] + self.pixel_nm,
            self.y_nm[-1] - self.y_nm[0] + self.pixel_nm,
        )


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
        # the error vanishes at 0.9 of the band, and is about even below and above
        weights, at = weights / 2, 0.9 * phase
        factor = 1.0
        # Newton's steps to this point
        for _ in range(8 if count > 1 else 0):
            turn = factor * at * places
            error = float(weights @ np.cos(turn)) - float(np.sinc(at / math.pi))
            factor += error / float(weights @ (np.sin(turn) * at * places))
        waves = phase * _WAVES
        mean = weights @ np.cos(np.outer(factor * places, waves))
        if np.abs(mean - np.sinc(waves / math.pi)).max() <= TOLERANCE:
            break
    return factor * places, weights
