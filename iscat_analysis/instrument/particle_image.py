"""The picture of one particle, and pictures registered on their average."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from iscat_analysis.config import Config, refuse_rod
from iscat_analysis.errors import ConfigError
from iscat_analysis.inference.fit import goodness_of_fit
from iscat_analysis.inference.heights import height_prior
from iscat_analysis.inference.laws import CONDITIONAL, NoiseLaw
from iscat_analysis.inference.likelihood import Likelihood
from iscat_analysis.last_used import memoize
from iscat_analysis.optics.forward import ForwardModel, PixelGrid, forward_model, peak_per_amplitude
from iscat_analysis.optics.local import WEIGHTS, Spot, changes_at
from iscat_analysis.optics.parameters import FOCUS_STEP, Settings, with_settings
from iscat_analysis.records import BoolArray, FloatArray

PRIVATE = 5
"""Unknowns of one image, as `Likelihood` has them: x, y, z [nm], mass [kDa], logarithm of the
background level."""


ROAM_NM = 300.0
"""Farthest from the centre of a picture that its particle may be, along x and y."""


Build = Callable[[Settings], ForwardModel]
"""Makes the microscope of some settings."""


@dataclass(frozen=True)
class ParticleImage:
    """The picture of one particle: counts of a region, and where the search begins."""

    grid: PixelGrid
    noise: NoiseLaw
    data: FloatArray
    x_nm: float
    y_nm: float
    z_nm: float
    mass_kda: float = 0.0
    level: float = 0.0
    focus_steps: float = 0.0
    place: tuple[float, float] = (0.0, 0.0)
    after: tuple[bool, ...] = ()
    frames: tuple[float, float] = (0.0, 0.0)
    snr: float = 0.0
    neighbours: tuple[tuple[int, float], ...] = ()
    rings: FloatArray | float = 1.0
    baseline: float = 0.0
    owner: int = -1
    heights_nm: tuple[float, float] | None = None

    @property
    def private(self) -> FloatArray:
        """Start of the image's own unknowns, shape (5,)."""
        return np.array([self.x_nm, self.y_nm, self.z_nm, self.mass_kda, self.level])

    @property
    def free(self) -> BoolArray:
        """Which of its own unknowns are, shape (5,)."""
        return np.array([True, True, self.heights_nm is not None, True, True])

    def among(self, contrast: FloatArray) -> ParticleImage:
        """Return the image with the contrast of its neighbours in its expectation."""
        rings = 1 + contrast
        data = self.noise.multiplied(self.data, rings / self.rings)
        bare = self.noise.multiplied(data, 1 / rings)
        baseline = self.noise.reference_change(data, bare)
        return replace(self, data=data, rings=rings, baseline=baseline)

    def seen_with(self, settings: Settings) -> dict[str, Any]:
        """Return the settings of the microscope in this picture, as keys of ``[optics]``."""
        own = {k: v for k, v in settings.items() if k not in WEIGHTS and k != FOCUS_STEP}
        own["focus_nm"] += self.focus_steps * settings.get(FOCUS_STEP, 0.0)
        for base, change in changes_at(settings, self.spot).items():
            own[base] = own.get(base, 0.0) + change
        return own

    @property
    def spot(self) -> Spot:
        """Where in the field and when the picture was taken."""
        return Spot(*self.place, self.focus_steps, self.after)

    @property
    def step(self) -> float:
        """Frame between those with its particle and those without."""
        return sum(self.frames) / 2

    @property
    def shown(self) -> float:
        """Middle of the frames that show its particle."""
        return self.frames[0] if self.mass_kda < 0 else self.frames[1]

    def slopes(self, name: str) -> Mapping[str, float]:
        """Give by how much a shared parameter changes those of this picture's optics."""
        if name == FOCUS_STEP:
            return {"focus_nm": self.focus_steps}
        return WEIGHTS[name](self.spot) if name in WEIGHTS else {name: 1.0}

    def stretched(self, factor: float) -> ParticleImage:
        """Return the picture with pixels of another size."""
        was = self.grid
        grid = PixelGrid(factor * was.x_nm, factor * was.y_nm, factor * was.pixel_nm)
        return replace(self, grid=grid, x_nm=factor * self.x_nm, y_nm=factor * self.y_nm)

    @property
    def offset_nm(self) -> tuple[float, float]:
        """Place y, x of its particle from the centre of the picture."""
        middle_y, middle_x = float(np.mean(self.grid.y_nm)), float(np.mean(self.grid.x_nm))
        return self.y_nm - middle_y, self.x_nm - middle_x

    def moved(self, private: FloatArray) -> ParticleImage:
        """Return the same pictures with another start."""
        x, y, z, mass, level = (float(v) for v in private)
        return replace(self, x_nm=x, y_nm=y, z_nm=z, mass_kda=mass, level=level)

    def placed(self, x_nm: float, y_nm: float) -> ParticleImage:
        """Return the same picture with another place, or the nearest where it may be."""
        there = replace(self, x_nm=x_nm, y_nm=y_nm)
        y, x = (float(np.clip(away, -ROAM_NM, ROAM_NM)) - away for away in there.offset_nm)
        return replace(there, x_nm=x_nm + x, y_nm=y_nm + y)

    def raised(self, shift_nm: float) -> ParticleImage:
        """Return the same picture with another height, or the nearest that is possible."""
        low, high = self.heights_nm or (self.z_nm, self.z_nm)
        return replace(self, z_nm=min(max(self.z_nm + shift_nm, low), high))


