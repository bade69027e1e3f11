"""Grids of pixels, and where the light of a pixel is sampled to integrate it over its area.

A pixel counts the light on all of its active area.  The mean over a square of side d multiplies a
wave of wave vector q by sinc(q_x d/2) sinc(q_y d/2).  With pixels of 84 nm at 525 nm and NA 1.42
the picture of a particle is 5 % fainter for it, with pixels of 120 nm 9 %.

The image of a particle at one height, sampled on the grid of the pixels, sharp or blurred.

The signal of a pixel is band-limited, the interference at k·NA and the scattered light at twice
that.  Its value at any position follows from `TAPS` samples along each axis.  Their weights have
the smallest mean-square error over the band, against a wave that is shifted to this position and
dimmed by the blur,

    w(t) = argmin ∫ |Σ_l w_l e^{iu(l − 3)} − e^{iut} e^{−q u²/2}|² du,

with u the wavenumber times the distance of the samples, t the position between two samples and q
the variance of the blur in units of that distance squared.  One set of samples is therefore enough
for every blur, of the interference and of the scattered light.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np

from iscat_analysis._kernels.image import signal_image
from iscat_analysis._kernels.lattice import DEGREE, TAPS
from iscat_analysis._kernels.lens import Pixels, StampLens
from iscat_analysis.config import AUTO, CameraConfig, Optics
from iscat_analysis.errors import DataError
from iscat_analysis.records import FloatArray

if TYPE_CHECKING:
    from iscat_analysis.config import Optics
    from iscat_analysis.optics.model import ForwardModel

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


BAND = 0.8
"""Largest u of the interference: the error of the sharp image is 4e-6, of its gradient 1e-5."""

RINGS = 1.6
"""The same, far from the particle: the relative error of the rings of the interference is 1e-3, and
the square of the scattered field is negligible."""


def samples_per_pixel(optics: Optics, pixel_nm: float, band: float = BAND) -> int:
    """Give how many samples per pixel the image needs along each axis."""
    return max(1, math.ceil(bandwidth(optics) * pixel_nm / band))


def margin_nm(optics: Optics, pixel_nm: float) -> float:
    """Give how far beyond the pixels a model must be sampled."""
    return pixel_nm + TAPS / 2 * pixel_nm / samples_per_pixel(optics, pixel_nm)


def sample_picture(
    model: ForwardModel, pixel_nm: float, half_px: float, band: float = BAND
) -> tuple[StampLens, FloatArray]:
    """Sample the image of a particle at the model's height.

    Shapes: `samples` (2, nodes, nodes).
    """
    fine = samples_per_pixel(model.optics, pixel_nm, band)
    step = pixel_nm / fine
    half = math.ceil(half_px * fine) + TAPS
    nodes = np.asarray(step * np.arange(-half, half + 1), dtype=np.float64)
    offsets, weights = model.area.points(pixel_nm)
    profile = model.profile(model.height_nm, 1)
    # as strong as the reference, so that neither P nor Q is lost in the rounding of the other
    z = 1 / math.sqrt(model.wave.peak(model.height_nm, 1.0, model.rho)[1])
    reach = model.reach_nm - math.sqrt(2) * pixel_nm
    both = np.zeros((2, nodes.size, nodes.size))
    for row, y in enumerate(nodes):
        inside = np.flatnonzero(nodes**2 + y**2 < reach**2)
        if not inside.size:
            continue
        pixels = Pixels(nodes[inside], np.array([y]), offsets, weights)
        for k, sign in enumerate((1.0, -1.0)):
            out = np.empty((1, inside.size))
            signal_image(profile, model.lens, pixels, np.array([0.0, 0.0, 0.0, sign * z]), out)
            both[k, row, inside] = out[0]
    up, down = both
    samples = np.stack([(up - down) / (2 * z), (up + down) / (2 * z**2)])
    per_phase = math.ceil(nodes.size / fine)
    padded = np.pad(samples, ((0, 0), (0, 0), (0, per_phase * fine - nodes.size)))
    phased = padded.reshape(2, nodes.size, per_phase, fine).swapaxes(2, 3)
    lens = StampLens(1 / step, half, weights_between(0.0, band), fine)
    return lens, np.ascontiguousarray(phased.reshape(2, nodes.size, -1))


@lru_cache(256)
def weights_between(variance: float, band: float = BAND) -> FloatArray:
    """Weights of the samples around a position, for a blur.

    Shapes: result (degree + 1, TAPS).
    """
    # of the quadrature over each band
    points, quadrature = np.polynomial.legendre.leggauss(24)
    u = band * np.concatenate([(points + 1) / 2, (points + 3) / 2])
    # beyond the band, to twice its end, there is little light
    root = np.sqrt(np.concatenate([quadrature, 1e-3**2 * quadrature]))
    waves = np.exp(1j * np.outer(u, np.arange(TAPS) - (TAPS // 2 - 1))) * root[:, None]
    t = (1 - np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))) / 2
    wanted = np.exp(1j * np.outer(u, t) - variance * u[:, None] ** 2 / 2) * root[:, None]
    left, right = (np.concatenate([part.real, part.imag]) for part in (waves, wanted))
    weights = np.linalg.lstsq(left, right, rcond=1e-15)[0]  # (TAPS, places)
    return np.linalg.solve(np.vander(t, DEGREE + 1, increasing=True), weights.T)
