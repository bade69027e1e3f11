"""The picture of a particle, where no microscope describes it: a maximum-likelihood template.

The idea is the effective point-spread function of J. Anderson and I. R. King, Publ. Astron. Soc.
Pac. 112, 1360 (2000), as in photutils: fit places and strengths with a picture, fit the picture to
places and strengths, repeat.  What is particular to interference is done here instead of there:
contrasts of either sign, the counts before and after with their own weights, the level of the light
of every picture, and a band limit in place of smoothing kernels: no light leaves the glass with a
wave vector beyond 2π n/λ, so that plane waves up to there say all that any microscope can show.

The picture is linear in the amplitudes of these waves.  Their prior knows that rings fade with
the distance, as the picture of the round before had them, and its variance is the one that makes
the pictures most probable (D. J. C. MacKay, Neural Comput. 4, 415, 1992).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.learner.particle_images import ParticleImage
from iscat_analysis.instrument.learner.starts import average_particle_images
from iscat_analysis.optics.forward import ForwardModel, peak_per_amplitude, with_template
from iscat_analysis.optics.measured import Template
from iscat_analysis.records import FloatArray, Mapper

_ROUNDS = 8
_SETTLED = 0.1  # change of the picture, over its noise, at which rounds end
_FADE_NM = 250.0  # beyond the pictures the template fades to nothing
_ROOM_NM = 250.0  # between periodic images, beside what fades
_ROAM_NM = 400.0  # along x and y, in the fit of one picture
_RING_NM = 150.0  # width of the rings on which the prior is told
_LEAST = 1e-4  # of its variance, relative to that of the centre
_FINE = 8  # points per step of the lattice, where the peak is looked for
_EVIDENCE = 30  # steps of the variance of the prior


@dataclass(frozen=True)
class _Waves:
    """Plane waves on a periodic square: a constant, cosines, sines."""

    qx: FloatArray
    qy: FloatArray

    @classmethod
    def within(cls, band: float, side_nm: float) -> _Waves:
        unit = 2 * math.pi / side_nm
        most = int(band / unit)
        kx, ky = np.meshgrid(np.arange(-most, most + 1), np.arange(-most, most + 1))
        half = (ky > 0) | ((ky == 0) & (kx >= 0))
        inside = half & (np.hypot(kx, ky) * unit <= band)
        order = np.argsort(np.hypot(kx, ky)[inside], kind="stable")
        return cls(unit * kx[inside][order], unit * ky[inside][order])

    def on(
        self, dx_nm: FloatArray, dy_nm: FloatArray, blur: tuple[FloatArray, FloatArray] | None
    ) -> FloatArray:
        """Values at rows dy and columns dx, averaged over pixels; shape (ny·nx, waves)."""
        along, up = (np.exp(1j * np.outer(d, q)) for d, q in ((dx_nm, self.qx), (dy_nm, self.qy)))
        if blur is not None:
            offsets, weights = blur
            along *= weights @ np.cos(np.outer(offsets, self.qx))
            up *= weights @ np.cos(np.outer(offsets, self.qy))
        both = (up[:, None] * along[None]).reshape(-1, self.qx.size)
        return np.concatenate([both.real, both.imag[:, 1:]], axis=1)

    def slopes(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients of the derivatives along x and y."""
        n = self.qx.size
        cos, sin = coefficients[:n], np.concatenate([[0.0], coefficients[n:]])
        out = []
        for q in (self.qx, self.qy):
            out.append(np.concatenate([q * sin, (-q * cos)[1:]]))
        return out[0], out[1]

    def moved(self, coefficients: FloatArray, x_nm: float, y_nm: float) -> FloatArray:
        """Coefficients of the picture with (x, y) in the place of the origin."""
        n = self.qx.size
        cos, sin = coefficients[:n], np.concatenate([[0.0], coefficients[n:]])
        turned = (cos - 1j * sin) * np.exp(1j * (self.qx * x_nm + self.qy * y_nm))
        return np.concatenate([turned.real, -turned.imag[1:]])


@dataclass(frozen=True)
class PictureFit:
    """A template and the pictures that made it."""

    template: Template
    sights: tuple[ParticleImage, ...]
    effective: float
    rounds: int