Images = Sequence[ParticleImage]


def models_of(images: Images, build: Build, settings: Settings) -> list[ForwardModel]:
    """Give the microscope of every picture; those alike share one."""
    own = [tuple(image.seen_with(settings).items()) for image in images]
    models = {each: build(dict(each)) for each in dict.fromkeys(own)}
    return [models[each] for each in own]


UNIT_KDA = 1e3  # at which interference and scattered light are told apart, by their powers


FARTHEST_CENTRE_PX = 4.0  # a picture's first centre is off by no more


def contrast_of(image: ParticleImage) -> tuple[FloatArray, FloatArray]:
    """Measured contrast of an image and the variance of its noise.

    Shapes: `contrast, variance` (ny, nx).
    """
    information = image.noise.terms(image.data, np.zeros(image.grid.shape), 0.0).information
    with np.errstate(divide="ignore", invalid="ignore"):
        contrast = image.noise.measured_signal(image.data)
    used = (information > 0) & np.isfinite(contrast)
    level = float(np.average(contrast[used], weights=information[used]))
    variance = 1 / np.where(used, information, 1e-6)
    return np.where(used, contrast - level, 0.0), variance


def with_masses(images: Images, build: Build, settings: Mapping[str, Any]) -> Images:
    """Give every image the mass that fits it best where it stands."""
    out = []
    for image, model in zip(images, models_of(images, build, settings), strict=True):
        place = image.grid, image.x_nm, image.y_nm, image.z_nm
        signal, slopes = model.gradient(*place, UNIT_KDA)
        # contrast per mass, and per square of the mass: interference, and the scattered light
        square = (UNIT_KDA * slopes[3] - signal) / UNIT_KDA**2
        parts = signal / UNIT_KDA - UNIT_KDA * square, square
        contrast, variance = contrast_of(image)
        weight = 1 / variance
        pictures = np.array([part - np.average(part, weights=weight) for part in parts])
        gram = np.einsum("yx,iyx,jyx->ij", weight, pictures, pictures)
        overlaps = np.einsum("yx,iyx,yx->i", weight, pictures, contrast)
        mass, _ = best_amplitudes(overlaps[0], overlaps[1], gram[0, 0], gram[0, 1], gram[1, 1])
        out.append(replace(image, mass_kda=float(mass)))
    return tuple(out)


