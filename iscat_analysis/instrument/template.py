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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Any

import numpy as np

from iscat_analysis.config import Config
from iscat_analysis.diagnosis import calibrated
from iscat_analysis.errors import ConfigError, DataError
from iscat_analysis.findings import printing
from iscat_analysis.fitting.ranges import background_mode
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.instrument.collect import bright_particle_images, kind_of
from iscat_analysis.instrument.measure import HELD_OUT_P, Judgement, judge
from iscat_analysis.instrument.particle_image import (
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
from iscat_analysis.optics.measured import Template, lattice_step_nm
from iscat_analysis.optics.parameters import LEAST_IMAGES, settings_of
from iscat_analysis.records import FloatArray, Mapper, Progress, silent
from iscat_analysis.text import in_toml
from iscat_analysis.threads import threads
from iscat_analysis.units import count

MARGINS_PX = (10, 6, 2)
"""Pixels by which pictures may be cut larger on every side than the square that is fitted later.

The farther the template reaches, the more is known of the rings of a particle's neighbours; but
the larger a picture, the fewer hold one particle alone.
"""

_HELD_OUT = 3  # every third picture is held out
_CONTAMINATED_SHARE = 0.25  # more than this is the template's fault


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
        found, judged = self.template, self.judgement
        return {
            "accepted": self.accepted,
            "refusals": list(self.refusals),
            "particles": found.sights,
            "contaminated": self.contaminated,
            "determined": self.fit.effective,
            "peak_se": found.peak_se,
            "pixel_nm": found.pixel_nm,
            "roi_nm": found.roi_nm,
            "held_out": {
                "p_values": judged.p_values.tolist(),
                "chi2_reduced": judged.chi2_reduced.tolist(),
                "uniform_p": judged.uniform_p,
            },
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
    movie, config, camera = ready.steady, ready.config, ready.camera
    pixel = float(config.camera.pixel_size_nm or np.nan)
    roi_nm = config.fit.roi_px(pixel) * pixel
    physics = config.optics.model_copy(update={"psf": "model", "template": None})
    with threads(config.compute.workers) as pool:
        for number, margin in enumerate(MARGINS_PX):
            progress("particles", number, len(MARGINS_PX))
            larger = config.fit.model_copy(update={"roi_nm": roi_nm + 2 * margin * pixel})
            cut = config.model_copy(update={"fit": larger, "optics": physics, "calibration": None})
            alone = _alone(*bright_particle_images(movie, cut, camera, pool, ready.opening))
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
        source = {
            "movie": movie.path.name,
            "sha256": movie.sha256(),
            "kind": kind_of(config),
            "version": version("iscat-analysis"),
        }
        step = lattice_step_nm(config.optics.wavelength_nm, config.optics.n_glass)
        settings = {
            "roi_nm": max(roi_nm, config.fit.roi_nm),
            "step_nm": step,
            "level": background_mode(config) == "sliding",
        }
        return _judged(
            place_particle_images(alone, nominal), nominal, ready.with_frames_asked(config),
            settings, source, pool.map,
        )  # fmt: skip


def _judged(
    images: Sequence[ParticleImage],
    nominal: ForwardModel,
    config: Config,
    settings: Mapping[str, float],
    source: Mapping[str, str],
    mapper: Mapper,
) -> MeasuredPicture:
    """Fit with a third held out, leave out what is not a particle alone, then fit them all."""
    level = bool(settings["level"])
    options = {"roi_nm": settings["roi_nm"], "step_nm": settings["step_nm"]}

    def fit(some: Sequence[ParticleImage]) -> PictureFit:
        return fit_picture(some, nominal, level=level, mapper=mapper, **options)

    def fitted_with(some: Sequence[ParticleImage], found: PictureFit) -> list[ParticleImage]:
        model = with_template(nominal, found.template)
        return list(mapper(lambda s: fit_own(s, model, level=level), some))

    def judged(some: Sequence[ParticleImage], found: PictureFit) -> Judgement:
        model = with_template(nominal, found.template)
        return judge(some, lambda _: model, settings_of(config), mapper)

    first = fit([s for i, s in enumerate(images) if i % _HELD_OUT != 1])
    held = fitted_with(images[1::_HELD_OUT], first)
    # something else happened in a picture with a smaller p-value
    kept = [(some, judged(some, first).p_values > 1e-4) for some in (first.images, held)]
    bad = sum(int(np.sum(~good)) for _, good in kept)
    contaminated = 0
    if 0 < bad <= _CONTAMINATED_SHARE * len(images):
        contaminated = bad
        rest = [s for s, ok in zip(*kept[0], strict=True) if ok]
        first = fit(rest)
        held = fitted_with([s for s, ok in zip(*kept[1], strict=True) if ok], first)
    judgement = judged(held, first)
    refusals = []
    if judgement.uniform_p < HELD_OUT_P:
        refusals.append(
            f"of {judgement.p_values.size} pictures that were held out the p-values are not "
            f"uniform (p = {judgement.uniform_p:.1g}, mean reduced chi2 = "
            f"{float(np.mean(judgement.chi2_reduced)):.3f})"
        )
    return MeasuredPicture(
        config, fit([*first.images, *held]), judgement, contaminated, source, tuple(refusals)
    )


def _alone(images: Sequence[ParticleImage], others: Sequence[ParticleImage]) -> list[ParticleImage]:
    """Leave out pictures into which another particle reaches."""

    def is_alone(image: ParticleImage) -> bool:
        # from the edge of a picture to the nearest other particle
        room = image.grid.pixel_nm * max(image.grid.shape) / 2 + 600.0
        x, y = float(np.mean(image.grid.x_nm)), float(np.mean(image.grid.y_nm))
        # share of a neighbour's contrast that is new in a picture and disturbs it
        near = (others[number] for number, share in image.neighbours if abs(share) > 0.02)
        return all(max(abs(o.x_nm - x), abs(o.y_nm - y)) > room for o in near)

    return [image for image in images if is_alone(image)]


_ROUNDS = 8
_SETTLED = 0.1  # change of the picture, over its noise, at which rounds end
_FADE_NM = 250.0  # beyond the pictures the template fades to nothing
_ROAM_NM = 400.0  # along x and y, in the fit of one picture
_LEAST = 1e-4  # of its variance, relative to that of the centre
_FINE = 8  # points per step of the lattice, where the peak is looked for


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
    images: tuple[ParticleImage, ...]
    effective: float
    rounds: int


def fit_picture(
    images: Sequence[ParticleImage],
    nominal: ForwardModel,
    *,
    roi_nm: float,
    step_nm: float,
    level: bool,
    mapper: Mapper = map,
) -> PictureFit:
    """Fit the picture that all particles share."""
    pixel = images[0].grid.pixel_nm
    side = max(images[0].grid.shape) * pixel
    # between periodic images, beside what fades
    waves = _Waves.within(1.2 / step_nm, side + 2 * (_FADE_NM + 250.0))
    own = list(images)
    blur = nominal.area.points(pixel)
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
        template = replace(template, side=nominal.area.side if blur[0].size > 1 else 0.0)
        model = with_template(nominal, template)
        own = list(mapper(lambda s, m=model: fit_own(s, m, level=level), own))
        moved = float(np.linalg.norm(coefficients - before) / np.sqrt(np.trace(covariance)))
    return PictureFit(template, tuple(own), effective, used)


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
    found = likelihood.maximize(start, free, low, high).theta
    return image.moved(found)


def _solve(
    images: Sequence[ParticleImage],
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

    def one(image: ParticleImage) -> tuple[FloatArray, FloatArray]:
        grid, strength, gain = image.grid, image.mass_kda * scale, math.exp(image.level)
        basis = waves.on(grid.x_nm - image.x_nm, grid.y_nm - image.y_nm, blur)
        shown = strength * (basis @ coefficients)
        bright = (1 + shown / 2) ** 2
        contrast, weight = signal_of(image, nominal, (bright - 1).reshape(grid.shape))
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

    found = list(mapper(one, images))
    information = np.sum([each[0] for each in found], axis=0)
    pull = np.sum([each[1] for each in found], axis=0) + information @ coefficients
    values, vectors = np.linalg.eigh(prior.T @ information @ prior)
    values = np.maximum(values, 0.0)
    vectors = prior @ vectors
    turned = vectors.T @ pull
    ridge = 1e-3 * float(values[-1])
    effective = 0.0
    for _ in range(30):  # steps of the variance of the prior
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
    # width of the rings on which the prior is told
    ring = np.rint(np.hypot(axis[:, None], axis).ravel() / 150.0).astype(int)
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
    images: Sequence[ParticleImage],
) -> tuple[FloatArray, tuple[float, float], float]:
    """Centre the energy, make the peak 1 and landings positive; give the shift and the factor."""
    axis = np.arange(-half_nm, half_nm + step_nm / 2, step_nm)
    pattern = (waves.on(axis, axis, None) @ coefficients).reshape(axis.size, axis.size)
    energy = pattern**2 / np.sum(pattern**2)
    x, y = float(energy.sum(axis=0) @ axis), float(energy.sum(axis=1) @ axis)
    centred = waves.moved(coefficients, x, y)
    pattern = (waves.on(axis, axis, None) @ centred).reshape(axis.size, axis.size)
    row, column = np.unravel_index(int(np.argmax(np.abs(pattern))), pattern.shape)
    fine = step_nm * np.linspace(-1, 1, 2 * _FINE + 1)
    near = waves.on(axis[column] + fine, axis[row] + fine, None) @ centred
    size = float(np.abs(near).max())
    if sum(math.copysign(1.0, image.mass_kda) for image in images) < 0:
        size = -size
    return centred / size, (x, y), size


def _template(
    waves: _Waves,
    coefficients: FloatArray,
    covariance: FloatArray,
    images: Sequence[ParticleImage],
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
        pixel_nm=images[0].grid.pixel_nm,
        roi_nm=roi_nm,
        peak_se=float(np.sqrt(rest @ covariance @ rest)),
        sights=len(images),
    )