def fit_picture(
    sights: Sequence[ParticleImage],
    nominal: ForwardModel,
    *,
    roi_nm: float,
    step_nm: float,
    level: bool,
    mapper: Mapper = map,
) -> PictureFit:
    """Fit the picture that all particles share."""
    pixel = sights[0].grid.pixel_nm
    side = max(sights[0].grid.shape) * pixel
    waves = _Waves.within(1.2 / step_nm, side + 2 * (_FADE_NM + _ROOM_NM))
    own = list(sights)
    offsets, weights = nominal.samples
    blur = (offsets * pixel, weights)
    coefficients, scale = np.zeros(2 * waves.qx.size - 1), peak_per_amplitude(nominal)
    prior = np.eye(coefficients.size)
    used, moved = 0, math.inf
    while used < _ROUNDS and moved > _SETTLED:
        used += 1
        found = _solve(own, nominal, waves, coefficients, prior, scale, blur, level, mapper)
        before, (coefficients, covariance, effective) = coefficients, found
        coefficients, shift, size = _gauge(waves, coefficients, side / 2, step_nm, own)
        own = [
            replace(s, x_nm=s.x_nm + shift[0], y_nm=s.y_nm + shift[1], mass_kda=s.mass_kda * size)
            for s in own
        ]
        covariance = covariance / size**2
        prior = _prior(waves, coefficients, covariance, step_nm)
        template = _template(
            waves, coefficients, covariance, own, roi_nm=roi_nm, side_nm=side, step_nm=step_nm
        )
        model = with_template(nominal, template)
        own = list(mapper(lambda s, m=model: fit_own(s, m, level=level), own))
        moved = float(np.linalg.norm(coefficients - before) / np.sqrt(np.trace(covariance)))
    return PictureFit(template, tuple(own), effective, used)


def fit_own(sight: ParticleImage, model: ForwardModel, *, level: bool) -> ParticleImage:
    """Fit what is a picture's own."""
    likelihood = Likelihood(model, sight.grid, sight.noise, sight.data)
    start = np.array([sight.x_nm, sight.y_nm, model.height_nm, sight.mass_kda, sight.level])
    room = np.array([_ROAM_NM, _ROAM_NM, 0.0, 20 * abs(sight.mass_kda), float(level)])
    half = (np.array(sight.grid.shape[::-1]) - 1) / 2 * sight.grid.pixel_nm
    centre = np.array([sight.grid.x_nm.mean(), sight.grid.y_nm.mean()])
    start[:2] = np.clip(start[:2], centre - np.minimum(half, _ROAM_NM), centre + _ROAM_NM)
    low, high = start - room, start + room
    low[:2], high[:2] = centre - _ROAM_NM, centre + _ROAM_NM
    free = np.array([True, True, False, True, level])
    found = likelihood.maximize(start, free, low, high).theta
    return sight.moved(found)


def place_particle_images(
    sights: Sequence[ParticleImage], nominal: ForwardModel
) -> list[ParticleImage]:
    """Register pictures on their average, and say how much of it each shows."""
    (average,), placed = average_particle_images(sights)
    scale = peak_per_amplitude(nominal)
    shown = average.data[0] / (average.data[1] - average.data[0]) - 1
    top = float(np.abs(shown).max())
    out = []
    for sight in placed:
        rows, columns = (
            (axis[:, None] - at) / sight.grid.pixel_nm + (n - 1) / 2
            for axis, at, n in (
                (sight.grid.y_nm, sight.y_nm, shown.shape[0]),
                (sight.grid.x_nm, sight.x_nm, shown.shape[1]),
            )
        )
        places = np.broadcast_arrays(rows, columns.T)
        moved = ndimage.map_coordinates(shown, places, order=3, mode="nearest") / top
        contrast, weight = _seen(sight, nominal, np.zeros(sight.grid.shape))
        moved = moved - np.average(moved, weights=weight)
        strength = np.sum(weight * moved * contrast) / np.sum(weight * moved**2)
        out.append(replace(sight, mass_kda=float(strength) / scale))
    return out


