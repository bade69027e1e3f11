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
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iscat_analysis.config import Config
from iscat_analysis.diagnosis import calibrated
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import printing
from iscat_analysis.fitting.ranges import background_mode
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.collect import Recording, bright_particle_images
from iscat_analysis.instrument.measure import (
    HELD_OUT_P,
    Judgement,
    judge,
    parted,
    without_contaminated,
)
from iscat_analysis.instrument.particle_image import (
    Images,
    ParticleImage,
    place_particle_images,
    reach_nm,
    refuse_uncalibratable,
    signal_of,
)
from iscat_analysis.movie import Stack
from iscat_analysis.optics.forward import (
    ForwardModel,
    forward_model,
    peak_per_amplitude,
    with_template,
)
from iscat_analysis.optics.parameters import LEAST_IMAGES, settings_of
from iscat_analysis.optics.waves import Template, lattice_step_nm
from iscat_analysis.records import Box, FloatArray, Mapper, Progress, silent
from iscat_analysis.text import in_toml
from iscat_analysis.threads import threads
from iscat_analysis.units import count

MARGINS_PX = (10, 6, 2)
"""Pixels by which pictures may be cut larger on every side than the square that is fitted later.

The farther the template reaches, the more is known of the rings of a particle's neighbours; but
the larger a picture, the fewer hold one particle alone.
"""


@dataclass(frozen=True, eq=False)
class MeasuredPicture:
    """A template, and how it describes pictures that did not make it."""

    config: Config
    fit: PictureFit
    judgement: Judgement
    contaminated: int
    source: Mapping[str, str]
    refusals: tuple[str, ...]

    @property
    def template(self) -> Template:
        """The picture."""
        return self.fit.template

    @property
    def accepted(self) -> bool:
        """Whether it may be used."""
        return not self.refusals

    def headline(self) -> str:
        """Say in one line what was found."""
        judged = self.judgement
        return (
            f"a template from {self.template.sights} particles, {self.fit.effective:.0f} numbers "
            f"determined by them, its peak to {100 * self.template.peak_se:.2g} %; reduced chi2 of "
            f"{judged.p_values.size} that were held out {np.mean(judged.chi2_reduced):.3f} "
            f"(p-values uniform: p = {judged.uniform_p:.2g})"
        )

    def to_dict(self) -> dict[str, Any]:
        """Give what ``template.json`` holds."""
        found = self.template
        return {
            "accepted": self.accepted,
            "refusals": list(self.refusals),
            "particles": found.sights,
            "contaminated": self.contaminated,
            "determined": self.fit.effective,
            "peak_se": found.peak_se,
            "pixel_nm": found.pixel_nm,
            "roi_nm": found.roi_nm,
            "held_out": self.judgement.told,
            "source": dict(self.source),
        }

    def to_toml(self, template: str, checksum: str) -> str:
        """Write what ``[optics] file`` reads."""
        lines = [
            "# Template measured by `iscat calibrate optics --measured`",
            "", "[optics]", 'psf = "measured"', f'template = "{template}"',
            "", "[template]", f'sha256 = "{checksum}"',
            f"pixel_nm = {self.template.pixel_nm:.9g}", f"roi_nm = {self.template.roi_nm:.9g}",
            f"peak_se = {self.template.peak_se:.3g}",
            "", "[provenance]", *(f"{key} = {in_toml(text)}" for key, text in self.source.items()),
            f"particles = {self.template.sights}", "",
        ]  # fmt: skip
        return "\n".join(lines)