def best_amplitudes(
    linear: FloatArray, square: FloatArray, ll: FloatArray, ls: FloatArray, ss: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Best amplitude a of a picture a·L + a²·Q, of either sign, and the χ² that it explains.

    `linear` and `square` are the overlaps of L and Q with the data, `ll`, `ls`, `ss` their own; all
    broadcast.
    """
    linear, square, ll, ls, ss = np.broadcast_arrays(linear, square, ll, ls, ss)
    weak = linear / ll
    unit = np.where(weak == 0, 1.0, np.abs(weak))
    # b + (2 q − ll) a − 3 ls a² − 2 ss a³ = 0, in units in which the weak solution is ±1
    terms = np.stack([linear, (2 * square - ll) * unit, -3 * ls * unit**2, -2 * ss * unit**3])
    lead = np.where(np.abs(terms[3]) > 1e-12 * np.abs(terms).max(axis=0), terms[3], np.inf)
    companion = np.zeros((*weak.shape, 3, 3))
    companion[..., 1, 0] = companion[..., 2, 1] = 1.0
    companion[..., :, 2] = -np.moveaxis(terms[:3] / lead, 0, -1)
    roots = np.linalg.eigvals(companion)
    real = np.where(np.abs(roots.imag) < 1e-6 * (1 + np.abs(roots.real)), roots.real, 0.0)
    tried = np.concatenate([real * unit[..., None], weak[..., None]], axis=-1)
    b, q, g, h, k = (v[..., None] for v in (linear, square, ll, ls, ss))
    explained = 2 * (b * tried + q * tried**2) - (g * tried**2 + 2 * h * tried**3 + k * tried**4)
    best = np.argmax(explained, axis=-1)[..., None]
    amplitude, gain = (np.take_along_axis(v, best, -1)[..., 0] for v in (tried, explained))
    return amplitude, gain


def average_particle_images(images: Images) -> tuple[Images, Images]:
    """Average the pictures of each focus, registered on each other, with the sign of each."""
    placed, averages = list(images), []
    for offset in sorted({image.focus_steps for image in images}):
        members = [i for i, image in enumerate(images) if image.focus_steps == offset]
        average, group = _average([images[i] for i in members])
        averages.append(average)
        for i, image in zip(members, group, strict=True):
            placed[i] = image
    # of a scan, whose averages are searched
    chosen = np.unique(np.linspace(0, len(averages) - 1, min(7, len(averages))).round())
    return tuple(averages[int(i)] for i in chosen), tuple(placed)


def _average(images: Images) -> tuple[ParticleImage, Images]:
    """Average pictures of one focus; their places are those of the average's centre."""
    contrasts, variances = zip(*(contrast_of(image) for image in images), strict=True)
    pixel = images[0].grid.pixel_nm
    shifts = np.array([image.offset_nm for image in images]) / pixel
    template = ndimage.shift(contrasts[0], -shifts[0], order=3, mode="nearest")
    variance = np.full(template.shape, float(np.median(variances[0])))
    for _ in range(3 if len(images) > 1 else 0):
        total, weight = np.zeros_like(template), np.zeros_like(template)
        for index, (contrast, noise) in enumerate(zip(contrasts, variances, strict=True)):
            shifts[index] = _register(contrast, template, shifts[index])
            moved = ndimage.shift(contrast, -shifts[index], order=3, mode="nearest")
            noise = float(np.median(noise))
            scale = float(np.vdot(moved, template) / np.vdot(template, template))
            total += scale * moved / noise
            weight += scale**2 / noise
        template, variance = total / weight, 1 / weight
    data = np.zeros((4, *template.shape))
    counts = 2 / variance
    data[0], data[2], data[3] = counts * (1 + template), 1.0, 1.0
    data[1] = counts + data[0]
    grid = PixelGrid.centred(template.shape[0], pixel)
    average = ParticleImage(
        grid, CONDITIONAL, data, 0.0, 0.0, images[0].z_nm, focus_steps=images[0].focus_steps
    )
    placed = []
    for image, shift in zip(images, (shifts * pixel).tolist(), strict=True):
        y, x = (moved - was for moved, was in zip(shift, image.offset_nm, strict=True))
        placed.append(replace(image, x_nm=image.x_nm + x, y_nm=image.y_nm + y))
    return average, placed


def _register(contrast: FloatArray, template: FloatArray, shift: FloatArray) -> FloatArray:
    """Shift of a picture from a template of either sign; the last one, where it is far from that.

    A window about the last shift would leave neighbours out, and the rings that tell aberrations.
    """
    from skimage.registration import phase_cross_correlation  # only the learner needs it

    found, *_ = phase_cross_correlation(template, contrast, normalization=None, upsample_factor=20)
    near = np.abs(found + shift).max() <= FARTHEST_CENTRE_PX
    return np.asarray(-found if near else shift)


def place_particle_images(images: Images, nominal: ForwardModel) -> Images:
    """Register pictures on their average, and say how much of it each shows."""
    (average,), placed = average_particle_images(images)
    scale = peak_per_amplitude(nominal)
    shown = average.data[0] / (average.data[1] - average.data[0]) - 1
    top = float(np.abs(shown).max())
    out = []
    for image in placed:
        rows, columns = (
            (axis[:, None] - at) / image.grid.pixel_nm + (n - 1) / 2
            for axis, at, n in (
                (image.grid.y_nm, image.y_nm, shown.shape[0]),
                (image.grid.x_nm, image.x_nm, shown.shape[1]),
            )
        )
        places = np.broadcast_arrays(rows, columns.T)
        moved = ndimage.map_coordinates(shown, places, order=3, mode="nearest") / top
        contrast, weight = signal_of(image, nominal, np.zeros(image.grid.shape))
        moved = moved - np.average(moved, weights=weight)
        strength = np.sum(weight * moved * contrast) / np.sum(weight * moved**2)
        out.append(replace(image, mass_kda=float(strength) / scale))
    return out


def signal_of(
    image: ParticleImage, nominal: ForwardModel, signal: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Measured signal of a picture and its information, 0 where masked; the model takes no part.

    Shapes: `signal` (ny, nx), both results (ny, nx).
    """
    likelihood = Likelihood(nominal, image.grid, image.noise, image.data)
    return np.nan_to_num(likelihood.measured_signal()), likelihood.signal_information(signal)


def build_microscope(config: Config, reach_nm: float, settings: Settings) -> ForwardModel:
    """Make the forward model of other optics, with the model's own mass scale."""
    changed = with_settings(config, settings).changed(calibration=None)
    seated = not config.heights_free and not config.particle.height_is_open
    highest = config.particle.nominal_height_nm if seated else None
    return forward_model(changed, reach_nm, z_max_nm=highest)


RINGS_NM = 9000.0
"""Farther than this from a particle its rings are left out."""


TESTED = 24
"""Particles on which optics are tested, the brightest."""


def reach_nm(image: ParticleImage) -> float:
    """Distance from a particle, which may move in its picture, to the farthest pixel."""
    # how far a particle may lie from the centre of its picture
    return image.grid.diagonal_nm / 2 + 450.0


def refuse_uncalibratable(config: Config) -> None:
    """Refuse what has no reference to interfere with, or no derivative."""
    if not config.optics.interferes:
        raise ConfigError(
            'optics.scheme = "darkfield" has no reference, and the optics are learned from the '
            "interference with it: calibrate with an interferometric movie of the same microscope"
        )
    if config.optics.convention == "dong2021":
        raise ConfigError('optics.convention = "dong2021" cannot be calibrated: use "exact"')
    refuse_rod(config, "optics are learned from round particles")
    if config.particle.is_sphere:
        raise ConfigError(
            f'particle.model = "{config.particle.model}": optics are learned from dipoles; record '
            "some, and give the file with their optics as optics.file"
        )


def microscopes(config: Config, reach_nm: float) -> Build:
    """Make models of changing optics, and keep the last few."""

    def model(items: tuple[tuple[str, Any], ...]) -> ForwardModel:
        return build_microscope(config, reach_nm, dict(items))

    at_hand = memoize(64, model)  # as many as there are pictures with optics of their own
    return lambda settings: at_hand(tuple(settings.items()))


def rings_of(config: Config, image: ParticleImage) -> Build:
    """Make models as far as rings of neighbours matter."""
    return microscopes(config, RINGS_NM + image.grid.diagonal_nm)


def goodness(image: ParticleImage, model: ForwardModel) -> tuple[float, float]:
    """Reduced χ² and p-value of a fitted picture."""
    likelihood = Likelihood(model, image.grid, image.noise, image.data)
    return goodness_of_fit(likelihood, image.private, image.free)


def with_sign(config: Config) -> tuple[Config | None, str]:
    """Give learned optics the sign of contrast that the calibration of masses has.

    A line between contrast and mass fixes that sign, and with it the reference phase of two that
    differ by half a turn.
    """
    phase, reason = config.optics.reference_phase_deg, ""
    for turned in (phase, (phase + 360) % 360 - 180):
        update = {"reference_phase_deg": turned, "calibrate": "never", "file": None}
        learned = config.changed(optics=update)
        try:
            forward_model(learned, 1000.0)
            return learned, ""
        except ConfigError as error:
            reason = str(error)
    return None, reason


def with_heights(images: Images, config: Config) -> Images:
    """Let each particle have its own height, if heights are to be learned from the movie."""
    prior = height_prior(config, 0.0) if config.particle.height_is_open else None
    heights = None if prior is None else prior.range_nm
    return [replace(image, heights_nm=heights or image.heights_nm) for image in images]


@dataclass(frozen=True)
class Collected:
    """Pictures of particles, and what is known of the microscope that made them."""

    config: Config
    """As configured: where the search begins, and what stays where pictures do not tell it."""

    images: Images
    others: Images = ()
    """Particles whose rings are in the pictures."""

    near: Settings | None = None
    """A microscope near theirs, from which the fit goes on; None: one is looked for."""

    found_with: Config | None = None
    """Optics with which they were found; None where no optics took part in that."""

    focus_step_nm: float | None = None
    """Of a scan of the focus."""

    refusal: str = ""
    """Why no optics describe them, however well they fit."""
