"""Movies seen through microscopes that the configuration does not describe.

The picture of a dipole is a sum over the whole pupil, ray by ray and azimuth by azimuth, with
scipy's Bessel functions: nothing here is taken from the package, so that a movie made with it knows
nothing of the model that is fitted.  Pictures are scaled to a peak contrast per kDa, as a mass
calibration would.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, shift
from scipy.special import jv

FloatArray = NDArray[np.float64]

PEAK_PER_KDA = 3.1e-5
_AZIMUTHS = 64
_FARTHEST_NM = 20_000.0
_NEAREST_NM = 4_000.0
_FOCUS_PART_NM = 30.0  # between these a picture is cubic in the focus
_NEGLIGIBLE = 1e-10  # share of a harmonic below which it is left out


@dataclass(frozen=True)
class Instrument:
    """One microscope; lengths in nm, aberrations by Noll's index as rms of the wavefront."""

    wavelength_nm: float = 525.0
    na: float = 1.42
    n_immersion: float = 1.515
    n_glass: float = 1.515
    n_sample: float = 1.33
    focus_nm: float = -300.0
    height_nm: float = 5.0
    emission: str = "dong2021"
    circular: bool = False
    analyzer: bool = False
    mask_na: float = 0.0
    attenuation: float = 1.0
    reference_phase_deg: float = 0.0
    aberrations_nm: Mapping[int, float] = field(default_factory=dict)
    ghost: tuple[float, float, float, float] | None = None
    """A second image of the particle's light: amplitude, phase [deg] and place [nm]."""


def _zernike(j: int, rho: FloatArray, phi: FloatArray) -> FloatArray:
    """Noll's polynomials of rms 1, less their value at the centre."""
    forms = {
        5: np.sqrt(6) * rho**2 * np.sin(2 * phi),
        6: np.sqrt(6) * rho**2 * np.cos(2 * phi),
        7: np.sqrt(8) * (3 * rho**3 - 2 * rho) * np.sin(phi),
        8: np.sqrt(8) * (3 * rho**3 - 2 * rho) * np.cos(phi),
        9: np.sqrt(8) * rho**3 * np.sin(3 * phi),
        10: np.sqrt(8) * rho**3 * np.cos(3 * phi),
        11: np.sqrt(5) * (6 * rho**4 - 6 * rho**2),
    }
    return forms[j]


@lru_cache(maxsize=2)
def _bessel(argument: bytes, shape: tuple[int, int]) -> FloatArray:
    """Bessel functions of orders 0 to 8, which microscopes of one aperture share."""
    return np.array([jv(h, np.frombuffer(argument).reshape(shape)) for h in range(9)])