def measure_template(
    movie: Stack,
    config: Config,
    *,
    progress: Progress = silent,
    notify: Callable[[str], None] | None = None,
) -> MeasuredPicture:
    """Measure the picture of a particle in an open movie."""
    refuse_uncalibratable(config)
    if config.fit.mode != "mass":
        raise ConfigError(
            f'fit.mode = "{config.fit.mode}" needs the picture at every height, which --measured '
            'does not give: use fit.mode = "mass"'
        )
    ready = calibrated(movie, config, report=printing(notify))
    movie, config = ready.steady, ready.config
    pixel = config.camera.pixel_nm
    roi_nm = config.roi_px * pixel
    physics = config.changed(optics={"psf": "model", "template": None}, calibration=None)
    with threads(config.compute.workers) as pool:
        for number, margin in enumerate(MARGINS_PX):
            progress("particles", number, len(MARGINS_PX))
            cut = physics.changed(fit={"roi_nm": roi_nm + 2 * margin * pixel})
            recording = Recording(movie, cut, ready.camera, pool, ready.opening)
            alone = _alone(*bright_particle_images(recording))
            if len(alone) >= 18:  # pictures with which a margin is good enough
                break
        progress("particles", len(MARGINS_PX), len(MARGINS_PX))
        if len(alone) < LEAST_IMAGES:
            raise DataError(
                f"{movie.path.name}: shows {count(len(alone), 'bright particle')} without another "
                f"nearby, and at least {LEAST_IMAGES} are needed to measure a picture; record more "
                "particles, fewer at a time, or brighter ones"
            )
        nominal = forward_model(cut, max(map(reach_nm, alone)) + roi_nm / 10)
        fitter = PictureFitter(
            nominal,
            roi_nm=max(roi_nm, config.fit.roi_nm),
            step_nm=lattice_step_nm(config.optics.wavelength_nm, config.optics.n_glass),
            level=background_mode(config) == "sliding",
            mapper=pool.map,
        )
        images = place_particle_images(alone, nominal)
        return _judged(images, fitter, ready.with_frames_asked(config), recording.origin())


def _judged(
    images: Images, fitter: PictureFitter, config: Config, source: Mapping[str, str]
) -> MeasuredPicture:
    """Fit with a third held out, leave out what is not a particle alone, then fit them all."""

    def judged(some: Images, found: PictureFit) -> Judgement:
        model = with_template(fitter.nominal, found.template)
        return judge(some, lambda _: model, settings_of(config), fitter.mapper)

    some, others = parted(images)
    first = fitter.fit(some)
    held = fitter.own(others, first.template)
    p_values = judged((*first.images, *held), first).p_values
    kept, rest = without_contaminated(first.images, held, p_values)
    contaminated = p_values.size - len(kept) - len(rest)
    if contaminated:
        first = fitter.fit(kept)
        held = fitter.own(rest, first.template)
    judgement = judged(held, first)
    refusals = (judgement.complaint,) if judgement.uniform_p < HELD_OUT_P else ()
    whole = fitter.fit([*first.images, *held])
    return MeasuredPicture(config, whole, judgement, contaminated, source, refusals)


def _alone(images: Images, others: Images) -> Images:
    """Leave out pictures into which another particle reaches."""

    def is_alone(image: ParticleImage) -> bool:
        # from the edge of a picture to the nearest other particle
        room = image.grid.pixel_nm * max(image.grid.shape) / 2 + 600.0
        x, y = float(np.mean(image.grid.x_nm)), float(np.mean(image.grid.y_nm))
        # share of a neighbour's contrast that is new in a picture and disturbs it
        near = (others[number] for number, share in image.neighbours if abs(share) > 0.02)
        return all(max(abs(o.x_nm - x), abs(o.y_nm - y)) > room for o in near)

    return [image for image in images if is_alone(image)]


_FADE_NM = 250.0  # beyond the pictures the template fades to nothing
_ROAM_NM = 400.0  # along x and y, in the fit of one picture


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

    def times(self, coefficients: FloatArray, factor: NDArray[Any]) -> FloatArray:
        """Coefficients of the picture whose waves are multiplied by complex factors."""
        n = self.qx.size
        cos, sin = coefficients[:n], np.concatenate([[0.0], coefficients[n:]])
        turned = (cos - 1j * sin) * factor
        return np.concatenate([turned.real, -turned.imag[1:]])


@dataclass(frozen=True)
class PictureFit:
    """A template and the pictures that made it."""

    template: Template
    images: Images
    effective: float


