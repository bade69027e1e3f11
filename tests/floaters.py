"""Movies of nanoparticles that diffuse in a thin volume, through microscopes of `instruments`.

As in `wanderers` a frame is the average of the pictures along the path, summed in the space of wave
vectors; here each place of the path has the picture of its own height.  Pictures are tabulated
along z, every `STEP_NM`, and interpolated by cubic polynomials.  Nothing is taken from the package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pandas as pd
from instruments import Instrument, Pictures, strength_of_sphere
from numpy.typing import NDArray
from scipy.fft import fft2, irfft2, next_fast_len
from scipy.ndimage import gaussian_filter

FloatArray = NDArray[np.float64]

GOLD = complex(0.592126, 2.135868)
"""Refractive index at 525 nm, P. B. Johnson and R. W. Christy (1972)."""

PARTS = 16
"""Places in one exposure."""

STEP_NM = 8.0
"""Between tabulated heights: the phase turns by a quarter, and the cubic is off by 1e-4."""

MARGIN_PX = 8.0
"""How far out of the field particles go before they turn back."""


@dataclass(frozen=True)
class Sphere:
    """Spheres of one kind: diameter [nm], D along each axis [µm²/s], index and number."""

    diameter_nm: float = 30.0
    d_um2_s: float = 16.36
    index: complex = GOLD
    count: int = 1


@dataclass(frozen=True)
class Floaters:
    """A movie and its truth.

    Attributes
    ----------
    counts : ndarray of uint16, shape (frames, y, x)
        What the camera gives.
    truth : DataFrame
        track, frame, x_nm, y_nm, z_nm (averages over the exposure), inside (whether that is in the
        field), d_um2_s; one row for each particle and frame.
    """

    counts: NDArray[np.uint16]
    truth: pd.DataFrame


class Volume:
    """Pictures of spheres at all heights, as spectra that paths are summed in.

    `field_px` is (rows, columns); the default instrument conserves energy.
    """

    def __init__(
        self,
        field_px: tuple[int, int],
        *,
        ceiling_nm: float = 2000.0,
        instrument: Instrument | None = None,
        pixel_nm: float = 84.0,
    ) -> None:
        self.field_px, self.ceiling_nm, self.pixel_nm = field_px, ceiling_nm, pixel_nm
        self.instrument = instrument or Instrument(emission="reciprocal")
        side = next_fast_len(2 * (max(field_px) + math.ceil(MARGIN_PX) + 1))
        self._side = side
        offset = (np.arange(side) - side // 2) * pixel_nm
        at = offset[None, :], offset[:, None]
        pictures = Pictures(self.instrument, 1.02 * math.sqrt(2) * side / 2 * pixel_nm)
        heights = STEP_NM * np.arange(-1, math.ceil(ceiling_nm / STEP_NM) + 3)
        self._first = float(heights[0])
        # 2 Re(s e) + |s e|² for any strength s: of e at two phases, and of its square
        self._spectra = np.empty((len(heights), 3, side, side // 2 + 1), dtype=complex)
        for n, z in enumerate(heights):
            here = pictures.at_height(float(z))
            for k, term in enumerate(here.terms_of_scatterer(*at)):
                self._spectra[n, k] = _spectrum(term)
        self._ky = 2 * np.pi * np.fft.fftfreq(side)
        self._kx = 2 * np.pi * np.fft.rfftfreq(side)

    def contrast(self, places_nm: FloatArray, strength: complex) -> FloatArray:
        """Average contrast of one sphere along a path (n, 3) [nm], shape (y, x)."""
        along = np.exp(-1j * np.outer(places_nm[:, 0] / self.pixel_nm, self._kx))
        across = np.exp(-1j * np.outer(places_nm[:, 1] / self.pixel_nm, self._ky))
        parts = strength.real, strength.imag, abs(strength) ** 2
        total = np.zeros(self._spectra.shape[2:], dtype=complex)
        for n, z in enumerate(places_nm[:, 2]):
            index, weights = _cubic((z - self._first) / STEP_NM)
            here = np.tensordot(
                np.outer(weights, parts), self._spectra[index - 1 : index + 3], axes=2
            )
            total += here * across[n][:, None] * along[n]
        rows, columns = self.field_px
        return irfft2(total / len(places_nm), s=(self._side, self._side))[:rows, :columns]

    def record(
        self,
        frames: int,
        spheres: tuple[Sphere, ...] = (Sphere(),),
        *,
        seed: int,
        level_e: float = 2e4,
        speckle: float = 0.15,
        power_noise: float = 0.01,
        frame_rate_hz: float = 1000.0,
        exposure_ms: float = 0.05,
        gain_e_per_adu: float = 2.0,
        spread_nm: float = 800.0,
    ) -> Floaters:
        """Record spheres that diffuse between walls which reflect.

        `speckle` and `power_noise` are the relative spread of the light from pixel to pixel and
        frame to frame; particles begin within `spread_nm` of the middle of the field.
        """
        rng = np.random.default_rng(seed)
        kinds = [sphere for sphere in spheres for _ in range(sphere.count)]
        walks = np.stack([
            self._path(rng, frames, sphere, 1 / frame_rate_hz, exposure_ms / 1e3, spread_nm)
            for sphere in kinds
        ])  # fmt: skip
        rows, columns = self.field_px
        rough = gaussian_filter(rng.standard_normal((rows, columns)), 3.0, mode="wrap")
        light = level_e * (1 + speckle * rough / rough.std())
        counts = np.empty((frames, rows, columns), dtype=np.uint16)
        strengths = [strength_of_sphere(self.instrument, s.diameter_nm, s.index) for s in kinds]
        for t in range(frames):
            signal = sum(
                self.contrast(walk[t], strength)
                for walk, strength in zip(walks, strengths, strict=True)
            )
            expected = (1 + power_noise * rng.standard_normal()) * light * (1 + signal)
            noisy = expected + np.sqrt(expected) * rng.standard_normal((rows, columns))
            counts[t] = np.floor(noisy / gain_e_per_adu + rng.random((rows, columns)))
        mean = walks.mean(axis=2)
        field = np.array([columns - 1, rows - 1]) * self.pixel_nm
        inside = ((mean[..., :2] >= 0) & (mean[..., :2] <= field)).all(axis=2)
        track, frame = (k.ravel() for k in np.indices(inside.shape))
        truth = pd.DataFrame({
            "track": track, "frame": frame,
            **{name: mean[..., k].ravel() for k, name in enumerate(("x_nm", "y_nm", "z_nm"))},
            "inside": inside.ravel(),
            "d_um2_s": np.array([s.d_um2_s for s in kinds])[track],
        })  # fmt: skip
        return Floaters(counts, truth)

    def _path(
        self,
        rng: np.random.Generator,
        frames: int,
        sphere: Sphere,
        interval_s: float,
        exposure_s: float,
        spread_nm: float,
    ) -> FloatArray:
        """Places in the parts of every exposure, shape (frames, PARTS, 3) [nm]."""
        rows, columns = self.field_px
        margin = MARGIN_PX * self.pixel_nm
        low = np.array([-margin, -margin, sphere.diameter_nm / 2])
        high = np.array([
            (columns - 1) * self.pixel_nm + margin, (rows - 1) * self.pixel_nm + margin,
            self.ceiling_nm,
        ])  # fmt: skip
        part = exposure_s / PARTS
        waits = np.full((frames, PARTS), part)
        waits[:, 0] = interval_s - (PARTS - 1) * part
        steps = np.sqrt(2e6 * sphere.d_um2_s * waits)[..., None]
        walk = np.cumsum((steps * rng.standard_normal((frames, PARTS, 3))).reshape(-1, 3), axis=0)
        size = high - low
        aside = np.maximum(size[:2] / 2 - spread_nm, 0.0)
        walk += rng.uniform([*aside, 0.0], [*(size[:2] - aside), size[2]])
        return (low + size - np.abs(walk % (2 * size) - size)).reshape(frames, PARTS, 3)


def _spectrum(image: FloatArray) -> NDArray[np.complex128]:
    return np.asarray(fft2(np.fft.ifftshift(image))[:, : image.shape[1] // 2 + 1])


def _cubic(place: float) -> tuple[int, FloatArray]:
    """Node below a place between nodes, and Lagrange's weights of the four around it."""
    index = math.floor(place)
    u = place - index
    return index, np.array([
        -u * (u - 1) * (u - 2) / 6, (u + 1) * (u - 1) * (u - 2) / 2,
        -(u + 1) * u * (u - 2) / 2, (u + 1) * u * (u - 1) / 6,
    ])  # fmt: skip