class Pictures:
    """Contrast of a particle through one microscope, as far as `reach_nm` from it.

    Light is averaged over pixels; where `pixel_nm` is 0 it is that at a point.
    """

    def __init__(
        self, instrument: Instrument, reach_nm: float = _FARTHEST_NM, pixel_nm: float = 84.0
    ) -> None:
        self._inside_nm = pixel_nm / 2 * np.polynomial.legendre.leggauss(2)[0]
        m = instrument
        k = 2 * np.pi / m.wavelength_nm
        alpha = np.arcsin(m.na / m.n_immersion)
        reach_nm = max(reach_nm, _NEAREST_NM)
        x, w = np.polynomial.legendre.leggauss(math.ceil(170 * max(1, reach_nm / _FARTHEST_NM)))
        # θ = θ_c + v|v| smooths the root at the critical angle; the edge of the mask is an end
        critical = np.arcsin(min(m.n_sample, m.na) / m.n_immersion)
        ends = [0.0, np.arcsin(m.mask_na / m.n_immersion), critical, alpha]
        edges = np.unique([np.sign(t - critical) * np.sqrt(abs(t - critical)) for t in ends])
        v = np.concatenate([(a + b + (b - a) * x) / 2 for a, b in pairwise(edges)])
        weight = np.concatenate([(b - a) * w for a, b in pairwise(edges)]) * np.abs(v)
        theta = critical + v * np.abs(v)
        sin, cos = np.sin(theta), np.cos(theta)
        cos_s = np.sqrt(1 - (m.n_immersion * sin / m.n_sample) ** 2 + 0j)
        cos_g = np.sqrt(1 - (m.n_immersion * sin / m.n_glass) ** 2 + 0j)
        up = m.n_glass * cos_g if m.emission == "reciprocal" else m.n_sample * cos_s
        t_p = 2 * up / (m.n_glass * cos_s + m.n_sample * cos_g)
        t_s = 2 * up / (m.n_glass * cos_g + m.n_sample * cos_s)
        oil = m.height_nm - m.focus_nm - m.height_nm * m.n_immersion / m.n_sample
        path = m.n_sample * m.height_nm * (cos_s + 1) + m.n_immersion * oil * (cos - 1)
        phi = 2 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
        rho = m.n_immersion * sin / m.na
        wave = sum(
            (a * _zernike(j, rho[:, None], phi[None]) for j, a in m.aberrations_nm.items()),
            start=np.zeros((theta.size, _AZIMUTHS)),
        )
        jones = np.array([1.0, 1j]) / np.sqrt(2) if m.circular else np.array([1.0, 0.0j])
        along = jones[0] * np.cos(phi) + jones[1] * np.sin(phi)
        across = -jones[0] * np.sin(phi) + jones[1] * np.cos(phi)
        radial = (t_p * cos_s)[:, None] * along
        turning = t_s[:, None] * across
        vector = np.stack([
            radial * np.cos(phi) - turning * np.sin(phi),
            radial * np.sin(phi) + turning * np.cos(phi),
        ])  # fmt: skip
        if m.analyzer:
            vector = np.stack([np.einsum("c,ctp->tp", np.conj(jones), vector)])
            reference = np.array([1.0 + 0j])
        else:
            reference = jones
        passes = np.where(m.n_immersion * sin < m.mask_na, m.attenuation, 1.0)
        pupil = vector * np.exp(1j * k * (path[:, None] + wave)) * (passes * np.sqrt(cos))[:, None]
        harmonics = np.fft.fft(pupil, axis=2) / _AZIMUTHS
        self._orders = [h if h <= 8 else h - _AZIMUTHS for h in (*range(9), *range(56, 64))]
        r = np.arange(0.0, reach_nm, 15.0)
        argument = k * m.n_immersion * sin * r[:, None]
        tables = []
        whole = [jh * (weight * sin) for jh in _bessel(argument.tobytes(), argument.shape)]
        for h in self._orders:
            bessel = whole[abs(h)] * (-1 if h < 0 and h % 2 else 1)
            tables.append(1j**h * np.einsum("rt,ct->rc", bessel, harmonics[:, :, h]))
        self._ghost = m.ghost
        # amplitude of the dipole: −i; the reference's own phase is added to it
        phase = np.exp(1j * np.deg2rad(m.reference_phase_deg))
        self._reference = reference * phase
        size = [np.abs(table).max() for table in tables]
        kept = [n for n, largest in enumerate(size) if largest > _NEGLIGIBLE * max(size)]
        self._orders = [self._orders[n] for n in kept]
        self._spline = CubicSpline(r, -1j * np.array(tables)[kept], axis=1)
        self._distances, self._nominal_nm = r, m.height_nm
        self._rise = k * m.n_sample * (cos_s + 1)  # phase per height
        self._rays = [
            (-1j * 1j**h * whole[abs(h)] * (-1 if h < 0 and h % 2 else 1), harmonics[:, :, h])
            for h in self._orders
        ]
        near = np.linspace(-900.0, 900.0, 181)
        linear, _ = self._terms(near[None, :], near[:, None])
        top = linear.flat[np.argmax(np.abs(linear))]
        self.sign = float(np.sign(top))
        self.per_kda = PEAK_PER_KDA / abs(top)

    def _field(self, dx_nm: FloatArray, dy_nm: FloatArray) -> NDArray[np.complex128]:
        r, phi = np.hypot(dx_nm, dy_nm), np.arctan2(dy_nm, dx_nm)
        parts = self._spline(r)
        e = sum(parts[n] * np.exp(1j * h * phi)[..., None] for n, h in enumerate(self._orders))
        return np.where((r < _FARTHEST_NM - 15.0)[..., None], e, 0.0)

    def _terms(self, dx_nm: FloatArray, dy_nm: FloatArray) -> tuple[FloatArray, FloatArray]:
        e = self._field(dx_nm, dy_nm)
        if self._ghost is not None:
            size, degrees, x, y = self._ghost
            turn = size * np.exp(1j * np.deg2rad(degrees))
            e = e + turn * self._field(dx_nm - x, dy_nm - y)
        linear = 2 * np.real(e @ np.conj(self._reference))
        return linear, np.sum(np.abs(e) ** 2, axis=-1)

    def contrast(self, dx_nm: FloatArray, dy_nm: FloatArray, mass_kda: float) -> FloatArray:
        """Contrast of a particle at camera minus particle coordinates that broadcast."""
        linear, square = self._averaged(self._terms, dx_nm, dy_nm)
        amplitude = mass_kda * self.per_kda
        return amplitude * linear + amplitude**2 * square

    def _averaged(
        self, light: Callable[..., tuple[FloatArray, ...]], dx_nm: FloatArray, dy_nm: FloatArray
    ) -> list[FloatArray]:
        """Average light over the pixels around points."""
        points = [light(dx_nm + x, dy_nm + y) for x in self._inside_nm for y in self._inside_nm]
        return [np.mean(parts, axis=0) for parts in zip(*points, strict=True)]

    def quadratures(
        self, dx_nm: FloatArray, dy_nm: FloatArray, mass_kda: float, turn: float
    ) -> FloatArray:
        """Interference with a reference that is ahead by an angle."""
        reference = np.conj(self._reference * np.exp(1j * turn))
        (light,) = self._averaged(
            lambda x, y: (2 * np.real(self._field(x, y) @ reference),), dx_nm, dy_nm
        )
        return mass_kda * self.per_kda * light

    def at_height(self, z_nm: float) -> Pictures:
        """Put the particle at another height, and leave the focus where it was."""
        turn = np.exp(1j * self._rise * (z_nm - self._nominal_nm))
        tables = [rays @ (pupil * turn).T for rays, pupil in self._rays]
        out = copy(self)
        out._spline = CubicSpline(self._distances, np.array(tables), axis=1)
        return out

    def scatterer(
        self, dx_nm: FloatArray, dy_nm: FloatArray, field_over_reference: complex
    ) -> FloatArray:
        """Contrast of a scatterer of absolute strength, see `strength_of_sphere`."""
        linear, turned, square = self.terms_of_scatterer(dx_nm, dy_nm)
        s = field_over_reference
        return s.real * linear + s.imag * turned + abs(s) ** 2 * square

    def terms_of_scatterer(
        self, dx_nm: FloatArray, dy_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Give what real part, imaginary part and squared size of a strength multiply."""
        real, imaginary, square = self._averaged(self._of_scatterer, dx_nm, dy_nm)
        return real, imaginary, square

    def _of_scatterer(
        self, dx_nm: FloatArray, dy_nm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Do what `terms_of_scatterer` does, at points."""
        r, phi = np.hypot(dx_nm, dy_nm), np.arctan2(dy_nm, dx_nm)
        parts = self._spline(r)
        e = sum(parts[n] * np.exp(1j * h * phi)[..., None] for n, h in enumerate(self._orders))
        along = 2 * e @ np.conj(self._reference)
        return np.real(along), -np.imag(along), np.sum(np.abs(e) ** 2, axis=-1)


def strength_of_sphere(
    instrument: Instrument, diameter_nm: float, refractive_index: complex
) -> complex:
    """Field of a small sphere over the reflected reference, energy-conserving emission."""
    m = instrument
    k = 2 * np.pi / m.wavelength_nm
    inside, outside = refractive_index**2, m.n_sample**2
    polarizability = np.pi / 2 * diameter_nm**3 * (inside - outside) / (inside + 2 * outside)
    into_sample = 2 * m.n_glass / (m.n_glass + m.n_sample)
    back = (m.n_glass - m.n_sample) / (m.n_glass + m.n_sample)
    dipole = (m.n_sample * k) ** 2 * polarizability * into_sample / (4 * np.pi)
    return complex(k * m.n_immersion * dipole / (m.attenuation * back))


def focus_scan(
    instrument: Instrument,
    focus_nm: FloatArray,
    places_px: FloatArray,
    strengths: NDArray[np.complex128],
    shape: tuple[int, int],
    *,
    level_e: float,
    pixel_nm: float,
    seed: int,
) -> NDArray[np.uint16]:
    """Frames of immobile scatterers under even light, one for each focus, with Poisson noise."""
    rng = np.random.default_rng(seed)
    y, x = (np.arange(n) * pixel_nm for n in shape)
    farthest = float(np.hypot(*shape)) * pixel_nm
    frames = np.empty((len(focus_nm), *shape), dtype=np.uint16)
    for t, focus in enumerate(focus_nm):
        pictures = Pictures(replace(instrument, focus_nm=float(focus)), farthest, pixel_nm)
        expected = np.full(shape, level_e)
        for (x_px, y_px), strength in zip(places_px, strengths, strict=True):
            at = (x - x_px * pixel_nm)[None, :], (y - y_px * pixel_nm)[:, None]
            expected *= 1 + pictures.scatterer(*at, complex(strength))
        frames[t] = rng.poisson(expected)
    return frames


@dataclass(frozen=True)
class Landings:
    """Particles that land and stay."""

    frame: NDArray[np.int64]
    x_px: FloatArray
    y_px: FloatArray
    mass_kda: FloatArray


class InstrumentMovie:
    """A landing movie in memory, with Poisson noise.

    Shapes: `shape` is (frames, rows, columns), `focus_nm` (frames,), `beam` (rows, columns),
    `stage_px` (frames, 2) along y and x.

    `focus_nm` is its rise in every frame, and masses are those of the instrument's own focus;
    `speckle` is the standard deviation of the background, and `beam` the light that falls on the
    sample, which stays where it is while the stage moves.
    """

    name = "movie"

    def __init__(
        self,
        instrument: Instrument,
        shape: tuple[int, int, int],
        landings: Landings,
        *,
        seed: int,
        level_e: float = 1e5,
        pixel_nm: float = 84.0,
        gain_e_per_adu: float = 4.0,
        focus_nm: FloatArray | None = None,
        speckle: float = 0.05,
        beam: FloatArray | float = 1.0,
        stage_px: FloatArray | None = None,
    ) -> None:
        rng = np.random.default_rng(seed)
        frames, rows, columns = shape
        y, x = np.arange(rows) * pixel_nm, np.arange(columns) * pixel_nm
        reach_nm = 1.02 * pixel_nm * math.hypot(rows, columns)
        rises = np.zeros(1)
        if focus_nm is not None:
            low, high = min(float(focus_nm.min()), 0.0), max(float(focus_nm.max()), 0.0)
            rises = np.linspace(low, high, max(math.ceil((high - low) / _FOCUS_PART_NM), 3) + 1)
        pictures = [
            Pictures(replace(instrument, focus_nm=instrument.focus_nm + rise), reach_nm, pixel_nm)
            for rise in rises
        ]
        alike = Pictures(instrument, reach_nm)
        rough = gaussian_filter(rng.standard_normal((rows, columns)), 3.0, mode="wrap")
        light = level_e * (1 + speckle * rough / rough.std())
        order = np.argsort(landings.frame)
        counts = np.empty(shape, dtype=np.uint16)
        landed = np.zeros((len(pictures), rows, columns))  # logarithm of 1 + contrast
        moving = None
        pending = [int(i) for i in order]
        for t in range(frames):
            while pending and landings.frame[pending[0]] <= t:
                i = pending.pop(0)
                for number, picture in enumerate(pictures):
                    landed[number] += np.log1p(
                        picture.contrast(
                            (x - landings.x_px[i] * pixel_nm)[None, :],
                            (y - landings.y_px[i] * pixel_nm)[:, None],
                            float(landings.mass_kda[i]) * alike.per_kda / picture.per_kda,
                        )
                    )
                if focus_nm is not None:
                    moving = CubicSpline(rises, landed)
            seen = landed[0] if moving is None or focus_nm is None else moving(focus_nm[t])
            expected = light * np.exp(seen)
            if stage_px is not None:
                expected = shift(expected, stage_px[t], order=3, mode="nearest")
            expected = expected * beam
            power = 1 + 0.01 * rng.standard_normal()
            noisy = power * expected + np.sqrt(power * expected) * rng.standard_normal(
                (rows, columns)
            )
            counts[t] = np.floor(noisy / gain_e_per_adu + rng.random((rows, columns)))
        self.counts = counts
        self.shape = shape
        self.dtype = counts.dtype

    def read(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Frames [start, stop)."""
        return self.counts[start:stop]


def draw_landings(
    shape: tuple[int, int, int],
    count: int,
    *,
    seed: int,
    masses: tuple[float, ...] = (92.0, 205.0, 430.0),
    margin_px: float = 8.0,
    first: int = 60,
    frame: int | None = None,
    apart_px: float = 0.0,
) -> Landings:
    """Particles anywhere, at any time or all in one frame; as many of each mass."""
    rng = np.random.default_rng(seed)
    frames, rows, columns = shape
    places: list[tuple[float, float]] = []
    while len(places) < count:
        x, y = (float(rng.uniform(margin_px, n - 1 - margin_px)) for n in (columns, rows))
        if all(np.hypot(x - a, y - b) >= apart_px for a, b in places):
            places.append((x, y))
    when = rng.integers(first, frames - first, count) if frame is None else np.full(count, frame)
    x_px, y_px = np.array(places).T
    return Landings(when, x_px, y_px, rng.permutation(np.resize(masses, count)))