@dataclass(frozen=True)
class PictureFitter:
    """Fits the picture that particles share, on a lattice, for regions of a side."""

    nominal: ForwardModel
    roi_nm: float
    step_nm: float
    level: bool
    """Whether the light of every picture has a level of its own."""

    mapper: Mapper = map

    def own(self, images: Images, template: Template) -> Images:
        """Fit what is each picture's own."""
        model = with_template(self.nominal, template)
        return list(self.mapper(lambda s: fit_own(s, model, level=self.level), images))

    def fit(self, images: Images) -> PictureFit:
        """Fit the picture that all particles share."""
        pixel, own = images[0].grid.pixel_nm, images
        side = max(images[0].grid.shape) * pixel
        # between periodic images, beside what fades
        waves = _Waves.within(1.2 / self.step_nm, side + 2 * (_FADE_NM + 250.0))
        several = self.nominal.area.points(pixel)[0].size > 1
        coefficients = np.zeros(2 * waves.qx.size - 1)
        prior = np.eye(coefficients.size)
        used, moved = 0, math.inf
        while used < 8 and moved > 0.1:  # of its noise
            used, before = used + 1, coefficients
            coefficients, covariance, effective = self._step(own, waves, coefficients, prior)
            coefficients, shift, size = _gauge(waves, coefficients, side / 2, self.step_nm, own)
            x, y = shift
            own = [
                replace(s, x_nm=s.x_nm + x, y_nm=s.y_nm + y, mass_kda=s.mass_kda * size)
                for s in own
            ]
            covariance = covariance / size**2
            prior = _prior(waves, coefficients, covariance, self.step_nm)
            contrast, sigma, peak_se = self._sampled(waves, coefficients, covariance, side)
            template = Template(
                contrast=contrast, sigma=sigma, step_nm=self.step_nm, pixel_nm=pixel,
                roi_nm=self.roi_nm, peak_se=peak_se, sights=len(own),
                side=self.nominal.area.side if several else 0.0,
            )  # fmt: skip
            own = self.own(own, template)
            moved = float(np.linalg.norm(coefficients - before) / np.sqrt(np.trace(covariance)))
        return PictureFit(template, own, effective)

    def _step(
        self, images: Images, waves: _Waves, coefficients: FloatArray, prior: FloatArray
    ) -> tuple[FloatArray, FloatArray, float]:
        """One Gauss–Newton step of the picture, places and levels eliminated picture by picture.

        Returns the coefficients, their covariance with the strengths held, and how many of them the
        data determine.
        """
        began, scale = bool(np.any(coefficients)), peak_per_amplitude(self.nominal)
        # along x and y
        slopes = [waves.times(coefficients, 1j * q) for q in (waves.qx, waves.qy)]

        def one(image: ParticleImage) -> tuple[FloatArray, FloatArray]:
            grid, strength, gain = image.grid, image.mass_kda * scale, math.exp(image.level)
            blur = self.nominal.area.points(grid.pixel_nm)
            basis = waves.on(grid.x_nm - image.x_nm, grid.y_nm - image.y_nm, blur)
            shown = strength * (basis @ coefficients)
            bright = (1 + shown / 2) ** 2
            contrast, weight = signal_of(image, self.nominal, (bright - 1).reshape(grid.shape))
            root = np.sqrt(weight.ravel())
            rest = root * (contrast.ravel() - (gain * bright - 1))
            rate = root * gain * (1 + shown / 2) * strength
            rows = basis * rate[:, None]
            nuisance = [root * bright] if self.level else []
            if began:
                nuisance += [rate * (basis @ slope) for slope in slopes]
            if nuisance:
                q, _ = np.linalg.qr(np.stack(nuisance, axis=1))
                rows, rest = rows - q @ (q.T @ rows), rest - q @ (q.T @ rest)
            return rows.T @ rows, rows.T @ rest

        found = list(self.mapper(one, images))
        information, pull = (np.sum(each, axis=0) for each in zip(*found, strict=True))
        values, vectors = np.linalg.eigh(prior.T @ information @ prior)
        values = np.maximum(values, 0.0)
        vectors = prior @ vectors
        pull = pull + information @ coefficients
        turned = vectors.T @ pull
        ridge, effective = 1e-3 * float(values[-1]), 0.0
        for _ in range(30):  # steps of the variance of the prior
            solved = turned / (values + ridge)
            effective = float(np.sum(values / (values + ridge)))
            ridge = effective / float(np.sum(solved**2))
        covariance = (vectors / (values + ridge)) @ vectors.T
        return covariance @ pull, covariance, effective

    def _sampled(
        self, waves: _Waves, coefficients: FloatArray, covariance: FloatArray, side_nm: float
    ) -> tuple[FloatArray, FloatArray, float]:
        """Sample the picture and its error on the lattice, and give the error of its peak.

        Beyond what was seen it fades.
        """
        count = math.ceil((side_nm / 2 + _FADE_NM) / self.step_nm)
        axis = np.asarray(self.step_nm * np.arange(-count, count + 1), dtype=np.float64)
        beyond = np.clip((np.abs(axis) - side_nm / 2) / _FADE_NM, 0, 1)
        fade = np.cos(math.pi / 2 * beyond) ** 2
        basis, window = waves.on(axis, axis, None), np.outer(fade, fade)
        image = (basis @ coefficients).reshape(window.shape) * window
        variance = np.einsum("pi,pi->p", basis @ covariance, basis).reshape(window.shape)
        # the strengths take what resembles the picture itself; the rest moves the peak
        peak = basis[int(np.argmax(np.abs(image)))]
        own = coefficients / np.sum(coefficients**2)
        rest = peak - (peak @ coefficients) * own
        return image, np.sqrt(variance) * window, float(np.sqrt(rest @ covariance @ rest))


