"""Landing movies of a microscope that is not the same everywhere in its field.

Every particle is drawn with the optics of its own place, by `instruments`, which knows nothing of
the model that is fitted.  Places are given in halves of the field from its centre.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from instruments import FloatArray, Instrument, Landings, Pictures
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

PIXEL_NM = 84.0
GAIN = 4.0
_RINGS, _SPOKES = 4, 24  # of plane waves in a cone

Optics = Callable[[Instrument, float, float], tuple[Instrument, float]]
"""Gives the instrument at a place, and the amplitude of its reference over that in the middle."""


def half_fields(
    shape: tuple[int, int], x_px: FloatArray, y_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Places in halves of the longer side from the centre."""
    half = max(shape) / 2
    return (x_px - (shape[1] - 1) / 2) / half, (y_px - (shape[0] - 1) / 2) / half


def tilted(x_nm: float, y_nm: float, curvature_nm: float = 0.0) -> Optics:
    """Focus as a plane, and curved."""

    def at(m: Instrument, x: float, y: float) -> tuple[Instrument, float]:
        rise = x_nm * x + y_nm * y + curvature_nm * (x**2 + y**2)
        return replace(m, focus_nm=m.focus_nm + rise), 1.0

    return at


def comatic(size_nm: float) -> Optics:
    """Coma along the radius, growing with it."""

    def at(m: Instrument, x: float, y: float) -> tuple[Instrument, float]:
        terms = dict(m.aberrations_nm)
        terms[8] = terms.get(8, 0.0) + size_nm * x
        terms[7] = terms.get(7, 0.0) + size_nm * y
        return replace(m, aberrations_nm=terms), 1.0

    return at


def astigmatic(x_nm: float, y_nm: float) -> Optics:
    """Astigmatism that is linear in the field."""

    def at(m: Instrument, x: float, y: float) -> tuple[Instrument, float]:
        terms = dict(m.aberrations_nm)
        terms[6] = terms.get(6, 0.0) + x_nm * x - y_nm * y
        terms[5] = terms.get(5, 0.0) + x_nm * y + y_nm * x
        return replace(m, aberrations_nm=terms), 1.0

    return at


def other_reference(curved_rad: float, tilt: float = 0.0) -> Optics:
    """Phase of the reference curved over the field, and its amplitude tilted."""

    def at(m: Instrument, x: float, y: float) -> tuple[Instrument, float]:
        phase = m.reference_phase_deg + math.degrees(curved_rad) * (x**2 + y**2)
        return replace(m, reference_phase_deg=phase), 1 + tilt * x

    return at


def in_a_cone(
    picture: Pictures,
    instrument: Instrument,
    dx_nm: FloatArray,
    dy_nm: FloatArray,
    mass_kda: float,
    illumination_na: float,
) -> FloatArray:
    """Contrast averaged over plane waves of a cone, each with its own path through the oil."""
    if not illumination_na:
        return picture.contrast(dx_nm, dy_nm, mass_kda)
    m, k = instrument, 2 * np.pi / instrument.wavelength_nm
    linear = [picture.quadratures(dx_nm, dy_nm, mass_kda, turn) for turn in (0.0, np.pi / 2)]
    square = picture.contrast(dx_nm, dy_nm, mass_kda) - linear[0]
    points, weights = np.polynomial.legendre.leggauss(_RINGS)
    total = np.zeros(np.broadcast_shapes(dx_nm.shape, dy_nm.shape))
    oil_nm = m.height_nm - m.focus_nm - m.height_nm * m.n_immersion / m.n_sample
    for area, weight in zip((points + 1) / 2, weights / 2, strict=True):
        na = illumination_na * np.sqrt(area)
        path = oil_nm * (np.sqrt(m.n_immersion**2 - na**2) - m.n_immersion)
        path -= m.height_nm * (np.sqrt(m.n_sample**2 - na**2) - m.n_sample)
        for angle in 2 * np.pi * np.arange(_SPOKES) / _SPOKES:
            turn = k * (na * (np.cos(angle) * dx_nm + np.sin(angle) * dy_nm) + path)
            total += weight / _SPOKES * (np.cos(turn) * linear[0] + np.sin(turn) * linear[1])
    return total + square


class UnevenMovie:
    """A landing movie in memory, each particle with its own optics, with Poisson noise."""

    name = "movie"
    path = "movie.tif"

    def __init__(
        self,
        instrument: Instrument,
        optics: Optics,
        shape: tuple[int, int, int],
        landings: Landings,
        *,
        seed: int,
        level_e: float = 1e5,
        illumination_na: float = 0.0,
    ) -> None:
        rng = np.random.default_rng(seed)
        frames, rows, columns = shape
        y, x = np.arange(rows) * PIXEL_NM, np.arange(columns) * PIXEL_NM
        reach_nm = 1.02 * PIXEL_NM * math.hypot(rows, columns)
        middle = Pictures(instrument, reach_nm)
        rough = gaussian_filter(rng.standard_normal((rows, columns)), 3.0, mode="wrap")
        light = level_e * (1 + 0.05 * rough / rough.std())
        places = np.transpose(half_fields((rows, columns), landings.x_px, landings.y_px))
        counts = np.empty(shape, dtype=np.uint16)
        pending = [int(i) for i in np.argsort(landings.frame)]
        for t in range(frames):
            while pending and landings.frame[pending[0]] <= t:
                i = pending.pop(0)
                local, reference = optics(instrument, *(float(v) for v in places[i]))
                picture = Pictures(local, reach_nm)
                size = float(landings.mass_kda[i]) * middle.per_kda / picture.per_kda / reference
                at = (
                    (x - landings.x_px[i] * PIXEL_NM)[None, :],
                    (y - landings.y_px[i] * PIXEL_NM)[:, None],
                )
                light = light * (1 + in_a_cone(picture, local, *at, size, illumination_na))
            expected = light * (1 + 0.01 * rng.standard_normal())
            noisy = expected + np.sqrt(expected) * rng.standard_normal((rows, columns))
            counts[t] = np.floor(noisy / GAIN + rng.random((rows, columns)))
        self.counts, self.shape, self.dtype = counts, shape, counts.dtype

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Frames [start, stop)."""
        return self.counts[start:stop]