def _seen(
    sight: ParticleImage, nominal: ForwardModel, signal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured signal of a picture and its information, 0 where masked; the model takes no part."""
    likelihood = Likelihood(nominal, sight.grid, sight.noise, sight.data)
    return np.nan_to_num(likelihood.measured_signal()), likelihood.signal_information(signal)


def _solve(
    sights: Sequence[ParticleImage],
    nominal: ForwardModel,
    waves: _Waves,
    coefficients: FloatArray,
    prior: FloatArray,
    scale: float,
    blur: tuple[FloatArray, FloatArray],
    level: bool,
    mapper: Mapper,
) -> tuple[FloatArray, FloatArray, float]:
    """One Gauss–Newton step of the picture, places and levels eliminated picture by picture.

    Returns the coefficients, their covariance with the strengths held, and how many of them the
    data determine.
    """
    began = bool(np.any(coefficients))
    along, up = waves.slopes(coefficients)

    def one(sight: ParticleImage) -> tuple[FloatArray, FloatArray]:
        grid, strength, gain = sight.grid, sight.mass_kda * scale, math.exp(sight.level)
        basis = waves.on(grid.x_nm - sight.x_nm, grid.y_nm - sight.y_nm, blur)
        shown = strength * (basis @ coefficients)
        bright = (1 + shown / 2) ** 2
        contrast, weight = _seen(sight, nominal, (bright - 1).reshape(grid.shape))
        root = np.sqrt(weight.ravel())
        rest = root * (contrast.ravel() - (gain * bright - 1))
        rate = root * gain * (1 + shown / 2) * strength
        rows = basis * rate[:, None]
        nuisance = [root * bright] if level else []
        if began:
            nuisance += [rate * (basis @ slope) for slope in (along, up)]
        if nuisance:
            q, _ = np.linalg.qr(np.stack(nuisance, axis=1))
            rows = rows - q @ (q.T @ rows)
            rest = rest - q @ (q.T @ rest)
        return rows.T @ rows, rows.T @ rest

    found = list(mapper(one, sights))
    information = np.sum([each[0] for each in found], axis=0)
    pull = np.sum([each[1] for each in found], axis=0) + information @ coefficients
    values, vectors = np.linalg.eigh(prior.T @ information @ prior)
    values = np.maximum(values, 0.0)
    vectors = prior @ vectors
    turned = vectors.T @ pull
    ridge = 1e-3 * float(values[-1])
    effective = 0.0
    for _ in range(_EVIDENCE):
        solved = turned / (values + ridge)
        effective = float(np.sum(values / (values + ridge)))
        ridge = effective / float(np.sum(solved**2))
    solved = turned / (values + ridge)
    covariance = (vectors / (values + ridge)) @ vectors.T
    return vectors @ solved, covariance, effective


def _prior(
    waves: _Waves, coefficients: FloatArray, covariance: FloatArray, step_nm: float
) -> FloatArray:
    """Root of the covariance of a picture whose variance fades with the distance, shape (k, k)."""
    side = 2 * math.pi / float(np.min(np.abs(waves.qx[waves.qx != 0])))
    points = 2 * math.ceil(side / step_nm / 2)
    axis = np.asarray((np.arange(points) - points // 2) * (side / points), dtype=np.float64)
    basis = waves.on(axis, axis, None)
    noise = np.einsum("pi,ij,pj->p", basis, covariance, basis, optimize=True)
    energy = (basis @ coefficients) ** 2 - noise
    ring = np.rint(np.hypot(axis[:, None], axis).ravel() / _RING_NM).astype(int)
    mean = np.bincount(ring, energy) / np.maximum(np.bincount(ring), 1)
    fading = np.maximum.accumulate(np.maximum(mean, _LEAST * mean.max())[::-1])[::-1]
    spread = np.sqrt(fading / fading[0])[ring]
    back = basis.T * np.where(np.arange(coefficients.size) == 0, 1.0, 2.0)[:, None] / ring.size
    return np.asarray((back * spread) @ basis)


def _gauge(
    waves: _Waves,
    coefficients: FloatArray,
    half_nm: float,
    step_nm: float,
    sights: Sequence[ParticleImage],
) -> tuple[FloatArray, tuple[float, float], float]:
    """Centre the energy, make the peak 1 and landings positive; give the shift and the factor."""
    axis = np.arange(-half_nm, half_nm + step_nm / 2, step_nm)
    image = (waves.on(axis, axis, None) @ coefficients).reshape(axis.size, axis.size)
    energy = image**2 / np.sum(image**2)
    x, y = float(energy.sum(axis=0) @ axis), float(energy.sum(axis=1) @ axis)
    centred = waves.moved(coefficients, x, y)
    image = (waves.on(axis, axis, None) @ centred).reshape(axis.size, axis.size)
    row, column = np.unravel_index(int(np.argmax(np.abs(image))), image.shape)
    fine = step_nm * np.linspace(-1, 1, 2 * _FINE + 1)
    near = waves.on(axis[column] + fine, axis[row] + fine, None) @ centred
    size = float(np.abs(near).max())
    if sum(math.copysign(1.0, sight.mass_kda) for sight in sights) < 0:
        size = -size
    return centred / size, (x, y), size


def _template(
    waves: _Waves,
    coefficients: FloatArray,
    covariance: FloatArray,
    sights: Sequence[ParticleImage],
    *,
    roi_nm: float,
    side_nm: float,
    step_nm: float,
) -> Template:
    """Sample the picture on its lattice; beyond what was seen it fades."""
    count = math.ceil((side_nm / 2 + _FADE_NM) / step_nm)
    axis = np.asarray(step_nm * np.arange(-count, count + 1), dtype=np.float64)
    beyond = np.clip((np.abs(axis) - side_nm / 2) / _FADE_NM, 0, 1)
    fade = np.cos(math.pi / 2 * beyond) ** 2
    basis = waves.on(axis, axis, None)
    window = np.outer(fade, fade)
    image = (basis @ coefficients).reshape(axis.size, axis.size) * window
    variance = np.einsum("pi,pi->p", basis @ covariance, basis).reshape(image.shape)
    # the strengths take what resembles the picture itself; the rest moves the peak
    peak = basis[int(np.argmax(np.abs(image)))]
    own = coefficients / np.sum(coefficients**2)
    rest = peak - (peak @ coefficients) * own
    return Template(
        contrast=image,
        sigma=np.sqrt(variance) * window,
        step_nm=step_nm,
        pixel_nm=sights[0].grid.pixel_nm,
        roi_nm=roi_nm,
        peak_se=float(np.sqrt(rest @ covariance @ rest)),
        sights=len(sights),
    )