def fit_own(image: ParticleImage, model: ForwardModel, *, level: bool) -> ParticleImage:
    """Fit what is a picture's own."""
    likelihood = Likelihood(model, image.grid, image.noise, image.data)
    start = np.array([image.x_nm, image.y_nm, model.height_nm, image.mass_kda, image.level])
    room = np.array([_ROAM_NM, _ROAM_NM, 0.0, 20 * abs(image.mass_kda), float(level)])
    half = (np.array(image.grid.shape[::-1]) - 1) / 2 * image.grid.pixel_nm
    centre = np.array([image.grid.x_nm.mean(), image.grid.y_nm.mean()])
    start[:2] = np.clip(start[:2], centre - np.minimum(half, _ROAM_NM), centre + _ROAM_NM)
    low, high = start - room, start + room
    low[:2], high[:2] = centre - _ROAM_NM, centre + _ROAM_NM
    free = np.array([True, True, False, True, level])
    found = likelihood.maximize(start, Box(free, low, high)).theta
    return image.moved(found)


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
    # width of the rings on which the prior is told
    ring = np.rint(np.hypot(axis[:, None], axis).ravel() / 150.0).astype(int)
    mean = np.bincount(ring, energy) / np.maximum(np.bincount(ring), 1)
    fading = np.maximum.accumulate(np.maximum(mean, 1e-4 * mean.max())[::-1])[::-1]
    spread = np.sqrt(fading / fading[0])[ring]
    back = basis.T * np.where(np.arange(coefficients.size) == 0, 1.0, 2.0)[:, None] / ring.size
    return np.asarray((back * spread) @ basis)


def _gauge(
    waves: _Waves, coefficients: FloatArray, half_nm: float, step_nm: float, images: Images
) -> tuple[FloatArray, tuple[float, float], float]:
    """Centre the energy, make the peak 1 and landings positive; give the shift and the factor."""
    axis = np.arange(-half_nm, half_nm + step_nm / 2, step_nm)
    pattern = (waves.on(axis, axis, None) @ coefficients).reshape(axis.size, axis.size)
    energy = pattern**2 / np.sum(pattern**2)
    x, y = float(energy.sum(axis=0) @ axis), float(energy.sum(axis=1) @ axis)
    centred = waves.times(coefficients, np.exp(1j * (waves.qx * x + waves.qy * y)))
    pattern = (waves.on(axis, axis, None) @ centred).reshape(axis.size, axis.size)
    row, column = np.unravel_index(int(np.argmax(np.abs(pattern))), pattern.shape)
    fine = step_nm * np.linspace(-1, 1, 17)  # where the peak is looked for
    near = waves.on(axis[column] + fine, axis[row] + fine, None) @ centred
    size = float(np.abs(near).max())
    if sum(math.copysign(1.0, image.mass_kda) for image in images) < 0:
        size = -size
    return centred / size, (x, y), size
